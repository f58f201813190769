"""A mechanism from one joint of an MJCF file, with or without a child joint."""

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np

from rotflex_jax import checks
from rotflex_jax.checks import known_arguments
from rotflex_jax.effects import (
    Coulomb,
    CurrentDrive,
    Effect,
    Gravity,
    Inertia,
    Lag,
    Motor,
    PositionServo,
    Saturation,
    Spring,
    Viscous,
    VoltageOffset,
)
from rotflex_jax.errors import InputError
from rotflex_jax.joints.mjcf_tree import FileJoint, FileModel
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.text.numbers import one_line

IGNORABLE = ("forcerange", "ctrlrange", "ref", "springref", "tendon", "equality", "actuator")
"""Entries of a file that can be left out on request."""


@known_arguments
def load_mjcf(
    path: str | os.PathLike[str],
    joint: str | None = None,
    child: str | None = None,
    ignore: Iterable[str] = (),
) -> Mechanism:
    """A mechanism from one joint of an MJCF file, as the start of a fit or a search.

        (armature + inertia about the axis) q''
            = actuator - damping q' - frictionloss sign(q') - stiffness q - weight

    All bodies below the joint count as one rigid body in the position at rest. With `child`, a joint below it
    about the same axis, the two joints are the hub and the arm of a flexible joint. Inertias come from
    `<inertial>` or from simple shapes, attributes also from classes of defaults. The actuator is a `motor`,
    `general`, `position`, `velocity` or `dcmotor`; its control is the input. Ranges of joints and of goals,
    contacts and drawings are not read. MuJoCo itself is not needed. Not for a chain whose inertia depends on
    the angle of the child.

    Args:
        path: Path of the file.
        joint: Name of the joint; None if the file has only one joint.
        child: Name of the joint below it, for a flexible joint.
        ignore: Entries of the file that are left out: `forcerange`, `ctrlrange`, `ref`, `springref`,
            `tendon`, `equality`, `actuator`.

    Returns:
        Mechanism with the port `hub` and the output `theta`; with a child also `joint`, `arm` and `alpha`.
        For a sliding joint the port `axis` and the output `position` take the place of `hub` and `theta`.

    Raises:
        InputError: The joint does not exist, the file has an entry that no effect can represent (the message
            names it), or the file declares a document type, includes other files or is too large.

    Source: MuJoCo documentation, XML reference, body, inertial, joint, actuator.
    """
    left_out = tuple(checks.one_of(name, "ignore", IGNORABLE) for name in checks.names(ignore, "ignore"))

    return mechanism_of(path, joint, child, left_out)


# Torque constant of a servo whose joint has no damping; its back-EMF is negligible [N m/A].
_NO_BRAKE = 1e-4

# Attributes that every kind of actuator has.
_OF_ALL_KINDS = {"gear", "ctrlrange", "ctrllimited", "forcerange", "forcelimited"}


def mechanism_of(
    path: str | os.PathLike[str], joint: str | None, child: str | None, ignore: tuple[str, ...]
) -> Mechanism:
    """The mechanism of a joint and its child; arguments as in `load_mjcf`."""
    file = FileModel(path)
    hub = _named(file, joint, "joint")
    arm = None if child is None else _named(file, child, "child")
    return _Reader(file, hub, arm, ignore).mechanism()


def _named(file: FileModel, name: str | None, argument: str) -> FileJoint:
    listed = ", ".join(one_line(j.name) for j in file.joints[:20]) or "none"
    if name is None and len(file.joints) == 1:
        return file.joints[0]
    found = [j for j in file.joints if j.name == name]
    if len(found) == 1:
        return found[0]
    given = "no joint was named" if name is None else f"{argument} was given {checks.shown(name)}"
    raise InputError(
        f"{one_line(file.path)} has the joints that turn or slide: {listed}; {given}, name one of these."
    )


