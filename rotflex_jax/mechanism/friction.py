"""Dry friction over one step: sliding, sticking or breakaway, including a stop within the step.

Each contact acts as a torque `f` that is constant over the step, `|f| <= level`. If the port keeps its
direction, `f` is the full level. If it stops at a fraction `t` of the step, either the remaining drive is
within the level and the port stays at rest, or it breaks away in the other direction and the level counts
with one sign for `t` and with the other for `1 - t`. Sticking is exact: a port at rest does not move while
the drive stays within the level.
"""

import functools
import operator
from typing import NamedTuple

import jax
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
    """Whether a speed is zero up to rounding errors; arguments as in `independent_contacts`."""
    return jnp.abs(v0) <= 64 * jnp.finfo(v0.dtype).eps * (jnp.abs(free) + stop * (up + down))


def divided(above: Float[Array, "*S"], below: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """`above / below`; `above` where `below` is zero, or so small that the derivative is not finite.

    The derivative divides by the square of `below`. The speed of a machine that friction holds under no drive
    falls by a factor of 1e16 from sample to sample, through numbers whose square is zero.
    """
    return above / jnp.where(jnp.abs(below) < jnp.finfo(below.dtype).tiny ** 0.5, 1.0, below)


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
    t = divided(v0, moved)
    rests = ~keeps & (jnp.abs(drive) <= turned)
    reverses = -(t * sign * level + (1 - t) * jnp.sign(drive) * turned)
    f = jnp.where(keeps, -sign * level, jnp.where(rests, -free / stop, reverses))
    # In units of the mean level: a constant torque shifts both levels but does not change their mean.
    band = (up + down) / 2
    beyond = jnp.maximum(0.0, (jnp.abs(drive) - turned) / jnp.where(band == 0, 1.0, band))
    holds = jnp.where((band == 0) | keeps, 0.0, jnp.maximum(0.0, 1.0 - beyond))
    return Contact(f, t, holds, ~keeps)


def sliding_torques(
    v0: Float[Array, "*S"], up: Float[Array, "*S"], down: Float[Array, "*S"]
) -> Float[Array, "*S"]:
    """Torques of contacts that keep their direction; arguments as in `independent_contacts`."""
    return -jnp.sign(v0) * jnp.where(v0 > 0, up, down)


def all_slide(
    v0: Float[Array, "k *S"],
    free: Float[Array, "k *S"],
    stop: Float[Array, "k k *D"],
    up: Float[Array, "k *S"],
    down: Float[Array, "k *S"],
) -> Bool[Array, "*S"]:
    """Whether all contacts keep their direction, each by itself and together.

    If so, `coupled_contacts` gives the torques of `sliding_torques`. Arguments as in `coupled_contacts`.
    """
    k, torque = len(v0), sliding_torques(v0, up, down)
    keeps = []
    for i in range(k):
        own = expand_axes(stop[i, i], v0[i])
        alone = free[i] + own * torque[i]
        together = sum((expand_axes(stop[i, j], v0[i]) * torque[j] for j in range(k) if j != i), alone)
        sign = jnp.sign(v0[i])
        rests = at_rest(v0[i], free[i], own, up[i], down[i])
        keeps.append((sign * alone > 0) & (sign * together > 0) & ~rests)
    return functools.reduce(operator.and_, keeps)


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
    ridge of 1e-10 regularises contacts that share one direction of motion. Beyond its first two axes the
    matrix has no further axes, or the further axes of the other arguments.
    """
    k = matrix.shape[0]
    if k == 1:
        return jnp.where(mask, rhs / expand_axes(matrix, rhs[None])[0], other)
    ridge = 1e-10 * jnp.max(jnp.abs(matrix), axis=(0, 1), keepdims=True)
    matrix = matrix + ridge * expand_axes(jnp.eye(k, dtype=matrix.dtype), matrix)
    part = lambda a: expand_axes(a, rhs[0])  # noqa: E731
    rows = [
        [*(jnp.where(own, part(matrix[i, j]), float(i == j)) for j in range(k)), jnp.where(own, b, f)]
        for i, (own, b, f) in enumerate(zip(mask, rhs, other, strict=True))
    ]
    for i in range(k):  # Gauss-Jordan
        scale = 1 / rows[i][i]
        rows[i] = [entry * scale for entry in rows[i]]
        rows = [
            row if j == i else [x - row[i] * p for x, p in zip(row, rows[i], strict=True)]
            for j, row in enumerate(rows)
        ]
    return jnp.stack([row[k] for row in rows])


def coupled_contacts(
    v0: Float[Array, "k *S"],
    free: Float[Array, "k *S"],
    stop: Float[Array, "k k *D"],
    up: Float[Array, "k *S"],
    down: Float[Array, "k *S"],
    passes: int | None = None,
) -> Contact:
    """Contacts that are coupled through the mechanism.

    Contacts at rest are first assumed to stick, and are eliminated. The other contacts respond with the
    mobility that remains. Sticking contacts whose torque exceeds their level slide in the next pass.

    For k contacts, k + 1 passes solve any case of two contacts. Where three contacts break away together,
    about one case in a hundred lets a contact slide during that step although the others would hold it again.
    Two passes solve all cases except those in which several contacts stop or break away in one step.

    Args:
        v0: Port speeds at the start [rad/s].
        free: Port speeds at the end without friction [rad/s].
        stop: Speed that a unit torque at one contact gives another in one step [rad/s per N m]; beyond its
            first two axes it has no further axes, or the further axes of the other arguments.
        up: Levels against positive motion [N m].
        down: Levels against negative motion [N m].
        passes: Number of passes; the number of contacts plus one if None.
    """
    k = v0.shape[0]
    if k == 1:
        return independent_contacts(v0, free, expand_axes(stop[0], v0), up, down)
    return _coupled(v0, free, stop, up, down, k + 1 if passes is None else passes)


# Traced once for all calls, in this step or in others, whose arrays have equal shapes.
@functools.partial(jax.jit, static_argnames="passes")
def _coupled(v0: Array, free: Array, stop: Array, up: Array, down: Array, passes: int) -> Contact:
    """Several contacts; arguments as in `coupled_contacts`."""
    k = v0.shape[0]
    # Contact by contact: rows stacked to a matrix would put a branch into the compiled loop over the entries.
    every, (start, end, forward, back) = range(k), map(jnp.unstack, (v0, free, up, down))
    mobility = [[expand_axes(stop[i, j], start[0]) for j in every] for i in every]
    slack = 1 + 1e3 * jnp.finfo(start[0].dtype).eps
    # A contact without a level does not stick.
    held = [
        at_rest(start[i], end[i], mobility[i][i], forward[i], back[i]) & (forward[i] + back[i] > 0)
        for i in every
    ]
    f = [jnp.zeros_like(start[0])] * k
    for last in (*[False] * (passes - 1), True):
        rows, needed = [[*mobility[i], end[i]] for i in every], []
        for i in every:  # Gauss-Jordan
            # With three contacts on two coordinates, one that the other two hold at rest carries no torque.
            needed.append(held[i] & (rows[i][i] > 1e-5 * mobility[i][i]))
            scale = 1 / jnp.where(needed[i], rows[i][i], 1.0)
            pivot = [entry * scale for entry in rows[i]]
            rows = [
                [
                    jnp.where(needed[i], p if j == i else entry - row[i] * p, entry)
                    for entry, p in zip(row, pivot, strict=True)
                ]
                for j, row in enumerate(rows)
            ]
        A, b = [row[:k] for row in rows], [row[k] for row in rows]
        found = [
            independent_contacts(
                start[i],
                sum((A[i][j] * f[j] for j in every if j != i), b[i]),
                jnp.where(held[i], mobility[i][i], jnp.maximum(A[i][i], 1e-6 * mobility[i][i])),
                forward[i],
                back[i],
            )
            for i in every
        ]
        f = [jnp.where(held[i], 0.0, found[i].torque) for i in every]
        torque = [jnp.where(needed[i], -sum((A[i][j] * f[j] for j in every), b[i]), f[i]) for i in every]
        if last:
            break
        fits = [(torque[i] <= back[i] * slack) & (torque[i] >= -forward[i] * slack) for i in every]
        f = [jnp.where(held[i] & ~fits[i], limited(torque[i], forward[i], back[i]), f[i]) for i in every]
        held = [held[i] & fits[i] for i in every]
    return Contact(
        torque=jnp.stack([limited(torque[i], forward[i], back[i]) for i in every]),
        t=jnp.stack([jnp.where(held[i], 0.0, found[i].t) for i in every]),
        holds=jnp.stack([jnp.where(held[i], 1.0, found[i].holds) for i in every]),
        crossed=jnp.stack([held[i] | found[i].crossed for i in every]),
    )
