"""Kalman filter and fixed-interval smoother of a linear time-varying model.

    s[k+1] = A[k] s[k] + c[k] + w,   y[k] = H[k] s[k] + g[k] + v

The channels of a sample are taken one after the other, so nothing is inverted; covariances move in
Joseph's form. The backward pass is that of Bryson and Frazier: it equals the one of Rauch, Tung and Striebel
where that exists, and also serves where the process noise is singular, as it is here.

Source: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters 2 and 10.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import export


class Linear(NamedTuple):
    """A linear model along one recording.

    Attributes:
        A: Transitions (N, m, m).
        c: Their constant parts (N, m).
        H: Slopes of the outputs (N, C, m).
        y: Measured outputs less their constant parts (N, C).
        seen: One where a sample counts (N,).
    """

    A: Any
    c: Any
    H: Any
    y: Any
    seen: Any


export.register_namedtuple_serialization(Linear, serialized_name=f"{__name__}.Linear")


class Start(NamedTuple):
    """First state: mean (m,) and variances (m,)."""

    mean: Any
    variance: Any


class _Update(NamedTuple):
    """What the backward pass needs of one channel: gain, innovation, its variance."""

    gain: jax.Array
    e: jax.Array
    S: jax.Array


def _product(A: jax.Array, B: jax.Array) -> jax.Array:
    """`A @ B` as multiply and add, which the compiler fuses into the loop."""
    return jnp.sum(A[:, :, None] * B[None], axis=1)


def _times(A: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.sum(A * x[None], axis=1)


def _corrected(
    m: jax.Array, P: jax.Array, H: jax.Array, y: jax.Array, seen: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, list[_Update]]:
    """Mean and covariance after the channels of one sample."""
    updates = []
    for c in range(H.shape[0]):
        h, r = H[c], noise[c] ** 2
        Ph = _times(P, h)
        S = jnp.sum(h * Ph) + r
        K = seen * Ph / S
        e = y[c] - jnp.sum(h * m)
        m = m + K * e
        half = P - K[:, None] * Ph[None]
        P = half - _times(half, h)[:, None] * K[None] + r * K[:, None] * K[None]
        updates.append(_Update(K, e, S))
    return m, (P + P.T) / 2, updates


def _moved(
    m: jax.Array, P: jax.Array, A: jax.Array, c: jax.Array, Q: jax.Array
) -> tuple[jax.Array, jax.Array]:
    moved = _product(_product(A, P), A.T)
    return _times(A, m) + c, (moved + moved.T) / 2 + jnp.diag(Q)


def log_likelihood(model: Linear, start: Start, noise: jax.Array, Q: jax.Array) -> jax.Array:
    """Log-likelihood of one recording [nat].

    Args:
        model: Along the recording.
        start: First state.
        noise: Deviation of the sensor noise per channel (C,).
        Q: Variance that the process noise adds to each state per sample (m,).
    """

    def step(carry: Any, row: Linear) -> Any:
        m, P, total = carry
        m, P, updates = _corrected(m, P, row.H, row.y, row.seen, noise)
        density = sum(jnp.log(2 * jnp.pi * u.S) + u.e**2 / u.S for u in updates)
        return (*_moved(m, P, row.A, row.c, Q), total - 0.5 * row.seen * density), None

    begin = (start.mean, jnp.diag(start.variance), jnp.zeros((), start.mean.dtype))
    return jax.lax.scan(step, begin, model)[0][2]


def smoothed(model: Linear, start: Start, noise: jax.Array, Q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean (N, m) and variance (N, m) of the states, given the whole recording; arguments as above."""

    def forward(carry: Any, row: Linear) -> Any:
        m, P = carry
        m1, P1, updates = _corrected(m, P, row.H, row.y, row.seen, noise)
        return _moved(m1, P1, row.A, row.c, Q), (m, P, updates)

    _, passed = jax.lax.scan(forward, (start.mean, jnp.diag(start.variance)), model)

    def backward(carry: Any, row: Any) -> Any:
        # Slope and curvature of the log-likelihood of what follows, as seen from the state.
        pull, weight = carry
        at, (m, P, updates) = row
        pull, weight = _times(at.A.T, pull), _product(_product(at.A.T, weight), at.A)
        for c in reversed(range(at.H.shape[0])):
            h, u = at.H[c], updates[c]
            pull = pull - h * jnp.sum(u.gain * pull) - at.seen * h * u.e / u.S
            left = weight - h[:, None] * _times(weight.T, u.gain)[None]
            weight = left - _times(left, u.gain)[:, None] * h[None] + at.seen * h[:, None] * h[None] / u.S
        weight = (weight + weight.T) / 2
        variance = jnp.diagonal(P) - jnp.sum(_product(P, weight) * P, axis=1)
        return (pull, weight), (m - _times(P, pull), jnp.maximum(variance, 0.0))

    m = model.A.shape[1]
    zero = (jnp.zeros(m, model.A.dtype), jnp.zeros((m, m), model.A.dtype))
    return jax.lax.scan(backward, zero, (model, passed), reverse=True)[1]
