"""Methods that start from the user's physics: as given, fitted, without and with more effects."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.discover import discover
from rotflex_jax.discover.refit import HORIZON
from rotflex_jax.effects.kinds import Linear
from rotflex_jax.fit import fit
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import sensor_noise, stack
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Textbook:
    """The mechanism as it was given, nothing fitted: what the data sheet is worth."""

    name: str = "textbook"
    title: str = "the mechanism with its given numbers"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the recordings."""
        return Fitted(model, parameters=0, predict=predictor(model, train))


@dataclasses.dataclass(frozen=True)
class LinearPart:
    """The linear effects of the mechanism alone, fitted: what the nonlinear ones are worth."""

    name: str = "linear"
    title: str = "the linear effects of the mechanism alone, fitted"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Leaves out every effect that is not linear, then fits as the grey box."""
        mechanism = model.mechanism
        nonlinear = [e for e in mechanism.effects if not isinstance(e, Linear)]
        for e in nonlinear:
            mechanism = mechanism.without(e.name, e.at)
        left_out = ", ".join(f"{e.name} at {e.at}" for e in nonlinear)
        note = f"without {left_out}" if nonlinear else "the mechanism is linear as it is"
        return fitted_physics(Model(mechanism, model.solver), train, say, note=note)


@dataclasses.dataclass(frozen=True)
class GreyBox:
    """The mechanism, its free parameters fitted to free runs."""

    name: str = "grey_box"
    title: str = "the mechanism, fitted to free runs"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fits the error that is compared."""
        return fitted_physics(model, train, say)


@dataclasses.dataclass(frozen=True)
class GreyBoxPredictor:
    """The mechanism, fitted to the predictions of a Kalman filter.

    Missing physics bends the parameters less than in a free run, since the filter puts down a part
    of the error to unknown torques; in return the free run is not what is minimised.

    Attributes:
        share: Intensity of these torques, as a share of what a torque as large as the motor's would
            have if it were drawn anew at each sample.
    """

    name: str = "grey_box_predictor"
    title: str = "the mechanism, fitted to predictions that admit unknown torques"
    family: str = "physics"
    share: float = HORIZON

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fits innovations instead of free runs."""
        return fitted_physics(model, train, say, _unknown_torques(model, train, self.share))


@dataclasses.dataclass(frozen=True)
class Discovered:
    """The mechanism with the effects that discovery adds, fitted like the grey box.

    Effects are chosen within the training recordings, whose ends play the held-out part: what the
    methods are compared on has no say.

    Attributes:
        share: Share of each training recording that discovery learns from; the rest decides.
    """

    name: str = "discovered"
    title: str = "the mechanism with the effects that discovery adds, fitted to free runs"
    family: str = "physics"
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Discovers on parts of the training recordings, then fits to the whole of them."""
        parts = [recording.split(self.share) for recording in train]
        result = discover(model, [a for a, _ in parts], [b for _, b in parts], progress=say)
        found = ", ".join(f"{r.effect} at {r.port}" for r in result.rounds)
        note = f"added {found}" if found else f"added nothing ({result.verdict.replace('_', ' ')})"
        return fitted_physics(result.model, train, say, note=note)


def fitted_physics(
    model: Model,
    train: Sequence[Recording],
    say: Progress,
    process_noise: Mapping[str, float] | None = None,
    note: str = "",
) -> Fitted:
    """A fit; one that diverged is raised, one that only stopped early is noted."""
    found = fit(model, train, process_noise=process_noise, progress=say)
    if found.status.startswith("diverged"):
        raise RuntimeError(found.status)
    stopped = "" if found.status == "converged" else f"fit {found.status}"
    said = "; ".join(filter(None, (note, stopped)))
    return Fitted(found.model, len(found.free_names), said, predictor(found.model, train))


def _unknown_torques(model: Model, train: Sequence[Recording], share: float) -> dict[str, float]:
    """Intensity of white torques along every coordinate, as a share of what the motor can do."""
    torque = torque_scale(model.mechanism, stack(train, model))
    return everywhere(model.mechanism, share * torque**2 * train[0].Ts)


def predictor(model: Model, train: Sequence[Recording]) -> Callable[[Recording], np.ndarray]:
    """One step ahead by the steady Kalman filter that admits unknown torques."""
    torques, noise = _unknown_torques(model, train, HORIZON), sensor_noise(train, model)
    return lambda recording: model.predict(recording, torques, noise)
