"""A recording: its defaults, its parts, its signals, and the findings on the quality of its data."""

import copy
import dataclasses
import pickle
import re
from base64 import b64decode
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from rotflex_jax.data.excitation import noise, prbs, steps
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Finding, Recording
from rotflex_jax.recording.quality import quantisation_step
from rotflex_jax.recording.recording import digest_of_recordings, joined, of_one_run

Ts = 0.002
COUNT = 2 * np.pi / 4096


def swinging(N: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A voltage and two smooth angles: the integral of a filtered voltage, and a decaying oscillation."""
    u = noise(N, Ts, seed=seed)
    speed = np.zeros(N)
    for k in range(N - 1):
        speed[k + 1] = speed[k] + Ts * (60 * u[k] - 30 * speed[k])
    theta = np.cumsum(speed) * Ts
    alpha = np.convolve(speed, np.sin(np.arange(100) / 16) * np.exp(-np.arange(100) / 30), "full")
    return u, np.column_stack([theta, 1e-2 * alpha[:N]])


def stop_and_go(rests: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A hub that dry friction brings to rest, again and again exactly at the ends of its motion."""
    s = np.linspace(0, 1, 101)
    rise = np.where(s < 0.5, 2 * s**2, 1 - 2 * (1 - s) ** 2)
    away, push = np.append(rise, np.ones(650)), np.append(2 * np.sign(0.5 - s), np.full(650, 0.1))
    theta = np.concatenate([away, 1 - away] * rests)
    return np.concatenate([push, -push] * rests), 0.5 * theta


def kinds(recording: Recording) -> dict[tuple[str, str], Finding]:
    return {(finding.kind, finding.channel): finding for finding in recording.findings}


def test_defaults_are_those_of_the_joint() -> None:
    u, y = swinging()
    recording = Recording(u=u, y=y, Ts=Ts)
    assert recording.channels == ("theta", "alpha")
    assert recording.units == ("rad", "rad")
    assert (recording.N, recording.duration, recording.n_init) == (4000, pytest.approx(8.0), 100)
    np.testing.assert_allclose(recording.t[[0, 1, -1]], [0.0, 0.002, 7.998])
    np.testing.assert_array_equal(recording.channel("alpha"), y[:, 1])
    assert recording.findings == ()
    assert recording.unit("alpha") == recording.units[1]
    for asked in (recording.channel, recording.unit):
        with pytest.raises(InputError, match="no channel 'beta'; it has theta, alpha"):
            asked("beta")


@pytest.mark.parametrize(
    ("N", "period", "n_init"), [(4000, 0.002, 100), (200, 0.1, 10), (60, 0.002, 15), (52, 0.4, 10)]
)
def test_initial_samples_are_a_fifth_of_a_second_within_limits(N: int, period: float, n_init: int) -> None:
    u, y = swinging(N)
    assert Recording(u=u, y=y, Ts=period).n_init == n_init


def test_one_output_is_theta_and_may_come_without_a_second_axis() -> None:
    u, y = swinging()
    recording = Recording(u=u[:, None], y=y[:, 0], Ts=np.float32(0.25))
    assert recording.channels == ("theta",)
    assert recording.y.shape == (4000, 1)
    assert recording.u.shape == (4000,)
    assert type(recording.Ts) is float


def test_precision_is_kept_and_whole_numbers_become_double() -> None:
    u, y = swinging()
    single = Recording(u=u.astype(np.float32), y=y.astype(np.float32), Ts=Ts)
    assert single.u.dtype == single.y.dtype == single.slice(0, 100).y.dtype == np.float32
    mixed = Recording(u=np.round(10 * u).astype(int), y=y.astype(np.float32), Ts=Ts)
    assert mixed.u.dtype == mixed.y.dtype == np.float64


def test_data_are_copied_and_cannot_be_changed() -> None:
    u, y = swinging()
    recording = Recording(u=u, y=y, Ts=Ts)
    u[0] = y[0, 0] = 7.0
    assert recording.u[0] != 7.0
    assert recording.y[0, 0] != 7.0
    for array in (recording.u, recording.y, recording.slice(0, 100).y):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7.0
    with pytest.raises(AttributeError):
        recording.Ts = 1.0  # pyright: ignore
    with_signal = recording.with_signals({"base [m/s^2]": np.sin(u)})
    for copied in (pickle.loads(pickle.dumps(with_signal)), copy.deepcopy(with_signal)):
        assert copied.channels == recording.channels
        for array in (copied.u, copied.y, copied.signals["base [m/s^2]"]):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 7.0


def test_split_cuts_in_the_order_of_time_and_keeps_the_clock() -> None:
    u, y = swinging()
    recording = Recording(u=u, y=y, Ts=Ts, start=1.0, n_init=50, source="here")
    for train, test in (recording.split(0.7), recording.split(), recording.split(seconds=5.6)):
        assert (train.N, test.N) == (2800, 1200)
        np.testing.assert_array_equal(np.concatenate([train.y, test.y]), y)
        np.testing.assert_array_equal(np.concatenate([train.u, test.u]), u)
        np.testing.assert_allclose(np.concatenate([train.t, test.t]), recording.t)
        assert (test.n_init, test.source, test.resolution) == (50, "here", recording.resolution)


@pytest.mark.parametrize(
    ("arguments", "options"),
    [((0.0,), {}), ((1.0,), {}), ((-0.5,), {}), ((), {"seconds": 8.0}), ((0.5,), {"seconds": 1.0})],
)
def test_split_without_two_parts_is_refused(arguments: tuple, options: dict) -> None:
    u, y = swinging()
    with pytest.raises(InputError, match=r"split|both given"):
        Recording(u=u, y=y, Ts=Ts).split(*arguments, **options)


def test_part_at_rest_is_no_error_and_says_so() -> None:
    u, theta = stop_and_go()
    recording = Recording(u=u, y=theta, Ts=Ts)
    rest = recording.slice(200, 240)
    assert {key: finding.severity for key, finding in kinds(rest).items()} == {
        ("short", "time"): "warning",
        ("constant_input", "voltage"): "warning",
        ("constant", "theta"): "warning",
    }
    assert rest.n_init == 10
    for end in (10, 11):
        with pytest.raises(InputError, match="within its"):
            recording.slice(10, end)


def test_decimation_keeps_the_impulse_of_the_input_and_the_measured_outputs() -> None:
    u, y = swinging(1003)
    slow = Recording(u=u, y=y, Ts=Ts, n_init=100).decimate(5)
    assert (slow.N, slow.Ts, slow.n_init) == (200, pytest.approx(0.01), 20)
    np.testing.assert_array_equal(slow.y, y[:1000:5])
    np.testing.assert_allclose(np.sum(slow.u) * slow.Ts, np.sum(u[:1000]) * Ts)
    for k in (0, 101):  # of 200 samples, one would be left
        with pytest.raises(InputError, match="`k` must be a whole number from 1 to half of the 200 samples"):
            slow.decimate(k)


def test_parts_are_of_one_run_before_and_after_decimation() -> None:
    u, y = swinging(2000)
    whole, other = Recording(u=u, y=y, Ts=Ts), Recording(u=u, y=y + np.sin(np.arange(2000))[:, None], Ts=Ts)
    first, second = whole.split(0.5)
    for a, b in ((first.decimate(2), second.decimate(2)), (first.decimate(3), second.decimate(3))):
        assert of_one_run(a, b) and of_one_run(b, first) and of_one_run(whole.decimate(5), a)
        assert not of_one_run(a, other.split(0.5)[1].decimate(2))
    # Decimated and then joined, they are the whole one decimated, if the cut lies between groups.
    (again,) = joined([first.decimate(2), second.decimate(2)])
    np.testing.assert_array_equal(again.y, whole.decimate(2).y)
    np.testing.assert_allclose(again.u, whole.decimate(2).u, rtol=1e-12)
    before = second.decimate(3).continues
    assert before is not None and before.start + before.duration == pytest.approx(second.start)
    for start in (2, 5):  # there are no two whole groups of samples before it
        near = whole.slice(start, 2000).decimate(3)
        assert near.continues is None and of_one_run(near, whole)
    assert of_one_run(pickle.loads(pickle.dumps(first.decimate(2))), second)


BASE, MOTOR = "acceleration of the base [m/s^2]", "second motor [A]"


def moving(N: int = 4000) -> Recording:
    """A recording with two signals: the acceleration of the base, and the current of a second motor."""
    u, y = swinging(N)
    return Recording(u=u, y=y, Ts=Ts, signals={BASE: np.arange(N), MOTOR: -np.arange(N)})


def test_signals_are_cut_and_joined_with_the_recording() -> None:
    whole = moving()
    assert list(whole.signals) == [BASE, MOTOR] and Recording(u=whole.u, y=whole.y, Ts=Ts).signals == {}
    part = whole.slice(1000, 3000)
    np.testing.assert_array_equal(part.signals[BASE], np.arange(1000.0, 3000.0))
    np.testing.assert_array_equal(part.continues.signals[MOTOR], -np.arange(1000.0))
    (again,) = joined(whole.split(0.7)[::-1])
    for name in whole.signals:
        np.testing.assert_array_equal(again.signals[name], whole.signals[name])
    # Signals are averaged like the input: the first mean is that of 0, 1 and 2.
    np.testing.assert_array_equal(whole.decimate(3).signals[MOTOR], -np.arange(1.0, 3999.0, 3.0))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(whole)).signals[BASE], whole.signals[BASE])


