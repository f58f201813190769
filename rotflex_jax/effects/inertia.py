"""Inertia: a moment of inertia, and an elastically attached part with its own mode of vibration."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.base import Linear, Probe, Scale, Stamp, register
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Inertia(Linear):
    """A moment of inertia that turns with the port.

        T = 1/2 inertia speed^2

    Not for a mass whose lever arm changes with the position: the inertia is constant.

    Args:
        at: Port.
        inertia: Moment of inertia [kg m^2].

    Source: Lagrange's equations.
    """

    name: ClassVar[str] = "inertia"
    inertial: ClassVar[bool] = True
    title: ClassVar[str] = "moment of inertia"
    equation: ClassVar[str] = "T = 1/2 * inertia * speed^2"
    amplitudes: ClassVar[tuple[str, ...]] = ("inertia",)

    inertia: float = parameter(0.002, unit="kg m^2", lower=0.0, meaning="moment of inertia")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(inertia=self.inertia)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        acceleration = scale.speed**2 / scale.position
        return [[{"inertia": 0.1 * scale.torque / acceleration}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"the {self.at} carries a moment of inertia of {self.inertia:.3g} kg m^2"


@register
@dataclasses.dataclass(frozen=True)
class SecondMode(Linear):
    """An inertia on a spring at the port: one more mode, such as the first bending mode of an arm.

        r'' + 2 damping W (r' - speed) + W^2 (r - position) = 0,    W = 2 pi frequency
        tau = -inertia r''

    `r` is the angle of the part, position and speed are those of the port. Not for a frequency above the
    excited band: the part then moves with the port, and its inertia only adds to the inertia at the port.

    Args:
        at: Port.
        inertia: Inertia of the part [kg m^2].
        frequency: Natural frequency of the part while the port is held [Hz].
        damping: Damping ratio of the part [-].

    Source: J. P. Den Hartog, Mechanical Vibrations, 4th ed., 1956, section 3.2.
    """

    name: ClassVar[str] = "second_mode"
    title: ClassVar[str] = "second vibration mode"
    equation: ClassVar[str] = (
        "r'' + 2 * damping * W * (r' - speed) + W**2 * (r - position) = 0, W = 2 * pi * frequency, "
        "tau = -inertia * r''"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("inertia",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm")

    inertia: float = parameter(5e-4, unit="kg m^2", lower=0.0, meaning="inertia of the part")
    frequency: float = parameter(15.0, unit="Hz", lower=1e-3, meaning="frequency while the port is held")
    damping: float = parameter(0.03, unit="", lower=0.0, meaning="damping ratio")

    @property
    def order(self) -> int:
        """Two states: the angle of the part relative to the port, and the absolute speed of the part."""
        return 2

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        W = 2 * math.pi * self.frequency
        square, loss = W * W, 2 * self.damping * W
        return Stamp(
            damping=self.inertia * loss,
            own=((0.0, 1.0), (-square, -loss)),
            from_speed=(-1.0, loss),
            from_voltage=(0.0, 0.0),
            torque=(self.inertia * square, self.inertia * loss),
        )

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test at each of several frequencies."""
        return (
            [
                [{"inertia": 0.05 * scale.inertia, "frequency": f, "damping": 0.05}]
                for f in (8.0, 11.0, 15.0, 20.0, 27.0)
            ]
            if scale.inertia
            else []
        )

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"a part of {self.inertia:.3g} kg m^2 at the {self.at} swings on its own at "
            f"{self.frequency:.3g} Hz with a damping ratio of {self.damping:.2g}"
        )
