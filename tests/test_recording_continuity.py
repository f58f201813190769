"""Wrapped angles, outliers, frozen sensors, and implausible sampling periods."""

import numpy as np
import pandas as pd
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.errors import InputError
from rotflex_jax.recording import quality
from rotflex_jax.recording.continuity import frozen, motion, outliers, wraps

TS = 0.0025
STEP = 2 * np.pi / 4096
RECORD = make_record([("coulomb", "hub")], kind="multisine", seed=4, seconds=12.0, fs=400.0)
T = TS * np.arange(len(RECORD["u"]))
U = RECORD["u"]
THETA, ALPHA = np.round(RECORD["y"].T / STEP) * STEP
NEW = ("slow", "wrapped", "outliers", "frozen")
MOVING = 1000 + int(np.argmax(np.abs(np.diff(THETA[1000:4000]))))  # a sample in fast motion


def table(**changed: np.ndarray) -> pd.DataFrame:
    return pd.DataFrame({"t": T, "voltage": U, "theta": THETA, "alpha": ALPHA} | changed)


def wrapped(x: np.ndarray) -> np.ndarray:
    return (x + np.pi) % (2 * np.pi) - np.pi


def changed(x: np.ndarray, where: slice | list[int], value: float) -> np.ndarray:
    x = x.copy()
    x[where] = value
    return x


def refused(frame: pd.DataFrame, **options: object) -> str:
    with pytest.raises(InputError) as caught:
        rf.load(frame, **options)  # pyright: ignore[reportArgumentType]
    return str(caught.value)


def kinds(frame: pd.DataFrame) -> list[str]:
    r = rf.load(frame, accept=quality.ACCEPTABLE)
    return [f.kind for f in r.findings if f.severity != "note"]


FAST = 4.0 * THETA + np.pi - 4.0 * THETA[MOVING]
"""Angle of a hub that passes half a turn in fast motion."""


def test_a_wrapped_angle_is_named_with_its_first_jump_and_no_unit() -> None:
    theta = wrapped(FAST)
    first = int(np.argmax(np.abs(np.diff(theta)) > np.pi))
    for given, options in ((theta, {}), (np.rad2deg(theta), {"degrees": True})):
        turned = ALPHA if not options else np.rad2deg(ALPHA)
        said = refused(table(theta=given, alpha=turned), **options)
        assert "'theta' jumps by a whole turn, 6.283 rad (360 deg)" in said
        assert f"after {first * TS:g} s" in said and "numpy.unwrap" in said
        assert "looks like" not in said and "degrees=True" not in said
    assert len(T) == rf.load(table(theta=np.unwrap(theta))).N
    # Arrays are refused too: no model has a wrapped angle as its output.
    with pytest.raises(InputError, match="it is wrapped"):
        rf.Recording(u=U, y=np.column_stack([theta, ALPHA]), Ts=TS)
    accepted = rf.Recording(u=U, y=np.column_stack([theta, ALPHA]), Ts=TS, accept="wrapped", start=3.0)
    (warning,) = (f for f in accepted.findings if f.severity == "warning")
    assert warning.kind == "wrapped" and f"after {3 + first * TS:g} s" in warning.message


def test_a_wrapped_angle_in_degrees_is_to_be_unwrapped_by_360_and_converted() -> None:
    said = refused(table(theta=np.rad2deg(wrapped(FAST)), alpha=np.rad2deg(ALPHA)))
    assert "jumps by 360, a whole turn in degrees" in said
    assert "numpy.unwrap(..., period=360), and pass degrees=True" in said


def test_whole_turns_by_chance_are_no_wrapped_angle() -> None:
    rng = np.random.default_rng(1)
    for size in (0.5, 1.0, 2.0, 4.0):
        for x in (rng.normal(size=4000), rng.normal(size=300), np.cumsum(rng.normal(size=4000))):
            assert not len(wraps(size * x, 2 * np.pi))
    assert not len(wraps(np.where(np.arange(200) % 2, np.pi, -np.pi), 2 * np.pi))
    step = 2.1 * np.pi * (np.arange(400) > 200) + 0.001 * np.sin(np.arange(400.0))
    assert not len(wraps(step, 2 * np.pi))


