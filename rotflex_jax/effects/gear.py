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

    `r` is the angle of the rotor relative to the port, referred to the port, and `tau` the torque that the
    teeth transmit to the port. When `tau` changes its sign, the teeth separate, and the rotor crosses the
    play of `2 gap` without driving the port. The impact at the other stop is inelastic: after it rotor and
    port have the same speed.

    The rotor has a `share` of the inertia that is entered at the port. The motor with its back-EMF acts on
    the rotor, all other effects at the port act on the rest. Effects on the motor shaft itself are entered at
    the port `rotor`, which a mechanism with this gear has in addition to its own ports. The torque that
    `heating` and `torque_saturation` take from the motor is subtracted at the port, even while the teeth are
    out of contact. Not for a spring that is loose about its rest position, which is `joint_play`, nor for
    play that is never crossed, which only shifts the angle. A mechanism has at most one gear with play, at a
    port with a motor and an inertia.

    Args:
        at: Port of the motor.
        gap: Half of the play, referred to the port [rad].
        share: Share of the rotor in the inertia of the port [-].

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
        """Angle [rad] from the middle of the play to each stop."""
        return self.gap

    def rotor(self) -> Scalar:
        """Share of the rotor in the inertia at the port."""
        return self.share

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Gaps that differ by factors of two, each an alternative; the motor crosses them in 3 to 34 ms."""
        times = [0.012 * 2 ** (k / 2) for k in (0, 1, -1, 2, -2, 3, -3, -4)]
        if not scale.inertia:
            return []
        return [[{"gap": scale.torque / scale.inertia * t * t / 4, "share": 0.6}] for t in times]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"the gear at the {self.at} has a play of {math.degrees(2 * self.gap):.3g} deg in all, which the "
            f"rotor with {100 * self.share:.0f} % of the inertia there crosses alone"
        )


@register
@dataclasses.dataclass(frozen=True)
class ElasticBacklash(Gear):
    """Play of a gear with elastic teeth: teeth in contact push like a damped spring, and never pull.

        tau = max(0, stiffness depth + damping depth') sign(r),   depth = |r| - gap > 0,   0 within the play

    `r` is the angle of the rotor relative to the port, referred to the port, and `tau` the torque that the
    teeth transmit to the port. The rotor has a `share` of the inertia that is entered at the port. The motor
    with its back-EMF and all effects at the port `rotor` act on the rotor, all other effects at the port act
    on the rest. With a `gap` of zero it is an elastic gear without play. Not for teeth that oscillate far
    above the sampling frequency: a recording then does not determine their stiffness and damping, and
    `backlash` with its rigid teeth is enough. A search tries this effect only on request, and in place of
    `backlash`, since a mechanism has at most one gear with play.

    Args:
        at: Port of the motor.
        gap: Half of the play, referred to the port [rad].
        share: Share of the rotor in the inertia of the port [-].
        stiffness: Stiffness of teeth in contact [N m/rad].
        damping: Damping of teeth in contact [N m s/rad].

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
        """Angle [rad] from the middle of the play to where the teeth touch."""
        return self.gap

    def rotor(self) -> Scalar:
        """Share of the rotor in the inertia at the port."""
        return self.share

    def teeth(self) -> tuple[Scalar, Scalar]:
        """Stiffness [N m/rad] and damping [N m s/rad] of teeth in contact."""
        return self.stiffness, self.damping

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Gaps that differ by factors of two, as for rigid teeth, each an alternative."""
        if not scale.inertia:
            return []
        teeth = {"share": 0.6, "stiffness": 1500.0, "damping": 0.3}
        gaps = [scale.torque / scale.inertia * (0.012 * 2 ** (k / 2)) ** 2 / 4 for k in range(-4, 4)]
        return [[{"gap": gap, **teeth}] for gap in gaps]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"the gear at the {self.at} has a play of {math.degrees(2 * self.gap):.3g} deg in all, which the "
            f"rotor with {100 * self.share:.0f} % of the inertia there crosses alone, and teeth of "
            f"{self.stiffness:.3g} N m/rad"
        )
