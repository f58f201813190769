"""Dry friction over one step: it brakes, holds, or lets go, with the stop inside the step resolved.

Each contact acts as a torque `f` that is constant over the step, `|f| <= level`. If the port keeps its
direction, `f` is the full level. If it comes to rest at a fraction `t` of the step, either the remaining
drive is within the level and the port stays at rest, or it breaks away in the other direction and the
level counts with one sign for `t` and with the other for `1 - t`. Sticking is exact: a port at rest does
not move at all while the drive stays within the level.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Contact(NamedTuple):
    """What contacts do over a step; one entry per contact.

    Attributes:
        torque: Torque on the port [N m].
        t: Fraction of the step until the port first stops.
        rests: Whether it is at rest at the end.
        crossed: Whether it passed through rest.
    """

    torque: jax.Array
    t: jax.Array
    rests: jax.Array
    crossed: jax.Array


def contact(
    v0: jax.Array, free: jax.Array, stop: jax.Array, up: jax.Array, down: jax.Array
) -> Contact:
    """Independent contacts.

    Args:
        v0: Port speed at the start [rad/s].
        free: Port speed at the end without this contact [rad/s].
        stop: Speed that a unit torque gives the port in one step [rad/s per N m].
        up: Level against positive motion [N m].
        down: Level against negative motion [N m].
    """
    sign = jnp.sign(v0)
    level = jnp.where(v0 > 0, up, down)
    sliding = free - stop * sign * level
    keeps = sign * sliding > 0
    drive = (free - v0) / stop
    turned = jnp.where(drive > 0, up, down)
    moved = v0 - sliding
    t = v0 / jnp.where(moved == 0, 1.0, moved)
    rests = ~keeps & (jnp.abs(drive) <= turned)
    reverses = -(t * sign * level + (1 - t) * jnp.sign(drive) * turned)
    f = jnp.where(keeps, -sign * level, jnp.where(rests, -free / stop, reverses))
    return Contact(f, t, rests, ~keeps)


def solve_masked(matrix: jax.Array, mask: jax.Array, rhs: jax.Array, other: jax.Array) -> jax.Array:
    """Solve `matrix[m, :] f = rhs[m]` for the masked rows m, with `f = other` in the rest.

    Elimination is unrolled: a handful of contacts, no library call inside a scan. A ridge of 1e-10 keeps
    contacts solvable that share one direction of motion. `matrix` is (k, k), the others (k, ...).
    """
    k, batch = matrix.shape[0], rhs.ndim - 1
    if k == 1:
        return jnp.where(mask, rhs / matrix[0, 0], other)
    eye = jnp.eye(k, dtype=matrix.dtype)
    ridge = 1e-10 * jnp.max(jnp.abs(matrix))
    wide = lambda m: m.reshape(m.shape + (1,) * batch)  # noqa: E731
    full = jnp.where(mask[:, None], wide(matrix + ridge * eye), wide(eye))
    full = jnp.concatenate([full, jnp.where(mask, rhs, other)[:, None]], axis=1)
    rows = [full[i] for i in range(k)]
    for i in range(k):  # Gauss-Jordan
        rows[i] = rows[i] / rows[i][i][None]
        rows = [r if j == i else r - r[i][None] * rows[i] for j, r in enumerate(rows)]
    return jnp.stack([r[k] for r in rows])


def contacts(
    v0: jax.Array, free: jax.Array, stop: jax.Array, up: jax.Array, down: jax.Array
) -> Contact:
    """Contacts that are coupled through the mechanism.

    Sweeps decide which contacts rest; those are then solved for together, and the others answer.

    Args:
        v0: Port speeds at the start (k, ...) [rad/s].
        free: Port speeds at the end without friction (k, ...) [rad/s].
        stop: Speed that a unit torque at one contact gives another in one step (k, k).
        up: Levels against positive motion (k, ...) [N m].
        down: Levels against negative motion (k, ...) [N m].
    """
    k = v0.shape[0]
    wide = lambda m: m.reshape(m.shape + (1,) * (v0.ndim - 1))  # noqa: E731
    own = wide(jnp.stack([stop[i, i] for i in range(k)]))
    if k == 1:
        return contact(v0, free, own, up, down)
    cross = wide(stop * (1 - jnp.eye(k, dtype=stop.dtype)))

    def answer(f: jax.Array) -> Contact:
        return contact(v0, free + jnp.sum(cross * f[None], axis=1), own, up, down)

    swept = answer(answer(contact(v0, free, own, up, down).torque).torque)
    together = solve_masked(stop, swept.rests, -free, swept.torque)
    torque = jnp.clip(together, -up, down)
    return answer(torque)._replace(torque=torque)
