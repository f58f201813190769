"""Methods that start from the user's physics: as given, fitted, without and with more effects."""

import dataclasses
from collections.abc import Mapping, Sequence

from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.discover import discover
from rotflex_jax.discover.refit import HORIZON
from rotflex_jax.effects.kinds import Linear
from rotflex_jax.fit import fit
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import stack
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Textbook:
    """The mechanism as it was given, nothing fitted: what the data sheet is worth."""

    name: str = "textbook"
    title: str = "the mechanism with its given numbers"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the recordings."""
        return Fitted(model, parameters=0)


@dataclasses.dataclass(frozen=True)
class LinearPart:
    """The linear effects of the mechanism alone, fitted: what the nonlinear ones are worth."""

    name: str = "linear"
    title: str = "the linear effects of the mechanism alone, fitted"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Leaves out every effect that is not linear, then fits as the grey box."""
        mechanism = model.mechanism
        nonlinear = [e for e in mechanism.effects if not isinstance(e, Linear)]
        for e in nonlinear:
            mechanism = mechanism.without(e.name, e.at)
        left_out = ", ".join(f"{e.name} at {e.at}" for e in nonlinear)
        note = f"without {left_out}" if nonlinear else "the mechanism is linear as it is"
        return _fitted(Model(mechanism, model.solver), train, say, note=note)


@dataclasses.dataclass(frozen=True)
class GreyBox:
    """The mechanism, its free parameters fitted to free runs."""

    name: str = "grey_box"
    title: str = "the mechanism, fitted to free runs"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fits the error that is compared."""
        return _fitted(model, train, say)


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
    share: float = HORIZON

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fits innovations instead of free runs."""
        torque = torque_scale(model.mechanism, stack(train, model))
        intensity = self.share * torque**2 * train[0].Ts
        return _fitted(model, train, say, everywhere(model.mechanism, intensity))


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
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Discovers on parts of the training recordings, then fits to the whole of them."""
        parts = [recording.split(self.share) for recording in train]
        result = discover(model, [a for a, _ in parts], [b for _, b in parts], progress=say)
        found = ", ".join(f"{r.effect} at {r.port}" for r in result.rounds)
        note = f"added {found}" if found else f"added nothing ({result.verdict.replace('_', ' ')})"
        return _fitted(result.model, train, say, note=note)


def _fitted(
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
    return Fitted(found.model, len(found.free_names), "; ".join(filter(None, (note, stopped))))
