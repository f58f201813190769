"""A linear state space fitted to free runs."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy

from rotflex_jax.compare.held_in import free_run_cost, one_period, parted
from rotflex_jax.compare.linear_system import LinearSystem
from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.compare.modes import Modes
from rotflex_jax.compare.subspace import free_numbers, subspace
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

# Samples of each recording that the gain of the predictor is chosen on.
LONGEST = 2000


@dataclasses.dataclass(frozen=True)
class LinearStateSpace:
    """A linear state space whose free run is fitted, begun at the poles of a subspace estimate.

    The best that a linear model with so many states can do in free run, whatever its physics. Not
    where friction sticks for long: the poles then are a mean of two regimes.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 7.3 (output error).

    Attributes:
        orders: Numbers of states to choose from, by the free run over the last part.
        pasts: Samples of the past that the subspace estimate may use.
        share: Share of each training recording to learn from; the rest decides.
    """

    name: str = "state_space"
    title: str = "a linear state space, fitted to free runs"
    family: str = "linear"
    orders: tuple[int, ...] = (2, 3, 4, 6)
    pasts: tuple[int, ...] = (16, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the model."""
        one_period(train, "a sampled system")
        first, last = parted(train, self.share)
        begun: dict[int, tuple[float, LinearSystem]] = {}
        for past in (p for p in self.pasts if p < min(r.N for r in first) // 8):
            for n, system in subspace(first, past, self.orders).items():
                cost = free_run_cost(system, first)
                if n not in begun or cost < begun[n][0]:
                    begun[n] = (cost, system)
        fitted: dict[int, tuple[float, LinearSystem]] = {}
        for n, (_, start) in sorted(begun.items()):
            system = refined(start, first)
            fitted[n] = (free_run_cost(system, last), system)
            say(f"order {n}: log error {fitted[n][0]:.2f}")
        if not fitted:
            raise RuntimeError("no subspace estimate could be made, the recordings are too short")
        best = min(fitted, key=lambda n: fitted[n][0])
        final = with_gain(refined(fitted[best][1], train), train)
        return Fitted(final, free_numbers(final), f"order {best}", final.predict)


def refined(system: LinearSystem, recordings: Sequence[Recording], steps: int = 40) -> LinearSystem:
    """The system with the least squared error of free runs, in modal coordinates.

        minimise  sum over channels of N log sum (y_c - y_hat_c)^2

    over poles, residues, offsets and first states. With one input a mode is `x+ = p x + u`, whose
    derivative by its pole is the same filter once more, so that a step costs a few filters.

    Args:
        system: Its poles are where the search begins.
        recordings: All with its sampling period.
        steps: Most steps.
    """
    return Modes.begun(_distinct(system.poles), recordings).fitted(recordings, steps).system(system.Ts)


def with_gain(system: LinearSystem, recordings: Sequence[Recording]) -> LinearSystem:
    """The system with the gain of a Kalman filter for a disturbed input, the best one step ahead."""
    recordings = [r.slice(0, min(r.N, LONGEST)) for r in recordings]
    y = [np.diff(r.y.astype(float), 2, axis=0) for r in recordings]
    noise = np.diag(np.maximum(np.concatenate(y).var(axis=0) / 6, 1e-300))  # white noise, differenced twice
    push = system.B[:, :1] * np.sqrt(np.mean([np.var(r.u) for r in recordings]))
    best, least = system, np.inf
    for q in np.logspace(-8, 2, 6):
        try:
            P = scipy.linalg.solve_discrete_are(
                system.A.T, system.C.T, q * push @ push.T + 1e-14 * np.eye(system.order), noise
            )
        except (np.linalg.LinAlgError, ValueError):
            continue
        K = system.A @ P @ system.C.T @ np.linalg.inv(system.C @ P @ system.C.T + noise)
        candidate = dataclasses.replace(system, K=K)
        e = np.concatenate([(r.y - candidate.predict(r))[r.n_init :] for r in recordings])
        cost = float(np.mean(np.log(np.mean(e**2, axis=0) + 1e-300)))
        if cost < least:
            best, least = candidate, cost
    return best


def _distinct(poles: np.ndarray) -> list[complex]:
    """One pole of each mode, inside of the unit circle and no two alike."""
    kept: list[complex] = []
    for p in sorted(poles.tolist(), key=lambda p: (abs(p), p.imag)):
        p = complex(p) if abs(p.imag) > 1e-9 else complex(p.real)
        if p.imag < 0:
            continue
        p *= min(max(abs(p), 0.05), 1 - 1e-6) / max(abs(p), 1e-9)
        while any(abs(p - other) < 1e-4 for other in kept):
            p *= 1 - 1e-3
        kept.append(p)
    return kept
