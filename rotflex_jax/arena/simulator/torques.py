"""Torques at the ports: static laws, hysteretic laws and oscillators."""

from __future__ import annotations

import numpy as np

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.tables import (
    BETA,
    COGGING,
    COGGING_PHASE,
    CUBIC,
    DAMPING,
    DRAG,
    DRIFT,
    FADING,
    GRAVITY,
    LEVEL,
    LOSS,
    MASS,
    PERIODS,
    PHASE,
    PLAY,
    PUSH,
    PUSH_AT,
    PUSH_WIDTH,
    QUADRATIC,
    RATE,
    RISE,
    RISE_SPEED,
    SHAKE,
    SHAKE_RATE,
    STIFFNESS,
    VISCOUS,
    WIDTH,
)


@compiled
def of_the_moment(c, z, s, t):
    """Torque at a port without dry friction and hysteresis, at position `z`, speed `s` and time `t`."""
    f = -(c[VISCOUS] + c[DRAG] * abs(s)) * s
    f -= (c[STIFFNESS] + (c[QUADRATIC] + c[CUBIC] * z) * z) * z
    if c[PLAY] != 0.0:
        f += c[STIFFNESS] * min(max(z, -c[PLAY]), c[PLAY])
    if c[GRAVITY] != 0.0:
        f -= c[GRAVITY] * np.sin(z + c[PHASE])
    if c[COGGING] != 0.0:
        f -= c[COGGING] * np.sin(c[PERIODS] * z + c[COGGING_PHASE])
    if c[DRIFT] != 0.0:
        f -= c[STIFFNESS] * c[DRIFT] * t * z
    if c[SHAKE] != 0.0:
        f += c[SHAKE] * np.sin(c[SHAKE_RATE] * t)
    if c[PUSH] != 0.0:
        f += c[PUSH] * np.exp(-(((z - c[PUSH_AT]) / c[PUSH_WIDTH]) ** 2))
    return f


@compiled
def build_up(row, x, s, h):
    r"""State of a hysteretic torque after a step at speed `s`, and the torque in the middle of the step.

    .. math::
        \dot x = \frac{s}{w}\Bigl(1 - |x|\,\frac{\beta\,\mathrm{sgn}(s x) + 1 - \beta}{g(s)}\Bigr)
            - \frac{x}{T}, \quad g = 1 + r e^{-(s/s_0)^2}, \quad
        f = -F x - c\, e^{-(s/s_0)^2}\, w\, \dot x

    With ``beta = 1``, ``r = 0`` and ``c = 0`` this is Dahl's law, with other `r` and `c` LuGre's law, and
    with another ``beta`` the Bouc-Wen law (exponent 1). `FADING` is ``1 / T``, usually zero.
    """
    level, width = row[LEVEL], row[WIDTH]
    g = 1.0
    if row[RISE] != 0.0:
        g += row[RISE] * np.exp(-((s / row[RISE_SPEED]) ** 2))
    # s |x| is |s| x while the torque builds up and -|s| x while it is released.
    part = 1.0 if s * x > 0.0 else 2 * row[BETA] - 1
    rate = part * abs(s) / (width * g) + row[FADING]
    # Midpoint rule of an equation that is linear in x.
    end = (x * (1 - 0.5 * h * rate) + h * s / width) / (1 + 0.5 * h * rate)
    bristles = row[DAMPING] * np.exp(-((s / row[RISE_SPEED]) ** 2))
    return end, -0.5 * level * (x + end) - bristles * width * (end - x) / h


@compiled
def oscillate(mode, r, v, z, s, h):
    """Angle and speed of a mass on a spring after a step, and its torque on the port.

    Args:
        mode: inertia of the mass, angular frequency with the port held fixed, damping ratio.
        r: angle of the mass at the start of the step.
        v: speed of the mass at the start of the step.
        z: angle of the port at the middle of the step.
        s: speed of the port at the middle of the step.
        h: length of the step.
    """
    k, d = mode[RATE] ** 2, 2 * mode[LOSS] * mode[RATE]
    # Midpoint rule, solved for the speed at the middle of the step.
    mid = (v + 0.5 * h * (k * (z - r) + d * s)) / (1 + 0.5 * h * (d + 0.5 * h * k))
    return r + h * mid, 2 * mid - v, -mode[MASS] * 2 * (mid - v) / h
