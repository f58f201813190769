"""Scores of methods that search for missing effects: effects named, false alarms, answers withheld."""

import contextlib
import math
import secrets
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.arena.marking import alike, exact
from rotflex_jax.arena.method import (
    NOTHING_MISSING,
    UNEXPLAINED,
    Answer,
    Apart,
    ArenaFailure,
    Here,
    Method,
    check_name,
)
from rotflex_jax.arena.problems import MEASURED, NOTHING, ONE, OUT, TWO, WORLD, Problem, drawn, measured
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.checks import number, progress as checked_progress, shown, whole
from rotflex_jax.errors import InputError

BINS, LEAST = 10, 0.01
"""Number of bins of equal width of a calibration; least probability that is counted."""

FOUND, FAILED = "found", "failed"

# A run has diverged if its error exceeds the noise by this factor.
_DIVERGED = 1e6


class Event(NamedTuple):
    """A probability, and whether the statement with this probability is true."""

    probability: float
    true: bool


class Bin(NamedTuple):
    """Events with similar probabilities.

    Attributes:
        claimed: Mean probability of the events.
        held: Share of the events that are true.
        cases: Number of events.
    """

    claimed: float
    held: float
    cases: int


def reliability(events: Iterable[Event]) -> list[Bin]:
    """Events in `BINS` bins of equal width, without empty bins."""
    listed = [e for e in events if e.probability >= LEAST]
    place = [min(int(BINS * e.probability), BINS - 1) for e in listed]
    groups = [[e for e, k in zip(listed, place, strict=True) if k == i] for i in range(BINS)]
    return [
        Bin(float(np.mean([e.probability for e in g])), float(np.mean([e.true for e in g])), len(g))
        for g in groups
        if g
    ]


def calibration_error(events: Iterable[Event]) -> float:
    """Expected calibration error: mean of |claimed - held| over bins, weighted by cases.

    >>> round(calibration_error([Event(0.8, held) for held in (True, True, False, True)]), 6)
    0.05
    """
    bins = reliability(events)
    cases = sum(b.cases for b in bins)
    return sum(b.cases * abs(b.claimed - b.held) for b in bins) / cases if cases else math.nan


class Share(NamedTuple):
    """A count out of a total."""

    count: int
    of: int

    def __str__(self) -> str:
        return f"{self.count}/{self.of}" if self.of else "-"


def name_of(place: Place) -> str:
    """`coulomb@hub` for ("coulomb", "hub")."""
    return "@".join(place)


@dataclass(frozen=True)
class Marks:
    """Marks of one answer, compared with the truth.

    Attributes:
        record: Number of the record, from 1.
        kind: Kind of the record.
        hidden: Effects that should be named.
        answered: Effects that were named.
        verdict: `found`, `nothing missing`, `unexplained` or `failed`.
        reason: Why the method failed, or why its model did not run.
        hits: Number of hidden effects that were named, by their own name or by that of an effect that no
            recording distinguishes from them.
        wrong: Names that are neither true nor belong to further errors of a wrong world.
        right: Whether the whole answer is right.
        events: Probabilities in the answer, and whether the effects were present.
        seconds: Time that the answer took [s].
        error: Root mean square error of free runs over test recordings, divided by the noise of the sensors
            (geometric mean over channels); for measured machines in the unit of the channel; None without a
            model.
        truth: The whole truth, in JSON types.
    """

    record: int
    kind: str
    hidden: tuple[Place, ...]
    answered: tuple[Place, ...]
    verdict: str
    reason: str
    hits: int
    wrong: tuple[Place, ...]
    right: bool
    events: tuple[Event, ...]
    seconds: float
    error: float | None
    truth: dict[str, Any]

    @classmethod
    def of(cls, row: dict[str, Any]) -> "Marks":
        """The marks from the result of `to_dict`."""
        place = lambda name: tuple(name.split("@"))  # noqa: E731
        own = {n: tuple(map(place, row[n])) for n in ("hidden", "answered", "wrong")}
        events = tuple(Event(p, true) for p, true in row["probabilities"])
        rest = {k: v for k, v in row.items() if k != "probabilities"}
        return cls(**{**rest, **own, "events": events})

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "record": self.record,
            "kind": self.kind,
            "hidden": [name_of(p) for p in self.hidden],
            "answered": [name_of(p) for p in self.answered],
            "verdict": self.verdict,
            "reason": self.reason,
            "hits": self.hits,
            "wrong": [name_of(p) for p in self.wrong],
            "right": self.right,
            "probabilities": [[e.probability, e.true] for e in self.events],
            "seconds": self.seconds,
            "error": self.error,
            "truth": self.truth,
        }


