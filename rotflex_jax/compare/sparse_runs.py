"""Free runs of sparse laws over many stretches at once: what they miss, and numbers that miss less."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.compare.sparse_terms import Terms, motions
from rotflex_jax.recording import Recording

# A law that goes so many ranges of the measurement away in a run over a whole recording is out.
REACH = 3.0


@dataclasses.dataclass(frozen=True)
class Piece:
    """A stretch of a recording: smoothed state at its start, input and outputs."""

    x0: Float[np.ndarray, " K"]
    u: Float[np.ndarray, " N"]
    y: Float[np.ndarray, "N C"]


def costs(
    terms: Terms,
    W: Float[np.ndarray, "L P C"],
    pieces: Sequence[Piece],
    train: Sequence[Recording],
    states: Sequence[np.ndarray],
) -> Float[np.ndarray, " L"]:
    """Mean log error of free runs of several laws over the pieces; infinite where one leaves the range."""
    n, C = terms.order * len(terms.channels), len(terms.channels)
    with np.errstate(all="ignore"):
        e = _missed(terms, W, pieces, train[0].Ts)
        cost = np.mean(np.log(np.sqrt(np.mean(e**2, axis=(1, 2))) + 1e-300), axis=1)
        for r, x in zip(train, states, strict=True):
            start = np.broadcast_to(x[0, :n], (len(W), 1, n))
            whole = motions(terms, W, start, r.u[None].astype(float), r.Ts)[:, 0, :, :C]
            reach = np.max(np.abs(whole - r.y[0]) / np.maximum(np.ptp(r.y, axis=0), 1e-300), axis=(1, 2))
            cost = np.where(reach < REACH, cost, np.inf)
    return np.where(np.isnan(cost), np.inf, cost)


def refined(
    terms: Terms, W: Float[np.ndarray, "P C"], pieces: Sequence[Piece], Ts: float, steps: int = 30
) -> Float[np.ndarray, "P C"]:
    """The weights that are not zero, by Levenberg-Marquardt on free runs; each channel counts alike."""
    where = np.nonzero(W)
    free = W[where]
    if not len(free):
        return W

    def laws(values: Float[np.ndarray, "L K"]) -> Float[np.ndarray, "L P C"]:
        out = np.zeros((len(values), *W.shape))
        out[:, where[0], where[1]] = values
        return out

    now = free
    with np.errstate(all="ignore"):
        e = _missed(terms, laws(now[None]), pieces, Ts)[0]
        size, damping = np.sqrt(np.mean(e**2, axis=(0, 1))), 1e-2
        cost = _log_error(e)
        for _ in range(steps):
            h = 1e-4 * np.maximum(np.abs(now), 1e-3 * np.abs(free))
            runs = _missed(terms, laws(now + np.vstack([0 * h, np.diag(h)])), pieces, Ts) / size
            flat = runs.reshape(len(runs), -1)
            J = (flat[1:] - flat[0]).T
            if not np.isfinite(J).all():
                break
            H, b = J.T @ J, J.T @ flat[0]
            scale = np.sqrt(np.maximum(np.diag(H), 1e-12 * np.diag(H).max()))
            H, b = H / np.outer(scale, scale), b / scale
            dampings = damping * 5.0 ** np.arange(-1, 6)
            moves = [np.linalg.solve(H + d * np.eye(len(b)), b) / scale * h for d in dampings]
            lanes = now - np.array(moves)
            missed = _missed(terms, laws(lanes), pieces, Ts)
            found = np.array([_log_error(m) for m in missed])
            best = int(np.argmin(found))
            if not found[best] < cost - 1e-5:
                break
            now, e, cost, damping = lanes[best], missed[best], found[best], max(dampings[best], 1e-9)
            size = np.sqrt(np.mean(e**2, axis=(0, 1)))
    return laws(now[None])[0]


def _missed(
    terms: Terms, W: Float[np.ndarray, "L P C"], pieces: Sequence[Piece], Ts: float
) -> Float[np.ndarray, "L M N C"]:
    """Errors of free runs of several laws over all pieces."""
    n, C = terms.order * len(terms.channels), len(terms.channels)
    start = np.stack([p.x0[:n] for p in pieces])
    start = np.broadcast_to(start, (len(W), *start.shape))
    return motions(terms, W, start, np.stack([p.u for p in pieces]), Ts)[..., :C] - np.stack(
        [p.y for p in pieces]
    )


def _log_error(e: np.ndarray) -> float:
    cost = float(np.mean(np.log(np.sqrt(np.mean(e**2, axis=(0, 1))) + 1e-300)))
    return cost if np.isfinite(cost) else np.inf
