"""One turning inertia: a servo without a flexible load."""

import dataclasses

from rotflex_jax.effects import Inertia, Motor, Viscous
from rotflex_jax.mechanism import Mechanism


def single_inertia(
    inertia: float = 0.0021,
    *,
    motor: Motor | None = None,
    damping: float = 0.0,
    channel: str = "theta",
    port: str = "hub",
) -> Mechanism:
    """A single inertia with a motor and viscous damping, one output.

        inertia theta'' = motor - damping theta'

    The motor is trusted as a whole, inertia and damping are free. A linear axis obeys the same
    equation: read kg for kg m^2, N for N m and m for rad, and give its force per volt as the torque
    constant of a motor with `back_emf=0, resistance=1, gear_ratio=1`.

    Args:
        inertia: [kg m^2].
        motor: Motor with its gear; None for the SRV02's as the paper lists it.
        damping: Viscous damping beside the motor's own [N m s/rad].
        channel: Name of the output.
        port: Name of the port.

    Returns:
        Mechanism of one coordinate, named as the output.

    Source: Newton 1687.

    >>> axis = single_inertia(95.1, motor=Motor(torque_constant=35.15, back_emf=0.0, resistance=1.0,
    ...     gear_ratio=1.0), damping=203.5, channel="position", port="axis")
    >>> axis.free_names
    ('axis.inertia.inertia', 'axis.viscous.coefficient')
    """
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
