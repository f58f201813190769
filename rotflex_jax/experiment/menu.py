"""The standard inputs that an experiment is chosen from, each at several bandwidths and within the limits."""

import dataclasses

import numpy as np

from rotflex_jax.data import excitation
from rotflex_jax.experiment.limits import Limits

# Peak of Gaussian noise over its deviation, where it is clipped; crest factor left to a multisine.
CLIPPED, CREST = 2.5, 1.7
# Amplitudes at which the best are tried again, as shares of what the limits allow.
SHARES = (0.5, 0.25)


@dataclasses.dataclass(frozen=True)
class Standard:
    """One standard input.

    Attributes:
        kind: Name in `rotflex_jax.data.excitation`.
        setting: What was chosen for it, in words.
        u: Voltage (N,) [V].
    """

    kind: str
    setting: str
    u: np.ndarray


def standard_inputs(N: int, Ts: float, limits: Limits) -> list[Standard]:
    """Every standard input as large as voltage and slew allow, at several bandwidths.

    Args:
        N: Samples.
        Ts: Sampling period [s].
        limits: Of the machine.
    """
    V, top, out = limits.voltage, 0.4 / Ts, []

    def offer(kind: str, setting: str, u: np.ndarray) -> None:
        # A constant part would only carry the machine away.
        out.append(Standard(kind, setting, limits.playable(u - u.mean(), Ts)))

    for corner in (2.0, 5.0, 15.0):
        offer("noise", f"{corner:g} Hz", excitation.noise(N, Ts, rms=V / CLIPPED, bandwidth=corner, seed=1))
    for high in (6.0, 12.0, 30.0):
        band = (max(0.1, 1 / (N * Ts)), min(high, top))
        offer(
            "multisine", f"to {band[1]:g} Hz", excitation.multisine(N, Ts, band=band, rms=V / CREST, seed=1)
        )
        offer("sweep", f"to {band[1]:g} Hz", excitation.sweep(N, Ts, band=band, amplitude=V))
    for hold in (0.1, 0.05, 0.02, 0.01):
        held = max(hold, Ts)
        offer("prbs", f"held {1e3 * held:g} ms", excitation.prbs(N, Ts, amplitude=V, hold=held, seed=1))
    for hold in ((0.15, 0.8), (0.05, 0.3), (0.02, 0.1)):
        words = f"held {1e3 * hold[0]:g} to {1e3 * hold[1]:g} ms"
        offer("steps", words, excitation.steps(N, Ts, amplitude=V, hold=hold, seed=1))
    return out
