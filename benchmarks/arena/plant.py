r"""The rotary flexible joint, simulated in 20 us steps with true sticking.

Hub angle `theta`, arm angle relative to the hub `alpha`. In the absolute speeds
``w = (theta', theta' + alpha')`` the inertia is diagonal,

.. math::
    J_h \dot w_1 = g\, v + f_{hub} - f_{joint}, \qquad
    J_a \dot w_2 = f_{arm} + f_{joint}, \qquad g = \eta k_t K_g / R_m,

and each of the three ports carries one torque law of its own position ``z`` and speed ``s``,

.. math::
    f = -(B + D|s|)\, s - (K + K_2 z + K_3 z^2)\, z - G \sin(z + \phi)
        - F(s)\,\mathrm{Sgn}(s), \qquad
    F(s) = F_\pm + E\, e^{-(s/s_0)^2},

where ``Sgn(0)`` is the whole interval [-1, 1]. The voltage passes limiter, offset and dead zone,
in this order, before it reaches the motor; back-EMF is a damper of ``g k_m K_g`` at the hub.

A law is one row of a small table, a new law is one more column and one more term in `_torque`
(or, for voltages, in `_amplifier`).

Source: G. Capobianco and S. R. Eugster, Time finite element based Moreau-type integrators (2018),
for the implicit midpoint form; J. J. Moreau, Unilateral contact and dry friction (1988).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

STEP = 20e-6
"""Length of one integration step [s]."""

HUB, ARM, JOINT = 0, 1, 2
PORTS = {"hub": HUB, "arm": ARM, "joint": JOINT}

# Columns of the torque table, one row per port, in the order of the equation above.
VISCOUS, DRAG, STIFFNESS, QUADRATIC, CUBIC, GRAVITY, PHASE = 0, 1, 2, 3, 4, 5, 6
FRICTION_PLUS, FRICTION_MINUS, STRIBECK, STRIBECK_SPEED = 7, 8, 9, 10
LAWS = 11

# Entries of the voltage table, in the order in which the voltage meets them.
LIMIT, OFFSET, DEAD_PLUS, DEAD_MINUS = 0, 1, 2, 3
VOLTAGES = 4

# Sweeps of the contact solver; the slowest case (all three ports stuck) needs about 100.
SWEEPS = 1000


@dataclass(frozen=True)
class Plant:
    """Physical constants of the joint.

    Args:
        J_hub: inertia of the hub, motor included [kg m^2].
        J_arm: inertia of the arm about the axis [kg m^2].
        K: stiffness of the joint [N m/rad].
        B_hub: viscous damping of the hub against the table [N m s/rad].
        B_joint: viscous damping between arm and hub [N m s/rad].
        R_m: resistance of the armature [ohm].
        k_t: torque constant of the motor [N m/A].
        k_m: back-EMF constant of the motor [V s/rad].
        K_g: gear ratio [-].
        eta: efficiency of motor and gear [-].
    """

    J_hub: float = 0.0021
    J_arm: float = 0.0059
    K: float = 1.61
    B_hub: float = 0.004
    B_joint: float = 0.003
    R_m: float = 2.6
    k_t: float = 0.00767
    k_m: float = 0.00767
    K_g: float = 70.0
    eta: float = 1.0

    @property
    def torque_per_volt(self) -> float:
        """``g = eta k_t K_g / R_m`` [N m/V]."""
        return self.eta * self.k_t * self.K_g / self.R_m


def _no_limits() -> NDArray[np.float64]:
    volts = np.zeros(VOLTAGES)
    volts[LIMIT] = np.inf
    return volts


@dataclass(frozen=True)
class Laws:
    """Everything that acts on the plant beyond its own constants; nothing by default.

    Args:
        torque: coefficients of the torque laws, ``(3, LAWS)``.
        volts: coefficients of the voltage path, ``(VOLTAGES,)``.
        bias: constant error of the two sensors [rad], ``(2,)``.
    """

    torque: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, LAWS)))
    volts: NDArray[np.float64] = field(default_factory=_no_limits)
    bias: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))


@njit(cache=True)
def _amplifier(u, volts):
    """Voltage at the motor: limiter, then offset, then dead zone."""
    v = min(max(u, -volts[LIMIT]), volts[LIMIT]) + volts[OFFSET]
    if v > volts[DEAD_PLUS]:
        return v - volts[DEAD_PLUS]
    if v < -volts[DEAD_MINUS]:
        return v + volts[DEAD_MINUS]
    return 0.0


@njit(cache=True)
def _torque(c, z, s):
    """Smooth part of one port's law at position `z` and speed `s`."""
    f = -(c[VISCOUS] + c[DRAG] * abs(s)) * s
    f -= (c[STIFFNESS] + (c[QUADRATIC] + c[CUBIC] * z) * z) * z
    if c[GRAVITY] != 0.0:
        f -= c[GRAVITY] * np.sin(z + c[PHASE])
    return f


