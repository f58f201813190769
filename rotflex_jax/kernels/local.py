"""Taylor kernels about a constant voltage: exact derivatives of the simulator."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.kernels.result import Kernels
from rotflex_jax.kernels.sensitivities import Modelled, lags_of, output_model
from rotflex_jax.mechanism.assembly import motor_voltage, rest_state
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.scan import states
from rotflex_jax.mechanism.simulate import FreeStep, Solver, free_run, read_outputs
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

DIRECTIONS_PER_BATCH = 64
"""Directions that are differentiated at once: enough for the vector units, few enough for the cache."""


def local_kernels(
    model: Mechanism | Modelled,
    Ts: float,
    channel: str,
    memory: int,
    *,
    voltage: float = 0.0,
    settle: float | None = None,
    cubic: bool = False,
) -> Kernels:
    """Volterra kernels by Taylor expansion of the simulated output in its last input samples.

        h1[k] = dy[t] / du[t-k],   h2[k, j] = 1/2 d2y[t] / du[t-k] du[t-j],   u near a constant

    The second-order series of a smooth mechanism has an error of third order in the input's deviation. Not
    for dry friction, dead zones and play at rest: a joint that sticks has zero slope there, and a joint that
    slides at a constant voltage has the slope of the joint without friction. An identification finds
    `average_kernels` there.

    Args:
        model: Mechanism, or a model with its own integration rule and gates.
        Ts: Sampling period [s]; the voltage is held between samples.
        channel: Output.
        memory: Number of lags M, from 0 to M - 1.
        voltage: Constant voltage that the series is about [V].
        settle: How long that voltage acts, from rest, before the kernels are formed [s]; five memories
            if None. A motion that continues after that (the angle of a turning hub) is part of `h0`.
        cubic: Whether to form the diagonal of the cubic kernel too.

    Returns:
        Exact kernels of the simulated model, without standard errors.

    Raises:
        InputError: An unknown channel, no lags, or a period or time that is not positive.

    Source: Rugh, Nonlinear System Theory, 1981, section 3.2 (kernels as Fréchet derivatives).

    >>> from rotflex_jax.joints import paper
    >>> kernels = local_kernels(paper(), 0.05, "alpha", 4)
    >>> [round(float(h), 4) + 0.0 for h in kernels.h1]
    [0.0, -0.0491, -0.0188, 0.0297]
    """
    s, memory = output_model(model, channel), lags_of(memory)
    settle = 5 * memory * Ts if settle is None else settle
    if not (np.isfinite(Ts) and Ts > 0 and np.isfinite(settle) and settle >= 0):
        raise InputError(
            f"A sampling period of {Ts:g} s and a settling time of {settle:g} s were given, but the first "
            "must be positive and the second not negative; correct them."
        )
    with double_precision():
        before = jnp.full(max(1, round(settle / Ts)), float(voltage))
        h0, h1, h2, h3 = _derivatives(
            s.mechanism.structure,
            s.solver,
            s.output,
            memory,
            cubic,
            jnp.asarray(s.mechanism.values),
            jnp.asarray(s.gates),
            jnp.asarray(rest_state(s.mechanism.structure, np.float64)),
            before,
            jnp.asarray(float(Ts)),
        )
    return Kernels(
        channel=channel,
        Ts=Ts,
        h0=float(h0),
        h1=np.asarray(h1),
        h2=np.asarray(h2),
        about=float(voltage),
        kind="local",
        input=f"small changes about {voltage:g} {s.mechanism.units.input}",
        h3_diagonal=np.asarray(h3) if cubic else None,
        input_unit=s.mechanism.units.input,
        output_unit=s.unit,
    )


@persistent_jit(static=5)
def _derivatives(
    structure: Mechanism,
    solver: Solver,
    output: int,
    memory: int,
    cubic: bool,
    values: jax.Array,
    gates: jax.Array,
    rest: jax.Array,
    before: jax.Array,
    Ts: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, Any]:
    mechanism = structure.with_values(values)
    held = jnp.concatenate([before, before[-1:]])
    x0 = free_run(structure, solver, values, gates, rest, held, Ts)[0][-1]
    c = solver.prepare(structure, values, gates, Ts)

    def last(recent: jax.Array) -> jax.Array:
        """The output at the end as a function of the input, latest sample first."""
        u = jnp.concatenate([before, recent[::-1]])
        # Actuation may have a memory, so it gets the earlier samples too.
        v = motor_voltage(mechanism, gates, u, Ts)[len(before) :]
        X = states(FreeStep(structure, solver), x0, v, c)
        return read_outputs(mechanism, gates, X[-1])[output]

    here, units = jnp.full(memory, before[-1]), jnp.eye(memory)
    batch = min(memory, DIRECTIONS_PER_BATCH)
    derivative = lambda f, e: lambda u: jax.jvp(f, (u,), (e,))[1]  # noqa: E731
    h1 = jax.lax.map(lambda e: derivative(last, e)(here), units, batch_size=batch)

    def row(e: jax.Array) -> jax.Array:
        return jax.vmap(lambda d: derivative(derivative(last, e), d)(here))(units)

    h2 = jax.lax.map(row, units, batch_size=max(1, DIRECTIONS_PER_BATCH // memory)) / 2
    h2 = (h2 + h2.T) / 2
    if not cubic:
        return last(here), h1, h2, None
    third = lambda e: derivative(derivative(derivative(last, e), e), e)(here) / 6  # noqa: E731
    return last(here), h1, h2, jax.lax.map(third, units, batch_size=batch)
