"""Derivatives of a model's output with respect to each of its last input samples.

A trajectory `x[t+1] = F(x[t], v[t])` has the Jacobians `A[t] = dF/dx`, `B[t] = dF/dv`, which follow from the
states and are computed for all samples at once. The response to the voltage k samples ago is
`A[t-1] ... A[t-k+1] B[t-k]`. It is computed by a recursion over the lag, for all samples in parallel.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax.checks import whole
from rotflex_jax.effects.base import Actuation
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import effects_of, motor_voltage
from rotflex_jax.mechanism.mechanism import Mechanism, check_input_alone, check_mechanism
from rotflex_jax.mechanism.scan import join_chunks, split_into_chunks, states
from rotflex_jax.mechanism.simulate import FreeStep, Solver, read_outputs
from rotflex_jax.mechanism.step import Exponential
from rotflex_jax.runtime.persistent_jit import persistent_jit


@runtime_checkable
class Modelled(Protocol):
    """A model: mechanism, integration rule, one gate per effect or None for all on."""

    @property
    def mechanism(self) -> Mechanism:
        """The physics."""
        ...

    @property
    def solver(self) -> Solver:
        """Integration rule."""
        ...

    @property
    def gates(self) -> tuple[float, ...] | None:
        """Gate of each effect; None if all effects are on."""
        ...


class OutputModel(NamedTuple):
    """One output of a mechanism with its solver and gates.

    Attributes:
        mechanism: The physics.
        solver: Integration rule.
        gates: Gate of each effect.
        output: Index of the output.
    """

    mechanism: Mechanism
    solver: Solver
    gates: Float[np.ndarray, " E"]
    output: int

    @property
    def unit(self) -> str:
        """Unit of the output."""
        return self.mechanism.quantities[self.output].unit(self.mechanism.units)


def output_model(model: Mechanism | Modelled, channel: str) -> OutputModel:
    """One output of a model; a mechanism alone is integrated by one exponential step per sample.

    Raises:
        InputError: The mechanism has no such output, or its voltage is not held between samples.
    """
    if isinstance(model, Mechanism):
        mechanism, solver, given = model, Exponential(), None
    else:
        check_mechanism(getattr(model, "mechanism", model))
        mechanism, solver, given = model.mechanism, model.solver, model.gates
    check_input_alone(mechanism, "a Volterra kernel")
    if channel not in mechanism.channels:
        raise InputError(
            f"Kernels of {channel!r} were requested, but the mechanism has the outputs "
            f"{', '.join(mechanism.channels)}; choose one of these."
        )
    if (between := getattr(solver, "between", "held")) != "held":
        raise InputError(
            f"Kernels were requested of a model whose voltage is {between} between its samples, but they "
            'are of a voltage that is held; use a solver with between="held".'
        )
    gates = np.ones(len(mechanism.effects)) if given is None else np.array(given, float)
    return OutputModel(mechanism, solver, gates, mechanism.channels.index(channel))


def lags_of(memory: int) -> int:
    """The number of lags as an integer.

    Raises:
        InputError: `memory` is not a whole number, or is below one.
    """
    return whole(memory, "memory", 1)


@persistent_jit(static=4)
def output_derivatives(
    structure: Mechanism,
    solver: Solver,
    output: int,
    reach: int,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, " n"],
    u: Float[Array, " N"],
    Ts: Float[Array, ""],
) -> tuple[Float[Array, " N"], Float[Array, "reach N"]]:
    """The output and its derivatives `dy[t] / du[t-k]`; derivatives with t < k are undefined.

    Args:
        structure: `mechanism.structure`; static.
        solver: Integration rule; static.
        output: Index of the output; static.
        reach: Number of lags, from 0 to reach - 1; static.
        values: Parameter values.
        gates: Gate of each effect.
        x0: First state.
        u: Voltage [V].
        Ts: Sampling period [s].
    """
    mechanism = structure.with_values(values)
    c = solver.prepare(structure, values, gates, Ts)
    v = motor_voltage(mechanism, gates, u, Ts)
    step = FreeStep(structure, solver)
    X = states(step, x0, v, c)
    read = lambda x: read_outputs(mechanism, gates, x)[output]  # noqa: E731

    def local(here: Any) -> tuple[Array, ...]:
        """Output, derivatives of the next state by state and voltage, derivatives of the output by state."""
        x, w = here
        size = len(x0) + 1
        units = jnp.broadcast_to(jnp.eye(size, dtype=x.dtype)[:, :, None], (size, size, len(w)))
        column = lambda e: jax.jvp(lambda q, r: step(q, r, c), (x, w), (e[:-1], e[-1]))[1]  # noqa: E731
        reading = lambda e: jax.jvp(read, (x,), (e[:-1],))[1]  # noqa: E731
        return read(x), jax.vmap(column)(units), jax.vmap(reading)(units[:-1])

    pieces = jax.lax.map(local, split_into_chunks((X, v)))
    y, AB, row = (jnp.moveaxis(join_chunks(piece, len(u)), 0, -1) for piece in pieces)
    A, B = AB[:-1], AB[-1]

    def next_lag(dx: Array, _: None) -> tuple[Array, Array]:
        """From the response of the state to the voltage k samples ago to its response k + 1 samples ago."""
        return jnp.roll(jnp.sum(A * dx[:, None], axis=0), 1, axis=1), jnp.sum(row * dx, axis=0)

    # The voltage of a sample acts on the next state at the earliest, so the response at lag 0 is zero.
    later = jax.lax.scan(next_lag, jnp.roll(B, 1, axis=1), None, length=reach)[1]
    responses = jnp.concatenate([jnp.zeros_like(later[:1]), later[: reach - 1]])
    if effects_of(mechanism, Actuation):
        responses = _by_command(mechanism, gates, u, Ts, responses)
    return y, responses


def _by_command(mechanism: Mechanism, gates: Array, u: Array, Ts: Array, responses: Array) -> Array:
    """Responses to the commanded voltage, from the responses to the motor's voltage.

    dy[t] / du[t-k] = sum_m dy[t] / dv[t-k+m]  dv[t-k+m] / du[t-k]
    """
    drive = lambda w: motor_voltage(mechanism, gates, w, Ts)  # noqa: E731
    slope = lambda e: jax.jvp(drive, (u,), (e,))[1]  # noqa: E731
    at = jnp.arange(len(u))[None, :] - jnp.arange(len(responses))[:, None]
    own, probe = slope(jnp.ones_like(u)), jax.random.normal(jax.random.key(0), u.shape, u.dtype)
    # The output of an actuator without memory depends on its input at the same sample only.
    at_once = jnp.allclose(slope(probe), own * probe, rtol=1e-9, atol=1e-12)
    return jax.lax.cond(at_once, lambda: responses * own[at], lambda: _convolved(slope, u, at, responses))


def _convolved(slope: Callable[[Array], Array], u: Array, at: Array, responses: Array) -> Array:
    """The sum of `_by_command` over all m below `reach`.

    The derivatives of the actuator are computed with impulse trains of the period `reach`. The responses to
    the impulses do not overlap, so a sample belongs to the latest impulse.
    """
    reach, time = len(responses), jnp.arange(len(u))
    trains = jax.lax.map(lambda p: slope((time % reach == p).astype(u.dtype)), jnp.arange(reach))
    lag = jnp.arange(reach)[:, None]

    def add(m: Array, total: Array) -> Array:
        """Adds the contribution of a command that reaches the motor m samples later."""
        moved = jnp.roll(responses * trains[(at - m) % reach, at], m, axis=0)
        return total + jnp.where(lag >= m, moved, 0.0)

    return jax.lax.fori_loop(0, reach, add, jnp.zeros_like(responses))