@pytest.mark.parametrize(
    ("channel", "where", "value"),
    [("alpha", [300], 50.0), ("alpha", slice(300, 307), -9999.0), ("theta", [300, 3000], 3.0)],
)
def test_outliers_are_named_with_time_and_value_and_no_unit(channel, where, value) -> None:
    clean = {"theta": THETA, "alpha": ALPHA}[channel]
    bad = table(**{channel: changed(clean, where, value)})
    said = refused(bad)
    assert f"'{channel}' is {value:.4g} rad" in said and "at 0.75 s (sample 300)" in said
    assert f"after {clean[299]:.4g} rad" in said
    assert f"{np.sum(bad[channel] != clean)} of {len(T)} samples" in said
    assert "remove or interpolate" in said and "looks like" not in said
    assert kinds(bad) == ["outliers"]  # and no other fault is reported
    # Arrays are not refused: the program that made them is responsible for their values.
    r = rf.Recording(u=U, y=bad[["theta", "alpha"]].to_numpy(), Ts=TS)
    assert [f.kind for f in r.findings if f.severity == "warning"] == ["outliers"]


def test_degrees_are_still_found_beside_other_faults() -> None:
    degrees = changed(np.rad2deg(3 * ALPHA), [300], -9999.0)
    assert kinds(table(alpha=degrees)) == ["outliers", "units"]


def test_limits_of_an_outlier() -> None:
    x = np.sin(np.arange(400) / 30)
    usual = motion(x)
    for times, found in ((7.0, False), (9.5, True)):
        assert outliers(changed(x, [200], x[200] + times * usual)).any() == found
    for samples, found in ((20, True), (21, False)):
        assert outliers(changed(x, slice(200, 200 + samples), -9.0)).any() == found
    for places, found in ((10, True), (11, False)):
        assert outliers(changed(x, list(range(20, 20 + 30 * places, 30)), -9.0)).any() == found
    step = x + 5.0 * (np.arange(400) > 200)
    assert not outliers(step).any()  # a jump without a return is not an outlier
    decay = np.concatenate([np.zeros(50), 0.5 ** np.arange(50.0)])
    assert not outliers(decay).any()
    pulse = 0.01 * np.sin(np.arange(600) / 300) * (np.arange(600) > 5)
    pulse[300:308] += 0.3 * np.sin(np.pi * np.arange(8) / 7)
    assert outliers(pulse, 0.05).any() and not outliers(pulse, 0.2).any()  # fast, but possible for a machine
    assert not outliers(np.random.default_rng(2).normal(size=4000)).any()
    assert not outliers(changed(np.zeros(400), [200], 1.0)).any()  # there is no motion to compare with


def test_a_conversion_that_was_made_is_not_advised_again() -> None:
    far = 1000.0 * THETA
    said = refused(table(theta=far), degrees=True, outputs="theta")
    assert "rad/s" in said and "degrees=True" not in said and "converted to radians" in said
    counts = np.round(100 * far / STEP)
    said = refused(table(theta=counts), counts=4096, outputs="theta")
    assert "rad/s" in said and "degrees=True" not in said and "converted to radians" in said
    assert "looks like degrees; pass degrees=True" in refused(table(theta=60 * FAST), outputs="theta")


# Sampling periods


