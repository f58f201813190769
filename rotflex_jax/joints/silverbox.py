"""The Silverbox: an electronic circuit that moves like a mass on a spring."""

import math

from rotflex_jax.effects import CurrentDrive, Inertia, Spring, Viscous
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.units import Units


def silverbox(frequency: float = 60.0, *, damping_ratio: float = 0.1, stiffness: float = 1.0) -> Mechanism:
    """A mass on a spring with a damper, from voltage to voltage.

        mass y'' + damping y' + stiffness y = v

    The output in volts stands for the position and the input for the force, so the gain is one and
    held; mass, damping and stiffness are free. The input of the public recordings is smooth between
    its samples: simulate with `Exponential(substeps=4, between="smooth")`.

    Args:
        frequency: Of the resonance, where to start [Hz].
        damping_ratio: Where to start.
        stiffness: Input per output at rest, where to start.

    Returns:
        Mechanism with the output `output` [V] and the port `joint`.

    Source: Wigren and Schoukens 2013, section on the Silverbox, less the cubic spring.

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
