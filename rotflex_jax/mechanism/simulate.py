"""Free run and prediction on arrays: pure, compiled once per structure, differentiable."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer, Real

from rotflex_jax.checks import positive, shown, signal, vector
from rotflex_jax.effects.base import Sensing
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import Layout, effects_of, motor_inputs, own_states, rest_state
from rotflex_jax.mechanism.linear import check_movable
from rotflex_jax.mechanism.mechanism import Mechanism, check_mechanism
from rotflex_jax.mechanism.scan import BLOCKED_FROM_SAMPLES, linear_outputs, states
from rotflex_jax.mechanism.small_matrices import evaluate_effect, matvec, sparse_matvec
from rotflex_jax.mechanism.smooth_rk4 import SmoothRK4
from rotflex_jax.mechanism.step import Exponential
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import working_precision


def true_outputs(structure: Mechanism, x: Float[Array, "n *S"]) -> Float[Array, "C *S"]:
    """Readings of ideal sensors."""
    layout = Layout.of(structure)
    moving = sparse_matvec(layout.output_rows, x)
    if not any(layout.output_states):
        return moving
    states = [moving[c] if i is None else x[i] for c, i in enumerate(layout.output_states)]
    return jnp.stack(states)


def sensor_readings(
    mechanism: Mechanism,
    gates: Float[Array, "E *D"],
    true: Float[Array, "C *S"],
    x: Float[Array, "n *S"] | None,
) -> Float[Array, "C *S"]:
    """Sensor readings for true outputs; only sensors with dynamics need the states `x`."""
    found = effects_of(mechanism, Sensing)
    if not found:
        return true
    y, ideal, gate, rows = (
        list(jnp.unstack(true)),
        jnp.unstack(true),
        jnp.unstack(gates),
        own_states(mechanism),
    )
    for i, effect in found:
        c = mechanism.channels.index(effect.at)
        measure: Callable[..., Any] = lambda e, *seen: e.measure(*seen)  # noqa: E731
        beside: tuple[Array, ...] = ()
        if effect.beside == "other":
            beside = (ideal[0 if c else 1],)
        elif effect.beside == "states" and x is not None:
            order = mechanism.quantities[c].derivative
            measure = lambda e, value, *z, order=order: e.measure(value, z, order)  # noqa: E731
            beside = tuple(x[row] for row in rows[i])
        y[c] = y[c] + gate[i] * (evaluate_effect(effect, measure, y[c], *beside) - y[c])
    return jnp.stack(y)


def read_outputs(
    mechanism: Mechanism, gates: Float[Array, "E *D"], x: Float[Array, "n *S"]
) -> Float[Array, "C *S"]:
    """Sensor readings for given states."""
    return sensor_readings(mechanism, gates, true_outputs(mechanism.structure, x), x)


def readings_with_slope_sign(
    mechanism: Mechanism, gates: Float[Array, "E *D"], x: Float[Array, "n *S"]
) -> tuple[Float[Array, "C *S"], Float[Array, "C *S"]]:
    """Readings, and the sign of their derivative with respect to the true value.

    The Kalman gain is that of ideal sensors. The reading of a full-wave rectifier falls as the true value
    rises from below zero: without the sign the correction would be unstable.
    """
    true = true_outputs(mechanism.structure, x)
    if not effects_of(mechanism, Sensing):
        return true, jnp.ones_like(true)
    read, slope = jax.jvp(lambda y: sensor_readings(mechanism, gates, y, x), (true,), (jnp.ones_like(true),))
    return read, jnp.sign(slope)


Solver = Exponential | SmoothRK4


@dataclasses.dataclass(frozen=True)
class FreeStep:
    """One step of a free run: from one state to the next under the recorded voltage."""

    structure: Mechanism
    solver: Solver

    @property
    def linear(self) -> bool:
        """Whether the state after the step is linear in state and voltage."""
        return isinstance(self.solver, Exponential) and all(e.exact_step for e in self.structure.effects)

    def __call__(self, x: Float[Array, "n *S"], v: Float[Array, "*hS"], c: Any) -> Float[Array, "n *S"]:
        """State one sample later under the voltage `v`."""
        return self.solver.advance(self.structure, x, v, c)


@dataclasses.dataclass(frozen=True)
class PredictorStep:
    """One step of a predictor, which first corrects the state: `x+ = F(x + K (y - h(x)), v)`.

    Where the next sample begins a window, the next state is the first state of that window.
    """

    structure: Mechanism
    solver: Solver

    def __call__(
        self, x: Float[Array, "n *S"], w: tuple[Float[Array, "..."], ...], constants: Any
    ) -> Float[Array, "n *S"]:
        """State one sample later.

        Args:
            x: State.
            w: Voltage, outputs, and whether the outputs may correct the state; for a run with windows also
                whether a window ends here, and the first state of the next window.
            constants: Constants of the solver, and the gain.
        """
        v, y, seen, *restart = w
        c, K = constants
        mechanism = self.structure.with_values(c.values)
        read, sign = readings_with_slope_sign(mechanism, c.gates, x)
        e = (y - read) * sign * seen[None]
        return started_again(self.solver.advance(self.structure, x + matvec(K, e), v, c), restart)


def started_again(x: Float[Array, "n *S"], restart: Sequence[Float[Array, "..."]]) -> Float[Array, "n *S"]:
    """The state, or the first state of the next window where a window ends; `restart` is from `restarts`."""
    if not restart:
        return x
    ends, start = restart
    return jnp.where(ends[None] > 0, start, x)


def restarts(
    x0: Float[Array, "W n"], window: Integer[Array, " N"]
) -> tuple[Float[Array, " n"], tuple[Float[Array, " N"], Float[Array, "N n"]]]:
    """The first state of a run that starts again at each window, and the restart inputs of its steps.

    Args:
        x0: First states of the windows.
        window: Index of the window of each sample.
    """
    following = jnp.concatenate([window[1:], window[-1:]])
    return x0[window[0]], ((following != window).astype(x0.dtype), x0[following])


def prepared_run(
    structure: Mechanism,
    solver: Solver,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    u: Float[Array, "N *c"],
    Ts: Float[Array, ""],
) -> tuple[Mechanism, Any, Any]:
    """The mechanism with its parameter values, the solver's input at each sample, the solver's constants."""
    mechanism = structure.with_values(values)
    constants = solver.prepare(structure, values, gates, Ts)
    return mechanism, motor_inputs(solver, mechanism, gates, u, Ts), constants


def free_run(
    structure: Mechanism,
    solver: Solver,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, " n"],
    u: Float[Array, "N *c"],
    Ts: Float[Array, ""],
) -> tuple[Float[Array, "N n"], Float[Array, "N C"]]:
    """Simulated states and outputs from the first state and the voltage alone.

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        values: Parameter values.
        gates: One factor per effect, 1 if the effect is on.
        x0: First state.
        u: Voltage [V], held over each sample, and the signals of the mechanism beside it.
        Ts: Sampling period [s].
    """
    mechanism, v, c = prepared_run(structure, solver, values, gates, u, Ts)
    X = states(FreeStep(structure, solver), x0, v, c)
    return X, read_outputs(mechanism, gates, X.T).T


def predictor_run(
    structure: Mechanism,
    solver: Solver,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, "*W n"],
    u: Float[Array, "N *c"],
    y: Float[Array, "N C"],
    seen: Float[Array, " N"],
    K: Float[Array, "n C"],
    Ts: Float[Array, ""],
    window: Integer[Array, " N"] | None = None,
) -> tuple[Float[Array, "N n"], Float[Array, "N C"]]:
    """States before correction and outputs predicted one step ahead.

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        values: Parameter values.
        gates: One factor per effect.
        x0: First state.
        u: Voltage [V], and the signals of the mechanism beside it.
        y: Measured outputs.
        seen: One where a sample may correct the state, zero where it may not.
        K: Gain; zero for a free run.
        Ts: Sampling period [s].
        window: Index of the window of each sample, if the run starts again at each window; `x0` is then
            (W, n).
    """
    mechanism, v, c = prepared_run(structure, solver, values, gates, u, Ts)
    x0, restart = (x0, ()) if window is None else restarts(x0, window)
    X = states(PredictorStep(structure, solver), x0, (v, y, seen, *restart), (c, K))
    return X, read_outputs(mechanism, gates, X.T).T


def first_predictions(
    structure: Mechanism,
    solver: Solver,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, "W n"],
    u: Float[Array, "N *c"],
    y: Float[Array, "N C"],
    seen: Float[Array, " N"],
    K: Float[Array, "n C"],
    Ts: Float[Array, ""],
    window: Integer[Array, " N"],
    count: Integer[Array, ""],
) -> Float[Array, "N C"]:
    """The first `count` outputs that `predictor_run` predicts, then zeros; not to be differentiated.

    One compiled program serves runs of any length up to N.
    """
    mechanism, v, c = prepared_run(structure, solver, values, gates, u, Ts)
    first, restart = restarts(x0, window)
    step, inputs = PredictorStep(structure, solver), (v, y, seen, *restart)

    def body(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        x, Y = carry
        w = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, k, 0, False), inputs)
        placed = jax.lax.dynamic_update_index_in_dim(Y, read_outputs(mechanism, gates, x), k, 0)
        return step(x, w, (c, K)), placed

    return jax.lax.fori_loop(0, count, body, (first, jnp.zeros_like(y)))[1]


@persistent_jit(static=2)
def _free_states(structure: Mechanism, solver: Solver, *given: Array) -> Array:
    return free_run(structure, solver, *given)[0]


@persistent_jit(static=2)
def _free_outputs(structure, solver, values, gates, x0, u, Ts):  # noqa: ANN001, ANN202 - as `free_run`
    """Outputs (N, C) alone: no state is stored."""
    mechanism, v, c = prepared_run(structure, solver, values, gates, u, Ts)
    step = FreeStep(structure, solver)
    if step.linear and len(u) >= BLOCKED_FROM_SAMPLES:
        if any(e.order for _, e in effects_of(structure, Sensing)):
            return read_outputs(mechanism, gates, states(step, x0, v, c).T).T
        rows = jnp.asarray(Layout.of(structure).output_rows, x0.dtype)
        rows = jnp.pad(rows, ((0, 0), (0, len(x0) - rows.shape[1])))
        return sensor_readings(mechanism, gates, linear_outputs(step, x0, v, c, rows).T, None).T
    body = lambda x, w: (step(x, w, c), read_outputs(mechanism, gates, x))  # noqa: E731
    return jax.lax.scan(body, x0, v)[1]


def first_state(
    rest: Float[np.ndarray, " n"], x0: Real[ArrayLike, " m"] | Sequence[float] | None
) -> Float[np.ndarray, " n"]:
    """The first state: the entries of `x0`, then the state at rest.

    Raises:
        InputError: `x0` has more entries than the model has states, or is no list of finite numbers.
    """
    start = rest.copy()
    if x0 is None:
        return start
    known = vector(x0, "x0", example="[0.1, 0.0], the positions")
    if len(known) > len(start):
        raise InputError(
            f"Argument `x0` has {len(known)} entries, but the model has {len(start)} states; give its "
            "positions, then its speeds."
        )
    start[: len(known)] = known
    return start


def simulate(
    mechanism: Mechanism,
    u: Real[ArrayLike, "N *c"] | Sequence[float],
    Ts: float,
    x0: Real[ArrayLike, " m"] | Sequence[float] | None = None,
    solver: Solver | None = None,
) -> Float[np.ndarray, "N C"]:
    """Outputs of a free run from `x0` (rest if None), in the precision of `u`.

    Args:
        mechanism: Model.
        u: Voltage [V] (N,), held over each sample; (N, 1 + S) if signals drive the mechanism too, in the
            order of `mechanism.signals`.
        Ts: Sampling period [s].
        x0: First state, or only its positions and speeds.
        solver: Integration rule; `Exponential()` if None.

    Raises:
        InputError: A coordinate has no inertia, `u` is no signal of finite numbers, or `Ts` is not positive.
    """
    return _simulated(_free_outputs, mechanism, u, Ts, x0, solver)


def simulate_states(
    mechanism: Mechanism,
    u: Real[ArrayLike, "N *c"] | Sequence[float],
    Ts: float,
    x0: Real[ArrayLike, " m"] | Sequence[float] | None = None,
    solver: Solver | None = None,
) -> Float[np.ndarray, "N n"]:
    """States of a free run: positions, speeds, then states of motor and memories."""
    return _simulated(_free_states, mechanism, u, Ts, x0, solver)


def _simulated(run, mechanism, u, Ts, x0, solver):  # noqa: ANN001, ANN202 - typed in the two callers
    check_mechanism(mechanism)
    check_movable(mechanism)
    u, Ts = _input(mechanism, u), positive(Ts, "Ts", example="0.002")
    if not (solver is None or isinstance(solver, Solver)):
        raise InputError(
            f"Argument `solver` must be Exponential(...) or SmoothRK4(...), but is {shown(solver)}; "
            "leave it out for the default."
        )
    start = first_state(rest_state(mechanism.structure, u.dtype), x0)
    with working_precision(u):
        gates = np.ones(len(mechanism.effects), u.dtype)
        values, period = mechanism.values.astype(u.dtype), np.asarray(Ts, u.dtype)
        return np.asarray(run(mechanism.structure, solver or Exponential(), values, gates, start, u, period))


def _input(mechanism: Mechanism, u: Any) -> Float[np.ndarray, "N *c"]:
    """The voltage, with the signals beside it if the mechanism takes signals; checked."""
    names = mechanism.signals
    if isinstance(u, Recording):
        raise InputError(
            "Argument `u` must be the samples of the voltage, but is a Recording; pass its u and its Ts, or "
            "write Model(mechanism).simulate(recording), which also starts from its first state."
        )
    if isinstance(u, Tracer):
        raise InputError(
            "JAX traces `u`, but its samples are needed here; inside of jax.jit or jax.grad use "
            "rotflex_jax.mechanism.free_run, or give numbers."
        )
    if not names:
        return signal(u)
    if np.shape(u)[1:] == (1 + len(names),):
        return np.stack([signal(column, "u") for column in np.transpose(u)], axis=1)
    if mechanism.takes_signals:
        raise InputError(
            f"The mechanism is driven by {', '.join(map(repr, names))} beside the voltage, but `u` has the "
            f"shape {np.shape(u)}; give {1 + len(names)} columns, or simulate a recording with these signals."
        )
    return signal(u)
