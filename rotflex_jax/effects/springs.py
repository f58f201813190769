"""Springs: linear, cubic, quadratic, with play."""

import dataclasses
import math
from typing import ClassVar

from rotflex_jax.effects.base import Force, Linear, Probe, Scalar, Scale, Stamp, register, within
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Spring(Linear):
    """A linear torsion spring.

        tau = -stiffness position

    Not for deflections at which the springs are no longer linear: add a quadratic or cubic term.

    Args:
        at: Port.
        stiffness: Torque per angle [N m/rad].

    Source: Hooke 1678.
    """

    name: ClassVar[str] = "spring"
    elastic: ClassVar[bool] = True
    title: ClassVar[str] = "linear spring"
    equation: ClassVar[str] = "tau = -stiffness * position"
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)

    stiffness: float = parameter(1.0, unit="N m/rad", lower=0.0, meaning="torque per angle")

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        return Stamp(stiffness=self.stiffness)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"a spring of {self.stiffness:.3g} N m/rad pulls the {self.at} back"


@register
@dataclasses.dataclass(frozen=True)
class CubicSpring(Force):
    """The cubic term of a spring that hardens, or softens if the stiffness is negative.

        tau = -stiffness position^3

    Not valid far outside the deflections of the recording: a softening spring would pull outwards there.

    Args:
        at: Port.
        stiffness: Cubic stiffness [N m/rad^3].

    Source: Duffing 1918.
    """

    name: ClassVar[str] = "cubic_spring"
    title: ClassVar[str] = "cubic spring"
    equation: ClassVar[str] = "tau = -stiffness * position^3"
    ports: ClassVar[tuple[str, ...]] = ("joint",)
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    stiffness: float = parameter(0.0, unit="N m/rad^3", typical=10.0, meaning="cubic stiffness")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.stiffness * position * position * position

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position**3}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        verb = "hardens" if self.stiffness >= 0 else "softens"
        # 0.1 rad is a deflection that is easy to imagine.
        torque = abs(self.stiffness) * 0.1**3
        return (
            f"the spring at the {self.at} {verb} with deflection, by {torque:.3g} N m at 0.1 rad "
            f"({self.stiffness:.3g} N m/rad^3)"
        )


@register
@dataclasses.dataclass(frozen=True)
class QuadraticSpring(Force):
    """The quadratic term of a spring that is stiffer to one side, such as a pair of different springs.

        tau = -stiffness position^2

    Not valid far outside the deflections of the recording: to one side it would pull outwards.

    Args:
        at: Port.
        stiffness: Quadratic stiffness [N m/rad^2], positive where positive deflection is stiffer.

    Source: Second-order Taylor term of any spring characteristic.
    """

    name: ClassVar[str] = "quadratic_spring"
    title: ClassVar[str] = "asymmetric spring"
    equation: ClassVar[str] = "tau = -stiffness * position^2"
    ports: ClassVar[tuple[str, ...]] = ("joint",)
    amplitudes: ClassVar[tuple[str, ...]] = ("stiffness",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    stiffness: float = parameter(0.0, unit="N m/rad^2", typical=1.0, meaning="quadratic stiffness")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return -self.stiffness * position * position

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"stiffness": 0.1 * scale.torque / scale.position**2}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        side = "positive" if self.stiffness >= 0 else "negative"
        torque = abs(self.stiffness) * 0.1**2
        return (
            f"the spring at the {self.at} is stiffer towards {side} deflection, by "
            f"{torque:.3g} N m at 0.1 rad ({self.stiffness:.3g} N m/rad^2)"
        )


@register
@dataclasses.dataclass(frozen=True)
class JointPlay(Force):
    """Play of a spring: within it, part or all of the stiffness is missing.

        tau = stiffness min(max(position, -play), play)

    The torque adds to the torque of the linear spring at the port. If `stiffness` equals the stiffness of
    this spring, there is no torque at all within the play; with a smaller value the spring is softer there.
    Not for play between motor and gear: that is `backlash`.

    Args:
        at: Port.
        play: Deflection to each side that is free [rad].
        stiffness: Stiffness that the spring lacks within the play [N m/rad].

    Source: M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash, Automatica 38,
    2002, the dead-zone model.
    """

    name: ClassVar[str] = "joint_play"
    title: ClassVar[str] = "spring play"
    equation: ClassVar[str] = "tau = stiffness * min(max(position, -play), play), beside the spring"
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    amplitudes: ClassVar[tuple[str, ...]] = ("play",)
    searched: ClassVar[tuple[str, ...]] = ("joint",)

    play: float = parameter(0.005, unit="rad", lower=0.0, meaning="free deflection to each side")
    stiffness: float = parameter(1.6, unit="N m/rad", lower=0.0, meaning="what the spring lacks there")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return self.stiffness * within(position, -self.play, self.play)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test: the whole stiffness of the spring is missing within the play."""
        return [[{"play": 0.05 * scale.position, "stiffness": scale.stiffness}]] if scale.stiffness else []

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"the {self.at} is loose by {self.play:.2g} rad ({math.degrees(self.play):.2g} degrees) to "
            f"each side: {self.stiffness:.3g} N m/rad of its spring are missing there"
        )
