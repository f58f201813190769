"""Checks of a recording on both sides of their limits; distinction of an absolute angle from a deflection."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import INPUTS, make_record
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording, quality
from rotflex_jax.recording.quality import (
    cut_off,
    is_absolute,
    is_swapped,
    quantisation_step,
    whole_numbers,
)
from rotflex_jax.recording.samples import even_spacing

# Effects that might make the distinction wrong: friction, gravity, play, the gain of a sensor, a second mode.
HIDDEN = [
    (("coulomb", "arm"), "steps"),
    (("gravity", "arm"), "sweep"),
    (("joint_play", "joint"), "noise"),
    (("sensor_gain", "theta"), "prbs"),
    (("second_mode", "arm"), "multisine"),
]


def warned(recording: rf.Recording) -> bool:
    return any(f.kind == "absolute" and f.severity == "warning" for f in recording.findings)


@pytest.mark.parametrize(("place", "kind"), [*HIDDEN, *((None, kind) for kind in INPUTS)])
def test_the_angle_in_the_room_is_told_from_a_deflection(place, kind) -> None:
    made = make_record([place] if place else [], kind=kind, seed=113, seconds=8.0, fs=250.0)
    theta, alpha = made["y"].T
    room = theta + alpha
    for arm, absolute in ((alpha, False), (-alpha, False), (room, True), (room - 0.7, True)):
        r = rf.Recording(u=made["u"], y=np.column_stack([theta, arm]), Ts=made["Ts"])
        assert warned(r) == absolute
        # Parts of a recording with a deflection give no warning either.
        assert not any(warned(r.slice(k, k + 250)) for k in range(0, 1750, 250)) or absolute


def deflection(theta: np.ndarray, t: np.ndarray, hertz: float, damping: float) -> np.ndarray:
    """Deflection of an arm on a spring for a given motion of the hub: a'' + 2 d w a' + w^2 a = -theta''."""
    w = 2 * np.pi * hertz
    system = StateSpace([[0, 1], [-(w**2), -2 * damping * w]], [[0], [1]], [[1, 0]], [[0]])
    return lsim(system, -np.gradient(np.gradient(theta, t), t), t)[1]


@pytest.mark.parametrize("hertz", [0.3, 1.0, 3.0, 10.0])
def test_no_motion_of_the_hub_makes_a_deflection_look_so(hertz: float) -> None:
    """Motions are sines at which the deflection is as large as theta, drifts, steps and noise."""
    t = np.arange(0, 10, 0.004)
    rng = np.random.default_rng(7)
    equal = np.sin(2 * np.pi * hertz / np.sqrt(2) * t)
    motions: list[Callable[[], np.ndarray]] = [
        lambda: equal,
        lambda: equal + 0.3 * t,
        lambda: equal + 0.2 * np.sin(2 * np.pi * 0.13 * t),
        lambda: np.tanh(20 * np.sin(2 * np.pi * 0.4 * t)),
        lambda: np.cumsum(rng.standard_normal(len(t))) * 0.02,
        lambda: np.convolve(rng.standard_normal(len(t)), np.blackman(80), mode="same"),
    ]
    for motion in motions:
        theta = motion()
        alpha = deflection(theta, t, hertz, 0.03)
        assert not is_absolute(theta, alpha)
        for start in range(0, len(t) - 500, 500):
            assert not is_absolute(theta[start : start + 500], alpha[start : start + 500])


def test_measured_joints_raise_no_doubt(measured) -> None:
    for r in [*measured("rotflex"), *measured("rotary_arm")[:1]]:
        assert not warned(r)
    for r in measured("rotflex"):
        theta, alpha = r.y.T
        assert warned(rf.Recording(u=r.u, y=np.column_stack([theta, theta + alpha]), Ts=r.Ts))


N, TS = 2000, 0.01
K = np.arange(N)
RNG = np.random.default_rng(5)
U = RNG.normal(size=N)
U /= np.max(np.abs(U))
WAVE = np.sin(K / 40) + 1e-3 * RNG.normal(size=N)
WAVE /= np.max(np.abs(WAVE))


def kinds(*, u: np.ndarray = U, theta: np.ndarray = WAVE, alpha: np.ndarray = 0.1 * WAVE[::-1]) -> set[str]:
    y = np.column_stack([theta, alpha])
    return {f"{f.kind} {f.channel}" for f in Recording(u=u, y=y, Ts=TS).findings if f.severity != "note"}


