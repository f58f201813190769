"""A fit by a solver of optimistix, to which the sums of the runs appear as a small least-squares problem.

    r = (a, sqrt(2 cost - a'a)),   J = (L', 0),   with H = L L', L a = g

has the cost `r'r / 2`, the gradient `J'r = g` and the product `J'J = H` of the whole problem. So a solver of
the Gauss-Newton kind takes the same steps as with the residuals of all samples, which it does not get. The
scales of the channels are held during a minimisation, which is repeated with new scales until these converge.
"""

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.problem import LikelihoodEquations, RunLayout, runs_with_slopes
from rotflex_jax.optimise.damped_least_squares import Minimum, Status
from rotflex_jax.parameters import Specification, Transform

if TYPE_CHECKING:
    from rotflex_jax.fit.greybox_problem import FitPoint, FitStage, GreyBoxProblem

Minimiser = optx.AbstractLeastSquaresSolver

# Largest number of minimisations; they end when no scale changes by more than this share.
MAX_RESCALINGS, SCALE_TOLERANCE = 8, 1e-3


class Moves(NamedTuple):
    """Columns of a step that change parameters and first states.

    Attributes:
        free: Indices of the fitted parameters, common ones first, then local ones.
        parameters: Their columns, for each recording.
        states: Columns of the first state of each window, for each recording.
    """

    free: tuple[int, ...]
    parameters: tuple[tuple[int, ...], ...]
    states: tuple[tuple[tuple[int, ...], ...], ...]

    @classmethod
    def of(cls, point: "FitPoint", c: FitCoordinates) -> "Moves":
        """The columns for a point."""
        shared = tuple(range(c.shared))
        recordings = range(len(point.local_z))
        return cls(
            (*point.free, *point.local),
            tuple((*shared, *c.local_columns(r).tolist()) for r in recordings),
            tuple(
                tuple(tuple(c.state_columns(r, k).tolist()) for k, _ in c.windows.of(r)) for r in recordings
            ),
        )


def minimise_by(
    minimiser: Minimiser,
    problem: "GreyBoxProblem",
    point: "FitPoint",
    stage: "FitStage",
    K: Float[np.ndarray, "R n C"],
) -> Minimum:
    """Minimum by a solver of optimistix, in float64; replaces `optimise.damped_least_squares.minimise`.

    The solver does not know the ends of physical ranges, which are not part of the coordinates. Do not use a
    solver that evaluates single residuals: here they are not errors of samples.

    Args:
        minimiser: Solver of optimistix, such as `LevenbergMarquardt(rtol=1e-6, atol=1e-6)`.
        problem: The problem of the fit.
        point: The start.
        stage: Free runs or predictions.
        K: Gains of the predictor.
    """
    coordinates, here = problem.coordinates(point, stage.windows), problem.equations(point, stage, K)
    first, steps, status = here, 0, Status.UNSOLVED
    for _ in range(MAX_RESCALINGS):
        tied = point.z, point.local_z, point.x0
        fixed = (
            *(jnp.asarray(a) for a in tied),
            jax.tree.map(jnp.asarray, (problem.dataset.data, problem.dataset.constants)),
            jnp.asarray(stage.windows.index),
            jnp.asarray(K),
            jnp.asarray(here.scale),
        )
        which = (
            problem.layout,
            problem.model.mechanism.parameter_specifications,
            Moves.of(point, coordinates),
        )
        none = jnp.zeros(coordinates.size)
        step, count, result = _solved(minimiser, which, none, fixed, problem.max_steps)
        before, point, steps = here.scale, coordinates.moved(point, np.asarray(step)), steps + int(count)
        here: LikelihoodEquations = problem.equations(point, stage, K)
        if result != optx.RESULTS.successful:
            used_up = result == optx.RESULTS.nonlinear_max_steps_reached
            status = Status.RUNNING if used_up else Status.UNSOLVED
            break
        status = Status.CONVERGED
        if np.all(np.abs(np.log(here.scale / before)) < SCALE_TOLERANCE):
            break
    else:
        status = Status.RUNNING
    return Minimum(point, first, here, here.cost, steps, status)


