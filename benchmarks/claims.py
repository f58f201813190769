"""Texts for the documents that are computed from results of benchmarks: counts, medians, tables.

`quoted.py` writes them into the documents, between marks with the name of the function.
"""

from __future__ import annotations

import functools
import json
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import scipy.stats

from arena.probability import classes, credible, scatter_of_right, usable
from arena.wrong_table import SEEN as SEEN_WORLDS
from rotflex_jax.arena.measured import MACHINES
from rotflex_jax.arena.scores import Event, calibration_error
from rotflex_jax.effects.labels import law_of
from rotflex_jax.parameters import HALF_WIDTH_95
from speed.table import waiting

RESULTS = Path(__file__).resolve().parent / "results"

# Name -> function that returns the text between the marks with this name.
NAMED: dict[str, Callable[[], str]] = {}


def named(function: Callable[[], str]) -> Callable[[], str]:
    """Registers a function under its name."""
    NAMED[function.__name__] = function
    return function


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in markdown, between the marks of a quotation."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(["", *(f"| {' | '.join(cells)} |" for cells in lines), ""])


ASKED: set[str] = set()
"""Names of the results files that `results` returned since this set was last emptied."""


def results(file: str) -> Any:
    """Content of a file of results; its name is added to `ASKED`."""
    ASKED.add(file)
    return _read(file)


@functools.cache
def _read(file: str) -> Any:
    return json.loads((RESULTS / file).read_text(encoding="utf-8"))


# -- wrong worlds -------------------------------------------------------------------------------------------


def _worlds(marked: str, seen: bool = False, kind: str | None = None) -> tuple[int, int]:
    """Number of wrong worlds in which the entry `marked` is true, and number where it is not None."""
    every = results("B0_wrong_worlds.json")["records"].values()
    rows = [r for r in every if (r["world"] in SEEN_WORLDS) is seen and r.get(marked) is not None]
    rows = [r for r in rows if kind in (None, r["kind"])]
    return sum(bool(r[marked]) for r in rows), len(rows)


@named
def worlds_named() -> str:
    """Number of worlds whose hidden effect was named, of all."""
    return "{} of {}".format(*_worlds("named"))


@named
def worlds_named_joint() -> str:
    """Number of flexible joints whose hidden effect was named, of all."""
    return "{} of {}".format(*_worlds("named", kind="joint"))


@named
def worlds_named_link() -> str:
    """Number of links with a strain gauge whose hidden effect was named, of all."""
    return "{} of {}".format(*_worlds("named", kind="link"))


@named
def worlds_missed_bound() -> str:
    """Upper 95 % limit of the share of worlds whose hidden effect is not named [%]."""
    found, count = _worlds("named")
    return _at_most(count - found, count)


@named
def worlds_wrong_bound() -> str:
    """Upper 95 % limit of the share of worlds in which a wrong effect is called established [%]."""
    return _at_most(*_worlds("wrong_established"))


@named
def worlds_seen_named() -> str:
    """Number of worlds read before an earlier revision whose hidden effect was named, of all."""
    return "{} of {}".format(*_worlds("named", seen=True))


@named
def worlds_seen_wrong() -> str:
    """Number of worlds read before an earlier revision in which a wrong effect was called established."""
    return "{} of {}".format(*_worlds("wrong_established", seen=True))


@named
def worlds_other_law() -> str:
    """Missed effects of worlds read earlier for which another law of the same friction was named, of all."""
    found = results("B0_wrong_worlds.json")["records"].values()
    missed = [r for r in found if r["world"] in SEEN_WORLDS and r.get("named") is False]
    friction = [r for r in missed if law_of(r["hidden"][0]) == "dry friction"]
    alike = [
        r
        for r in friction
        if any(law_of(q["effect"]) == "dry friction" and q["port"] == r["hidden"][1] for q in r["rounds"])
    ]
    return f"{len(alike)} of {len(missed)}"


@named
def worlds_wrong() -> str:
    """Number of worlds in which a wrong effect was called established, of all."""
    return "{} of {}".format(*_worlds("wrong_established"))


def _worlds_with_probabilities() -> list[dict[str, Any]]:
    return usable(results("B0_wrong_worlds.json")["records"].values())


@named
def worlds_most_probable() -> str:
    """Number of worlds whose most probable set is right, of all."""
    top = [classes(row)[0] for row in _worlds_with_probabilities()]
    return f"{sum(e.true for e in top)} of {len(top)}"


@named
def worlds_claimed() -> str:
    """Mean probability of the most probable sets [%]."""
    return f"{100 * statistics.mean(classes(row)[0].probability for row in _worlds_with_probabilities()):.0f}"


def _calibrated(machines: list[list[Event]], digits: int) -> str:
    """Mean distance of probability and frequency, and the distance that right probabilities would show."""
    chance, most = scatter_of_right([[e.probability for e in answers] for answers in machines])
    error = calibration_error([e for answers in machines for e in answers])
    show = lambda x: f"{x:.{digits}f}"  # noqa: E731
    return f"{show(error)} ({show(chance)} if all were right, up to {show(most)} in 95 %)"


@named
def worlds_calibrated() -> str:
    """Calibration error of the most probable sets, and the error that right probabilities would show."""
    return _calibrated([classes(row)[:1] for row in _worlds_with_probabilities()], 2)


@named
def worlds_calibrated_all() -> str:
    """Calibration error of all sets, and the error that right probabilities would show."""
    return _calibrated([classes(row) for row in _worlds_with_probabilities()], 3)


@named
def worlds_credible() -> str:
    """Share of worlds whose credible set of 90 % contains the truth [%], and the mean size of the set."""
    c = credible(_worlds_with_probabilities())
    return f"{100 * c.held:.0f} % (mean size {c.size:.1f})"


# -- the measured joint -------------------------------------------------------------------------------------

WAYS = {"ab": "A to B", "ba": "B to A", "mixed": "first 7 s of both to the last 3 s"}


