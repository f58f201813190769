"""Free run of a series in the middle of a motion: what the input was before is told by the first samples."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Volterra
from rotflex_jax.basis.bank import Bank
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

# Stretches of unknown input before the recording, longer and longer into the past.
PIECES = 12
LONGEST_PAST = 4000


@dataclasses.dataclass(frozen=True)
class ChannelSeries:
    """Weights in front of a basis of the input, for one output.

        y[t] = w phi[t],  or where it integrates  y[t] = y[t-1] + Ts w phi[t]

    Attributes:
        basis: Volterra series on a bank.
        weights: (P,).
        integrates: Whether the series is the rate of the output.
        Ts: Sampling period it holds for [s].
        noise: Error of the series over stretches as long as the first samples [output].
        mean: Mean input, what the unknown past is drawn to.
        spread: Standard deviation of the input, how far from it the past may be.
    """

    basis: Volterra
    weights: Float[np.ndarray, " P"]
    integrates: bool
    Ts: float
    noise: float
    mean: float
    spread: float

    def simulate(self, u: np.ndarray, head: np.ndarray) -> Float[np.ndarray, " N"]:
        """Free run from the input and the first samples of the output."""
        reach, m = min(int(self.basis.bank.reach), LONGEST_PAST), len(head)
        edges = np.unique(np.round(np.geomspace(1, reach, PIECES)).astype(int))
        edges = np.concatenate([[0], edges])
        # The bank is linear and knows no time: a stretch of input is one step less a later one.
        step = responses(self.basis.bank, np.ones(reach + m))
        until = [step[b : b + m] for b in edges]
        unknown = self.spread * np.stack([b - a for a, b in itertools.pairwise(until)])
        known = responses(self.basis.bank, np.concatenate([np.full(reach, self.mean), u]))[reach:]
        a = self._past(head, known[:m], unknown)
        past = np.full(reach, self.mean)
        for k, (late, early) in enumerate(itertools.pairwise(edges)):
            past[reach - early : reach - late] += self.spread * a[k]
        run = self._output(responses(self.basis.bank, np.concatenate([past, u]))[reach:])
        return run + np.mean(head - run[:m]) if self.integrates else run

    def _output(self, z: Float[np.ndarray, "N M"]) -> Float[np.ndarray, " N"]:
        rate = products(self.basis, z) @ self.weights
        return self.Ts * np.cumsum(rate) if self.integrates else rate

    def _past(self, head: np.ndarray, known: np.ndarray, unknown: np.ndarray) -> Float[np.ndarray, " K"]:
        """Most likely input before the first sample, in spreads about its mean, by Levenberg-Marquardt."""

        def missed(a: np.ndarray) -> np.ndarray:
            e = head - self._output(known + np.tensordot(a, unknown, axes=1))
            return np.concatenate([(e - e.mean() if self.integrates else e) / self.noise, a])

        a = np.zeros(len(unknown))
        e = missed(a)
        damping = 1e-3
        for _ in range(12):
            J = np.stack([(missed(a + d) - e) / 1e-4 for d in 1e-4 * np.eye(len(a))], axis=1)
            H, b, before = J.T @ J, J.T @ e, float(e @ e)
            # A polynomial may overshoot: a shorter step then, or none.
            for _ in range(5):
                move = np.linalg.solve(H + damping * np.diag(np.diag(H)), -b)
                new = missed(a + move)
                if new @ new < before:
                    a, e, damping = a + move, new, damping / 10
                    break
                damping *= 10
            if not float(e @ e) < 0.99 * before:
                break
        return a


@dataclasses.dataclass(frozen=True)
class SeriesModel:
    """One series for each output; the same for everything that learns weights."""

    channels: tuple[ChannelSeries, ...]

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run from the input and the first `n_init` samples of the outputs."""
        Ts, m = self.channels[0].Ts, recording.n_init
        if abs(recording.Ts / Ts - 1) > 1e-6:
            raise InputError(
                f"The series holds for a sampling period of {Ts:g} s, but the recording has "
                f"{recording.Ts:g} s; fit it to a recording of that period."
            )
        u = recording.u.astype(float)
        return np.stack([c.simulate(u, recording.y[:m, i]) for i, c in enumerate(self.channels)], axis=1)

    def predict(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """One step ahead: an output that integrates goes on from its last sample, others run free."""
        run, y = self.simulate(recording), recording.y.astype(float)
        for i, c in enumerate(self.channels):
            if c.integrates:
                run[1:, i] = y[:-1, i] + np.diff(run[:, i])
        return run

    @property
    def parameters(self) -> int:
        """Weights in all."""
        return sum(int(np.count_nonzero(c.weights)) for c in self.channels)


def responses(bank: Bank, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N M"]:
    """Outputs of a bank; signals of like lengths share one compilation."""
    padded = np.zeros(max(512, 1 << (len(u) - 1).bit_length()))
    padded[: len(u)] = u
    return np.asarray(bank.outputs(padded))[: len(u)]


def products(basis: Volterra, z: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N P"]:
    """Regressors from outputs of the bank, degree by degree."""
    columns = []
    for degree in basis.chosen:
        if degree == 0:
            columns.append(np.ones((len(z), 1)))
            continue
        factors = np.array([i for i in basis.indices if len(i) == degree], int)
        product = z[:, factors[:, 0]]
        for f in factors.T[1:]:
            product = product * z[:, f]
        columns.append(product)
    return np.concatenate(columns, axis=1)


def model_of(parts: Sequence[ChannelSeries]) -> SeriesModel:
    """The series of all outputs.

    Raises:
        RuntimeError: Weights that are not finite.
    """
    if not all(np.isfinite(c.weights).all() for c in parts):
        raise RuntimeError("the weights are not finite")
    return SeriesModel(tuple(parts))
