"""A neural network for the missing torque at hub and joint, trained in simulation, then explained by terms.

This is a universal differential equation: the linear joint is kept, and a small network adds a torque at hub
and joint that depends on angles, speeds and voltage. Short free runs from smoothed states are compared with
the recording, and Adam updates the weights. The torque of the network along the motion is then explained by
the same terms and the same forward selection as in the torque balance.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.motion import Motion, Values, motions
from rotflex_jax.arena.rivals.selection import Regression, rows, select
from rotflex_jax.arena.rivals.terms import linear_columns, terms
from rotflex_jax.mechanism.linear import zero_order_hold

WIDTH, RUN_SECONDS, STEPS, RATE = 24, 0.5, 1200, 5e-3


def neural(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Trains a network on each recording; terms for the torque of the first must also explain the second."""
    m, after = motions(train, validation)
    torque, left = learn(m)
    said = learn(after)[0]
    # Every fifth sample only: neighbouring samples contain nearly the same information.
    thin = slice(None, None, 5)
    unit = np.diag(1 / (np.std(torque, axis=0) + 1e-12))

    def regression(m: Motion, torque: Values) -> Regression:
        flat = [rows(t.columns[thin], unit) for t in terms(m)]
        return Regression(rows(torque[thin, :, None], unit)[:, 0], rows(linear_columns(m)[thin], unit), flat)

    answer = select(regression(m, torque), regression(after, said), terms(m))
    return answer._replace(note=f"runs left with {left:.2g} of the error; {answer.note}")


def learn(m: Motion) -> tuple[Values, float]:
    """Generalised torque (N, 2) of the network along the motion, and the remaining share of the error."""
    n = len(m.joint.A)
    push = np.zeros((n, 2))
    push[2:4] = np.linalg.inv(m.mass)
    A, B = zero_order_hold(m.joint.A, np.column_stack([m.joint.B, push]), m.Ts)
    length = round(RUN_SECONDS / m.Ts)
    runs = len(m.u) // length
    cut = lambda x: x[: runs * length].reshape(runs, length, *x.shape[1:])  # noqa: E731
    x = np.hstack([m.q, m.v])
    if n > 4:
        x = np.hstack([x, np.zeros((len(x), n - 4))])
    size = np.std(np.column_stack([x[:, :4], m.u]), axis=0)
    spread = np.std(m.missing, axis=0)
    rng = np.random.default_rng(0)
    weights = {
        "a": rng.standard_normal((5, WIDTH)) / np.sqrt(5),
        "b": rng.standard_normal(WIDTH),
        "c": rng.standard_normal((WIDTH, WIDTH)) / np.sqrt(WIDTH),
        "d": np.zeros(WIDTH),
        "e": 0.01 * rng.standard_normal((WIDTH, 2)),
    }
    data = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.float32),
        (weights, A, B, size, spread, cut(x), cut(m.u), np.std(m.q, axis=0)),
    )
    trained, losses = _train(*data)
    say = jax.vmap(lambda s, u: _torque(trained, s, u, data[3], data[4]))
    torque = say(jnp.asarray(x, jnp.float32), jnp.asarray(m.u, jnp.float32))
    return np.asarray(torque, float), float(losses[-1] / losses[0])


def _torque(w: Any, x: jax.Array, u: jax.Array, size: jax.Array, spread: jax.Array) -> jax.Array:
    z = jnp.append(x[:4], u) / size
    h = jnp.tanh(jnp.tanh(z @ w["a"] + w["b"]) @ w["c"] + w["d"])
    return (h @ w["e"]) * spread


@functools.partial(jax.jit)
def _train(w: Any, A: Any, B: Any, size: Any, spread: Any, x: Any, u: Any, unit: Any) -> Any:
    def loss(w: Any) -> jax.Array:
        def run(x0: jax.Array, us: jax.Array) -> jax.Array:
            def step(s: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
                tau = _torque(w, s, v, size, spread)
                return A @ s + B @ jnp.append(v, tau), s[:2]

            return jax.lax.scan(step, x0, us)[1]

        runs = jax.vmap(run)(x[:, 0], u)
        return jnp.mean(jnp.square((runs - x[:, :, :2]) / unit))

    def update(carry: Any, k: jax.Array) -> tuple[Any, jax.Array]:
        w, first, second = carry
        value, g = jax.value_and_grad(loss)(w)
        norm = jnp.sqrt(sum(jnp.sum(v**2) for v in jax.tree.leaves(g)))
        g = jax.tree.map(lambda v: v * jnp.minimum(1.0, 1.0 / (norm + 1e-12)), g)
        first = jax.tree.map(lambda f, v: 0.9 * f + 0.1 * v, first, g)
        second = jax.tree.map(lambda s, v: 0.999 * s + 0.001 * v**2, second, g)
        rate = RATE * 0.5 * (1 + jnp.cos(jnp.pi * k / STEPS))
        w = jax.tree.map(
            lambda p, f, s: (
                p - rate * (f / (1 - 0.9 ** (k + 1))) / (jnp.sqrt(s / (1 - 0.999 ** (k + 1))) + 1e-10)
            ),
            w,
            first,
            second,
        )
        return (w, first, second), value

    zero = jax.tree.map(jnp.zeros_like, w)
    (w, _, _), losses = jax.lax.scan(update, (w, zero, zero), jnp.arange(STEPS, dtype=jnp.float32))
    return w, losses
