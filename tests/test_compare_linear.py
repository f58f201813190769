"""Linear models and Volterra series from data, compared with systems simulated by scipy and numpy."""

import dataclasses
from typing import Any, cast

import numpy as np
import pytest
import scipy.signal

import rotflex_jax as rf
from rotflex_jax.basis import Volterra
from rotflex_jax.basis.bank import Averages
from rotflex_jax.compare import ARX, AdaptiveSeries, BatchSeries, LinearStateSpace, Subspace
from rotflex_jax.compare.linear_models import refined, subspace
from rotflex_jax.compare.method import require_one_sampling_period
from rotflex_jax.compare.series import bank_outputs, monomials
from rotflex_jax.models.linear_system import LinearSystem
from rotflex_jax.recording import Recording

Ts = 0.01
POLES = np.array([0.97 * np.exp(0.25j), 0.97 * np.exp(-0.25j), 0.9])


def quiet(text: str) -> None:
    del text


def driven(seconds: float = 20.0, noise: float = 0.01, seed: int = 0, integrates: bool = False) -> Recording:
    """A recording of two filters of scipy, a resonance with a lag and a lag alone, with sensor noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=round(seconds / Ts / 8)), 8)
    first = scipy.signal.lfilter([0.0, 0.01, 0.02], np.poly(POLES[:2]).real, u)
    first = scipy.signal.lfilter([0.1], [1.0, -0.9], first)
    last = scipy.signal.lfilter([0.0, 0.1], [1.0, -0.9], u)
    if integrates:
        first = Ts * np.cumsum(first)
    y = np.column_stack([first, last]) + noise * rng.normal(size=(len(u), 2)) * [first.std(), last.std()]
    return Recording(u=u, y=y, Ts=Ts, n_init=40)


def driven_by_two(seconds: float = 20.0, noise: float = 0.01) -> Recording:
    """The system of `driven` on a moving base, which acts on each output by a filter with the same poles."""
    record, rng = driven(seconds, noise=0.0), np.random.default_rng(1)
    base = scipy.signal.lfilter([0.2], [1.0, -0.8], rng.normal(size=record.N))
    first = scipy.signal.lfilter([0.0, 0.03, -0.02], np.poly(POLES[:2]).real, base)
    y = record.y + np.column_stack([first, scipy.signal.lfilter([0.0, -0.2], [1.0, -0.9], base)])
    y += noise * rng.normal(size=y.shape) * y.std(axis=0)
    return dataclasses.replace(record, y=y).with_signals({"base [m/s^2]": base})


def response(system: LinearSystem, frequencies: np.ndarray, column: int) -> np.ndarray:
    """Frequency response from one input to all outputs, computed from the state-space matrices."""
    z, one = np.exp(1j * frequencies), np.eye(system.order)
    B, D = system.B[:, column], system.D[:, column]
    return np.array([system.C @ np.linalg.solve(x * one - system.A, B) + D for x in z])


@pytest.mark.parametrize("way", ["subspace", "fitted to free runs"])
def test_a_signal_is_a_second_input(way: str) -> None:
    record = driven_by_two(noise=1e-6)
    system = subspace([record], 20, (4,))[4]  # with two inputs the lag needs two states
    if way != "subspace":
        system = refined(system, [record])
    assert system.signals == ("base [m/s^2]",)
    frequencies = np.linspace(0.01, 2.0, 20)
    z, resonance = np.exp(-1j * frequencies), np.poly(POLES[:2]).real
    lag, swinging = 1 - 0.9 * z, np.polyval(resonance[::-1], z)
    from_input = np.column_stack([(0.01 * z + 0.02 * z**2) * 0.1 / (swinging * lag), 0.1 * z / lag])
    from_base = np.column_stack([(0.03 * z - 0.02 * z**2) / swinging, -0.2 * z / lag])
    for column, expected in enumerate((from_input, from_base)):
        found = response(system, frequencies, column)
        np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_a_linear_system_takes_one_initial_sample_and_a_recording_in_a_list() -> None:
    system = LinearSystem(
        A=np.array([[0.5]]),
        B=np.array([[1.0, 0.0]]),
        C=np.array([[1.0]]),
        D=np.zeros((1, 2)),
        K=np.zeros((1, 1)),
        Ts=0.1,
    )
    record = Recording(
        u=np.ones(6), y=2 - 0.5 ** np.arange(-1.0, 5.0), Ts=0.1, accept=("short", "constant_input")
    )
    for run in (system.simulate([record]), system.predict([record])):
        assert record.n_init == 1
        np.testing.assert_allclose(run, record.y, atol=1e-12)  # x+ = 0.5 x + 1 from x = 0
    with pytest.raises(rf.InputError, match="`recording` must be a Recording or a list of them, but is None"):
        system.simulate(cast(Any, None))


def test_a_linear_system_has_a_constant_of_state_and_output() -> None:
    """x+ = 0.8 x + 0.5 u + 0.1 and y = 2 x + 0.3 from x = 3 at rest of the input, in closed form."""
    A, B, C, D = (np.array(x) for x in ([[0.8]], [[0.5, 0.1]], [[2.0]], [[0.0, 0.3]]))
    system = LinearSystem(A=A, B=B, C=C, D=D, K=np.zeros((1, 1)), Ts=Ts)
    y = 2 * (0.5 + 2.5 * 0.8 ** np.arange(60.0)) + 0.3
    record = Recording(u=np.zeros(60), y=y[:, None], Ts=Ts, n_init=10, accept=("units", "constant_input"))
    np.testing.assert_allclose(system.simulate(record)[:, 0], y, rtol=1e-9)


def test_a_linear_system_says_which_signal_a_recording_lacks() -> None:
    system = subspace([driven_by_two()], 20, (4,))[4]
    with pytest.raises(rf.InputError, match=r"signal 'base \[m/s\^2\]' is needed.* has 'wind \[m/s\]';"):
        system.simulate(driven().with_signals({"wind [m/s]": driven().u}))


def test_sampling_periods_may_differ_by_rounding_alone() -> None:
    record = driven()
    system = subspace([record], 20, (4,))[4]
    near, other = (dataclasses.replace(record, Ts=Ts * factor) for factor in (1 + 1e-12, 1 + 1e-5))
    np.testing.assert_array_equal(system.simulate(near), system.simulate(record))
    require_one_sampling_period([record, near], "a sampled system")
    with pytest.raises(rf.InputError, match="different sampling periods, but a sampled system has one"):
        require_one_sampling_period([record, other], "a sampled system")
    with pytest.raises(rf.InputError, match=r"system holds for a sampling period of 0\.01 s, but .* of that"):
        system.simulate(other)


def test_linear_methods_compare_with_the_signals_that_recordings_have() -> None:
    record, methods = driven_by_two(), [Subspace(), LinearStateSpace()]
    with_it, without = rf.compare(record, methods), rf.compare(record.with_signals({}), methods)
    for name in ("subspace", "state_space"):
        for channel, y in zip(record.channels, record.y.T, strict=True):
            assert with_it[name].rmse[channel] < 0.03 * y.std()
            assert without[name].rmse[channel] > 0.2 * y.std()


def test_parameters_of_a_linear_model_with_a_signal_are_counted_once() -> None:
    """Models of order 4 with two inputs and two outputs; formulas for the counts stand at the assertions."""
    record, model = driven_by_two(), rf.Model(rf.joints.paper())
    of_subspace = Subspace(orders=(4,)).fit(model, [record], quiet)
    assert of_subspace.parameters == 4 * (2 + 2) + 2 * 2 + 2  # n (C + m) + C m + C, in any coordinates
    of_poles = LinearStateSpace(orders=(4,)).fit(model, [record], quiet)
    assert of_poles.parameters == 4 * (2 * 2 + 1) + 2 * 2 + 2  # n (C m + 1) + C m + C: poles and residues


def test_the_subspace_method_finds_the_poles_that_scipy_simulated() -> None:
    system = subspace([driven(noise=1e-6)], 20, (3,))[3]
    for pole in POLES:
        assert np.min(np.abs(system.poles - pole)) < 1e-4
    frequencies = np.linspace(0.01, 2.0, 20)
    z = np.exp(1j * frequencies)
    mine = [system.C @ np.linalg.solve(x * np.eye(3) - system.A, system.B[:, 0]) + system.D[:, 0] for x in z]
    _, reference = scipy.signal.freqz([0.0, 0.1], [1.0, -0.9], frequencies)
    np.testing.assert_allclose(np.array(mine)[:, 1], reference, atol=1e-3 * np.abs(reference).max())


def test_a_free_run_fit_is_better_than_the_subspace_estimate_in_noise() -> None:
    record = driven(noise=0.2)
    begun = subspace([record], 10, (3,))[3]
    fitted = refined(begun, [record])
    true = driven(noise=0.0)
    error = lambda s: np.sqrt(np.mean((s.simulate(true) - true.y)[40:] ** 2, axis=0)) / true.y.std(axis=0)  # noqa: E731
    assert np.all(error(fitted) < 0.03)
    assert np.all(error(fitted) < error(begun) + 1e-3)
    for pole in POLES[::2]:
        assert np.min(np.abs(fitted.poles - pole)) < 0.01


@pytest.mark.parametrize("method", [Subspace(), LinearStateSpace(orders=(2, 3, 4))])
def test_a_linear_plant_with_an_integrator_is_followed_to_the_noise(method: object) -> None:
    train, test = driven(noise=0.002, integrates=True), driven(8.0, noise=0.0, seed=3, integrates=True)
    fitted = method.fit(None, [train], quiet)  # type: ignore[attr-defined]
    e = (fitted.simulator.simulate(test) - test.y)[40:]
    assert np.all(np.sqrt(np.mean(e**2, axis=0)) < 0.05 * test.y.std(axis=0))
    assert any(abs(p - 1) < 0.01 for p in fitted.simulator.poles)
    ahead = fitted.predict(train)[40:] - train.y[40:]
    assert np.all(np.sqrt(np.mean(ahead**2, axis=0)) < 0.02 * train.y.std(axis=0))


@pytest.mark.parametrize("method", [Subspace(), LinearStateSpace(orders=(3,)), ARX(orders=(4,))])
def test_one_step_ahead_sees_only_what_came_before(method: object) -> None:
    record = driven(6.0)
    fitted = method.fit(None, [record], quiet)  # type: ignore[attr-defined]
    k = 300
    y = record.y.copy()
    y[k:] += 1.0
    changed = dataclasses.replace(record, y=y)
    before, after = fitted.predict(record), fitted.predict(changed)
    np.testing.assert_array_equal(before[: k + 1], after[: k + 1])
    assert not np.allclose(before[k + 1], after[k + 1])


def test_wide_taps_are_means_of_the_delays() -> None:
    u = np.random.default_rng(0).normal(size=50)
    z = Averages(3, 4, first=2).outputs(u)
    padded = np.concatenate([np.zeros(20), u])
    for t, i in ((0, 0), (10, 1), (49, 2)):
        last = 20 + t - 2 - 4 * i
        assert z[t, i] == pytest.approx(padded[last - 3 : last + 1].mean())
    assert Averages(3, 4, first=2).reach == 14


def test_products_are_those_of_the_basis() -> None:
    basis = Volterra(Averages(3, 2), 3)
    u = np.random.default_rng(0).normal(size=80)
    np.testing.assert_allclose(monomials(basis, bank_outputs(basis.bank, u)), basis.regressors(u), atol=1e-12)


def volterra_plant(seed: int, integrates: bool = False, N: int = 3000, noise: float = 0.01) -> Recording:
    """A recording of a Volterra series of order 2 in means over four samples, computed by numpy alone."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=N // 2), 2)
    past = np.concatenate([np.zeros(20), u])
    tap = [np.array([past[20 + t - 4 - 4 * i : 20 + t - 4 * i].mean() for t in range(N)]) for i in range(3)]
    y = 0.2 + tap[0] - 0.5 * tap[1] + 0.25 * tap[2] + 0.4 * tap[0] * tap[1] - 0.3 * tap[2] ** 2
    if integrates:
        y = Ts * np.cumsum(y)
    return Recording(u=u, y=y + noise * y.std() * rng.normal(size=N), Ts=Ts, channels="speed", n_init=50)


