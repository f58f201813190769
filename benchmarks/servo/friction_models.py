"""The extended friction models M1 to M6 of servo actuators, and their simulator at the control period.

The machine is a pendulum on a voltage-controlled motor, with the angle q from the lowest point and the goal
delayed by `command_delay`:

    control = supply clip(kp error_gain (goal - q), -1, 1)                            firmware
    motor   = kt / R (control - kt q'),    load = -m g l sin(q + q_offset)
    net     = motor + load
    stop    = J / Ts q' + net                            torque that brings q' to zero within a step
    q''     = (net - sign(stop) min(|stop|, friction + viscous |q'|)) / J,     J = m l^2 + armature

The friction level, with s = exp(-|q' / speed|^exponent), which is 1 at rest and 0 at speed:

    M1  base
    M2  base + s stribeck
    M3  base + load_base |load - motor|
    M4  base + s stribeck + (load_base + s load_stribeck) |load - motor|
    M5  base + s stribeck + |external load - driven motor|
        + s |external_stribeck load - driven_stribeck motor|
    M6  M5 + s (external_quadratic load^2 where |load| < |motor|,
                driven_quadratic motor^2 where |load| > |motor|), only where the two oppose each other

In M5 and M6 friction depends on whether the motor drives the load or the load drives the motor. Steps are
those of the authors' simulator: explicit, one per sample, with friction limited to the torque that stops the
motion. The article specifies the directional and quadratic terms and the exponent only in part; here they are
as in the authors' program.

Source: Duclusaud, Passault, Padois, Ly 2024, Extended friction models for the physics simulation of servo
actuators, arXiv 2410.08650, section III; bounds and simulator as published with it (Rhoban, bam, 2026).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numba
import numpy as np

GRAVITY = 9.80665

# Name -> least and largest value.
MOTOR = {
    "kt": (0.1, 3.0),
    "R": (0.5, 10.0),
    "armature": (1e-4, 0.05),
    "q_offset": (-0.1, 0.1),
    "command_delay": (0.0, 0.05),
    "viscous": (0.0, 1.0),
    "base": (0.0, 0.2),
}
STRIBECK = {"stribeck": (0.0, 0.2), "speed": (0.1, 1.0), "exponent": (1.0, 10.0)}
LOAD = {"load_base": (0.0, 0.5)}
DIRECTIONAL = {"driven": (0.0, 0.5), "external": (0.0, 0.5)}
DIRECTIONAL_STRIBECK = {"driven_stribeck": (0.0, 1.0), "external_stribeck": (0.0, 1.0)}
QUADRATIC = {"driven_quadratic": (0.0, 0.01), "external_quadratic": (0.0, 0.01)}
MODELS: dict[str, dict[str, tuple[float, float]]] = {
    "M1": MOTOR,
    "M2": MOTOR | STRIBECK,
    "M3": MOTOR | LOAD,
    "M4": MOTOR | STRIBECK | LOAD | {"load_stribeck": (0.0, 1.0)},
    "M5": MOTOR | STRIBECK | DIRECTIONAL | DIRECTIONAL_STRIBECK,
    "M6": MOTOR | STRIBECK | DIRECTIONAL | DIRECTIONAL_STRIBECK | QUADRATIC,
}
# All parameters, in the order in which the compiled simulator takes them.
ORDER = (*MOTOR, *STRIBECK, *LOAD, "load_stribeck", *DIRECTIONAL, *DIRECTIONAL_STRIBECK, *QUADRATIC)
# Values of parameters that a model lacks. Without a Stribeck term, its shape must still be finite.
NEUTRAL = dict.fromkeys(ORDER, 0.0) | {"speed": 1.0, "exponent": 1.0}


@dataclasses.dataclass(frozen=True)
class Logs:
    """Recordings as arrays for the simulator; the padding of shorter ones does not count.

    Attributes:
        goal: Goal angle (R, N) [rad].
        angle: Measured angle (R, N) [rad].
        length: Number of samples of each recording (R,).
        slope: Duty per angle error, kp times the error gain (R,) [1/rad].
        supply: Supply voltage (R,) [V].
        start: First angle and speed (R, 2) [rad, rad/s].
        Ts: Period of a simulation step [s].
        load: Torque of the weight with the pendulum horizontal, m g l [N m].
        inertia: Inertia of the pendulum, m l^2 [kg m^2].
    """

    goal: np.ndarray
    angle: np.ndarray
    length: np.ndarray
    slope: np.ndarray
    supply: np.ndarray
    start: np.ndarray
    Ts: float
    load: float
    inertia: float


def _arguments(values: dict[str, float], logs: Logs) -> tuple[Any, ...]:
    """Arguments of the compiled simulator; gain and weight are those of the logs unless `values` has them."""
    slope = np.full_like(logs.slope, values["slope"]) if "slope" in values else logs.slope
    own = dataclasses.replace(logs, slope=slope, load=values.get("load", logs.load))
    arrays = tuple(getattr(own, f.name) for f in dataclasses.fields(own))
    return (flat({n: v for n, v in values.items() if n in NEUTRAL}), *arrays)


def flat(values: dict[str, float]) -> np.ndarray:
    """Parameters in the order of the compiled simulator, with values without effect for absent ones."""
    return np.array([(NEUTRAL | values)[name] for name in ORDER])


def rollouts(values: dict[str, float], logs: Logs) -> np.ndarray:
    """Angles (R, N) of free runs [rad]."""
    return _rollouts(*_arguments(values, logs))


def mean_error(values: dict[str, float], logs: Logs) -> float:
    """Mean absolute error of the angle, averaged over recordings [rad]: the cost of the authors."""
    return float(_mean_error(*_arguments(values, logs)))


@numba.njit(cache=True, fastmath=False)
def _friction(p: Any, motor: float, load: float, speed: float) -> float:
    stribeck, width, exponent, load_base, load_stribeck = p[7], p[8], p[9], p[10], p[11]
    driven, external, driven_s, external_s, driven_q, external_q = p[12], p[13], p[14], p[15], p[16], p[17]
    s = np.exp(-(abs(speed / width) ** exponent))
    gear = abs(load - motor)
    level = p[6] + s * stribeck + (load_base + s * load_stribeck) * gear
    level += abs(external * load - driven * motor) + s * abs(external_s * load - driven_s * motor)
    if np.sign(load) != np.sign(motor):
        if abs(load) < abs(motor):
            level += s * external_q * load * load
        elif abs(load) > abs(motor):
            level += s * driven_q * motor * motor
    return level


@numba.njit(cache=True, fastmath=False)
def _run(p, goal, n, slope, supply, start, Ts, weight, inertia, out):
    kt, R, armature, offset, delay, viscous = p[0], p[1], p[2], p[3], p[4], p[5]
    J = inertia + armature
    q, v = start[0], start[1]
    late = delay / Ts
    whole = int(late)
    part = late - whole
    for k in range(n):
        out[k] = q
        newer, older = max(k - whole, 0), max(k - whole - 1, 0)
        wanted = (1 - part) * goal[newer] + part * goal[older]
        duty = min(max(slope * (wanted - q), -1.0), 1.0)
        motor = kt / R * (supply * duty - kt * v)
        load = -weight * np.sin(q + offset)
        net = motor + load
        stop = J / Ts * v + net
        net -= np.sign(stop) * min(abs(stop), _friction(p, motor, load, v) + viscous * abs(v))
        a = net / J
        v = min(max(v + a * Ts, -100.0), 100.0)
        q += v * Ts + 0.5 * a * Ts * Ts


@numba.njit(cache=True, fastmath=False)
def _rollouts(p, goal, angle, length, slope, supply, start, Ts, weight, inertia):
    out = np.zeros_like(goal)
    for r in range(len(goal)):
        _run(p, goal[r], length[r], slope[r], supply[r], start[r], Ts, weight, inertia, out[r])
    return out


@numba.njit(cache=True, fastmath=False)
def _mean_error(p, goal, angle, length, slope, supply, start, Ts, weight, inertia):
    total = 0.0
    out = np.zeros(goal.shape[1])
    for r in range(len(goal)):
        _run(p, goal[r], length[r], slope[r], supply[r], start[r], Ts, weight, inertia, out)
        error = 0.0
        for k in range(length[r]):
            error += abs(out[k] - angle[r, k])
        total += error / length[r]
    return total / len(goal)
