"""A run, its squared error and the normal equations of that in one pass over the samples.

The scan carries the state, its slopes along every direction, and the sums

    cost = sum e'e / 2,   g = sum J'e,   H = sum J'J,   e = (y_hat - y) / s,   J = de/dp

so that nothing of the length of a recording is stored. A fit that wants no more than these three is
several times quicker with it than with the slopes of all samples, as long as small loops are compiled
into one function (`enable_fast_loops`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float

from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.absent import Numbers, Samples
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.tangents import Ways, fold_outputs


class Sums(NamedTuple):
    """Of one recording, by D directions; the cost of each channel apart."""

    cost: Float[Array, " C"]
    g: Float[Array, " D"]
    H: Float[Array, "D D"]


export.register_namedtuple_serialization(Sums, serialized_name=f"{__name__}.Sums")


def normal_equations(
    structure: Mechanism,
    solver: Solver,
    numbers: Numbers,
    ways: Ways,
    samples: Samples,
    scale: Float[Array, " C"],
) -> Sums:
    """Half the squared error of a run, its slope, and the product of the Jacobian with itself.

    Args:
        structure: Mechanism without numbers; static.
        solver: Integration rule; static.
        numbers: Where it runs; a free run where the gain is None.
        ways: The D directions.
        samples: The recording.
        scale: Size of the error of each channel.
    """

    def fold(sums: Sums, y_hat: Array, J: Array, sample: Any) -> tuple[Sums, None]:
        y, counts = sample
        # Not a product: beyond its last sample a run may diverge.
        e = jnp.where(counts > 0, (y_hat - y) / scale, 0.0)
        J = jnp.where(counts > 0, J / scale[:, None], 0.0)
        each = range(len(e))
        return Sums(
            sums.cost + e * e / 2,
            sums.g + sum(J[c] * e[c] for c in each),
            sums.H + sum(J[c][:, None] * J[c][None] for c in each),
        ), None

    D, dtype = len(ways.x0), samples.u.dtype
    none = Sums(jnp.zeros(len(scale), dtype), jnp.zeros(D, dtype), jnp.zeros((D, D), dtype))
    return fold_outputs(structure, solver, numbers, ways, samples, fold, none)[0]


def moved_by(structure: Mechanism, slopes: Float[Array, " P"], free: Float[Array, " K"], states: int) -> Ways:
    """Directions of the coordinates of some parameters, then of that many positions and speeds.

    Args:
        structure: Mechanism without numbers.
        slopes: How each value moves with its coordinate.
        free: Places of the parameters.
        states: How many entries of the first state are moved.
    """
    K, D = len(free), len(free) + states
    values = jnp.zeros((D, len(slopes)), slopes.dtype).at[jnp.arange(K), free].set(slopes[free])
    n = len(rest_state(structure, np.float64))
    x0 = jnp.zeros((D, n), slopes.dtype).at[K + jnp.arange(states), jnp.arange(states)].set(1.0)
    return Ways(values, jnp.zeros((D, len(structure.effects)), slopes.dtype), x0)
