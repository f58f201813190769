"""The models that a search has reached, as plain JSON; a search that was stopped goes on from them."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotflex_jax import __version__
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.whitening import Whitener
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.digest import content, digest_of
from rotflex_jax.text.files import path_of

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
    return problem.evaluated(h, problem.innovations([h])[0])


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
