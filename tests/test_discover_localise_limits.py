"""Each limit of the statements on where an error lies, tested from both sides with its value."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rotflex_jax.discover import localise, locate
from rotflex_jax.discover.localise import ConditionSet, ErrorShare, half_width, missing_acceleration
from rotflex_jax.discover.result import Where
from rotflex_jax.recording import Recording
from rotflex_jax.text.numbers import percent_of_whole

WORDS = {k: f"{k} {{}}" for k in ("inside", "outside", "above", "below")}
WORDS |= {"positive": "positive", "negative": "negative"}
RNG = np.random.default_rng(0)


def record(N: int = 400, Ts: float = 0.01) -> Recording:
    k = np.arange(N)
    y = np.column_stack([np.sin(k / 30), 0.1 * np.sin(k / 7)])
    return Recording(u=np.cos(k / 11), y=y, Ts=Ts, accept=("short",))


@pytest.mark.parametrize(
    ("N", "Ts", "half"), [(100, 0.01, 3), (100, 0.005, 6), (100, 0.02, 3), (12, 0.02, 0), (13, 0.02, 3)]
)
def test_signals_are_smoothed_over_30_ms_and_three_samples_to_each_side(N: int, Ts: float, half: int) -> None:
    shape: Any = SimpleNamespace(N=N, Ts=Ts)
    assert half_width(shape) == half


def test_the_acceleration_of_a_parabola_is_known_between_the_jumps() -> None:
    rec = record(200)  # smoothed over seven samples
    t = np.arange(200) * 0.01
    error = 1.5 * t**2 - 0.3 * t + 7.0
    for order, expected in ((2, np.full(200, 3.0)), (1, 3 * t - 0.3)):
        found, seen = missing_acceleration(error, rec, (90,), order)
        np.testing.assert_allclose(found[seen], expected[seen], atol=1e-9)
        unknown = [*range(4), *range(87, 94), *range(197, 200)]
        np.testing.assert_array_equal(np.flatnonzero(~seen), unknown)
    found, seen = missing_acceleration(error[:12], record(12))
    assert not seen.any() and not found.any()


@pytest.mark.parametrize(("share", "moves"), [(0.999, True), (1.001, False)])
def test_what_moves_is_five_times_its_error(share: float, moves: bool) -> None:
    x = np.where(RNG.random(400) < 0.5, 1.0, -1.0)
    x[:6] = 30.0  # 2 % of the samples may be further away
    found = localise._sides("speed", x, "m/s", share / 5, WORDS)
    assert (found is not None) == moves
    assert found is None or found.edges[-1] == pytest.approx(1.0)  # ten steps of a tenth, no fewer
    assert localise._sides("speed", np.zeros(400), "m/s", -1.0, WORDS) is None
    assert localise._sides("speed", np.where(x > 0, 1.0, -1.0), "m/s", 0.2, WORDS) is None  # exactly 5 times


@pytest.mark.parametrize(("unit", "factor", "step"), [("V", 1.0, 0.1), ("rad", 180 / np.pi, 5.0)])
def test_conditions_hold_where_they_say(unit: str, factor: float, step: float) -> None:
    """Limits are multiples of a round number near an eighth of the reach, in the unit that people read.

    Only conditions that hold for 3 to 60 % of the time are kept.
    """
    x = np.concatenate([np.linspace(-0.83, 0.87, 1700), np.tile(0.1 * np.arange(-8, 9), 10)])
    reach = float(np.quantile(np.abs(x), 0.98))
    found = localise._sides("deflection", x, unit, 0.0, WORDS)
    assert found is not None
    expected = {"positive": x > 0, "negative": x < 0}
    for k in range(1, int(factor * reach / step + 1e-9) + 1):
        limit = k * step / factor
        held = (np.abs(x) < limit, np.abs(x) > limit, x > limit, x < -limit)
        for name, mask in zip(("inside", "outside", "above", "below"), held, strict=True):
            expected[(name, f"{k * step:.4g}")] = mask
    expected = {k: m for k, m in expected.items() if 0.03 <= m.mean() <= 0.6}
    told = [tuple(p.split(" ")[:2]) if " " in p else p for p in found.phrases]
    assert told == list(expected)
    np.testing.assert_array_equal(found.masks, list(expected.values()))
    edges = step / factor * np.arange(-int(factor * reach / step), int(factor * reach / step) + 1)
    np.testing.assert_allclose(found.edges, edges)
    np.testing.assert_array_equal(found.bins, np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2))


@pytest.mark.parametrize(("held", "kept"), [(2, False), (3, True), (60, True), (61, False)])
def test_a_condition_holds_for_three_to_sixty_hundredths_of_the_time(held: int, kept: bool) -> None:
    mask = np.arange(100) < held
    given = ConditionSet("speed", np.array([mask]), ("now",), np.zeros(100, int), np.arange(2.0), "m/s")
    assert (localise._informative(given) is not None) == kept


def turning(back: float, error: float) -> ConditionSet | None:
    """Conditions for a speed of 1 that is negative twice for 0.05 s, at 4 s and at 8 s."""
    speed = np.ones(1200)
    speed[400:405] = speed[800:805] = -back
    return localise._reversals(speed, error, 0.01, "the hub")


@pytest.mark.parametrize(("share", "turns"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("error", [1e-3, 0.1])
def test_a_reversal_is_three_hundredths_of_the_speed_and_four_times_its_error(
    share: float, turns: bool, error: float
) -> None:
    """The root mean square of the speed is nearly sqrt(1190 / 1200), without the ten negative samples."""
    limit = max(4 * error, 0.03 * np.sqrt(1190 / 1200))
    assert (turning(share * limit, error) is not None) == turns
    assert turning(0.5, 0.125) is None  # exactly four times the error


def test_times_after_a_reversal() -> None:
    found = turning(0.5, 0.0)
    assert found is not None
    since = np.full(1200, np.inf)
    for k in (400, 405, 800, 805):
        since[k:] = 0.01 * np.arange(1200 - k)
    times = (0.02, 0.04, 0.08, 0.12, 0.2, 0.3, 0.5)
    masks = {f"within {1e3 * h:.0f} ms after the hub reverses": since < h - 1e-9 for h in times}
    # Conditions for less than 3 % of the time are left out.
    masks = {k: m for k, m in masks.items() if m.mean() >= 0.03}
    assert list(masks) == list(found.phrases) and 0 < len(masks) < len(times)
    np.testing.assert_array_equal(found.masks, list(masks.values()))
    np.testing.assert_array_equal(found.edges, [0.0, *times, np.inf])
    np.testing.assert_array_equal(found.bins, np.searchsorted(times, since + 1e-9, side="right"))
    at_the_end = localise._reversals(np.append(np.ones(29), -1.0), 0.0, 0.01, "the hub")
    assert at_the_end is not None and at_the_end.masks[:, -1].all() and not at_the_end.masks[:, :-1].any()


def share_of(share: float, expected: float, p: float, kind: str = "speed") -> ErrorShare:
    none = np.zeros(0)
    return ErrorShare(Where("", share, p, kind, "theta", none, none, none, "s"), expected)


def test_several_comparisons_are_corrected_for() -> None:
    """Of n p-values the k-th smallest may be at most 0.05 k / n (Benjamini and Hochberg).

    Then all smaller ones pass as well.
    """
    for side, passed in ((0.999, 3), (1.001, 0)):
        p = [0.9, 0.05 * 3 / 5 * side, 0.0299, 0.7, 0.0298]
        assert len(localise._significant([share_of(0.5, 0.1, x) for x in p])) == passed
    assert localise._significant([]) == []
    assert len(localise._significant([share_of(0.5, 0.1, 0.05)])) == 1


@pytest.mark.parametrize(("expected", "least"), [(0.1, 0.18), (0.5, 0.65)])
@pytest.mark.parametrize("side", [-1e-3, 0.0, 1e-3])
def test_a_share_is_told_if_it_is_eight_hundredths_and_a_third_more(
    expected: float, least: float, side: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The share is at least 0.08 more than expected, and at least 1.3 times the expected share."""
    nothing = share_of(0.1, 0.1, 1.0)
    found = share_of(least + side, expected, 1e-9)
    monkeypatch.setattr(localise, "condition_sets", lambda *given: ())
    monkeypatch.setattr(localise, "in_time", lambda *given: found)
    monkeypatch.setattr(localise, "in_frequency", lambda *given: nothing)
    rec = record()
    told = locate(rec, RNG.standard_normal((rec.N, 2)), rec.channels, (1.0, 1.0))
    assert (found.where in told) == (side >= 0)


