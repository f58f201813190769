"""Lines of progress of a search: with the validation error of a model reached, or a step that begins."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.labels import with_titles
from rotflex_jax.text.numbers import as_read


class Milestone(str):
    """A line with the validation error of a model that was reached.

    Attributes:
        label: What the model is.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> what its own unit is in that one.
        kept: What a search needs to go on from this model, in plain JSON types; see `checkpoint`.
    """

    kept: dict[str, Any]
    label: str
    errors: dict[str, float]
    floor: dict[str, float]
    units: dict[str, str]
    factors: dict[str, float]


def milestone(
    label: str,
    channels: Sequence[str],
    units: Mapping[str, str],
    errors: Float[np.ndarray, " C"],
    floor: Float[np.ndarray, " C"],
) -> Milestone:
    """A line with the errors that it names.

    Args:
        label: What the model is.
        channels: Outputs of the model, in order.
        units: Channel -> its own unit.
        errors: Validation error of short free runs, by channel. While a search runs, their first states
            are fitted; its result has the errors from states estimated from the first samples alone.
        floor: Noise of the sensor, by channel.

    >>> line = milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.array([0.01]), np.array([5e-4]))
    >>> line, line.errors
    ('+ Coulomb friction at hub: short runs from fitted first states leave theta 0.573 deg', {'theta': 0.01})
    """
    read = {c: as_read(1.0, units[c]) for c in channels}
    by_name = dict(zip(channels, (float(e) for e in errors), strict=True))
    label = with_titles(label)
    listed = ", ".join(f"{c} {read[c][0] * e:.3g} {read[c][1]}" for c, e in by_name.items())
    line = Milestone(f"{label}: short runs from fitted first states leave {listed}")
    line.label, line.errors, line.kept = label, by_name, {}
    line.floor = dict(zip(channels, (float(f) for f in floor), strict=True))
    line.units = {c: unit for c, (_, unit) in read.items()}
    line.factors = {c: factor for c, (factor, _) in read.items()}
    return line


StepKind = Literal["baseline", "score", "refit", "pairs", "needed", "finish"]
"""Steps of a search, each of which takes about as long as the last one of its kind."""

# What follows a step if the round in which it stands is the last.
_AFTER: dict[StepKind, tuple[StepKind, ...]] = {
    "baseline": ("score", "refit", "needed", "finish"),
    "score": ("refit", "needed", "finish"),
    "refit": ("needed", "finish"),
    "pairs": ("needed", "finish"),
    "needed": ("finish",),
    "finish": (),
}
# Steps that consist of refits take about as long as these where none of their kind was measured.
_LIKE: dict[StepKind, StepKind] = {"pairs": "refit", "needed": "refit", "finish": "refit"}


class BeginningStep(str):
    """A line that says that a step of a search begins.

    Attributes:
        kind: Which one.
    """

    kind: StepKind


def beginning(kind: StepKind, line: str) -> BeginningStep:
    """A line with the kind of step that it announces."""
    step = BeginningStep(line)
    step.kind = kind
    return step


class TimeLeft:
    """How long a search goes on, from how long its own steps took; follows its lines of progress.

    Nothing is known of a step before one of its kind was measured: the first ones compile programs, and how
    long that takes depends on the machine. How many rounds there will be nobody knows, so that the estimate
    is for the case that the round at work is the last one.

    Args:
        clock: Seconds, from any beginning.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._began = self._step_began = clock()
        self._kind: StepKind | None = None
        self._measured: dict[StepKind, float] = {}

    def follow(self, line: str) -> None:
        """Takes note of a line of progress."""
        if not isinstance(line, BeginningStep):
            return
        now = self._clock()
        if self._kind is not None:
            self._measured[self._kind] = now - self._step_began
        self._kind, self._step_began = line.kind, now

    def seconds(self) -> float | None:
        """Time left [s] if this round is the last; None where nothing measured tells it.

        That is so where no step of a kind to come was measured yet, and where the one at work takes longer
        than the last one of its kind.
        """
        if self._kind is None:
            return None
        usual = self._usual(self._kind)
        following = [self._usual(kind) for kind in _AFTER[self._kind]]
        if usual is None or None in following or self._overdue(usual):
            return None
        return usual - (self._clock() - self._step_began) + sum(x for x in following if x is not None)

    def _overdue(self, usual: float) -> bool:
        return self._clock() - self._step_began > usual

    def _usual(self, kind: StepKind) -> float | None:
        return self._measured.get(kind, self._measured.get(_LIKE.get(kind, kind)))

    def words(self) -> str:
        """Time so far, and what is left in round numbers where it can be told."""
        so_far, left = f"{self._clock() - self._began:.0f} s so far", self.seconds()
        if left is None:
            usual = self._usual(self._kind) if self._kind else None
            return so_far + (", longer than expected" if usual is not None and self._overdue(usual) else "")
        last = "" if self._kind in ("needed", "finish") else " if this round is the last"
        return f"{so_far}, {_roughly(left)} left{last}"


# What an estimate is rounded to [s]: no more digits than it is worth.
_ROUND = (5, 10, 20, 30, 45, 60, 90, 120, 180, 300, 600, 1200, 1800, 3600)


def _roughly(seconds: float) -> str:
    """A time in words, to about a third of itself.

    >>> _roughly(2.0), _roughly(52.0), _roughly(200.0), _roughly(10000.0)
    ('less than 5 s', 'about 45 s', 'about 3 min', 'about 3 h')
    """
    if seconds < _ROUND[0]:
        return f"less than {_ROUND[0]} s"
    if seconds > _ROUND[-1]:
        return f"about {max(round(seconds / 3600), 1)} h"
    nearest = min(_ROUND, key=lambda known: abs(known / seconds - 1))
    return f"about {nearest} s" if nearest <= 90 else f"about {nearest // 60} min"
