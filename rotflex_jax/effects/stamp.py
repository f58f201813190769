"""What a linear effect adds to the equations of motion."""

from typing import NamedTuple

import jax

Scalar = jax.Array | float


class Stamp(NamedTuple):
    """What a linear effect writes into the equations of motion at its port `p`.

    `M += inertia p p'`, `D += damping p p'`, `K += stiffness p p'`, torque `drive voltage` at `p`.
    A linear effect with states `z` of its own adds `z' = own z + from_speed p.dq + from_voltage v`
    (lists of length m, `own` m by m) and the torque `torque . z` at `p`.
    """

    inertia: Scalar = 0.0
    damping: Scalar = 0.0
    stiffness: Scalar = 0.0
    drive: Scalar = 0.0
    own: tuple[tuple[Scalar, ...], ...] = ()
    from_speed: tuple[Scalar, ...] = ()
    from_voltage: tuple[Scalar, ...] = ()
    torque: tuple[Scalar, ...] = ()
