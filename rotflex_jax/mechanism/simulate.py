"""Free run and prediction on arrays; everything is pure, jitted once per structure and differentiable."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.effects.kinds import Gear
from rotflex_jax.mechanism.assembly import Layout, driven_voltage, effects_of, rest_state
from rotflex_jax.mechanism.blocks import WORTH, linear_outputs
from rotflex_jax.mechanism.combine import apply
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.propagate import states
from rotflex_jax.mechanism.sensors import read_outputs, read_with_sign, sensed
from rotflex_jax.mechanism.smooth import SmoothRK4
from rotflex_jax.mechanism.step import Exponential
from rotflex_jax.precision import working_precision

Solver = Exponential | SmoothRK4


@dataclasses.dataclass(frozen=True)
class FreeStep:
    """State to state under the recorded voltage."""

    structure: Mechanism
    solver: Solver

    @property
    def linear(self) -> bool:
        """Whether the state after the step is linear in state and voltage."""
        rough = Layout.of(self.structure).torque_ports or effects_of(self.structure, Gear)
        return isinstance(self.solver, Exponential) and not rough

    def __call__(self, x: jax.Array, v: jax.Array, c: Any) -> jax.Array:
        """State one sample later under the voltage `v`."""
        return self.solver.advance(self.structure, x, v, c)


@dataclasses.dataclass(frozen=True)
class PredictorStep:
    """State to state, corrected by the measured output first: `x+ = F(x + K (y - h(x)), v)`."""

    structure: Mechanism
    solver: Solver

    def __call__(self, x: jax.Array, w: tuple[jax.Array, ...], constants: Any) -> jax.Array:
        """State one sample later; `w` is voltage, outputs, and whether they may correct the state."""
        v, y, seen = w
        c, K = constants
        mechanism = self.structure.with_values(c.values)
        read, way = read_with_sign(mechanism, c.gates, x)
        e = (y - read) * way * seen[None]
        return self.solver.advance(self.structure, x + apply(K, e), v, c)


def driven(
    structure: Mechanism, solver: Solver, values: jax.Array, gates: jax.Array, u: jax.Array, Ts: jax.Array
) -> tuple[Mechanism, Any, Any]:
    """The mechanism with its numbers, what the solver takes at each sample of `u` (N,), its constants."""
    mechanism = structure.with_values(values)
    constants = solver.prepare(structure, values, gates, Ts)
    return mechanism, solver.inputs(driven_voltage(mechanism, gates, u, Ts)), constants


def free_run(
    structure: Mechanism,
    solver: Solver,
    values: jax.Array,
    gates: jax.Array,
    x0: jax.Array,
    u: jax.Array,
    Ts: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Simulated states (N, n) and outputs (N, C) from the first state and the voltage alone.

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        values: Parameter values (P,).
        gates: One factor per effect, 1 where it is on.
        x0: First state (n,).
        u: Voltage (N,) [V], held over each sample.
        Ts: Sampling period [s].
    """
    mechanism, v, c = driven(structure, solver, values, gates, u, Ts)
    X = states(FreeStep(structure, solver), x0, v, c)
    return X, read_outputs(mechanism, gates, X.T).T


def predictor_run(
    structure: Mechanism,
    solver: Solver,
    values: jax.Array,
    gates: jax.Array,
    x0: jax.Array,
    u: jax.Array,
    y: jax.Array,
    seen: jax.Array,
    K: jax.Array,
    Ts: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """States before correction (N, n) and outputs predicted one step ahead (N, C).

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        values: Parameter values (P,).
        gates: One factor per effect.
        x0: First state (n,).
        u: Voltage (N,) [V].
        y: Measured outputs (N, C).
        seen: One where a sample may correct the state, zero where it may not (N,).
        K: Gain (n, C); zero is a free run.
        Ts: Sampling period [s].
    """
    mechanism, v, c = driven(structure, solver, values, gates, u, Ts)
    X = states(PredictorStep(structure, solver), x0, (v, y, seen), (c, K))
    return X, read_outputs(mechanism, gates, X.T).T


@kept(static=2)
def _free_states(structure: Mechanism, solver: Solver, *given: jax.Array) -> jax.Array:
    return free_run(structure, solver, *given)[0]


@kept(static=2)
def _free_outputs(structure, solver, values, gates, x0, u, Ts):  # noqa: ANN001, ANN202 - as `free_run`
    """Outputs (N, C) alone: no state is kept."""
    mechanism, v, c = driven(structure, solver, values, gates, u, Ts)
    step = FreeStep(structure, solver)
    if step.linear and len(u) >= WORTH:
        rows = jnp.asarray(Layout.of(structure).output_rows, x0.dtype)
        rows = jnp.pad(rows, ((0, 0), (0, len(x0) - rows.shape[1])))
        return sensed(mechanism, gates, linear_outputs(step, x0, v, c, rows).T).T
    body = lambda x, w: (step(x, w, c), read_outputs(mechanism, gates, x))  # noqa: E731
    return jax.lax.scan(body, x0, v)[1]


def simulate(
    mechanism: Mechanism,
    u: np.ndarray,
    Ts: float,
    x0: np.ndarray | None = None,
    solver: Solver | None = None,
) -> np.ndarray:
    """Outputs (N, C) of a free run from `x0` (rest if None), in the precision of `u`.

    Args:
        mechanism: Model.
        u: Voltage (N,) [V], held over each sample.
        Ts: Sampling period [s].
        x0: First state, or only its positions and speeds.
        solver: Integration rule; `Exponential()` if None.
    """
    return _simulated(_free_outputs, mechanism, u, Ts, x0, solver)


def simulate_states(
    mechanism: Mechanism,
    u: np.ndarray,
    Ts: float,
    x0: np.ndarray | None = None,
    solver: Solver | None = None,
) -> np.ndarray:
    """States (N, n) of a free run: positions, speeds, then states of motor and memories."""
    return _simulated(_free_states, mechanism, u, Ts, x0, solver)


def _simulated(run, mechanism, u, Ts, x0, solver):  # noqa: ANN001, ANN202 - typed in the two callers
    u = np.asarray(u)
    u = u if u.dtype in (np.float32, np.float64) else u.astype(np.float64)
    start = rest_state(mechanism.structure, u.dtype)
    if x0 is not None:
        start[: len(x0)] = x0
    with working_precision(u):
        gates = np.ones(len(mechanism.effects), u.dtype)
        numbers = (mechanism.values.astype(u.dtype), gates, start, u, np.asarray(Ts, u.dtype))
        return np.asarray(run(mechanism.structure, solver or Exponential(), *numbers))