def marked(
    problem: Problem, answer: Answer, record: int, error: float | None = None, note: str = ""
) -> Marks:
    """The marks of an answer.

    For a record with one or two hidden effects, the answer is right if it names them and nothing else; an
    effect that no recording distinguishes from a hidden one counts as its name. For a record with nothing
    hidden, the right answer is that nothing is missing. For an effect outside the catalogue, the right answer
    is that something stays unexplained. In a wrong world it is right to name the hidden effect; names of
    further errors of that world count neither way.

    Args:
        problem: The record.
        answer: The answer.
        record: Number of the record.
        error: Error of the model in the answer, as in `Marks`.
        note: Why its model did not run.
    """
    said, hidden = set(answer.effects), problem.hidden
    there = {p for place in hidden for p in alike(place)} if problem.kind != OUT else set()
    forgiven = there | set(problem.forgiven)
    hits = 0 if problem.kind == OUT else sum(bool(alike(p) & said) for p in hidden)
    wrong = tuple(p for p in answer.effects if p not in forgiven) if problem.kind != MEASURED else ()
    verdict = UNEXPLAINED if answer.unexplained else FOUND if said else NOTHING_MISSING
    if problem.kind in (ONE, TWO):
        right = verdict == FOUND and exact(said, hidden)
    elif problem.kind == NOTHING:
        right = verdict == NOTHING_MISSING
    elif problem.kind == OUT:
        right = verdict == UNEXPLAINED
    elif problem.kind == WORLD:
        right = hits == len(hidden) and not wrong
    else:
        right = error is not None
    events = tuple(Event(p, place in forgiven) for place, p in answer.probabilities.items())
    return Marks(
        record,
        problem.kind,
        hidden,
        answer.effects,
        verdict,
        note,
        hits,
        wrong,
        right,
        () if problem.kind == MEASURED else events,
        answer.seconds,
        error,
        problem.truth,
    )


def failed(problem: Problem, reason: str, record: int, seconds: float) -> Marks:
    """The marks of a record without an answer."""
    return Marks(
        record,
        problem.kind,
        problem.hidden,
        (),
        FAILED,
        reason,
        0,
        (),
        False,
        (),
        seconds,
        None,
        problem.truth,
    )


