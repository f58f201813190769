"""Only the active part of a super-model is run, with the same results as the whole."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH

import rotflex_jax.effects as fx
from rotflex_jax.discover.batched_predictor import BatchedPredictor, Directions, ParameterSet
from rotflex_jax.discover.candidate_slopes import candidate_sensitivities
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel, build
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, kalman_gains, simulate
from rotflex_jax.mechanism.assembly import Layout, motor_inputs, own_states
from rotflex_jax.mechanism.simulate import PredictorStep, read_outputs
from rotflex_jax.runtime.xla import double_precision

TS, N = (0.004, 0.005), 120
SCALES = {p: fx.Scale(2.0, 3.0, 0.3, 0.2, 1.6, 0.006) for p in ("hub", "arm", "joint")}
SCALES |= {p: fx.Scale(2.0, 1.0, 0.3, 0.2) for p in ("input", "theta", "alpha")}
PROCESS = {"hub": 1e-5, "joint": 1e-6}
WANTED = (
    (fx.LuGre, "hub"),
    (fx.SecondMode, "arm"),
    (fx.CubicSpring, "joint"),
    (fx.Heating, "hub"),
    (fx.BoucWen, "joint"),
    (fx.Lag, "input"),
    (fx.Coulomb, "joint"),
    (fx.Cogging, "arm"),
    (fx.CrossTalk, "alpha"),
)
SETS = {
    "nothing": (),
    "without states": (EffectLocation("cubic_spring", "joint"), EffectLocation("lag", "input")),
    "one memory": (EffectLocation("heating", "hub"), EffectLocation("cubic_spring", "joint")),
    "a mode and dry friction": (EffectLocation("second_mode", "arm"), EffectLocation("coulomb", "joint")),
    "all": tuple(EffectLocation(cls.name, port) for cls, port in WANTED),
}


@functools.cache
def supermodel() -> SuperModel:
    """A baseline with states of linear effects and of memories, and candidates with more of both."""
    baseline = paper(inductance=0.18e-3, joint_damping=1e-3) + fx.Dahl("arm", 0.004, 0.01)
    return build(baseline, WANTED, SCALES)


# Each of the two recordings is one window.
ONE_RUN = np.zeros((2, N), np.int32)


@functools.cache
def predictor(between: str = "held") -> BatchedPredictor:
    rng = np.random.default_rng(0)
    u = 1.5 * np.repeat(rng.normal(size=(2, N // 5)), 5, axis=1)
    y = np.stack([simulate(paper(stiffness=1.5), v, Ts) for v, Ts in zip(u, TS, strict=True)])
    y = y + 5e-4 * rng.normal(size=y.shape)
    seen = 1.0 * (rng.random((2, N)) < 0.95)
    seen[0, 2 * N // 3 :] = 0.0  # as if only the first seconds counted
    data = StackedRecordings(u, y, seen, np.array(TS))
    return BatchedPredictor(supermodel(), Exponential(between=between), data)


def numbers(name: str) -> ParameterSet:
    """Parameters of a set for the whole super-model; offsets and first states differ between recordings."""
    s, rng = supermodel(), np.random.default_rng(1)
    values, size = np.tile(s.mechanism.values, (2, 1)), Layout.of(s.mechanism.structure).size
    values[:, s.local] = 0.01 * rng.normal(size=(2, len(s.local)))
    K, x0 = 0.02 * rng.normal(size=(2, size, 2)), np.zeros((2, size))
    for r, Ts in enumerate(TS):
        K[r, s.baseline_states] = kalman_gains(s.baseline, [PROCESS], [5e-4, 5e-4], Ts)[0]
    gates = s.gates(s.calibrations + SETS[name])
    x0[:, list(s.active(gates).states)] = 0.1  # zero for inactive effects
    return ParameterSet(values, (x0 * rng.normal(size=x0.shape))[:, None], gates, K)


def parameter_set(name: str) -> ParameterSet:
    """The same for the batched predictor, with the first state of the active part alone."""
    whole = numbers(name)
    return whole._replace(x0=whole.x0[..., list(supermodel().active(whole.gates).states)])


@functools.cache
def program(between: str):
    """Innovations of the whole super-model by `jax.lax.scan`, and their derivatives by `jax.jvp`."""
    structure, solver = supermodel().mechanism.structure, Exponential(between=between)
    step = PredictorStep(structure, solver)

    def predicted(gates, values, x0, K, u, y, seen, Ts):
        mechanism = structure.with_values(values)
        constants = (solver.prepare(structure, values, gates, Ts), K)
        inputs = (motor_inputs(solver, mechanism, gates, u, Ts), y, seen)
        X = jax.lax.scan(lambda x, w: (step(x, w, constants), x), x0, inputs)[1]
        return (y - read_outputs(mechanism, gates, X.T).T) * seen[:, None]

    def run(whole, dvalues, dgates):
        def e(values, gates):
            each = jax.vmap(functools.partial(predicted, gates))
            return each(values, whole.x0[:, 0], whole.K, *map(jnp.asarray, predictor(between).data))

        at = (whole.values, whole.gates)
        return e(*at), jax.vmap(lambda dv, dg: jax.jvp(e, at, (dv, dg))[1])(dvalues, dgates)

    return jax.jit(run, compiler_options=ROUGH)


def whole_run(whole: ParameterSet, along: Directions, between: str = "held") -> tuple[np.ndarray, np.ndarray]:
    """Innovations (R, N, C) and slopes (D, R, N, C)."""
    with double_precision():
        e, J = program(between)(*jax.tree.map(jnp.asarray, (whole, along.values, along.gates)))
        return np.asarray(e), np.asarray(J)


def directions(name: str, *names: str) -> Directions:
    """Five directions: a tenth of each named parameter, and zeros; none changes the first state."""
    m, on = supermodel().mechanism, parameter_set(name)
    sizes = ((2, len(m.values)), on.x0.shape[-1:], on.gates.shape)
    d = Directions(*(np.zeros((5, *size)) for size in sizes))
    for row, parameter in enumerate(names):
        i = m.parameter_names.index(parameter)
        d.values[row, :, i] = 0.1 * m.values[i]
    return d


# -- layout of states and parameters ------------------------------------------------------------


def test_states_of_linear_effects_come_first_then_memories():
    s = supermodel()
    rows = {(e.name, e.at): own_states(s.mechanism).get(i) for i, e in enumerate(s.mechanism.effects)}
    assert {location: r for location, r in rows.items() if r} == {
        ("motor", "hub"): (4,),
        ("second_mode", "arm"): (5, 6),
        ("dahl", "arm"): (7,),
        ("lugre", "hub"): (8,),
        ("heating", "hub"): (9,),
        ("bouc_wen", "joint"): (10,),
    }
    assert Layout.of(s.mechanism.structure).size == 11
    assert s.baseline_states == [0, 1, 2, 3, 4, 7]


@pytest.mark.parametrize("name", SETS)
def test_a_part_lacks_the_candidates_that_are_off(name):
    s, gates = supermodel(), parameter_set(name).gates
    part = s.active(gates)
    off = set(s.candidates) - set(SETS[name])
    expected = [e for e in s.mechanism.effects if (e.name, e.at) not in off]
    assert list(part.mechanism.effects) == expected
    assert [s.mechanism.effects[i] for i in part.effects] == expected
    np.testing.assert_array_equal(s.mechanism.values[list(part.parameters)], part.mechanism.values)
    assert [s.mechanism.parameter_names[i] for i in part.parameters] == [*part.mechanism.parameter_names]
    assert len(part.states) == Layout.of(part.mechanism.structure).size
    assert set(s.baseline_states) <= set(part.states)
    mine, all_rows = own_states(part.mechanism), own_states(s.mechanism)
    for k, i in enumerate(part.effects):
        assert tuple(part.states[row] for row in mine.get(k, ())) == all_rows.get(i, ())
    assert s.active(gates) is part  # compiled once
    assert part.mechanism.trusted == s.baseline.trusted


def test_a_part_holds_all_that_any_of_several_lanes_needs():
    s = supermodel()
    both = np.stack([parameter_set("one memory").gates, parameter_set("a mode and dry friction").gates])
    kept = {(s.mechanism.effects[i].name) for i in s.active(both).effects}
    assert {"heating", "second_mode", "coulomb", "cubic_spring"} <= kept
    assert not {"lugre", "bouc_wen", "lag"} & kept


def test_candidates_that_could_not_act_are_left_out():
    flat = {p: dataclasses.replace(scale, stiffness=0.0, inertia=0.0) for p, scale in SCALES.items()}
    wanted = ((fx.Heating, "arm"), (fx.Heating, "hub"), (fx.JointPlay, "joint"), (fx.SecondMode, "arm"))
    assert set(build(paper(), wanted, flat).candidates) == {("heating", "hub")}
    without_motor = paper().without("motor", "hub")
    assert set(build(without_motor, wanted, SCALES).candidates) == {
        ("joint_play", "joint"),
        ("second_mode", "arm"),
    }


# -- innovations and derivatives ----------------------------------------------------------------


def test_innovations_on_parts_are_those_of_the_whole():
    names = ("nothing", "without states", "one memory", "a mode and dry friction")
    found = predictor().innovations([parameter_set(name) for name in names], ONE_RUN)
    for name, mine in zip(names, found, strict=True):
        whole = whole_run(numbers(name), directions(name))[0]
        np.testing.assert_allclose(mine, whole, rtol=0, atol=1e-10, err_msg=name)
        assert name == "nothing" or np.abs(mine - found[0]).max() > 1e-4


def test_slopes_on_parts_are_those_of_the_whole():
    name = "a mode and dry friction"
    along = directions(name, "hub.motor.torque_constant", "arm.second_mode.frequency", "joint.coulomb.level")
    along.gates[3] = supermodel().gates([EffectLocation("cubic_spring", "joint")])
    e, J = predictor().slopes([parameter_set(name)], [along], ONE_RUN)
    whole_e, whole_J = whole_run(numbers(name), along)
    np.testing.assert_allclose(e[0], whole_e, rtol=0, atol=1e-10)
    for mine, whole in zip(J[0], whole_J, strict=True):
        np.testing.assert_allclose(mine, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
    assert np.abs(whole_J[:4]).max(axis=(1, 2, 3)).min() > 1e-5


@pytest.mark.parametrize("between", ["held", "switched"])
def test_probes_are_the_slopes_of_the_whole(between: str):
    """Derivatives along amplitudes of inactive effects, and along the gate of the lag without amplitude."""
    s, now, put = supermodel(), parameter_set("one memory"), numbers("one memory")
    # States of inactive effects are not corrected: gains are those of the baseline.
    K = np.zeros_like(now.K)
    K[:, s.baseline_states] = now.K[:, s.baseline_states]
    now, put = now._replace(K=K), put._replace(K=K)
    absent = [c for c in s.candidates.values() if now.gates[c.effect] == 0]
    found = candidate_sensitivities(predictor(between), now, absent, ONE_RUN)
    tried = [(p.candidate.location, p.shape, p.member) for slopes in found for p in slopes.probes]
    assert sorted(tried) == sorted(
        (c.location, k, m) for c in absent for k, shape in enumerate(c.probes) for m in range(len(shape))
    )
    for p, mine in ((p, J) for slopes in found for p, J in zip(*slopes, strict=True)):
        c, along = p.candidate, directions("one memory")
        values, gates, own = put.values.copy(), put.gates.copy(), list(c.parameters)
        shape = np.array(c.probes[p.shape][p.member])
        values[:, own] = np.where(c.amplitudes, 0.0, shape)
        along.values[0][:, own] = np.where(c.amplitudes, shape, 0.0)
        if any(c.amplitudes):
            gates[c.effect] = 1.0
        else:
            along.gates[0, c.effect] = 1.0
        expected = whole_run(put._replace(values=values, gates=gates), along, between)[1][0]
        size = np.abs(expected).max()
        assert size > 1e-6, c.location
        np.testing.assert_allclose(
            mine, expected, rtol=0, atol=1e-9 * size, err_msg=f"{c.location} {p.shape}"
        )
