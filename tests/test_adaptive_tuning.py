"""Tuning: derivatives against differences, descent against a grid, and the treatment of divergence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rotflex_jax.adaptive import LMS, RLS
from rotflex_jax.adaptive.learning_curve import learning_curve
from rotflex_jax.adaptive.moments import Moments, ar1_covariance
from rotflex_jax.adaptive.objectives import RangeTransform, _values_on, sample_moments, tuning_data, values_at
from rotflex_jax.adaptive.step_sizes import Margin, mean_square_bound
from rotflex_jax.adaptive.tuning import grid, loss_and_slopes, tune
from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.optimise.quasi_newton import descend
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce.plants import plant, response
from rotflex_jax.runtime.xla import double_precision

OBJECTIVES = ("final", "mean_error", "last_half")
BASIS = Volterra(Delays(5))
BOTH = RangeTransform(("mu1", "mu2"), ((0.0, np.inf), (0.0, np.inf)))


def two_steps(settings: dict) -> LMS:
    return LMS(BASIS.step_sizes({0: settings["mu1"], 1: settings["mu1"], 2: settings["mu2"]}))


def cut(u: np.ndarray, y: np.ndarray, Ts: float, parts: int, n_init: int = 10) -> list[Recording]:
    N = len(u) // parts
    return [
        Recording(u[k * N : k * N + N], y[k * N : k * N + N, None], Ts, channels=("alpha",), n_init=n_init)
        for k in range(parts)
    ]


@pytest.fixture(scope="module")
def joint() -> list[Recording]:
    """Eight recordings at 10 Hz with 4000 scored samples: a joint with friction, dead zone and offset."""
    u = noise(32_080, 0.1, bandwidth=2.0, seed=0)
    alpha = response(plant("S6"), u, 0.1, step=0.01)[:, 1]
    alpha = alpha + 1e-3 * np.random.default_rng(1).standard_normal(len(u))
    return cut(u, alpha, 0.1, 8)


@pytest.fixture(scope="module")
def short() -> list[Recording]:
    """Three recordings of 300 samples: a Volterra series of the model class with noise."""
    rng = np.random.default_rng(2)
    u = rng.standard_normal(900)
    y = BASIS.regressors(u) @ rng.standard_normal(21) + 0.5 * rng.standard_normal(900)
    return cut(u, y, 0.1, 3)


def lms_by_hand(phi: np.ndarray, y: np.ndarray, mu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    w, errors = np.zeros(phi.shape[1]), []
    for x, target in zip(phi, y, strict=True):
        errors.append(target - w @ x)
        w = w + mu * errors[-1] * x
    return w, np.array(errors)


def test_objectives_are_what_their_names_say(short: list[Recording]) -> None:
    mu = BASIS.step_sizes({0: 0.02, 1: 0.02, 2: 0.004})
    phi = [BASIS.regressors(r.u)[10:] for r in short]
    y = [r.y[10:, 0] for r in short]
    runs = [lms_by_hand(x, t, mu) for x, t in zip(phi, y, strict=True)]

    def smallest(keep: list[int]) -> float:
        X, Y = np.concatenate([phi[k] for k in keep]), np.concatenate([y[k] for k in keep])
        return float(np.mean((Y - X @ np.linalg.lstsq(X, Y, rcond=None)[0]) ** 2))

    excess = []
    for b in range(3):
        others = [k for k in range(3) if k != b]
        missed = np.mean([np.mean((y[k] - phi[k] @ runs[b][0]) ** 2) for k in others])
        excess.append(missed / smallest(others) - 1)
    errors = np.array([e for _, e in runs])
    J0 = smallest([0, 1, 2])
    expected = {
        "final": np.mean(excess),
        "mean_error": np.mean(errors**2) / J0,
        "last_half": np.mean(errors[:, 145:] ** 2) / J0,
    }
    for objective, value in expected.items():
        test = short if objective == "final" else ()
        axes = {"mu1": [0.02], "mu2": [0.004]}
        found = grid(two_steps, axes, BASIS, short, "alpha", objective=objective, test=test)
        assert found.value == pytest.approx(value, rel=1e-9)
        if test:
            assert found.test == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(("objective", "guarded"), [*((o, False) for o in OBJECTIVES), ("final", True)])
def test_derivative_is_that_of_central_differences(
    joint: list[Recording], objective: str, guarded: bool
) -> None:
    with double_precision():
        data = tuning_data(BASIS, joint[:4], "alpha", objective)
        # These step sizes violate the margin, so that the penalty is active.
        guard = Margin(sample_moments(data.phi), 200.0) if guarded else None
        options = {"curve": BOTH, "build": two_steps, "objective": objective}
        x, h = np.log([0.004, 4e-4]), 1e-5
        points = x + h * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        values, slopes = jax.device_get(loss_and_slopes(jnp.asarray(points), data, guard, **options))
    differences = (values[1::2] - values[2::2]) / (2 * h)
    np.testing.assert_allclose(slopes[0], differences, rtol=1e-4, atol=1e-6)
    assert np.min(np.abs(slopes[0])) > 1e-3


STARTS = [
    {"mu1": 1e-3, "mu2": 1e-4},
    {"mu1": 0.03, "mu2": 1e-4},
    {"mu1": 1e-3, "mu2": 3e-3},
    {"mu1": 0.03, "mu2": 2e-3},
]
GRID = {"mu1": np.geomspace(5e-4, 0.15, 15), "mu2": np.geomspace(1e-5, 6e-3, 15)}


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_gradient_is_no_worse_than_a_grid_of_225_at_a_third_of_its_cost(
    joint: list[Recording], objective: str
) -> None:
    train, test = joint[:4], joint[4:]
    tried = grid(two_steps, GRID, BASIS, train, "alpha", objective=objective, test=test)
    found = tune(two_steps, STARTS, BASIS, train, "alpha", objective=objective, test=test)
    assert tried.evaluations == 225
    assert found.evaluations <= 75  # sum over the four starts
    for path in found.paths:
        assert path.values[-1] <= tried.value
        assert path.values[-1] == pytest.approx(found.value, rel=1e-4)
        assert path.status == "minimum"
    assert found.test < 1.05 * tried.test
    assert found.stability is not None
    assert found.stability.stable
    assert tried.values.shape == (15, 15)
    assert not tried.values[-1, -1] < 1e6  # the grid contains unstable step sizes


def test_theory_predicts_what_the_tuned_filter_leaves(joint: list[Recording]) -> None:
    found = tune(two_steps, STARTS, BASIS, joint[:4], "alpha", objective="final", test=joint[4:])
    phi = np.concatenate([BASIS.regressors(r.u)[10:] for r in joint])
    y = np.concatenate([r.y[10:, 0] for r in joint])
    w = np.linalg.lstsq(phi, y, rcond=None)[0]
    J0 = float(np.mean((y - phi @ w) ** 2))
    moments = Moments.gaussian(ar1_covariance(np.exp(-2 * np.pi * 2.0 * 0.1), 5))
    curve = learning_curve(moments, np.asarray(found.filter.mu), w, np.array([4000]), noise=J0)  # type: ignore[attr-defined]
    assert found.value == pytest.approx(curve.excess[0] / J0, rel=0.4)
    assert found.test == pytest.approx(curve.excess[0] / J0, rel=0.4)


def test_objectives_ask_for_different_step_sizes(joint: list[Recording]) -> None:
    best = {
        objective: tune(two_steps, STARTS, BASIS, joint[:4], "alpha", objective=objective).settings["mu1"]
        for objective in ("final", "mean_error")
    }
    assert best["mean_error"] > 8 * best["final"]


def test_a_start_that_diverges_is_led_back(short: list[Recording]) -> None:
    starts = [{"mu1": 0.02, "mu2": 0.002}, {"mu1": 5.0, "mu2": 5.0}]
    found = tune(two_steps, starts, BASIS, short, "alpha", objective="final")
    first, second = found.paths
    assert second.values[-1] == pytest.approx(first.values[-1], rel=1e-3)
    assert second.evaluations > len(second.values)
    for path in found.paths:
        assert np.all(np.isfinite(path.values))
        assert np.all(np.diff(path.values) < 0)


def test_of_several_starts_the_best_end_counts(short: list[Recording]) -> None:
    """After one run from each start the ends are the starts, and almost no step learns almost nothing."""
    starts = [{"mu1": 1e-5, "mu2": 1e-6}, {"mu1": 0.02, "mu2": 0.002}]
    found = tune(two_steps, starts, BASIS, short, "alpha", objective="final", evaluations=1)
    assert found.settings == pytest.approx(starts[1]) and found.evaluations == 2
    assert found.paths[0].values[-1] > found.paths[1].values[-1] == found.value


def test_divergence_from_every_start_is_told(short: list[Recording]) -> None:
    with pytest.raises(InputError, match="diverges from every one of 1 starts"):
        tune(two_steps, {"mu1": 5.0, "mu2": 5.0}, BASIS, short, "alpha", objective="final", evaluations=5)
    with pytest.raises(InputError, match="diverges at every point"):
        grid(two_steps, {"mu1": [5.0], "mu2": [5.0]}, BASIS, short, "alpha", objective="final")


def test_a_margin_is_kept(short: list[Recording]) -> None:
    free = tune(two_steps, STARTS[0], BASIS, short, "alpha", objective="mean_error")
    assert free.stability is not None
    least = 3 * free.stability.factor
    kept = tune(two_steps, STARTS[0], BASIS, short, "alpha", objective="mean_error", margin=least)
    assert kept.stability is not None
    # The margin is a penalty and no constraint, so that it is not reached completely.
    assert kept.stability.factor > 0.6 * least
    assert kept.stability.factor > 1.5 * free.stability.factor
    assert kept.value > free.value
    # The value is the objective without the penalty.
    by_degree = dict(enumerate(kept.settings[name] for name in ("mu1", "mu1", "mu2")))
    phi, y = ([x(r)[10:] for r in short] for x in (lambda r: BASIS.regressors(r.u), lambda r: r.y[:, 0]))
    runs = [lms_by_hand(x, t, BASIS.step_sizes(by_degree))[1] for x, t in zip(phi, y, strict=True)]
    least = np.linalg.lstsq(np.concatenate(phi), np.concatenate(y), rcond=None)[1][0]
    assert kept.value == pytest.approx(np.sum(np.square(runs)) / least, rel=1e-6)


@pytest.mark.parametrize("a", [0.0, 0.8])
def test_margin_is_the_bound(a: float) -> None:
    for moments in (
        Moments.gaussian(ar1_covariance(a, 3)),
        Moments.of_regressors(Volterra(Delays(3)).regressors(noise(3000, 0.1, bandwidth=1.0, seed=3))),
    ):
        mu = np.random.default_rng(4).uniform(0.001, 0.01, 10)
        with double_precision():
            found = float(Margin(moments).log_factor(jnp.asarray(mu)))
        assert found == pytest.approx(np.log(mean_square_bound(moments, mu)), abs=1e-6)


def test_forgetting_follows_a_drifting_plant() -> None:
    rng = np.random.default_rng(5)
    u = rng.standard_normal(2000)
    drift = np.cumsum(0.05 * rng.standard_normal((2000, 2)), axis=0)
    basis = Volterra(Delays(2), order=1, constant=False)
    y = np.sum(basis.regressors(u) * drift, axis=1) + 0.3 * rng.standard_normal(2000)
    records = cut(u, y, 0.1, 2)

    def forgetting(settings: dict) -> RLS:
        return RLS(lam=settings["lam"])

    options = {"ranges": {"lam": (0.5, 1.0)}}
    found = tune(forgetting, {"lam": 0.99}, basis, records, "alpha", objective="last_half", **options)
    tried = grid(
        forgetting, {"lam": np.linspace(0.6, 0.999, 60)}, basis, records, "alpha", objective="last_half"
    )
    assert found.value <= tried.value
    assert 0.6 < found.settings["lam"] < 0.98
    assert found.stability is None
    assert "no theory" in str(found)


def test_a_pole_is_found_through_the_filter() -> None:
    rng = np.random.default_rng(6)
    u = rng.standard_normal(2400)
    y = Orthonormal.laguerre(0.8, 1).outputs(u)[:, 0] + 0.05 * rng.standard_normal(2400)
    bank = Orthonormal.laguerre(0.4, 1)

    def build(settings: dict) -> tuple[RLS, Volterra]:
        return RLS(), Volterra(bank.with_parameters(settings["pole"][None]), order=1, constant=False)

    basis = Volterra(bank, order=1, constant=False)
    found = tune(
        lambda s: build({"pole": jnp.asarray(s["pole"])}),
        {"pole": 0.4},
        basis,
        cut(u, y, 0.1, 3),
        "alpha",
        objective="final",
        ranges={"pole": (-1.0, 1.0)},
    )
    assert found.settings["pole"] == pytest.approx(0.8, abs=0.01)
    assert found.basis.bank.poles[0].real == pytest.approx(found.settings["pole"])  # type: ignore[attr-defined]
    # What remains of the variance is the noise.
    assert found.value == pytest.approx(0.05**2 / np.var(y), rel=0.15)


def test_other_values_compile_nothing_again(short: list[Recording]) -> None:
    traces = []

    def build(settings: dict) -> LMS:
        if any(isinstance(value, jax.core.Tracer) for value in settings.values()):
            traces.append(1)
        return two_steps(settings)

    for mu1 in (0.01, 0.02):
        tune(build, {"mu1": mu1, "mu2": 1e-3}, BASIS, short, "alpha", objective="mean_error")
        grid(build, {"mu1": [mu1, 0.03], "mu2": [1e-3]}, BASIS, short, "alpha", objective="mean_error")
        if mu1 == 0.01:
            first = len(traces)
    assert len(traces) == first > 0
    with double_precision():
        data = tuning_data(BASIS, short, "alpha", "final")
        compiled = _values_on.programs_made
        for mu in (0.01, 0.02):
            values_at(jnp.array([[mu, mu]]), data, names=("mu1", "mu2"), build=build, objective="final")
        assert _values_on.programs_made == compiled + 1


def test_a_function_that_makes_the_filter_may_hold_traced_values(joint) -> None:
    """With mu = s a, the derivative by a at a = 1 is mu times the derivative by mu."""
    short = [r.slice(0, 300) for r in joint[:2]]
    with double_precision():
        data = tuning_data(BASIS, short, "alpha", "mean_error")

        def error(a: jax.Array, point: float) -> jax.Array:
            build = lambda s: LMS(s["mu"] * a)  # noqa: E731
            at = jnp.array([[point]])
            return values_at(at, data, names=("mu",), build=build, objective="mean_error")[0]

        slope, h = float(jax.grad(error)(jnp.asarray(1.0), 0.01)), 1e-5
        difference = float(error(jnp.asarray(1.0), 0.01 + h) - error(jnp.asarray(1.0), 0.01 - h)) / (2 * h)
    assert slope == pytest.approx(0.01 * difference, rel=1e-4) and abs(slope) > 1e-4


def test_a_refused_step_is_cut_to_the_minimum_of_the_parabola() -> None:
    """From 0.5 a step of one along a steep parabola gains nothing, and its half is the minimum."""
    points = []

    def parabola(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points.append(float(p[0, 0]))
        return 50 * p[:, 0] ** 2, 100 * p

    (found,) = descend(parabola, np.array([[0.5]]), 20)
    assert found.status == "minimum" and points == [0.5, -0.5, 0.0]


def test_descent_survives_points_without_a_value() -> None:
    def banana(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rosenbrock's function plus an exponential, as steep as the error of a diverging filter."""
        x, y = points.T
        wall = np.exp(np.minimum(60 * (x - 1.15), 300))
        value = (1 - x) ** 2 + 100 * (y - x**2) ** 2 + wall
        slope = np.stack([-2 * (1 - x) - 400 * x * (y - x**2) + 60 * wall, 200 * (y - x**2)], axis=1)
        value[x > 1.3], slope[x > 1.3] = np.nan, np.inf
        return value, slope

    found = descend(banana, np.array([[-1.2, 1.0], [0.5, 2.0], [1.5, 1.5]]), 200)
    for place in found:
        np.testing.assert_allclose(place.points[-1], 1.0, atol=0.02)  # the exponential shifts it by 0.004
        assert place.status == "minimum"
        steps = np.abs(np.diff(place.points, axis=0))
        assert np.max(steps) <= 1.0 + 1e-12
    calls = []
    (lost,) = descend(lambda p: (calls.append(p), (np.full(1, np.nan), p))[1], np.ones((1, 1)), 30)
    assert lost.status == "no finite value" and len(calls) == 1