@dataclass(frozen=True)
class MethodScore:
    """Score of a method on a set of records.

    Attributes:
        method: Name of the method.
        rows: Marks of every record.
    """

    method: str
    rows: tuple[Marks, ...]

    def _share(self, rows: Iterable[Marks], good: Callable[[Marks], bool]) -> Share:
        listed = list(rows)
        return Share(sum(map(good, listed)), len(listed))

    def of(self, *kinds: str) -> list[Marks]:
        """Rows of some kinds."""
        return [r for r in self.rows if r.kind in kinds]

    @property
    def right(self) -> Share:
        """Simulated records whose whole answer is right."""
        return self._share(self.of(ONE, TWO, NOTHING, OUT, WORLD), lambda r: r.right)

    @property
    def named(self) -> Share:
        """Hidden effects of the catalogue that were named."""
        rows = self.of(ONE, TWO)
        return Share(sum(r.hits for r in rows), sum(len(r.hidden) for r in rows))

    @property
    def wrong(self) -> int:
        """Number of wrong names, over all simulated records except the wrong worlds."""
        return sum(len(r.wrong) for r in self.of(ONE, TWO, NOTHING, OUT))

    @property
    def alarms(self) -> Share:
        """Records with nothing hidden for which the answer was that something is missing."""
        return self._share(self.of(NOTHING), lambda r: r.verdict in (FOUND, UNEXPLAINED))

    @property
    def withheld(self) -> Share:
        """Records with an effect outside the catalogue for which the answer was `unexplained`."""
        return self._share(self.of(OUT), lambda r: r.verdict == UNEXPLAINED)

    @property
    def worlds(self) -> Share:
        """Wrong worlds whose hidden effect was named."""
        rows = [r for r in self.of(WORLD) if r.hidden]
        return self._share(rows, lambda r: r.hits == len(r.hidden))

    @property
    def worlds_wrong(self) -> int:
        """Number of wrong names in wrong worlds."""
        return sum(len(r.wrong) for r in self.of(WORLD))

    @property
    def events(self) -> list[Event]:
        """All probabilities in the answers."""
        return [e for r in self.rows for e in r.events]

    @property
    def calibration(self) -> float | None:
        """Expected calibration error of the probabilities; None if all are below `LEAST`."""
        error = calibration_error(self.events)
        return None if math.isnan(error) else error

    @property
    def brier(self) -> float | None:
        """Mean square of probability less truth (0 or 1); None without probabilities."""
        return statistics.fmean((e.probability - e.true) ** 2 for e in self.events) if self.events else None

    @property
    def seconds(self) -> float | None:
        """Median time of an answer [s]."""
        answered = [r.seconds for r in self.rows if r.verdict != FAILED]
        return statistics.median(answered) if answered else None

    @property
    def error(self) -> float | None:
        """Median error of free runs over simulated test recordings, in units of the sensor noise."""
        errors = [r.error for r in self.of(ONE, TWO, NOTHING, OUT, WORLD) if r.error is not None]
        return statistics.median(errors) if errors else None

    @property
    def failures(self) -> int:
        """Number of records without an answer."""
        return sum(r.verdict == FAILED for r in self.rows)

    def summary(self) -> dict[str, Any]:
        """All scores as plain JSON."""
        shares = {n: list(getattr(self, n)) for n in ("right", "named", "alarms", "withheld", "worlds")}
        names = ("wrong", "worlds_wrong", "calibration", "brier", "seconds", "error", "failures")
        return {**shares, **{n: getattr(self, n) for n in names}, "events": len(self.events)}


COLUMNS = {
    "right": "right",
    "named": "effects named",
    "wrong": "wrong names",
    "alarms": "false alarms",
    "withheld": "withheld outside",
    "worlds": "wrong worlds",
    "calibration": "calibration error",
    "error": "error / noise",
    "seconds": "s",
    "failures": "failed",
}
"""Columns of the table: attribute of `MethodScore` -> heading."""


def cells(score: MethodScore) -> list[str]:
    """A row of the table as text."""
    found = [getattr(score, name) for name in COLUMNS]
    return [
        score.method,
        *("-" if x is None else f"{x:.3g}" if isinstance(x, float) else str(x) for x in found),
    ]


@dataclass(frozen=True)
class Scores:
    """Scores of several methods on the same records.

    Attributes:
        seed: Seed from which the records were drawn.
        seconds: Length of a record [s].
        limit: Time limit for an answer [s].
        methods: Score of each method.
    """

    seed: int
    seconds: float
    limit: float
    methods: tuple[MethodScore, ...]

    def __str__(self) -> str:
        return self.to_markdown()

    def to_markdown(self) -> str:
        """The table in Markdown."""
        head = ["method", *COLUMNS.values()]
        lines = [head, ["---", *["---:"] * len(COLUMNS)], *map(cells, self.methods)]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "schema": 1,
            "seed": self.seed,
            "seconds": self.seconds,
            "limit": self.limit,
            "records": len(self.methods[0].rows) if self.methods else 0,
            "methods": {
                s.method: {"summary": s.summary(), "rows": [r.to_dict() for r in s.rows]}
                for s in self.methods
            },
        }

    def report(self, path: str | Path) -> Path:
        """Write a self-contained page; return its path."""
        from rotflex_jax.arena.page import write

        return write(self, path)


