"""What stands between samples: late voltages, finer steps, and what a recording inherits."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import small_problem as sp

import rotflex_jax as rf
from rotflex_jax.discover.likelihood import (
    SUBSTEP_FACTOR,
    LikelihoodProblem,
    correct_discretisation_bias,
    levenberg_marquardt,
)
from rotflex_jax.effects import Delay, Heating, Lag
from rotflex_jax.mechanism import Exponential
from rotflex_jax.parameters import Transform
from rotflex_jax.runtime.xla import double_precision


@pytest.mark.parametrize("late", [Delay(time=0.0045), Delay(time=0.004), Lag(time=0.006), Lag(time=0.0007)])
def test_a_late_voltage_moves_a_mass_as_far_as_it_should(late):
    """Both hold the impulse and come late by `time` in the mean: a free mass ends where that says."""
    Ts, N = 0.002, 400
    u = np.zeros(N)
    u[5:45] = np.random.default_rng(0).normal(size=40)
    with double_precision():
        v = np.asarray(late.drive(jnp.asarray(u), Ts))
    middle = (np.arange(N) + 0.5) * Ts
    assert v.sum() == pytest.approx(u.sum(), rel=1e-12)
    far = Ts * np.sum((N * Ts - middle) * v)
    assert far == pytest.approx(Ts * np.sum((N * Ts - middle - late.time) * u), rel=1e-9)


# -- finer steps ------------------------------------------------------------------------------------


def coarse(found: LikelihoodProblem, substeps: int) -> LikelihoodProblem:
    solver = Exponential(substeps=substeps)
    return LikelihoodProblem.of(found.supermodel, solver, found.dataset, found.ports)


def with_friction(problem: LikelihoodProblem):
    s, h = problem.supermodel, sp.fitted(problem)
    i = s.parameter_indices(sp.HUB)[0]
    z = h.z.copy()
    z[i] = Transform.of([s.mechanism.parameter_specifications[i]]).unconstrain(np.array([0.01]))[0]
    return dataclasses.replace(h, locations=(*h.locations, sp.HUB), free=(*h.free, i), z=z)


def test_one_step_reaches_what_a_fit_with_finer_steps_finds():
    problem = coarse(sp.problem(sp.recordings(sp.records(0.03))), 1)
    h = levenberg_marquardt(problem, [with_friction(problem)], max_steps=60)[0]
    best = levenberg_marquardt(coarse(problem, SUBSTEP_FACTOR), [h], max_steps=60)[0]
    better = correct_discretisation_bias(problem, h)
    free = list(h.free)
    before, after = (np.abs(x.z[free] - best.z[free]) for x in (h, better))
    assert before.max() > 1e-4
    assert after.max() < 0.25 * before.max()


def test_where_the_motion_is_linear_nothing_moves():
    problem = coarse(sp.problem(sp.recordings(sp.records(0.0))), 1)
    h = sp.fitted(problem)
    assert correct_discretisation_bias(problem, h) is h


# -- what came before -------------------------------------------------------------------------------


def test_a_part_knows_what_came_before_it():
    u = np.sin(np.arange(400.0))
    whole = rf.Recording(u=u, y=np.stack([np.cumsum(u), u], axis=1) * 1e-3, Ts=0.01, accept=("units",))
    train, test = whole.split(0.7)
    assert whole.continues is None and train.continues is None
    assert test.continues is not None and test.continues.N == train.N
    np.testing.assert_array_equal(test.continues.y, train.y)
    later = test.slice(20, 60)
    assert later.continues is not None and later.continues.N == 20
    assert later.continues.continues is not None and later.continues.continues.N == train.N


def test_a_warm_motor_stays_warm_in_the_second_part():
    """The second part of a run is a run of its own, but for the heat that the first one left."""
    model = rf.Model(rf.joints.paper() + Heating(at="hub", rate=3.0, time=30.0))
    rng = np.random.default_rng(1)
    u = np.repeat(2 * rng.normal(size=60), 20)
    empty = rf.Recording(
        u=u, y=np.cumsum(rng.normal(size=(1200, 2)), axis=0) * 1e-3, Ts=0.005, accept=("units",)
    )
    whole = dataclasses.replace(empty, y=model.simulate(empty, np.zeros(4)))
    test = whole.split(0.7)[1]
    warm = model.simulate(test) - test.y
    cold = model.simulate(dataclasses.replace(test, continues=None)) - test.y
    assert np.abs(warm).max() < 0.02 * np.abs(cold).max()