def test_a_long_sampling_period_is_refused_as_an_option_as_in_a_column() -> None:
    frame = table().drop(columns="t")
    assert "advances by 2.5 per sample, too slow" in refused(table(t=1000 * T))
    said = refused(frame, Ts=2.5)
    assert "period is 2.5 s, too slow for a joint" in said and "pass Ts=0.0025, or accept=('slow',)" in said
    y = np.column_stack([THETA, ALPHA])
    with pytest.raises(InputError, match=r"period is 2\.5 s, too slow"):
        rf.Recording(u=U, y=y, Ts=2.5)
    for options in ({"Ts": 2.5, "accept": "slow"}, {"Ts": 2.5, "time_unit": "s"}, {"Ts": 0.499}):
        assert rf.load(frame, **options).Ts == options["Ts"]
    assert rf.load(table(t=1000 * T), time_unit="s").Ts == 2.5
    assert rf.load(table(t=1000 * T), accept="units").Ts == 2.5
    assert rf.Recording(u=U, y=y, Ts=0.2).decimate(5).Ts == 1.0
    # A quantity other than an angle may be sampled slowly, such as the level of a tank.
    assert rf.load(frame, Ts=4.0, outputs={"level": "theta"}, units={"level": "V"}).Ts == 4.0


def test_an_impossible_speed_at_an_impossible_rate_names_the_unit_of_the_time() -> None:
    said = refused(table(t=1000 * T), time_unit="us")
    assert "rad/s" in said and "sampled at 400000 Hz: the unit of the time looks wrong" in said
    assert "time_unit=" in said and "degrees=True" in said
    said = refused(
        table(t=1000 * T, theta=np.rad2deg(THETA), alpha=np.rad2deg(ALPHA)), time_unit="us", degrees=True
    )
    assert "the unit of the time looks wrong" in said and "degrees=True" not in said


# Frozen sensors


def test_a_frozen_stretch_is_named_from_when_to_when() -> None:
    held = slice(2000, 2401)
    frame = table(theta=changed(THETA, held, THETA[2000]), alpha=changed(ALPHA, held, ALPHA[2000]))
    said = refused(frame)
    assert "'theta' and 'alpha' are exactly constant from 5 to 6 s while the input varies" in said
    assert "accept=('frozen',)" in said
    assert kinds(frame) == ["frozen"]
    alone = rf.Recording(u=U, y=frame["theta"], Ts=TS, start=1.0)
    assert any("'theta' is exactly constant from 6 to 7 s" in f.message for f in alone.findings)


def test_a_sensor_that_is_lost_for_long_is_named() -> None:
    said = refused(table(theta=changed(THETA - 3.0, slice(2000, 2100), 0.0)))
    assert "'theta' is exactly 0 rad from 5 to 5.2475 s, and jumps to it and away" in said


def test_an_input_that_rests_leaves_nothing_to_be_noticed() -> None:
    held = slice(2000, 2401)
    y = np.column_stack([changed(x, held, x[2000]) for x in (THETA, ALPHA)])
    assert frozen(U, y, TS) is not None
    assert frozen(changed(U, held, 0.0), y, TS) is None


@pytest.mark.parametrize("fs", [50.0, 400.0])
@pytest.mark.parametrize("place", [("coulomb", "hub"), ("stribeck", "hub"), ("joint_play", "joint")])
def test_a_machine_at_rest_and_one_that_sticks_and_slips_are_not_reported(place, fs: float) -> None:
    for kind in ("multisine", "steps", "sweep"):
        made = make_record([place], kind=kind, seed=2, seconds=10.0, fs=fs)
        for step in (STEP, 8 * STEP):
            y = np.round(made["y"] / step) * step
            # With the second input, the first 101 samples of the voltage are zero.
            for u in (made["u"], made["u"] * (np.arange(len(y)) > 100)):
                r = rf.Recording(u=u, y=y, Ts=made["Ts"], accept=quality.ACCEPTABLE)
                assert not {f.kind for f in r.findings} & set(NEW)


def test_a_joint_that_friction_holds_through_a_weak_input_is_at_rest() -> None:
    """Simulated stick-slip: the hub follows a strong input and is exactly at rest under a weak one."""
    k = np.arange(4000)
    u = np.where(k % 1000 < 500, 0.4, 3.0) * np.sin(k / 30)
    theta, speed = np.zeros(4000), 0.0
    for j in range(1, 4000):
        drive = (
            u[j - 1] - np.sign(speed) * 1.0 if speed else np.sign(u[j - 1]) * max(abs(u[j - 1]) - 1.0, 0.0)
        )
        after = 0.97 * speed + TS * 30 * drive
        speed = 0.0 if speed * after < 0 else after
        theta[j] = theta[j - 1] + TS * speed
    theta = np.round(theta / STEP) * STEP
    rests = np.flatnonzero(np.diff(theta) == 0)
    assert len(rests) > 800  # long stretches at rest while the input varies
    assert frozen(u, theta[:, None], TS) is None