class _Reader:
    """Translates the joints of a file to effects."""

    def __init__(
        self, file: FileModel, hub: FileJoint, arm: FileJoint | None, ignore: tuple[str, ...]
    ) -> None:
        self.file, self.hub, self.arm, self.ignore = file, hub, arm, ignore
        self.port = "axis" if hub.slides else "hub"
        self.effects: list[Effect] = []
        self.input_unit = "V"
        self.side = 1.0
        if arm is not None:
            self._check_child(arm)

    def unable(self, what: str, name: str) -> None:
        """Refuse an entry that no effect can represent, unless it is to be left out."""
        if name not in self.ignore:
            hint = f", or give ignore=[{name!r}] to leave it out" if name in IGNORABLE else ""
            raise InputError(
                f"{one_line(self.file.path)} has {what}, which no effect of the mechanism says; "
                f"change the file{hint}."
            )

    def _check_child(self, arm: FileJoint) -> None:
        hub = self.hub
        self.side = float(np.sign(hub.axis @ arm.axis))
        apart = np.cross(arm.anchor - hub.anchor, hub.axis) if not hub.slides else np.zeros(3)
        behind = arm.body != hub.body and arm.body in self.file.below(hub.body)
        parallel = np.linalg.norm(np.cross(hub.axis, arm.axis)) < 1e-6
        if not (behind and parallel and arm.slides == hub.slides and np.linalg.norm(apart) < 1e-6):
            names = f"{one_line(arm.name)!r} is not about the same axis behind {one_line(hub.name)!r}"
            raise InputError(
                f"The joint {names}, so the inertia would depend on its angle; name a child on the same axis "
                "or none."
            )

    def mechanism(self) -> Mechanism:
        """The mechanism."""
        hub, arm, number = self.hub, self.arm, self.file.number
        self._check_options()
        bodies = self.file.below(hub.body)
        outer = [] if arm is None else self.file.below(arm.body)
        inner = [b for b in bodies if b not in outer]
        self._check_masses(hub, inner)
        if arm is not None:
            self._check_masses(arm, outer)
        armature = number(hub.attributes, "armature")
        self.effects.append(Inertia(at=self.port, inertia=self._inertia(inner) + armature))
        if arm is not None:
            self.effects.append(Inertia(at="arm", inertia=self._inertia(outer)))
            if number(arm.attributes, "armature"):
                self.effects.append(Inertia(at="joint", inertia=number(arm.attributes, "armature")))
        damping = self._own_damping(hub)
        damping = self._drive(damping)
        self.effects.append(Viscous(at=self.port, coefficient=damping))
        self._contact(hub, self.port)
        if arm is not None:
            self.effects.append(Viscous(at="joint", coefficient=self._own_damping(arm)))
            self._contact(arm, "joint", always=True)
        self._weight(inner, self.port)
        self._weight(outer, "arm")
        self._tendons()
        self._equalities()
        return self._assembled()

    def _check_masses(self, joint: FileJoint, bodies: list[int]) -> None:
        """Refuse bodies without mass or inertia, as MuJoCo does: any torque would move them at once."""
        if not sum(self.file.bodies[k].mass for k in bodies) > 0 or not self._inertia(bodies) > 0:
            raise InputError(
                f"{one_line(self.file.path)} has no mass, or no inertia about the axis, in what moves "
                f"with the joint {one_line(joint.name)!r}; write the mass and the inertia of its bodies."
            )

    def _check_options(self) -> None:
        """Refuse options that change the forces of the whole file."""
        for name in ("actuation", "damper", "spring", "passive", "frictionloss", "clampctrl"):
            if self.file.flags.get(name) == "disable":
                self.unable(f'the flag {name}="disable"', name)
        for name in ("viscosity", "density"):
            if self.file.number(self.file.options, name):
                self.unable(f"the {name} of a fluid", name)
        if "actuatorgroupdisable" in self.file.options:
            self.unable("actuators that are switched off (actuatorgroupdisable)", "actuatorgroupdisable")

    def _assembled(self) -> Mechanism:
        hub, arm = self.hub, self.arm
        units = Units("m", "N", input=self.input_unit) if hub.slides else Units(input=self.input_unit)
        channel = "position" if hub.slides else "theta"
        drive = next(e for e in self.effects if isinstance(e, Motor | CurrentDrive | PositionServo))
        held = [drive.full_name(n) for n in drive.values]
        if arm is None:
            ports, outputs, coordinates = {self.port: (1.0,)}, {channel: self.port}, (channel,)
            if isinstance(drive, PositionServo):
                held = [n for n in held if not n.endswith(("torque_constant", "resistance"))]
                held.append(f"{self.port}.inertia.inertia")
        else:
            ports = {self.port: (1.0, 0.0), "joint": (0.0, 1.0), "arm": (1.0, self.side)}
            coordinates = (channel, "alpha")
            outputs = {channel: self.port, "alpha": "joint"}
            held = [n for n in held if not n.endswith(".torque_constant")] + ["arm.inertia.inertia"]
        return Mechanism(coordinates, ports, tuple(self.effects), outputs, trusted=tuple(held), units=units)

    # -- what moves --------------------------------------------------------------------------------

    def _inertia(self, bodies: list[int]) -> float:
        """Inertia of bodies about the axis of the joint [kg m^2], or for a sliding joint their mass [kg]."""
        total, axis = 0.0, self.hub.axis
        for b in (self.file.bodies[k] for k in bodies):
            across = np.cross(axis, b.centre - self.hub.anchor)
            total += b.mass if self.hub.slides else float(axis @ b.inertia @ axis + b.mass * across @ across)
        return total

    def _weight(self, bodies: list[int], port: str) -> None:
        """Torque of the weight, axis . (turn(q) r x m g): a cosine and a sine of the angle."""
        attributes = self.file.options
        if self.file.flags.get("gravity") == "disable":
            return
        fall, axis = self.file.numbers(attributes, "gravity", 3, np.array([0.0, 0.0, -9.81])), self.hub.axis
        cosine = sine = size = 0.0
        for b in (self.file.bodies[k] for k in bodies):
            pull, lever = b.mass * fall, b.centre - self.hub.anchor
            size += float(np.linalg.norm(pull)) * (1.0 if self.hub.slides else float(np.linalg.norm(lever)))
            cosine += float(pull @ axis) if self.hub.slides else float(axis @ np.cross(lever, pull))
            sine += 0.0 if self.hub.slides else float(axis @ np.cross(np.cross(axis, lever), pull))
        if self.hub.slides and abs(cosine) > 1e-9 * size:
            self.unable("a sliding joint with weight along it, a constant force", "weight along a slide")
        if not self.hub.slides and math.hypot(sine, cosine) > 1e-9 * size:
            self.effects.append(Gravity(at=port, sine=-sine, cosine=-cosine))

    # -- joints ------------------------------------------------------------------------------------

    def _own_damping(self, joint: FileJoint) -> float:
        """Damping of a joint; refuses entries of the joint that no effect can represent."""
        for name in ("springdamper", "springyield", "actuatorgravcomp"):
            if any(x not in ("0", "0.0", "false") for x in joint.attributes.get(name, "0").split()):
                self.unable(f"{name} at the joint {one_line(joint.name)!r}", name)
        if self.file.number(joint.attributes, "ref"):
            self.unable(f"a reference angle (ref) at the joint {one_line(joint.name)!r}", "ref")
        return self.file.number(joint.attributes, "damping")

    def _contact(self, joint: FileJoint, port: str, always: bool = False) -> None:
        """Spring and dry friction of a joint."""
        stiffness, level = (self.file.number(joint.attributes, n) for n in ("stiffness", "frictionloss"))
        if stiffness and self.file.number(joint.attributes, "springref"):
            self.unable(
                f"a spring away from zero (springref) at the joint {one_line(joint.name)!r}", "springref"
            )
        self._join(Spring(at=port, stiffness=stiffness), bool(stiffness) or always)
        self._join(Coulomb(at=port, level=level), bool(level))

    def _join(self, effect: Effect, wanted: bool) -> None:
        """Add an effect; if there is one of its name at its port, add the parameters to that effect."""
        if not wanted:
            return
        for k, old in enumerate(self.effects):
            if (old.name, old.at) == (effect.name, effect.at):
                self.effects[k] = old.replace(**{n: v + effect.values[n] for n, v in old.values.items()})
                return
        self.effects.append(effect)

    def _tendons(self) -> None:
        """Enter fixed tendons over hub and arm at the arm; refuse other tendons that act on the joints."""
        names = {j.name for j in (self.hub, self.arm) if j is not None}
        for group in self.file.root.findall("tendon"):
            for element in group:
                shares = {
                    j.get("joint"): self.file.number(dict(j.attrib), "coef", 1.0)
                    for j in element.findall("joint")
                }
                attributes = self.file.attributes_of(element, None, "tendon")
                keys = ("stiffness", "damping", "frictionloss", "armature")
                k, d, level, inertia = (self.file.number(attributes, n) for n in keys)
                if element.tag == "spatial" or (names & set(shares) and not set(shares) <= names):
                    self.unable(f"the tendon {one_line(attributes.get('name', ''))!r}", "tendon")
                    continue
                if not names & set(shares) or not any((k, d, level, inertia)):
                    continue
                own = tuple(shares.get(j.name, 0.0) for j in (self.hub, self.arm) if j is not None)
                rest = self.file.numbers(attributes, "springlength", None, np.zeros(1))
                if own != (1.0, self.side) or (k and np.any(rest)):
                    self.unable(f"the tendon {one_line(attributes.get('name', ''))!r}", "tendon")
                    continue
                self._join(Spring(at="arm", stiffness=k), bool(k))
                self._join(Viscous(at="arm", coefficient=d), bool(d))
                self._join(Coulomb(at="arm", level=level), bool(level))
                self._join(Inertia(at="arm", inertia=inertia), bool(inertia))

    def _equalities(self) -> None:
        names = {j.name for j in (self.hub, self.arm) if j is not None}
        for group in self.file.root.findall("equality"):
            for element in group.findall("joint"):
                if {element.get("joint1"), element.get("joint2")} & names:
                    self.unable("an equality that holds the joint", "equality")

    # -- the actuator ------------------------------------------------------------------------------

    def _drive(self, damping: float) -> float:
        """Adds the drive of the joint; returns the damping of the joint that the drive does not include."""
        mine: list[ET.Element] = []
        names = {j.name for j in (self.hub, self.arm) if j is not None}
        fixed = self.file.root.findall("tendon/fixed")
        tied = {t.get("name") for t in fixed if names & {j.get("joint") for j in t.findall("joint")}} - {None}
        for group in self.file.root.findall("actuator"):
            for element in group:
                attributes = self.file.attributes_of(element, None, "general")
                at = attributes.get("joint", attributes.get("jointinparent"))
                mine += [element] if at == self.hub.name else []
                if attributes.get("tendon") in tied:
                    self.unable(
                        f"an actuator at the tendon {one_line(str(attributes['tendon']))!r}", "actuator"
                    )
                if at in names and at != self.hub.name:
                    self.unable(
                        f"an actuator at the joint {one_line(str(at))!r}, behind the first", "actuator"
                    )
        if not mine or (len(mine) > 1 and "actuator" not in self.ignore):
            at = one_line(self.hub.name)
            raise InputError(
                f"{one_line(self.file.path)} has {len(mine)} actuators at the joint {at!r}, but one must "
                "drive it, from which the input follows; leave one there."
            )
        return self._actuator(mine[0], damping)

    def _actuator(self, element: ET.Element, damping: float) -> float:
        file, kind = self.file, element.tag
        known = ("motor", "general", "position", "velocity", "dcmotor")
        # MuJoCo keeps one set of defaults for all actuators; gains belong to one kind of actuator.
        every = file.attributes_of(element, None, *known)
        attributes = file.attributes_of(element, None, "general") | {
            n: every[n] for n in _OF_ALL_KINDS & set(every)
        }
        if kind == "general" and {"kp", "kv"} & set(every):
            self.unable("defaults of another kind for a <general> actuator", "actuator law")
        gear = float(file.numbers(attributes, "gear", None, np.ones(1))[0])
        if kind not in known:
            self.unable(f"an actuator <{one_line(kind)}>", "kind of actuator")
        if kind == "dcmotor":
            self._direct_current(attributes, gear)
            return damping
        for name in ("armature", "damping", "delay", "dampratio", "inheritrange"):
            if any(x not in ("0", "0.0") for x in attributes.get(name, "0").split()):
                self.unable(f"{name} at its actuator", name)
        gain, constant, at_position, at_speed, time = self._law(kind, attributes)
        self._filter(time)
        if constant and gain:
            self.effects.append(VoltageOffset(offset=constant / gain))
        torque, stiffness, brake = gear * gain, -at_position * gear**2, -at_speed * gear**2
        if stiffness:
            return self._position_loop(attributes, gear, torque, stiffness, brake, damping)
        self._limits(attributes, gain, bool(brake or constant or time > 0))
        if brake and torque > 0:
            self.effects.append(
                Motor(
                    at=self.port,
                    torque_constant=torque,
                    back_emf=brake / torque,
                    resistance=1.0,
                    gear_ratio=1.0,
                )
            )
            return damping
        self.effects.append(CurrentDrive(at=self.port, gain=self._forwards(torque)))
        return damping + brake

    def _forwards(self, torque: float) -> float:
        if torque == 0:
            self.unable("an actuator whose control gives no force", "gain of zero")
        if torque < 0:
            self.unable("an actuator whose positive control turns backwards", "negative gain")
        return torque

    def _law(self, kind: str, attributes: dict[str, str]) -> tuple[float, float, float, float, float]:
        """Gain, constant, coefficients of position and speed, and time constant of an actuator's force."""
        file = self.file
        if kind == "position":
            stiffness = file.number(attributes, "kp", 1.0)
            damping, time = file.number(attributes, "kv"), file.number(attributes, "timeconst")
            return stiffness, 0.0, -stiffness, -damping, time
        if kind == "velocity":
            return file.number(attributes, "kv", 1.0), 0.0, 0.0, -file.number(attributes, "kv", 1.0), 0.0
        if kind == "motor":
            return 1.0, 0.0, 0.0, 0.0, 0.0
        gains = file.numbers(attributes, "gainprm", None, np.ones(1))
        kind_of_gain, dynamics = attributes.get("gaintype", "fixed"), attributes.get("dyntype", "none")
        if kind_of_gain != "fixed" or dynamics not in ("none", "filter", "filterexact"):
            self.unable(f"an actuator of gaintype {kind_of_gain}, dyntype {dynamics}", "actuator law")
        bias = np.zeros(3)
        if attributes.get("biastype", "none") == "affine":
            given = file.numbers(attributes, "biasprm", None, np.zeros(3))[:3]
            bias[: len(given)] = given
        elif attributes.get("biastype", "none") != "none":
            self.unable(f"an actuator of biastype {one_line(attributes['biastype'])}", "actuator law")
        if bias[2] > 0 and bias[1] == -gains[0]:
            self.unable("an actuator with a damping ratio (a positive third biasprm)", "dampratio")
        time = float(file.numbers(attributes, "dynprm", None, np.ones(1))[0]) if dynamics != "none" else 0.0
        return float(gains[0]), float(bias[0]), float(bias[1]), float(bias[2]), time

    def _filter(self, time: float) -> None:
        if time > 0:
            self.effects.append(Lag(time=time))

    def _range(self, attributes: dict[str, str], name: str) -> float:
        """Half of a symmetric range; infinite if there is no range, or if it is left out."""
        ends = self.file.numbers(attributes, name, 2)
        if ends is None or attributes.get(name.replace("range", "limited"), "auto") == "false":
            return math.inf
        if ends[0] != -ends[1] or ends[1] <= 0:
            self.unable(f"an asymmetric {name} of {ends[0]:g} to {ends[1]:g}", name)
            return math.inf
        return float(ends[1]) if name not in self.ignore else math.inf

    def _limits(self, attributes: dict[str, str], gain: float, other: bool) -> None:
        """Enter the limits of control and force as one limit of the input; refuse one of an `other` force."""
        limit, force = self._range(attributes, "ctrlrange"), self._range(attributes, "forcerange")
        if math.isfinite(force) and other:
            self.unable(
                "a forcerange at an actuator with damping, a filter or a constant of its own", "forcerange"
            )
        elif math.isfinite(force) and gain:
            limit = min(limit, force / abs(gain))
        if math.isfinite(limit):
            self.effects.insert(0, Saturation(limit=limit))

    def _position_loop(
        self,
        attributes: dict[str, str],
        gear: float,
        torque: float,
        stiffness: float,
        brake: float,
        damping: float,
    ) -> float:
        """A position loop: linear, or a servo that includes the joint's damping if its force is limited."""
        if stiffness < 0 or torque <= 0:
            self.unable("an actuator that pushes away from its goal", "actuator law")
        self.input_unit = "m" if self.hub.slides else "rad"
        force = self._range(attributes, "forcerange") * abs(gear)
        if math.isinf(force):
            self.effects += [
                CurrentDrive(at=self.port, gain=torque),
                Spring(at=self.port, stiffness=stiffness),
            ]
            return damping + brake
        if abs(torque - stiffness) > 1e-9 * stiffness:
            self.unable("a forcerange at a position loop with a gear or an offset", "forcerange")
        constant = math.sqrt(damping) if damping > 0 else _NO_BRAKE
        self.effects.append(
            PositionServo(
                at=self.port,
                gain=1.0,
                gain_scale=stiffness / force,
                limit=1.0,
                supply=force / constant,
                period=max(-2 * brake / stiffness, 0.0),
                torque_constant=constant,
                resistance=1.0,
                derivative=brake / force if brake > 0 else None,
            )
        )
        return min(damping, 0.0)

    def _direct_current(self, attributes: dict[str, str], gear: float) -> None:
        file = self.file
        for name in (
            "cogging",
            "controller",
            "input",
            "lugre",
            "nominal",
            "saturation",
            "thermal",
            "armature",
            "damping",
        ):
            if name in attributes and attributes[name] != "voltage":
                self.unable(f"{name} at its dcmotor", name)
        both = file.numbers(attributes, "motorconst", None, np.zeros(1))
        constant = math.sqrt(float(both[0] * both[-1])) if np.all(both > 0) else 0.0
        resistance = file.number(attributes, "resistance")
        if not (constant > 0 and resistance > 0):
            raise file.error("has a dcmotor without motorconst and resistance above zero", "write both")
        inductance = float(file.numbers(attributes, "inductance", None, np.zeros(1))[0])
        limit = self._range(attributes, "ctrlrange")
        if math.isfinite(limit):
            self.effects.insert(0, Saturation(limit=limit))
        self.effects.append(
            Motor(
                at=self.port,
                torque_constant=constant,
                back_emf=constant,
                resistance=resistance,
                gear_ratio=self._forwards(gear),
                inductance=inductance or None,
            )
        )
