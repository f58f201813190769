"""Batched least squares against SciPy's, properties of every refit, and the discretisation bias."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import small_problem as sp
from scipy.optimize import least_squares

import rotflex_jax as rf
from rotflex_jax.discover import likelihood as refit_module
from rotflex_jax.discover.integration_step import correct_discretisation_bias
from rotflex_jax.discover.likelihood import (
    EXTRA_ALTERNATIONS,
    LikelihoodProblem,
    _grid,
    choose_process_noise,
    levenberg_marquardt,
    refit,
)
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.effects import Delay, Heating, Lag
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import Windows
from rotflex_jax.mechanism import Exponential
from rotflex_jax.mechanism.finer_step import SUBSTEP_FACTOR
from rotflex_jax.optimise.damped_least_squares import LARGEST_STEP
from rotflex_jax.parameters import Transform
from rotflex_jax.runtime.xla import double_precision


@pytest.fixture(scope="module")
def plain():
    """Recordings of the baseline itself, and the baseline at its optimum."""
    problem = sp.problem(sp.recordings(sp.records(0.0)))
    return problem, sp.fitted(problem)


@pytest.fixture(scope="module")
def rough():
    """Recordings with friction."""
    return sp.problem(sp.recordings(sp.records(0.02)))


def with_friction(problem, level: float):
    """The true structure; the friction, which starts at this level, is a free parameter."""
    s, h = problem.supermodel, sp.start(problem, wrong=0.05)
    i = s.parameter_indices(sp.HUB)[0]
    z = h.z.copy()
    spec = s.mechanism.parameter_specifications[i]
    z[i] = Transform.of([spec]).unconstrain(np.array([level]))[0]
    return dataclasses.replace(h, locations=(*h.locations, sp.HUB), free=(*h.free, i), z=z)


def at(h, numbers: np.ndarray):
    """The hypothesis with other parameters: common ones, then local ones and first states by recording."""
    shared, R = len(h.free), len(h.x0)
    z = h.z.copy()
    z[list(h.free)] = numbers[:shared]
    rest = numbers[shared:].reshape(R, -1)
    return dataclasses.replace(h, z=z, local_z=rest[:, : len(h.local)], x0=rest[:, None, len(h.local) :])


def numbers_of(h) -> np.ndarray:
    return np.concatenate([h.z[list(h.free)], np.hstack([h.local_z, h.x0[:, 0]]).ravel()])


def cost(problem, h, whitener) -> float:
    e = problem.innovations([h])[0]
    return 0.5 * float(np.sum(whitener(e, problem.seen) ** 2))


def test_slopes_are_those_of_the_innovations(rough):
    """Derivatives by all parameters and first states of a fit, against central differences."""
    h = with_friction(rough, 0.02)
    h = rough.with_process_noise(h, {"hub": 1e-4 * rough.dataset.torque_scale**2 * 0.0025, "joint": 1e-9})
    own = np.array([[0.01, 0.002], [-0.02, 0.001]])
    h = dataclasses.replace(h, local_z=own, x0=np.full((2, 1, 4), 0.01))
    _, J = rough.slopes([h])
    assert (J[0, h.moved :] == 0).all()
    point, shared, each, step = numbers_of(h), len(h.free), h.moved - len(h.free), 1e-6
    for k in range(h.moved):
        nudge = np.zeros_like(point)
        # Local parameters and first states are changed in both recordings together.
        nudge[[k] if k < shared else [k, k + each]] = step
        e = rough.innovations([at(h, point + way * nudge) for way in (1, -1)])
        expected = (e[0] - e[1]) / (2 * step)
        # At a few samples the sign of friction changes, which makes a jump in the differences.
        close = np.abs(J[0, k] - expected) < 1e-4 * np.abs(expected).max()
        assert close.mean() > 0.98, k


def blocks(h) -> tuple[Windows, list[list[slice]]]:
    """Two recordings of 30 samples: two windows and one window."""
    index = np.zeros((2, 30), np.int32)
    index[0, 12:] = 1
    windows = Windows(index, (2, 1), np.zeros((2, 2, h.x0.shape[-1])))
    return windows, [[slice(0, 12), slice(12, 30)], [slice(0, 30)]]


def every_row(h, W: np.ndarray) -> np.ndarray:
    """Slopes along every coordinate of a fit (M, R N C), zero where a coordinate has no influence."""
    shared, local = len(h.free), len(h.local)
    rows = [W[k] for k in range(shared)]
    for r, slices in enumerate(blocks(h)[1]):
        for k, samples in [(k, slice(None)) for k in range(shared, shared + local)] + [
            (k, samples) for samples in slices for k in range(shared + local, h.moved)
        ]:
            one = np.zeros_like(W[k])
            one[r, samples] = W[k, r, samples]
            rows.append(one)
    return np.array(rows).reshape(len(rows), -1)


def test_sums_are_those_of_the_whole_matrix(plain):
    _, h = plain
    rng = np.random.default_rng(0)
    w, W = rng.normal(size=(2, 30, 2)), rng.normal(size=(h.moved, 2, 30, 2))
    coordinates, rows = FitCoordinates.of(h, blocks(h)[0]), every_row(h, W)
    H, g = coordinates.sums(w, W)
    np.testing.assert_allclose(H, rows @ rows.T, atol=1e-10)
    np.testing.assert_allclose(g, rows @ w.ravel(), atol=1e-10)


def test_the_projection_is_that_on_the_whole_matrix(plain):
    _, h = plain
    rng = np.random.default_rng(1)
    W, signals = rng.normal(size=(h.moved, 2, 30, 2)), rng.normal(size=(3, 2, 30, 2))
    found = FitCoordinates.of(h, blocks(h)[0]).orthogonal_to(W)(signals)
    rows, flat = every_row(h, W), signals.reshape(3, -1)
    left = flat - np.linalg.lstsq(rows.T, flat.T, rcond=None)[0].T @ rows
    np.testing.assert_allclose(found, left, atol=1e-9)


@pytest.mark.parametrize("intensity", [0.0, 1e-4], ids=["free run", "predictor"])
def test_the_optimum_is_that_of_scipy(rough, intensity):
    h = with_friction(rough, 0.01)
    h = rough.with_process_noise(h, dict.fromkeys(rough.ports, intensity * rough.process_noise_range[1]))
    found = levenberg_marquardt(rough, [h], max_steps=60)[0]
    s, seen = rough.supermodel, rough.seen

    def residuals(numbers):
        e = rough.innovations([at(h, numbers)])[0]
        return h.whitener(e, seen).ravel()

    def slopes(numbers):
        """Forward differences, all in one batch."""
        step = 1e-6
        nudged = [at(h, numbers + step * row) for row in np.eye(len(numbers))]
        e = rough.innovations([at(h, numbers), *nudged])
        w = h.whitener(e, seen).reshape(len(e), -1)
        return (w[1:] - w[0]).T / step

    # From another start, so that the two fits take different paths.
    start = numbers_of(found) + 0.02
    best = least_squares(residuals, start, jac=slopes, x_scale="jac", xtol=1e-10, ftol=1e-10)
    assert cost(rough, found, h.whitener) < best.cost + 0.5
    assert cost(rough, found, h.whitener) > best.cost - 0.5
    assert cost(rough, found, h.whitener) < cost(rough, h, h.whitener) - 100
    mine, theirs = found.values(s)[0], at(h, best.x).values(s)[0]
    free = list(h.free)
    np.testing.assert_allclose(mine[free], theirs[free], rtol=0.02)


def test_side_by_side_is_the_same_as_alone(rough):
    starts = [with_friction(rough, 0.005), sp.start(rough, wrong=0.1), with_friction(rough, 0.05)]
    together = levenberg_marquardt(rough, starts)
    for h, one in zip(together, starts, strict=True):
        alone = levenberg_marquardt(rough, [one])[0]
        np.testing.assert_allclose(h.log_likelihood, alone.log_likelihood, rtol=1e-9)
        np.testing.assert_allclose(h.z, alone.z, rtol=1e-6, atol=1e-9)


def test_refits_side_by_side_are_the_same_as_alone(rough):
    starts = [with_friction(rough, 0.005), sp.start(rough, wrong=0.1), with_friction(rough, 0.05)]
    for h, one in zip(refit(rough, starts), starts, strict=True):
        alone = refit(rough, [one])[0]
        assert h.log_likelihood == alone.log_likelihood
        assert h.process_noise == alone.process_noise
        np.testing.assert_array_equal(h.z, alone.z)


def test_the_truth_is_recovered(rough):
    found = refit(rough, [with_friction(rough, 0.008)])[0]
    values = found.values(rough.supermodel)
    s = rough.supermodel
    level = s.parameter_indices(sp.HUB)[0]
    bias = s.parameter_indices(EffectLocation("voltage_offset", "input"))[0]
    assert values[0, level] == pytest.approx(0.02, rel=0.05)
    # Each recording has its own offset; the parameters of the machine are common.
    np.testing.assert_allclose(values[:, bias], [0.02, -0.02], atol=0.006)
    assert np.ptp(values[:, list(found.free)], axis=0).max() == 0


def test_the_likelihood_never_falls(rough):
    starts = [with_friction(rough, 0.05), sp.start(rough, wrong=0.1)]
    e = rough.innovations(starts)
    before = [rough.evaluated(h, x).log_likelihood for h, x in zip(starts, e, strict=True)]
    one = levenberg_marquardt(rough, starts)
    for h, ll in zip(one, before, strict=True):
        assert h.log_likelihood >= ll
    for h, ll in zip(refit(rough, one, alternations=2), [h.log_likelihood for h in one], strict=True):
        assert h.log_likelihood >= ll
    # At the optimum there is nothing to gain.
    again = levenberg_marquardt(rough, levenberg_marquardt(rough, one))
    last = levenberg_marquardt(rough, again)
    for a, b in zip(again, last, strict=True):
        assert 0 <= b.log_likelihood - a.log_likelihood < 1.0


def test_no_step_raises_the_cost(rough):
    """Also from starts so far away that a full step raises the cost."""
    starts = [sp.start(rough, wrong=-0.7), sp.start(rough, wrong=5.0)]
    costs = [[cost(rough, h, h.whitener) for h in starts]]
    for steps in (1, 2, 4, 8, 12):
        now = levenberg_marquardt(rough, starts, max_steps=steps)
        costs.append([cost(rough, h, s.whitener) for h, s in zip(now, starts, strict=True)])
    assert (np.diff(costs, axis=0) <= 0).all()
    assert (np.array(costs[-1]) < 0.5 * np.array(costs[0])).all()


def test_more_freedom_is_never_less_likely(rough):
    small = levenberg_marquardt(rough, [sp.start(rough)])[0]
    i = rough.supermodel.parameter_indices(sp.HUB)[0]
    z = small.z.copy()
    z[i] = np.log(1e-3)
    large = dataclasses.replace(small, locations=(*small.locations, sp.HUB), free=(*small.free, i), z=z)
    assert refit(rough, [large])[0].log_likelihood > small.log_likelihood + 50


def test_blocks_of_free_runs_count_errors_by_their_factor_down_to_the_noise(plain):
    """An error a tenth as large gains log 10; below the sensor noise there is nothing left to gain."""
    problem, h = plain
    runs, shape = problem.of_free_runs(problem.windows), problem.dataset.data.y.shape
    block = lambda times: runs.evaluated(h, np.full(shape, times * sp.NOISE)).blocks  # noqa: E731
    np.testing.assert_allclose(block(1e2) - block(1e3), np.log(10), rtol=1e-4)
    assert np.all(np.abs(block(0.01) - block(0.1)) < 0.01)


def test_process_noise_is_nil_where_the_model_is_right_and_not_where_it_is_wrong(plain, rough):
    problem, right = plain
    least, most = problem.process_noise_range
    settled = choose_process_noise(problem, right, wide=True)
    assert settled.process_noise["hub"] < 1e-4 * most
    assert settled.log_likelihood < right.log_likelihood + 5
    wrong = levenberg_marquardt(rough, [sp.start(rough)])[0]
    moved = choose_process_noise(rough, wrong, wide=True)
    assert moved.process_noise["hub"] > 1e-3 * most
    assert moved.log_likelihood > wrong.log_likelihood + 100
    for h in (settled, moved):
        assert all(least <= q <= most for q in h.process_noise.values())
    # The gain belongs to the intensity that is reported.
    np.testing.assert_allclose(rough.gains(moved, [moved.process_noise])[0], moved.K, rtol=1e-9)


def test_one_step_is_no_longer_than_allowed(rough):
    far = sp.start(rough, wrong=5.0)
    found = levenberg_marquardt(rough, [far], max_steps=1)[0]
    free = list(far.free)
    specs = [rough.supermodel.mechanism.parameter_specifications[i] for i in free]
    bounded = np.array([bool(np.isfinite(x.lower) or np.isfinite(x.upper)) for x in specs])
    # A parameter without a bound may move by its size, if this is more than its typical size.
    most = LARGEST_STEP * np.where(bounded, 1.0, np.maximum(np.abs(far.z[free]), 1.0))
    assert np.max(np.abs(found.z[free] - far.z[free]) / most) == pytest.approx(1.0)
    assert np.abs(found.local_z - far.local_z).max() <= LARGEST_STEP * (1 + 1e-9)
    held = [i for i in range(len(far.z)) if i not in far.free]
    np.testing.assert_array_equal(found.z[held], far.z[held])


@pytest.mark.parametrize("times", [0.0, 300.0])
def test_damping_without_a_bound_is_found_from_any_value(plain, times):
    """A viscous coefficient has a typical size of 0.01; fits begin at zero and at 300 times this size."""
    problem, usual = plain
    i = problem.supermodel.mechanism.parameter_names.index("joint.viscous.coefficient")
    assert i in usual.free
    z = usual.z.copy()
    z[i] = times
    (again,) = refit(problem, [dataclasses.replace(usual, z=z)])
    assert again.log_likelihood == pytest.approx(usual.log_likelihood, abs=1.0)
    assert again.z[i] == pytest.approx(usual.z[i], rel=0.02)


def test_grid_of_intensities():
    two = _grid({"hub": 1.0, "joint": 10.0}, (0.1, 1.0))
    assert sorted((q["hub"], q["joint"]) for q in two) == [(0.1, 1), (0.1, 10), (1, 1), (1, 10)]
    three = _grid({"a": 1.0, "b": 1.0, "c": 1.0}, (0.5, 2.0))
    assert len(three) == 6 and all(sorted(q.values())[1] == 1.0 for q in three)


def test_a_start_from_which_nothing_is_finite_is_left_alone(rough):
    """Its log-likelihood becomes minus infinity, and other fits are not affected."""
    good, bad = with_friction(rough, 0.01), sp.start(rough)
    bad = dataclasses.replace(bad, x0=np.full((2, 1, 4), np.nan))
    one, other = levenberg_marquardt(rough, [good, bad])
    assert np.isfinite(one.log_likelihood)
    assert other.log_likelihood == -np.inf


@pytest.mark.parametrize(
    ("gains", "alternations", "taken"),
    [
        ([40, 0.5, 99], 3, 2),  # converged
        ([300, 200, 100, 80, 60, 5, 99], 3, 6),  # not converged after three: continues while it gains much
        ([300, 200, 3, 99], 3, 3),  # little is left after three
        ([99], 0, 0),
        ([50] * 40, 1, 1 + EXTRA_ALTERNATIONS),  # limited
    ],
)
def test_a_refit_is_not_stopped_on_its_way(monkeypatch, plain, gains, alternations, taken):
    """The number of alternations, where the gain of each is prescribed."""
    problem, h = plain
    left = iter(gains)
    start = dataclasses.replace(h, densities=np.zeros((2, 1)))
    calls = []

    def fitted(_, point):
        calls.append(1)
        h, more = point.hypothesis, next(left) if len(calls) > 1 else 0.0
        return dataclasses.replace(point, hypothesis=dataclasses.replace(h, densities=h.densities + more / 2))

    monkeypatch.setattr(refit_module, "_fitted", fitted)
    monkeypatch.setattr(refit_module, "choose_process_noise", lambda problem, start, wide: start)
    end = refit(problem, [start], alternations=alternations)[0]
    assert len(calls) - 1 == taken
    assert end.log_likelihood == sum(gains[:taken])


def test_a_refit_of_free_runs_computes_slopes_once_at_each_point(monkeypatch, rough):
    runs, points = rough.of_free_runs(rough.windows), []
    of_slopes = LikelihoodProblem.of_slopes

    def counted(problem, use, hypotheses):
        points.extend(h.z.tobytes() + h.local_z.tobytes() + h.x0.tobytes() for h in hypotheses)
        return of_slopes(problem, use, hypotheses)

    monkeypatch.setattr(LikelihoodProblem, "of_slopes", counted)
    start = runs.with_likelihood(with_friction(runs, 0.01))
    (end,) = refit(runs, [start])
    assert end.log_likelihood > start.log_likelihood
    assert len(points) > 3
    assert len(set(points)) == len(points)


@pytest.mark.parametrize("late", [Delay(time=0.0045), Delay(time=0.004), Lag(time=0.006), Lag(time=0.0007)])
def test_a_late_voltage_moves_a_mass_as_far_as_it_should(late):
    """Delay and lag keep the impulse and shift its mean by `time`, so the end of a free mass is known."""
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


def test_one_step_reaches_what_a_fit_with_finer_steps_finds():
    problem = coarse(sp.problem(sp.recordings(sp.records(0.03))), 1)
    h = levenberg_marquardt(problem, [with_friction(problem, 0.01)], max_steps=60)[0]
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
    """The second part of a run starts with the heat of the first, which reduces its error to 2 % or less."""
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
