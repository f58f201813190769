"""Public machines: EMPS, the Silverbox, a rotary arm, a serial flexible link, a single inertia."""

import dataclasses
import math
from types import MappingProxyType

from rotflex_jax.checks import instance, known_arguments
from rotflex_jax.effects import CurrentDrive, Inertia, MeasuredDisturbance, Motor, Spring, Viscous
from rotflex_jax.effects.base import Effect, driven_place
from rotflex_jax.errors import InputError
from rotflex_jax.joints.rotary_flexible import PORTS, flexible_joint
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Units


@known_arguments
def single_inertia(
    inertia: float = 0.0021,
    *,
    motor: Motor | None = None,
    damping: float = 0.0,
    channel: str = "theta",
    port: str = "hub",
) -> Mechanism:
    """A single inertia with a motor, viscous damping and one output.

        inertia theta'' = motor - damping theta'

    All parameters of the motor are trusted; inertia and damping are free. A linear axis obeys the same
    equation: read kg for kg m^2, N for N m and m for rad, and give its force per volt as the torque
    constant of a motor with `back_emf=0, resistance=1, gear_ratio=1`.

    Args:
        inertia: Inertia [kg m^2].
        motor: Motor with its gear; None for the motor of the SRV02 as listed in the paper.
        damping: Viscous damping in addition to that of the motor [N m s/rad].
        channel: Name of the output.
        port: Name of the port.

    Returns:
        Mechanism with one coordinate that has the name of the output.

    Source: Newton 1687.

    >>> axis = single_inertia(95.1, motor=Motor(torque_constant=35.15, back_emf=0.0, resistance=1.0,
    ...     gear_ratio=1.0), damping=203.5, channel="position", port="axis")
    >>> axis.free_names
    ('axis.inertia.inertia', 'axis.viscous.coefficient')
    """
    if motor is not None:
        instance(motor, Motor, "motor", "give rotflex_jax.effects.Motor('hub', ...)")
    motor = dataclasses.replace(motor or Motor(), at=port)
    return Mechanism(
        coordinates=(channel,),
        ports={port: (1.0,)},
        effects=(
            Inertia(at=port, inertia=inertia),
            motor,
            Viscous(at=port, coefficient=damping),
        ),
        outputs={channel: port},
        trusted=tuple(f"{port}.motor.{name}" for name in motor.values),
    )


FORCE_PER_VOLT = 35.15065188248547
"""Force on the carriage per volt of command [N/V], as given with the recordings."""


@known_arguments
def emps(mass: float = 80.0, *, damping: float = 100.0, gain: float = FORCE_PER_VOLT) -> Mechanism:
    """A linear axis with a mass, viscous damping, a force proportional to the voltage, and one output.

        mass x'' = gain v - damping x'

    The gain is trusted; mass and damping are free. Dry friction is left for a search to find.

    Args:
        mass: Mass of carriage, screw and rotor together, reflected to the carriage [kg].
        damping: Viscous damping [N s/m].
        gain: Force per volt [N/V].

    Returns:
        Mechanism with the output `position` [m] and the port `axis`.

    Source: Janot, Gautier and Brunot 2019, Data set and reference models of EMPS, equation 1 without
        friction and offset.

    >>> emps().free_names
    ('axis.inertia.inertia', 'axis.viscous.coefficient')
    >>> [s.unit for s in emps().parameter_specifications]
    ['kg', 'N/V', 'N s/m']
    """
    return Mechanism(
        coordinates=("position",),
        ports={"axis": (1.0,)},
        effects=(
            Inertia(at="axis", inertia=mass),
            CurrentDrive(at="axis", gain=gain),
            Viscous(at="axis", coefficient=damping),
        ),
        outputs={"position": "axis"},
        trusted=("axis.current_drive.gain",),
        units=Units("m", "N", motion_size=0.1, effort_size=1000.0),
    )


