"""Errors of the sensors, before noise and quantisation."""

from __future__ import annotations

import numpy as np

from rotflex_jax.arena.simulator.tables import BACKWARD_LOSS, BIAS, CUBIC_ERROR, GAIN_ERROR, Values


def read(angles: Values, sensors: Values) -> Values:
    """Readings: gain and cubic error, then a smaller gain for negative values, then a bias.

    Args:
        angles: true angles [rad], ``(N, 2)``.
        sensors: table of `simulator.tables.Laws`, ``(2, 4)``.

    Returns:
        Readings [rad], ``(N, 2)``.
    """
    y = angles * (1 + sensors[:, GAIN_ERROR] + sensors[:, CUBIC_ERROR] * angles**2)
    y = np.where(y < 0, 1 - sensors[:, BACKWARD_LOSS], 1.0) * y
    return y + sensors[:, BIAS]
