"""Levenberg-Marquardt on the normal equations of free runs, compiled as one loop, start after start."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import export
from jax.sharding import Mesh
from jaxtyping import Array, Float

from rotflex_jax.devices import spread
from rotflex_jax.fit.normal_equations import Sums, moved_by, normal_equations
from rotflex_jax.fit.residuals import Data
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.absent import Numbers, Samples
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.parameters import Transform

BOUND = 1.0
"""Most that one coordinate moves in a step; of a parameter with a bound, a factor of e."""
ENOUGH = 1e-9
"""A step that would lower the cost by less than this share of it is not taken."""
ROUGHLY = 1e-3
"""The same where starts are only put in order."""


class Problem(NamedTuple):
    """What all starts have in common.

    Attributes:
        values: Of all parameters; those that are not free stay (P,).
        free: Places of the free ones (K,).
        data: The recordings.
        scale: Size of the error of each channel (C,).
    """

    values: Any
    free: Any
    data: Data
    scale: Any


class Place(NamedTuple):
    """Where a start stands: free coordinates (K,), first states (R, m), their sums, and how it got there.

    `step` is what comes next, of both, and `done` whether it is worth a run.
    """

    z: Array
    x0: Array
    sums: Sums
    damping: Array
    step: tuple[Array, Array]
    steps: Array
    done: Array


class Reached(NamedTuple):
    """Where starts ended: values of all parameters (S, P), first states (S, R, m), costs (S,), steps (S,)."""

    values: Any
    x0: Any
    cost: Any
    steps: Any
    z: Any


export.register_namedtuple_serialization(Reached, serialized_name=f"{__name__}.Reached")


@kept(static=3)
def descend(
    structure: Mechanism,
    solver: Solver,
    mesh: Mesh | None,
    z: Float[Array, "S K"],
    x0: Float[Array, "S R m"],
    problem: Problem,
    most: int,
    enough: float = ENOUGH,
) -> Reached:
    """Where every start leads, on each device one after the other.

    Side by side they would wait for the slowest, and a run with all its sums fills a core as it is.

    Args:
        structure: Mechanism without numbers; static.
        solver: Integration rule; static.
        mesh: Devices that the starts are shared out to; None for one device; static.
        z: Unconstrained coordinates of the free parameters at each start.
        x0: First positions and speeds at each start.
        problem: What they have in common.
        most: Most runs of each.
        enough: Share of the cost below which there is nothing more to gain.
    """
    return spread(functools.partial(_every, structure, solver), mesh)((z, x0), problem, most, enough)


def _every(
    structure: Mechanism,
    solver: Solver,
    starts: tuple[Array, Array],
    problem: Problem,
    most: int,
    enough: float,
) -> Reached:
    transform = Transform.of(structure.parameter_specifications)

    def values(z: Array) -> Array:
        whole = jnp.zeros_like(problem.values).at[problem.free].set(z)
        return problem.values.at[problem.free].set(transform.constrain(whole)[problem.free])

    def sums(z: Array, x0: Array) -> Sums:
        p, slopes = jax.jvp(values, (z,), (jnp.ones_like(z),))
        ways = moved_by(structure, slopes, problem.free, x0.shape[1])
        gates = jnp.ones(len(structure.effects), p.dtype)

        def run(r: Any) -> Sums:
            numbers = Numbers(p, gates, whole_state(structure, r[0]), None)
            return normal_equations(structure, solver, numbers, ways, Samples(*r[1]), problem.scale)

        return jax.lax.map(run, (x0, tuple(problem.data)))

    def one(start: tuple[Array, Array]) -> Reached:
        z, x0 = start
        first = _there(z, x0, sums(z, x0), jnp.asarray(1e-3), jnp.asarray(1), enough)
        turn = functools.partial(_turn, sums, enough)
        end = jax.lax.while_loop(lambda p: ~p.done & (p.steps < most), turn, first)
        return Reached(values(end.z), end.x0, jnp.sum(end.sums.cost), end.steps, end.z)

    return jax.lax.map(one, starts)


def _turn(sums: Any, enough: float, place: Place) -> Place:
    """One step, taken where it lowers the cost."""
    z, x0 = place.z + place.step[0], place.x0 + place.step[1]
    trial = sums(z, x0)
    before, after = jnp.sum(place.sums.cost), jnp.sum(trial.cost)
    better = after < before  # not where it is not a number
    keep = lambda new, old: jnp.where(better, new, old)  # noqa: E731
    damping = jnp.where(better, jnp.maximum(place.damping / 10, 1e-12), place.damping * 8)
    kept = Sums(*(keep(new, old) for new, old in zip(trial, place.sums, strict=True)))
    there = _there(keep(z, place.z), keep(x0, place.x0), kept, damping, place.steps + 1, enough)
    return there._replace(done=there.done | (better & (before - after <= enough * after)))


def _there(z: Array, x0: Array, sums: Sums, damping: Array, steps: Array, enough: float) -> Place:
    """A place with the step that comes next; done where hardly anything is left to gain."""
    step = _step(z, sums, damping)
    d = jnp.concatenate([jnp.broadcast_to(step[0], (len(x0), len(z))), step[1]], axis=1)
    expected = -jnp.sum(d * sums.g) - jnp.einsum("ri,rij,rj->", d, sums.H, d) / 2
    cost = jnp.sum(sums.cost)
    # A step that was held short says nothing of what is left to gain.
    whole = (damping <= 1e-3) & jnp.all(jnp.abs(step[0]) < BOUND)
    done = whole & (expected <= enough * cost) | (damping > 1e10) | ~jnp.isfinite(cost)
    return Place(z, x0, sums, damping, step, steps, done)


def _step(z: Array, sums: Sums, damping: Array) -> tuple[Array, Array]:
    """Damped Gauss-Newton; the first state of a recording is eliminated, for it meets only its own samples.

    A step of a parameter is bounded: far from the answer the linear picture is wrong about where it ends,
    and without the bound two starts in three from a wide box end elsewhere than at the least cost.
    """
    K = len(z)
    g, H = sums.g, sums.H
    tiny = 1e-14 * jnp.max(jnp.abs(jnp.diagonal(H, axis1=1, axis2=2)))
    damped = lambda m: m + jnp.diag(damping * jnp.diag(m) + tiny)  # noqa: E731
    A, B, C = damped(jnp.sum(H[:, :K, :K], axis=0)), H[:, :K, K:], jax.vmap(damped)(H[:, K:, K:])
    # What the first states would do by themselves, and what they do with the parameters.
    inner = jnp.linalg.solve(C, jnp.concatenate([jnp.swapaxes(B, 1, 2), g[:, K:, None]], axis=2))
    left = A - jnp.sum(jnp.einsum("rkm,rml->rkl", B, inner[:, :, :K]), axis=0)
    right = jnp.sum(g[:, :K] - jnp.einsum("rkm,rm->rk", B, inner[:, :, K]), axis=0)
    dz = jnp.clip(-jnp.linalg.solve(left, right), -BOUND, BOUND)
    return dz, -inner[:, :, K] - jnp.einsum("rmk,k->rm", inner[:, :, :K], dz)
