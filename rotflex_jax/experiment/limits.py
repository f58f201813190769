"""What the machine may be asked for, and the nearest voltage that asks for no more."""

import dataclasses
import math

import numpy as np

from rotflex_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Limits:
    """What an experiment must not exceed.

    Voltage and slew hold exactly. Travel and deflection are what the models predict, so a share of them is
    kept free; where the models are wrong, the machine may still go further.

    Args:
        voltage: Largest |u| [V].
        slew: Largest change of the voltage per second [V/s].
        travel: Largest |first channel| from its start, the servo angle [rad].
        deflection: Largest |second channel|, the deflection of the arm [rad].
        margin: Share of travel and deflection that stays free for what the models do not know.

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
            value = getattr(self, name)
            if not value > 0 or (name == "voltage" and not math.isfinite(value)):
                raise InputError(
                    f"The limit `{name}` was given as {value:g}, but needs a positive number in {unit}; "
                    "give what the machine bears."
                )
        if not 0 <= self.margin < 1:
            raise InputError(
                f"The margin was given as {self.margin:g}, but is a share from 0 up to, but without, 1; "
                "give for instance 0.1."
            )

    def outputs(self, channels: int) -> np.ndarray:
        """Largest |output| of each channel (C,) with the margin taken off."""
        known = np.array([self.travel, self.deflection])[:channels] * (1 - self.margin)
        return np.concatenate([known, np.full(channels - len(known), np.inf)])

    def playable(self, u: np.ndarray, Ts: float) -> np.ndarray:
        """A voltage within limit and slew everywhere; the same one where it is so already.

        Clipped, then the mean of the largest signal below and the smallest above that change no faster
        than allowed (the envelopes of Pasch and Hausdorff). It starts from 0 V and can end there.

        Args:
            u: Voltage (N,) [V].
            Ts: Sampling period [s].
        """
        return self.routed(u, Ts)[0]

    def routed(self, u: np.ndarray, Ts: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`playable(u)`, and for each of its samples the two samples of `u` whose mean it follows."""
        N = len(u)
        inside = np.clip(u, -self.voltage, self.voltage)
        if not math.isfinite(self.slew):
            here = np.arange(N)
            return inside, here, here
        most = self.slew * Ts * (1 - 1e-12)
        ends = most * np.minimum(np.arange(1, N + 1), np.arange(N, 0, -1))
        inside = np.clip(inside, -ends, ends)
        low, of_low = _below(inside, most)
        high, of_high = _below(-inside, most)
        return (low - high) / 2, of_low, of_high


def _below(u: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """min_j u[j] + most |k - j| for every k, and the j that gives it."""
    k = np.arange(len(u))
    after, j = _running(u - most * k)
    before, i = _running((u + most * k)[::-1])
    before, i = before[::-1], len(u) - 1 - i[::-1]
    first, second = after + most * k, before - most * k
    return np.minimum(first, second), np.where(first <= second, j, i)


def _running(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Running minimum and where it was reached."""
    least = np.minimum.accumulate(x)
    new = np.concatenate([[True], x[1:] < least[:-1]])
    return least, np.maximum.accumulate(np.where(new, np.arange(len(x)), 0))
