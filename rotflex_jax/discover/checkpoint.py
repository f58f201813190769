"""What a search tells while it runs: errors reached, and the state from which a stopped search goes on."""

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax import __version__
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.effects.labels import with_titles
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import content, digest_of
from rotflex_jax.text.files import path_of
from rotflex_jax.text.numbers import as_read


class Milestone(str):
    """A line with the validation error of a model that was reached.

    Attributes:
        label: What the model is.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> what its own unit is in that one.
        kept: What a search needs to go on from this model, in plain JSON types.
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
    long that takes depends on the machine. The number of rounds is not known beforehand, so the estimate is
    for the case that this round is the last.

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

        That is so where a step still to come is of a kind that was not measured yet, and where the present
        one takes longer than the last one of its kind.
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


# What a hypothesis is made of besides the locations, all else follows from a run with these.
_NUMBERS = ("z", "local_z", "x0", "K")


def digest_of_search(
    model: Model, s: SuperModel, seconds: float, train: Sequence[Recording], validation: Sequence[Recording]
) -> str:
    """Digest of all that the models of a search depend on; the code of one's own effects is not among it.

    Args:
        model: The user's model.
        s: It with every candidate.
        seconds: Length of short free runs [s].
        train: Recordings that are fitted.
        validation: Recordings that decide; none where those for training do.
    """
    m = model.mechanism
    physics = (m.coordinates, m.ports, m.effects, m.outputs, sorted(m.trusted), m.units)
    text = repr((__version__, physics, model.solver, model.gates, s.mechanism.parameter_names, seconds))
    # The same recordings, shared out otherwise, are another search.
    count = str(len(train)).encode()
    return digest_of(text.encode(), count, *(part for r in (*train, *validation) for part in content(r)))


def kept(h: Hypothesis) -> dict[str, Any]:
    """A hypothesis in plain JSON types, every number as it is."""
    numbers = {name: getattr(h, name).tolist() for name in _NUMBERS}
    marks = {"locations": [list(p) for p in h.locations], "free": list(h.free), "local": list(h.local)}
    return {**marks, **numbers, "process_noise": dict(h.process_noise)}


def restored(problem: LikelihoodProblem, written: Mapping[str, Any]) -> Hypothesis:
    """The hypothesis that was written, with the whitener and the likelihood that its innovations give."""
    locations = tuple(EffectLocation(*map(str, p)) for p in written["locations"])
    numbers = {name: np.array(written[name], float) for name in _NUMBERS}
    h = Hypothesis(
        locations=locations,
        free=tuple(map(int, written["free"])),
        local=tuple(map(int, written["local"])),
        process_noise={str(p): float(q) for p, q in written["process_noise"].items()},
        whitener=Whitener.of_noise(problem.noise),
        **numbers,
    )
    _check(problem, h)
    return problem.with_likelihood(h)


def _check(problem: LikelihoodProblem, h: Hypothesis) -> None:
    """Raises ValueError where a hypothesis is none of this problem."""
    s, R = problem.supermodel, len(problem.seen)
    on = [i for p in h.locations for i in s.parameter_indices(p)]
    if not set(h.locations) <= {*s.candidates, *s.calibrations} or sorted((*h.free, *h.local)) != sorted(
        (*s.baseline_free, *on)
    ):
        raise ValueError(h)
    intensities = h.process_noise.values()
    if not set(h.process_noise) <= set(problem.ports) or not all(0 <= q < math.inf for q in intensities):
        raise ValueError(h)
    states = len(s.active(s.gates(h.locations)).states)
    expected = {
        "z": (len(s.mechanism.parameter_names),),
        "local_z": (R, len(h.local)),
        "x0": (R, problem.windows.number, states),
        "K": (R, Layout.of(s.mechanism.structure).size, len(problem.noise)),
    }
    numbers = {name: getattr(h, name) for name in _NUMBERS}
    if any(x.shape != expected[name] or not np.all(np.isfinite(x)) for name, x in numbers.items()):
        raise ValueError(h)


class AddedEffect(NamedTuple):
    """An effect that a search has added.

    Attributes:
        location: Effect and port.
        score: The penalised score that put it forward [nat].
        rivals: What was not distinguished from it.
        gains: What it gained at both horizons.
    """

    location: EffectLocation
    score: float
    rivals: tuple[EffectLocation, ...]
    gains: tuple[HorizonGain, HorizonGain | None]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": list(self.location),
            "score": self.score,
            "rivals": [list(p) for p in self.rivals],
            "gains": [None if g is None else list(g) for g in self.gains],
        }

    @classmethod
    def from_dict(cls, written: Mapping[str, Any]) -> "AddedEffect":
        """The inverse of `to_dict`."""
        prediction, free_run = (None if g is None else HorizonGain(*map(float, g)) for g in written["gains"])
        if prediction is None:
            raise ValueError(written)
        rivals = tuple(EffectLocation(*map(str, p)) for p in written["rivals"])
        location = EffectLocation(*map(str, written["effect"]))
        return cls(location, float(written["score"]), rivals, (prediction, free_run))


class KeptStage(NamedTuple):
    """A model that a search has reached.

    Attributes:
        prediction: Fitted to predictions, as `kept` writes it.
        free_run: Fitted to free runs.
        added: The effects that were added last; none for the baseline.
    """

    prediction: dict[str, Any]
    free_run: dict[str, Any]
    added: tuple[AddedEffect, ...] = ()

    def to_dict(self, digest: str) -> dict[str, Any]:
        """Plain JSON types.

        Args:
            digest: Of the search.
        """
        return {
            "digest": digest,
            "added": [a.to_dict() for a in self.added],
            "prediction": self.prediction,
            "free_run": self.free_run,
        }

    @classmethod
    def from_dict(cls, written: Mapping[str, Any]) -> "KeptStage":
        """The inverse of `to_dict`."""
        added = tuple(AddedEffect.from_dict(a) for a in written["added"])
        return cls(written["prediction"], written["free_run"], added)


def read_stages(path: str | Path, digest: str) -> Sequence[KeptStage]:
    """The models in a file that a stopped search has left, the baseline first.

    Args:
        path: `NAME.stopped.json`.
        digest: Of the search that goes on.

    Raises:
        InputError: No such file, or that of another search.
    """
    path = path_of(path)
    try:
        written = json.loads(path.read_text(encoding="utf-8"))
        stages = [entry["search"] for entry in written["stages"]]
        same = bool(stages) and all(stage["digest"] == digest for stage in stages)
        found = [KeptStage.from_dict(stage) for stage in stages]
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror or error}); give the file NAME.stopped.json that a "
            "stopped search has left."
        ) from None
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError, RecursionError):
        raise not_kept(path) from None
    if not same:
        raise InputError(
            f"{path} was left by a search of other recordings, another model or another version, and this "
            "search cannot go on from there; give what was given then, or search from the start."
        )
    if found[0].added or not all(stage.added for stage in found[1:]):
        raise not_kept(path)
    return found


def not_kept(path: str | Path) -> InputError:
    """The error for a file that holds no models of a search."""
    return InputError(
        f"{path} holds no models that a search can go on from; give the file NAME.stopped.json that a "
        "stopped search has left."
    )
