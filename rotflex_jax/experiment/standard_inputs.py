"""Limits of a machine, and standard inputs within these limits from which an experiment is chosen."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.checks import number, real, shown
from rotflex_jax.data import excitation
from rotflex_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits that an experiment must not exceed.

    The limits on voltage and slew rate hold exactly. Travel and deflection are predicted by the models, so a
    margin is kept; if the models are wrong, the machine may still exceed these limits.

    Args:
        voltage: Largest |u| [V].
        slew: Largest change of the voltage per second [V/s].
        travel: Largest distance of the first channel, the servo angle, from its start [rad].
        deflection: Largest distance of the second channel, the deflection of the arm, from its start [rad].
        margin: Share of travel and deflection that is reserved for errors of the models.

    >>> Limits(voltage=5.0, deflection=0.17).outputs(2)
    array([  inf, 0.153])
    """

    voltage: float
    slew: float = math.inf
    travel: float = math.inf
    deflection: float = math.inf
    margin: float = 0.1

    def __post_init__(self) -> None:
        for name, unit in (("voltage", "V"), ("slew", "V/s"), ("travel", "rad"), ("deflection", "rad")):
            value = real(getattr(self, name))
            if not value > 0 or (name == "voltage" and not math.isfinite(value)):
                raise InputError(
                    f"The limit `{name}` was given as {shown(getattr(self, name))}, but needs a positive "
                    f"number in {unit}; give what the machine bears."
                )
        number(self.margin, "margin", least=0, below=1, example="0.1")

    def outputs(self, channels: int) -> Float[np.ndarray, " C"]:
        """Largest |output| of each channel, less the margin."""
        known = np.array([self.travel, self.deflection])[:channels] * (1 - self.margin)
        return np.concatenate([known, np.full(channels - len(known), np.inf)])

    def playable(self, u: Float[np.ndarray, " N"], Ts: float, start: float = 0.0) -> Float[np.ndarray, " N"]:
        """The voltage within the limits on voltage and slew rate; unchanged if it is within them already.

        The voltage is clipped. The result is the mean of the largest signal below it and the smallest signal
        above it that change no faster than allowed (the envelopes of Pasch and Hausdorff). It can follow the
        voltage `start`, and 0 V can follow it.

        Args:
            u: Voltage [V].
            Ts: Sampling period [s].
            start: Voltage of the sample before, limited to one step from 0 V [V].
        """
        return self.playable_with_sources(u, Ts, start)[0]

    def playable_with_sources(
        self, u: Float[np.ndarray, " N"], Ts: float, start: float = 0.0
    ) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """`playable(u)`, and for each sample the two samples of `u` that determine it, each by a half."""
        N = len(u)
        inside = np.clip(u, -self.voltage, self.voltage)
        if not math.isfinite(self.slew):
            k = np.arange(N)
            return inside, k, k
        step = self.slew * Ts * (1 - 1e-12)
        # A start further from 0 V counts as one step from it, so that a scaled-down input can follow it.
        start = min(max(start, -step), step)
        begins, ends = step * np.arange(1, N + 1), step * np.arange(N, 0, -1)
        inside = np.clip(inside, np.maximum(start - begins, -ends), np.minimum(start + begins, ends))
        low, low_source = _lower_envelope(inside, step)
        high, high_source = _lower_envelope(-inside, step)
        return (low - high) / 2, low_source, high_source


def checked_limits(limits: Any) -> Limits:
    """The limits, checked.

    Raises:
        InputError: The argument is no `Limits`.
    """
    if not isinstance(limits, Limits):
        raise InputError(
            f"Argument `limits` must be Limits(voltage=...), but is {shown(limits)}; give what the "
            "machine bears."
        )
    return limits


def _lower_envelope(u: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """min_j u[j] + step |k - j| for every k, and the j of this minimum."""
    k = np.arange(len(u))
    after, j = _running_minimum(u - step * k)
    before, i = _running_minimum((u + step * k)[::-1])
    before, i = before[::-1], len(u) - 1 - i[::-1]
    first, second = after + step * k, before - step * k
    return np.minimum(first, second), np.where(first <= second, j, i)


def _running_minimum(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Running minimum, and the index at which it was reached."""
    least = np.minimum.accumulate(x)
    new = np.concatenate([[True], x[1:] < least[:-1]])
    return least, np.maximum.accumulate(np.where(new, np.arange(len(x)), 0))


# Crest factors (peak over root mean square) of Gaussian noise, which is clipped there, and of a multisine.
NOISE_CREST, MULTISINE_CREST = 2.5, 1.7
# Amplitudes at which the best inputs are rated again, as shares of the amplitude within the limits.
REDUCED_AMPLITUDES = (0.5, 0.25)


@dataclasses.dataclass(frozen=True, eq=False)
class StandardInput:
    """One standard input.

    Attributes:
        kind: Name in `rotflex_jax.data.excitation`.
        setting: Parameters of the input in words.
        u: Voltage [V].
    """

    kind: str
    setting: str
    u: Float[np.ndarray, " N"]


def standard_inputs(
    N: int,
    Ts: float,
    limits: Limits,
    *,
    corners: tuple[float, ...] = (2.0, 5.0, 15.0),
    highs: tuple[float, ...] = (6.0, 12.0, 30.0),
    lowest: float = 0.1,
    seed: int = 1,
    start: float = 0.0,
) -> list[StandardInput]:
    """All standard inputs at several bandwidths, as large as the limits on voltage and slew rate allow.

    Args:
        N: Number of samples.
        Ts: Sampling period [s].
        limits: Limits of the machine.
        corners: Corner frequencies of noise [Hz].
        highs: Highest frequencies of multisines and sweeps [Hz].
        lowest: Their lowest frequency [Hz]; higher if less than one period is within N samples.
        seed: Seed of random numbers.
        start: Voltage of the sample before [V].
    """
    V, top, low, out = limits.voltage, 0.4 / Ts, max(lowest, 1 / (N * Ts)), []

    def add(kind: str, setting: str, u: np.ndarray) -> None:
        # A constant part would only make the machine drift.
        out.append(StandardInput(kind, setting, limits.playable(u - u.mean(), Ts, start)))

    for corner in corners:
        u = excitation.noise(N, Ts, rms=V / NOISE_CREST, bandwidth=corner, seed=seed)
        add("noise", f"{corner:g} Hz", u)
    for high in highs:
        band = (low, max(2 * low, min(high, top)))
        setting = f"to {band[1]:g} Hz"
        u = excitation.multisine(N, Ts, band=band, rms=V / MULTISINE_CREST, seed=seed)
        add("multisine", setting, u)
        add("sweep", setting, excitation.sweep(N, Ts, band=band, amplitude=V))
    for hold in (0.1, 0.05, 0.02, 0.01):
        held = max(hold, Ts)
        add("prbs", f"held {1e3 * held:g} ms", excitation.prbs(N, Ts, amplitude=V, hold=held, seed=seed))
    for hold in ((0.15, 0.8), (0.05, 0.3), (0.02, 0.1)):
        setting = f"held {1e3 * hold[0]:g} to {1e3 * hold[1]:g} ms"
        add("steps", setting, excitation.steps(N, Ts, amplitude=V, hold=hold, seed=seed))
    return out
