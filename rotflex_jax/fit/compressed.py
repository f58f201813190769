"""A fit by a solver of optimistix: the sums of its runs as a least-squares problem of a few residuals.

    r = (a, sqrt(2 cost - a'a)),   J = (L', 0),   with H = L L', L a = g

has the cost `r'r / 2`, the slope `J'r = g` and the product `J'J = H` of the whole problem, so a solver of the
Gauss-Newton kind takes the same steps as on the residuals of all samples, of which none is stored.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from rotflex_jax.fit.descent import UNSOLVED, Given, Moved, Reached, sums

Minimiser = optx.AbstractLeastSquaresSolver


def minimise(minimiser: Minimiser, moved: Moved, flat: np.ndarray, given: Given, max_steps: int) -> Reached:
    """Where the solver ends, in float64.

    Not with a solver that looks at single residuals: these are no errors of samples.

    Args:
        minimiser: Solver of optimistix, such as `LevenbergMarquardt(rtol=1e-6, atol=1e-6)`.
        moved: What it moves.
        flat: All coordinates at the start.
        given: What it holds.
        max_steps: Most steps.
    """
    first = np.asarray(sums(moved, jnp.asarray(flat), given).cost)
    start = jnp.asarray(flat[moved.index])
    end, steps, result = _solved(minimiser, moved, start, (jnp.asarray(flat), given), max_steps)
    there = flat.copy()
    there[moved.index] = np.asarray(end)
    cost = np.asarray(sums(moved, jnp.asarray(there), given).cost)
    status = UNSOLVED
    if result == optx.RESULTS.successful:
        status = "converged"
    elif result == optx.RESULTS.nonlinear_max_steps_reached:
        status = f"stopped after {max_steps} steps"
    return Reached(there, first, cost, int(steps), status)


@eqx.filter_jit
def _solved(minimiser: Minimiser, moved: Moved, start: Array, held: Any, most: int) -> Any:
    problem = functools.partial(_residuals, moved)
    found = optx.least_squares(problem, minimiser, start, held, max_steps=most, throw=False)
    return found.value, found.stats["num_steps"], found.result


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _residuals(moved: Moved, z: Float[Array, " M"], held: Any) -> Float[Array, " M+1"]:
    return _compressed(moved, z, held)[0]


@_residuals.defjvp
def _slopes(moved: Moved, at: Any, way: Any) -> tuple[Array, Array]:
    r, J = _compressed(moved, *at)
    return r, jnp.append(J @ way[0], 0.0)


def _compressed(moved: Moved, z: Float[Array, " M"], held: Any) -> tuple[Array, Array]:
    """`r`, and the rows of `J` that are not zero."""
    flat, given = held
    cost, g, H = sums(moved, flat.at[moved.index].set(z), given)
    # Scaled to a unit diagonal first: coordinates may differ by many orders of size.
    diagonal = jnp.diagonal(H)
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    L = jnp.linalg.cholesky(H / jnp.outer(size, size) + 1e-14 * len(z) * jnp.eye(len(z), dtype=z.dtype))
    a = jax.scipy.linalg.solve_triangular(L, g / size, lower=True)
    rest = jnp.maximum(2 * jnp.sum(cost) - a @ a, 0.0)
    return jnp.append(a, jnp.sqrt(rest)), (L * size[:, None]).T
