"""A mechanism as a chain of joints about one axis, as far as simulators of rigid bodies can represent it.

The coordinates are the angles (or displacements) of successive joints, so that body k moves with the sum of
the first k coordinates. A port whose vector is one at the first coordinates and zero after them is a body. A
port whose vector has a single one is a joint. Any other port is a combination of joints.
"""

import dataclasses
import math
from typing import Any

from rotflex_jax.effects import Coulomb, Gravity, Lag, Motor, PositionLoop, Saturation, VoltageOffset
from rotflex_jax.effects.base import Actuation, DryFriction, Effect, Linear, Sensing
from rotflex_jax.errors import InputError
from rotflex_jax.export.certificate import label
from rotflex_jax.mechanism import Mechanism

Vector = tuple[float, ...]

LEAST_INERTIA = 1e-7
"""Inertia given to a body without one, as a share of the smallest inertia: simulators refuse zero."""

# Speed at which friction that decreases with speed has reached its final level [rad/s].
_FAST = 1e6


@dataclasses.dataclass
class Place:
    """Sum of the effects at one port, or at several ports with the same vector.

    Attributes:
        name: Name of the port.
        inertia: Inertia [kg m^2].
        stiffness: Stiffness [N m/rad].
        damping: Viscous damping [N m s/rad].
        friction: Level of dry friction [N m].
        gravity: Amplitudes of sine and cosine of the weight [N m].
        torque: Constant torque [N m].
    """

    name: str
    inertia: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    gravity: tuple[float, float] = (0.0, 0.0)
    torque: float = 0.0


@dataclasses.dataclass
class Drive:
    """A motor: torque = min(max(gain v + constant + at_position position + at_speed speed, -limit), limit).

    Attributes:
        name: Name of the port and of the effect.
        vector: Vector of the port.
        gain: Torque per input.
        constant: Constant torque.
        at_position: Torque per position.
        at_speed: Torque per speed.
        limit: Largest torque.
        coil: Torque per current, voltage per speed of the port, resistance and inductance; None for a current
            without a time constant.
    """

    name: str
    vector: Vector
    gain: float
    constant: float = 0.0
    at_position: float = 0.0
    at_speed: float = 0.0
    limit: float = math.inf
    coil: tuple[float, float, float, float] | None = None