def test_the_summary_names_the_objective_and_what_was_found(short: list[Recording]) -> None:
    text = str(tune(two_steps, STARTS[:2], BASIS, short, "alpha", objective="last_half", test=short))
    for part in ('tuned for "last_half"', "2 starts", "mu1 = ", "kept for the test", "mean-square bound"):
        assert part in text


@pytest.mark.parametrize(
    ("change", "phrase"),
    [
        ({"objective": "mse"}, "one of final, mean_error, last_half"),
        ({"recordings": 1}, "needs 2 recordings"),
        ({"start": {}}, "name the same settings"),
        ({"start": [{"mu1": 1.0, "mu2": 1.0}, {"mu1": 1.0}]}, "name the same settings"),
        ({"start": {"mu1": -1.0, "mu2": 1.0}}, "`mu1` must start between 0 and inf"),
        ({"ranges": {"mu2": (1.0, 0.0)}}, "range of `mu2` must rise"),
        ({"ranges": {"mu": (0.0, 1.0)}}, "`ranges` names 'mu', but the settings are mu1, mu2;"),
        ({"evaluations": 0}, "`evaluations`"),
        ({"margin": -1.0}, "A margin is a positive factor"),
    ],
)
def test_what_cannot_be_tuned_is_refused(short: list[Recording], change: dict, phrase: str) -> None:
    options = {"start": STARTS[0], "objective": "final", "recordings": 3} | change
    start, records = options.pop("start"), short[: options.pop("recordings")]
    with pytest.raises(InputError, match=phrase):
        tune(two_steps, start, BASIS, records, "alpha", **options)


