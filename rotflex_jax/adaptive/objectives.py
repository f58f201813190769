"""What settings of a filter are judged by. The three answers differ by decades, so name the question.

    final       mean square of what the last weights of one recording miss on the other recordings
    mean_error  mean square of the a-priori errors over the whole run
    last_half   the same over its second half

`final` asks for a model and likes small steps. The other two judge the filter while it runs: they
reward weights that follow the record, which no frozen model repeats, and `mean_error` above all a
quick start.
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter, scan
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Objective = Literal["final", "mean_error", "last_half"]


class Batch(eqx.Module):
    """Recordings of one length side by side, and what the best fixed weights make of them.

    The first `n_init` samples are left out: their regressors reach back to before the recording.

    Attributes:
        u: inputs (B, N).
        y: outputs (B, N).
        phi: regressors (B, N - n_init, P) of the basis as given.
        skip: samples left out.
        best: best weights for all recordings but one (B, P), or for all (1, P).
        gram: mean of phi phi' over the same recordings.
        smallest: mean squared error of these weights.
    """

    u: Float[Array, "B N"]
    y: Float[Array, "B N"]
    phi: Float[Array, "B L P"]
    skip: int = eqx.field(static=True)
    best: Float[Array, "K P"]
    gram: Float[Array, "K P P"]
    smallest: Float[Array, " K"]


def batch(basis: Basis, recordings: Sequence[Recording], channel: str, objective: str) -> Batch:
    """Recordings made ready for an objective.

    Args:
        basis: of the regressors.
        recordings: of one length and sampling period; at least two for "final".
        channel: output to be followed.
        objective: "final", "mean_error" or "last_half".

    Raises:
        InputError: an unknown objective, or recordings that do not go together.
    """
    if objective not in get_args(Objective):
        raise InputError(
            f"Argument `objective` must be one of {', '.join(get_args(Objective))}, but is {objective!r}; "
            "choose one."
        )
    least = 2 if objective == "final" else 1
    if len(recordings) < least:
        raise InputError(
            f'The objective "{objective}" needs {least} recordings or more, but {len(recordings)} were '
            "given; cut a long one with Recording.slice."
        )
    lengths, periods = sorted({r.N for r in recordings}), {r.Ts for r in recordings}
    if len(lengths) > 1 or len(periods) > 1:
        raise InputError(
            f"The recordings must have one length and sampling period, but have {lengths} samples and "
            f"{sorted(periods)} s; cut them to the shortest with Recording.slice."
        )
    u = np.stack([np.asarray(r.u, dtype=float) for r in recordings])
    y = np.stack([np.asarray(r.channel(channel), dtype=float) for r in recordings])
    skip = max(r.n_init for r in recordings)
    phi = np.stack([np.asarray(basis.regressors(row), dtype=float)[skip:] for row in u])
    held = range(len(u)) if objective == "final" else [-1]
    best, gram, smallest = [], [], []
    for b in held:
        X = np.concatenate([phi[k] for k in range(len(u)) if k != b])
        Y = np.concatenate([y[k, skip:] for k in range(len(u)) if k != b])
        # Minimum norm: equal columns, as in the full layout, are allowed. The triangle has the answer of
        # all rows, and is found far quicker than their singular values.
        R = np.asarray(np.linalg.qr(np.concatenate([X, Y[:, None]], axis=1), mode="r"))
        w = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=np.finfo(float).eps * max(X.shape))[0]
        best.append(w)
        gram.append(X.T @ X / len(X))
        smallest.append(np.mean((Y - X @ w) ** 2))
    parts = (np.stack(best), np.stack(gram), np.array(smallest))
    return Batch(jnp.asarray(u), jnp.asarray(y), jnp.asarray(phi), skip, *(jnp.asarray(p) for p in parts))


def evaluate(
    data: Batch, objective: Objective, filter: AdaptiveFilter, basis: Any = None
) -> Float[Array, ""]:
    """The objective, traced: settings of the filter and poles of the basis may carry derivatives.

    Args:
        data: recordings.
        objective: which.
        filter: started anew on every recording.
        basis: given where it changes; its error is then compared with the variance of the output,
            for the best weights are no longer the same.

    Returns:
        For a fixed basis the excess over the smallest error, in its units ("final"), or the error in units
        of the smallest; for a changing basis the error in units of the output's variance.
    """
    y = data.y[:, data.skip :]
    phi = data.phi
    if basis is not None:
        phi = jax.vmap(basis.respond)(data.u)[:, data.skip :]
    states, errors = jax.vmap(lambda phi, y: scan(filter, phi, y))(phi, y)
    unit = jnp.var(y) if basis is not None else jnp.mean(data.smallest)
    if objective == "mean_error":
        return jnp.mean(errors**2) / unit
    if objective == "last_half":
        return jnp.mean(errors[:, errors.shape[1] // 2 :] ** 2) / unit
    weights = jax.vmap(filter.weights)(states)
    if basis is None:
        # (w - best)' R (w - best): the excess without the difference of two nearly equal numbers.
        miss = weights - data.best
        return jnp.mean(jnp.einsum("bp,bpq,bq->b", miss, data.gram, miss) / data.smallest)
    e = y[None] - jnp.einsum("blp,ap->abl", phi, weights)
    others = 1 - jnp.eye(len(y), dtype=y.dtype)
    return jnp.sum(others * jnp.mean(e**2, axis=2)) / jnp.sum(others) / unit


def unit(objective: Objective, changing: bool) -> str:
    """What `evaluate` counts in, in words."""
    if changing:
        return "of the output's variance"
    return "of the smallest error, in excess of it" if objective == "final" else "of the smallest error"