def score(
    methods: "Method | str | Sequence[Method | str]",
    records: int = 12,
    seed: int | None = None,
    *,
    seconds: float = 20.0,
    limit: float = 600.0,
    with_measured: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Scores:
    """Score methods that search for missing effects on records whose truth they cannot see.

    A method is a function `method(train, validation, model)` of lists of recordings and the textbook model.
    It returns `"nothing missing"`, `"unexplained"`, a list of effects such as `["coulomb@hub"]`, or a mapping
    with `effects`, `unexplained`, `probabilities` (effect -> number) and `model`, which simulates recordings.
    If a method raises an error, gives an invalid answer or takes too long, it has failed on that record.

    Args:
        methods: A function, which runs in this process; `"FILE.py:NAME"` or the name of an entrant, which
            runs in a separate process; or several of these.
        records: Number of simulated records; half have one hidden effect, see `problems.drawn`.
        seed: Seed from which the records are drawn; a random seed if None. No method receives it.
        seconds: Length of a record, training and validation together [s].
        limit: Time limit for an answer [s]. A process is stopped at this time; a function in this process
            fails when it returns later.
        with_measured: Whether to score also free runs on public recordings of measured machines, if these are
            available.
        progress: Called with a line of text now and then.

    Returns:
        The scores, with all answers and the truth; `report` writes them as a page.

    Raises:
        InputError: An argument is not valid, or a method cannot be loaded.
    """
    listed = [methods] if isinstance(methods, str) or callable(methods) else methods
    if not isinstance(listed, Sequence) or not listed:
        raise InputError(
            f"Argument `methods` must be a function, a name or a list of these, but is {shown(methods)}; "
            "give for instance 'search'."
        )
    for method in listed:
        if not isinstance(method, str) and not callable(method):
            raise InputError(
                f"Argument `methods` must have functions or names, but has {shown(method)}; give "
                "for instance 'search'."
            )
        if isinstance(method, str):
            check_name(method)
    names = [m if isinstance(m, str) else getattr(m, "__name__", type(m).__name__) for m in listed]
    twice = [n for k, n in enumerate(names) if n in names[:k]]
    if twice:
        raise InputError(f"The method {shown(twice[0])} was given twice; give each once.")
    records = whole(records, "records", 1)
    seed = secrets.randbits(31) if seed is None else whole(seed, "seed", 0, math.inf)
    seconds = number(seconds, "seconds", least=4.0, unit="s", example="20.0")
    limit = number(limit, "limit", above=0, unit="s", example="600.0")
    say = checked_progress(progress)
    with contextlib.ExitStack() as stack:
        running = [stack.enter_context(Apart(m) if isinstance(m, str) else Here(m)) for m in listed]
        for method in running:
            if isinstance(method, Apart):
                method.begin()
        problems = drawn(records, seed, seconds, say)
        problems += measured(say) if with_measured else []
        found = []
        for name, method in zip(names, running, strict=True):
            rows = []
            for k, problem in enumerate(problems, 1):
                say(f"{name}: record {k} of {len(problems)}")
                rows.append(answered(method, problem, k, limit))
            found.append(MethodScore(name, tuple(rows)))
            method.__exit__()
        return Scores(seed, seconds, limit, tuple(found))


def answered(method: Here | Apart, problem: Problem, record: int, limit: float) -> Marks:
    """The marks of a method on one record, including failures.

    Args:
        method: Method in this process or in a separate one.
        problem: The record.
        record: Number of the record.
        limit: Time limit for an answer [s].
    """
    began = time.perf_counter()
    try:
        answer = method.answer(problem.given(), limit)
    except ArenaFailure as reason:
        return failed(problem, str(reason), record, time.perf_counter() - began)
    if not answer.has_model:
        return marked(problem, answer, record)
    try:
        runs = method.simulate(problem.asked())
    except ArenaFailure as reason:
        return marked(problem, answer, record, None, f"Its model does not run: {reason}")
    error = run_error(problem, runs)
    return marked(problem, answer, record, error, "" if error is not None else "Its model diverges.")


def run_error(problem: Problem, runs: Sequence[Float[np.ndarray, "_ C"]]) -> float | None:
    r"""Error of free runs, geometric mean over the channels; None if they diverge.

    .. math::
        e = \prod_c (\mathrm{rms}_c / s_c)^{1/C}

    with the noise :math:`s_c` of a channel; for a measured machine :math:`s_c = 1`.

    Args:
        problem: The record.
        runs: One array ``(N, C)`` for each of `problem.runs()`.
    """
    recordings = problem.runs()
    left = [(r.y - run)[r.n_init :] for r, run in zip(recordings, runs, strict=True)]
    rms = np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0))
    if problem.kind != MEASURED:
        channels = recordings[0].channels
        rms = rms / np.array([problem.noise.get(c, 1.0) for c in channels])
    if not np.all(np.isfinite(rms)) or np.any(rms > _DIVERGED):
        return None
    return float(np.exp(np.mean(np.log(np.maximum(rms, 1e-300)))))
