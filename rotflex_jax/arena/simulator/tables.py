r"""Effects on the plant in addition to its constants: tables of coefficients, without effects by default.

The torque at every port depends on the position ``z`` and the speed ``s`` of this port,

.. math::
    f = -(B + D|s|)\, s - K\, d(z) - (K_2 + K_3 z)\, z^2 - G \sin(z + \phi) - C \sin(n z + \psi)
        - F(z, s)\,\mathrm{Sgn}(s), \quad
    F = F_\pm + E\, e^{-(s/s_0)^2} + P\,(1 + r \sin 3z),

where ``Sgn(0)`` is the whole interval [-1, 1] and ``d`` is the deflection of the linear spring without its
play, ``d(z) = z - clip(z, -p, p)``. A law with states of its own is a row of `Laws.hysteresis` or
`Laws.modes`. A new law needs one more column here and one more term in `simulator.torques`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, "..."]
"""Array of numbers; the docstrings give the shapes."""

HUB, ARM, JOINT = 0, 1, 2
PORTS = {"hub": HUB, "arm": ARM, "joint": JOINT}

# Columns of the torque table, one row per port, in the order of the equation above.
VISCOUS, DRAG, STIFFNESS, QUADRATIC, CUBIC, GRAVITY, PHASE = 0, 1, 2, 3, 4, 5, 6
FRICTION_PLUS, FRICTION_MINUS, STRIBECK, STRIBECK_SPEED = 7, 8, 9, 10
COGGING, COGGING_PHASE, PERIODS, PLAY = 11, 12, 13, 14
# The catalogue of the package does not contain these: friction that depends on the angle, a stiffness that
# grows linearly with time, a torque that is a sine of time (a periodic disturbance acts on the voltage).
PATCHY, PATCHY_SHARE, DRIFT, SHAKE, SHAKE_RATE = 15, 16, 17, 18, 19
# Nor this one: a torque ``P exp(-((z - c) / w)^2)`` that acts around one position only.
PUSH, PUSH_AT, PUSH_WIDTH = 20, 21, 22
LAWS = 23

# Entries of the voltage table, in the order in which they act on the voltage.
LIMIT, OFFSET, DEAD_PLUS, DEAD_MINUS, DELAY, LAG = 0, 1, 2, 3, 4, 5
VOLTAGES = 6

# Columns of the hysteresis table (`simulator.torques.build_up`) and of the table of oscillators.
AT, LEVEL, WIDTH, BETA, RISE, RISE_SPEED, DAMPING, FADING = 0, 1, 2, 3, 4, 5, 6, 7
HYSTERESIS = 8
MASS, RATE, LOSS = 0, 1, 2

# Entries of the motor table.
HEAT_RATE, COOLING, GEAR_PLAY, WEAKENING, WEAKENING_SPEED = 0, 1, 2, 3, 4
MOTOR = 5

# Columns of the sensor table, one row per channel.
BIAS, GAIN_ERROR, CUBIC_ERROR, BACKWARD_LOSS = 0, 1, 2, 3
CHANNELS = {"theta": 0, "alpha": 1}


def _no_limits() -> Values:
    volts = np.zeros(VOLTAGES)
    volts[LIMIT] = np.inf
    return volts


@dataclass(frozen=True)
class Laws:
    """All effects on the plant in addition to its constants; none by default.

    Args:
        torque: coefficients of the torque laws, ``(3, LAWS)``.
        volts: coefficients of the voltage path, ``(VOLTAGES,)``.
        hysteresis: hysteretic torques, one row for each, ``(n, HYSTERESIS)``.
        modes: inertia [kg m^2], angular frequency [rad/s] and damping ratio of an oscillator at the hub and
            of one at the arm, ``(2, 3)``.
        motor: coefficients of motor and gear, ``(MOTOR,)``.
        sensors: errors of the two sensors, ``(2, 4)``.
    """

    torque: Values = field(default_factory=lambda: np.zeros((3, LAWS)))
    volts: Values = field(default_factory=_no_limits)
    hysteresis: Values = field(default_factory=lambda: np.zeros((0, HYSTERESIS)))
    modes: Values = field(default_factory=lambda: np.zeros((2, 3)))
    motor: Values = field(default_factory=lambda: np.zeros(MOTOR))
    sensors: Values = field(default_factory=lambda: np.zeros((2, 4)))


class Tables(NamedTuple):
    """Constants and laws in the form that the compiled loop uses.

    Attributes:
        J: inertia of the hub (rotor of the motor included), of the arm, and of the rotor [kg m^2].
        emf: damping by the back-EMF: decrease of the motor torque per speed [N m s/rad].
        engaged: torque table, the plant's constants included, for hub and rotor in contact.
        free: torque table for hub and rotor apart: the back-EMF acts on the rotor, not on the hub.
        dry: whether any port has dry friction.
        hysteresis: as in `Laws`.
        modes: as in `Laws`.
        motor: as in `Laws`.
    """

    J: Values
    emf: float
    engaged: Values
    free: Values
    dry: bool
    hysteresis: Values
    modes: Values
    motor: Values
