"""Play in the gear between motor and hub, with rigid or with elastic teeth."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.base import Gear, Probe, Scalar, Scale, register
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Backlash(Gear):
    """Play of a gear: the gear transmits torque only while its teeth are in contact.

        |r| <= gap,    tau >= 0 at r = gap,    tau <= 0 at r = -gap,    tau = 0 between

    `r` is the angle of the rotor relative to the port, referred to the port, and `tau` the transmitted
    torque. The rotor has a `share` of the inertia that is entered at the port; the motor with its back-EMF
    acts on it, all other effects at the port on the rest. What the motor's own shaft meets stands at the port
    `rotor`, which a mechanism with this gear has besides its own. The impact of the teeth is inelastic.
    Not for a spring that is loose about its rest position, which is `joint_play`, nor for play that is
    never crossed, which shifts the angle only. Beside `heating` and `torque_saturation` the lost torque acts
    on the port even while the rotor is in flight.

    Args:
        at: Port of the motor.
        gap: Half of the play [rad], as the port sees it.
        share: The rotor's part of the port's inertia.

    Source: M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash, Automatica 38,
    2002; F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, chapter 6.
    """

    name: ClassVar[str] = "backlash"
    title: ClassVar[str] = "backlash"
    law_of: ClassVar[str] = "play"
    equation: ClassVar[str] = (
        "|r| <= gap, torque passes only at |r| = gap, r angle of the rotor against the port, rotor inertia = "
        "share * inertia"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("gap",)
    searched: ClassVar[tuple[str, ...]] = ("hub",)

    gap: float = parameter(0.005, unit="rad", lower=0.0, meaning="half of the play")
    share: float = parameter(
        0.7, unit="", lower=0.02, upper=0.98, meaning="the rotor's part of the port's inertia"
    )

    def stops(self) -> Scalar:
        """Angle [rad] from the middle to each stop."""
        return self.gap

    def rotor(self) -> Scalar:
        """The rotor's part of the inertia at the port."""
        return self.share

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Gaps in steps of two, those that the motor's torque crosses in 3 to 34 ms, each an alternative."""
        times = [0.012 * 2 ** (k / 2) for k in (0, 1, -1, 2, -2, 3, -3, -4)]
        if not scale.inertia:
            return []
        return [[{"gap": scale.torque / scale.inertia * t * t / 4, "share": 0.6}] for t in times]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the gear at the {self.at} has a play of {math.degrees(2 * self.gap):.3g} deg in all, which the "
            f"rotor with {100 * self.share:.0f} % of the inertia there crosses alone"
        )


@register
@dataclasses.dataclass(frozen=True)
class ElasticBacklash(Gear):
    """Play of a gear whose teeth give: beyond the play they push like a spring with damping, and never pull.

        tau = max(0, stiffness depth + damping depth') sign(r),   depth = |r| - gap > 0,   0 within the play

    `r` is the angle of the rotor relative to the port, referred to the port, and `tau` the torque on the
    port. The rotor has a `share` of the inertia that is entered at the port; the motor with its back-EMF
    acts on it with all that stands at the port `rotor`, all other effects at the port on the rest. Without a
    gap it is a gear that is elastic only.
    Not where the teeth swing far above the sampling frequency: that is `backlash`, its limit, without the
    two parameters that no recording shows then. A search tries it on request and in the place of
    `backlash`, since a machine has one gear.

    Args:
        at: Port of the motor.
        gap: Half of the play [rad], as the port sees it.
        share: The rotor's part of the port's inertia.
        stiffness: Of teeth in contact [N m/rad].
        damping: Of teeth in contact [N m s/rad].

    Source: M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash, Automatica 38, 2002,
    section 2 (dead zone model with damping); K. H. Hunt and F. R. E. Crossley, J. Applied Mechanics 42, 1975,
    for contacts that do not pull.
    """

    name: ClassVar[str] = "elastic_backlash"
    title: ClassVar[str] = "backlash with elastic teeth"
    law_of: ClassVar[str] = "play"
    equation: ClassVar[str] = (
        "tau = max(0, stiffness * depth + damping * depth') * sign(r), depth = |r| - gap > 0, r angle of the "
        "rotor against the port, rotor inertia = share * inertia"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    contains: ClassVar[tuple[str, ...]] = ("backlash",)
    steps: ClassVar[int] = 4

    gap: float = parameter(0.005, unit="rad", lower=0.0, meaning="half of the play")
    share: float = parameter(
        0.7, unit="", lower=0.02, upper=0.98, meaning="the rotor's part of the port's inertia"
    )
    stiffness: float = parameter(1500.0, unit="N m/rad", lower=1.0, meaning="of teeth in contact")
    damping: float = parameter(0.3, unit="N m s/rad", lower=0.0, meaning="of teeth in contact")

    def stops(self) -> Scalar:
        """Angle [rad] from the middle to where the teeth touch."""
        return self.gap

    def rotor(self) -> Scalar:
        """The rotor's part of the inertia at the port."""
        return self.share

    def teeth(self) -> tuple[Scalar, Scalar]:
        """Stiffness [N m/rad] and damping [N m s/rad] of teeth in contact."""
        return self.stiffness, self.damping

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Gaps in steps of two as for rigid teeth, each an alternative."""
        if not scale.inertia:
            return []
        teeth = {"share": 0.6, "stiffness": 1500.0, "damping": 0.3}
        gaps = [scale.torque / scale.inertia * (0.012 * 2 ** (k / 2)) ** 2 / 4 for k in range(-4, 4)]
        return [[{"gap": gap, **teeth}] for gap in gaps]

    def sentence(self) -> str:
        """In words."""
        return (
            f"the gear at the {self.at} has a play of {math.degrees(2 * self.gap):.3g} deg in all, which the "
            f"rotor with {100 * self.share:.0f} % of the inertia there crosses alone, and teeth of "
            f"{self.stiffness:.3g} N m/rad"
        )