@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_input_beyond_a_hundred_volts_looks_like_millivolts(share: float, found: bool) -> None:
    assert ("units voltage" in kinds(u=100 * share * U)) == found


@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_deflection_beyond_half_a_turn_looks_like_degrees(share: float, found: bool) -> None:
    assert ("units alpha" in kinds(alpha=np.pi * share * WAVE[::-1])) == found
    assert ("units alpha" in kinds(alpha=-np.pi * share * np.abs(WAVE[::-1]))) == found  # to one side


@pytest.mark.parametrize(
    "volts", [1.0, 10.0]
)  # below and above the voltage at which the limit begins to grow
@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_speed_per_volt_that_no_servo_reaches_looks_like_degrees(
    volts: float, share: float, found: bool
) -> None:
    speed = np.max(np.abs(WAVE[2:] - WAVE[:-2])) / (2 * TS)  # over 20 ms
    limit = max(60.0, 15.0 * volts)
    assert ("units theta" in kinds(u=volts * U, theta=share * limit / speed * WAVE)) == found


@pytest.mark.parametrize(
    ("late", "said"), [(0.0099, None), (0.0101, "jittery"), (0.499, "jittery"), (0.501, "gap of")]
)
def test_times_are_even_to_a_hundredth(late: float, said: str | None) -> None:
    t = TS * np.arange(100.0)
    t[50:] += late * TS
    if said is None:
        assert even_spacing(t, "Time") == pytest.approx(TS, rel=2e-4)
        return
    with pytest.raises(InputError, match=said):
        even_spacing(t, "Time")


@pytest.mark.parametrize("rate", [610.35, 500.0, 300.0])
def test_only_a_short_period_is_rounded(rate: float) -> None:
    """Times that are rounded to 1 ns; the period is exact if it is a short number, else it is the mean."""
    period = even_spacing(np.round(np.arange(2000) / rate, 9), "Time")
    assert period == (0.002 if rate == 500.0 else pytest.approx(1 / rate, rel=1e-9))


@pytest.mark.parametrize(("volts", "accepted"), [(0.0, False), (8e-13, False), (1.2e-12, True)])
@pytest.mark.parametrize("scale", [0.01, 1.0, 50.0])
def test_input_is_constant_below_a_trillionth(volts: float, accepted: bool, scale: float) -> None:
    u = scale * (1.0 + volts * np.where(K % 2, 0.5, -0.5))
    if accepted:
        assert kinds(u=u) is not None
        return
    with pytest.raises(InputError, match="throughout"):
        kinds(u=u)


# -- steps of an encoder ----------------------------------------------------------------------------

EPS = np.finfo(float).eps


@pytest.mark.parametrize(("levels", "step"), [(9, None), (10, 0.25)])
def test_a_step_needs_ten_levels(levels: int, step: float | None) -> None:
    assert quantisation_step(0.25 * (np.arange(200.0) % levels)) == step


@pytest.mark.parametrize(("repeated", "step"), [(0, None), (1, 0.25)])
def test_a_step_needs_a_level_that_comes_back(repeated: int, step: float | None) -> None:
    assert quantisation_step(0.25 * np.append(np.arange(50.0), np.arange(repeated))) == step


@pytest.mark.parametrize(("off", "found"), [(0.0498, True), (0.0502, False)])
def test_levels_lie_on_a_lattice_to_a_twentieth_of_its_step(off: float, found: bool) -> None:
    levels = np.arange(4001.0)
    levels[2000] += off  # in the middle, where it moves the fitted lattice by only a 4001st of that
    step = quantisation_step(np.append(levels, levels))
    assert (step is not None) == found
    assert step is None or step == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("smallest", range(1, 6))