@pytest.mark.parametrize(("times", "small"), [(1.299, True), (1.3, True), (1.301, False)])
@pytest.mark.parametrize("channel", [0, 1])
def test_an_error_is_no_larger_than_the_noise_to_three_tenths(
    times: float, small: bool, channel: int
) -> None:
    e = np.where(np.arange(100)[:, None] % 2, 1.0, -1.0) * np.ones(2)
    e[:, channel] *= times
    told = localise._nothing_stands_out(e, ("theta", "alpha"), {"theta": 1.0, "alpha": 1.0})
    assert ("no larger than the noise" in told.statement) == small


@pytest.mark.parametrize(
    ("start", "stop", "said"),
    [
        (9, 300, "before 3.0 s"),
        (10, 300, "between 0.1 s and 3.0 s"),
        (500, 990, "between 5.0 s and 9.9 s"),
        (500, 991, "after 5.0 s"),
    ],
)
def test_a_hundredth_at_an_end_is_no_piece_of_its_own(start: int, stop: int, said: str) -> None:
    e = 0.1 * np.where(np.arange(1000) % 2, 1.0, -1.0)
    e[start:stop] *= 10
    found = localise.in_time("theta", e, record(1000))
    assert said in found.where.statement
    held = slice(0 if start < 10 else start, 1000 if stop > 990 else stop)
    assert found.share == pytest.approx(np.sum(e[held] ** 2) / np.sum(e**2))
    assert found.expected == pytest.approx((held.stop - held.start) / 1000)


