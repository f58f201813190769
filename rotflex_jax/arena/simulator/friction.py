"""Dry friction as a set-valued law: a port stays at rest while a torque within the interval can hold it.

Source: J. J. Moreau, Unilateral contact and dry friction (1988).
"""

from __future__ import annotations

import numpy as np

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.tables import (
    ARM,
    FRICTION_MINUS,
    FRICTION_PLUS,
    HUB,
    JOINT,
    PATCHY,
    PATCHY_SHARE,
    STRIBECK,
    STRIBECK_SPEED,
    Values,
)

# Largest number of sweeps of the contact solver; the slowest case (all three ports stuck) needs about 100.
SWEEPS = 1000


def rough(c: Values) -> bool:
    """Whether any port has dry friction."""
    return bool(c[:, [*range(FRICTION_PLUS, STRIBECK + 1), PATCHY]].any())


@compiled
def interval(c, z, s, h, low, high):
    """Friction impulses that each port allows over a step, at positions `z` and speeds `s`."""
    for p in range(3):
        peak = 0.0
        if c[p, STRIBECK] != 0.0:
            peak = c[p, STRIBECK] * np.exp(-((s[p] / c[p, STRIBECK_SPEED]) ** 2))
        if c[p, PATCHY] != 0.0:
            peak += c[p, PATCHY] * (1 + c[p, PATCHY_SHARE] * np.sin(3 * z[p]))
        low[p] = -h * (c[p, FRICTION_PLUS] + peak)
        high[p] = h * (c[p, FRICTION_MINUS] + peak)


@compiled
def stick_or_slip(w1, w2, low, high, impulse, J_hub, J_arm):
    """Friction impulses of one step and the speeds after them, by projected Gauss-Seidel.

    At every port the impulse stops the motion if the interval [low, high] allows it; otherwise it is the end
    of the interval that opposes the motion. `impulse` holds the initial guess and receives the result.
    """
    w1 += (impulse[HUB] - impulse[JOINT]) / J_hub
    w2 += (impulse[ARM] + impulse[JOINT]) / J_arm
    reduced = J_hub * J_arm / (J_hub + J_arm)
    tolerance = 1e-14 * (high - low).max()
    for _ in range(SWEEPS):
        change = 0.0
        j = min(max(impulse[HUB] - J_hub * w1, low[HUB]), high[HUB])
        w1 += (j - impulse[HUB]) / J_hub
        change = max(change, abs(j - impulse[HUB]))
        impulse[HUB] = j
        j = min(max(impulse[ARM] - J_arm * w2, low[ARM]), high[ARM])
        w2 += (j - impulse[ARM]) / J_arm
        change = max(change, abs(j - impulse[ARM]))
        impulse[ARM] = j
        j = min(max(impulse[JOINT] - reduced * (w2 - w1), low[JOINT]), high[JOINT])
        w1 -= (j - impulse[JOINT]) / J_hub
        w2 += (j - impulse[JOINT]) / J_arm
        change = max(change, abs(j - impulse[JOINT]))
        impulse[JOINT] = j
        if change <= tolerance:
            break
    # Stuck means at rest, not at 1e-17 rad/s: rounding must not let a stuck port creep.
    hub_stuck = low[HUB] < impulse[HUB] < high[HUB]
    arm_stuck = low[ARM] < impulse[ARM] < high[ARM]
    joint_stuck = low[JOINT] < impulse[JOINT] < high[JOINT]
    if hub_stuck or (joint_stuck and arm_stuck):
        w1 = 0.0
    if arm_stuck:
        w2 = 0.0
    elif joint_stuck:
        w2 = w1
    return w1, w2
