"""Linear state-space models: by a subspace method, and fitted to free runs."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Complex, Float

from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import (
    Fitted,
    require_one_sampling_period,
    split_for_validation,
    validation_cost,
)
from rotflex_jax.fit.linear import factor
from rotflex_jax.models.linear_system import LinearSystem
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import common_signals


@dataclasses.dataclass(frozen=True)
class Subspace:
    """A linear state-space model by a subspace method that is consistent in closed loop too.

    Order and length of the past are chosen by the best free run over the last part of the training
    recordings. Not enough for coarse sensors at a high sampling rate: the regression minimises the error of
    the next sample. `LinearStateSpace` starts from its result and fits free runs. Signals that all recordings
    have are further inputs.

    Source: A. Chiuso, The role of vector autoregressive modeling in predictor-based subspace
    identification, Automatica 43, 2007 (PBSIDopt).

    Attributes:
        orders: Numbers of states to choose from.
        pasts: Numbers of past samples to choose from.
        share: Share of each training recording to learn from; the rest is for validation.
    """

    name: str = "subspace"
    title: str = "a linear state space, by a subspace method"
    family: str = "linear"
    orders: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 8)
    pasts: tuple[int, ...] = (8, 16, 32, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose order and past and fit the system; `model` is ignored."""
        found, past = chosen_system(train, self.orders, self.pasts, self.share, say)
        note = f"order {found.order}, past of {past} samples"
        return Fitted(found, free_numbers(found), note, found.predict)


def free_numbers(system: LinearSystem) -> int:
    """Number of parameters of the input-output behaviour with offsets, independent of the coordinates."""
    C, columns = system.D.shape
    return system.order * (C + columns - 1) + C * columns


