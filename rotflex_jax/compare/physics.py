"""Methods that start from the user's mechanism: as given, fitted, with added effects or a learned torque."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import Fitted, split_for_validation
from rotflex_jax.discover import discover
from rotflex_jax.discover.learned_torque import learn_torque
from rotflex_jax.discover.likelihood import MAX_PROCESS_NOISE_SHARE
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.fit import fit
from rotflex_jax.fit.dataset import Dataset, prepare, process_noise_ports
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Textbook:
    """The mechanism as it was given; nothing is fitted."""

    name: str = "textbook"
    title: str = "the mechanism with its given parameters"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Return the model unchanged; only the noise of its predictor comes from the recordings."""
        return Fitted(model, parameters=0, predict=one_step_predictor(model, train))


@dataclasses.dataclass(frozen=True)
class LinearPart:
    """The linear effects of the mechanism alone, fitted."""

    name: str = "linear"
    title: str = "the linear effects of the mechanism alone, fitted"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Leave out effects that are neither linear nor driven by a signal, then fit as the grey box."""
        mechanism = model.mechanism
        nonlinear = [e for e in mechanism.effects if not e.is_linear and not e.signal]
        for e in nonlinear:
            mechanism = mechanism.without(e.name, e.at)
        left_out = ", ".join(f"{e.name} at {e.at}" for e in nonlinear)
        note = f"without {left_out}" if nonlinear else "the mechanism is linear as it is"
        return fit_mechanism(Model(mechanism, model.solver), train, say, note=note)


@dataclasses.dataclass(frozen=True)
class GreyBox:
    """The mechanism, with its free parameters fitted to free runs."""

    name: str = "grey_box"
    title: str = "the mechanism, fitted to free runs"
    family: str = "physics"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fit the free parameters to free runs, the error that is compared."""
        return fit_mechanism(model, train, say)


@dataclasses.dataclass(frozen=True)
class GreyBoxPredictor:
    """The mechanism, fitted to the predictions of a Kalman filter.

    Missing physics biases the parameters less than in a free run, because the filter attributes a part of the
    error to unknown torques. In return the error of free runs is not minimised.

    Attributes:
        share: Intensity of these torques, as a share of the intensity of white noise as large as the torque
            of the motor.
    """

    name: str = "grey_box_predictor"
    title: str = "the mechanism, fitted to predictions that admit unknown torques"
    family: str = "physics"
    share: float = MAX_PROCESS_NOISE_SHARE

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fit the free parameters to innovations instead of free runs."""
        return fit_mechanism(model, train, say, _process_noise(model, prepare(model, train), self.share))


@dataclasses.dataclass(frozen=True)
class Discovered:
    """The mechanism with the effects that discovery adds, fitted like the grey box.

    Effects are chosen within the training recordings, whose last parts are for validation. The test data of
    the comparison are not used.

    Attributes:
        share: Share of each training recording that discovery learns from; the rest is for validation.
    """

    name: str = "discovered"
    title: str = "the mechanism with the effects that discovery adds, fitted to free runs"
    family: str = "physics"
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Discover on parts of the training recordings, then fit to the whole of each."""
        result = discover(model, *split_for_validation(train, self.share), progress=say)
        found = ", ".join(effect_label(*pair) for pair in result.added)
        note = f"added {found}" if found else f"added nothing ({result.verdict.replace('_', ' ')})"
        return fit_mechanism(result.model, train, say, note=note)


def fit_mechanism(
    model: Model,
    train: Sequence[Recording],
    say: Progress,
    process_noise: Mapping[str, float] | None = None,
    note: str = "",
) -> Fitted:
    """Fit the free parameters; raise if the fit diverged, and note an early stop and remarks."""
    fitted = fit(model, train, process_noise=process_noise, progress=say)
    if fitted.status.startswith("diverged"):
        raise RuntimeError(fitted.status)
    stopped = "" if fitted.status == "converged" else f"fit {fitted.status}"
    note = "; ".join(filter(None, (note, stopped, *(remark.sentence for remark in fitted.remarks))))
    return Fitted(fitted.model, len(fitted.free_names), note, one_step_predictor(fitted.model, train))


def _process_noise(model: Model, train: Dataset, share: float) -> dict[str, float]:
    """Intensity of white torques along every coordinate, from a share of the torque of the motor."""
    return process_noise_ports(model.mechanism, share * train.torque_scale**2 * float(train.data.Ts[0]))


def one_step_predictor(
    model: Model, train: Sequence[Recording]
) -> Callable[[Recording], Float[np.ndarray, "N C"]]:
    """One-step-ahead predictor: the stationary Kalman filter with unknown torques as process noise."""
    dataset = prepare(model, train)
    torques = _process_noise(model, dataset, MAX_PROCESS_NOISE_SHARE)
    return lambda recording: model.predict(recording, torques, dataset.noise)


@dataclasses.dataclass(frozen=True)
class LearnedTorqueMethod:
    """The grey box with a learned torque at one port: a smooth map of position and speed of the port.

    Attributes:
        at: Port; the first port of the mechanism if None.
        share: Share of each training recording to which the map is fitted; the rest is for validation.
    """

    name: str = "learned_torque"
    title: str = "the mechanism with a learned torque at one port"
    family: str = "learned"
    at: str | None = None
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fit the mechanism first, then the map in addition to it."""
        fitted = fit_mechanism(model, train, say)
        grey_box = fitted.simulator
        assert isinstance(grey_box, Model)
        at = self.at or next(iter(model.mechanism.port_vectors))
        first, last = split_for_validation(train, self.share)
        found = learn_torque(grey_box, first, last, at, progress=say)
        weights = np.asarray(found.effect.weights).size if found.kept else 0
        free = len(found.model.mechanism.free_names)
        note = f"at {at}, reads like {found.formula}" if found.kept else f"no torque at {at} was kept"
        note = "; ".join(filter(None, (note, fitted.note)))
        return Fitted(found.model, free + weights, note, one_step_predictor(found.model, train))
