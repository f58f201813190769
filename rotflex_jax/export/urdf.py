"""Export of a model to URDF: links, joints with damping and friction, and a list of what URDF lacks."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.errors import InputError, optional
from rotflex_jax.export.certificate import Exported, Subject, in_comment
from rotflex_jax.export.joint_chain import (
    LEAST_INERTIA,
    Chain,
    body_of,
    described as number,
    joint_of,
    mass_and_lever,
)
from rotflex_jax.export.mjcf import LONGEST_STEP, machine_name, shares
from rotflex_jax.joints.servos import FREE_FALL
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Quantity
from rotflex_jax.models.model import Model
from rotflex_jax.text.numbers import one_line


def to_urdf(
    model: Mechanism | Model,
    Ts: float = 0.002,
    name: str = "machine",
    u: Real[np.ndarray, " N"] | Sequence[float] | None = None,
) -> Exported:
    """A model as a URDF file, with its certificate.

        links: inertia about the axis, weight as a mass off the axis;  joints: damping and friction

    Each coordinate becomes a joint with a link, and the joints form a chain about one axis. A URDF has
    neither motors nor springs. The certificate gives the equation of each motor, so that a user can apply its
    torque as effort of the joint; springs are left out. Not for a flexible joint, therefore, unless the
    simulator adds the spring: use `to_mjcf`.

    Args:
        model: Mechanism with its parameter values, or a Model; its joints turn or slide.
        Ts: Sampling period of the certificate's input [s].
        name: Name of the machine.
        u: Input of the certificate; None for three sines with rests.

    Returns:
        The text of the file, with the certificate, which the file contains as a comment. For the certificate
        MuJoCo simulates the file, with the torques of the motors applied to the joints. Without the package
        mujoco nothing is simulated.

    Raises:
        InputError: The machine neither turns nor slides; `name` is no name, `Ts` no sampling period, or `u`
            no signal.

    Source: ROS, URDF XML specification, link and joint.
    """
    subject, name = Subject.of(model, Ts, u).of_motion(), machine_name(name)
    chain = Chain.of(subject.mechanism, "URDF")
    tree = _robot(subject.mechanism, chain, name)
    text = _written(tree)
    try:
        mujoco = optional("mujoco", "A certificate of URDF")
    except InputError as missing:
        certificate = subject.certificate("URDF", "", None, chain.left_out, chain.approximated, str(missing))
    else:
        version = f"MuJoCo {mujoco.__version__}, with the torques of the motors as efforts,"
        y = _run(text, subject, chain)
        certificate = subject.certificate("URDF", version, y, chain.left_out, chain.approximated)
    tree.insert(0, ET.Comment(in_comment(str(certificate))))
    return Exported(_written(tree), certificate)


def _written(tree: ET.Element) -> str:
    ET.indent(tree)
    return '<?xml version="1.0"?>\n' + ET.tostring(tree, encoding="unicode") + "\n"


def _robot(mechanism: Mechanism, chain: Chain, name: str) -> ET.Element:
    turns = mechanism.units.motion == "rad"
    joints, bodies = shares(mechanism, chain, armature=False)
    _tell_what_is_left_out(mechanism, chain)
    root = ET.Element("robot", {"name": name})
    base = parent = "base"
    ET.SubElement(root, "link", {"name": base})
    least = min((inertia for inertia, _ in bodies if inertia), default=1.0)
    for k, coordinate in enumerate(map(one_line, mechanism.coordinates)):
        inertia, gravity = bodies[k]
        mass, x, z = mass_and_lever(inertia or LEAST_INERTIA * least, gravity, FREE_FALL)
        own = number((inertia or LEAST_INERTIA * least) / (2 if any(gravity) else 1))
        link = ET.SubElement(root, "link", {"name": f"{coordinate} link"})
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", {"xyz": f"{number(x)} 0 {number(z)}", "rpy": "0 0 0"})
        ET.SubElement(inertial, "mass", {"value": number(mass)})
        diagonal = {"ixx": own, "iyy": own, "izz": own}
        ET.SubElement(inertial, "inertia", diagonal | {"ixy": "0", "ixz": "0", "iyz": "0"})
        kind = "continuous" if turns else "prismatic"
        joint = ET.SubElement(root, "joint", {"name": coordinate, "type": kind})
        ET.SubElement(joint, "parent", {"link": parent})
        ET.SubElement(joint, "child", {"link": f"{coordinate} link"})
        ET.SubElement(joint, "axis", {"xyz": "0 1 0" if turns else "1 0 0"})
        if not turns:  # URDF requires limits of a sliding joint; these are never reached
            limits = {"lower": "-1e6", "upper": "1e6", "effort": "1e9", "velocity": "1e6"}
            ET.SubElement(joint, "limit", limits)
        if k in joints and (joints[k].damping or joints[k].friction):
            at = joints[k]
            law = {"damping": number(at.damping), "friction": number(at.friction)}
            ET.SubElement(joint, "dynamics", law)
        parent = f"{coordinate} link"
    return root


def _tell_what_is_left_out(mechanism: Mechanism, chain: Chain) -> None:
    units = mechanism.units
    for drive in chain.drives:
        law = f"{drive.gain:.6g} {one_line(units.input)} input"
        law += "".join(
            f" {f:+.6g} {w}" for f, w in ((drive.at_position, "position"), (drive.at_speed, "speed")) if f
        )
        law += f" {drive.constant:+.6g}" if drive.constant else ""
        law += f", no more than {drive.limit:.6g} either way" if math.isfinite(drive.limit) else ""
        chain.left_out.append(f"motor {drive.name}: apply its effort [{units.effort}] = {law}")
        if drive.coil is not None:
            gain, emf, resistance, inductance = drive.coil
            chain.left_out.append(
                f"motor {drive.name}: current of time constant {inductance / resistance:.3g} s, back-EMF of "
                f"{gain * emf / resistance:.6g} {units.unit('N m s/rad')}"
            )
    if math.isfinite(chain.input_limit):
        chain.left_out.append(
            f"limit of the input: {chain.input_limit:.6g} {one_line(units.input)} either way"
        )
    if chain.lag:
        chain.left_out.append(f"input lag of {chain.lag:.6g} s")
    for vector, place in chain.places.items():
        spring = units.unit("N m/rad")
        if place.stiffness:
            chain.left_out.append(f"spring at {place.name}: {place.stiffness:.6g} {spring}")
        if place.inertia and body_of(vector) is None:
            inertia = f"{place.inertia:.6g} {units.unit('kg m^2')}"
            chain.left_out.append(f"inertia at {place.name}, which is no link: {inertia}")
        if joint_of(vector) is None and (place.damping or place.friction):
            chain.left_out.append(f"damping and friction at {place.name}, which is no joint")


def _run(text: str, subject: Subject, chain: Chain) -> Float[np.ndarray, "N C"]:
    """Outputs of the file in MuJoCo, with the torques of the motors applied to the joints."""
    mujoco = optional("mujoco", "A certificate of URDF")
    m = mujoco.MjModel.from_xml_string(text)
    steps = max(10, int(np.ceil(subject.Ts / LONGEST_STEP - 1e-9)))
    h = m.opt.timestep = subject.Ts / steps
    m.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    m.opt.gravity[:] = (0.0, 0.0, -FREE_FALL)
    if subject.mechanism.units.motion != "rad":
        m.opt.gravity[:] = 0.0
    m.dof_solref[:] = (2 * h, 1.0)
    m.dof_solimp[:, :3] = (0.9999, 0.9999, 0.001)
    d = mujoco.MjData(m)
    q, dq = d.qpos, d.qvel
    rows = np.array(
        [
            Quantity(what).row(tuple(map(float, subject.mechanism.port_vectors[port])))
            for _, (port, what) in subject.mechanism.outputs
        ]
    )
    drives = [(np.array(drive.vector), drive) for drive in chain.drives]
    y = np.zeros((len(subject.u), len(rows)))
    for k, u in enumerate(np.clip(subject.u, -chain.input_limit, chain.input_limit).tolist()):
        y[k] = rows @ np.concatenate([q, dq])
        for _ in range(steps):
            d.qfrc_applied[:] = 0.0
            for p, drive in drives:
                braking = 0.0 if drive.coil is None else -drive.coil[0] * drive.coil[1] / drive.coil[2]
                law = (
                    drive.gain * u
                    + drive.constant
                    + drive.at_position * (p @ q)
                    + (drive.at_speed + braking) * (p @ dq)
                )
                d.qfrc_applied[:] += p * min(max(law, -drive.limit), drive.limit)
            mujoco.mj_step(m, d)
    return y
