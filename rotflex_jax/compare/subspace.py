"""A linear system from data in one stroke: regression on the past, then a singular value decomposition."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.compare.held_in import free_run_cost, one_period, parted
from rotflex_jax.compare.linear_system import LinearSystem
from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.fit.linear import factor
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Subspace:
    """A linear state-space model by a subspace method that is right in closed loop too.

    Order and length of the past are those with the best free run over the last part of the training
    recordings. Not for coarse sensors at a high sampling rate alone: the regression minimises the
    error of the next sample, and `LinearStateSpace` goes on from here to the free run.

    Source: A. Chiuso, The role of vector autoregressive modeling in predictor-based subspace
    identification, Automatica 43, 2007 (PBSIDopt).

    Attributes:
        orders: Numbers of states to choose from.
        pasts: Samples of the past to choose from.
        share: Share of each training recording to learn from; the rest decides.
    """

    name: str = "subspace"
    title: str = "a linear state space, by a subspace method"
    family: str = "linear"
    orders: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 8)
    pasts: tuple[int, ...] = (8, 16, 32, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the model."""
        found, past = chosen_system(train, self.orders, self.pasts, self.share, say)
        note = f"order {found.order}, past of {past} samples"
        return Fitted(found, free_numbers(found), note, found.predict)


def free_numbers(system: LinearSystem) -> int:
    """Numbers of the behaviour from input to outputs, offsets included, whatever the coordinates."""
    n, C = system.order, len(system.C)
    return n * (C + 1) + 2 * C


def chosen_system(
    train: Sequence[Recording], orders: Sequence[int], pasts: Sequence[int], share: float, say: Progress
) -> tuple[LinearSystem, int]:
    """The system whose order and past are best in free run within the training recordings, and its past."""
    one_period(train, "a sampled system")
    first, last = parted(train, share)
    best, least = (orders[0], pasts[0]), np.inf
    for past in (p for p in pasts if p < min(r.N for r in first) // 8):
        candidates = subspace(first, past, orders)
        for n, system in candidates.items():
            cost = free_run_cost(system, last)
            if cost < least:
                best, least = (n, past), cost
        say(f"past {past}: log error {least:.2f}")
    n, past = best
    return subspace(train, past, (n,))[n], past


def subspace(recordings: Sequence[Recording], past: int, orders: Sequence[int]) -> dict[int, LinearSystem]:
    """Systems of several orders from one decomposition, by order.

        y[k] = sum over i of M_i z[k-i] + D [u[k], 1] + e[k],  z = (u, y),
        M_i = C (A - K C)^(i-1) [B - K D, K]

    The M_i of a long regression, stacked as an observability matrix times the past, have the states as
    their strongest right singular vectors; with these the system is a linear regression.

    Args:
        recordings: All with the same sampling period.
        past: Samples that the regression looks back.
        orders: Numbers of states; those beyond what the data carry are left out.
    """
    mean, size = _sizes(recordings)
    Z, Y, U, ends = [], [], [], []
    for r in recordings:
        z = (np.column_stack([r.u, r.y]).astype(float) - mean) / size
        lags = np.lib.stride_tricks.sliding_window_view(z, past, axis=0)[:-1]  # (N - p, 1 + C, p)
        Z.append(np.swapaxes(lags, 1, 2)[:, ::-1].reshape(len(z) - past, -1))  # newest first
        Y.append(z[past:, 1:])
        U.append(np.column_stack([z[past:, 0], np.ones(len(z) - past)]))
        ends.append(len(z) - past)
    Ys = np.vstack(Y)
    C, P = Ys.shape[1], Z[0].shape[1]
    # All that follows needs only the triangular factor of the rows, which is small.
    R = factor(np.hstack([np.vstack(Z), np.vstack(U), Ys]))
    M = np.linalg.lstsq(R[:, : P + 2], R[:, P + 2 :], rcond=1e-10)[0][:P].T.reshape(C, past, 1 + C)
    # Rows of block i predict i samples ahead from what is known now: the newest i lags have left.
    stacked = np.zeros((past, C, past, 1 + C))
    for i in range(past):
        stacked[i, :, : past - i] = M[:, i:]
    stacked = stacked.reshape(past * C, past * (1 + C))
    RZ = R[:P, :P]
    _, s, V = np.linalg.svd(stacked @ RZ.T, full_matrices=False)
    states = np.linalg.lstsq(RZ, np.eye(P), rcond=1e-12)[0]
    found = {}
    for n in (n for n in orders if n <= min(len(s), past * C) and s[n - 1] > 1e-12 * s[0]):
        T = (states @ V[:n].T) * np.sqrt(s[:n])
        found[n] = _system([z @ T for z in Z], Y, U, mean, size, recordings[0].Ts)
    return found


def _system(
    X: list[np.ndarray],
    Y: list[np.ndarray],
    U: list[np.ndarray],
    mean: np.ndarray,
    size: np.ndarray,
    Ts: float,
) -> LinearSystem:
    """The system with given states, by two regressions; in the units of the data."""
    n = X[0].shape[1]
    x, y, u = np.vstack(X), np.vstack(Y), np.vstack(U)
    CD = _regression(np.hstack([x, u]), y)
    C, D = CD[:, :n], CD[:, n:]
    e = [yi - np.hstack([xi, ui]) @ CD.T for xi, yi, ui in zip(X, Y, U, strict=True)]
    now = np.vstack([np.hstack([xi, ui, ei])[:-1] for xi, ui, ei in zip(X, U, e, strict=True)])
    nxt = np.vstack([xi[1:] for xi in X])
    ABK = _regression(now, nxt)
    A, B, K = ABK[:, :n], ABK[:, n : n + 2], ABK[:, n + 2 :]
    su, sy = size[0], size[1:]
    # Back from numbers about their means and of size one.
    B = np.column_stack([B[:, 0] / su, B[:, 1] - B[:, 0] * mean[0] / su])
    D = np.column_stack([D[:, 0] / su, D[:, 1] - D[:, 0] * mean[0] / su]) * sy[:, None]
    D[:, 1] += mean[1:]
    return LinearSystem(A, B, C * sy[:, None], D, K / sy, Ts)


def _regression(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Matrix W with y = W x, row by row."""
    R = factor(np.hstack([x, y]))
    P = x.shape[1]
    return np.linalg.lstsq(R[:, :P], R[:, P:], rcond=None)[0].T


def _sizes(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the input and the outputs."""
    z = np.vstack([np.column_stack([r.u, r.y]) for r in recordings]).astype(float)
    size = z.std(axis=0)
    return z.mean(axis=0), np.where(size > 0, size, 1.0)