def _three(value: float) -> str:
    """Three digits, but no more than two decimals."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


IN_WORDS = {
    "coulomb": "Coulomb friction",
    "dahl": "Dahl friction",
    "lugre": "LuGre friction",
    "bouc_wen": "Bouc-Wen hysteresis",
}


def joint_errors(way: str, stage: int) -> str:
    """Errors of short free runs at a stage of a search, and in brackets errors of one whole run [deg]."""
    found = results("B1.json")["search"][WAYS[way]]
    here = [found["baseline"], *found["rounds"]][stage]
    short, whole = (
        " / ".join(_three(math.degrees(here[kind][c])) for c in ("theta", "alpha"))
        for kind in ("held_out_rmse_windows", "held_out_rmse")
    )
    return f"{short} ({whole})"


def joint_effects(way: str) -> list[str]:
    """Effects that a search found, in order, in words."""
    rounds = results("B1.json")["search"][WAYS[way]]["rounds"]
    place = lambda port: f"of {port}" if port in ("theta", "alpha") else f"at the {port}"  # noqa: E731
    return [f"{IN_WORDS.get(r['effect'], r['effect'].replace('_', ' '))} {place(r['port'])}" for r in rounds]


def joint_first(way: str) -> str:
    """The first effect that a search found, and the errors with it."""
    found = joint_effects(way)
    return f"{found[0]}: {joint_errors(way, 1)}" if found else "none was found"


def joint_all(way: str) -> str:
    """The further effects that a search found, and the errors with all effects."""
    found = joint_effects(way)
    return f"{', '.join(found[1:])}: {joint_errors(way, -1)}" if len(found) > 1 else "the same"


for _way in WAYS:
    NAMED[f"joint_{_way}_baseline"] = functools.partial(joint_errors, _way, 0)
    NAMED[f"joint_{_way}_first"] = functools.partial(joint_first, _way)
    NAMED[f"joint_{_way}_all"] = functools.partial(joint_all, _way)


@named
def joint_noise() -> str:
    """Noise of the sensors [deg]."""
    floor = results("B1.json")["search"]["A to B"]["noise_floor"]
    return " / ".join(f"{math.degrees(floor[c]):.3f}" for c in ("theta", "alpha"))


@named
def joint_fitted_freely() -> str:
    """Errors of short free runs over B of LuGre friction and hysteresis, fitted to free runs over A [deg]."""
    found = results("B1.json")["fits"]["LuGre at the hub, Bouc-Wen at the joint, from A"]
    return " / ".join(f"{e:.2f}" for e in found["evaluated"]["B"]["no_offset"])


@named
def joint_theta_fall() -> str:
    """Factor by which Coulomb friction fitted to run A reduces the short-run error of theta over run B."""
    found = results("B1.json")
    before = math.degrees(found["search"]["A to B"]["baseline"]["held_out_rmse_windows"]["theta"])
    after = found["fits"]["Coulomb at the hub, from A"]["evaluated"]["B"]["no_offset"][0]
    return f"{before / after:.1f}"


# -- measured machines --------------------------------------------------------------------------------------


def _measured() -> dict[str, dict[str, Any]]:
    """Directions (training to test data) of machines without signals; those with signals are left out."""
    rows = results("B9.json")["rows"]
    return {key: row for key, row in rows.items() if not MACHINES[row["machine"]].with_signals}


@named
def measured_others() -> str:
    """Number of other methods that had the same recordings."""
    (count,) = {len(row["others"]["rows"]) for row in _measured().values()}
    return str(count)


def _used(row: dict[str, Any]) -> dict[str, Any]:
    """Errors of the model to use."""
    return row["reported"].get("fitted to all") or row["reported"]["final"]


def measured_lead(row: dict[str, Any], horizon: str, channel: int) -> float | None:
    """Error of the best other method over the error of the model to use.

    Args:
        row: A direction.
        horizon: "" for whole runs, "_windows" for runs of 2 s.
        channel: Which of the row's channels.

    Returns:
        The ratio, above one where the model to use is ahead; None where the machine has no such channel.
    """
    key = f"rmse{horizon}"
    used = _used(row)[f"test_{key}"]
    names = [c for c in used if c != "seconds"]
    if channel >= len(names):
        return None
    ok = [other for other in row["others"]["rows"] if other["status"] == "ok"]
    errors = [e for other in ok if (e := (other[f"held_out_{key}"] or {}).get(names[channel])) is not None]
    return min(errors) / used[names[channel]]


def measured_ahead(horizon: str, channel: int) -> str:
    """Number of directions in which the model to use is better than every other method, of all."""
    leads = [measured_lead(row, horizon, channel) for row in _measured().values()]
    have = [lead for lead in leads if lead is not None]
    return f"{sum(lead > 1 for lead in have)} of {len(have)}"


for _number, _channel in enumerate(("first", "second")):
    for _name, _horizon in (("windows", "_windows"), ("whole", "")):
        NAMED[f"measured_{_channel}_{_name}"] = functools.partial(measured_ahead, _horizon, _number)


MEASURED_DIRECTIONS = {
    "rotflex: A to B": "measured joint, A to B",
    "rotflex: B to A": "measured joint, B to A",
    "rotflex: A and half of B to the rest": "measured joint, A and half of B to the rest",
    "rotflex: B and half of A to the rest": "measured joint, B and half of A to the rest",
    "rotflex: first 70 % of all to the rest": "measured joint, the first 70 % of both to the rest",
    "emps: official": "EMPS, official",
    "emps: first half to second half": "EMPS, first half to second half",
    "rigid_arm: gain 6, decided on gain 8, to gains 1 and 3": "rigid arm, gain 6 to gains 1 and 3",
    "rigid_arm: gain 8, decided on gains 1 and 3, to gain 6": "rigid arm, gain 8 to gain 6",
    "rigid_arm: gains 1 and 3, decided on gain 6, to gain 8": "rigid arm, gains 1 and 3 to gain 8",
    "rigid_arm: first 70 % of all to the rest": "rigid arm, first 70 % of all to the rest",
    "flexible_arm: first half to second half": "flexible arm, first half to second half",
    "bam_xl330: gains 100 to 400 to gain 800": "XL-330, gains 100 to 400 to gain 800",
    "bam_xl330: gain 800 to gains 100 to 400": "XL-330, gain 800 to gains 100 to 400",
    "so101: random motion to steps": "SO-101, elbow, random motion to steps",
    "so101: steps to random motion": "SO-101, elbow, steps to random motion",
}
"""Directions in the table of the model to use -> their labels there."""
_OF_STAGES = {
    "lqr, first half to its end": "2026, first half to its end",
    "feedback, first half to its end": "2011, first half to its end",
    "lqr to feedback": "2026 to 2011",
    "feedback to lqr": "2011 to 2026",
    "lqr and half of feedback to the rest": "2026 and half of 2011 to the rest",
    "feedback and half of lqr to the rest": "2011 and half of 2026 to the rest",
    "first 70 % of all to the rest": "first 70 % of both to the rest",
}
MEASURED_DIRECTIONS |= {
    f"two_dof_link_{stage}: {way}": f"two-link machine, stage {stage}, {runs}"
    for stage in (1, 2)
    for way, runs in _OF_STAGES.items()
}


def _whole_and_windows(errors: dict[str, Any], name: str, channel: str) -> str:
    """Errors of one channel over whole runs and over 2 s, of positions in millimetres, else in degrees."""
    factor = 1e3 if channel == "position" else math.degrees(1.0)
    return " / ".join(f"{factor * errors[name + horizon][channel]:.2f}" for horizon in ("", "_windows"))


@named
def measured_models() -> str:
    """The table of the model to use beside the best other method, in the first channel."""
    rows, lines = results("B9.json")["rows"], []
    for key, label in MEASURED_DIRECTIONS.items():
        reported, best = rows[key]["reported"], rows[key]["others"]["rows"][0]
        channel = next(iter(reported["final"]["test_rmse"]))
        lines.append(
            [
                label,
                "mm" if channel == "position" else "deg",
                _whole_and_windows(reported["final"], "test_rmse", channel),
                _whole_and_windows(used, "test_rmse", channel)
                if (used := reported["fitted to all"])
                else "not taken",
                f"{_whole_and_windows(best, 'held_out_rmse', channel)} (`{best['method']}`)",
            ]
        )
    head = ["machine, direction", "unit", "the search, fitted to training data", "the model to use"]
    return _table([*head, "best other, by whole runs"], lines)


# -- the two-link machine with signals -----------------------------------------------------------------------


def _in_degrees(errors: dict[str, float], stage: int | None = None) -> str:
    """Errors of theta and alpha over 2 s [deg]; with `stage` errors of this stage of a two-stage machine."""
    names = [name if stage is None else f"{name}{stage}" for name in ("theta", "alpha")]
    return " / ".join(f"{math.degrees(errors[name]):.2f}" for name in names)


LINEAR = ("arx", "subspace", "state_space")
"""Linear methods of `compare` without a physical model; signals are further inputs to them."""


def _best_linear(row: dict[str, Any]) -> str:
    """Errors and name of the linear method that is best on the test data, by which the rows are ranked."""
    best = next(m for m in row["others"]["rows"] if m["method"] in LINEAR and m["status"] == "ok")
    return f"{_in_degrees(best['held_out_rmse_windows'])} ({best['method']})"


@named
def two_link_signals() -> str:
    """The table of the two-link machine without and with the motion of the other stage."""
    ways = ("search, by itself", "linear, by itself", "search, other link known", "linear, other link known")
    lines = []
    rows = results("B9.json")["rows"]
    for stage, other in ((1, 2), (2, 1)):
        for run, year in (("lqr", 2026), ("feedback", 2011)):
            way = f"{run}, first half to its end"
            alone, beside, both = (
                rows[f"{machine}: {way}"]
                for machine in (
                    f"two_dof_link_{stage}",
                    f"two_dof_link_{stage}_beside_{other}",
                    "two_stage_link",
                )
            )
            cells = [
                _in_degrees(alone["reported"]["baseline"]["test_rmse_windows"]),
                _in_degrees(_used(alone)["test_rmse_windows"]),
                _best_linear(alone),
                _in_degrees(_used(beside)["test_rmse_windows"]),
                _best_linear(beside),
                _in_degrees(_used(both)["test_rmse_windows"], stage),
            ]
            lines.append([f"{stage}, {year}", *cells])
    return _table(["stage, run", "as it is", *ways, "both stages in one"], lines)


# -- fits of measured machines ------------------------------------------------------------------------------

FITTED_MACHINES = {
    "rotflex": "rotary joint",
    "emps": "EMPS",
    "rigid_arm": "rigid arm",
    "flexible_arm": "flexible arm",
    "two_dof_link_1": "two-link machine, stage 1",
    "two_dof_link_2": "two-link machine, stage 2",
}


# Costs of fits that differ by no more than this count as equal [nat].
SAME_COST = 1.0


def _above_coulomb(which: int) -> str:
    """Number of fits that end with a larger cost than Coulomb friction, though their law contains it.

    Args:
        which: 0 for fits without restarts, 1 with restarts; the fit of Coulomb friction has restarts.
    """
    each = [
        pair[which]["cost"] > laws["coulomb"][1]["cost"] + SAME_COST
        for laws in results("B15.json")["rows"].values()
        for law, pair in laws.items()
        if law != "coulomb"
    ]
    return f"{sum(each)} of {len(each)}"


def _ratio(pairs: list[list[dict[str, Any]]], errors: str) -> float:
    """Errors of fits with restarts over errors without: geometric mean over fits and channels."""
    logs = [math.log(more[errors][c] / one[errors][c]) for one, more in pairs for c in one[errors]]
    return math.exp(statistics.mean(logs))


@named
def restarted_fits() -> str:
    """The table of fits without and with restarts."""
    lines = []
    for machine, title in FITTED_MACHINES.items():
        rows = results("B15.json")["rows"]
        pairs = [
            pair for key, laws in rows.items() if key.startswith(f"{machine}:") for pair in laws.values()
        ]
        lower = sum(more["cost"] < one["cost"] - SAME_COST for one, more in pairs)
        ratios = (f"{_ratio(pairs, errors):.2f}" for errors in ("rmse", "test_rmse"))
        lines.append([title, str(len(pairs)), str(lower), *ratios])
    return _table(["machine", "fits", "with a lower cost", "training data", "test data"], lines)


@named
def restarts_take() -> str:
    """Time of a fit with restarts over the time without: median and largest."""
    rows = results("B15.json")["rows"]
    ratios = [more["seconds"] / one["seconds"] for laws in rows.values() for one, more in laws.values()]
    return f"{statistics.median(ratios):.0f} times as long in the median and {max(ratios):.0f} times at most"


def _whole_converged(which: int) -> str:
    """Number of fits to whole runs that converge, of all; `which` is 0 without restarts, 1 with restarts."""
    each = [pair[which]["status"] == "converged" for pair in results("B15.json")["whole"].values()]
    return f"{sum(each)} of {len(each)}"


for _which, _name in enumerate(("once", "restarted")):
    NAMED[f"above_coulomb_{_name}"] = functools.partial(_above_coulomb, _which)
    NAMED[f"whole_converged_{_name}"] = functools.partial(_whole_converged, _which)


# -- the arena ----------------------------------------------------------------------------------------------

SEEN = (1000, 1001)
"""Seeds of recordings that were read during revisions of the search.