def test_parts_with_other_signals_are_not_joined() -> None:
    first, second = moving().split(0.5)
    for other in ({}, {BASE: second.signals[BASE]}, {**second.signals, "third": second.u}):
        parts = [first, second.with_signals(other)]
        assert all(a is b for a, b in zip(joined(parts), parts, strict=True))


def test_signals_are_exchanged_copied_and_cannot_be_changed() -> None:
    recording, wind = moving(60), np.ones(60)
    other = recording.with_signals({"wind [m/s]": wind})
    wind[:] = 0.0
    assert list(other.signals) == ["wind [m/s]"] and np.all(other.signals["wind [m/s]"] == 1.0)
    assert list(recording.signals) == [BASE, MOTOR] and other.with_signals({}).signals == {}
    with pytest.raises(ValueError, match="read-only"):
        other.signals["wind [m/s]"][0] = 2.0
    single = dataclasses.replace(recording, u=np.float32(recording.u), y=np.float32(recording.y))
    assert single.signals[BASE].dtype == single.u.dtype == np.float32


@pytest.mark.parametrize(
    ("signals", "phrase"),
    [
        (3, "must give the samples of each signal by its name, but is 3"),
        ([np.zeros(60)], "by its name, but is a list"),
        ({3: np.zeros(60)}, "given the name 3, but it needs one line of text"),
        ({" ": np.zeros(60)}, "given the name ' ', but it needs one line of text"),
        ({"theta": np.zeros(60)}, "the name 'theta' of the input or of a channel"),
        ({"voltage": np.zeros(60)}, "the name 'voltage' of the input or of a channel"),
        ({BASE: np.zeros(59)}, r"one value for each of the 60 samples, but has the shape \(59,\)"),
        ({BASE: np.zeros((60, 1))}, r"but has the shape \(60, 1\)"),
        ({BASE: 0.0}, r"but has the shape \(\)"),
        ({BASE: np.zeros(60, complex)}, "must hold real numbers, but holds complex128"),
        ({BASE: np.where(np.arange(60) == 7, np.nan, 0.0)}, "is nan at sample 7, in 1 of 60"),
    ],
)
def test_signals_that_are_none_are_refused(signals: Any, phrase: str) -> None:
    u, y = swinging(60)
    with pytest.raises(InputError, match=phrase):
        Recording(u=u, y=y, Ts=Ts, signals=signals)


