"""The state at the start of a recording, fitted to its first samples by least squares with the simulator."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from rotflex_jax.effects.base import Linear
from rotflex_jax.mechanism.assembly import Layout, effects_of, motor_inputs, rest_state
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.scan import states
from rotflex_jax.mechanism.simulate import FreeStep, Solver, read_outputs
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_compiled
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

# Least number of rows of the arrays of a call: calls with fewer segments share one program.
LEAST_ROWS = 64
# Increment of a state for a difference quotient.
DIFFERENCE = 1e-6
# Largest number of evaluations of one segment.
MAX_EVALUATIONS = 25
# Where friction stops the motion, difference quotients are inaccurate, and with less damping some fits do not
# end at the least error. Directions that a segment does not determine stay at their guess.
RULES = Rules(enough_share=1e-14, least=1e-6)


def rough_states(structure: Mechanism, y: Float[np.ndarray, "W N C"], Ts: float) -> Float[np.ndarray, "W s"]:
    """Positions and speeds at the start of W segments, from straight lines through their samples.

    Coordinates that the sensors do not determine are set so that the springs are relaxed, and to zero where
    there is no spring. Speeds come from the slopes of positions first, and then from speed sensors, whose
    sign a rectifier may hide.

    Args:
        structure: Mechanism without parameter values.
        y: Samples of the outputs.
        Ts: Sampling period [s].
    """
    layout, (W, N, C) = Layout.of(structure), y.shape
    slope, start = np.zeros((C, W)), y[:, 0].T
    if N > 1:
        samples = np.moveaxis(y, 1, 0).reshape(N, W * C)
        slope, start = (line.reshape(W, C).T for line in np.polyfit(np.arange(N) * Ts, samples, 1))
    rows = np.array(layout.output_rows)
    n, is_position = layout.n, np.array([q.is_position for q in structure.quantities])
    positions, speeds = rows[is_position, :n], rows[~is_position, n:]
    ports = {e.at for _, e in effects_of(structure, Linear) if e.elastic}
    springs = np.array([structure.port_vectors[p] for p in sorted(ports)]).reshape(-1, n)
    relaxed = springs, np.zeros((len(springs), W))
    q = _lexicographic_fit([(positions, start[is_position]), relaxed], n)
    dq = _lexicographic_fit([(positions, slope[is_position]), relaxed, (speeds, start[~is_position])], n)
    return np.concatenate([q, dq]).T


def _lexicographic_fit(rows: list[tuple[np.ndarray, np.ndarray]], n: int) -> Float[np.ndarray, "n W"]:
    """The smallest `X` with `A X = B` for the first pair, then for the next as far as `X` is undetermined."""
    X, free = np.zeros((n, rows[0][1].shape[1])), np.eye(n)
    for A, B in rows:
        left = A @ free
        X = X + free @ np.linalg.pinv(left) @ (B - A @ X)
        free = free @ scipy.linalg.null_space(left)
    return X


@persistent_jit(static=2, optimisation_level=1)
def _fitted_states(
    structure: Mechanism,
    solver: Solver,
    values: Array,
    gates: Array,
    guess: Array,
    hidden: Array,
    u: Array,
    y: Array,
    Ts: Array,
    count: Array,
) -> Array:
    """Positions and speeds (W, m) with the least squared error, each of the first `count` segments by itself.

    The segments are fitted one after another: each fit stops when it has converged, and a shortcut through a
    step has to hold for the runs of one segment only. Rows from `count` on return their guess. Derivatives
    are difference quotients: segments are short, and the derivative of the simulation would take longer to
    compile than all the runs take.
    """
    m = guess.shape[1]
    increments = jnp.concatenate([jnp.zeros((1, m)), DIFFERENCE * jnp.eye(m)])
    # Formed once, outside of the minimisation, so that they are not traced within its loop.
    mechanism, constants = structure.with_values(values), solver.prepare(structure, values, gates, Ts)

    def with_fitted(k: Array, found: Array) -> Array:
        v = motor_inputs(solver, mechanism, gates, u[k], Ts)

        def run(x0: Array) -> Array:
            return read_outputs(mechanism, gates, states(FreeStep(structure, solver), x0, v, constants).T).T

        def linearise(x: Array) -> NormalEquations:
            starts = jnp.concatenate([x[None] + increments, jnp.tile(hidden[k][None], (m + 1, 1))], axis=1)
            e = (jax.vmap(run)(starts) - y[k][None]).reshape(m + 1, -1)
            return NormalEquations.of((e[1:] - e[:1]).T / DIFFERENCE, e[0])

        return found.at[k].set(minimise_compiled(linearise, guess[k], RULES, max_steps=MAX_EVALUATIONS)[0])

    return jax.lax.fori_loop(0, count, with_fitted, guess)


def initial_states(
    mechanism: Mechanism,
    solver: Solver,
    gates: Float[np.ndarray, " E"],
    u: Float[np.ndarray, "W N *c"],
    y: Float[np.ndarray, "W N C"],
    Ts: float,
    hidden: Float[np.ndarray, "W h"] | None = None,
) -> Float[np.ndarray, "W n"]:
    """First states of W segments of a recording, each by itself.

    Positions and speeds are fitted; the error of each channel counts in its own unit. States that no sensor
    measures (memories, motor current, modes of a part) are given.

    Args:
        mechanism: Model.
        solver: Integration rule.
        gates: One factor per effect.
        u: Voltage [V], and the signals of the mechanism beside it.
        y: Measured outputs.
        Ts: Sampling period [s].
        hidden: The states other than positions and speeds; at rest if None.
    """
    structure = mechanism.structure
    if hidden is None:
        rest = rest_state(structure, np.float64)[2 * Layout.of(structure).n :]
        hidden = np.tile(rest, (len(u), 1))
    guess = rough_states(structure, y, Ts)
    # Rows beyond the segments are not evaluated; they keep the number of compiled shapes small.
    rows = np.minimum(np.arange(max(LEAST_ROWS, 2 ** (len(u) - 1).bit_length())), len(u) - 1)
    with double_precision():
        segments = guess[rows], hidden[rows], u[rows], y[rows], np.float64(Ts)
        given = jax.device_put((mechanism.values, gates, *segments, len(u)))
        found = np.asarray(_fitted_states(structure, solver, *given))
    return np.concatenate([found[: len(u)], hidden], axis=1)
