r"""What acts on the plant besides its own constants: tables of coefficients, empty by default.

Every port carries a torque law of its own position ``z`` and speed ``s``,

.. math::
    f = -(B + D|s|)\, s - K\, d(z) - (K_2 + K_3 z)\, z^2 - G \sin(z + \phi) - C \sin(n z + \psi)
        - F(z, s)\,\mathrm{Sgn}(s), \quad
    F = F_\pm + E\, e^{-(s/s_0)^2} + P\,(1 + r \sin 3z),

where ``Sgn(0)`` is the whole interval [-1, 1] and ``d`` takes the play out of the linear spring,
``d(z) = z - clip(z, -p, p)``. A law with a memory is a row of `Laws.hysteresis` or `Laws.modes`.
A new law is one more column and one more term in `simulator.torques`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, "..."]
"""Numbers whose shape the docstring tells."""

HUB, ARM, JOINT = 0, 1, 2
PORTS = {"hub": HUB, "arm": ARM, "joint": JOINT}

# Columns of the torque table, one row per port, in the order of the equation above.
VISCOUS, DRAG, STIFFNESS, QUADRATIC, CUBIC, GRAVITY, PHASE = 0, 1, 2, 3, 4, 5, 6
FRICTION_PLUS, FRICTION_MINUS, STRIBECK, STRIBECK_SPEED = 7, 8, 9, 10
COGGING, COGGING_PHASE, PERIODS, PLAY = 11, 12, 13, 14
# Of these the package has no exact counterpart: friction that depends on the angle, a stiffness that
# grows in proportion to time, a torque that is a sine of time (a periodic disturbance acts on the voltage).
PATCHY, PATCHY_SHARE, DRIFT, SHAKE, SHAKE_RATE = 15, 16, 17, 18, 19
# Nor for a push ``P exp(-((z - c) / w)^2)`` that is felt around one position only.
PUSH, PUSH_AT, PUSH_WIDTH = 20, 21, 22
LAWS = 23

# Entries of the voltage table, in the order in which the voltage meets them.
LIMIT, OFFSET, DEAD_PLUS, DEAD_MINUS, DELAY, LAG = 0, 1, 2, 3, 4, 5
VOLTAGES = 6

# Columns of the hysteresis table (`simulator.torques.build_up`) and of the oscillators on a port.
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
    """Everything that acts on the plant beyond its own constants; nothing by default.

    Args:
        torque: coefficients of the torque laws, ``(3, LAWS)``.
        volts: coefficients of the voltage path, ``(VOLTAGES,)``.
        hysteresis: torques that build up over an angle, one row each.
        modes: mass, rate and damping ratio of an oscillator at the hub and one at the arm, ``(2, 3)``.
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
    """Constants and laws as the compiled loop reads them.

    Attributes:
        J: inertia of the hub, of the arm, and of the motor's rotor as a part of the hub's [kg m^2].
        emf: motor torque lost per speed [N m s/rad].
        engaged: torque table, the plant's own constants included, hub and rotor being one.
        free: the same without the back-EMF at the hub, which acts on the rotor alone.
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
