"""A geared motor that turns a rigid or a flexible arm, as a student laboratory has it."""

from rotflex_jax.effects import Motor
from rotflex_jax.joints.rotary_flexible import flexible_joint
from rotflex_jax.joints.single_inertia import single_inertia
from rotflex_jax.mechanism import Mechanism

GEAR_RATIO, TORQUE_CONSTANT, RESISTANCE = 48.4, 0.0107, 3.29
"""Turns of the motor per turn of the arm, torque per current [N m/A] and armature resistance [ohm]."""


def rotary_arm(flexible: bool = False, *, arm_inertia: float = 0.004, stiffness: float = 1.0) -> Mechanism:
    """The arm of the laboratory with its constants as a start; the motor is trusted as a whole.

    Rigid, one inertia with the output `theta`. Flexible, a hub and an arm on a spring with the outputs
    `theta` and `alpha`, the angle of the tip against the hub; there the laboratory gives the hub's
    inertia, the arm's and the stiffness are a guess, and all three are free.

    Args:
        flexible: Which of the two arms.
        arm_inertia: Of the flexible arm, where to start [kg m^2].
        stiffness: Of the flexible arm, where to start [N m/rad].

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
