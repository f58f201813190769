"""Dry friction: Coulomb, different in each direction, Stribeck, growing with the load of a gear."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from rotflex_jax.checks import shown
from rotflex_jax.effects.base import DRY_FRICTION, DryFriction, Probe, Scalar, Scale, register
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import parameter


@register
@dataclasses.dataclass(frozen=True)
class Coulomb(DryFriction):
    """Constant (Coulomb) friction, with true sticking.

        tau = -level sign(speed) while sliding, any |tau| <= level at rest

    Not where the level falls as the motion starts: that is Stribeck friction.

    Args:
        at: Port.
        level: Friction torque [N m].

    Source: Coulomb 1785.
    """

    name: ClassVar[str] = "coulomb"
    title: ClassVar[str] = "Coulomb friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = "tau = -level * sign(speed), holds while |tau| <= level"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    steady: ClassVar[bool] = True

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction`."""
        return self.level

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction of the score test."""
        return [[{"level": 0.1 * scale.torque}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return f"Coulomb friction of {self.level:.3g} N m at the {self.at}"


@register
@dataclasses.dataclass(frozen=True)
class CoulombAsymmetric(DryFriction):
    """Constant friction with a level for each direction.

        tau = -forward while speed > 0, backward while speed < 0, between the two at rest

    It is equal to symmetric friction of the level `(forward + backward) / 2` together with the constant
    torque `(backward - forward) / 2`. On most recordings the two cannot be distinguished, since a voltage
    offset at the hub, or a shift of the deflection at the joint, gives such a torque.

    Args:
        at: Port.
        forward: Level that opposes positive motion [N m].
        backward: Level that opposes negative motion [N m].

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit 1994, section 2.
    """

    name: ClassVar[str] = "coulomb_asymmetric"
    title: ClassVar[str] = "asymmetric Coulomb friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = (
        "tau = -forward if speed > 0, +backward if speed < 0, holds while -forward <= tau <= backward"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("forward", "backward")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    steady: ClassVar[bool] = True

    forward: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque against positive motion")
    backward: float = parameter(
        0.02, unit="N m", lower=0.0, meaning="friction torque against negative motion"
    )

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction`."""
        return jnp.where(direction > 0, self.forward, self.backward)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, one for each direction of motion."""
        torque = 0.1 * scale.torque
        return [[{"forward": torque, "backward": 0.0}, {"forward": 0.0, "backward": torque}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"Coulomb friction at the {self.at} of {self.forward:.3g} N m turning forwards and "
            f"{self.backward:.3g} N m turning backwards"
        )


@register
@dataclasses.dataclass(frozen=True)
class Stribeck(DryFriction):
    """Friction that falls from a breakaway level to a constant level with increasing speed.

        |tau| = level + excess exp(-(v/speed)^2) while sliding, up to level + excess at rest

    `v` is the speed of the port; at `v = speed` a share exp(-1) of the excess is left. Not for a recording
    without slow motion: where the port reverses quickly, the excess cannot be distinguished from a slightly
    larger constant level.

    Args:
        at: Port.
        level: Friction torque at high speed [N m].
        excess: Additional friction torque at standstill [N m].
        speed: Speed over which the excess is lost [rad/s].

    Source: Stribeck 1902; Bo and Pavelescu 1982 with exponent 2.
    """

    name: ClassVar[str] = "stribeck"
    title: ClassVar[str] = "Stribeck friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = (
        "tau = -(level + excess * exp(-(v / speed)^2)) * sign(v), holds while |tau| <= level + excess"
    )
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "excess")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque at speed")
    excess: float = parameter(0.01, unit="N m", lower=0.0, meaning="additional friction torque at standstill")
    # A shape parameter has no value at which the effect is absent; the bound keeps the quotient finite.
    speed: float = parameter(0.2, unit="rad/s", lower=1e-4, meaning="speed over which the excess is lost")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion at |speed| [rad/s]."""
        return self.level + self.excess * jnp.exp(-jnp.square(speed / self.speed))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test at each of three speeds."""
        torque = 0.1 * scale.torque
        speeds = [max(share * scale.speed, 1e-3) for share in (0.05, 0.2, 0.6)]
        return [
            [
                {"level": torque, "excess": 0.0, "speed": speed},
                {"level": 0.0, "excess": torque, "speed": speed},
            ]
            for speed in speeds
        ]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"friction at the {self.at} falls from {self.level + self.excess:.3g} N m at "
            f"standstill to {self.level:.3g} N m within about {2 * self.speed:.2g} rad/s"
        )


@register
@dataclasses.dataclass(frozen=True)
class LoadFriction(DryFriction):
    """Friction of a gear that grows with the torque it transmits, more where the load drives the motor.

        |tau| = level + driving |load| while the motor drives,  level + driven |load| while it is driven

    `load` is the torque through the gear, taken as the mean of both sides of the port: the torque of the
    motor, and the torque that the rest of the machine takes. With `of="motor"` it is the torque of the motor
    alone: a machine that turns the gear back while the motor gives no torque then meets the constant level
    only. The motor drives if the load has the sign of the speed. At rest any torque up to the level holds
    the port, with the share for the direction in which the port would start to move. With `of="both"`, no
    load can turn a motor that gives no torque if `driven` is 2 or more. Not together with a free efficiency
    of the motor, which has the same influence while the motor drives.

    Args:
        at: Port of the motor.
        level: Friction torque without load [N m].
        driving: Share of the load that is lost while the motor drives [-].
        driven: Share of the load that is lost while the load drives the motor [-].
        tied: Whether `driven` always equals `driving`, whatever value is given for it (model M3). Useful for
            recordings of a servo with one weight, which cannot distinguish two shares from another torque
            constant.
        of: Torque that is the load: the mean torque of "both" sides of the port, or of the "motor" alone.

    Raises:
        InputError: If `of` is none of these, `tied` is not True or False, or a value is out of its bounds.

    Source: M. Duclusaud, G. Passault, V. Padois and O. Ly, Extended friction models for the physics
    simulation of servo actuators, 2024, models M3 and M5 (load-dependent and directional friction).
    """

    name: ClassVar[str] = "load_friction"
    title: ClassVar[str] = "load-dependent friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = (
        "tau = -(level + share * |load|) * sign(speed), share = driving if load * speed > 0, driven "
        "otherwise, load torque through the gear"
    )
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "driving", "driven")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    # Where the load hardly varies, it cannot be distinguished from constant friction: searched on request.
    searched: ClassVar[tuple[str, ...]] = ()
    loaded: ClassVar[bool] = True

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque without load")
    driving: float = parameter(
        0.1, unit="", lower=0.0, meaning="share of the load that is lost while the motor drives"
    )
    driven: float = parameter(
        0.2, unit="", lower=0.0, meaning="share of the load that is lost while the load drives the motor"
    )

    tied: bool = False
    of: str = "both"

    def __post_init__(self) -> None:
        if not isinstance(self.of, str) or self.of not in ("both", "motor"):
            raise InputError(
                f"LoadFriction was given of={shown(self.of)}, but the load is of 'both' sides or of the "
                "'motor'; give one of these."
            )
        if not isinstance(self.tied, bool):
            raise InputError(
                f"LoadFriction was given tied={self.tied!r}, but it needs True or False; say whether both "
                "shares are one."
            )
        if self.tied:
            object.__setattr__(self, "driven", self.driving)
        super().__post_init__()

    @property
    def follows(self) -> dict[str, str]:
        """The share `driven` follows the share `driving`, if they are tied."""
        return {"driven": "driving"} if self.tied else {}

    @property
    def rest_share(self) -> float:
        """Weight of the rest of the machine in the load."""
        return 0.0 if self.of == "motor" else 0.5

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar, load: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction` under the load [N m]."""
        push = jnp.asarray(load) * direction
        return self.level + jnp.where(push > 0, self.driving * push, -self.driven * push)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Three directions of the score test, one for each parameter."""
        none = {"level": 0.0, "driving": 0.0, "driven": 0.0}
        return [[none | {"level": 0.1 * scale.torque}, none | {"driving": 0.2}, none | {"driven": 0.2}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        whose = "of the motor" if self.of == "motor" else "through the gear"
        return (
            f"friction at the {self.at} grows with the torque {whose}: from {self.level:.3g} N m by "
            f"{self.driving:.1%} of it while the motor drives and by {self.driven:.1%} while it is driven"
        )


@register
@dataclasses.dataclass(frozen=True)
class GearFriction(DryFriction):
    """Friction of a gear that grows in proportion to the torque of the motor.

        |tau| = level + share |motor torque|

    The motor torque is the torque that the motor gives at this port, with `heating` and `torque_saturation`
    included. At rest any torque up to the level holds the port. Where the port reverses, the friction changes
    its sign and keeps its magnitude. It is `LoadFriction` with `of="motor"` and `tied=True`: one share,
    whether the motor drives the machine or is driven; a recording with one load cannot determine two. If the
    motor's torque is in phase with the speed, the effect can hardly be distinguished from viscous damping or
    another torque per volt; a weight or a spring that the motor holds makes it distinguishable.

    Args:
        at: Port of the motor.
        level: Friction torque without load [N m].
        share: Share of the motor's torque that is lost [-].

    Source: M. Duclusaud, G. Passault, V. Padois and O. Ly, Extended friction models for the physics
        simulation of servo actuators, 2024, model M3, here with the torque of the motor as its load.
    """

    name: ClassVar[str] = "gear_friction"
    title: ClassVar[str] = "torque-dependent gear friction"
    law_of: ClassVar[str] = DRY_FRICTION
    equation: ClassVar[str] = "tau = -(level + share * |motor torque|) * sign(speed)"
    ports: ClassVar[tuple[str, ...]] = ("hub",)
    amplitudes: ClassVar[tuple[str, ...]] = ("level", "share")
    contains: ClassVar[tuple[str, ...]] = ("coulomb",)
    # Where only inertias and springs load the motor, the other laws of friction are equivalent to it.
    searched: ClassVar[tuple[str, ...]] = ("loaded",)
    loaded: ClassVar[bool] = True

    level: float = parameter(0.02, unit="N m", lower=0.0, meaning="friction torque without load")
    share: float = parameter(
        0.2, unit="", lower=0.0, physical=(0.0, 1.0), meaning="share of the motor's torque that is lost"
    )

    @property
    def rest_share(self) -> float:
        """Zero: the level depends on the torque of the motor alone."""
        return 0.0

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar, load: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction` under the motor's torque `load` [N m]."""
        return self.level + self.share * jnp.abs(jnp.asarray(load))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Two directions of the score test, one for each parameter."""
        return [[{"level": 0.1 * scale.torque, "share": 0.0}, {"level": 0.0, "share": 0.2}]]

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
        return (
            f"friction at the {self.at} is {self.share:.1%} of the torque of the motor, "
            f"and {self.level:.3g} N m besides"
        )