Quoted figures are of the other recordings.
"""


def records(
    *, outside: bool = False, hidden: bool = True, effects: int = 1, size: float = 1.0
) -> list[dict[str, Any]]:
    """Records whose seeds were not read in a revision of the search.

    By default these are records with known effects: `effects` of them at once, of the share `size` of their
    usual size, with both sensors. With `outside` they have an effect that the catalogue lacks; with
    `hidden=False` they have nothing to be found.
    """
    every = results("B0.json")["records"].values()
    ran = [r for r in every if "error" not in r and r["seed"] not in SEEN]
    if outside:
        return [r for r in ran if r["outside"]]
    if not hidden:
        return [r for r in ran if not r["outside"] and not r["wanted"]]
    found = [r for r in ran if not r["outside"] and len(r["wanted"]) == effects and len(r["channels"]) == 2]
    return [r for r in found if len(r["effects"]) == effects and r.get("size", 1.0) == size]


@named
def arena_seen() -> str:
    """Seeds of the records that are left out."""
    return " and ".join(map(str, SEEN))


@named
def arena_hidden() -> str:
    """Number of records with one effect to be found."""
    return str(len(records()))


@named
def arena_first() -> str:
    """Number of records with one effect to be found in which it was named first."""
    return str(sum(bool(r["first"]) for r in records()))


@named
def arena_small() -> str:
    """Number of records with one effect of a fifth of its usual size."""
    return str(len(records(size=0.2)))


@named
def arena_small_first() -> str:
    """Number of records with one effect of a fifth of its usual size in which it was named first."""
    return str(sum(bool(r["first"]) for r in records(size=0.2)))


@named
def arena_pairs() -> str:
    """Number of records with two effects to be found."""
    return str(len(records(effects=2)))


@named
def arena_pairs_both() -> str:
    """Number of records with two effects in which both were found or in a set that was reported."""
    return str(sum(r["hits"] == 2 for r in records(effects=2)))


@named
def arena_pairs_one() -> str:
    """Number of records with two effects in which at least one was found or in a set that was reported."""
    return str(sum(r["hits"] >= 1 for r in records(effects=2)))


@named
def arena_inside() -> str:
    """Number of records with one effect in which it was found or in a set that was reported."""
    return str(sum(bool(r["inside"]) for r in records()))


@named
def arena_nothing() -> str:
    """Number of records in which nothing is to be found."""
    return str(len(records(hidden=False)))


@named
def arena_alarms() -> str:
    """Number of records in which nothing is to be found, but an effect was named (false alarms)."""
    return str(sum(bool(r["rounds"]) for r in records(hidden=False)))


def most(k: int, n: int) -> float:
    """Upper limit of the exact one-sided 95 % confidence interval of a share, for k cases of n.

    If the true share had this value, k or fewer cases of n would occur with a probability of 5 %.

    Source: C. J. Clopper and E. S. Pearson, Biometrika 26, 1934.

    >>> round(most(0, 116), 4), round(most(3, 60), 4)
    (0.0255, 0.1242)
    """
    return float(scipy.stats.beta.ppf(0.95, k + 1, n - k)) if k < n else 1.0


def _at_most(k: int, n: int) -> str:
    """The upper limit from `most` in per cent, rounded up."""
    return f"{math.ceil(1000 * most(k, n)) / 10:.1f}"


@named
def arena_alarm_bound() -> str:
    """Upper 95 % limit of the share of false alarms [%]."""
    return _at_most(int(arena_alarms()), int(arena_nothing()))


@named
def arena_missed_bound() -> str:
    """Upper 95 % limit of the share of missed effects [%]."""
    found, count = int(arena_inside()), len(records())
    return _at_most(count - found, count)


@named
def arena_overlooked_bound() -> str:
    """Upper 95 % limit of the share of effects outside of the catalogue not called unexplained [%]."""
    found, count = int(arena_unexplained()), int(arena_outside())
    return _at_most(count - found, count)


@named
def arena_outside() -> str:
    """Number of records with an effect that the catalogue lacks."""
    return str(len(records(outside=True)))


@named
def arena_unexplained() -> str:
    """Number of records with an effect that the catalogue lacks which were called unexplained."""
    return str(sum(r["verdict"] == "unexplained" for r in records(outside=True)))


@named
def arena_outside_named() -> str:
    """Number of records with an effect that the catalogue lacks in which an effect was named, wrongly."""
    return str(sum(bool(r["rounds"]) for r in records(outside=True)))


@named
def arena_over_oracle() -> str:
    """Median of held-out error over error of the true structure, in records with one effect, all channels."""
    ratios = sorted(v for r in records() for v in r.get("over_oracle", {}).values())
    return f"{ratios[len(ratios) // 2]:.2f}"


@named
def arena_intervals() -> str:
    """Share of 95 % intervals that contain the true value, over records with one effect [%]."""
    numbers = [p for r in records() for p in r["parameters"].values() if p.get("std")]
    held = sum(abs(p["estimate"] - p["true"]) <= HALF_WIDTH_95 * p["std"] for p in numbers)
    return f"{100 * held / len(numbers):.0f}" if numbers else "–"


@named
def arena_numbers() -> str:
    """Number of parameters with a 95 % interval, over records with one effect."""
    return str(sum(bool(p.get("std")) for r in records() for p in r["parameters"].values()))


@named
def arena_seconds() -> str:
    """Median processor time of a search [s]; other programs ran beside it."""
    times = sorted(r["cpu_s"] for r in records())
    return f"{times[len(times) // 2]:.0f}"


def arena_commit() -> str:
    """Revision of the code of the latest run."""
    return results("B0.json")["runs"][-1]["commit"]


# -- public machines ----------------------------------------------------------------------------------------


def _row(machine: str, words: str) -> dict[str, Any]:
    return next(r for r in results("B3.json")[machine]["rows"] if words in r["model"])


def _last_effect(machine: str) -> dict[str, Any]:
    """The row of the last effect that the search itself added."""
    return results("B3.json")[machine]["rows"][len(results("B3.json")[machine]["rounds"])]


for _part in ("multisine", "arrow"):
    NAMED[f"silverbox_{_part}"] = lambda part=_part: f"{_last_effect('silverbox')['free run'][part]:.2f}"
    NAMED[f"silverbox_{_part}_narx"] = lambda part=_part: (
        f"{results('B3.json')['silverbox']['published']['Gaussian-process NARX'][part]:.2f}"
    )


@named
def silverbox_errors() -> str:
    """Table of errors of free runs over the official tests, of models that were found and published [mV]."""
    case = results("B3.json")["silverbox"]
    tests = list(case["rows"][0]["free run"])
    last = len(case["rounds"])
    rows = {
        "mass, damper, spring": case["rows"][0],
        "all that was found but the bias of the output": case["rows"][last - 1],
        "all that was found": case["rows"][last],
        "the same with a held input": case["rows"][-1],
    }
    errors = {words: row["free run"] for words, row in rows.items()}
    for method in ("Gaussian-process NARX", "SUBNET", "linear"):
        errors[f"published by Champneys et al.: {method}"] = case["published"][method]
    cells = [
        [words, *(f"{each[t]:.3g}" if t in each else "" for t in tests)] for words, each in errors.items()
    ]
    return _table(["model", *(f"{t} [{case['unit']}]" for t in tests)], cells)


@named
def emps_errors() -> str:
    """Table of errors of models of EMPS, each fitted to one free run over the training record [mm]."""
    case = results("B3.json")["emps"]
    words = ("mass and viscous damping", "+ dry friction", "+ damping unequal in the two directions")
    labels = [*words, "+ an offset that drifts through the record"]
    rows = [
        [label, f"{row['trained']:.3g}", f"{row['free run']['pulses']:.3g}"]
        for label, row in zip(labels, case["rows"], strict=True)
    ]
    bound = case["bound"]["errors"]["pulses"]
    rows.append(["the last, fitted to the test itself: what the structure could do", "", f"{bound:.2g}"])
    methods = ("polynomial NARX", "linear state space", "ARX")
    errors = ", ".join(f"{case['published'][m]['pulses']:.3g}" for m in methods)
    rows.append([f"published by Champneys et al.: {', '.join(methods)}", "", errors])
    model = "model, parameters fitted to one free run over the training record"
    return _table([model, "training [mm]", "official test [mm]"], rows)


EMPS_PARAMETERS = {
    "axis.inertia.inertia": "mass [kg]",
    "axis.viscous.coefficient": "viscous damping [N s/m]",
    "axis.coulomb.level": "dry friction [N]",
    "axis.viscous_asymmetric.asymmetry": "half the damping forwards less that backwards [N s/m]",
}


@named
def emps_parameters() -> str:
    """Table of parameters of EMPS by several fits, with 95 % intervals, and as published."""
    case = results("B3.json")["emps"]
    predictions = {c["parameter"]: c["prediction"] for c in case["conditional_intervals"]}
    of_search, of_run = _last_effect("emps")["search estimates"], case["rows"][-1]["free-run estimates"]

    def told(estimates: dict[str, Any], name: str) -> str:
        if name not in estimates:
            return ""
        low, high = estimates[name]["ci95"]
        return f"{estimates[name]['value']:.4g} ({low:.4g} to {high:.4g})"

    return _table(
        ["", "predictions", "search: free runs of 2 s", "one free run over the record", "published"],
        [
            [
                words,
                *(told(estimates, name) for estimates in (predictions, of_search, of_run)),
                f"{case['constants'][name][0]:.4g}" if name in case["constants"] else "",
            ]
            for name, words in EMPS_PARAMETERS.items()
        ],
    )


@named
def rigid_arm_errors() -> str:
    """Errors of free runs of the rigid arm, fitted to the run with gain 6 [mrad]."""
    case = results("B3.json")["rigid arm"]
    first, *found = case["rows"]
    by_search = found[: len(case["rounds"])]
    rows = {"inertia and viscous damping": first}
    rows |= {f"+ {row['model'].replace('_', ' ')}, by the search": row for row in by_search}
    by_hand = ("dry friction, by hand, fitted to free runs", "and an offset of the voltage")
    rows |= dict(zip(by_hand, found[len(by_search) :], strict=True))
    tests = list(first["free run"])
    return _table(
        ["rigid arm", *(t.removesuffix(", theta") for t in tests), "windows of 2 s of both"],
        [
            [words, *(f"{row['free run'][t]:.3g}" for t in tests), f"{row['windows']['theta']:.3g}"]
            for words, row in rows.items()
        ],
    )


@named
def emps_narx() -> str:
    """Published error of the polynomial NARX model of EMPS [mm]."""
    return f"{results('B3.json')['emps']['published']['polynomial NARX']['pulses']:.2f}"


def _millimetres(pair: list[float]) -> str:
    """Two errors [m] in millimetres."""
    return " and ".join(f"{1e3 * e:.{1 if e > 1e-3 else 2}f}" for e in pair)


@named
def emps_unequal() -> str:
    """Damping of EMPS backwards less its damping forwards [N s/m]."""
    found = _last_effect("emps")["search estimates"]["axis.viscous_asymmetric.asymmetry"]
    return f"{-2 * found['value']:.0f}"


@named
def emps_candidates() -> str:
    """Number of candidates in the first round of free runs of EMPS."""
    return str(len(results("B3.json")["emps"]["free-run rounds"][0]["tried"]))


@named
def emps_before_drift() -> str:
    """Errors of free runs of EMPS over the two held-out parts before an effect was added [mm]."""
    return _millimetres(results("B3.json")["emps"]["free-run rounds"][0]["held_out"])


@named
def emps_with_drift() -> str:
    """Errors of free runs of EMPS over the two held-out parts with the effect that was added [mm]."""
    found = results("B3.json")["emps"]["free-run rounds"][0]
    return _millimetres(found["tried"][found["taken"]])


@named
def emps_runner_up() -> str:
    """Errors over these two parts with the next best effect, by the larger of its two errors [mm]."""
    found = results("B3.json")["emps"]["free-run rounds"][0]
    return _millimetres(min((e for name, e in found["tried"].items() if name != found["taken"]), key=max))


# -- every method -------------------------------------------------------------------------------------------


@named
def methods_count() -> str:
    """Number of methods that were compared on the mixed split of the measured joint."""
    return str(len(results("B5/rotflex_mixed.json")["rows"]))


def _fit_seconds() -> dict[str, float]:
    """Fit time of each method on run A of the measured joint, without the two methods that search [s]."""
    rows = results("B5/rotflex_AB.json")["rows"]
    slow = ("discovered", "learned_torque")
    return {r["method"]: r["fit_seconds"] for r in rows if r["method"] not in slow and r["fit_seconds"]}


@named
def compare_seconds() -> str:
    """Sum of the fit times of all methods that do not search [s]."""
    return f"{sum(_fit_seconds().values()):.0f}"


@named
def compare_ensemble() -> str:
    """Longest of these fit times, of the method `sindy_ensemble` [s]."""
    assert max(_fit_seconds(), key=_fit_seconds().__getitem__) == "sindy_ensemble"
    return f"{_fit_seconds()['sindy_ensemble']:.0f}"


@named
def compare_first() -> str:
    """Time of the first fit of a physical model, which compiles for the others [s]."""
    return f"{_fit_seconds()['linear']:.0f}"


@named
def compare_other() -> str:
    """Longest fit time of the other methods that do not search [s]."""
    return f"{max(s for m, s in _fit_seconds().items() if m not in ('sindy_ensemble', 'linear')):.1f}"


# -- many recordings ----------------------------------------------------------------------------------------


@named
def fleet_million() -> str:
    """Time that the machinery around a million searches takes [min]."""
    return f"{1e6 * results('B8.json')['fleet']['searched'] / 60:.0f}"


@named
def fleet_workers() -> str:
    """Number of workers that one command can supply, for each second that a search takes, to two digits."""
    return f"{float(format(1 / results('B8.json')['fleet']['searched'], '.2g')):,.0f}"


# -- kernels and learned torques ----------------------------------------------------------------------------


def _change(name: str, kernel: str) -> str:
    """Relative change of a kernel by an effect, in per cent."""
    share = 100 * results("B8.json")["kernels"]["shares"][name][kernel]
    return f"{share:.2g} %" if share else "exactly nothing"


for _effect in (
    *("coulomb hub", "coulomb joint", "stribeck hub", "dead zone", "saturation", "cubic spring"),
    *("quadratic drag", "joint play", "sensor cubic", "offset", "quadratic spring", "rectifier"),
    *("one-sided dead zone", "unequal coulomb", "offset with friction"),
):
    for _degree, _kernel in ((1, "linear"), (2, "quadratic")):
        _key = f"kernel_{_effect.replace(' ', '_').replace('-', '_')}_h{_degree}"
        NAMED[_key] = functools.partial(_change, _effect, _kernel)


def _in_noise(hidden: str, when: str) -> str:
    """Errors of short held-out runs, in multiples of the noise."""
    found = results("B8.json")["torque"][hidden]
    if when == "after" and not found["kept"]:
        return "not kept"
    return " / ".join(f"{found[when][c]:.1f}" for c in ("theta", "alpha"))


def _reads(hidden: str) -> str:
    """The formula of a learned torque, for a cell of a table; empty if it was not kept."""
    found = results("B8.json")["torque"][hidden]
    return "`" + found["formula"].replace("|", "\\|") + "`" if found["kept"] else ""


for _hidden in ("friction", "drag", "uneven friction", "nothing"):
    _key = f"torque_{_hidden.replace(' ', '_')}"
    NAMED |= {f"{_key}_{w}": functools.partial(_in_noise, _hidden, w) for w in ("before", "after")}
    NAMED[f"{_key}_reads"] = functools.partial(_reads, _hidden)


# -- other ways to find the effect --------------------------------------------------------------------------

# This method fits every candidate with the simulator of this package. It is not independent of the package
# and therefore counted separately.
REFITS = "refit + BIC"


def _search() -> dict[str, Any]:
    """Counts of the search on the records that the other methods were given."""
    return results("B6.json")["summary"]["rotflex_jax"]


def _regressions() -> dict[str, dict[str, Any]]:
    """Counts of the regressions that were given all records that the search was given."""
    summary = results("B6.json")["summary"]
    given = lambda sums: (sums["first"][1], sums["false_alarms"][1])  # noqa: E731
    every = given(summary["rotflex_jax"])
    apart = {"rotflex_jax", REFITS}
    return {n: sums for n, sums in summary.items() if n not in apart and given(sums) == every}


@named
def rivals_records() -> str:
    """Number of records with an effect that all methods were given."""
    return str(_search()["first"][1])


@named
def rivals_ours() -> str:
    """Number of records with an effect in which the search named it first."""
    return str(_search()["first"][0])


@named
def rivals_exact() -> str:
    """Number of records with an effect in which the search named it and nothing else."""
    return str(_search()["exact"][0])


@named
def rivals_refits() -> str:
    """Number of records with an effect in which the refit of this effect had the lowest BIC of all."""
    return str(results("B6.json")["summary"][REFITS]["first"][0])


@named
def rivals_refits_exact() -> str:
    """Number of records with an effect in which the refits named it and nothing else."""
    return str(results("B6.json")["summary"][REFITS]["exact"][0])


@named
def rivals_refits_seconds() -> str:
    """Processor time of the refits for one record: median and largest."""
    taken = [r["cpu_s"] for r in results("B6.json")["rows"].values() if r["rival"] == REFITS]
    return f"{statistics.median(taken):.0f} s (at most {max(taken):.0f})"


@named
def rivals_best() -> str:
    """Number of records with an effect in which the best of the regressions named it first."""
    return str(max(sums["first"][0] for sums in _regressions().values()))


@named
def rivals_count() -> str:
    """Number of regressions."""
    return str(len(_regressions()))


@named
def rivals_columns() -> str:
    """Whether the regressions had columns for states and for errors of sensors."""
    rows = [r for r in results("B6.json")["rows"].values() if r["rival"] in _regressions()]
    having = sum(bool(r.get("states")) for r in rows)
    return "had none" if not having else "had them" if having == len(rows) else "had them in part"


@named
def rivals_alarms() -> str:
    """False alarms of the regressions in records with nothing hidden: smallest and largest number."""
    alarms = [sums["false_alarms"][0] for sums in _regressions().values()]
    return f"{min(alarms)} to {max(alarms)}"


@named
def rivals_refits_alarms() -> str:
    """Number of false alarms of the refits in records with nothing hidden."""
    return str(results("B6.json")["summary"][REFITS]["false_alarms"][0])


@named
def rivals_outside() -> str:
    """Number of records with an effect that the catalogue lacks in which the refits named one, of all."""
    rows = [r for r in results("B6.json")["rows"].values() if r["rival"] == REFITS and r["outside"]]
    return f"{sum(bool(r['rounds']) for r in rows)} of {len(rows)}"


@named
def rivals_nothing() -> str:
    """Number of records with nothing hidden that all methods were given."""
    return str(_search()["false_alarms"][1])


# -- certainty ----------------------------------------------------------------------------------------------


@named
def certainty_cost() -> str:
    """Processor time of profiles, identifiability, bands and probabilities: smallest and largest [s]."""
    each = [parts["all"] for parts in results("B11.json")["summary"]["cost"].values()]
    return f"{min(each):.0f} to {max(each):.0f} s"


# -- the next experiment ------------------------------------------------------------------------------------

# Longest experiment of B4_sequential [s].
LONGEST_EXPERIMENT = 20.0


def decision_seconds(how: dict[str, Any], case: dict[str, Any]) -> float:
    """Time after which an experiment names the true model of a case [s]; the longest time if it does not."""
    decided = how.get("decided", case["verdict"] == "decided")  # a case is its own sequential experiment
    return how["seconds"] if decided and how["best"] == case["truth"] else LONGEST_EXPERIMENT


def _until_decided(kind: str) -> list[tuple[float, float]]:
    """Times to a decision with a kind of standard input and with the sequential experiment, by case [s].

    Hopeless cases are left out. Without a right decision, the longest time counts.
    """
    rows = [r for r in results("B4_sequential.json")["rows"] if not r["hopeless"]]
    pairs = [(next(s for s in r["standard"] if s["input"] == kind), r) for r in rows]
    return [(decision_seconds(s, r), decision_seconds(r, r)) for s, r in pairs]


def _kind_seconds(kind: str) -> str:
    """Median over the cases of the time to a decision with a kind of standard input [s]."""
    return f"{statistics.median(a for a, _ in _until_decided(kind)):.1f}"


def _kind_ratio(kind: str) -> str:
    """Median over cases of the time with a kind of standard input over that of the sequential experiment."""
    return f"{statistics.median(a / b for a, b in _until_decided(kind)):.1f}"


def _best_kind() -> str:
    """The kind of standard input with the smallest median time over the cases."""
    names = {"prbs": "binary sequence"}
    kind = results("B4_sequential.json")["summary"]["kind"]
    return names.get(kind, kind)


def _medians() -> str:
    """Median time of the best kind of standard input over the median time of the sequential experiment."""
    pairs = _until_decided(results("B4_sequential.json")["summary"]["kind"])
    standard, sequential = (statistics.median(seconds) for seconds in zip(*pairs, strict=True))
    return f"{standard / sequential:.1f}"


def _slow_ratio() -> str:
    """Median of the time of the fastest standard input over that of the sequential experiment.

    Only cases count in which the standard input takes more than 1 s. Which standard input is the fastest in a
    case is known only in hindsight.
    """
    ratios = []
    for row in results("B4_sequential.json")["rows"]:
        if not row["hopeless"]:
            fastest = min(decision_seconds(s, row) for s in row["standard"])
            if fastest > 1:
                ratios.append(fastest / decision_seconds(row, row))
    return f"{statistics.median(ratios):.1f}"


NAMED["decided_medians"] = _medians
NAMED["decided_slow"] = _slow_ratio
NAMED["decided_kind"] = _best_kind
for _kind in ("multisine", "prbs", "sweep", "steps", "noise"):
    NAMED[f"decided_{_kind}_seconds"] = functools.partial(_kind_seconds, _kind)
    NAMED[f"decided_{_kind}_ratio"] = functools.partial(_kind_ratio, _kind)


def _next_ratio(pair: str) -> str:
    """Margin with the design over the margin with the best standard input: smallest and largest ratio."""
    ratios = []
    for row in results("B4.json")["rows"]:
        if row["pair"] == pair:
            worth = {True: 0.0, False: 0.0}
            for i in row["inputs"]:
                design = i["input"] == "design"
                worth[design] = max(worth[design], i["margin"])
            ratios.append(worth[True] / worth[False])
    return f"{min(ratios):.0f} to {max(ratios):.0f}"


NAMED["next_ratio"] = functools.partial(_next_ratio, "delay or lag")
NAMED["next_ratio_mode"] = functools.partial(_next_ratio, "second mode or sensor gain")


# -- servos -------------------------------------------------------------------------------------------------


WITH_SLOPES = 3.5
"""Processor time of a free run with derivatives by about seven parameters, over that of a run without."""


@named
def servo_rollouts() -> str:
    """Number of free runs of the evolution (CMA-ES) of the grey box over the number for its fit."""
    name = "weight friction, delay"
    took = [results("B10.json")["summary"][n]["rollouts"] for n in (f"{name}, CMA-ES", name)]
    return f"{took[0] / took[1]:.0f}"


@named
def servo_robust_ratio() -> str:
    """Free runs of the evolution of M4 over those of the robust fit, each of which counts `WITH_SLOPES`."""
    summary = results("B10.json")["summary"]
    took = [summary[n]["rollouts"] for n in ("M4", "motor friction, delay, robust")]
    return f"{took[0] / (WITH_SLOPES * took[1]):.0f}"


@named
def servo_robust_processor() -> str:
    """Processor time of the robust fit [s], median over the splits."""
    rows = (case["motor friction, delay, robust"] for case in results("B10.json")["splits"].values())
    return f"{statistics.median(row['processor seconds'] for row in rows):.0f}"


def _arm_runs(name: str) -> str:
    """Number of free runs of a recording for the fit of a model of the SO-101, median over its joints."""
    took = (row["takes"][name]["rollouts"] for row in results("B10.json")["so101"])
    return f"{statistics.median(took):,.0f}"


def _arm_others(name: str) -> str:
    """Error of a model of the SO-101 over the test motions [deg], averaged over joints and motions.

    These motions were used for no fit and no choice.
    """
    rows = results("B10.json")["so101"]
    return f"{statistics.mean(errors[name] for row in rows for errors in row['others'].values()):.2f}"


def _arm_all(name: str) -> str:
    """Mean error of a model of the SO-101 over all motions that no fit used, also `step_response` [deg]."""
    rows = results("B10.json")["so101"]
    away = [e for row in rows for e in (row[name], *(errors[name] for errors in row["others"].values()))]
    return f"{statistics.mean(away):.2f}"


ARM = (
    "no friction",
    "Coulomb",
    "Coulomb, slow",
    "Coulomb, delay, CMA-ES",
    "M1",
    "M2",
    "M3",
    "M4",
    "M5",
    "M6",
    "parameters of M1",
)
for _k, _model in enumerate(ARM):
    NAMED[f"servo_arm_runs_{_k}"] = functools.partial(_arm_runs, _model)
    NAMED[f"servo_arm_others_{_k}"] = functools.partial(_arm_others, _model)
    NAMED[f"servo_arm_all_{_k}"] = functools.partial(_arm_all, _model)


def _arm_ratio(evolved: str, fitted: str, cost: float = 1.0) -> str:
    """Free runs of an evolution at the SO-101 over those of a fit, of `cost` each; medians over joints."""
    rows = results("B10.json")["so101"]
    took = [statistics.median(r["takes"][n]["rollouts"] for r in rows) for n in (evolved, fitted)]
    return f"{took[0] / (cost * took[1]):.0f}"


NAMED["servo_arm_ratio"] = functools.partial(_arm_ratio, "Coulomb, delay, CMA-ES", "Coulomb")
NAMED["servo_arm_ratio_M1"] = functools.partial(_arm_ratio, "M1", "parameters of M1")
NAMED["servo_arm_ratio_M1_equal"] = functools.partial(_arm_ratio, "M1", "parameters of M1", WITH_SLOPES)


# -- speed --------------------------------------------------------------------------------------------------

# Name -> row of B7.json, and the row of the same table with which it is compared.
BESIDE = {
    "lms_5": ("LMS M=5: rotflex_jax", "LMS M=5: C -O3"),
    "lms_10": ("LMS M=10: rotflex_jax", "LMS M=10: C -O3"),
    "lms_20": ("LMS M=20: rotflex_jax", "LMS M=20: C -O3"),
    "lms_50": ("LMS M=50: rotflex_jax", "LMS M=50: C -O3"),
    "padasip": ("LMS M=5: rotflex_jax", "LMS M=5: padasip"),
    "pairs": ("100 pairs: rotflex_jax, the sweep alone", "100 pairs: C -O3 over lanes"),
    "pair_slopes": ("1 pair: rotflex_jax value and gradient", "1 pair: rotflex_jax value"),
    "rls_21": ("RLS 21 weights: rotflex_jax", "RLS 21 weights: C -O3"),
    "rls_66": ("RLS 66 weights: rotflex_jax", "RLS 66 weights: C -O3"),
    "rls_231": ("RLS 231 weights: rotflex_jax", "RLS 231 weights: C -O3"),
    "order_4": ("smooth friction with current, order 4: value", "C -O3, RK4 without current"),
    "order_2": ("smooth friction with current, order 2: value", "C -O3, RK4 without current"),
    "dry": ("dry friction with current, order 2: value", "C -O3, RK4 without current"),
    "linear": ("linear, blocks: value", "C -O3, RK4 without current"),
    "linear_control": ("linear, blocks: value", "python-control, linear"),
    "solve_ivp": (
        "smooth friction with current, order 2: value",
        "solve_ivp RK45, default tolerance",
    ),
    "diffrax": ("smooth friction with current, order 2: value", "diffrax, Tsit5, a step per sample"),
    "casadi": ("smooth friction with current, order 2: value", "CasADi, RK4 by mapaccum"),
    "jacobian": (
        "smooth, order 2: value and Jacobian by 8, carried",
        "smooth, order 2: value inside JAX",
    ),
    "jacobian_stored": ("smooth, order 2: Jacobian by 8, stored", "smooth, order 2: value inside JAX"),
    "jacobian_dry": (
        "dry, order 2: value and Jacobian by 8, carried",
        "dry, order 2: value inside JAX",
    ),
    "sums": (
        "smooth, order 2: J'J and J'e by 8 and 4 first states",
        "smooth, order 2: value inside JAX",
    ),
    "fit_scipy": ("one fit: rotflex_jax", "one fit: scipy + numba"),
    "fit_optimistix": ("one fit: rotflex_jax", "one fit: optimistix"),
    "fit_solve_ivp": ("one fit: rotflex_jax", "one fit: scipy + solve_ivp"),
    "fit_intervals": ("one fit: rotflex_jax fit, with intervals", "one fit: scipy + numba"),
    "recordings": ("16 recordings: rotflex_jax", "16 recordings: scipy + numba"),
    "starts": ("64 starts, staged: rotflex_jax", "64 starts, staged: scipy + numba"),
}


def _cost(row: str) -> float:
    """Processor time of a row of the table of speed, in the unit of its table."""
    parts = (part for part in results("B7.json").values() if isinstance(part, dict))
    groups = [g for part in parts for g in part.get("groups", [])]
    return next(r["cpu"] for g in groups for r in g["rows"] if r["name"] == row)


def _digits(value: float) -> str:
    """Three digits, without a power of ten."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