@pytest.mark.parametrize(("early", "late", "said"), [(300, 900, "before 3.0 s"), (100, 700, "after 7.0 s")])
def test_of_large_errors_at_both_ends_the_longer_piece_is_told(early: int, late: int, said: str) -> None:
    e = 0.1 * np.where(np.arange(1000) % 2, 1.0, -1.0)
    e[:early], e[late:] = 10 * e[:early], 10 * e[late:]
    assert said in localise.in_time("theta", e, record(1000)).where.statement


def test_the_significance_in_time_is_that_of_kuiper() -> None:
    """The p-value is 2 sum (4 j^2 v^2 - 1) exp(-2 j^2 v^2), computed here.

    v is the range of the cumulative sum of the squared error less its mean, over its standard deviation.
    """
    rec, rng = record(1000), np.random.default_rng(8)
    for seed in range(5):
        e = np.random.default_rng(seed).standard_normal(1000) * np.where(np.arange(1000) < 500, 1.0, 1.15)
        d = e**2 - np.mean(e**2)
        lags = localise.correlation_length(e[:, None])
        r = np.array([d[k:] @ d[: len(d) - k] for k in range(lags + 1)])
        spread = r[0] + 2 * sum((1 - k / (lags + 1)) * r[k] for k in range(1, lags + 1))
        v = np.ptp(np.append(0.0, np.cumsum(d))) / np.sqrt(spread)
        p = 2 * sum((4 * j**2 * v**2 - 1) * np.exp(-2 * j**2 * v**2) for j in range(1, 100))
        assert localise.in_time("theta", e, rec).where.p_value == pytest.approx(min(p, 1.0), rel=1e-6)
    # For a range far below that of random errors, where the series is inaccurate, p is a probability too.
    flat = np.where(np.arange(1000) % 2, 1.0, -1.0) * (1 + 1e-9 * rng.standard_normal(1000))
    assert 0.0 <= localise.in_time("theta", flat, rec).where.p_value <= 1.0


