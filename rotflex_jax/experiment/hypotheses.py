"""Two machines that a recording cannot tell apart: the fitted model with one effect or with the other."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, Solver, kalman_gains
from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.model import Model
from rotflex_jax.parameters import Transform

Place = tuple[str, str]

# Fitted in every recording anew, so that they never count as evidence.
OFFSET: Place = ("voltage_offset", "input")


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """One machine, and how the other one may bend to look like it.

    Attributes:
        label: `effect@port`.
        mechanism: Fitted model with the effect and the calibrations of a recording.
        solver: Integration rule.
        moved: Places in `mechanism.values` of what a fit to a new recording moves.
        calibrations: Full names of the parameters that every recording has for itself.
        K: Gain of the predictor (n, C); zero is a free run.
        L: Inverse Cholesky factor of the covariance of the innovations (C, C).
    """

    label: str
    mechanism: Mechanism
    solver: Solver
    moved: tuple[int, ...]
    calibrations: tuple[str, ...]
    K: np.ndarray
    L: np.ndarray

    @property
    def transform(self) -> Transform:
        """Unconstrained <-> physical."""
        return Transform.of(self.mechanism.parameter_specifications)

    @property
    def start(self) -> np.ndarray:
        """Numbers where a fit to a new recording starts: unconstrained values, then a first state at rest."""
        z = self.transform.unconstrain(self.mechanism.values)
        return np.concatenate([z[list(self.moved)], np.zeros(2 * len(self.mechanism.coordinates))])

    @property
    def rest(self) -> np.ndarray:
        """State at rest."""
        return rest_state(self.mechanism.structure, np.float64)

    def with_numbers(self, numbers: np.ndarray) -> "Hypothesis":
        """The hypothesis with the numbers that a fit moved; the first state is left out."""
        z = self.transform.unconstrain(self.mechanism.values)
        z[list(self.moved)] = numbers[: len(self.moved)]
        mine = list(self.moved)
        values = self.mechanism.values
        values[mine] = self.transform.physical(z)[0][mine]
        return dataclasses.replace(self, mechanism=self.mechanism.with_values(values))

    def effect(self) -> Effect:
        """The effect that makes the hypothesis."""
        name, _, port = self.label.partition("@")
        return self.mechanism.effect(name, port)


def place_of(effect: Any) -> Place:
    """Name and port of an effect given as `name@port`, as a pair, or as the effect itself."""
    if isinstance(effect, Effect):
        return effect.name, effect.at
    pair = effect.split("@") if isinstance(effect, str) else effect
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(p, str) for p in pair)):
        raise InputError(
            f"An effect was given as {effect!r}, but needs a name and a port; write for instance "
            '"delay@input", or give an effect with its numbers.'
        )
    name, port = pair
    if name not in CATALOG:
        raise InputError(
            f"The effect {name!r} is not in the catalogue, which has {', '.join(CATALOG)}; use one of these."
        )
    return name, port


def hypothesis(
    model: Model,
    effect: Any,
    other: Place,
    process_noise: Mapping[str, float],
    noise: np.ndarray,
    Ts: float,
) -> Hypothesis:
    """The fitted model with one effect, and without its rival.

    Args:
        model: Fitted model; may have one of the two effects.
        effect: The effect: an instance with its numbers, `name@port` or a pair. The numbers of a model that
            has it count, otherwise those of the catalogue.
        other: The rival, which is taken out.
        process_noise: Port -> intensity of the process torque [(N m)^2 s].
        noise: Deviation of the sensor noise per channel (C,).
        Ts: Sampling period [s].
    """
    name, port = place_of(effect)
    m = model.mechanism
    present = {(e.name, e.at) for e in m.effects}
    if other in present:
        m = m.without(*other)
    if isinstance(effect, Effect):
        m = (m.without(name, port) if (name, port) in present else m) + effect
    elif (name, port) not in present:
        m = m + CATALOG[name](at=port)
    plain = set(m.parameter_names)
    m = _calibrated(m)
    calibrations = tuple(n for n in m.parameter_names if n not in plain)
    free = [i for i, n in enumerate(m.parameter_names) if n not in m.trusted]
    K = kalman_gains(m, [process_noise], noise, Ts)[0]
    layout = Layout.of(m.structure)
    C = np.zeros((len(m.channels), layout.size))
    C[:, : 2 * layout.n] = layout.output_rows
    # K = P C' S^-1 with S = C P C' + R, hence C K = 1 - R S^-1.
    S = np.linalg.solve(np.eye(len(C)) - C @ K, np.diag(np.square(noise)))
    L = np.linalg.inv(np.linalg.cholesky((S + S.T) / 2))
    return Hypothesis(f"{name}@{port}", m, model.solver, tuple(free), calibrations, K, L)


def _calibrated(m: Mechanism) -> Mechanism:
    """The mechanism with what every recording may have for itself: an offset, biases of further channels.

    The first channel needs no bias: its first position is fitted.
    """
    places = [OFFSET, *(("sensor_bias", c) for c in m.channels[1:])]
    for name, port in places:
        if (name, port) not in {(e.name, e.at) for e in m.effects}:
            m = m + CATALOG[name](at=port)
    return m