def chosen_system(
    train: Sequence[Recording], orders: Sequence[int], pasts: Sequence[int], share: float, say: Progress
) -> tuple[LinearSystem, int]:
    """The system with the order and past that give the best free runs over the validation parts; its past."""
    require_one_sampling_period(train, "a sampled system")
    first, last = split_for_validation(train, share)
    best, least = (orders[0], pasts[0]), np.inf
    for past in (p for p in pasts if p < min(r.N for r in first) // 8):
        candidates = subspace(first, past, orders)
        for n, system in candidates.items():
            cost = validation_cost(system, last)
            if cost < least:
                best, least = (n, past), cost
        say(f"past {past}: log error {least:.2f}")
    n, past = best
    return subspace(train, past, (n,))[n], past


def subspace(recordings: Sequence[Recording], past: int, orders: Sequence[int]) -> dict[int, LinearSystem]:
    """Systems of several orders from one decomposition, by order.

        y[k] = sum over i of M_i z[k-i] + D [u[k], 1] + e[k],  z = (u, y),
        M_i = C (A - K C)^(i-1) [B - K D, K]

    with the m inputs u: the input, and the signals that all recordings have.

    The M_i follow from a long regression. They are stacked as an observability matrix times the past; its
    strongest right singular vectors give the states. With the states, the system is a linear regression.

    Args:
        recordings: Recordings with the same sampling period.
        past: Number of past samples in the regression.
        orders: Numbers of states; orders that the data do not support are left out.
    """
    signals = common_signals(recordings)
    m = 1 + len(signals)
    columns = [np.column_stack([r.inputs(signals), r.y]).astype(float) for r in recordings]
    mean, size = _sizes(columns)
    Z, Y, U, ends = [], [], [], []
    for values in columns:
        z = (values - mean) / size
        lags = np.lib.stride_tricks.sliding_window_view(z, past, axis=0)[:-1]  # (N - p, m + C, p)
        Z.append(np.swapaxes(lags, 1, 2)[:, ::-1].reshape(len(z) - past, -1))  # newest first
        Y.append(z[past:, m:])
        U.append(np.column_stack([z[past:, :m], np.ones(len(z) - past)]))
        ends.append(len(z) - past)
    Ys = np.vstack(Y)
    C, P = Ys.shape[1], Z[0].shape[1]
    # The following steps need only the triangular factor of the rows, which is small.
    R = factor(np.hstack([np.vstack(Z), np.vstack(U), Ys]))
    known = P + m + 1
    M = np.linalg.lstsq(R[:, :known], R[:, known:], rcond=1e-10)[0][:P].T.reshape(C, past, m + C)
    # Rows of block i predict i samples ahead from the present past: the newest i lags are not known.
    stacked = np.zeros((past, C, past, m + C))
    for i in range(past):
        stacked[i, :, : past - i] = M[:, i:]
    stacked = stacked.reshape(past * C, past * (m + C))
    RZ = R[:P, :P]
    _, s, V = np.linalg.svd(stacked @ RZ.T, full_matrices=False)
    states = np.linalg.lstsq(RZ, np.eye(P), rcond=1e-12)[0]
    found = {}
    for n in (n for n in orders if n <= min(len(s), past * C) and s[n - 1] > 1e-12 * s[0]):
        T = (states @ V[:n].T) * np.sqrt(s[:n])
        found[n] = _system([z @ T for z in Z], Y, U, mean, size, recordings[0].Ts, signals)
    return found


def _system(
    X: list[np.ndarray],
    Y: list[np.ndarray],
    U: list[np.ndarray],
    mean: np.ndarray,
    size: np.ndarray,
    Ts: float,
    signals: tuple[str, ...],
) -> LinearSystem:
    """The system with given states, by two regressions, in the units of the data."""
    n, m = X[0].shape[1], 1 + len(signals)
    x, y, u = np.vstack(X), np.vstack(Y), np.vstack(U)
    CD = _regression(np.hstack([x, u]), y)
    C, D = CD[:, :n], CD[:, n:]
    e = [yi - np.hstack([xi, ui]) @ CD.T for xi, yi, ui in zip(X, Y, U, strict=True)]
    now = np.vstack([np.hstack([xi, ui, ei])[:-1] for xi, ui, ei in zip(X, U, e, strict=True)])
    nxt = np.vstack([xi[1:] for xi in X])
    ABK = _regression(now, nxt)
    A, B, K = ABK[:, :n], ABK[:, n : n + m + 1], ABK[:, n + m + 1 :]
    sy = size[m:]

    def of_inputs(w: np.ndarray) -> np.ndarray:
        """Columns of inputs and constant, from columns for inputs that are centred and scaled to size one."""
        columns = w[:, :m] / size[:m]
        return np.column_stack([columns, w[:, m] - columns @ mean[:m]])

    B, D = of_inputs(B), of_inputs(D) * sy[:, None]
    D[:, m] += mean[m:]
    return LinearSystem(A, B, C * sy[:, None], D, K / sy, Ts, signals)


def _regression(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Matrix W with y = W x for every row, by least squares."""
    R = factor(np.hstack([x, y]))
    P = x.shape[1]
    return np.linalg.lstsq(R[:, :P], R[:, P:], rcond=None)[0].T


def _sizes(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each column of several recordings."""
    z = np.vstack(columns)
    size = z.std(axis=0)
    return z.mean(axis=0), np.where(size > 0, size, 1.0)


# No recording distinguishes a pole with less decay than this from an integrator.
LEAST_DECAY = 1e-9
# Largest step of the logarithms of decay and angle of a pole.
LARGEST_POLE_STEP = 1.0
# Change of the sum over channels of log mean e^2 that is not worth a step.
LOG_COST_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True)
class Modes:
    """A sum of modes and an offset.

        x_i+ = p_i x_i + u_i,  x_i[0] = xi_ir in recording r,    y_c = offset_c + sum over i of Re(g_ci x_i)

    Each of the m inputs (the input, then the signals) drives its own modes, which have the same n poles. The
    modes of the input come first, then those of each signal; there are S = m n modes.

    Attributes:
        p: Poles of the modes, one of each complex pair.
        g: Residues, real for a real pole.
        offset: Offset of each channel.
        xi: First states, real for a real pole.
        signals: Names of the signals.
    """

    p: Complex[np.ndarray, " S"]
    g: Complex[np.ndarray, "C S"]
    offset: Float[np.ndarray, " C"]
    xi: Complex[np.ndarray, "R S"]
    signals: tuple[str, ...] = ()

    @classmethod
    def begun(cls, poles: Sequence[complex], recordings: Sequence[Recording]) -> "Modes":
        """Residues, then first states, for given poles, both by least squares."""
        signals = common_signals(recordings)
        p = np.tile(np.array(poles, complex), 1 + len(signals))
        S, R, C = len(p), len(recordings), recordings[0].y.shape[1]
        y = np.concatenate([r.y for r in recordings]).astype(float)
        empty = cls(p, np.zeros((C, S), complex), np.zeros(C), np.zeros((R, S), complex), signals)
        forced, free = empty._forced(recordings), empty._free(recordings)
        of_poles = _pair(free[:, : len(poles)])  # the free modes of the other inputs are the same
        columns = [_pair(forced), np.ones((len(y), 1)), _by_recording(of_poles, recordings)]
        W = _least_norm(np.hstack(columns), y)
        g = _complex(W[: 2 * S].T, p)
        # With the residues known, one first state serves all channels.
        e = y - np.stack([(forced @ g_c).real for g_c in g], axis=1) - W[2 * S]
        size = np.maximum(y.std(axis=0), 1e-300)
        rows = [_by_recording(_pair(free * g_c), recordings) / s for g_c, s in zip(g, size, strict=True)]
        xi = _least_norm(np.vstack(rows), (e / size).T.reshape(-1, 1))[:, 0].reshape(R, 2 * S)
        return dataclasses.replace(empty, g=g, offset=W[2 * S], xi=_complex(xi, p))

    @property
    def pole_count(self) -> int:
        """Number of poles, which the modes of all inputs share."""
        return len(self.p) // (1 + len(self.signals))

    def fitted(self, recordings: Sequence[Recording], max_steps: int) -> "Modes":
        """The modes with the least `sum over channels of N/2 log mean e^2` of free runs."""
        n, S = self.pole_count, len(self.p)

        def cost(modes: Modes) -> float:
            with np.errstate(all="ignore"):
                return _log_cost(modes._errors(recordings))

        def linearised(modes: Modes) -> NormalEquations:
            # The errors divided by their own size give the gradient of the logarithm.
            e = modes._errors(recordings)
            size = np.sqrt(np.mean(e**2, axis=0)) + 1e-300
            J = -modes._slopes(recordings) / size[:, None]
            equations = NormalEquations.of(J.reshape(-1, J.shape[2]), (e / size).ravel())
            return equations._replace(costs=np.array([_log_cost(e)]))

        limit = np.full(2 * n + 2 * S * (len(self.g) + len(self.xi)) + len(self.g), np.inf)
        limit[: 2 * n] = LARGEST_POLE_STEP
        rules = Rules(enough=LOG_COST_TOLERANCE / 2 * sum(r.N for r in recordings))
        return minimise(
            linearised, self, rules, limit=limit, cost=cost, move=Modes._moved, max_steps=max_steps
        ).x

    def system(self, Ts: float) -> LinearSystem:
        """The modes as a state-space model with real numbers."""
        real = np.imag(self.p) == 0
        blocks = [
            np.array([[p.real]]) if r else np.array([[p.real, -p.imag], [p.imag, p.real]])
            for p, r in zip(self.p, real, strict=True)
        ]
        driven = np.concatenate([[1.0] if r else [1.0, 0.0] for r in real])
        size = sum(len(b) for b in blocks[: self.pole_count])
        B = _block_diagonal(*[part[:, None] for part in np.split(driven, len(driven) // size)])
        C = np.column_stack(
            [c for g, r in zip(self.g.T, real, strict=True) for c in ([g.real] if r else [g.real, -g.imag])]
        )
        return LinearSystem(
            _block_diagonal(*blocks),
            np.column_stack([B, np.zeros(len(B))]),
            C,
            np.column_stack([np.zeros((len(C), B.shape[1])), self.offset]),
            np.zeros((len(B), len(C))),
            Ts,
            self.signals,
        )

    def _forced(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N S"]:
        inputs = (r.inputs(self.signals).astype(complex) for r in recordings)
        return np.vstack([_filtered(self.p, np.repeat(u, self.pole_count, axis=1)) for u in inputs])

    def _free(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N S"]:
        poles, of_inputs = self.p[: self.pole_count], (1, 1 + len(self.signals))
        each = [
            np.stack([scipy.signal.lfilter([1], [1, -p], np.eye(1, r.N)[0]) for p in poles], axis=1)
            for r in recordings
        ]
        return np.tile(np.vstack(each), of_inputs)

    def _states(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N S"]:
        each = np.repeat(self.xi, [r.N for r in recordings], axis=0)
        return self._forced(recordings) + each * self._free(recordings)

    def _errors(self, recordings: Sequence[Recording]) -> Float[np.ndarray, "N C"]:
        y = np.concatenate([r.y for r in recordings]).astype(float)
        return y - self.offset - np.real(self._states(recordings) @ self.g.T)

    def _slopes(self, recordings: Sequence[Recording]) -> Float[np.ndarray, "N C P"]:
        """Derivatives of the outputs by decay and angle of the poles, residues, offsets, first states."""
        x, free = self._states(recordings), self._free(recordings)
        ends = np.cumsum([r.N for r in recordings])[:-1]
        by_pole = np.vstack([_filtered(self.p, part) for part in np.split(x, ends)])
        decay, angle = -np.log(np.abs(self.p)), np.angle(self.p)
        C, S, N = len(self.g), len(self.p), len(x)
        columns = []
        for c in range(C):
            slope = by_pole * self.g[c] * self.p
            by_mode = np.stack([(slope * -decay).real, (slope * 1j * angle).real], axis=1)
            poles = by_mode.reshape(N, 2, -1, self.pole_count).sum(axis=2).reshape(N, -1)
            residues, offsets = np.zeros((N, 2 * S * C)), np.zeros((N, C))
            residues[:, 2 * S * c : 2 * S * (c + 1)] = _pair(x)
            offsets[:, c] = 1.0
            starts = _by_recording(_pair(free * self.g[c]), recordings)
            columns.append(np.hstack([poles, residues, offsets, starts]))
        return np.stack(columns, axis=1)

    def _moved(self, move: Float[np.ndarray, " P"]) -> "Modes":
        C, n, S, R = len(self.g), self.pole_count, len(self.p), len(self.xi)
        a, b, g, offset, xi = np.split(move, np.cumsum([n, n, 2 * S * C, C]))
        a, b = np.tile(a, S // n), np.tile(b, S // n)
        decay = -np.log(np.abs(self.p)) * np.exp(a)
        angle = np.angle(self.p)
        turned = np.where(np.imag(self.p) == 0, angle, np.clip(angle * np.exp(b), 1e-9, np.pi - 1e-9))
        p = np.exp(-np.maximum(decay, LEAST_DECAY) + 1j * turned)
        p = np.where(np.imag(self.p) == 0, np.sign(np.real(self.p)) * np.abs(p), p)
        return Modes(
            p,
            self.g + _complex(g.reshape(C, 2 * S), self.p),
            self.offset + offset,
            self.xi + _complex(xi.reshape(R, 2 * S), self.p),
            self.signals,
        )


def _filtered(p: np.ndarray, u: np.ndarray) -> Complex[np.ndarray, "N n"]:
    u = np.broadcast_to(u, (len(u), len(p)))
    return np.stack(
        [scipy.signal.lfilter([0, 1], [1, -pole], x) for pole, x in zip(p, u.T, strict=True)], axis=1
    )


def _pair(x: Complex[np.ndarray, "N n"]) -> Float[np.ndarray, "N m"]:
    """Re(w x) for w = w_re + i w_im, as columns for w_re and w_im."""
    return np.concatenate([np.real(x), -np.imag(x)], axis=1)


def _complex(w: Float[np.ndarray, "K m"], p: np.ndarray) -> Complex[np.ndarray, "K n"]:
    re, im = np.split(w, 2, axis=1)
    return re + 1j * np.where(np.imag(p) == 0, 0.0, im)


def _block_diagonal(*blocks: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.linalg.block_diag(*blocks))


def _by_recording(x: np.ndarray, recordings: Sequence[Recording]) -> np.ndarray:
    """The rows of each recording in separate columns."""
    return _block_diagonal(*np.split(x, np.cumsum([r.N for r in recordings])[:-1]))


def _least_norm(phi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares from normal equations with scaled columns; accurate enough as the start of a fit."""
    size = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    phi = phi / size
    H = phi.T @ phi
    return np.linalg.lstsq(H, phi.T @ y, rcond=1e-10)[0] / size[:, None]


def _log_cost(e: np.ndarray) -> float:
    cost = len(e) / 2 * float(np.sum(np.log(np.mean(e**2, axis=0) + 1e-300)))
    return cost if np.isfinite(cost) else np.inf


# Number of samples of each recording on which the gain of the predictor is chosen.
GAIN_SAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class LinearStateSpace:
    """A linear state-space model that is fitted to free runs, started at the poles of a subspace estimate.

    It is the best that a linear model with this number of states can do in free run, whatever the physics.
    Not for friction that sticks for long: the poles are then a mean of two regimes. Signals that all
    recordings have are further inputs, each with its own modes at the same poles.

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 7.3 (output error).

    Attributes:
        orders: Numbers of states to choose from, by the free run over the last part.
        pasts: Numbers of past samples that the subspace estimate may use.
        share: Share of each training recording to learn from; the rest is for validation.
    """

    name: str = "state_space"
    title: str = "a linear state space, fitted to free runs"
    family: str = "linear"
    orders: tuple[int, ...] = (2, 3, 4, 6)
    pasts: tuple[int, ...] = (16, 64)
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose the order and fit the system; `model` is ignored."""
        require_one_sampling_period(train, "a sampled system")
        first, last = split_for_validation(train, self.share)
        begun: dict[int, tuple[float, LinearSystem]] = {}
        for past in (p for p in self.pasts if p < min(r.N for r in first) // 8):
            for n, system in subspace(first, past, self.orders).items():
                cost = validation_cost(system, first)
                if n not in begun or cost < begun[n][0]:
                    begun[n] = (cost, system)
        fitted: dict[int, tuple[float, LinearSystem]] = {}
        for n, (_, start) in sorted(begun.items()):
            system = refined(start, first)
            fitted[n] = (validation_cost(system, last), system)
            say(f"order {n}: log error {fitted[n][0]:.2f}")
        if not fitted:
            raise RuntimeError("no subspace estimate could be made, the recordings are too short")
        best = min(fitted, key=lambda n: fitted[n][0])
        final = with_gain(refined(fitted[best][1], train), train)
        # The inputs share the poles.
        C, columns = final.D.shape
        count = best * (C * (columns - 1) + 1) + C * columns
        return Fitted(final, count, f"order {best}", final.predict)


def refined(system: LinearSystem, recordings: Sequence[Recording], max_steps: int = 80) -> LinearSystem:
    """The system with the least squared error of free runs, in modal coordinates.

        minimise  sum over channels of N log sum (y_c - y_hat_c)^2

    over poles, residues, offsets and first states. A mode of one input is `x+ = p x + u`. Its derivative with
    respect to the pole is the same filter applied once more, so a step costs only a few filters.

    Args:
        system: System whose poles are the start.
        recordings: Recordings with its sampling period.
        max_steps: Largest number of steps that are tried.
    """
    return Modes.begun(_distinct(system.poles), recordings).fitted(recordings, max_steps).system(system.Ts)


def with_gain(system: LinearSystem, recordings: Sequence[Recording]) -> LinearSystem:
    """The system with the gain of a Kalman filter for a disturbed input that predicts best one step ahead."""
    recordings = [r.slice(0, min(r.N, GAIN_SAMPLES)) for r in recordings]
    y = [np.diff(r.y.astype(float), 2, axis=0) for r in recordings]
    noise = np.diag(np.maximum(np.concatenate(y).var(axis=0) / 6, 1e-300))  # white noise, differenced twice
    push = system.B[:, :1] * np.sqrt(np.mean([float(np.var(r.u)) for r in recordings]))
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
    """One pole of each mode, moved inside the unit circle and apart from equal poles."""
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