def test_signals_are_shown_where_there_are_any() -> None:
    recording = moving(60)
    assert f"alpha [rad], beside {BASE} and {MOTOR})" in repr(recording)
    assert "beside" not in repr(recording.with_signals({}))
    page, without = recording._repr_html_(), recording.with_signals({})._repr_html_()
    text = " ".join(ElementTree.fromstring(page.replace("\xa0", " ")).itertext())
    assert "acceleration of the base m/s² 0.00 … 59.0 " in text and "second motor A −59.0 … 0.00 " in text
    lines = [b64decode(re.findall('base64,([^"]*)', each)[0]).count(b"<polyline") for each in (page, without)]
    assert lines == [5, 3]


def test_digests_have_signals_where_there_are_any() -> None:
    k = np.arange(60.0)
    recording = Recording(
        u=k % 7,
        y=np.column_stack([k % 5, k % 3]),
        Ts=0.25,
        channels=("a", "b"),
        units=("m", "V"),
        resolution={"a": 0.5, "b": None},
        constants={"hub.gain": 2.0},
        start=1.5,
        accept="saturated",
    )
    # Results are stored with digests, so the digest without signals must stay that of commit 963d166, which
    # had no signals.
    known = "78585956cc1d98473654666fc8d5e3fc6e0977b490719f7b049a6eb20187d96c"
    assert digest_of_recordings([recording, *recording.split(0.5)]) == known
    cases = [{}, {"p": k}, {"q": k}, {"p": -k}, {"p": k, "q": -k}, {"p": -k, "q": k}]
    digests = [digest_of_recordings([recording.with_signals(case)]) for case in cases]
    assert len(set(digests)) == len(cases)
    assert digest_of_recordings([recording.with_signals({"q": -k, "p": k})]) == digests[4]


