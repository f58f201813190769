"""The independent simulator as a machine that is read and driven sample by sample."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rotflex_jax.arena.simulator.laws import Place, laws
from rotflex_jax.arena.simulator.plant import STEP, Plant, sample, state_of, tables_of, working_space
from rotflex_jax.arena.simulator.records import COUNT, JITTER
from rotflex_jax.arena.simulator.sensors import read
from rotflex_jax.arena.simulator.tables import Values
from rotflex_jax.arena.simulator.voltage import Path


class Machine:
    """A joint at rest at zero, whose encoders are read and whose voltage is held over each sample.

    Args:
        plant: physical constants.
        hidden: parameters of every effect by name and port, as in `simulator.laws.laws`.
        Ts: sampling period [s].
        seed: seed of the noise of the encoders.
    """

    def __init__(self, plant: Plant, hidden: Mapping[Place, Mapping[str, float]], Ts: float, seed: int = 0):
        found = laws(hidden)
        self.substeps = max(1, round(Ts / STEP))
        self.h, self.gain = Ts / self.substeps, plant.torque_per_volt
        self.tables, self.path = tables_of(plant, found), Path(found.volts, self.substeps, self.h)
        self.errors, self.space = found.sensors, working_space()
        self.x = state_of(found)
        self.new, self.side, self.samples = self.x.copy(), 0, 0
        self.noise = np.random.default_rng(seed)
        self.states: list[Values] = []

    @classmethod
    def of(cls, record: Mapping[str, Any], seed: int = 0) -> Machine:
        """The machine of a record from `simulator.records.make_record`."""
        truth = record["truth"]
        hidden = {(e["effect"], e["port"]): e["parameters"] for e in truth["effects"]}
        return cls(Plant(**truth["plant"]), hidden, record["Ts"], seed)

    def read(self) -> Values:
        """Readings of the encoders [rad], ``(2,)``."""
        clean = read(self.x[None, :2], self.errors)[0]
        return COUNT * (np.round((clean + JITTER * self.noise.standard_normal(2)) / COUNT) + 0.0)

    def advance(self, voltage: float) -> None:
        """Holds a voltage [V] over one sample."""
        self.states.append(self.x.copy())
        drive = self.gain * self.path(float(voltage))
        first = self.samples * self.substeps
        self.side = sample(self.x, self.new, self.side, drive, first, self.h, self.tables, self.space)
        self.samples += 1
