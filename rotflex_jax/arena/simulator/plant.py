r"""The rotary flexible joint, simulated in 20 us steps with true sticking.

Hub angle `theta`, arm angle relative to the hub `alpha`. In the absolute speeds
``w = (theta', theta' + alpha')`` the inertia is diagonal,

.. math::
    J_h \dot w_1 = g\, v + f_{hub} - f_{joint}, \qquad
    J_a \dot w_2 = f_{arm} + f_{joint}, \qquad g = \eta k_t K_g / R_m,

and the torque at each of the three ports follows the laws of `simulator.tables`. The voltage passes
`simulator.voltage` before it reaches the motor. The back-EMF is a damper of ``g k_m K_g`` at the hub, or at
the rotor while play in the gear (`simulator.gear`) separates rotor and hub.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotflex_jax.arena.simulator.compiled import compiled
from rotflex_jax.arena.simulator.friction import rough
from rotflex_jax.arena.simulator.gear import ROTOR_SHARE, geared_step
from rotflex_jax.arena.simulator.motion import (
    ALPHA,
    HEAT,
    MEMORY,
    MODES,
    R_ANGLE,
    R_SPEED,
    THETA,
    W_ARM,
    W_HUB,
    Space,
    step,
)
from rotflex_jax.arena.simulator.tables import GEAR_PLAY, HUB, JOINT, STIFFNESS, VISCOUS, Laws, Tables, Values
from rotflex_jax.arena.simulator.voltage import supply

STEP = 20e-6
"""Length of one integration step [s]."""


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


class Course(NamedTuple):
    """All states of the plant; every row belongs to the start of a sample.

    Attributes:
        motion: ``theta, alpha, theta', alpha'``, ``(N, 4)``.
        rotor: angle and speed of the rotor, ``(N, 2)``; without play in the gear equal to those of the hub.
        heat: relative rise of the armature's resistance, ``(N,)``.
        modes: angle and speed of the oscillators at hub and arm, ``(N, 4)``.
        memory: normalised hysteretic torques in the order of their rows, ``(N, rows)``.
    """

    motion: Values
    rotor: Values
    heat: Values
    modes: Values
    memory: Values


@compiled
def working_space():
    """Work arrays of `simulator.motion.step`; friction impulses are zero."""
    return Space(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


@compiled
def sample(x, new, side, drive, first, h, tables, space):
    """Advances the state `x` over one sample.

    Args:
        x: state at the start; receives the state at the end.
        new: work array of the same size and content.
        side: contact of the gear, as in `simulator.gear.geared_step`.
        drive: torque of the cold motor at rest in every step of the sample.
        first: number of the first step of the sample, from which the time is computed.
        h: length of a step [s].
        tables: `simulator.tables.Tables`.
        space: `simulator.motion.Space`.

    Returns:
        `side` at the end.
    """
    play = tables.motor[GEAR_PLAY] > 0
    for i in range(drive.size):
        t = (first + i) * h
        if play:
            side = geared_step(x, new, side, drive[i], t, h, tables, space)
        else:
            step(x, new, drive[i], t + 0.5 * h, h, True, tables, space)
            x[:] = new
    return side


@compiled
def run(drive, h, tables, start, first):
    """States at the start of every sample.

    Args:
        drive: torque of the cold motor at rest, ``(N, substeps)``.
        h: length of a step [s].
        tables: `simulator.tables.Tables`.
        start: whole state at the first sample.
        first: number of the first step, from which the time is computed.
    """
    N, substeps = drive.shape
    x, new = start.copy(), start.copy()
    out = np.empty((N, x.size))
    space, side = working_space(), 0
    for k in range(N):
        out[k] = x
        side = sample(x, new, side, drive[k], first + k * substeps, h, tables, space)
    return out


def tables_of(plant: Plant, laws: Laws) -> Tables:
    """Constants and laws in the form that the compiled loops use."""
    emf = plant.torque_per_volt * plant.k_m * plant.K_g
    free = laws.torque.copy()
    free[JOINT, VISCOUS] += plant.B_joint
    free[JOINT, STIFFNESS] += plant.K
    engaged = free.copy()
    engaged[HUB, VISCOUS] += plant.B_hub + emf
    free[HUB, VISCOUS] += plant.B_hub
    J = np.array([plant.J_hub, plant.J_arm, ROTOR_SHARE * plant.J_hub])
    return Tables(J, emf, engaged, free, rough(free), laws.hysteresis, laws.modes, laws.motor)


def state_of(laws: Laws, start: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)) -> Values:
    """Whole state with these angles and speeds; the other states are as at the start of `course`."""
    x = np.zeros(MEMORY + len(laws.hysteresis))
    theta, alpha, hub, joint = start
    arm = hub + joint
    x[[THETA, ALPHA, W_HUB, W_ARM]] = theta, alpha, hub, arm
    x[[R_ANGLE, R_SPEED]] = theta, hub
    x[MODES:MEMORY] = theta, hub, theta + alpha, arm
    return x


def course_of(states: Values) -> Course:
    """States of `run` by name."""
    motion = states[:, [THETA, ALPHA, W_HUB, W_ARM]]
    motion[:, 3] -= motion[:, 2]
    return Course(
        motion,
        states[:, [R_ANGLE, R_SPEED]],
        states[:, HEAT],
        states[:, MODES:MEMORY],
        states[:, MEMORY:],
    )


def course(
    plant: Plant,
    laws: Laws,
    u: Values,
    Ts: float,
    start: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    step: float = STEP,
) -> Course:
    """Motion and internal states of the joint under a voltage that is held between samples.

    At the start the motor is cold, hysteretic torques are zero, oscillators move with their port, and the
    rotor has the speed of the hub and is in the middle of its play.

    Args:
        plant: physical constants.
        laws: effects in addition to these constants.
        u: voltage [V], ``(N,)``; sample `k` is held from ``k Ts`` to ``(k + 1) Ts``.
        Ts: sampling period [s].
        start: angles [rad] and speeds [rad/s] at the first sample.
        step: longest integration step [s].
    """
    substeps = max(1, round(Ts / step))
    h = Ts / substeps
    path = supply(np.ascontiguousarray(u, dtype=np.float64), laws.volts, substeps, h)
    return course_of(run(plant.torque_per_volt * path, h, tables_of(plant, laws), state_of(laws, start), 0))


def simulate(
    plant: Plant,
    laws: Laws,
    u: Values,
    Ts: float,
    start: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    step: float = STEP,
) -> Values:
    """``theta, alpha, theta', alpha'`` at the samples, ``(N, 4)``; arguments as in `course`."""
    return course(plant, laws, u, Ts, start, step).motion
