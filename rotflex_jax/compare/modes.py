"""Modes of a sampled linear system with one input, fitted to free runs by Levenberg-Marquardt."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Complex, Float

from rotflex_jax.compare.linear_system import LinearSystem
from rotflex_jax.recording import Recording

# A pole closer to one than this cannot be told from an integrator by any recording.
EDGE = 1e-9


@dataclasses.dataclass(frozen=True)
class Modes:
    """A sum of modes and an offset.

        x_i+ = p_i x_i + u,  x_i[0] = xi_ir in recording r,    y_c = offset_c + sum over i of Re(g_ci x_i)

    Attributes:
        p: Poles (n,), one of each pair.
        g: Residues (C, n), real where the pole is.
        offset: (C,).
        xi: First states (R, n), real where the pole is.
    """

    p: Complex[np.ndarray, " n"]
    g: Complex[np.ndarray, "C n"]
    offset: Float[np.ndarray, " C"]
    xi: Complex[np.ndarray, "R n"]

    @classmethod
    def begun(cls, poles: Sequence[complex], recordings: Sequence[Recording]) -> "Modes":
        """Residues and first states for given poles, by least squares one after the other."""
        p = np.array(poles, complex)
        n, R, C = len(p), len(recordings), recordings[0].y.shape[1]
        y = np.concatenate([r.y for r in recordings]).astype(float)
        empty = cls(p, np.zeros((C, n), complex), np.zeros(C), np.zeros((R, n), complex))
        forced, free = empty._forced(recordings), empty._free(recordings)
        columns = [_pair(forced), np.ones((len(y), 1)), _by_recording(_pair(free), recordings)]
        W = _least_norm(np.hstack(columns), y)
        g = _complex(W[: 2 * n].T, p)
        # With the residues known, one first state serves all channels.
        e = y - np.stack([(forced @ g_c).real for g_c in g], axis=1) - W[2 * n]
        size = np.maximum(y.std(axis=0), 1e-300)
        rows = [_by_recording(_pair(free * g_c), recordings) / s for g_c, s in zip(g, size, strict=True)]
        xi = _least_norm(np.vstack(rows), (e / size).T.reshape(-1, 1))[:, 0].reshape(R, 2 * n)
        return dataclasses.replace(empty, g=g, offset=W[2 * n], xi=_complex(xi, p))

    def fitted(self, recordings: Sequence[Recording], steps: int) -> "Modes":
        """The modes whose free runs are closest, by damped steps that count only if they help."""
        now, damping = self, 1e-2
        e = now._errors(recordings)
        cost = _cost(e)
        for _ in range(steps):
            size = np.sqrt(np.mean(e**2, axis=0)) + 1e-300
            J = now._slopes(recordings) / size[:, None]
            J = J.reshape(-1, J.shape[2])
            H, b = J.T @ J, J.T @ (e / size).ravel()
            scale = np.sqrt(np.maximum(np.diag(H), 1e-12 * np.max(np.diag(H))))
            H, b = H / np.outer(scale, scale), b / scale
            for _ in range(6):
                move = np.linalg.solve(H + damping * np.eye(len(b)), b) / scale
                new = now._moved(move)
                with np.errstate(all="ignore"):
                    e_new = new._errors(recordings)
                gain = cost - _cost(e_new)
                if gain > 0:
                    damping = max(damping / 5, 1e-9)
                    break
                damping *= 5
            else:
                break
            now, e, cost = new, e_new, cost - gain
            if gain < 1e-6:
                break
        return now

    def system(self, Ts: float) -> LinearSystem:
        """The same as a state space with real numbers."""
        real = np.imag(self.p) == 0
        blocks = [
            np.array([[p.real]]) if r else np.array([[p.real, -p.imag], [p.imag, p.real]])
            for p, r in zip(self.p, real, strict=True)
        ]
        B = np.concatenate([[1.0] if r else [1.0, 0.0] for r in real])
        C = np.column_stack(
            [c for g, r in zip(self.g.T, real, strict=True) for c in ([g.real] if r else [g.real, -g.imag])]
        )
        zero = np.zeros_like(self.offset)
        return LinearSystem(
            _block_diagonal(*blocks),
            np.column_stack([B, np.zeros(len(B))]),
            C,
            np.column_stack([zero, self.offset]),
            np.zeros((len(B), len(C))),
            Ts,
        )

    def _forced(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N n"]:
        return np.vstack([_filtered(self.p, r.u.astype(complex)[:, None]) for r in recordings])

    def _free(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N n"]:
        return np.vstack(
            [
                np.stack([scipy.signal.lfilter([1], [1, -p], np.eye(1, r.N)[0]) for p in self.p], axis=1)
                for r in recordings
            ]
        )

    def _states(self, recordings: Sequence[Recording]) -> Complex[np.ndarray, "N n"]:
        each = np.repeat(self.xi, [r.N for r in recordings], axis=0)
        return self._forced(recordings) + each * self._free(recordings)

    def _errors(self, recordings: Sequence[Recording]) -> Float[np.ndarray, "N C"]:
        y = np.concatenate([r.y for r in recordings]).astype(float)
        return y - self.offset - np.real(self._states(recordings) @ self.g.T)

    def _slopes(self, recordings: Sequence[Recording]) -> Float[np.ndarray, "N C P"]:
        """Of the outputs by decay and angle of the poles, residues, offsets, first states."""
        x, free = self._states(recordings), self._free(recordings)
        ends = np.cumsum([r.N for r in recordings])[:-1]
        by_pole = np.vstack([_filtered(self.p, part) for part in np.split(x, ends)])
        decay, angle = -np.log(np.abs(self.p)), np.angle(self.p)
        C, n, N = len(self.g), len(self.p), len(x)
        columns = []
        for c in range(C):
            slope = by_pole * self.g[c] * self.p
            poles = np.concatenate([(slope * -decay).real, (slope * 1j * angle).real], axis=1)
            residues, offsets = np.zeros((N, 2 * n * C)), np.zeros((N, C))
            residues[:, 2 * n * c : 2 * n * (c + 1)] = _pair(x)
            offsets[:, c] = 1.0
            starts = _by_recording(_pair(free * self.g[c]), recordings)
            columns.append(np.hstack([poles, residues, offsets, starts]))
        return np.stack(columns, axis=1)

    def _moved(self, move: Float[np.ndarray, " P"]) -> "Modes":
        C, n, R = len(self.g), len(self.p), len(self.xi)
        a, b, g, offset, xi = np.split(move, np.cumsum([n, n, 2 * n * C, C]))
        decay = -np.log(np.abs(self.p)) * np.exp(np.clip(a, -1, 1))
        angle = np.angle(self.p)
        turned = np.where(
            np.imag(self.p) == 0, angle, np.clip(angle * np.exp(np.clip(b, -1, 1)), 1e-9, np.pi - 1e-9)
        )
        p = np.exp(-np.maximum(decay, EDGE) + 1j * turned)
        p = np.where(np.imag(self.p) == 0, np.sign(np.real(self.p)) * np.abs(p), p)
        return Modes(
            p,
            self.g + _complex(g.reshape(C, 2 * n), self.p),
            self.offset + offset,
            self.xi + _complex(xi.reshape(R, 2 * n), self.p),
        )


def _filtered(p: np.ndarray, u: np.ndarray) -> Complex[np.ndarray, "N n"]:
    u = np.broadcast_to(u, (len(u), len(p)))
    return np.stack(
        [scipy.signal.lfilter([0, 1], [1, -pole], x) for pole, x in zip(p, u.T, strict=True)], axis=1
    )


def _pair(x: Complex[np.ndarray, "N n"]) -> Float[np.ndarray, "N 2n"]:
    """Re(w x) for w = w_re + i w_im, as columns for w_re and w_im."""
    return np.concatenate([np.real(x), -np.imag(x)], axis=1)


def _complex(w: Float[np.ndarray, "K 2n"], p: np.ndarray) -> Complex[np.ndarray, "K n"]:
    re, im = np.split(w, 2, axis=1)
    return re + 1j * np.where(np.imag(p) == 0, 0.0, im)


def _block_diagonal(*blocks: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.linalg.block_diag(*blocks))


def _by_recording(x: np.ndarray, recordings: Sequence[Recording]) -> np.ndarray:
    """Columns of their own for each recording."""
    return _block_diagonal(*np.split(x, np.cumsum([r.N for r in recordings])[:-1]))


def _least_norm(phi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares by way of the squares, columns of one size; the search goes on from here."""
    size = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    phi = phi / size
    H = phi.T @ phi
    return np.linalg.lstsq(H, phi.T @ y, rcond=1e-10)[0] / size[:, None]


def _cost(e: np.ndarray) -> float:
    cost = float(np.sum(np.log(np.mean(e**2, axis=0) + 1e-300)))
    return cost if np.isfinite(cost) else np.inf