@dataclasses.dataclass
class Chain:
    """A mechanism as a chain of joints.

    Attributes:
        places: Vector of a port -> effects there.
        drives: Motors, which all have the same input.
        input_limit: Largest input.
        lag: Time constant between command and input [s]; 0 for none.
        offset: Offset that is added to the input.
        left_out: Effects that the chain lacks, with the reason.
        approximated: Effects that the chain represents in a different way.
    """

    places: dict[Vector, Place] = dataclasses.field(default_factory=dict)
    drives: list[Drive] = dataclasses.field(default_factory=list)
    input_limit: float = math.inf
    lag: float = 0.0
    offset: float = 0.0
    left_out: list[str] = dataclasses.field(default_factory=list)
    approximated: list[str] = dataclasses.field(default_factory=list)

    @classmethod
    def of(cls, mechanism: Mechanism, form: str) -> "Chain":
        """The mechanism as a chain of joints, for an export to the format `form`.

        Raises:
            InputError: The mechanism neither turns nor slides.
        """
        if mechanism.units.motion not in ("rad", "m"):
            raise InputError(
                f"The mechanism moves in {mechanism.units.motion}, but {form} has joints that turn (rad) or "
                "slide (m); export C code or an FMU."
            )
        chain = cls()
        for effect in mechanism.effects:
            chain._add(mechanism, effect)
        for drive in chain.drives:
            drive.constant += drive.gain * chain.offset
        # Friction with two levels equals friction with their mean and a constant torque, which a motor gives.
        for vector, place in chain.places.items():
            able = (d for d in chain.drives if d.vector == vector and d.coil is None and math.isinf(d.limit))
            drive = next(able, None)
            if place.torque and drive is not None:
                drive.constant += place.torque
            elif place.torque:
                chain.approximated.append(
                    f"friction at {place.name}: the mean of both directions, without the {place.torque:.4g} "
                    f"{mechanism.units.effort} between them"
                )
        return chain

    def _add(self, mechanism: Mechanism, effect: Effect) -> None:
        if isinstance(effect, Actuation):
            self._add_actuation(mechanism, effect)
            return
        if isinstance(effect, Sensing):
            self.left_out.append(f"{label(effect)}: sensors of the simulator read what is true")
            return
        vector = tuple(map(float, mechanism.vector(effect)))
        place = self.places.setdefault(vector, Place(effect.at))
        if isinstance(effect, PositionLoop):
            self._add_servo(effect, vector, place)
        elif isinstance(effect, Motor) and effect.inductance is not None:
            gain, emf = (
                effect.gear_ratio * k for k in (effect.efficiency * effect.torque_constant, effect.back_emf)
            )
            self.drives.append(
                Drive(
                    f"{effect.at}.{effect.name}",
                    vector,
                    gain / effect.resistance,
                    coil=(gain, emf, effect.resistance, effect.inductance),
                )
            )
        elif isinstance(effect, Linear) and not effect.order and not effect.torque_at_port:
            self._add_linear(effect, vector, place)
        elif isinstance(effect, DryFriction):
            self._add_friction(mechanism, effect, place)
        elif isinstance(effect, Gravity) and mechanism.units.motion == "rad":
            s, c = place.gravity
            place.gravity = (s + effect.sine, c + effect.cosine)
        elif "coulomb" in effect.contains and hasattr(effect, "level"):
            self._add_level(mechanism, effect, place, float(getattr(effect, "level")))  # noqa: B009 - of some
        else:
            self.left_out.append(f"{label(effect)}: {effect.equation}")

    def _add_linear(self, effect: Linear, vector: Vector, place: Place) -> None:
        stamp = effect.stamp()
        place.inertia += float(stamp.inertia)
        if effect.motor:
            drive = Drive(f"{effect.at}.{effect.name}", vector, float(stamp.drive))
            drive.at_position, drive.at_speed = -float(stamp.stiffness), -float(stamp.damping)
            self.drives.append(drive)
            return
        place.stiffness += float(stamp.stiffness)
        place.damping += float(stamp.damping)

    def _add_servo(self, effect: PositionLoop, vector: Vector, place: Place) -> None:
        """Adds a servo; its duty limit does not include the back-EMF, which becomes damping of the joint."""
        on = 1.0 if effect.enabled is None else effect.enabled
        per_duty = on * effect.torque_constant * effect.supply / effect.resistance
        stiffness = per_duty * effect.gain * effect.gain_scale
        drive = Drive(f"{effect.at}.{effect.name}", vector, stiffness, limit=per_duty * effect.limit)
        drive.at_position, drive.at_speed = -stiffness, stiffness * effect.period / 2
        drive.at_speed -= per_duty * (effect.derivative or 0.0)
        self.left_out += [f"{label(effect)}: {p}" for p in effect.further_parts if "derivative" not in p]
        self.drives.append(drive)
        place.damping += on * effect.torque_constant**2 / effect.resistance

    def _add_friction(self, mechanism: Mechanism, effect: DryFriction, place: Place) -> None:
        load = (0.0,) if effect.loaded else ()
        forward, backward = (float(effect.limit(0.0, _FAST, d, *load)) for d in (1.0, -1.0))
        if effect.steady:
            place.friction += (forward + backward) / 2
            place.torque -= (forward - backward) / 2
        else:
            self._add_level(mechanism, effect, place, (forward + backward) / 2)

    def _add_level(self, mechanism: Mechanism, effect: Effect, place: Place, level: float) -> None:
        place.friction += level
        loaded = isinstance(effect, DryFriction) and effect.loaded
        which = "without load; what grows with the torque is left out" if loaded else "at speed"
        self.approximated.append(
            f"{label(effect)}: as {Coulomb.title} of {level:.4g} {mechanism.units.effort}, its level {which}"
        )

    def _add_actuation(self, mechanism: Mechanism, effect: Actuation) -> None:
        if isinstance(effect, Saturation) and not (self.lag or self.offset):
            self.input_limit = min(self.input_limit, effect.limit)
        elif isinstance(effect, VoltageOffset) and not _has_coil(mechanism):
            self.offset += effect.offset
        elif isinstance(effect, Lag) and not self.lag and not _has_coil(mechanism):
            self.lag = effect.time
        else:
            self.left_out.append(f"{label(effect)}: {effect.equation}")


def _has_coil(mechanism: Mechanism) -> bool:
    return any(isinstance(e, Motor) and e.inductance is not None for e in mechanism.effects)


def joint_of(vector: Vector) -> int | None:
    """Index of the joint that a port is; None for any other port."""
    ones = [k for k, x in enumerate(vector) if x]
    return ones[0] if len(ones) == 1 and vector[ones[0]] == 1.0 else None


def body_of(vector: Vector) -> int | None:
    """Index of the body that a port is; None for any other port."""
    moved = sum(1 for x in vector if x)
    return moved - 1 if moved and vector == (1.0,) * moved + (0.0,) * (len(vector) - moved) else None


def mass_and_lever(
    inertia: float, amplitudes: tuple[float, float], free_fall: float
) -> tuple[float, float, float]:
    """Mass and position (x, z) of the centre of mass of a body with a given inertia and weight.

    The axis is y, and the weight acts along -z. The mass at its lever contributes half of the inertia.

    Args:
        inertia: Inertia of the body about the axis [kg m^2].
        amplitudes: Amplitudes of sine and cosine of the weight [N m].
        free_fall: Acceleration of free fall [m/s^2].
    """
    sine, cosine = amplitudes
    weight = math.hypot(sine, cosine)
    if not weight:
        return inertia, 0.0, 0.0  # without a weight, any mass on the axis will do
    mass = 2 * weight**2 / (inertia * free_fall**2)
    return mass, -cosine / (mass * free_fall), -sine / (mass * free_fall)


def described(value: Any) -> str:
    """A number for an XML attribute, with all its digits."""
    return repr(float(value))
