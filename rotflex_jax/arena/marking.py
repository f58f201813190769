"""Compares an answer with the hidden effects, by names; independent of the methods."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rotflex_jax.arena.simulator.hidden import ABSORBED, EQUIVALENT, OUTSIDE, UNSEEN
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.simulator.plant import Plant
from rotflex_jax.effects.base import full_name
from rotflex_jax.text.numbers import json_number

# Effect -> parameter in the arena -> parameters of the same effect in the package.
_RENAMED: dict[str, dict[str, tuple[str, ...]]] = {
    "coulomb_asymmetric": {"level_plus": ("forward",), "level_minus": ("backward",)},
    "quadratic_spring": {"coefficient": ("stiffness",)},
    "cubic_spring": {"coefficient": ("stiffness",)},
    "dead_zone": {"width": ("positive", "negative")},
    "lugre": {"speed": ("slow",)},
}


def renamed(place: Place, values: Mapping[str, float], K: float = Plant.K) -> dict[str, float]:
    """Parameters of an effect under the names of the package.

    Args:
        place: name and port.
        values: parameters under the names of the arena.
        K: stiffness of the joint [N m/rad], which is missing within a play.

    Returns:
        Parameter names and values as in `rotflex_jax.effects`.
    """
    if place[0] == "gravity":  # -m sin(z + phase), expanded
        m, phase = values["moment"], values["phase"]
        return {"sine": m * math.cos(phase), "cosine": m * math.sin(phase)}
    if place[0] == "cogging":
        a, phase = values["amplitude"], values["phase"]
        return {
            "sine": a * math.cos(phase),
            "cosine": a * math.sin(phase),
            "periods": values["periods"],
        }
    if place[0] == "backlash":  # from the middle to each stop
        return {"gap": values["play"] / 2}
    if place[0] == "joint_play":
        return {**values, "stiffness": K}
    names = _RENAMED.get(place[0], {})
    return {new: value for old, value in values.items() for new in names.get(old, (old,))}


def visible(hidden: Iterable[Place], kind: str, channels: Sequence[str] = ("theta", "alpha")) -> list[Place]:
    """The hidden effects that the textbook joint lacks and that this input and these sensors can show."""
    missing = {"theta", "alpha"} - set(channels)
    seen = [p for p in hidden if p not in ABSORBED and kind not in UNSEEN.get(p, set())]
    return [p for p in seen if p[1] not in missing]


def alike(place: Place) -> set[Place]:
    """The effect itself and its documented equivalents."""
    return {place} | EQUIVALENT.get(place, set())


def exact(answer: Iterable[Place], wanted: Sequence[Place]) -> bool:
    """Whether the answer is the truth, where an effect may be replaced by all of its equivalents."""
    got = set(answer)
    options = [set[Place]()]
    for place in wanted:
        choices = [{place}, *([EQUIVALENT[place]] if place in EQUIVALENT else [])]
        options = [o | c for o in options for c in choices]
    return any(got == o for o in options)


def scored(
    wanted: Sequence[Place],
    rounds: Sequence[Place],
    equivalents: Sequence[Sequence[Place]],
    verdict: str,
) -> dict[str, Any]:
    """Marks of one answer.

    Args:
        wanted: effects that should be found.
        rounds: effects that were found, in order.
        equivalents: for each of these, the effects that were reported as equivalent.
        verdict: the verdict in one word.

    Returns:
        `first`: whether the first effect is true, or an equivalent of a true one; `strict`: whether it is
        true by name; `exact`: whether the whole set is true; `inside`: whether every true effect is found or
        listed as equivalent; `hits`: how many are; `set_size`: size of the largest set of equivalent effects;
        `extra`: effects that are neither true nor equivalents of true ones; `verdict_right`: whether the
        verdict is right, which for an effect outside the package is `unexplained`; `outside`: whether there
        is such an effect.
    """
    listed = set(rounds) | {p for group in equivalents for p in group}
    allowed = {p for place in wanted for p in alike(place)}
    marks: dict[str, Any] = {
        "first": bool(rounds) and rounds[0] in allowed if wanted else not rounds,
        "strict": bool(rounds) and rounds[0] in wanted if wanted else not rounds,
        "exact": exact(rounds, wanted),
        "inside": all(alike(p) & listed for p in wanted),
        "hits": sum(bool(alike(p) & listed) for p in wanted),
        "set_size": max((1 + len(group) for group in equivalents), default=0),
        "extra": [list(p) for p in rounds if p not in allowed],
    }
    outside = any(p in OUTSIDE for p in wanted)
    if outside:
        right = verdict == "unexplained"
    elif not wanted:
        right = verdict in ("nothing_missing", "not_excited") and not rounds
    elif verdict == "ambiguous":
        right = marks["inside"]
    else:
        right = verdict == "found" and marks["exact"]
    return {**marks, "verdict_right": right, "outside": outside}


def parameter_errors(
    hidden: Mapping[Place, Mapping[str, float]], estimates: Mapping[str, Any], K: float = Plant.K
) -> dict[str, dict[str, Any]]:
    """True values and estimates of the parameters with the same full name; effects not found are left out.

    Effects that only add to a constant of the baseline are left out too: they have no separate estimate.

    Args:
        hidden: parameters under the names of the arena.
        estimates: full name `port.effect.parameter` -> object with `value`, `std` and `ci95`.
        K: stiffness of the joint [N m/rad].

    Returns:
        Full name -> true value, estimate with its standard deviation, error [%], and whether the 95 %
        interval contains the true value.
    """
    table = dict[str, dict[str, Any]]()
    for place, values in hidden.items():
        if place in ABSORBED:
            continue
        for name, true in renamed(place, values, K).items():
            full = full_name(place[1], place[0], name)
            if full not in estimates:
                continue
            e = estimates[full]
            table[full] = {
                "true": true,
                "estimate": e.value,
                "std": json_number(e.std),
                "error_percent": 100 * (e.value - true) / abs(true) if true else math.nan,
                "covered": bool(e.ci95[0] <= true <= e.ci95[1]),
            }
    return table