@pytest.mark.parametrize("integrates", [False, True])
def test_a_volterra_plant_is_found_with_its_memory(integrates: bool) -> None:
    train, test = volterra_plant(1, integrates), volterra_plant(2, integrates, noise=0.0)
    fitted = BatchSeries("v", "v", count=3).fit(None, [train], quiet)  # type: ignore[arg-type]
    (channel,) = fitted.simulator.channels  # type: ignore[attr-defined]
    assert channel.integrates is integrates
    # Widths are chosen from a coarse grid; the error is small only if it is the width of the plant, 4.
    part = test.slice(1000, 3000)
    e = (fitted.simulator.simulate(part) - part.y)[part.n_init :]
    assert np.sqrt(np.mean(e**2)) < (0.5 if channel.basis.bank.width != 4 else 0.05) * part.y.std()


def test_weights_and_past_of_a_series_are_those_of_the_plant() -> None:
    from rotflex_jax.compare.series import select_series

    train, test = volterra_plant(1), volterra_plant(2, noise=0.0)
    series = select_series([Volterra(Averages(3, 4))], [train], 0, 0.7).series
    truth = dict.fromkeys(series.basis.names, 0.0)
    names = list(series.basis.names)
    for name, w in zip(
        (names[0], names[1], names[2], names[3], names[5], names[9]),
        (0.2, 1, -0.5, 0.25, 0.4, -0.3),
        strict=True,
    ):
        truth[name] = w
    np.testing.assert_allclose(series.weights, list(truth.values()), atol=0.02)
    # The part begins during a motion, so the input before it is estimated from its first samples.
    part = test.slice(1000, 1400)
    run = series.simulate(part.u, part.y[: part.n_init, 0])
    assert np.sqrt(np.mean((run - part.y[:, 0]) ** 2)) < 0.02 * part.y.std()


@pytest.mark.parametrize("rule", ["lms", "nlms", "rls", "kalman"])
def test_every_filter_learns_the_plant(rule: str) -> None:
    train, test = volterra_plant(1, N=2400), volterra_plant(2, N=1000, noise=0.0)
    method = AdaptiveSeries("a", "a", rule, count=3, passes=5)  # type: ignore[arg-type]
    fitted = method.fit(None, [train], quiet)  # type: ignore[arg-type]
    best = BatchSeries("v", "v", count=3).fit(None, [train], quiet)  # type: ignore[arg-type]
    error = lambda f: float(np.sqrt(np.mean((f.simulator.simulate(test) - test.y)[50:] ** 2)))  # noqa: E731
    assert error(fitted) < 2 * error(best) + 0.1 * test.y.std()


def test_a_single_output_that_is_a_speed() -> None:
    record = volterra_plant(1)
    mechanism = rf.joints.single_inertia(channel="speed")
    table = rf.compare(record, ["arx", "subspace", "state_space", "laguerre_ridge"], mechanism=mechanism)
    assert {row.status for row in table.rows} == {"ok"}
    assert all(row.rmse["speed"] < record.y.std() for row in table.rows)
