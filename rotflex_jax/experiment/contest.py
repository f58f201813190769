"""What an input is worth: how far each of two machines stays from the other's best imitation of it."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.experiment.hypotheses import Hypothesis
from rotflex_jax.experiment.imitation import Imitation, best_imitation, pull, truth
from rotflex_jax.experiment.limits import Limits

# Shapes from which an imitation also starts: factors of every number of the rival's effect that is not an
# amplitude. Linear algebra alone sees one shape at a time.
FACTORS = (0.6, 1.6)
# A run is contained in the other machine that imitates it to this share of the opposite case, and to so
# little that no recording would decide it [nat].
CONTAINED, FEW = 0.05, 10.0
# Exponent of the smooth maximum whose slope stands for that of a peak.
PEAKED = 24


@dataclasses.dataclass(frozen=True)
class Meeting:
    """Both machines under one voltage.

    Attributes:
        outputs: Runs of A and of B (2, N, C).
        imitations: B's best imitation of A, and A's of B.
        counted: Which of the two count.
    """

    outputs: np.ndarray
    imitations: tuple[Imitation, Imitation]
    counted: tuple[bool, bool] = (True, True)

    @property
    def nats(self) -> float:
        """Log-likelihood by which the worse told of the two wins, expected [nat]."""
        return min(self._told)

    @property
    def mean(self) -> float:
        """Geometric mean of what counts, what a climb raises in the place of the smaller [nat].

        Where one direction is bounded, as that of a play by its size, the slope of the smaller would leave
        the other where it is.
        """
        return float(np.exp(np.mean(np.log(np.maximum(self._told, 1e-12)))))

    @property
    def _told(self) -> list[float]:
        """Nats of what counts; none where an imitation failed, since then nothing is known."""
        pairs = zip(self.imitations, self.counted, strict=True)
        return [i.nats if np.isfinite(i.nats) else 0.0 for i, yes in pairs if yes]


@dataclasses.dataclass(frozen=True)
class Contest:
    """Two hypotheses at one sampling period, with what the machine may be asked for.

    Attributes:
        pair: A and B.
        Ts: Sampling period [s].
        limits: Of the machine.
        doubts: Other numbers (P,) that A may have, for the peaks.
        counted: Whether the run of A counts, and that of B: not one that the other machine contains.
    """

    pair: tuple[Hypothesis, Hypothesis]
    Ts: float
    limits: Limits
    doubts: Sequence[np.ndarray] = ()
    counted: tuple[bool, bool] = (True, True)

    def meet(self, u: np.ndarray, last: Meeting | None = None, thorough: bool = False) -> Meeting:
        """Runs of both, and each one's best imitation of the other.

        Args:
            u: Voltage (N,) [V].
            last: A meeting under a similar voltage, to start from.
            thorough: Start from several shapes of the imitator too, and keep the best.
        """
        runs = [truth(h, u, self.Ts) for h in self.pair]
        found = []
        for k, y in enumerate(runs):
            rival = self.pair[1 - k]
            starts = [rival.start if last is None else last.imitations[k].numbers]
            if thorough:
                starts += [rival.start] * (last is not None) + other_shapes(rival)
            found.append(best_imitation(rival, u, y, self.Ts, starts))
        return Meeting(np.array(runs), (found[0], found[1]), self.counted)

    def visible(self, meetings: Sequence[Meeting]) -> "Contest":
        """The contest without a direction that no input can show.

        Where one machine contains the other (Stribeck friction Coulomb's), or one effect is next to nothing
        at the size that imitates the other, that run can always be imitated; only the opposite case shows
        in a recording.

        Args:
            meetings: Under inputs of many kinds.
        """
        nats = np.array([[i.nats for i in m.imitations] for m in meetings])
        one, other = np.max(nats, axis=0, where=np.isfinite(nats), initial=0.0)
        counted = (bool(one > min(CONTAINED * other, FEW)), bool(other > min(CONTAINED * one, FEW)))
        return dataclasses.replace(self, counted=counted if any(counted) else (True, True))

    def excess(self, outputs: np.ndarray) -> np.ndarray:
        """Peak over limit, per hypothesis and channel (2, C)."""
        return np.max(np.abs(outputs), axis=1) / self.limits.outputs(outputs.shape[-1])

    def slope(self, u: np.ndarray, m: Meeting, penalty: np.ndarray) -> np.ndarray:
        """Slope (N,) of `log(mean) - sum penalty * log(peak)` along the voltage [1/V].

        Args:
            u: Voltage (N,) [V].
            m: Meeting under it.
            penalty: Per hypothesis and channel (2, C).
        """
        total = np.zeros_like(u)
        for k, i in enumerate(m.imitations):
            y = m.outputs[k]
            size = np.maximum(np.max(np.abs(y), axis=0), 1e-300)
            share = np.abs(y / size) ** (PEAKED - 1) * np.sign(y)
            weight = share / np.sum(np.abs(y / size) ** PEAKED, axis=0) / size
            true, rival = self.pair[k], self.pair[1 - k]
            part = self.counted[k] / sum(self.counted) / max(i.nats, 1e-12)
            total += pull(true, rival, i.numbers, u, self.Ts, part, -penalty[k] * weight)
        return total

    def peaks(self, u: np.ndarray) -> np.ndarray:
        """Largest |output| per channel (C,) under A, B, and A with its doubts."""
        a, b = self.pair
        doubtful = [dataclasses.replace(a, mechanism=a.mechanism.with_values(d)) for d in self.doubts]
        return np.max([np.max(np.abs(truth(h, u, self.Ts)), axis=0) for h in (a, b, *doubtful)], axis=0)

    def within(self, u: np.ndarray) -> np.ndarray:
        """The voltage, made smaller until every predicted peak is within its limit.

        Raises:
            InputError: The machine leaves its limits almost by itself.
        """
        for _ in range(30):
            peaks = self.peaks(u)
            over = float(np.max(peaks / self.limits.outputs(len(peaks))))
            if over <= 1:
                return u
            u = u * 0.998 / min(over, 5.0)
        raise InputError(
            "The model is predicted to leave the limits on travel or deflection under the smallest voltage, "
            "which an offset in it may do; widen the limits, shorten the experiment, or take the offset out."
        )


def other_shapes(h: Hypothesis) -> list[np.ndarray]:
    """Starts of an imitation with other shapes of the effect, one number changed at a time."""
    effect = h.effect()
    names, out = h.mechanism.parameter_names, []
    for name, value in effect.values.items():
        full = f"{effect.at}.{effect.name}.{name}"
        if name in effect.amplitudes or names.index(full) not in h.moved or value == 0:
            continue
        spec = effect.declared()[name]
        for factor in FACTORS:
            if spec.lower < factor * value < spec.upper:
                m = h.mechanism.with_values({full: factor * value})
                out.append(dataclasses.replace(h, mechanism=m).start)
    return out
