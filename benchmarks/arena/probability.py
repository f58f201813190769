"""Calibration of the probabilities of sets of effects: stored evidence, reliability, credible sets."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arena.marks import good
from rotflex_jax.arena.marking import alike, exact
from rotflex_jax.arena.scores import Event, calibration_error, reliability
from rotflex_jax.arena.simulator.hidden import EQUIVALENT
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.text.colours import BASELINE, FINAL, INK
from rotflex_jax.text.plotting import blank, styled

if TYPE_CHECKING:  # a process makes its settings before it imports JAX
    from rotflex_jax.discover import Discovery
    from rotflex_jax.discover.probabilities import EvidenceRule, Probabilities

Row = dict[str, Any]

CREDIBLE = 0.9
"""Probability of a credible set."""


def told(result: Discovery, evidence: bool = False) -> Row:
    """The entries of a row for the probabilities of a search.

    Args:
        result: Result of the search.
        evidence: Whether the evidence of each half second is stored too, for a calibration.
    """
    found = result.probabilities
    if found is None:
        return {}
    row: Row = {"probabilities": told_of(found), "misfit": result.assessment.misfit}
    if evidence:
        row["evidence"] = [
            [sorted(s.effects), _written(s.prediction, 2), _written(s.free_run, 4)] for s in found.evidence
        ]
    return row


def told_of(found: Probabilities) -> Row:
    """Sets and their probabilities, for JSON."""
    return {
        "sets": [[sorted(s.effects), round(s.probability, 5)] for s in found.sets],
        "elsewhere": found.elsewhere,
    }


def _written(blocks: NDArray[np.float64] | None, digits: int) -> str | None:
    """Values of the blocks as a line of text."""
    return None if blocks is None else " ".join(f"{x:.{digits}f}" for x in blocks)


@functools.cache
def _read(line: str | None) -> NDArray[np.float64] | None:
    return None if line is None else np.array(line.split(), float)


def weighed(row: Row, rule: EvidenceRule) -> Probabilities:
    """The probabilities of a row under another rule, from its stored evidence."""
    from rotflex_jax.discover.probabilities import FittedSet, probabilities

    sets = [FittedSet(frozenset(names), _read(p), _read(f)) for names, p, f in row["evidence"]]
    return probabilities(sets, misfit=misfit(row), rule=rule)


def misfit(row: Row) -> float:
    """Misfit of the final model of a row; in rows without it, computed from short free runs alone."""
    from rotflex_jax.discover.verdict import Assessment

    if "misfit" in row:
        return row["misfit"]
    errors = row["errors"]["validation"]["final"]["windows"] if "errors" in row else row["windows"]
    return Assessment({}, {c: errors[c] / row["noise_floor"][c] for c in errors}, 0.0).misfit


def place_of(name: str) -> Place:
    """Effect and port of a name such as "coulomb@hub"."""
    effect, _, port = name.partition("@")
    return effect, port


def reduced(names: Iterable[str], row: Row) -> frozenset[Place] | None:
    """A set of effects without further errors of a wrong world; None for a right set.

    Names of further errors make an answer neither better nor worse, so that sets that differ only by such
    names count as the same answer.
    """
    places = frozenset(place_of(n) for n in names)
    if "world" not in row:
        return None if exact(places, [(e, p) for e, p in row["wanted"]]) else places
    wanted = set() if row["hidden"] is None else alike((row["hidden"][0], row["hidden"][1]))
    besides = {(e, p) for b in row["besides"] for e, p in b["names"]} - wanted
    left = places - besides
    right = not left if not wanted else bool(left) and left <= wanted
    return None if right else left


def classes(row: Row) -> list[Event]:
    """Probabilities of the answers of a row, most probable first; sets with the same answer are added up."""
    mass: dict[frozenset[Place] | None, float] = {}
    for names, p in row["probabilities"]["sets"]:
        key = reduced(names, row)
        mass[key] = mass.get(key, 0.0) + p
    return sorted((Event(p, key is None) for key, p in mass.items()), key=lambda e: -e.probability)


def effect_events(row: Row) -> list[Event]:
    """Probability of each effect of a row, and whether it or an equivalent effect is present."""
    if "world" in row:
        there = {(e, p) for b in row["besides"] for e, p in b["names"]}
        there |= set() if row["hidden"] is None else alike((row["hidden"][0], row["hidden"][1]))
    else:
        there = {q for e, p in row["wanted"] for q in {(e, p)} | EQUIVALENT.get((e, p), set())}
    mass: dict[str, float] = {}
    for names, p in row["probabilities"]["sets"]:
        for name in names:
            mass[name] = mass.get(name, 0.0) + p / (1 - row["probabilities"]["elsewhere"])
    return [Event(p, place_of(name) in there) for name, p in mass.items()]


def usable(records: Iterable[Row]) -> list[Row]:
    """Rows with probabilities, without those whose effect the catalogue lacks."""
    return [r for r in good(list(records)) if "probabilities" in r and not r.get("outside")]


def scatter_of_right(machines: Sequence[Sequence[float]], draws: int = 300) -> tuple[float, float]:
    """Calibration error by chance if all probabilities are right: its mean and its 95 % quantile.

    Args:
        machines: Probabilities of mutually exclusive answers, for each machine.
        draws: How often the truth of all machines is drawn from these probabilities.
    """
    rng, found = np.random.default_rng(0), []
    for _ in range(draws):
        told = []
        for claimed in machines:
            true = int(np.searchsorted(np.cumsum(claimed), rng.random()))
            told += [Event(p, k == true) for k, p in enumerate(claimed)]
        found.append(calibration_error(told))
    return float(np.mean(found)), float(np.quantile(found, 0.95))


class CredibleSets(NamedTuple):
    """Share of credible sets that contain the truth, their mean number of answers, and the number of rows."""

    held: float
    size: float
    cases: int


def credible(rows: Sequence[Row]) -> CredibleSets:
    """Credible sets of rows: fewest answers with the share `CREDIBLE` of the probability of fitted sets."""
    held, sizes = [], []
    for row in rows:
        listed = classes(row)
        total = np.cumsum([e.probability for e in listed])
        size = min(int(np.searchsorted(total, (CREDIBLE - 1e-9) * total[-1])) + 1, len(listed))
        held.append(any(e.true for e in listed[:size]))
        sizes.append(size)
    return CredibleSets(float(np.mean(held)), float(np.mean(sizes)), len(rows))


def summary(records: Iterable[Row]) -> str:
    """Calibration of the rows of a results file, in lines of text."""
    lines, every = [], usable(records)
    kinds = {
        "plain": [r for r in every if "world" not in r],
        "wrong worlds": [r for r in every if "world" in r],
        "all": every,
    }
    for name, rows in kinds.items():
        if not rows:
            continue
        top, sets = [classes(r)[0] for r in rows], [e for r in rows for e in classes(r)]
        known = sum(any(e.true for e in classes(r)) for r in rows)
        c = credible(rows)
        first = [[e.probability] for e in top]
        every_set = [[e.probability for e in classes(r)] for r in rows]
        expected = [scatter_of_right(machines) for machines in (first, every_set)]
        least = [f"({mean:.3f} if all were right, up to {high:.3f})" for mean, high in expected]
        lines.append(
            f"{name}: {len(rows)} machines, the right set fitted in {known}; most probable set right in "
            f"{sum(e.true for e in top)}, mean probability {np.mean([e.probability for e in top]):.3f}, "
            f"calibration error {calibration_error(top):.3f} {least[0]}; all sets "
            f"{calibration_error(sets):.3f} {least[1]}; "
            f"effects {calibration_error([e for r in rows for e in effect_events(r)]):.3f}; sets of "
            f"{100 * CREDIBLE:g} % hold the truth in {100 * c.held:.1f} %, mean size {c.size:.2f}"
        )
    return "\n".join(lines)


@styled
def draw_probabilities(records: list[Row], path: Path) -> None:
    """Draws the reliability diagram of the probabilities of sets and of effects."""
    rows = usable(records)
    figure = blank(5.4, 4.8)
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color=INK, linewidth=0.8, label="as claimed")
    kinds = (
        ([e for r in rows for e in classes(r)], "o", FINAL, "sets of effects"),
        ([e for r in rows for e in effect_events(r)], "s", BASELINE, "effects"),
    )
    for events, marker, colour, name in kinds:
        bins = reliability(events)
        scatter = [math.sqrt(b.claimed * (1 - b.claimed) / b.cases) for b in bins]
        ax.errorbar(
            [b.claimed for b in bins],
            [b.held for b in bins],
            yerr=scatter,
            fmt=marker,
            color=colour,
            markersize=4.5,
            capsize=2.5,
            label=f"{name}; expected calibration error {calibration_error(events):.3f}",
        )
    ax.set_xlim(-0.02, 1.02)
    ax.set_ylim(-0.05, 1.2)
    ax.set_xlabel("probability claimed [–]")
    ax.set_ylabel("share that were so [–]")
    ax.set_title(f"Probabilities and what became of them ({len(rows)} machines)")
    ax.legend(loc="upper left")
    figure.savefig(path, dpi=160)


def drawn_probabilities(records: list[Row], results: Path) -> list[Path]:
    """Draws the diagram to a file such as `B0_probabilities.png`, if any rows have probabilities."""
    if not usable(records):
        return []
    path = results.with_name(f"{results.stem}_probabilities.png")
    draw_probabilities(records, path)
    return [path]
