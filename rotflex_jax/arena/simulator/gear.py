"""Play between motor and hub: two inertias that are either in contact or apart.

The rotor pushes the hub at one end of the play or at the other, and never pulls it. The impact is inelastic:
afterwards both have the same speed, which conserves their momentum.

Source: F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts (1996), chapter 6,
for the two states of a contact and what ends them.
"""

from __future__ import annotations

import numpy as np

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.motion import R_ANGLE, R_SPEED, ROTOR, THETA, W_HUB, step
from rotflex_jax.arena.simulator.tables import GEAR_PLAY, HUB

ROTOR_SHARE = 0.8
"""Share of the rotor in the inertia of the hub."""

# Largest number of contacts and releases within one integration step; more than two come from rounding.
CHANGES = 6


@compiled
def touch(gap, rate, end_rate, wall, h):
    """Time at which a gap reaches a wall that it has passed by the end of a step.

    The acceleration of the gap is constant over the step, as in the midpoint rule.
    """
    a, distance = (end_rate - rate) / (2 * h), wall - gap
    root = np.sqrt(max(rate * rate + 4 * a * distance, 0.0))
    # This form of the solution has no cancellation: `way` is the sign of the motion towards the wall.
    way = 1.0 if distance > 0 or (distance == 0 and wall > 0) else -1.0
    below = rate + way * root
    if way * below <= 0.0:
        return 0.0
    return min(max(2 * distance / below, 0.0), h)


@compiled
def geared_step(x, new, side, drive, t, h, tables, space):
    """A step with play in the gear.

    Args:
        x: state at the start; receives the state at the end.
        new: work array of the same size.
        side: 1 if the rotor is ahead and touches, -1 if it is behind and touches, 0 if apart.
        drive: torque of the cold motor at rest [N m].
        t: time at the start [s].
        h: length of the step [s].
        tables: `simulator.tables.Tables`.
        space: `simulator.motion.Space`.

    Returns:
        `side` at the end.
    """
    half = 0.5 * tables.motor[GEAR_PLAY]
    share = tables.J[ROTOR] / tables.J[HUB]
    left = h
    for change in range(CHANGES):
        last = change == CHANGES - 1
        if side != 0:
            carried = step(x, new, drive, t + 0.5 * left, left, True, tables, space)
            if side * carried >= 0.0 or last:
                x[:] = new
                return side
            side = 0
        step(x, new, drive, t + 0.5 * left, left, False, tables, space)
        gap = new[R_ANGLE] - new[THETA]
        if abs(gap) <= half:
            x[:] = new
            return 0
        side = 1 if gap > 0 else -1
        rate, end_rate = x[R_SPEED] - x[W_HUB], new[R_SPEED] - new[W_HUB]
        part = touch(x[R_ANGLE] - x[THETA], rate, end_rate, side * half, left)
        if part > 0.0:
            step(x, new, drive, t + 0.5 * part, part, False, tables, space)
            x[:] = new
        x[R_ANGLE] = x[THETA] + side * half
        x[W_HUB] = share * x[R_SPEED] + (1 - share) * x[W_HUB]
        x[R_SPEED] = x[W_HUB]
        t += part
        left -= part
        if left <= 0.0:
            return side
    return side
