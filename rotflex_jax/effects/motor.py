"""The direct-current motor with its gear."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Linear, Probe, Scale, Stamp
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Motor(Linear):
    """A voltage-driven direct-current motor behind a gear, with back-EMF.

        tau = efficiency torque_constant gear_ratio i
        inductance di/dt = v - resistance i - back_emf gear_ratio speed

    Without an inductance the current follows the voltage at once. Not for a motor driven by a
    current amplifier: that has no back-EMF.

    Args:
        at: Port the gear drives.
        torque_constant: Torque per current [N m/A].
        back_emf: Voltage per speed of the motor shaft [V s/rad].
        resistance: Of the armature [ohm].
        gear_ratio: Turns of the motor per turn of the port.
        efficiency: Of motor and gear together; 1 for none lost.
        inductance: Of the armature [H], or None.

    Source: Quanser, SRV02 user manual, 2011, table 3.1 and the section on modelling.
    """

    name: ClassVar[str] = "motor"
    title: ClassVar[str] = "direct-current motor"
    equation: ClassVar[str] = (
        "tau = efficiency * torque_constant * gear_ratio * i, "
        "inductance * di/dt = v - resistance * i - back_emf * gear_ratio * speed"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("torque_constant",)
    motor: ClassVar[bool] = True

    at: str = "hub"
    torque_constant: float = parameter(0.00767, unit="N m/A", lower=0.0, meaning="torque per current")
    back_emf: float = parameter(0.00767, unit="V s/rad", lower=0.0, meaning="voltage per speed")
    resistance: float = parameter(2.6, unit="ohm", lower=1e-6, meaning="armature resistance")
    gear_ratio: float = parameter(70.0, unit="", lower=0.0, meaning="motor turns per load turn")
    efficiency: float = parameter(
        1.0, unit="", lower=0.0, physical=(0.0, 1.0), meaning="efficiency of motor and gear"
    )
    inductance: float | None = parameter(
        None, unit="H", typical=2e-4, lower=1e-9, meaning="armature inductance"
    )

    @property
    def order(self) -> int:
        """One state, the current, where there is an inductance."""
        return 0 if self.inductance is None else 1

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        gain = self.efficiency * self.torque_constant * self.gear_ratio
        emf = self.back_emf * self.gear_ratio
        if self.inductance is None:
            return Stamp(drive=gain / self.resistance, damping=gain * emf / self.resistance)
        return Stamp(
            own=((-self.resistance / self.inductance,),),
            from_speed=(-emf / self.inductance,),
            from_voltage=(1.0 / self.inductance,),
            torque=(gain,),
        )

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """None: a recording with a voltage has its motor in the model from the start."""
        return []

    def sentence(self) -> str:
        """In words."""
        gain = self.efficiency * self.torque_constant * self.gear_ratio / self.resistance
        speed = math.inf if self.back_emf == 0 else 1 / (self.back_emf * self.gear_ratio)
        return (
            f"the motor gives the {self.at} {gain:.3g} N m per volt at rest and runs free at "
            f"{speed:.3g} rad/s per volt"
        )
