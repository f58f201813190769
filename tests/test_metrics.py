"""Metrics against their formulas, worked out by hand."""

import numpy as np
import pytest

from rotflex_jax import metrics
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Y = np.array([[0.0, 10.0], [1.0, 10.0], [3.0, 14.0], [4.0, 14.0]])
E = np.array([[1.0, 2.0], [-1.0, 2.0], [1.0, 2.0], [-3.0, 2.0]])

BY_HAND = {
    # mean of e^2 is (1 + 1 + 1 + 9) / 4 = 3 and 4; the means of y are 2 and 12
    "rmse": [np.sqrt(3), 2.0],
    "nrmse": [np.sqrt(12 / 10), 1.0],
    "fit_percent": [100 * (1 - np.sqrt(12 / 10)), 0.0],
    # the mean of e is -0.5 and its variance 3 - 0.25; a constant error has variance 0
    "vaf": [100 * (1 - 2.75 / 2.5), 100.0],
    "mae": [1.5, 2.0],
    "max_error": [3.0, 2.0],
}


@pytest.mark.parametrize("name", BY_HAND)
def test_metric_equals_its_formula_by_hand(name: str) -> None:
    np.testing.assert_allclose(getattr(metrics, name)(Y, Y - E), BY_HAND[name], atol=1e-12)


@pytest.mark.parametrize("name", BY_HAND)
def test_one_channel_alone_gives_one_number(name: str) -> None:
    value = getattr(metrics, name)(Y[:, 0], (Y - E)[:, 0])
    assert np.ndim(value) == 0
    assert value == pytest.approx(BY_HAND[name][0])


@pytest.mark.parametrize("name", BY_HAND)
def test_samples_that_the_model_may_see_do_not_count(name: str) -> None:
    metric, y_hat = getattr(metrics, name), Y - E
    scrambled = y_hat.copy()
    scrambled[:2] = 1e6
    np.testing.assert_array_equal(metric(Y, scrambled, n_init=2), metric(Y, y_hat, n_init=2))
    assert not np.allclose(metric(Y, scrambled, n_init=1), metric(Y, y_hat, n_init=1))


@pytest.mark.parametrize("name", BY_HAND)
def test_recording_brings_its_channels_and_its_initial_samples(name: str) -> None:
    rng = np.random.default_rng(0)
    recording = Recording(u=rng.normal(size=80), y=0.1 * rng.normal(size=(80, 2)), Ts=0.01)
    y_hat = recording.y + 0.1 * rng.normal(size=(80, 2))
    metric = getattr(metrics, name)
    values = metric(recording, y_hat)
    assert list(values) == ["theta", "alpha"]
    assert all(type(value) is float for value in values.values())
    np.testing.assert_array_equal(list(values.values()), metric(recording.y, y_hat, recording.n_init))


@pytest.mark.parametrize("kind", ["uint8", "int16", "float16", "float32"])
@pytest.mark.parametrize("name", BY_HAND)
def test_counts_in_a_narrow_type_do_not_overflow(name: str, kind: str) -> None:
    y, y_hat = np.array([250, 3, 10, 200]), np.array([2, 251, 10, 100])
    if kind != "uint8":
        y, y_hat = 100 * y, 100 * y_hat
    metric = getattr(metrics, name)
    assert metric(y.astype(kind), y_hat.astype(kind)) == pytest.approx(metric(y * 1.0, y_hat * 1.0), rel=1e-3)


def test_size_of_a_complex_error_counts() -> None:
    assert metrics.rmse([3j, 4.0], [0.0, 0.0]) == pytest.approx(np.sqrt(12.5))


def test_errors_in_windows_by_hand() -> None:
    """Windows of 20 samples, 8 of them not scored; a rest of 16 joins the last window, one of 17 does not."""
    starts = {56: [0, 20], 57: [0, 20, 40]}
    rng, recordings, runs = np.random.default_rng(0), [], []
    for N, begin in starts.items():
        r = Recording(u=rng.normal(size=N), y=0.1 * rng.normal(size=(N, 2)), Ts=0.1, n_init=8, accept="short")
        assert metrics.window_starts(r, 2.0)[0].tolist() == begin
        e = np.full((N, 2), np.nan)  # stays in the samples that are not scored
        for k, (i, j) in enumerate(zip(begin, [*begin[1:], N], strict=True)):
            e[i + 8 : j] = [k + 1.0, -0.5]
        np.testing.assert_array_equal(metrics.counted(r, 2.0), np.isfinite(e[:, 0]))
        recordings.append(r)
        runs.append(r.y - e)
    # 12 errors of 1 and 28 of 2; then 12 of 1, 12 of 2 and 9 of 3.
    squares = (12 * 1 + 28 * 4) + (12 * 1 + 12 * 4 + 9 * 9)
    found = metrics.windowed_rmse(recordings, [r.y for r in recordings], runs, 2.0)
    np.testing.assert_allclose(found, [np.sqrt(squares / (40 + 33)), 0.5], rtol=1e-12)


def test_a_window_is_at_least_twice_as_long_as_its_first_samples() -> None:
    """Of 100 samples with `n_init` of 8: windows of 16, and the last one takes the rest of 4."""
    r = Recording(u=np.arange(100.0), y=np.arange(100.0), Ts=0.1, n_init=8)
    starts, longest = metrics.window_starts(r, 1e-3)
    assert starts.tolist() == [0, 16, 32, 48, 64, 80] and longest == 20


def test_single_precision_stays_single() -> None:
    assert metrics.rmse(Y.astype(np.float32), (Y - E).astype(np.float32)).dtype == np.float32


def test_channel_at_rest_has_no_fit_but_an_error() -> None:
    rest = np.column_stack([np.ones(5), np.arange(5.0)])
    fit = metrics.fit_percent(rest, rest + 0.5)
    assert np.isnan(fit[0])
    assert np.isfinite(fit[1])
    assert metrics.rmse(rest, rest + 0.5) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        ((Y, Y[:3]), "same shape"),
        ((Y, Y[:, 0]), "same shape"),
        ((Y, Y, 4), "4 of 4 samples"),
        ((Y, Y, -1), "whole number from 0, but is -1"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments: tuple, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        metrics.rmse(*arguments)