def test_quantisation_is_named_with_its_step() -> None:
    u, y = swinging()
    recording = Recording(u=u, y=COUNT * np.round(y / COUNT), Ts=Ts)
    assert recording.resolution == pytest.approx({"theta": COUNT, "alpha": COUNT})
    finding = kinds(recording)["quantised", "theta"]
    assert finding.severity == "note"
    assert "0.001534 rad (0.08789 deg)" in finding.message
    assert recording.slice(0, 60).resolution == recording.resolution


def test_known_resolution_is_believed() -> None:
    u, y = swinging()
    recording = Recording(u=u, y=y, Ts=Ts, resolution={"theta": 1e-3})
    assert recording.resolution == {"theta": 1e-3, "alpha": None}


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_step_is_found_whatever_its_unit_offset_and_rounding(scale: float) -> None:
    _, y = swinging()
    levels = np.round(y[:, 0] / COUNT)
    step = COUNT * scale
    assert quantisation_step(levels * step) == pytest.approx(step)
    assert quantisation_step(levels * step + 0.3 * step) == pytest.approx(step)
    assert quantisation_step((levels * step).astype(np.float32)) == pytest.approx(step, rel=1e-5)
    assert quantisation_step(2 * levels * step) == pytest.approx(2 * step)
    # Values that differ only by a rounding error are one level.
    far_off = 1000 * step * (np.arange(4000) % 2)
    assert quantisation_step(levels * step + far_off - far_off / 3 * 3) == pytest.approx(step)
    # If no two neighbouring levels occur, the smallest gap is two steps.
    sparse = np.cumsum(np.tile([2, 3], 20))[np.arange(4000) % 40]
    assert quantisation_step(sparse * step) == pytest.approx(step)
    in_degrees = np.rad2deg(levels * COUNT)
    assert quantisation_step(np.round(in_degrees, 3)) == pytest.approx(360 / 4096, rel=1e-4)


