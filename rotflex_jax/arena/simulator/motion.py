"""One integration step of the whole plant, by the implicit midpoint rule.

Source: G. Capobianco and S. R. Eugster, Time finite element based Moreau-type integrators (2018).
"""

from __future__ import annotations

from typing import NamedTuple

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.friction import interval, stick_or_slip
from rotflex_jax.arena.simulator.tables import (
    ARM,
    AT,
    COOLING,
    HEAT_RATE,
    HUB,
    JOINT,
    MASS,
    WEAKENING,
    WEAKENING_SPEED,
    Values,
)
from rotflex_jax.arena.simulator.torques import build_up, of_the_moment, oscillate

ROTOR = 2

# State: angle of the hub, angle of the arm relative to the hub, absolute speeds of both, relative rise of the
# motor resistance, angle and speed of the rotor and of two oscillators; states of hysteretic torques follow.
THETA, ALPHA, W_HUB, W_ARM, HEAT, R_ANGLE, R_SPEED, MODES = 0, 1, 2, 3, 4, 5, 6, 7
MEMORY = 11


class Space(NamedTuple):
    """Work arrays of a step, with one entry per port.

    Attributes:
        z: positions at the middle of the step.
        s: speeds at the middle of the step.
        f: torques.
        low: smallest friction impulse.
        high: largest friction impulse.
        impulse: friction impulse of the last step, which is the initial guess for the next step.
    """

    z: Values
    s: Values
    f: Values
    low: Values
    high: Values
    impulse: Values


@compiled
def motor(drive, speed, heat, h, emf, m):
    """Motor torque, and heating after a step; `drive` is the torque of the cold motor at rest."""
    cold = drive - emf * speed
    torque = cold / (1 + heat)
    if m[HEAT_RATE] != 0.0:
        # Midpoint rule: the torque is taken at the heating in the middle of the step.
        mid = heat
        for _ in range(2):
            torque = cold / (1 + mid)
            mid = (heat + 0.5 * h * m[HEAT_RATE] * cold * torque) / (1 + 0.5 * h * m[COOLING])
        heat, torque = 2 * mid - heat, cold / (1 + mid)
    if m[WEAKENING] != 0.0:
        torque *= 1 - m[WEAKENING] * abs(speed) / (abs(speed) + m[WEAKENING_SPEED])
    return torque, heat


@compiled
def step(x, new, drive, t, h, engaged, tables, space):
    """Writes the state after a step into `new`, and returns the torque that the gear transmits.

    Args:
        x: state at the start.
        new: receives the state at the end.
        drive: torque of the cold motor at rest [N m].
        t: time at the middle of the step [s].
        h: length of the step [s].
        engaged: whether hub and rotor turn together; if not, the rotor turns alone.
        tables: `simulator.tables.Tables`.
        space: `Space`.
    """
    J_arm, J_rotor, m = tables.J[ARM], tables.J[ROTOR], tables.motor
    J_hub = tables.J[HUB] if engaged else tables.J[HUB] - J_rotor
    c = tables.engaged if engaged else tables.free
    z, s, f = space.z, space.s, space.f
    plain = m[HEAT_RATE] == 0.0 and m[WEAKENING] == 0.0
    w1, w2 = x[W_HUB], x[W_ARM]
    n1, n2, at_motor = w1, w2, 0.0
    new[R_SPEED] = x[R_SPEED]
    # Two passes give second order, and `h` is much shorter than every time constant.
    for _ in range(2):
        m1, m2 = 0.5 * (w1 + n1), 0.5 * (w2 + n2)
        a, b = x[THETA] + 0.5 * h * m1, x[ALPHA] + 0.5 * h * (m2 - m1)
        z[HUB], z[ARM], z[JOINT] = a, a + b, b
        s[HUB], s[ARM], s[JOINT] = m1, m2, m2 - m1
        for p in range(3):
            f[p] = of_the_moment(c[p], z[p], s[p], t)
        for i in range(tables.hysteresis.shape[0]):
            row = tables.hysteresis[i]
            p = int(row[AT])
            new[MEMORY + i], torque = build_up(row, x[MEMORY + i], s[p], h)
            f[p] += torque
        for p in range(2):
            if tables.modes[p, MASS] != 0.0:
                k = MODES + 2 * p
                new[k], new[k + 1], torque = oscillate(tables.modes[p], x[k], x[k + 1], z[p], s[p], h)
                f[p] += torque
        if engaged:
            pushed = drive
            if not plain:
                # The torque table contains the back-EMF of the cold motor.
                at_motor, new[HEAT] = motor(drive, m1, x[HEAT], h, tables.emf, m)
                pushed = at_motor + tables.emf * m1
        else:
            pushed = 0.0
            turning = 0.5 * (x[R_SPEED] + new[R_SPEED])
            at_motor, new[HEAT] = motor(drive, turning, x[HEAT], h, tables.emf, m)
            new[R_SPEED] = x[R_SPEED] + h * at_motor / J_rotor
        n1 = w1 + h * (pushed + f[HUB] - f[JOINT]) / J_hub
        n2 = w2 + h * (f[ARM] + f[JOINT]) / J_arm
        if tables.dry:
            interval(c, z, s, h, space.low, space.high)
            n1, n2 = stick_or_slip(n1, n2, space.low, space.high, space.impulse, J_hub, J_arm)
    new[THETA] = x[THETA] + 0.5 * h * (w1 + n1)
    new[ALPHA] = x[ALPHA] + 0.5 * h * (w2 + n2 - w1 - n1)
    new[W_HUB], new[W_ARM] = n1, n2
    if not engaged:
        new[R_ANGLE] = x[R_ANGLE] + 0.5 * h * (x[R_SPEED] + new[R_SPEED])
        return 0.0
    new[R_ANGLE], new[R_SPEED] = x[R_ANGLE] + new[THETA] - x[THETA], n1
    if plain:
        at_motor = drive - tables.emf * 0.5 * (w1 + n1)
    return at_motor - J_rotor * (n1 - w1) / h
