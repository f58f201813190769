"""Recordings in closed loop: the controller uses the readings of the sensors.

The recorded voltage is the voltage that the controller holds over the sample; the plant is integrated in
steps of 20 us (`simulator.plant`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rotflex_jax.arena.simulator.control import LIMIT, Controller
from rotflex_jax.arena.simulator.plant import (
    STEP,
    Course,
    Plant,
    course_of,
    sample,
    state_of,
    tables_of,
    working_space,
)
from rotflex_jax.arena.simulator.sensors import read
from rotflex_jax.arena.simulator.tables import Laws, Values
from rotflex_jax.arena.simulator.voltage import Path

COUNT = 2 * np.pi / 4096
"""One count of the encoders [rad]."""


@dataclass(frozen=True)
class Sensors:
    """Quantisation, noise and further errors of the sensors, in addition to the sensor errors in `Laws`.

    Args:
        resolution: one count of theta and of alpha [rad].
        noise: standard deviation of the noise before quantisation [rad].
        modes: shares of the deflections of the oscillators at hub and arm in the reading of alpha.
        crosstalk: share of theta in the reading of alpha.
        late: delay of the reading of alpha [samples].
    """

    resolution: tuple[float, float] = (COUNT, COUNT)
    noise: tuple[float, float] = (0.0, 0.0)
    modes: tuple[float, float] = (0.0, 0.0)
    crosstalk: float = 0.0
    late: int = 0

    def deviation(self) -> Values:
        """Standard deviation of noise and quantisation together [rad], ``(2,)``."""
        return np.sqrt(np.square(self.noise) + np.square(self.resolution) / 12)

    def clean(self, states: Values, table: Values) -> Values:
        """Readings without noise and quantisation [rad], ``(N, 2)``.

        Args:
            states: states of the plant, rows as in `simulator.plant.run`.
            table: errors of the sensors, as in `simulator.tables.Laws`.
        """
        course = course_of(states)
        angles = course.motion[:, :2].copy()
        theta, alpha = angles.T
        angles[:, 1] = (
            alpha
            + self.modes[0] * (course.modes[:, 0] - theta)
            + self.modes[1] * (course.modes[:, 2] - theta - alpha)
        )
        y = read(angles, table)
        y[:, 1] += self.crosstalk * y[:, 0]
        if self.late:
            y[:, 1] = np.concatenate([np.full(self.late, y[0, 1]), y[: -self.late, 1]])
        return y

    def measured(self, clean: Values, noise: Values) -> Values:
        """Recorded angles [rad]; `noise` is standard normal, with the shape of `clean`."""
        step = np.asarray(self.resolution)
        return step * (np.round((clean + np.asarray(self.noise) * noise) / step) + 0.0)


@dataclass(frozen=True)
class Loop:
    """One run of a machine under a controller.

    Args:
        u: voltage that the controller held over each sample [V], ``(N,)``.
        y: recorded angles [rad], ``(N, 2)``.
        clean: readings without noise and quantisation [rad], ``(N, 2)``.
        states: whole state of the plant at each sample, as `simulator.plant.run` gives it.
        torque: disturbance torque added to the motor torque [N m], ``(N,)``.
        reference: reference of the controller [rad], ``(N,)``.
        first: number of samples from the start at rest to the first sample of this run.
    """

    u: Values
    y: Values
    clean: Values
    states: Values
    torque: Values
    reference: Values
    first: int = 0

    @property
    def course(self) -> Course:
        """The states by name."""
        return course_of(self.states)

    def after(self, samples: int) -> Loop:
        """The run from a later sample on."""
        parts = (self.u, self.y, self.clean, self.states, self.torque, self.reference)
        return Loop(*(x[samples:] for x in parts), first=self.first + samples)


@dataclass
class _Filter:
    """Derivative of readings by a first-order filter."""

    keep: float
    Ts: float
    last: Values = field(default_factory=lambda: np.zeros(2))
    rate: Values = field(default_factory=lambda: np.zeros(2))

    def __call__(self, y: Values) -> Values:
        self.rate = self.keep * self.rate + (1 - self.keep) * (y - self.last) / self.Ts
        self.last = y
        return self.rate


def recorded(
    plant: Plant,
    laws: Laws,
    sensors: Sensors,
    controller: Controller,
    reference: Values,
    Ts: float,
    rng: np.random.Generator,
    torque: Values | None = None,
    step: float = STEP,
) -> Loop:
    """A run from rest at zero under feedback.

    Args:
        plant: physical constants.
        laws: effects in addition to these constants.
        sensors: sensors of the controller and of the recording.
        controller: feedback; its voltage is limited to `simulator.control.LIMIT`.
        reference: reference of the controller [rad], ``(N,)``.
        Ts: sampling period [s].
        rng: random generator for the noise of the sensors.
        torque: disturbance torque added to the motor torque [N m], ``(N,)``, held over each sample.
        step: longest integration step [s].
    """
    N, substeps = reference.size, max(1, round(Ts / step))
    h, gain = Ts / substeps, plant.torque_per_volt
    torque = np.zeros(N) if torque is None else torque
    tables, path, space = tables_of(plant, laws), Path(laws.volts, substeps, h), working_space()
    x = state_of(laws)
    new, side = x.copy(), 0
    k = np.asarray(controller.gains)
    rates = _Filter(float(np.exp(-2 * np.pi * controller.corner * Ts)), Ts)
    noise = rng.standard_normal((N, 2))
    states, u, clean, y = np.empty((N, x.size)), np.empty(N), np.empty((N, 2)), np.empty((N, 2))
    for n in range(N):
        states[n] = x
        # A delayed reading needs earlier samples.
        clean[n] = sensors.clean(states[max(0, n - sensors.late) : n + 1], laws.sensors)[-1]
        y[n] = sensors.measured(clean[n], noise[n])
        wanted = k[0] * reference[n] - k[:2] @ y[n] - k[2:] @ rates(y[n])
        u[n] = np.round(np.clip(wanted, -LIMIT, LIMIT), 6)
        side = sample(x, new, side, gain * path(u[n]) + torque[n], n * substeps, h, tables, space)
    return Loop(u, y, clean, states, torque, reference)
