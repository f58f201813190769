"""Compares what a search answered with what was hidden; knows names, not methods."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rotflex_jax.arena.simulator.hidden import ABSORBED, EQUIVALENT, OUTSIDE, UNSEEN
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.simulator.plant import Plant
from rotflex_jax.effects.base import full_name
from rotflex_jax.text.numbers import json_number

# Arena's parameter -> the parameters of the same effect in the package.
_RENAMED: dict[str, dict[str, tuple[str, ...]]] = {
    "coulomb_asymmetric": {"level_plus": ("forward",), "level_minus": ("backward",)},
    "quadratic_spring": {"coefficient": ("stiffness",)},
    "cubic_spring": {"coefficient": ("stiffness",)},
    "dead_zone": {"width": ("positive", "negative")},
    "lugre": {"speed": ("slow",)},
}


def renamed(place: Place, values: Mapping[str, float], K: float = Plant.K) -> dict[str, float]:
    """An effect's parameters under the package's names.

    Args:
        place: name and port.
        values: parameters under the arena's names.
        K: stiffness of the plant's joint [N m/rad], which play takes away.

    Returns:
        Parameter names and values as `rotflex_jax.effects` has them.
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
    """The hidden effects that a textbook joint lacks and this input and these sensors can show."""
    missing = {"theta", "alpha"} - set(channels)
    seen = [p for p in hidden if p not in ABSORBED and kind not in UNSEEN.get(p, set())]
    return [p for p in seen if p[1] not in missing]


def alike(place: Place) -> set[Place]:
    """The effect itself and its documented look-alikes."""
    return {place} | EQUIVALENT.get(place, set())


def exact(answer: Iterable[Place], wanted: Sequence[Place]) -> bool:
    """Whether the answer is the truth, or the truth written with all look-alikes instead."""
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
        equivalents: for each of them, what it was said to be mistaken for.
        verdict: the end state in one word.

    Returns:
        `first`: the first effect is true, look-alikes allowed; `strict`: true by name; `exact`: the
        whole set; `inside`: every true effect is found or listed; `hits`: how many are; `set_size`: the
        largest set that a round was reported as; `extra`: effects that are neither
        true nor look-alikes; `verdict_right`, which for an effect outside the package is that
        something remains unexplained; `outside`: whether there was one.
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
    """True values beside the estimates of the same full name; effects not found are left out.

    So are effects that only add to a constant of the baseline: they have no number of their own.

    Args:
        hidden: parameters under the arena's names.
        estimates: full name `port.effect.parameter` -> object with `value` and `ci95`.
        K: stiffness of the plant's joint [N m/rad].

    Returns:
        Full name -> true value, estimate with its standard deviation, error [%], whether the 95 % interval
        holds the truth.
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
