"""Progress of a search: errors reached, time left, and the state from which a stopped search continues."""

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
from rotflex_jax.text.numbers import as_read, json_number


class Milestone(str):
    """A line of progress with the validation error of a model that the search has reached.

    Attributes:
        label: Name of the model.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> factor from its own unit to the unit in which people read it.
        kept: What a search needs to continue from this model, in plain JSON types.
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
    """A line of progress with the errors of a model.

    Args:
        label: Name of the model.
        channels: Outputs of the model, in order.
        units: Channel -> its own unit.
        errors: Validation error of short free runs, by channel. While a search runs, their first states are
            fitted. The errors in its result are those of runs from states estimated from the first samples.
        floor: Noise of the sensor, by channel.

    >>> line = milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.array([0.01]), np.array([5e-4]))
    >>> line
    '+ Coulomb friction at hub: error of short free runs, first states fitted: theta 0.573 deg'
    """
    read = {c: as_read(1.0, units[c]) for c in channels}
    by_name = dict(zip(channels, (float(e) for e in errors), strict=True))
    label = with_titles(label)
    listed = ", ".join(f"{c} {read[c][0] * e:.3g} {read[c][1]}" for c, e in by_name.items())
    line = Milestone(f"{label}: error of short free runs, first states fitted: {listed}")
    line.label, line.errors, line.kept = label, by_name, {}
    line.floor = dict(zip(channels, (float(f) for f in floor), strict=True))
    line.units = {c: unit for c, (_, unit) in read.items()}
    line.factors = {c: factor for c, (factor, _) in read.items()}
    return line


StepKind = Literal["baseline", "score", "refit", "pairs", "needed", "finish"]
"""Kinds of steps of a search; a step takes about as long as the last one of its kind."""

# Steps that follow a step if its round is the last one.
_AFTER: dict[StepKind, tuple[StepKind, ...]] = {
    "baseline": ("score", "refit", "needed", "finish"),
    "score": ("refit", "needed", "finish"),
    "refit": ("needed", "finish"),
    "pairs": ("needed", "finish"),
    "needed": ("finish",),
    "finish": (),
}
# If no step of a kind was measured yet, it is assumed to take as long as a step of this other kind.
_LIKE: dict[StepKind, StepKind] = {"pairs": "refit", "needed": "refit", "finish": "refit"}


class BeginningStep(str):
    """A line of progress that announces a step of a search.

    Attributes:
        kind: Kind of the step.
    """

    kind: StepKind


def beginning(kind: StepKind, line: str) -> BeginningStep:
    """A line of progress that announces a step of a kind."""
    step = BeginningStep(line)
    step.kind = kind
    return step


class TimeLeft:
    """Estimate of the time that a search still takes, from the duration of its own steps so far.

    It follows the lines of progress. Before a step of a kind was measured, nothing is known of this kind: the
    first steps compile programs, and the time for that depends on the computer. The number of rounds is not
    known beforehand, so the estimate assumes that the present round is the last.

    Args:
        clock: Function that returns a time [s] from any origin.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._began = self._step_began = clock()
        self._kind: StepKind | None = None
        self._measured: dict[StepKind, float] = {}

    def follow(self, line: str) -> None:
        """Take note of a line of progress."""
        if not isinstance(line, BeginningStep):
            return
        now = self._clock()
        if self._kind is not None:
            self._measured[self._kind] = now - self._step_began
        self._kind, self._step_began = line.kind, now

    def seconds(self) -> float | None:
        """Time left [s] if this round is the last; None where it cannot be estimated.

        It cannot be estimated if the kind of the present step or of a following step was not measured yet, or
        if the present step takes longer than the last one of its kind.
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
        """Time so far and, if it can be estimated, time left in round numbers."""
        so_far, left = f"{self._clock() - self._began:.0f} s so far", self.seconds()
        if left is None:
            usual = self._usual(self._kind) if self._kind else None
            return so_far + (", longer than expected" if usual is not None and self._overdue(usual) else "")
        last = "" if self._kind in ("needed", "finish") else " if this round is the last"
        return f"{so_far}, {_roughly(left)} left{last}"


# Values to which an estimate is rounded [s].
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


# Arrays of a hypothesis that are stored; whitener, likelihood and blocks follow from a run.
_NUMBERS = ("z", "local_z", "x0", "K")
_INDICES = ("free", "local", "sizes")


def digest_of_search(
    model: Model, s: SuperModel, seconds: float, train: Sequence[Recording], validation: Sequence[Recording]
) -> str:
    """Digest of everything that the models of a search depend on, except the code of the user's own effects.

    Args:
        model: The user's model.
        s: The super-model.
        seconds: Length of short free runs [s].
        train: Training recordings.
        validation: Validation recordings; empty where training recordings validate each other.
    """
    m = model.mechanism
    physics = (m.coordinates, m.ports, m.effects, m.outputs, sorted(m.trusted), m.units)
    text = repr((__version__, physics, model.solver, model.gates, s.mechanism.parameter_names, seconds))
    # The same recordings, divided differently into training and validation, are another search.
    count = str(len(train)).encode()
    return digest_of(text.encode(), count, *(part for r in (*train, *validation) for part in content(r)))


def kept(h: Hypothesis) -> dict[str, Any]:
    """A hypothesis in plain JSON types, with all numbers in full precision."""
    numbers = {name: getattr(h, name).tolist() for name in _NUMBERS}
    marks = {"locations": [list(p) for p in h.locations]}
    marks |= {name: list(getattr(h, name)) for name in _INDICES}
    return {**marks, **numbers, "process_noise": dict(h.process_noise)}


def restored(problem: LikelihoodProblem, written: Mapping[str, Any]) -> Hypothesis:
    """A hypothesis as written by `kept`, with the whitener and the likelihood from a new run.

    Raises:
        ValueError: If the hypothesis does not fit the problem.
    """
    locations = tuple(EffectLocation(*map(str, p)) for p in written["locations"])
    numbers = {name: np.array(written[name], float) for name in _NUMBERS}
    indices = {name: tuple(map(int, written[name])) for name in _INDICES}
    h = Hypothesis(
        locations=locations,
        free=indices["free"],
        local=indices["local"],
        process_noise={str(p): float(q) for p, q in written["process_noise"].items()},
        whitener=Whitener.of_noise(problem.noise),
        sizes=indices["sizes"],
        **numbers,
    )
    _check(problem, h)
    return problem.with_likelihood(h)


def _check(problem: LikelihoodProblem, h: Hypothesis) -> None:
    """Raise ValueError if a hypothesis does not fit the problem."""
    s, R = problem.supermodel, len(problem.seen)
    on = [i for p in h.locations for i in s.parameter_indices(p)]
    if not set(h.locations) <= {*s.candidates, *s.calibrations} or sorted((*h.free, *h.local)) != sorted(
        (*s.baseline_free, *on)
    ):
        raise ValueError(h)
    if not set(h.sizes) <= set(h.local):
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
        score: Penalised score for which it was refitted [nat]; NaN if it was refitted without one.
        rivals: Effects that were not distinguished from it.
        gains: Its gains in predictions and in free runs.
    """

    location: EffectLocation
    score: float
    rivals: tuple[EffectLocation, ...]
    gains: tuple[HorizonGain, HorizonGain | None]

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": list(self.location),
            "score": json_number(self.score),
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
        score = math.nan if written["score"] is None else float(written["score"])
        return cls(location, score, rivals, (prediction, free_run))


class KeptStage(NamedTuple):
    """A model that a search has reached, as it is stored.

    Attributes:
        prediction: The model fitted to predictions, as `kept` writes it.
        free_run: The model fitted to free runs, as `kept` writes it.
        added: The effects that were added last; none for the baseline.
    """

    prediction: dict[str, Any]
    free_run: dict[str, Any]
    added: tuple[AddedEffect, ...] = ()

    def to_dict(self, digest: str) -> dict[str, Any]:
        """Plain JSON types.

        Args:
            digest: Digest of the search.
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
        digest: Digest of the search that continues.

    Raises:
        InputError: If there is no such file, or if another search has left it.
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