def test_the_smallest_gap_may_be_up_to_five_steps(smallest: int) -> None:
    gaps = [smallest, *range(-(-3 * smallest // 2), 2 * smallest + 3)]
    gaps = np.random.default_rng(smallest).choice(gaps, 60)
    levels = 0.1 * np.cumsum(np.append(smallest, gaps))
    assert quantisation_step(np.append(levels, levels)) == pytest.approx(0.1)


@pytest.mark.parametrize(("apart", "found"), [(16, True), (18, False)])
def test_values_that_differ_by_16_units_of_rounding_are_one_level(apart: int, found: bool) -> None:
    levels = np.arange(32, 65) / 64  # at most one, so that the unit of rounding is EPS
    assert (quantisation_step(np.append(levels, levels - apart * EPS)) is not None) == found


@pytest.mark.parametrize(("share", "found"), [(0.996, False), (1.004, True)])
def test_a_step_is_a_hundred_times_what_makes_values_equal(share: float, found: bool) -> None:
    levels = 1.0 - share * 1600 * EPS * np.arange(20)
    assert (quantisation_step(np.append(levels, levels)) is not None) == found


# -- the end of a sensor's range --------------------------------------------------------------------


def visits(near: int, far: int, at_end: int, number: int = 2, leaving: int | None = None) -> np.ndarray:
    """A signal of range one that goes `number` times to its upper end and stays there for `at_end` samples.

    The last tenth of the range takes `far` samples on the way there, and the last fortieth `near` of these.
    On the way back this tenth takes `leaving` samples, by default `far`.
    """
    away = leaving or far

    def ramp(full: int) -> np.ndarray:
        start = np.linspace(1.0, 0.1, 200, endpoint=False)
        middle = np.linspace(0.1, 0.025, full - near, endpoint=False)
        return np.concatenate([start, middle, np.linspace(0.025, 0.0, near, endpoint=False)])

    one = np.concatenate([ramp(far), np.zeros(at_end), ramp(away)[::-1]])
    return 1.0 - np.tile(one, number)


def is_cut(x: np.ndarray, u: np.ndarray | None = None, Ts: float = 0.01, step: float | None = None) -> bool:
    return cut_off(x, step, np.zeros(len(x)) if u is None else u, Ts) is not None


@pytest.mark.parametrize(("ratio", "found"), [(2.47, False), (2.53, True), (5.95, True), (6.05, False)])
def test_an_end_is_reached_straight_where_four_times_as_far_takes_longer(ratio: float, found: bool) -> None:
    """From 2.5 to six times as long: above six times the signal has paused, which is no evidence."""
    far = round(400 * ratio)
    assert is_cut(visits(400, far, 20)) == found
    # Arriving and leaving must both be straight; a parabola takes twice as long for four times as far.
    assert is_cut(visits(400, far, 20, leaving=800)) is False
    # The lower end is checked like the upper one.
    assert is_cut(-visits(400, far, 20)) == found


def test_a_signal_that_is_cut_at_zero_is_rectified() -> None:
    x = 0.1 * visits(400, 1020, 20)
    rng = np.random.default_rng(11)
    u, theta = rng.normal(size=len(x)), np.cumsum(rng.normal(size=len(x))) / 100

    def read(alpha: np.ndarray) -> Recording:
        return Recording(u=u, y=np.column_stack([theta, alpha]), Ts=TS)

    (told,) = (f for f in read(x - x.max()).findings if f.kind in ("rectified", "saturated"))
    assert (told.kind, told.channel, told.severity) == ("rectified", "alpha", "warning")
    assert f"exactly 0 rad, its extreme, in 40 of {len(x)} samples" in told.message
    with pytest.raises(InputError, match=r"is exactly 0\.05 rad.* saturated"):
        read(x - 0.05)


@pytest.mark.parametrize(
    ("at_end", "found"),
    [((5, 4), False), ((5, 5), True), ((10,), False), ((2,) * 5, True)],
)
def test_ten_samples_at_an_end_in_two_visits(at_end: tuple[int, ...], found: bool) -> None:
    """A signal is cut off from ten samples at an end on, in at least two visits."""
    x = np.concatenate([visits(100, 400, n, number=1) for n in at_end])
    assert is_cut(x) == found
    assert not found or cut_off(x, None, x, 0.01) == (1.0, 10)


@pytest.mark.parametrize(("order", "found"), [(1, True), (2, False), (3, False)])
def test_an_end_that_is_crept_to_after_a_pause_is_no_limit(order: int, found: bool) -> None:
    """A joint with dry friction follows a step of its setpoint, pauses, creeps on, and leaves at the next.

    The last tenth takes 3.1 times as long as the last fortieth, where the distance to the end falls as
    (1 - t)^order. The signal goes straight on only where the order is one.
    """
    t = np.linspace(0.0, 1.0, 110, endpoint=False)
    arrives = [np.linspace(1.0, 0.1, 200, endpoint=False), np.linspace(0.1, 0.025, 230, endpoint=False)]
    one = np.concatenate([*arrives, 0.025 * (1 - t) ** order, np.zeros(180), np.linspace(0.0, 1.0, 400)])
    assert is_cut(1.0 - np.tile(one, 2)) == found


@pytest.mark.parametrize(("more", "found"), [(0, False), (1, True)])
def test_twelve_samples_on_the_way_are_enough(more: int, found: bool) -> None:
    """Within a tenth of the end, arriving and leaving, there are 11 or 12 samples per visit.

    With 12 the motion over this tenth is tested, which is straight; with 11 that over a fifth, which is not.
    """
    far = np.linspace(1.0, 0.25, 200)
    close = [0.15, 0.15, 0.15, 0.09, *[0.045] * 3]
    arrives = np.concatenate([far, close, [0.04] * more, [0.01]])
    leaves = np.concatenate([[0.01], close[::-1], far[::-1]])
    assert is_cut(1.0 - np.tile(np.concatenate([arrives, np.zeros(5), leaves]), 2)) == found


@pytest.mark.parametrize(("samples", "found"), [(19, False), (20, True)])
def test_a_push_both_ways_takes_twenty_samples(samples: int, found: bool) -> None:
    """A single stay at the end, during which the input is strongest in both directions.

    At a sampling period of 0.1 s the mean over a tenth of a second is a single sample.
    """
    x = visits(400, 800, samples, number=1)
    u = 0.1 * np.sin(np.arange(len(x)))
    first = np.flatnonzero(x == 1.0)[0]
    u[first + 2 : first + 6], u[first + 8 : first + 12] = 1.0, -1.0
    assert is_cut(x, u, Ts=0.1) == found


@pytest.mark.parametrize(
    ("up", "down", "found"), [(0.79, 0.9, False), (0.9, 0.79, False), (0.81, 0.81, True)]
)
def test_a_push_is_four_fifths_of_the_strongest(up: float, down: float, found: bool) -> None:
    x = visits(400, 800, 100, number=1)
    u = np.zeros(len(x))
    u[50:90], u[100:140] = 1.0, -1.0
    first = np.flatnonzero(x == 1.0)[0]
    u[first + 10 : first + 40], u[first + 50 : first + 80] = up, -down
    assert is_cut(x, u) == found


@pytest.mark.parametrize(("lasts", "found"), [(7, False), (9, True)])
def test_a_push_is_the_mean_over_a_tenth_of_a_second(lasts: int, found: bool) -> None:
    """Over ten samples, a push of seven has a mean of 70 % of a long push, and one of nine 90 %."""
    x = visits(400, 800, 100, number=1)
    u = np.zeros(len(x))
    u[50:90], u[100:140] = 1.0, -1.0
    first = np.flatnonzero(x == 1.0)[0]
    u[first + 20 : first + 20 + lasts], u[first + 60 : first + 60 + lasts] = 1.0, -1.0
    assert is_cut(x, u) == found


# -- the input --------------------------------------------------------------------------------------


def is_clipped(u: np.ndarray) -> bool:
    y = np.column_stack([WAVE, 0.1 * WAVE[::-1]])[: len(u)]
    return any(f.kind == "clipped_input" for f in Recording(u=u, y=y, Ts=TS).findings)


@pytest.mark.parametrize(
    ("samples", "held", "often"), [(2000, 1, 10), (500, 1, 5), (2000, 4, 20)], ids=["share", "few", "held"]
)
@pytest.mark.parametrize("end", [1, -1])
def test_a_limit_is_stood_at_unusually_often(samples: int, held: int, often: int, end: int) -> None:
    """At least a two-hundredth of all samples, at least five, and five times as many as at a usual level."""
    free = np.repeat(np.random.default_rng(0).uniform(-1, 1, samples // held), held)
    for count, found in ((often - 1, False), (often, True)):
        u = free.copy()
        u[: count - 1] = u[samples // 2] = 2.0 * end
        assert is_clipped(u) == found
    u = np.abs(free) + 0.5 if end > 0 else -np.abs(free) - 0.5
    u[:often] = 0.0  # a voltage of zero is not a limit
    assert not is_clipped(u)


@pytest.mark.parametrize(("share", "found"), [(0.09, False), (0.11, True)])
def test_an_input_that_stands_still_once_is_not_clipped(share: float, found: bool) -> None:
    """A part of a recording may begin where friction holds the machine, and the controller its voltage."""
    u = np.random.default_rng(0).uniform(-1, 1, 2000)
    u[300:700] = -1.0
    assert not is_clipped(u) and not is_clipped(u[300:])
    u[450:500] = u.max() * share - (1 - share)  # a share of the range away, then back
    assert is_clipped(u) == found


@pytest.mark.parametrize(("levels", "found"), [(9, False), (10, True)])
def test_an_input_of_a_few_levels_is_not_clipped(levels: int, found: bool) -> None:
    u = np.append(np.arange(1.0, levels), np.full(200, float(levels)))
    assert is_clipped(np.append(u, np.tile(u[:levels], 10))) == found


def test_whole_numbers_over_twenty_are_counts() -> None:
    k = np.arange(100.0)
    assert not whole_numbers(k % 20) and whole_numbers(k % 21)
    assert not whole_numbers(np.append(k, 0.5))


# -- the absolute angle of the arm, and swapped columns ---------------------------------------------

TURN = 2 * np.pi * np.arange(4096) / 4096


def slow(first: float, second: float, fast: float = 0.0) -> np.ndarray:
    """Sines in the two slow bands, and one far above them."""
    return first * np.cos(2 * TURN) + second * np.cos(6 * TURN) + fast * np.cos(100 * TURN)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("share", "found"), [(0.99, True), (1.01, False)])
def test_the_angle_in_the_room_follows_to_a_twentieth_and_then_to_three(
    share: float, found: bool, sign: int
) -> None:
    theta = slow(0.1, 1.0)
    assert is_absolute(theta, slow(0.1 * (1 + sign * 0.05 * share), 1.0)) == found
    assert is_absolute(theta, slow(0.1, 1.0 + sign * 0.15 * share)) == found


@pytest.mark.parametrize(("apart", "found"), [(0.1, True), (0.3, False)])
def test_it_follows_with_a_coherence_of_99_hundredths(apart: float, found: bool) -> None:
    """Of two sines in one band, one is larger and the other smaller, so the mean slope stays at one."""
    theta = slow(1.0, 0.0) + np.cos(4.5 * TURN) + np.cos(6.5 * TURN)
    alpha = slow(1.0, 0.0) + (1 + apart) * np.cos(4.5 * TURN) + (1 - apart) * np.cos(6.5 * TURN)
    assert is_absolute(theta, alpha) == found


@pytest.mark.parametrize(("size", "found"), [(0.0030, False), (0.0034, True)])
def test_slow_motion_is_three_thousandths_of_all(size: float, found: bool) -> None:
    """The share is that of the windowed transform, of which a sine in the first band has only 0.95 there."""
    theta = slow(size, 0.1, np.sqrt(0.99))
    assert is_absolute(theta, theta) == found
    theta = 0.1 * np.cos(TURN) + slow(0.0, 0.95 * size, np.sqrt(0.99))
    assert is_absolute(theta, theta) == found


@pytest.mark.parametrize(("share", "found"), [(0.99, False), (1.01, True)])
def test_swapped_is_three_times_the_motion_of_the_hub(share: float, found: bool) -> None:
    theta = slow(0.3, 1.0)
    assert is_swapped(theta, slow(3 * 0.3 * share, 4.0)) == found
    assert is_swapped(theta, slow(3 * 0.4, 3.0 * share)) == found


@pytest.mark.parametrize(("size", "found"), [(0.030, False), (0.034, True)])
def test_swapped_needs_slow_motion_of_three_hundredths(size: float, found: bool) -> None:
    alpha = slow(size, 0.1, np.sqrt(0.99))
    assert is_swapped(0.1 * alpha, alpha) == found


@pytest.mark.parametrize(("samples", "found"), [(15, False), (16, True)])
def test_what_is_slow_needs_two_samples_in_the_shortest_period(samples: int, found: bool) -> None:
    x = np.cos(np.linspace(0, 4 * np.pi, samples)) + 0.7 * np.random.default_rng(3).normal(size=samples)
    assert is_absolute(x, x) == found
    assert is_swapped(0.1 * x, x) == found


def test_what_is_exactly_at_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values exactly at a limit; signals or limits are chosen such that sums have no rounding error."""
    y = np.column_stack([WAVE, 0.1 * WAVE[::-1]])
    for samples, short in ((49, True), (50, False)):
        r = Recording(u=U[:samples], y=y[:samples], Ts=TS, accept=quality.ACCEPTABLE)
        assert any(f.kind == "short" for f in r.findings) == short
    assert "units voltage" not in kinds(u=100 * U) and np.max(np.abs(100 * U)) == 100.0
    half_turn = np.where(K % 2, 1.0, -1.0) * np.pi
    assert "units alpha" not in kinds(alpha=half_turn)
    # The largest speed that a servo may have, over one sample of a quarter of a second.
    for volts, speed in ((1.0, 60.0), (10.0, 150.0)):
        for more, found in ((0.0, False), (1e-9, True)):
            theta = np.array([0.0, 0.0, 0.25 * speed + more, 0.0])
            told = quality._like_degrees(theta, volts * np.ones(4), 0.25, "theta", "V")
            assert (told is not None) == found
    x = slow(1.0, 1.0)
    monkeypatch.setattr(quality, "SWAPPED_RATIO", 4.0)
    assert not is_swapped(x, 4.0 * x) and is_swapped(x, 4.000001 * x)
    # The least share of slow motion in one band; the rest is in the other.
    monkeypatch.setattr(quality, "_spectrum", lambda values: np.asarray(values, complex))
    monkeypatch.setattr(quality, "LEAST_SLOW_SHARE", 0.5)
    hub = np.zeros(16)
    hub[1], hub[4] = 3.0, 4.0  # norm 5
    monkeypatch.setattr(quality, "LEAST_SLOW_SHARE", 0.6)
    assert not is_absolute(hub, hub)
    monkeypatch.setattr(quality, "LEAST_SLOW_SHARE", 0.59)
    assert is_absolute(hub, hub)
    # A slope that differs from one by the tolerance, and one by more.
    monkeypatch.setattr(quality, "SLOW_BANDS", ((1, 4, 0.25), (4, 8, 0.25)))
    assert is_absolute(hub, 1.25 * hub) and not is_absolute(hub, 1.2500001 * hub)
    monkeypatch.setattr(quality, "LEAST_SLOW_SHARE", 0.06)
    assert not is_swapped(0.1 * hub, hub)  # ten times this share is required
    monkeypatch.setattr(quality, "LEAST_SLOW_SHARE", 0.059)
    assert is_swapped(0.1 * hub, hub)
    assert not is_absolute(hub, 0.0 * hub)


def test_sentences_tell_the_numbers_that_decided() -> None:
    y = np.column_stack([WAVE, 0.1 * WAVE[::-1]])

    def said(u: np.ndarray = U, theta: np.ndarray = WAVE, alpha: np.ndarray = y[:, 1]) -> str:
        r = Recording(u=u, y=np.column_stack([theta, alpha]), Ts=TS, accept=quality.ACCEPTABLE)
        return " ".join(f.message for f in r.findings)

    swapped = quality._swapped(slow(1.0, 1.0)[:, None] * [0.1, 1.0], ("theta", "alpha"))
    assert swapped is not None and "moves 10 times as far as 'theta'" in swapped.message
    assert "reaches 250 V" in said(u=250 * U)
    assert "alpha' reaches 4 rad" in said(alpha=4 * WAVE[::-1])
    told = quality._like_degrees(np.array([0.0, 25.0, 0.0]), np.full(3, -2.0), 0.25, "theta", "V")
    assert told is not None and "up to 100 rad/s on 2 V" in told.message
    assert "is 1.5 V throughout" in said(u=np.full(N, 1.5))
    assert "'alpha' never changes from 0.25 rad" in said(alpha=np.full(N, 0.25))
    step = 2 * np.pi / 4096
    assert "in steps of 0.001534 rad (0.08789 deg)" in said(theta=step * np.round(WAVE / step))
    assert "whole numbers from -30 to 30" in said(theta=np.round(30 * WAVE))
    clipped = np.clip(2 * U, -0.5, 0.75)
    assert "stands at its limit, -0.5 and 0.75 V" in said(u=clipped)
    short = Recording(u=U[:40], y=y[:40], Ts=TS, accept=quality.ACCEPTABLE)
    assert "at least 50 samples, but has 40" in " ".join(f.message for f in short.findings)


def test_swapped_columns_are_found_in_a_recording() -> None:
    hub, arm = slow(0.3, 1.0, 0.1), 0.1 * slow(0.3, 1.0, -0.2)
    for y, found in (((hub, arm), False), ((arm, hub), True)):
        r = Recording(np.cos(50 * TURN), np.column_stack(y), 0.01)
        assert any(f.kind == "swapped" and f.channel == "alpha" for f in r.findings) == found
