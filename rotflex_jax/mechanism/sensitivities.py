"""Sensitivities of a run: in forward mode along with the run, and to effects that are inactive.

    x[k+1] = f(x[k], v[k], c),   dx[k+1] = df/dx dx[k] + df/dv dv[k] + df/dc dc

State and tangents advance together, and the requested result is the only array of the length of the run. The
D directions are the last axis, so that vector units work on all directions at once. The state is repeated
along that axis, so that one expression serves state and tangents; whatever is the same in all directions is
computed once (`repetition`).
`scan.states` stores the Jacobians of the step instead, for reverse mode and for inactive effects.

An effect whose amplitude is zero does not change the run and its Jacobians `A[k]`. It only adds a forcing
`b[k]` to the same recursion,

    dx[k+1] = A[k] dx[k] + b[k],

evaluated along the run, with the effect's own states driven by that run. Each inactive effect therefore costs
one forcing, however many states it has.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from rotflex_jax.effects.base import Actuation, Force, Gear, Memory
from rotflex_jax.mechanism.assembly import effects_of, motor_inputs, stamped
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.repetition import without_repetition
from rotflex_jax.mechanism.scan import directional, forcing, states, tangent_recursion
from rotflex_jax.mechanism.simulate import (
    FreeStep,
    PredictorStep,
    Solver,
    read_outputs,
    restarts,
    started_again,
)
from rotflex_jax.mechanism.step import Exponential


class RunParameters(NamedTuple):
    """Parameters of a predictor run of one structure.

    Attributes:
        values: Parameter values.
        gates: One factor per effect.
        x0: First state, or the first state of each window.
        K: Kalman gain; None for a free run.
    """

    values: Float[Array, "*batch P"]
    gates: Float[Array, "*batch E"]
    x0: Float[Array, "*batch n"]
    K: Float[Array, "*batch n C"] | None


class RecordingSamples(NamedTuple):
    """Samples of one recording.

    Attributes:
        u: Voltage [V].
        y: Measured outputs.
        seen: One where a sample may correct the state, zero where it may not.
        Ts: Sampling period [s].
        window: Index of the window of each sample, if the run starts again at each window; else None.
        count: Number of samples that are run; None for all.
    """

    u: Float[Array, "*batch N"]
    y: Float[Array, "*batch N C"]
    seen: Float[Array, "*batch N"]
    Ts: Float[Array, "*batch"]
    window: Integer[Array, "*batch N"] | None = None
    count: Integer[Array, "*batch"] | None = None

    def started_at(self, x0: Float[Array, "*W n"]) -> tuple[Float[Array, " n"], tuple[Any, ...]]:
        """The first state of a run, and the measured inputs of its step."""
        measured = (self.y, self.seen)
        if self.window is None:
            return x0, measured
        first, restart = restarts(x0, self.window)
        return first, (*measured, *restart)


class LinearisedRun(NamedTuple):
    """A run, and the derivative of each of its steps with respect to the state before the step.

    Attributes:
        X: States.
        A: Jacobians of the step; entry [k, j] is column j of `A[k]`.
    """

    X: Float[Array, "*batch N n"]
    A: Float[Array, "*batch N n n"]


def inactive_sensitivities(
    structure: Mechanism,
    solver: Solver,
    inactive: tuple[int, ...],
    parameters: RunParameters,
    samples: RecordingSamples,
    active: Integer[Array, " r"],
    run: LinearisedRun,
    dvalues: Float[Array, "D P"],
    dgates: Float[Array, "D E"],
) -> Float[Array, "D N C"]:
    """Derivatives of the predicted outputs along effects that are inactive.

    The program differentiates only what an inactive effect enters. If none of them is linear, for instance,
    the matrices of the step are not differentiated.

    Args:
        structure: Structure with all effects; static.
        solver: Integration rule; static.
        inactive: Indices of the effects that the directions move; static.
        parameters: Parameters, with every inactive effect at zero amplitude or with its gate at zero.
        samples: The recording.
        active: Indices of the states that do not belong to inactive effects.
        run: Run without the inactive effects, from `inactive_laws.run_responses`.
        dvalues: Directions in the parameter values.
        dgates: Directions in the gates.
    """
    step, effects = PredictorStep(structure, solver), structure.effects
    counts = [len(e.values) for e in effects]
    own = [sum(counts[:i]) + k for i in inactive for k in range(counts[i])]
    enters_matrices = any(i in inactive for i, _ in stamped(structure))
    changes_voltage = any(isinstance(effects[i], Actuation) for i in inactive)
    switched = any(not effects[i].amplitudes for i in inactive)

    def voltage(values: Array, gates: Array) -> Any:
        known = structure.with_values(values)
        return motor_inputs(solver, known, gates, samples.u, samples.Ts)

    def prepare(values: Array, gates: Array) -> Any:
        return solver.prepare(structure, values, gates, samples.Ts)

    def with_derivatives(f: Callable[[Array, Array], Any], moves: bool) -> tuple[Any, Any]:
        """The value of `f`, and its derivative along each direction; None if it does not depend on them."""
        at = parameters.values, parameters.gates
        if not moves:
            return f(*at), None
        return jax.vmap(lambda *tangent: jax.jvp(f, at, tangent), out_axes=(None, 0))(dvalues, dgates)

    v, dv = with_derivatives(voltage, changes_voltage)
    c, dc = with_derivatives(prepare, enters_matrices)
    x0, measured = samples.started_at(parameters.x0)
    X = run.X
    if X.shape[1] < len(x0):  # with the inactive effects' own states, driven by the run
        X = states(step, x0, (v, *measured), (c, parameters.K))
    # As single numbers, so that parameters of other effects are not differentiated.
    scalars = list(jnp.unstack(parameters.values))
    inputs, constants = (v, *measured), (c._replace(values=scalars), parameters.K)

    still = jax.tree.map(lambda _: None, c)

    def derivative(dvalues: Array, dgates: Array, dvoltage: Any, dc: Any) -> Array:
        dc = still if dc is None else dc
        dc = dc._replace(values=[dvalues[i] if i in own else None for i in range(len(scalars))])
        dc = dc._replace(gates=dgates if switched else None)
        b = forcing(step, X, inputs, (dvoltage, *(None for _ in measured)), constants, (dc, None))
        dx = tangent_recursion(run.A, b[:, active], jnp.zeros_like(x0[active]))
        dX = jnp.zeros_like(X).at[:, active].set(dx)
        read = lambda x, values, gates: read_outputs(structure.with_values(values), gates, x)  # noqa: E731
        return directional(read, (X.T, scalars, parameters.gates), (dX.T, dc.values, dc.gates)).T

    return jax.vmap(derivative)(dvalues, dgates, dv, dc)


Accumulator = Callable[[Any, Float[Array, " C"], Float[Array, "C D"], Any], tuple[Any, Any]]
"""`accumulate(sums, y_hat, J, (y, seen))` returns the new sums and what is stored of this sample."""


class TangentDirections(NamedTuple):
    """Directions in which a run is differentiated.

    Attributes:
        values: Components in the parameter values.
        gates: Components in the gates.
        x0: Components in the first state, the same in every window.
    """

    values: Float[Array, "*batch D P"]
    gates: Float[Array, "*batch D E"]
    x0: Float[Array, "*batch D n"]


def accumulate_outputs(
    structure: Mechanism,
    solver: Solver,
    parameters: RunParameters,
    directions: TangentDirections,
    samples: RecordingSamples,
    accumulate: Accumulator,
    start: Any,
) -> tuple[Any, Any]:
    """Sums over the outputs of a run and their derivatives, sample by sample.

    Forward mode only. Not for a prediction in hundreds of directions, which no longer fit into the
    processor's first-level cache.

    Args:
        structure: Mechanism without parameter values; static.
        solver: Integration rule; static.
        parameters: Parameters of the run; a free run if the gain is None.
        directions: Directions of the derivatives.
        samples: The recording.
        accumulate: What to do with the outputs of a sample.
        start: Sums before the first sample.

    Returns:
        The last sums, and what was stored (N, ...); None instead if the samples have a count.
    """
    values, gates, x0, K = parameters
    D = len(directions.x0)
    repeated = functools.partial(jax.tree.map, lambda a: jnp.broadcast_to(a[..., None], (*jnp.shape(a), D)))
    repeats = _takes_repeated_constants(structure, solver)

    def prepare(p: Array, g: Array) -> Any:
        return solver.prepare(structure, p, g, samples.Ts)

    def drive(p: Array, g: Array) -> Any:
        return motor_inputs(solver, structure.with_values(p), g, samples.u, samples.Ts)

    def read(x: Array, p: Array, g: Array) -> Array:
        return read_outputs(structure.with_values(p), g, x)

    def derivatives(f: Callable[[Array, Array], Any]) -> Any:
        both = lambda *tangent: jax.jvp(f, (values, gates), tangent)  # noqa: E731
        return jax.vmap(both, out_axes=(None, -1))(directions.values, directions.gates)

    c, dc = derivatives(prepare)
    v, dv = derivatives(drive) if effects_of(structure, Actuation) else (drive(values, gates), None)
    free, predictor = FreeStep(structure, solver), PredictorStep(structure, solver)

    def step(v: Any, x: Array, c: Any, sample: Any, K: Any) -> Array:
        if K is None:
            return started_again(free(x, v, c), sample[2:])
        return predictor(x, (v, *sample), (c, K))

    def along(at: Any, tangents: Any) -> tuple[Array, Array]:
        """The state after a step, and its derivative in one direction, or in all if `at` is repeated."""
        v, x, c, *given = at
        if tangents[0] is None:  # the voltage has no derivative
            return jax.jvp(lambda x, c: step(v, x, c, *given), (x, c), tangents[1:])
        return jax.jvp(lambda v, x, c: step(v, x, c, *given), (v, x, c), tangents)

    def later(x: Array, dx: Array, v: Any, dv: Any, sample: Any) -> tuple[Array, Array]:
        at, tangents = (v, x, c, sample, K), (dv, dx, dc)
        if repeats:
            once = jax.tree.map(lambda a: jnp.asarray(a)[..., None], at)
            end, dend = without_repetition(along, D, once, tangents)
            return end[:, 0], dend
        ends, dend = jax.vmap(functools.partial(along, at), in_axes=(-1,), out_axes=(None, -1))(tangents)
        return ends, dend

    x0_directions = jnp.asarray(directions.x0).T

    def advance(carry: Any, sample: Any) -> Any:
        (x, dx, sums), (v, dv, here) = carry, sample
        J = jax.jvp(read, repeated((x, values, gates)), (dx, directions.values.T, directions.gates.T))[1]
        sums, stored = accumulate(sums, read(x, values, gates), J, here[:2])
        x, dx = later(x, dx, v, dv, here)
        if samples.window is not None:
            dx = jnp.where(here[2] > 0, x0_directions, dx)
        return (x, dx, sums), stored

    first, measured = samples.started_at(jnp.asarray(x0))
    carry, inputs = (first, x0_directions, start), (v, dv, measured)
    if samples.count is None:
        (_, _, sums), stored = jax.lax.scan(advance, carry, inputs)
        return sums, stored
    at = lambda k: jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, k, 0, False), inputs)  # noqa: E731
    return jax.lax.fori_loop(0, samples.count, lambda k, carry: advance(carry, at(k))[0], carry)[2], None


def _takes_repeated_constants(structure: Mechanism, solver: Solver) -> bool:
    """Whether the step accepts constants that are repeated along the directions."""
    laws = (*effects_of(structure, Force), *effects_of(structure, Memory))
    by_motor = any(e.driven_by != "voltage" for _, e in laws)
    elastic = any(gear.teeth() is not None for _, gear in effects_of(structure, Gear))
    return isinstance(solver, Exponential) and not elastic and not by_motor


def outputs_with_sensitivities(
    structure: Mechanism,
    solver: Solver,
    parameters: RunParameters,
    directions: TangentDirections,
    samples: RecordingSamples,
) -> tuple[Float[Array, "N C"], Float[Array, "N C D"]]:
    """Outputs of a run and their derivatives along some directions; arguments as in `accumulate_outputs`.

    Forward mode only, and several times faster than `jax.jacfwd` of a run.
    """
    store: Accumulator = lambda sums, y, J, _: (sums, (y, J))  # noqa: E731
    return accumulate_outputs(structure, solver, parameters, directions, samples, store, ())[1]