@known_arguments
def silverbox(frequency: float = 60.0, *, damping_ratio: float = 0.1, stiffness: float = 1.0) -> Mechanism:
    """A mass on a spring with a damper, from voltage to voltage.

        mass y'' + damping y' + stiffness y = v

    The output in volts stands for the position and the input for the force, so the gain is one and
    trusted; mass, damping and stiffness are free. The input of the public recordings is smooth between
    its samples: simulate with `Exponential(substeps=4, between="smooth")`.

    Args:
        frequency: Start value of the resonance frequency [Hz].
        damping_ratio: Start value of the damping ratio.
        stiffness: Start value of the stiffness, the input per output at rest.

    Returns:
        Mechanism with the output `output` [V] and the port `joint`.

    Source: Wigren and Schoukens 2013, section on the Silverbox, without the cubic spring.

    >>> silverbox().free_names
    ('joint.inertia.inertia', 'joint.viscous.coefficient', 'joint.spring.stiffness')
    >>> [s.unit for s in silverbox().parameter_specifications]
    ['s^2', '', 's', '']
    """
    w = 2 * math.pi * frequency
    return Mechanism(
        coordinates=("output",),
        ports={"joint": (1.0,)},
        effects=(
            Inertia(at="joint", inertia=stiffness / w**2),
            CurrentDrive(at="joint", gain=1.0),
            Viscous(at="joint", coefficient=2 * damping_ratio * stiffness / w),
            Spring(at="joint", stiffness=stiffness),
        ),
        outputs={"output": "joint"},
        trusted=("joint.current_drive.gain",),
        units=Units("V", "V", motion_size=0.1, effort_size=0.1),
    )


GEAR_RATIO, TORQUE_CONSTANT, RESISTANCE = 48.4, 0.0107, 3.29
"""Turns of the motor per turn of the arm, torque per current [N m/A] and armature resistance [ohm]."""


@known_arguments
def rotary_arm(flexible: bool = False, *, arm_inertia: float = 0.004, stiffness: float = 1.0) -> Mechanism:
    """The rotary arm of a student laboratory with its constants; all parameters of the motor are trusted.

    The rigid arm is one inertia with the output `theta`. The flexible arm is a hub and an arm on a spring,
    with the outputs `theta` and `alpha`, the angle of the tip relative to the hub. For the flexible arm the
    laboratory gives the inertia of the hub; the inertia of the arm and the stiffness are guesses. All three
    are free.

    Args:
        flexible: True for the flexible arm, False for the rigid arm.
        arm_inertia: Start value of the inertia of the flexible arm [kg m^2].
        stiffness: Start value of the stiffness of the flexible arm [N m/rad].

    Returns:
        Mechanism with the ports of `single_inertia` or of a flexible joint.

    Source: Constants of the laboratory, ASEN 2003, laboratory 6, 2017.

    >>> rotary_arm().free_names
    ('hub.inertia.inertia', 'hub.viscous.coefficient')
    >>> rotary_arm(flexible=True).free_names[:3]
    ('hub.inertia.inertia', 'arm.inertia.inertia', 'joint.spring.stiffness')
    """
    motor = Motor(
        at="hub",
        torque_constant=TORQUE_CONSTANT,
        back_emf=TORQUE_CONSTANT,
        resistance=RESISTANCE,
        gear_ratio=GEAR_RATIO,
    )
    if not flexible:
        return single_inertia(0.0035, motor=motor)
    joint = flexible_joint(hub_inertia=0.002, arm_inertia=arm_inertia, stiffness=stiffness, motor=motor)
    return joint.release("arm.inertia.inertia").trust("hub.motor.torque_constant")


TWO_DOF_LINK = MappingProxyType(
    {
        1: MappingProxyType(
            {
                "hub_inertia": 0.06353616,
                "arm_inertia": 0.17043427,
                "stiffness": 39.957193,
                "torque_per_current": 8.925,
                "hub_damping": 4.0,
                "joint_damping": 0.0,
            }
        ),
        2: MappingProxyType(
            {
                "hub_inertia": 0.00301955,
                "arm_inertia": 0.0064387,
                "stiffness": 6.857751,
                "torque_per_current": 0.87,
                "hub_damping": 1.5,
                "joint_damping": 0.085608,
            }
        ),
    }
)
"""Constants of the laboratory by stage: J11, J12, Ks1, Ktg1, B11, B12 and those of stage 2, in SI units."""


