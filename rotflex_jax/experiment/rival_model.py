"""Two models that a recording cannot distinguish: the fitted model with one effect or with the other."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, Solver, kalman_gains
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Transform

# Fitted to every recording separately, so that it never counts as evidence.
VOLTAGE_OFFSET = ("voltage_offset", "input")


@dataclasses.dataclass(frozen=True)
class RivalModel:
    """One of two competing models, and which of its parameters a new recording leaves open.

    A fit to a new recording has D unknowns: unconstrained values of the free parameters, then the first
    state.

    Attributes:
        label: `effect@port`.
        mechanism: Fitted model with the effect and the calibrations of a recording.
        solver: Integration rule.
        free: Indices in `mechanism.values` of the parameters that are fitted to a new recording.
        calibrations: Full names of the parameters that every recording has for itself.
        K: Gain of the predictor; zero is a free run.
        L: Inverse Cholesky factor of the covariance of the innovations.
    """

    label: str
    mechanism: Mechanism
    solver: Solver
    free: tuple[int, ...]
    calibrations: tuple[str, ...]
    K: Float[np.ndarray, "n C"]
    L: Float[np.ndarray, "C C"]

    @property
    def transform(self) -> Transform:
        """Unconstrained <-> physical."""
        return Transform.of(self.mechanism.parameter_specifications)

    @property
    def start(self) -> Float[np.ndarray, " D"]:
        """Unknowns where a fit to a new recording starts: the model's own values, and a state at rest."""
        z = self.transform.unconstrain(self.mechanism.values)
        return np.concatenate([z[list(self.free)], np.zeros(2 * len(self.mechanism.coordinates))])

    def with_unknowns(self, unknowns: Float[np.ndarray, " D"]) -> "RivalModel":
        """The model with fitted parameters; the first state is left out."""
        z, free = self.transform.unconstrain(self.mechanism.values), list(self.free)
        z[free] = unknowns[: len(free)]
        values = self.mechanism.values
        values[free] = self.transform.physical(z)[0][free]
        return dataclasses.replace(self, mechanism=self.mechanism.with_values(values))

    def effect(self) -> Effect:
        """The effect that distinguishes this model from its rival."""
        name, _, port = self.label.partition("@")
        return self.mechanism.effect(name, port)


def effect_location(effect: Any) -> tuple[str, str]:
    """Name and port of an effect given as `name@port`, as a pair, or as the effect itself."""
    if isinstance(effect, Effect):
        return effect.name, effect.at
    pair = effect.split("@") if isinstance(effect, str) else effect
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(p, str) for p in pair)):
        raise InputError(
            f"An effect was given as {effect!r}, but needs a name and a port; write for instance "
            '"delay@input", or give an effect with its parameters.'
        )
    name, port = pair
    if name not in CATALOG:
        raise InputError(
            f"The effect {name!r} is not in the catalogue, which has {', '.join(CATALOG)}; use one of these."
        )
    return name, port


def rival_model(
    model: Model,
    effect: Any,
    other: tuple[str, str],
    process_noise: Mapping[str, float],
    noise: Float[np.ndarray, " C"],
    Ts: float,
) -> RivalModel:
    """The fitted model with one effect, and without its rival.

    Args:
        model: Fitted model; may have one of the two effects.
        effect: The effect: an instance with its parameters, `name@port` or a pair. A model that has it
            gives the parameters, otherwise the catalogue does.
        other: Effect and port of the rival, which is taken out.
        process_noise: Port -> intensity of the process torque [(N m)^2 s].
        noise: Standard deviation of the sensor noise per channel.
        Ts: Sampling period [s].
    """
    name, port = effect_location(effect)
    m = model.mechanism
    present = {(e.name, e.at) for e in m.effects}
    if other in present:
        m = m.without(*other)
    if isinstance(effect, Effect):
        m = (m.without(name, port) if (name, port) in present else m) + effect
    elif (name, port) not in present:
        m = m + CATALOG[name](at=port)
    before = set(m.parameter_names)
    m = with_calibrations(m)
    calibrations = tuple(n for n in m.parameter_names if n not in before)
    free = [i for i, n in enumerate(m.parameter_names) if n not in m.trusted]
    K = kalman_gains(m, [process_noise], noise, Ts)[0]
    layout = Layout.of(m.structure)
    C = np.zeros((len(m.channels), layout.size))
    C[:, : 2 * layout.n] = layout.output_rows
    # K = P C' S^-1 with S = C P C' + R, hence C K = 1 - R S^-1.
    S = np.linalg.solve(np.eye(len(C)) - C @ K, np.diag(np.square(noise)))
    L = np.linalg.inv(np.linalg.cholesky((S + S.T) / 2))
    return RivalModel(f"{name}@{port}", m, model.solver, tuple(free), calibrations, K, L)


def with_calibrations(m: Mechanism) -> Mechanism:
    """The mechanism with a voltage offset and sensor biases, which every recording has for itself.

    The first channel needs no bias: its first position is fitted.
    """
    locations = [VOLTAGE_OFFSET, *(("sensor_bias", c) for c in m.channels[1:])]
    for name, port in locations:
        if (name, port) not in {(e.name, e.at) for e in m.effects}:
            m = m + CATALOG[name](at=port)
    return m
