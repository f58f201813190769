"""Export of a model to MuJoCo (MJCF): bodies, joints, tendons for other ports, actuators, sensors."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError, optional
from rotflex_jax.export.certificate import Exported, Subject, in_comment
from rotflex_jax.export.joint_chain import (
    LEAST_INERTIA,
    Chain,
    Drive,
    Place,
    Vector,
    body_of,
    described as number,
    joint_of,
    mass_and_lever,
)
from rotflex_jax.joints.servos import FREE_FALL
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.text.numbers import one_line

LONGEST_STEP = 1e-4
"""Largest time step in a file [s]: larger steps are less accurate with dry friction."""

# Parameters of dry friction, a soft constraint in MuJoCo: the hardest ones that its solver tolerates.
_HARD = "0.9999 0.9999 0.001"


def to_mjcf(
    model: Mechanism | Model,
    Ts: float = 0.002,
    name: str = "machine",
    u: Real[np.ndarray, " N"] | Sequence[float] | None = None,
) -> Exported:
    """A model as an MJCF file for MuJoCo, with its certificate.

        joints: damping, frictionloss, stiffness, armature;  motor: torque = gain u + bias_speed speed

    Each coordinate becomes a joint with a body, and the joints form a chain about one axis. The inertia that
    a motor turns becomes `armature` of its joint. Ports that are combinations of joints (the arm against the
    ground) become fixed tendons. A motor becomes a `general` actuator with its back-EMF, or a `dcmotor` if it
    has an inductance. A servo becomes a `general` actuator with a limited force, whose input is the goal.
    Effects that MuJoCo cannot represent are left out, or approximated by Coulomb friction of a constant
    level; the certificate lists them.

    Args:
        model: Mechanism with its parameter values, or a Model; its joints turn or slide.
        Ts: Sampling period of the certificate's input [s]; it is a multiple of the time step in the file.
        name: Name of the machine.
        u: Input of the certificate; None for three sines with rests.

    Returns:
        The text of the file, with the certificate, which the file contains as a comment. Without the package
        mujoco nothing is simulated, and the certificate gives the reason.

    Raises:
        InputError: The machine neither turns nor slides; `name` is no name, `Ts` no sampling period, or `u`
            no signal.

    Source: MuJoCo documentation, XML reference; E. Todorov, Convex and analytically-invertible dynamics with
    contacts and constraints, 2014, for friction as a constraint.
    """
    subject, name = Subject.of(model, Ts, u).of_motion(), machine_name(name)
    chain = Chain.of(subject.mechanism, "MJCF")
    tree = _mujoco(subject.mechanism, chain, name, subject.Ts)
    text = _written(tree)
    by, why_not, y = "", "", None
    try:
        by = f"MuJoCo {optional('mujoco', 'A certificate of MJCF').__version__}"
        y = run_in_mujoco(text, subject.u, subject.Ts)
    except InputError as missing:
        why_not = str(missing)
    except ValueError as error:  # an earlier version of MuJoCo lacks some elements
        why_not = f"{by} does not read the file: {one_line(str(error))[:200]}"
    certificate = subject.certificate("MJCF", by, y, chain.left_out, chain.approximated, why_not)
    tree.insert(0, ET.Comment(in_comment(str(certificate))))
    return Exported(_written(tree), certificate)


def run_in_mujoco(
    text: str, u: Real[np.ndarray, " N"] | Sequence[float], Ts: float
) -> Float[np.ndarray, "N C"]:
    """Readings of the sensors of an MJCF file, simulated in MuJoCo from rest.

    Args:
        text: Text of the file.
        u: Input of every actuator, held over each sample.
        Ts: Sampling period [s], a multiple of the file's time step.

    Raises:
        InputError: MuJoCo is not installed.
    """
    mujoco = optional("mujoco", "A run in MuJoCo")
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    steps = max(round(Ts / m.opt.timestep), 1)
    y = np.zeros((len(u), m.nsensordata))
    # A lag starts in its steady state for the first command.
    d.act[:] = u[0] if m.na and m.actuator_dyntype[0] == mujoco.mjtDyn.mjDYN_FILTEREXACT else 0.0
    for k, value in enumerate(u):
        d.ctrl[:] = value
        mujoco.mj_step(m, d)
        y[k] = d.sensordata  # MuJoCo evaluates sensors at the start of the step
        for _ in range(steps - 1):
            mujoco.mj_step(m, d)
    return y


def machine_name(name: Any) -> str:
    """The name of a machine on one line, checked.

    Raises:
        InputError: The name is no text, or an empty one.
    """
    if isinstance(name, str) and name.strip():
        return one_line(name)
    raise InputError(f"A machine needs a name, but {shown(name)} was given; give for instance 'joint'.")


def _written(tree: ET.Element) -> str:
    ET.indent(tree)
    return ET.tostring(tree, encoding="unicode") + "\n"


def _element(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, tag, {k: one_line(v) for k, v in attributes.items() if v})


def _nonzero(**values: float) -> dict[str, str]:
    return {k: number(v) for k, v in values.items() if v}


def _mujoco(mechanism: Mechanism, chain: Chain, name: str, Ts: float) -> ET.Element:
    h = Ts / max(10, math.ceil(Ts / LONGEST_STEP - 1e-9))
    hard = {"solreffriction": f"{number(2 * h)} 1", "solimpfriction": _HARD}
    turns = mechanism.units.motion == "rad"
    root = ET.Element("mujoco", {"model": name})
    _element(root, "compiler", angle="radian", autolimits="true")
    weighty = any(any(p.gravity) for p in chain.places.values())
    fall = f"0 0 {number(-FREE_FALL)}" if weighty else "0 0 0"
    _element(root, "option", timestep=number(h), integrator="implicitfast", gravity=fall)
    body = _element(root, "worldbody")
    joints, bodies = shares(mechanism, chain, armature=turns)
    least = min((p.inertia for p in chain.places.values() if p.inertia), default=1.0)
    tendons = {v: p for v, p in chain.places.items() if joint_of(v) is None and any(v)}
    for k, coordinate in enumerate(mechanism.coordinates):
        body = _element(body, "body", name=f"{coordinate} body")
        at, (inertia, gravity) = joints.get(k, Place(coordinate)), bodies[k]
        axis = {"type": "hinge", "axis": "0 1 0"} if turns else {"type": "slide", "axis": "1 0 0"}
        acting = _nonzero(stiffness=at.stiffness, damping=at.damping, armature=at.inertia)
        acting |= _nonzero(frictionloss=at.friction) | hard if at.friction else {}
        _element(body, "joint", name=coordinate, **axis, **acting)
        mass, x, z = mass_and_lever(inertia or LEAST_INERTIA * least, gravity, FREE_FALL)
        own = (inertia or LEAST_INERTIA * least) / (2 if any(gravity) else 1)
        place = f"{number(x)} 0 {number(z)}"
        _element(body, "inertial", pos=place, mass=number(mass), diaginertia=" ".join([number(own)] * 3))
    names = _tendons(root, mechanism, chain, tendons, hard)
    actuators = _element(root, "actuator") if chain.drives else root
    for drive in chain.drives:
        _actuator(actuators, mechanism, drive, chain, names)
    sensors = _element(root, "sensor")
    for channel, (port, _) in mechanism.outputs:
        vector = tuple(map(float, mechanism.port_vectors[port]))
        kind = "pos" if mechanism.quantity(channel).is_position else "vel"
        j = joint_of(vector)
        on = {"joint": mechanism.coordinates[j]} if j is not None else {"tendon": names[vector]}
        _element(sensors, next(iter(on)) + kind, name=channel, **on)
    return root


def shares(
    mechanism: Mechanism, chain: Chain, armature: bool
) -> tuple[dict[int, Place], list[tuple[float, tuple[float, float]]]]:
    """Index of a joint -> effects at the joint, and (inertia, weight) of each body.

    An inertia that a motor turns belongs to its joint (armature) unless it has a weight. An inertia at a port
    that is a joint and no body belongs to the joint too. A weight needs a body with an inertia; a weight
    without one is removed from the chain and added to its `left_out`.

    Args:
        mechanism: The machine.
        chain: The machine as a chain of joints.
        armature: Whether a joint may have the inertia that a motor turns. In MuJoCo a sliding joint should
            not: its friction becomes too soft if the body has almost no mass.
    """
    driven = {d.vector for d in chain.drives}
    joints: dict[int, Place] = {}
    bodies = [(0.0, (0.0, 0.0))] * len(mechanism.coordinates)
    for vector, place in chain.places.items():
        j, b = joint_of(vector), body_of(vector)
        if any(place.gravity) and (b is None or not place.inertia):
            chain.left_out.append(
                f"gravity torque at {place.name} (gravity): no body with an inertia turns with that port"
            )
            place.gravity = (0.0, 0.0)
        in_body = b is not None and (j is None or any(place.gravity) or vector not in driven or not armature)
        if b is not None and in_body:
            bodies[b] = (place.inertia, place.gravity)
        if j is not None:
            copy = Place(place.name, 0.0 if in_body else place.inertia, place.stiffness, place.damping)
            copy.friction = place.friction
            joints[j] = copy
    return joints, bodies


def _tendons(
    root: ET.Element,
    mechanism: Mechanism,
    chain: Chain,
    places: dict[Vector, Place],
    hard: dict[str, str],
) -> dict[Vector, str]:
    """Adds fixed tendons for ports that are combinations of joints; returns vector -> name of its tendon."""
    measured = {tuple(map(float, mechanism.port_vectors[port])) for _, (port, _) in mechanism.outputs}
    needed = [d.vector for d in chain.drives] + sorted(measured)
    names: dict[Vector, str] = {}
    group: ET.Element | None = None
    for vector in dict.fromkeys([*places, *needed]):
        if joint_of(vector) is not None:
            continue
        place = places.get(vector, Place(_port_name(mechanism, vector)))
        acting = _nonzero(stiffness=place.stiffness, damping=place.damping)
        acting |= _nonzero(armature=0.0 if body_of(vector) is not None else place.inertia)
        acting |= _nonzero(frictionloss=place.friction) | hard if place.friction else {}
        if not acting and vector not in needed:
            continue
        group = _element(root, "tendon") if group is None else group
        rest = {"springlength": "0"} if place.stiffness else {}
        tendon = _element(group, "fixed", name=place.name, **rest, **acting)
        for coordinate, share in zip(mechanism.coordinates, vector, strict=True):
            if share:
                _element(tendon, "joint", joint=coordinate, coef=number(share))
        names[vector] = place.name
    return names


def _port_name(mechanism: Mechanism, vector: Vector) -> str:
    return next(n for n, v in mechanism.port_vectors.items() if tuple(map(float, v)) == vector)


def _actuator(
    parent: ET.Element, mechanism: Mechanism, drive: Drive, chain: Chain, names: dict[Vector, str]
) -> None:
    j = joint_of(drive.vector)
    on = {"joint": mechanism.coordinates[j]} if j is not None else {"tendon": names[drive.vector]}
    limit = chain.input_limit
    clip = {"ctrlrange": f"{number(-limit)} {number(limit)}"} if math.isfinite(limit) else {}
    if drive.coil is not None and drive.coil[1] > 0 and drive.coil[0] > 0:
        # MuJoCo has one motor constant: it is the back-EMF constant here, and resistance and inductance are
        # scaled to keep the torque.
        gain, emf, resistance, inductance = drive.coil
        electric = {"resistance": resistance * emf / gain, "inductance": inductance * emf / gain}
        motor = {k: number(v) for k, v in electric.items()}
        _element(parent, "dcmotor", name=drive.name, **on, motorconst=number(emf), **motor, **clip)
        return
    # With exactly the negative gain at the position, MuJoCo would read a positive third number as a damping
    # ratio.
    bias = [drive.constant, drive.at_position * (1 + 1e-12), drive.at_speed]
    law = {"gaintype": "fixed", "gainprm": number(drive.gain)}
    if any(bias):
        law |= {"biastype": "affine", "biasprm": " ".join(map(number, bias))}
    time = drive.coil[3] / drive.coil[2] if drive.coil is not None else chain.lag
    if time:
        law |= {"dyntype": "filterexact", "dynprm": number(time)}
    if math.isfinite(drive.limit):
        law["forcerange"] = f"{number(-drive.limit)} {number(drive.limit)}"
    _element(parent, "general", name=drive.name, **on, **law, **clip)


def safe_identifier(name: str) -> str:
    """A name with letters, digits and underscores only, for programs that allow no other characters.

    >>> safe_identifier("2 fast; int")
    '_2_fast__int'
    """
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"