@named
def order_4_over_2() -> str:
    """Cost of a run at order 4 over its cost at order 2."""
    return f"{_cost(BESIDE['order_4'][0]) / _cost(BESIDE['order_2'][0]):.1f}"


for _name, (_row_name, _base) in BESIDE.items():
    NAMED[f"{_name}_time"] = lambda row=_row_name: _digits(_cost(row))
    NAMED[f"{_name}_beside"] = lambda base=_base: _digits(_cost(base))
    NAMED[f"{_name}_ratio"] = lambda row=_row_name, base=_base: f"{_cost(row) / _cost(base):.2g}"
    NAMED[f"{_name}_gain"] = lambda row=_row_name, base=_base: _digits(_cost(base) / _cost(row))


@named
def waiting_for_searches() -> str:
    """The table of waiting times for searches."""
    found = results("B7.json").get("waiting")
    return "\n".join(["", *waiting(found["waiting"]), ""]) if found else "\nNot measured yet.\n"


# -- probabilities of sets ----------------------------------------------------------------------------------


def _with_probabilities() -> list[dict[str, Any]]:
    return usable(results("B0.json")["records"].values())


@named
def calibrated_machines() -> str:
    """Number of machines of the arena, with effects of the catalogue or none, with probabilities of sets."""
    return str(len(_with_probabilities()))