def test_bands_hold_their_share_of_the_power() -> None:
    """Edges are 1, 2 and 5 times powers of ten, from four times the lowest frequency on.

    Expected shares are those of white noise.
    """
    rec = record(1000)  # 0.1 to 50 Hz
    e = np.random.default_rng(9).standard_normal(1000) + 0.5 + np.sin(2 * np.pi * 3.0 * rec.t)
    found = localise.in_frequency("theta", e, rec, "m")
    np.testing.assert_allclose(found.where.edges, [0.0, 0.05, 0.5, 1, 2, 5, 10, 20, 50])
    power = np.abs(np.fft.fft(e)) ** 2
    f = np.abs(np.fft.fftfreq(1000, 0.01))
    inside = [(f >= a) & (f < b) for a, b in zip(found.where.edges[:-1], found.where.edges[1:], strict=True)]
    inside[-1] |= f == 50.0
    np.testing.assert_allclose(found.where.profile, [power[m].sum() / power.sum() for m in inside])
    np.testing.assert_allclose(found.where.expected, [m.mean() for m in inside])
    assert found.where.p_value == 1 / 1000
    # Bands begin at four times the lowest frequency, 0.125 Hz in 8 s.
    assert localise.in_frequency("theta", e[:800], record(800), "m").where.edges[2] == 0.5


def test_a_share_of_all_or_of_nothing_has_a_divergence() -> None:
    assert localise.relative_entropy(1.0, 0.2) == pytest.approx(np.log(5.0))
    assert localise.relative_entropy(0.0, 0.2) == localise.relative_entropy(1.0, 1.0) == 0.0


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (1e-5, "0.1 %"),
        (0.0099, "1.0 %"),
        (0.01, "1 %"),
        (0.9949, "99 %"),
        (0.995, "99.5 %"),
        (0.9994, "99.9 %"),
        (0.9995, "all"),
        (0.9996, "all"),
    ],
)
def test_shares_as_they_are_read(share: float, said: str) -> None:
    assert percent_of_whole(share) == said


def test_the_deflection_is_the_parabola_through_seven_samples() -> None:
    """Least squares of a parabola over three samples to each side, at the middle one."""
    alpha = np.zeros(400)
    alpha[20:380] = np.random.default_rng(12).normal(size=360)
    rec = Recording(u=np.cos(np.arange(400) / 11), y=np.column_stack([record().y[:, 0], alpha]), Ts=0.01)
    sets = localise.condition_sets(rec, rec.channels, {}, None)
    (found,) = (conditions for conditions in sets if conditions.kind == "deflection")
    smooth = np.convolve(alpha, np.array([-2, 3, 6, 7, 6, 3, -2]) / 21, mode="same")
    far = np.min(np.abs(smooth[:, None] - found.edges), axis=1) > 1e-9
    expected = np.clip(np.searchsorted(found.edges, smooth, side="right") - 1, 0, len(found.edges) - 2)
    np.testing.assert_array_equal(found.bins[far], expected[far])
    assert far.sum() > 350


@pytest.mark.parametrize("Ts", [0.01, 0.002])
def test_a_speed_is_smoothed_over_the_half_width_to_each_side(Ts: float) -> None:
    """A jump between two samples changes the speed in all windows that contain both."""
    y = np.where(np.arange(400) < 200, 0.0, 1.0) - 0.01 * np.arange(400)
    jump = Recording(record(400, Ts).u, y[:, None], Ts, channels=("theta",), accept=("short",))
    speed, error, unit = localise._speed(jump, "theta", 0.0, None)
    half = half_width(jump)
    np.testing.assert_array_equal(
        np.flatnonzero(np.abs(speed + 0.01 / Ts) > 1e-9), np.arange(200 - half, 200 + half)
    )
    assert error == 0.0 and unit == "rad/s"
