"""Sensitivities by laws that are evaluated beside a run, against JAX's derivative of runs with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, Mechanism, Solver, kalman_gains, simulate
from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.mechanism.inactive_laws import (
    InactiveLaws,
    adds_to_step,
    friction_responses,
    law_sensitivities,
    run_responses,
)
from rotflex_jax.mechanism.sensitivities import RecordingSamples, RunParameters
from rotflex_jax.mechanism.simulate import PredictorStep, prepared_run, read_outputs, restarts
from rotflex_jax.runtime.xla import double_precision

Ts, N = 0.004, 150
JOINT = paper(joint_damping=1e-3)
RUBBING = JOINT + fx.Coulomb("hub", 0.03) + fx.CubicSpring("joint", 4.0)
LOADED = JOINT + fx.LoadFriction("hub", level=0.01, driving=0.2, driven=0.1, of="motor")
SERVO = JOINT.without("motor", "hub") + fx.PidServo("hub", torque_constant=0.3, resistance=3.0, integral=4.0)
CASES = {
    "a second contact": (RUBBING, Exponential(passes=2), fx.Stribeck("joint", 0.0, 0.0, 0.4)),
    "the same contact": (RUBBING, Exponential(passes=2), fx.CoulombAsymmetric("hub", 0.0, 0.0)),
    "a torque, order 4": (RUBBING, Exponential(order=4), fx.Gravity("arm", 0.0, 0.0)),
    "a memory": (RUBBING, Exponential(), fx.LuGre("joint", level=0.0, damping=0.0)),
    "a torque beside friction by the motor's torque": (LOADED, Exponential(), fx.Gravity("arm", 0.0, 0.0)),
    "a memory beside a servo whose current is read": (
        SERVO + fx.CurrentMeter("hub") + fx.Coulomb("hub", 0.03),
        Exponential(),
        fx.LuGre("joint", level=0.0, damping=0.0),
    ),
    "beside play": (JOINT + fx.Backlash("hub", 0.02), Exponential(), fx.Gravity("arm", 0.0, 0.0)),
}


@dataclasses.dataclass(frozen=True)
class Run:
    """A recording in two windows, and a model with first states and gain for it."""

    joint: Mechanism
    solver: Solver
    x0: np.ndarray
    K: np.ndarray
    u: np.ndarray
    y: np.ndarray
    seen: np.ndarray
    window: np.ndarray

    @classmethod
    def of(cls, joint: Mechanism, solver: Solver) -> "Run":
        rng = np.random.default_rng(0)
        plain = [e for e in joint.effects if not isinstance(e, fx.Backlash)]
        gain = kalman_gains(dataclasses.replace(joint, effects=plain), [{"hub": 1e-4}], [5e-4] * 2, Ts)[0]
        K = np.zeros((Layout.of(joint.structure).size, 2))
        K[:4] = gain[:4]
        u = 1.5 * np.repeat(rng.normal(size=N // 5), 5)
        y = simulate(paper(stiffness=1.5), u, Ts) + 5e-4 * rng.normal(size=(N, 2))
        x0 = np.tile(rest_state(joint.structure, np.float64), (2, 1))
        x0[:, :4] = rng.normal(size=(2, 4)) * [0.1, 0.01, 0.2, 0.1]
        return cls(joint, solver, x0, K, u, y, 1.0 * (rng.random(N) < 0.9), np.arange(N) // 90)

    def outputs(self, effect: fx.Effect, values: jax.Array) -> jax.Array:
        """Outputs of the model with the effect added, by an ordinary scan of all steps."""
        whole = self.joint + effect
        structure, first = whole.structure, len(self.joint.values)
        size, own = Layout.of(structure).size, self.x0.shape[1]
        rest = np.tile(rest_state(structure, np.float64), (2, 1))
        rest[:, :own] = self.x0
        x, restart = restarts(jnp.asarray(rest), jnp.asarray(self.window))
        every = jnp.asarray(whole.values).at[first:].set(values)
        gates = jnp.ones(len(whole.effects))
        given = map(jnp.asarray, (self.u, Ts))
        mechanism, v, c = prepared_run(structure, self.solver, every, gates, *given)
        step, K = PredictorStep(structure, self.solver), jnp.pad(self.K, ((0, size - own), (0, 0)))
        inputs = (v, jnp.asarray(self.y), jnp.asarray(self.seen), *restart)
        X = jax.lax.scan(lambda x, w: (step(x, w, (c, K)), x), x, inputs)[1]
        return read_outputs(mechanism, gates, X.T).T


@pytest.mark.parametrize("case", CASES)
def test_slopes_are_those_of_the_model_with_the_effect(case: str) -> None:
    """Reference: JAX's derivative of a scan of the model with the effect, and no other inactive contact."""
    joint, solver, effect = CASES[case]
    assert adds_to_step(effect, joint.structure, solver)
    run, values = Run.of(joint, solver), np.array(list(effect.values.values()))
    ways = np.array([[1.0 * (n == a) for n in effect.values] for a in effect.amplitudes])
    # The sum of the directions as well.
    ways = np.array([effect.declared()[n].typical for n in effect.values]) * np.vstack(
        [ways, ways.sum(axis=0)]
    )

    def found() -> jax.Array:
        gates = jnp.ones(len(joint.effects))
        numbers = RunParameters(jnp.asarray(joint.values), gates, jnp.asarray(run.x0), jnp.asarray(run.K))
        samples = RecordingSamples(*map(jnp.asarray, (run.u, run.y, run.seen, Ts, run.window)))
        structure, smooth = joint.structure, isinstance(effect, fx.Force | fx.Memory)
        responses = run_responses(structure, solver, (effect.at,) if smooth else (), numbers, samples)
        at_ports = responses.torques
        if at_ports is None:
            ports = ("arm", effect.at)  # another contact without a level changes nothing
            found = friction_responses(structure, solver, ports, numbers, samples, responses.run.X)
            at_ports = jax.tree.map(lambda a: a[:, 1:], found)
        laws = InactiveLaws((jnp.asarray(values[None]),), (jnp.asarray(ways[None]),))
        return law_sensitivities((effect,), (effect.at,), laws, samples, responses, at_ports)

    with double_precision():
        slope = jax.vmap(lambda way: jax.jvp(lambda p: run.outputs(effect, p), (values,), (way,))[1])
        expected = np.asarray(jax.jit(slope, compiler_options=ROUGH)(jnp.asarray(ways)))
        mine = np.asarray(jax.jit(found, compiler_options=ROUGH)())
    assert mine.shape == expected.shape
    for one, other in zip(mine, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * np.abs(other).max())
    assert np.abs(expected).max(axis=(1, 2)).min() > 1e-6
