"""Dry friction over one step: sliding, sticking or breakaway, with the stop inside the step resolved.

Each contact acts as a torque `f` that is constant over the step, `|f| <= level`. If the port keeps its
direction, `f` is the full level. If it stops at a fraction `t` of the step, either the remaining drive is
within the level and the port stays at rest, or it breaks away in the other direction and the level counts
with one sign for `t` and with the other for `1 - t`. Sticking is exact: a port at rest does not move while
the drive stays within the level.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rotflex_jax.mechanism.small_matrices import expand_axes


class Contact(NamedTuple):
    """Result of contacts over a step; one entry per contact.

    Attributes:
        torque: Torque on the port [N m].
        t: Fraction of the step until the port first stops.
        holds: One where the port is at rest at the end, falling to zero as the drive grows from one level
            to two; without this transition the position would jump at breakaway.
        crossed: Whether the speed passed through zero.
    """

    torque: Float[Array, "*S"]
    t: Float[Array, "*S"]
    holds: Float[Array, "*S"]
    crossed: Bool[Array, "*S"]


def at_rest(
    v0: Float[Array, "*S"],
    free: Float[Array, "*S"],
    stop: Float[Array, "*#S"],
    up: Float[Array, "*S"],
    down: Float[Array, "*S"],
) -> Bool[Array, "*S"]:
    """Whether a speed is zero to rounding; arguments as in `independent_contacts`."""
    return jnp.abs(v0) <= 64 * jnp.finfo(v0.dtype).eps * (jnp.abs(free) + stop * (up + down))


def independent_contacts(
    v0: Float[Array, "*S"],
    free: Float[Array, "*S"],
    stop: Float[Array, "*#S"],
    up: Float[Array, "*S"],
    down: Float[Array, "*S"],
) -> Contact:
    """Contacts that do not influence each other.

    Args:
        v0: Port speed at the start [rad/s].
        free: Port speed at the end without this contact [rad/s].
        stop: Speed that a unit torque gives the port in one step [rad/s per N m].
        up: Level against positive motion [N m].
        down: Level against negative motion [N m].
    """
    v0 = jnp.where(at_rest(v0, free, stop, up, down), 0.0, v0)
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
    # In units of the mean level, which a constant torque does not change.
    band = (up + down) / 2
    beyond = jnp.maximum(0.0, (jnp.abs(drive) - turned) / jnp.where(band == 0, 1.0, band))
    holds = jnp.where((band == 0) | keeps, 0.0, jnp.maximum(0.0, 1.0 - beyond))
    return Contact(f, t, holds, ~keeps)


def limited(f: Float[Array, "*S"], up: Float[Array, "*S"], down: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Torques limited to their levels.

    Not `clip`: where torque and level are both zero it halves the derivative with respect to the level.
    """
    return jnp.where(f > down, down, jnp.where(f < -up, -up, f))


def solve_masked(
    matrix: Float[Array, "k k *D"],
    mask: Bool[Array, "k *S"],
    rhs: Float[Array, "k *S"],
    other: Float[Array, "k *S"],
) -> Float[Array, "k *S"]:
    """Solve `matrix[m, :] f = rhs[m]` for the masked rows m, with `f = other` in the others.

    Elimination is unrolled: there are few contacts, and a library call would break the fusion of the scan. A
    ridge of 1e-10 regularises contacts that share one direction of motion. The matrix has no axes beyond the
    second, or those of the other arguments.
    """
    k = matrix.shape[0]
    matrix = expand_axes(matrix, rhs[None])
    if k == 1:
        return jnp.where(mask, rhs / matrix[0], other)
    eye = expand_axes(jnp.eye(k, dtype=matrix.dtype), matrix)
    ridge = 1e-10 * jnp.max(jnp.abs(matrix), axis=(0, 1), keepdims=True)
    full = jnp.where(mask[:, None], matrix + ridge * eye, eye)
    full = jnp.concatenate([full, jnp.where(mask, rhs, other)[:, None]], axis=1)
    rows = [full[i] for i in range(k)]
    for i in range(k):  # Gauss-Jordan
        rows[i] = rows[i] / rows[i][i][None]
        rows = [r if j == i else r - r[i][None] * rows[i] for j, r in enumerate(rows)]
    return jnp.stack([r[k] for r in rows])


def coupled_contacts(
    v0: Float[Array, "k *S"],
    free: Float[Array, "k *S"],
    stop: Float[Array, "k k *D"],
    up: Float[Array, "k *S"],
    down: Float[Array, "k *S"],
    passes: int | None = None,
) -> Contact:
    """Contacts that are coupled through the mechanism.

    Contacts at rest are first assumed to stick and are eliminated; the others respond with the remaining
    mobility, and those that exceed their level slide in the next pass. One pass more than there are contacts
    solves any case of two; of three that break away together, one in a hundred lets a contact go for that
    step which the others would hold again. Two passes solve all but cases in which several contacts stop or
    break away in one step.

    Args:
        v0: Port speeds at the start [rad/s].
        free: Port speeds at the end without friction [rad/s].
        stop: Speed that a unit torque at one contact gives another in one step [rad/s per N m]; no axes
            beyond the second, or those of the other arguments.
        up: Levels against positive motion [N m].
        down: Levels against negative motion [N m].
        passes: One more than contacts if None.
    """
    k = v0.shape[0]
    own = expand_axes(jnp.stack([stop[i, i] for i in range(k)]), v0)
    if k == 1:
        return independent_contacts(v0, free, own, up, down)
    eye = expand_axes(jnp.eye(k, dtype=stop.dtype), v0[None])
    stop = jnp.broadcast_to(expand_axes(stop, v0[None]), (k, *v0.shape))
    full = jnp.concatenate([stop, free[:, None]], axis=1)
    slack = 1 + 1e3 * jnp.finfo(v0.dtype).eps
    # A contact without a level does not stick.
    held = at_rest(v0, free, own, up, down) & (up + down > 0)
    f = jnp.zeros_like(v0)
    for last in (*[False] * (k if passes is None else passes - 1), True):
        rows, needed = [full[i] for i in range(k)], []
        for i in range(k):  # Gauss-Jordan
            # Three contacts on two coordinates: one that is at rest by the others alone carries no torque.
            needed.append(held[i] & (rows[i][i] > 1e-5 * own[i]))
            pivot = rows[i] / jnp.where(needed[i], rows[i][i], 1.0)[None]
            rows = [
                jnp.where(needed[i][None], pivot if j == i else row - row[i][None] * pivot, row)
                for j, row in enumerate(rows)
            ]
        A, b = jnp.stack([row[:k] for row in rows]), jnp.stack([row[k] for row in rows])
        mobile = jnp.where(held, own, jnp.maximum(jnp.sum(A * eye, axis=1), 1e-6 * own))
        found = independent_contacts(v0, b + jnp.sum(A * (1 - eye) * f[None], axis=1), mobile, up, down)
        f = jnp.where(held, 0.0, found.torque)
        torque = jnp.where(jnp.stack(needed), -(b + jnp.sum(A * f[None], axis=1)), f)
        if last:
            break
        fits = (torque <= down * slack) & (torque >= -up * slack)
        f = jnp.where(held & ~fits, limited(torque, up, down), f)
        held = held & fits
    return Contact(
        torque=limited(torque, up, down),
        t=jnp.where(held, 0.0, found.t),
        holds=jnp.where(held, 1.0, found.holds),
        crossed=held | found.crossed,
    )