@named
def calibrated_sets() -> str:
    """Expected calibration error of the most probable sets of these machines."""
    return f"{calibration_error([classes(row)[0] for row in _with_probabilities()]):.3f}"


# -- mutants ------------------------------------------------------------------------------------------------


def _mutants(file: str = "mutants.json") -> list[dict[str, Any]]:
    return list(results(file)["mutants"].values())


def _fresh_mutants() -> list[dict[str, Any]]:
    return _mutants("mutants_fresh.json")


@named
def mutants_drawn() -> str:
    """Number of mutants: changes of a constant or an operator in modules that make decisions."""
    return str(len(_mutants()))


@named
def mutants_first() -> str:
    """Number of mutants that the tests detected when the mutants were drawn."""
    return str(sum(r["first"] for r in _mutants()))


@named
def mutants_noticed() -> str:
    """Number of mutants that the tests detect now."""
    return str(sum(r["noticed"] for r in _mutants()))


@named
def mutants_same() -> str:
    """Number of mutants that do not change any result."""
    return str(sum("equivalent" in r for r in _mutants()))


@named
def mutants_fresh() -> str:
    """Number of mutants of a second sample that the tests detected when they were drawn, of all."""
    rows = _fresh_mutants()
    return f"{sum(r['first'] for r in rows)} of {len(rows)}"


@named
def mutants_fresh_same() -> str:
    """Number of mutants of the second sample that do not change any result."""
    return str(sum("equivalent" in r for r in _fresh_mutants()))


@named
def mutants_fresh_share() -> str:
    """Share of mutants detected when drawn, in the second sample without those that change no result [%]."""
    rows = [r for r in _fresh_mutants() if "equivalent" not in r]
    return f"{100 * sum(r['first'] for r in rows) / len(rows):.0f}"