@known_arguments
def two_dof_link(stage: int = 1) -> Mechanism:
    """One stage of the serial flexible link alone: a flexible joint driven by a current.

        hub_inertia theta'' + arm_inertia (theta'' + alpha'') = torque_per_current i - hub_damping theta'
        arm_inertia (theta'' + alpha'') = -stiffness alpha - joint_damping alpha'

    The torque per current and the inertia of the arm are trusted: while friction holds the hub, the motion
    shows the frequency of the link but hardly the inertia of the arm, and a fit may assign all inertia to the
    hub. The other parameters are free and start at the constants of the laboratory. Among these constants the
    damping of the hubs is larger than in the recordings, and the dry friction of the gears is missing.
    Stage 2 is mounted on the end of link 1, whose motion is not part of this model; recordings have its
    acceleration as a signal (`effects.MeasuredDisturbance`). `two_stage_link` is a model of both stages.

    Args:
        stage: 1, which carries stage 2, or 2.

    Returns:
        Mechanism with the ports of a flexible joint and the outputs `theta` and `alpha`; its input is
        a current [A], so that the gain of the drive is in N m/A.

    Source: Constants of the laboratory in lqr_full_10deg.mat; Quanser, 2-DOF serial flexible link,
        reference manual, 2011.

    >>> two_dof_link(2).free_names[:2]
    ('hub.inertia.inertia', 'joint.spring.stiffness')
    """
    if stage not in TWO_DOF_LINK:
        raise InputError(f"The machine has the stages 1 and 2, but stage={stage!r} was given; choose one.")
    constants = TWO_DOF_LINK[stage]
    return Mechanism(
        coordinates=("theta", "alpha"),
        ports=PORTS,
        effects=(
            Inertia(at="hub", inertia=constants["hub_inertia"]),
            Inertia(at="arm", inertia=constants["arm_inertia"]),
            Spring(at="joint", stiffness=constants["stiffness"]),
            CurrentDrive(at="hub", gain=constants["torque_per_current"]),
            Viscous(at="hub", coefficient=constants["hub_damping"]),
            Viscous(at="joint", coefficient=constants["joint_damping"]),
        ),
        outputs={"theta": "hub", "alpha": "joint"},
        trusted=("hub.current_drive.gain", "arm.inertia.inertia"),
        units=Units(input="A"),
    )


SECOND_CURRENT = "current of motor 2 [A]"
"""Signal that drives the second stage of `two_stage_link`."""


@known_arguments
def two_stage_link() -> Mechanism:
    """Both stages of the serial flexible link in one mechanism: two currents, four coordinates, four outputs.

        theta1, alpha1    angle of hub 1, deflection of link 1
        theta2, alpha2    angle of hub 2, deflection of link 2, relative to the end of link 1

    With the angles `beta1 = theta1 + alpha1` and `beta2 = beta1 + theta2 + alpha2` of the links, twice the
    kinetic energy is

        J11 theta1'^2 + J12 beta1'^2 + J21 theta2'^2 + J22 beta2'^2 + m (L beta1' + l beta2')^2

    for small angles between the links. The centre of mass of link 2 is at `l`, half the length of link 2, and
    link 2 is mounted on the end of link 1, which has the length `L = 2 l`. `m l^2` is the inertia at the port
    `mass2` with the position `2 beta1 + beta2`.

    The first current is the input, the second current a signal of the recording. The torques per current and
    the inertia of arm 1 are trusted. Start values are the constants of the laboratory for each stage alone.
    Three quarters of the inertia of link 2 are at `mass2`, as for a uniform beam, and the inertia of arm 1 is
    reduced so that the sum stays the same.

    Source: Constants of the laboratory in lqr_full_10deg.mat; Quanser, 2-DOF serial flexible link, reference
        manual, 2011.

    >>> two_stage_link().channels
    ('theta1', 'alpha1', 'theta2', 'alpha2')
    """
    first, second = TWO_DOF_LINK[1], TWO_DOF_LINK[2]
    ports = {
        "hub1": (1, 0, 0, 0),
        "joint1": (0, 1, 0, 0),
        "arm1": (1, 1, 0, 0),
        "hub2": (0, 0, 1, 0),
        "joint2": (0, 0, 0, 1),
        "arm2": (1, 1, 1, 1),
        "mass2": (3, 3, 1, 1),
    }
    at_mass = 0.75 * second["arm_inertia"]
    arms = {1: first["arm_inertia"] - 4 * at_mass, 2: second["arm_inertia"] - at_mass}
    effects: list[Effect] = [CurrentDrive(at="hub1", gain=first["torque_per_current"])]
    for stage, constants in ((1, first), (2, second)):
        effects += [
            Inertia(at=f"hub{stage}", inertia=constants["hub_inertia"]),
            Inertia(at=f"arm{stage}", inertia=arms[stage]),
            Spring(at=f"joint{stage}", stiffness=constants["stiffness"]),
            Viscous(at=f"hub{stage}", coefficient=constants["hub_damping"]),
            Viscous(at=f"joint{stage}", coefficient=constants["joint_damping"]),
        ]
    driven = MeasuredDisturbance(at=driven_place("hub2", SECOND_CURRENT), gain=second["torque_per_current"])
    return Mechanism(
        coordinates=("theta1", "alpha1", "theta2", "alpha2"),
        ports=ports,
        effects=(*effects, Inertia(at="mass2", inertia=at_mass), driven),
        outputs={"theta1": "hub1", "alpha1": "joint1", "theta2": "hub2", "alpha2": "joint2"},
        trusted=("hub1.current_drive.gain", "arm1.inertia.inertia", driven.full_name("gain")),
        units=Units(input="A"),
    )
