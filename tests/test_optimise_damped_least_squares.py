"""Damped least squares against scipy and closed forms, and where residuals are not finite."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from rotflex_jax.optimise.damped_least_squares import (
    NormalEquations,
    Rules,
    Status,
    bounded_solution,
    damped,
    minimise,
    minimise_compiled,
    minimise_together,
)
from rotflex_jax.runtime.xla import double_precision

RULES = Rules(enough=1e-14)


def rosenbrock(x):
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def decay(x):
    """A sum of two exponentials at 20 times, less data that no parameters reproduce exactly."""
    t = jnp.linspace(0.0, 3.0, 20)
    data = 2.0 * jnp.exp(-0.7 * t) + 0.5 * jnp.exp(-3.0 * t) + 0.05 * jnp.cos(9.0 * t)
    return x[0] * jnp.exp(-jnp.exp(x[1]) * t) + x[2] * jnp.exp(-jnp.exp(x[3]) * t) - data


def equations(residuals: Callable) -> Callable:
    return lambda x: NormalEquations.of(jax.jacfwd(residuals)(x), residuals(x))


def plain(residuals: Callable) -> Callable:
    """The compiled normal equations as numpy arrays."""
    made = jax.jit(equations(residuals))
    return lambda x: jax.device_get(made(jnp.asarray(x)))


CASES = {
    "rosenbrock": (rosenbrock, np.array([-1.2, 1.0])),
    "rosenbrock, far": (rosenbrock, np.array([40.0, -30.0])),
    "decay": (decay, np.array([1.0, 0.0, 1.0, 2.0])),
}


@pytest.mark.parametrize("case", CASES)
def test_the_minimum_is_that_of_scipy(case: str) -> None:
    residuals, start = CASES[case]
    with double_precision():
        reference = least_squares(
            lambda x: np.asarray(residuals(jnp.asarray(x))), start, xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        found = minimise(plain(residuals), start, RULES, max_steps=300)
        run = jax.jit(lambda x: minimise_compiled(equations(residuals), x, RULES, max_steps=300))
        x, _, progress = run(jnp.asarray(start))
    assert found.status == Status.CONVERGED
    assert found.cost == pytest.approx(reference.cost, rel=1e-8, abs=1e-12)
    np.testing.assert_allclose(found.x, reference.x, rtol=1e-5, atol=1e-5)
    # The compiled loop counts the evaluation at the start too, and takes the same steps.
    assert int(progress.evaluations) == found.evaluations + 1
    assert int(progress.status) == Status.CONVERGED
    np.testing.assert_allclose(x, found.x, rtol=1e-6, atol=1e-6)


def test_limits_shorten_steps_and_leave_the_minimum() -> None:
    limit = np.array([0.1, np.inf])
    points: list[np.ndarray] = []
    with double_precision():
        evaluate = plain(rosenbrock)

        def seen(x: np.ndarray) -> NormalEquations:
            points.append(x)
            return evaluate(x)

        found = minimise(seen, np.array([-1.2, 1.0]), RULES, limit=limit, max_steps=300)
        run = jax.jit(
            lambda x: minimise_compiled(equations(rosenbrock), x, RULES, limit=limit, max_steps=300)
        )
        x, _, _ = run(jnp.array([-1.2, 1.0]))
    np.testing.assert_allclose(found.x, [1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(x, [1.0, 1.0], atol=1e-6)
    first = np.array([p[0] for p in points])
    assert np.abs(first[1] - first[0]) == pytest.approx(0.1)
    assert len(points) > 20  # a distance of 2.2 in steps of at most 0.1


def test_a_bounded_step_is_that_of_scipy_within_a_box() -> None:
    rng = np.random.default_rng(0)
    A, b, limit = rng.normal(size=(30, 4)), rng.normal(size=30), np.array([0.05, np.inf, 0.1, np.inf])
    reference = lsq_linear(A, b, (-limit, limit), tol=1e-14).x
    x, limited = bounded_solution(A.T @ A, A.T @ b, limit)
    np.testing.assert_allclose(x, reference, atol=1e-8)
    assert bool(limited) and np.abs(x[0]) == pytest.approx(0.05)
    free, limited = bounded_solution(A.T @ A, A.T @ b, np.full(4, 10.0))
    np.testing.assert_allclose(free, np.linalg.lstsq(A, b)[0], atol=1e-10)
    assert not limited


def test_a_linear_problem_takes_the_steps_of_the_closed_form() -> None:
    rng = np.random.default_rng(1)
    A, b = rng.normal(size=(12, 3)) * [1.0, 1e3, 1e-2], rng.normal(size=12)
    made = NormalEquations.of(A, -b)
    step, _ = made.step(0.3)
    D = np.diag(np.sum(A**2, axis=0))
    np.testing.assert_allclose(step, np.linalg.solve(A.T @ A + 0.3 * D, A.T @ b), rtol=1e-9)
    assert made.predicted_decrease(step) == pytest.approx((b @ b - np.sum((A @ step - b) ** 2)) / 2)
    found = minimise(lambda x: NormalEquations.of(A, A @ x - b), np.zeros(3), RULES)
    best = np.linalg.lstsq(A, b)[0]
    np.testing.assert_allclose(found.x, best, rtol=1e-5)
    assert found.first.cost == pytest.approx(b @ b / 2)
    assert found.equations.cost == found.cost == pytest.approx(np.sum((A @ best - b) ** 2) / 2)


def test_several_dampings_of_one_matrix_at_once() -> None:
    H = np.array([[2.0, 0.5], [0.5, 8.0]])
    dampings = np.array([0.0, 1.0, 10.0])
    together = damped(H, dampings)
    for A, d in zip(together, dampings, strict=True):
        np.testing.assert_allclose(A, H + d * np.diag([2.0, 8.0]), rtol=1e-12)
    steps, _ = NormalEquations(np.zeros(1), np.array([1.0, -1.0]), H).step(dampings)
    np.testing.assert_allclose(steps[1], np.linalg.solve(together[1], [-1.0, 1.0]))


def test_a_direction_that_the_residuals_do_not_determine_stays() -> None:
    """The residuals depend only on the sum of the first two parameters: this is fitted, the rest stays."""
    A = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.5, 0.5, 0.0]])
    b = A @ [1.0, 2.0, 0.0] + [0.1, 0.0, -0.1]
    found = minimise(lambda x: NormalEquations.of(A, A @ x - b), np.array([0.5, 0.0, 7.0]), RULES)
    assert found.status == Status.CONVERGED
    best = np.linalg.lstsq(A[:, :1], b)[0][0]
    assert found.x[0] + found.x[1] == pytest.approx(best, rel=1e-6)
    assert found.x[0] - found.x[1] == pytest.approx(0.5, abs=1e-3)
    assert found.x[2] == pytest.approx(7.0, abs=1e-3)


def test_points_without_a_value_shorten_the_step() -> None:
    """`log x - 1` has no value below zero, where the first full step ends."""

    def made(x: np.ndarray) -> NormalEquations:
        with np.errstate(invalid="ignore"):
            return NormalEquations.of(1 / x[None], np.log(x) - 1.0)

    tried: list[float] = []

    def counted(x: np.ndarray) -> NormalEquations:
        tried.append(float(x[0]))
        return made(x)

    found = minimise(counted, np.array([30.0]), RULES, max_steps=200)
    assert min(tried) < 0
    assert found.status == Status.CONVERGED
    assert found.x[0] == pytest.approx(np.e, rel=1e-6)
    with double_precision():
        run = jax.jit(
            lambda x: minimise_compiled(equations(lambda x: jnp.log(x) - 1.0), x, RULES, max_steps=200)
        )
        assert run(jnp.array([30.0]))[0][0] == pytest.approx(np.e, rel=1e-6)
        assert int(run(jnp.array([-1.0]))[2].status) == Status.DIVERGED
    with np.errstate(invalid="ignore"):
        lost = minimise(made, np.array([-1.0]), RULES)
    assert lost.status == Status.DIVERGED and lost.evaluations == 0


def test_slopes_without_a_value_end_it() -> None:
    """The square root has a value at zero, but no finite derivative."""

    def made(x: np.ndarray) -> NormalEquations:
        return NormalEquations(np.array([np.sqrt(x[0])]), np.array([np.inf]), np.array([[np.inf]]))

    found = minimise(made, np.zeros(1), RULES)
    assert found.status == Status.UNSOLVED and found.x[0] == 0.0


def test_where_the_evaluations_are_used_up_it_still_runs() -> None:
    with double_precision():
        found = minimise(plain(rosenbrock), np.array([-1.2, 1.0]), RULES, max_steps=3)
    assert found.status == Status.RUNNING and found.evaluations == 3


def test_no_progress_over_a_window_ends_it() -> None:
    """In the curved valley steps gain little, so the gain over a window falls below the least progress."""
    with double_precision():
        slow = minimise(plain(rosenbrock), np.array([-1.2, 1.0]), Rules(window=4, least_progress=1.0))
    assert slow.status == Status.CONVERGED
    assert slow.evaluations % 4 == 0
    assert slow.cost > 1e-3


def test_several_problems_end_as_each_alone_and_share_their_runs() -> None:
    starts = [np.array([-1.2, 1.0]), np.array([2.0, 2.0]), np.array([1.0, 1.0]), np.array([np.nan, 0.0])]
    rounds: list[int] = []
    with double_precision():
        made = plain(rosenbrock)

        def costs(points: list[np.ndarray]) -> list[float]:
            rounds.append(len(points))
            return [float(made(x).cost) for x in points]

        alone = [minimise(made, start, RULES, max_steps=100) for start in starts]
        together = minimise_together(
            lambda points: [made(x) for x in points], starts, RULES, costs=costs, max_steps=100
        )
        batch = jax.jit(jax.vmap(lambda x: minimise_compiled(equations(rosenbrock), x, RULES, max_steps=100)))
        x, _, progress = batch(jnp.array(starts))
    for one, found in zip(alone, together, strict=True):
        np.testing.assert_array_equal(found.x, one.x)
        assert (found.status, found.evaluations) == (one.status, one.evaluations)
    assert len(rounds) == max(one.evaluations for one in alone)
    assert rounds[0] == 2 and rounds[-1] == 1
    np.testing.assert_allclose(x[:3], 1.0, atol=1e-6)
    expected = [Status.CONVERGED] * 3 + [Status.DIVERGED]
    assert progress.status.tolist() == [one.status for one in alone] == expected


@pytest.mark.parametrize("case", ["rosenbrock", "rosenbrock, far"])
def test_after_a_refused_step_costs_are_evaluated_alone(case: str) -> None:
    """The points are those of a minimisation without it; no equations of a second refused step are made."""
    residuals, start = CASES[case]
    with double_precision():
        made = plain(residuals)
        whole, linearised, alone = (list[np.ndarray]() for _ in range(3))
        usual = minimise(lambda x: (whole.append(x), made(x))[1], start, RULES, max_steps=300)
        found = minimise(
            lambda x: (linearised.append(x), made(x))[1],
            start,
            RULES,
            cost=lambda x: (alone.append(x), float(made(x).cost))[1],
            costs_after=1,
            max_steps=300,
        )
        costs = [float(made(x).cost) for x in whole]
    np.testing.assert_array_equal(found.x, usual.x)
    assert (found.cost, found.status, found.evaluations) == (usual.cost, usual.status, usual.evaluations)
    refused, expected = False, list[np.ndarray]()
    for k in range(1, len(costs)):
        if refused:
            expected.append(whole[k])
        refused = not costs[k] < min(costs[:k])
    assert expected
    np.testing.assert_array_equal(alone, expected)
    assert len(linearised) < len(whole)


def test_steps_may_act_on_anything() -> None:
    """The step changes the logarithm of a positive number, and the point is the number itself."""
    found = minimise(
        lambda p: NormalEquations.of(np.array([[p * p]]), np.array([p**2 / 2 - 8.0])),
        100.0,
        RULES,
        limit=np.array([0.5]),
        move=lambda p, s: p * float(np.exp(s[0])),
    )
    assert found.x == pytest.approx(4.0, rel=1e-6)
