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

from rotflex_jax.fit.problem import FreeCoordinates, RunInputs, summed_equations
from rotflex_jax.optimise.damped_least_squares import Minimum, Status

Minimiser = optx.AbstractLeastSquaresSolver


def minimise_by(
    minimiser: Minimiser,
    free: FreeCoordinates,
    flat: Float[np.ndarray, " F"],
    inputs: RunInputs,
    max_steps: int,
) -> Minimum:
    """Where the solver ends, in float64; takes the place of `optimise.damped_least_squares.minimise`.

    Not with a solver that looks at single residuals: these are no errors of samples.

    Args:
        minimiser: Solver of optimistix, such as `LevenbergMarquardt(rtol=1e-6, atol=1e-6)`.
        free: What it adjusts.
        flat: All coordinates at the start.
        inputs: What the runs have in common.
        max_steps: Most steps.
    """
    fixed = (jnp.asarray(flat), inputs)
    first = jax.device_get(summed_equations(free, *fixed))
    x, steps, result = _solved(minimiser, free, jnp.asarray(flat[free.index]), fixed, max_steps)
    end = jax.device_get(summed_equations(free, fixed[0].at[free.index].set(x), inputs))
    status = Status.UNSOLVED
    if result == optx.RESULTS.successful:
        status = Status.CONVERGED
    elif result == optx.RESULTS.nonlinear_max_steps_reached:
        status = Status.RUNNING
    return Minimum(np.asarray(x), first, end, float(end.cost), int(steps), status)


@eqx.filter_jit
def _solved(minimiser: Minimiser, free: FreeCoordinates, start: Array, fixed: Any, most: int) -> Any:
    problem = functools.partial(_residuals, free)
    found = optx.least_squares(problem, minimiser, start, fixed, max_steps=most, throw=False)
    return found.value, found.stats["num_steps"], found.result


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _residuals(free: FreeCoordinates, z: Float[Array, " M"], fixed: Any) -> Float[Array, " M+1"]:
    return _compressed(free, z, fixed)[0]


@_residuals.defjvp
def _slopes(free: FreeCoordinates, at: Any, way: Any) -> tuple[Array, Array]:
    r, J = _compressed(free, *at)
    return r, jnp.append(J @ way[0], 0.0)


def _compressed(free: FreeCoordinates, z: Float[Array, " M"], fixed: Any) -> tuple[Array, Array]:
    """`r`, and the rows of `J` that are not zero."""
    flat, inputs = fixed
    costs, g, H = summed_equations(free, flat.at[free.index].set(z), inputs)
    # Scaled to a unit diagonal first: coordinates may differ by many orders of size.
    diagonal = jnp.diagonal(H)
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    L = jnp.linalg.cholesky(H / jnp.outer(size, size) + 1e-14 * len(z) * jnp.eye(len(z), dtype=z.dtype))
    a = jax.scipy.linalg.solve_triangular(L, g / size, lower=True)
    rest = jnp.maximum(2 * jnp.sum(costs) - a @ a, 0.0)
    return jnp.append(a, jnp.sqrt(rest)), (L * size[:, None]).T