def test_test_recordings_are_checked_before_anything_is_tuned(short: list[Recording]) -> None:
    calls = []

    def counted(settings: dict) -> LMS:
        calls.append(settings)
        return two_steps(settings)

    given = {"basis": BASIS, "recordings": short[:2], "channel": "alpha", "objective": "final"}
    for search, settings in ((grid, {"mu1": [0.01], "mu2": [0.01]}), (tune, {"mu1": 0.01, "mu2": 0.01})):
        with pytest.raises(InputError, match='"final" needs 2 recordings or more in `test`, but 1 was given'):
            search(counted, settings, **given, test=short[2:])
    assert not calls


def test_one_recording_needs_no_list(short: list[Recording]) -> None:
    given = {"basis": BASIS, "channel": "alpha", "objective": "last_half"}
    alone = grid(two_steps, {"mu1": [0.01], "mu2": [0.01]}, recordings=short[0], test=short[1], **given)
    in_lists = grid(two_steps, {"mu1": [0.01], "mu2": [0.01]}, recordings=short[:1], test=short[1:2], **given)
    assert (alone.value, alone.test) == (in_lists.value, in_lists.test)


def test_recordings_of_different_length_are_refused(short: list[Recording]) -> None:
    with pytest.raises(InputError, match="one length"):
        tune(two_steps, STARTS[0], BASIS, [short[0], short[1].slice(0, 200)], "alpha", objective="final")
