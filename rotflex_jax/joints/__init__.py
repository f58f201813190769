"""Ready-made mechanisms: flexible joints, a flexible link, servos, public machines; import from MJCF."""

from rotflex_jax.joints.flexible_link import flexible_link
from rotflex_jax.joints.mjcf import load_mjcf
from rotflex_jax.joints.public_machines import (
    emps,
    rotary_arm,
    silverbox,
    single_inertia,
    two_dof_link,
    two_stage_link,
)
from rotflex_jax.joints.rotary_flexible import (
    SPRINGS,
    SpringType,
    arm_inertia,
    flexible_joint,
    hub_inertia,
    paper,
    quanser_2002,
    quanser_2010,
    spring_settings,
    spring_stiffness,
)
from rotflex_jax.joints.servos import position_servo, servo, sts3215, xl330_pendulum

__all__ = [
    "paper",
    "quanser_2002",
    "quanser_2010",
    "flexible_joint",
    "flexible_link",
    "single_inertia",
    "emps",
    "silverbox",
    "rotary_arm",
    "two_dof_link",
    "two_stage_link",
    "position_servo",
    "servo",
    "sts3215",
    "xl330_pendulum",
    "load_mjcf",
    "arm_inertia",
    "hub_inertia",
    "spring_stiffness",
    "spring_settings",
    "SPRINGS",
    "SpringType",
]