@eqx.filter_jit
def _solved(minimiser: Minimiser, which: Any, start: Array, fixed: Any, most: int) -> Any:
    problem = functools.partial(_residuals, which)
    found = optx.least_squares(problem, minimiser, start, fixed, max_steps=most, throw=False)
    return found.value, found.stats["num_steps"], found.result


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _residuals(which: Any, step: Float[Array, " M"], fixed: Any) -> Float[Array, " M+1"]:
    return _compressed(which, step, fixed)[0]


@_residuals.defjvp
def _slopes(which: Any, at: Any, tangent: Any) -> tuple[Array, Array]:
    r, J = _compressed(which, *at)
    return r, jnp.append(J @ tangent[0], 0.0)


def _compressed(which: Any, step: Float[Array, " M"], fixed: Any) -> tuple[Array, Array]:
    """`r`, and the rows of `J` that are not zero."""
    cost, g, H = _sums(which, step, fixed)
    # Scaled to a unit diagonal first, since coordinates may differ by many orders of magnitude.
    diagonal = jnp.diagonal(H)
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    L = jnp.linalg.cholesky(H / jnp.outer(size, size) + 1e-14 * len(g) * jnp.eye(len(g), dtype=g.dtype))
    a = jax.scipy.linalg.solve_triangular(L, g / size, lower=True)
    rest = jnp.maximum(2 * cost - a @ a, 0.0)
    return jnp.append(a, jnp.sqrt(rest)), (L * size[:, None]).T


def _sums(
    which: tuple[RunLayout, tuple[Specification, ...], Moves], step: Float[Array, " M"], fixed: Any
) -> tuple[Float[Array, ""], Float[Array, " M"], Float[Array, "M M"]]:
    """Half the sum of squared scaled errors after a step, its gradient, and `J'J`."""
    layout, specs, moves = which
    z, local_z, x0, given, window, K, scale = fixed
    (data, constants), free = given, np.array(moves.free)
    shared, transform = len(free) - local_z.shape[1], Transform.of(specs)
    Z = jnp.tile(z, (len(x0), 1)).at[:, free[shared:]].set(local_z)
    for r, columns in enumerate(moves.parameters):
        Z = Z.at[r, free].add(step[np.array(columns)])
        for k, states in enumerate(moves.states[r]):
            x0 = x0.at[r, k, : len(states)].add(step[np.array(states, int)])
    held = jnp.ones(Z.shape[1], bool).at[free].set(False)[None] | ~jnp.isnan(constants)
    values, slopes = jax.jvp(jax.vmap(transform.constrain), (Z,), (jnp.ones_like(Z),))
    values, slopes = jnp.where(jnp.isnan(constants), values, constants), jnp.where(held, 0.0, slopes)
    many = x0.shape[1] > 1
    y_hat, J = runs_with_slopes(
        layout, values, slopes, free, x0 if many else x0[:, 0], data, K, window if many else None
    )
    seen = data.seen[:, :, None] > 0
    e = jnp.where(seen, (y_hat - data.y) / scale[None, None], 0.0)
    J = jnp.where(seen[..., None], J / scale[None, None, :, None], 0.0)
    M = len(step)
    g, H = jnp.zeros(M), jnp.zeros((M, M))
    for r, columns in enumerate(moves.parameters):
        for k, states in enumerate(moves.states[r]):
            own, inside = np.array((*columns, *states)), (window[r] == k)[:, None, None]
            part = jnp.where(inside, J[r], 0.0).reshape(-1, len(own))
            g = g.at[own].add(part.T @ e[r].reshape(-1))
            H = H.at[np.ix_(own, own)].add(part.T @ part)
    return jnp.sum(e * e) / 2, g, H