@pytest.mark.parametrize("scale", [1.0, 180 / np.pi])
@pytest.mark.parametrize("digits", range(6, 13))
def test_step_of_the_difference_of_two_rounded_columns_is_that_of_the_encoders(
    digits: int, scale: float
) -> None:
    """As where the angle of the arm is absolute: the deflection is its difference to that of the hub."""
    _, y = swinging()
    hub, arm = (COUNT * np.round(x / COUNT) for x in (y[:, 0], y[:, 0] + y[:, 1]))
    deflection = (np.round(scale * arm, digits) - np.round(scale * hub, digits)) / scale
    assert quantisation_step(deflection) == pytest.approx(COUNT, rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_noise_free_numbers_have_no_step(seed: int) -> None:
    _, y = swinging(seed=seed)
    assert quantisation_step(y[:, 0]) is None
    assert quantisation_step(np.repeat(y[:, 1], 3)) is None
    assert quantisation_step(steps(4000, Ts, seed=seed)) is None
    held = np.maximum.accumulate(y[:, 0])  # exactly constant over long stretches
    assert quantisation_step(held) is None


def test_rest_at_the_end_of_the_motion_is_not_saturation() -> None:
    u, theta = stop_and_go()
    assert np.sum(theta == theta.max()) > 1000
    for y in (theta, COUNT * np.round(theta / COUNT)):
        assert ("saturated", "theta") not in kinds(Recording(u=u, y=y, Ts=Ts))


def test_turning_point_on_one_step_of_the_encoder_is_not_saturation() -> None:
    u, _ = swinging()
    zigzag = np.abs(np.arange(4000) % 1000 - 500) * COUNT / 3.5
    recording = Recording(u=u, y=COUNT * np.round(zigzag / COUNT), Ts=Ts)
    assert set(kinds(recording)) == {("quantised", "theta")}


@pytest.mark.parametrize("step", [0.0, COUNT])
@pytest.mark.parametrize("seed", range(4))
def test_sensor_that_cuts_off_is_refused_unless_accepted(seed: int, step: float) -> None:
    u, y = swinging(seed=seed)
    y = step * np.round(y / step) if step else y
    Recording(u=u, y=y, Ts=Ts)
    limit = 0.5 * np.max(np.abs(y[:, 1]))
    y[:, 1] = np.clip(y[:, 1], -limit, limit)
    with pytest.raises(InputError, match=r"'alpha' is exactly .* saturated"):
        Recording(u=u, y=y, Ts=Ts)
    accepted = Recording(u=u, y=y, Ts=Ts, accept="saturated")
    assert kinds(accepted)["saturated", "alpha"].severity == "warning"


def test_sensor_that_stays_at_its_limit_while_it_is_driven_is_saturated() -> None:
    u, y = swinging(seed=1)
    theta = y[:, 0] + np.linspace(0, 60, len(u))  # drifts into the limit and stays there
    Recording(u=u, y=theta, Ts=Ts)
    with pytest.raises(InputError, match="saturated"):
        Recording(u=u, y=np.minimum(theta, theta[1500]), Ts=Ts)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rest_against_a_strong_push_one_way_proves_nothing(sign: float) -> None:
    u, theta = stop_and_go()
    u = np.where(theta == theta.max(), 2.0 * sign, u)
    assert ("saturated", "theta") not in kinds(Recording(u=u, y=theta, Ts=Ts))


def test_one_sided_sensor_is_named_rectified() -> None:
    u, y = swinging()
    y[:, 1] = np.maximum(y[:, 1], 0.0)
    assert kinds(Recording(u=u, y=y, Ts=Ts))["rectified", "alpha"].severity == "warning"


def test_clipped_voltage_is_named_and_fine() -> None:
    u, y = swinging()
    clipped = kinds(Recording(u=np.clip(u, -1, 1), y=y, Ts=Ts))["clipped_input", "voltage"]
    assert clipped.severity == "note"
    assert "limit, -1 and 1 V" in clipped.message


@pytest.mark.parametrize("u", [prbs(4000, Ts), steps(4000, Ts)], ids=["prbs", "steps"])
def test_held_voltage_is_no_clipped_one(u: np.ndarray) -> None:
    assert kinds(Recording(u=u, y=swinging()[1], Ts=Ts)) == {}


def test_units_are_doubted_by_size() -> None:
    u, y = swinging()
    assert "looks like degrees" in kinds(Recording(u=u, y=np.rad2deg(y), Ts=Ts))["units", "theta"].message
    assert "millivolts" in kinds(Recording(u=1000 * u, y=y, Ts=Ts))["units", "voltage"].message
    assert kinds(Recording(u=u, y=1000 * y, Ts=Ts, units=("mm", "mm"))) == {}


def test_measured_joint_loads_without_a_doubt(measured: Callable[[str], list[Recording]]) -> None:
    for recording in measured("rotflex"):
        assert set(kinds(recording)) == {("quantised", "theta"), ("quantised", "alpha")}
        found = [quantisation_step(recording.channel(name)) for name in ("theta", "alpha")]
        assert found == pytest.approx([COUNT, COUNT])


def test_measured_joint_cut_off_is_seen(measured: Callable[[str], list[Recording]]) -> None:
    recording = measured("rotflex")[0]
    limit = 0.6 * np.max(recording.y[:, 0])
    y = np.clip(recording.y, -limit, limit)
    with pytest.raises(InputError, match=r"'theta' is exactly .* saturated"):
        Recording(u=recording.u, y=y, Ts=recording.Ts)