def test_measured_joints_have_none_of_these_faults(measured) -> None:
    for recording in [*measured("rotflex"), *measured("rotary_arm")]:
        assert not set(NEW) & {f.kind for f in recording.findings}


def test_digests_do_not_know_the_new_faults() -> None:
    """Results are stored with digests of parts, which contain the accepted faults, so these are fixed."""
    assert quality.ACCEPTABLE[: len(quality.IN_DIGESTS)] == quality.IN_DIGESTS
    assert not set(NEW) & set(quality.IN_DIGESTS)


# A speed that is held


def motor_speed(levels: list[float], each: int = 400, rate: float = 10.0) -> np.ndarray:
    """Speed of a motor after steps of its voltage, in closed form [rad/s]."""
    speed, found = 0.0, []
    fall = np.exp(-rate * TS * np.arange(1, each + 1))
    for level in levels:
        found.append(20.0 * level + (speed - 20.0 * level) * fall)
        speed = found[-1][-1]
    return np.concatenate(found)


LEVELS = [0.0, 5.0, -5.0, 2.0, 0.0]
STEPS_OF_VOLTAGE = np.repeat(LEVELS, 400)
SPEED = motor_speed(LEVELS)
NOISY = SPEED + np.random.default_rng(3).normal(0.0, 0.2, len(SPEED))


def on_speed(x: np.ndarray) -> list[str]:
    r = rf.Recording(u=STEPS_OF_VOLTAGE, y=x, Ts=TS, channels="speed", units="rad/s")
    return [f.message for f in r.findings if f.severity != "note"]


def test_a_speed_that_is_stuck_or_at_its_limit_is_named() -> None:
    stuck = changed(NOISY, slice(900, None), NOISY[900])
    (said,) = on_speed(stuck)
    assert f"'speed' is exactly {NOISY[900]:g} rad/s from 2.25 to 4.9975 s" in said
    (said,) = on_speed(np.clip(NOISY, -60.0, 60.0))
    assert "'speed' is exactly 60 rad/s from 1.09 to" in said
    frame = pd.DataFrame({"t": TS * np.arange(len(stuck)), "voltage": STEPS_OF_VOLTAGE, "speed": stuck})
    assert "accept=('frozen',)" in refused(frame, outputs={"speed": "speed"}, units={"speed": "rad/s"})


@pytest.mark.parametrize("step", [1e-9, 1e-3, 0.1, 2.0])
def test_a_speed_that_settles_is_not_reported(step: float) -> None:
    for x in (SPEED, NOISY):
        assert on_speed(np.round(x / step) * step) == []


def test_a_speed_that_friction_brings_to_rest_is_not_cut_off() -> None:
    """It falls in proportion to the time and stops at once, here with the offset of a tacho or without."""
    one_way = np.maximum(STEPS_OF_VOLTAGE, 0.0)
    falls = SPEED[799] - 2.0 * np.arange(1, 1201)
    x = np.concatenate([SPEED[:800], np.maximum(falls, 0.0)])
    for offset, u in ((0.0, one_way), (1.3, one_way), (1.3, STEPS_OF_VOLTAGE)):
        r = rf.Recording(u=u, y=x + offset, Ts=TS, channels="speed", units="rad/s")
        assert [f.kind for f in r.findings if f.severity != "note"] == []
    rectified = rf.Recording(u=STEPS_OF_VOLTAGE, y=np.maximum(SPEED, 0.0), Ts=TS, channels="w", units="rad/s")
    assert [f.kind for f in rectified.findings if f.severity != "note"] == ["rectified"]