@njit(cache=True)
def _stick_or_slip(w1, w2, low, high, impulse, J_hub, J_arm):
    """Friction impulses of one step and the speeds they leave, by projected Gauss-Seidel.

    At every port the impulse stops the motion if the interval [low, high] allows it, and sits on
    the end that opposes the motion otherwise. `impulse` holds the guess and receives the answer.
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


@njit(cache=True)
def _run(u, substeps, h, J_hub, J_arm, gain, c, volts, start):
    """States ``(theta, alpha, theta', alpha')`` at the start of every sample."""
    out = np.empty((u.size, 4))
    low, high, impulse = np.zeros(3), np.zeros(3), np.zeros(3)
    rough = (c[:, FRICTION_PLUS : STRIBECK + 1] != 0.0).any()
    theta, alpha = start[0], start[1]
    w1, w2 = start[2], start[2] + start[3]
    for k in range(u.size):
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = theta, alpha, w1, w2 - w1
        drive = gain * _amplifier(u[k], volts)
        for _ in range(substeps):
            n1, n2 = w1, w2
            # Implicit midpoint rule; two passes make it second order and h is far below 1/rate.
            for _ in range(2):
                m1, m2 = 0.5 * (w1 + n1), 0.5 * (w2 + n2)
                a, b = theta + 0.5 * h * m1, alpha + 0.5 * h * (m2 - m1)
                joint = _torque(c[JOINT], b, m2 - m1)
                n1 = w1 + h * (drive + _torque(c[HUB], a, m1) - joint) / J_hub
                n2 = w2 + h * (_torque(c[ARM], a + b, m2) + joint) / J_arm
                if rough:
                    for p in range(3):
                        s = m1 if p == HUB else (m2 if p == ARM else m2 - m1)
                        peak = 0.0
                        if c[p, STRIBECK] != 0.0:
                            peak = c[p, STRIBECK] * np.exp(-((s / c[p, STRIBECK_SPEED]) ** 2))
                        low[p] = -h * (c[p, FRICTION_PLUS] + peak)
                        high[p] = h * (c[p, FRICTION_MINUS] + peak)
                    n1, n2 = _stick_or_slip(n1, n2, low, high, impulse, J_hub, J_arm)
            theta += 0.5 * h * (w1 + n1)
            alpha += 0.5 * h * (w2 + n2 - w1 - n1)
            w1, w2 = n1, n2
    return out


def simulate(
    plant: Plant,
    laws: Laws,
    u: NDArray[np.float64],
    Ts: float,
    start: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    step: float = STEP,
) -> NDArray[np.float64]:
    """Motion of the joint under a voltage that is held between samples.

    Args:
        plant: physical constants.
        laws: what acts besides them.
        u: voltage [V], ``(N,)``; sample `k` is held from ``k Ts`` to ``(k + 1) Ts``.
        Ts: sampling period [s].
        start: angles [rad] and speeds [rad/s] at the first sample.
        step: longest integration step [s].

    Returns:
        ``theta, alpha, theta', alpha'`` at the samples, ``(N, 4)``.
    """
    substeps = max(1, round(Ts / step))
    coefficients = laws.torque.copy()
    gain = plant.torque_per_volt
    coefficients[HUB, VISCOUS] += plant.B_hub + gain * plant.k_m * plant.K_g
    coefficients[JOINT, VISCOUS] += plant.B_joint
    coefficients[JOINT, STIFFNESS] += plant.K
    return _run(
        np.ascontiguousarray(u, dtype=np.float64),
        substeps,
        Ts / substeps,
        plant.J_hub,
        plant.J_arm,
        gain,
        coefficients,
        laws.volts,
        np.asarray(start, dtype=np.float64),
    )
