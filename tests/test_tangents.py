"""Slopes carried with the run beside those that JAX takes of the run itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, SmoothRK4, free_run, predictor_run
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    outputs_with_sensitivities,
)
from rotflex_jax.runtime.xla import double_precision

JOINT = paper(hub_damping=0.01, joint_damping=0.002, inductance=2e-4)
PLAIN = paper(hub_damping=0.01, joint_damping=0.002)
CASES = {
    "forces": (JOINT + fx.CubicSpring("joint", 4.0), Exponential(order=4), False),
    "two contacts": (
        PLAIN + fx.Coulomb("hub", 0.02) + fx.Coulomb("joint", 0.01),
        Exponential(passes=1),
        True,
    ),
    "memory": (PLAIN + fx.LuGre("hub"), Exponential(), True),
    "sensor and input": (
        PLAIN + fx.SensorCubic("alpha", 0.1) + fx.Lag(time=0.004),
        Exponential(substeps=2, between="smooth"),
        True,
    ),
    "one direction by itself": (PLAIN + fx.CubicSpring("joint", 4.0), SmoothRK4(substeps=2), False),
}


@pytest.mark.parametrize("case", CASES)
def test_slopes_are_those_of_the_whole_run(case: str) -> None:
    joint, solver, corrected = CASES[case]
    structure = joint.structure
    rng = np.random.default_rng(0)
    N, n, P, E = 120, len(rest_state(structure, np.float64)), len(joint.values), len(joint.effects)
    ways = TangentDirections(
        rng.normal(size=(5, P)) * joint.values, np.zeros((5, E)), 0.1 * rng.normal(size=(5, n))
    )
    ways.gates[4, -1] = 1.0
    samples = RecordingSamples(
        3 * rng.normal(size=N), 0.1 * rng.normal(size=(N, 2)), np.arange(N) % 7 > 0.0, 0.002
    )
    gain = 0.2 * rng.normal(size=(n, 2)) if corrected else None
    with double_precision():
        given = jax.tree.map(jnp.asarray, (joint.values, np.ones(E), 0.05 * rng.normal(size=n)))
        u, y, seen, Ts = (jnp.asarray(a, jnp.float64) for a in samples[:4])

        def run(*point: jax.Array) -> jax.Array:
            values, gates, x0 = point
            if gain is None:
                return free_run(structure, solver, values, gates, x0, u, Ts)[1]
            return predictor_run(structure, solver, values, gates, x0, u, y, seen, jnp.asarray(gain), Ts)[1]

        directions = jax.tree.map(jnp.asarray, tuple(ways))
        slope = jax.vmap(lambda p, g, x: jax.jvp(run, given, (p, g, x))[1], out_axes=-1)
        y_hat, J = jax.jit(lambda: (run(*given), slope(*directions)))()
        numbers = RunParameters(given[0], given[1], given[2], None if gain is None else jnp.asarray(gain))
        carried = jax.jit(outputs_with_sensitivities, static_argnums=(0, 1))
        got = carried(
            structure, solver, numbers, TangentDirections(*directions), RecordingSamples(u, y, seen, Ts)
        )
    np.testing.assert_allclose(got[0], y_hat, rtol=1e-10, atol=1e-12 * np.abs(y_hat).max())
    np.testing.assert_allclose(got[1], J, rtol=1e-7, atol=1e-9 * np.abs(J).max())
