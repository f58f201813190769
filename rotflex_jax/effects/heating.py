"""A motor that loses torque as it warms up."""

import dataclasses
from typing import ClassVar

from rotflex_jax.effects.catalogue import register
from rotflex_jax.effects.kinds import Drive, Memory, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Heating(Memory):
    """The armature's resistance rises with its own heat: R becomes R (1 + rate z).

        dz/dt = m^2 / (1 + rate z) - z / time,    tau = -rate z / (1 + rate z) m

    `m` is the torque the motor at this port would give when cold, so `tau` is what it loses and the
    heat is that of the current. Not for a recording that is short against `time` and evenly driven:
    the loss is a slow drift that a lower torque constant stands in for.

    Args:
        at: Port of the motor.
        rate: Relative rise of the resistance per second and squared torque [1/((N m)^2 s)].
        time: Time constant of cooling [s].

    Source: First-order thermal model of an armature; J. F. Gieras, Permanent Magnet Motor
    Technology, 3rd ed., 2010, section 8.4.
    """

    name: ClassVar[str] = "heating"
    title: ClassVar[str] = "motor that warms up"
    equation: ClassVar[str] = (
        "dz/dt = m**2 / (1 + rate * z) - z / time, tau = -rate * z / (1 + rate * z) * m, "
        "m torque of the cold motor"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("rate",)
    driven_by: ClassVar[Drive] = "motor"
    searched: ClassVar[tuple[str, ...]] = ("hub",)

    rate: float = parameter(0.5, unit="1/((N m)^2 s)", lower=0.0, meaning="rise of the resistance by heat")
    time: float = parameter(30.0, unit="s", lower=1e-2, meaning="time constant of cooling")

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [(N m)^2]."""
        return drive * drive / (1 + self.rate * z) - z / self.time

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.rate * z / (1 + self.rate * z) * drive

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction at each of two times of cooling."""
        return [[{"rate": 0.01 / scale.torque**2, "time": time}] for time in (10.0, 100.0)]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the motor at the {self.at} warms up: its resistance rises by {self.rate:.3g} per second and "
            f"(N m)^2 of torque, and cools with a time constant of {self.time:.3g} s"
        )
