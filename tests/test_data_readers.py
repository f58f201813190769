"""Readers of the recordings of the serial flexible link, the position servo and the six hobby servos."""

import dataclasses
import gzip
import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy.signal import csd, savgol_filter

import rotflex_jax as rf
from rotflex_jax.data.datasets import DATASETS, fetch, load_dataset
from rotflex_jax.data.readers import (
    ACCELERATION_SAMPLES,
    COUNT,
    GAUGE_FILTER_DAMPING,
    GAUGE_FILTER_FREQUENCY,
    GAUGE_RAD_PER_VOLT,
    SO101_JOINTS,
    link_acceleration,
    load_bam_xl330,
    load_bam_xl330_released,
    load_so101,
    load_two_dof_link,
    stages_together,
)
from rotflex_jax.data.registry import PublicDataset, PublicFile
from rotflex_jax.errors import InputError
from rotflex_jax.joints.public_machines import TWO_DOF_LINK
from rotflex_jax.mechanism import linearise
from rotflex_jax.recording import Recording

Measured = Callable[[str], list[Recording]]

SIGNALS = ("Im1", "Im2", "th11", "th12", "th21", "th22")


def low_pass(x: np.ndarray, Ts: float) -> np.ndarray:
    """The filter of the gauges, one Euler step per sample, from rest."""
    w, d = GAUGE_FILTER_FREQUENCY, GAUGE_FILTER_DAMPING
    y, v, out = 0.0, 0.0, []
    for value in x:
        out.append(y)
        y, v = y + Ts * v, v + Ts * (w**2 * (value - y) - 2 * d * w * v)
    return np.array(out)


def link_run(folder: Path) -> dict[str, np.ndarray]:
    """Write a synthetic run in both layouts; the signals before the filter are returned [deg, A]."""
    rng, k = np.random.default_rng(0), np.arange(300)
    signals = {name: rng.normal(size=300).cumsum() for name in SIGNALS}
    tables = {
        f"data_{name}": np.column_stack(
            [k / 500 + 3.0, 0 * k, low_pass(x, 0.002) if name[-1:] == "2" and name != "Im2" else x]
        )
        for name, x in signals.items()
    }
    scipy.io.savemat(folder / "run.mat", tables)
    for name in SIGNALS:
        scipy.io.savemat(folder / f"data_own_{name}.mat", {f"data_{name}": tables[f"data_{name}"]})
    return signals


def test_a_link_run_is_read_stage_by_stage_without_its_filter(tmp_path: Path) -> None:
    written = link_run(tmp_path)
    whole = load_two_dof_link(tmp_path / "run.mat")
    pieces = load_two_dof_link(tmp_path / "data_own_th21.mat")
    for stage, recording, other in zip((1, 2), whole, pieces, strict=True):
        assert (recording.N, recording.Ts, recording.start) == (298, 0.002, 3.0)
        assert (recording.input_name, recording.input_unit) == ("current", "A")
        assert (recording.channels, recording.units) == (("theta", "alpha"), ("rad", "rad"))
        assert recording.resolution["theta"] == COUNT / {1: 100, 2: 50}[stage]
        assert f"stage {stage}" in recording.source
        assert f"stage {stage}" in other.source
        np.testing.assert_array_equal(recording.u, written[f"Im{stage}"][1:-1])
        for k, channel in enumerate(recording.channels):
            in_degrees = np.rad2deg(recording.channel(channel))
            np.testing.assert_allclose(in_degrees, written[f"th{stage}{k + 1}"][:-2], atol=1e-8)
        np.testing.assert_array_equal(recording.y, other.y)
        np.testing.assert_array_equal(recording.u, other.u)


def test_a_deflection_that_is_not_measured_yet_is_left_out(tmp_path: Path) -> None:
    link_run(tmp_path)
    tables = {k: v for k, v in scipy.io.loadmat(tmp_path / "run.mat").items() if k.startswith("data_")}
    blank = np.where(np.arange(300) < 100, 0.0, 1.0 + np.sin(np.arange(300.0)))
    tables["data_th12"][:, 2] = low_pass(blank, 0.002)
    scipy.io.savemat(tmp_path / "late.mat", tables)
    first, second = load_two_dof_link(tmp_path / "late.mat")
    assert (first.N, second.N) == (198, 298)
    assert first.start == pytest.approx(3.2)
    np.testing.assert_allclose(np.rad2deg(first.y[:, 1]), blank[100:298], atol=1e-8)


def test_each_stage_has_the_acceleration_of_the_other_link(tmp_path: Path) -> None:
    written = link_run(tmp_path)
    for filtered in (False, True):
        runs = load_two_dof_link(tmp_path / "run.mat", filtered=filtered)
        for recording, run, stage in zip(runs, runs[::-1], (2, 1), strict=True):
            ((name, values),) = recording.signals.items()
            assert name == f"acceleration of link {stage} [rad/s^2]" and len(values) == recording.N
            angle = run.y.sum(axis=1)
            if not filtered:
                both = written[f"th{stage}1"] + written[f"th{stage}2"]
                np.testing.assert_allclose(np.rad2deg(angle), both[:-2], atol=1e-8)
            second, third = (savgol_filter(angle, 71, 5, n, run.Ts) for n in (2, 3))
            inside = slice(40, -40)
            np.testing.assert_allclose(values[inside], (second + 0.001 * third)[inside], rtol=1e-6)


def test_the_acceleration_of_a_link_is_that_in_the_middle_of_a_sample() -> None:
    period, w = 0.002, 2 * np.pi * 3.0
    t = period * np.arange(600)
    middle = t + period / 2
    # Polynomials of third order: exact everywhere, also where a deflection begins at sample 200.
    alpha = np.where(t >= t[200], 1.0 + 4 * t**2 - t**3, 0.0)
    found = link_acceleration(t**3 - 2 * t**2, alpha, 200, period)
    expected = 6 * middle - 4 + np.where(t >= t[200], 8 - 6 * middle, 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    # A swing at 3 Hz, below the resonance of link 2: to 1 %, and not late.
    found = link_acceleration(0.3 * np.sin(w * t), 0.1 * np.cos(w * t), 0, period)
    expected = -(w**2) * (0.3 * np.sin(w * middle) + 0.1 * np.cos(w * middle))
    inside = slice(ACCELERATION_SAMPLES, -ACCELERATION_SAMPLES)
    assert np.max(np.abs(found - expected)[inside]) < 0.01 * np.max(np.abs(expected))


def test_a_link_counts_as_its_servo_where_its_deflection_is_not_logged_yet(tmp_path: Path) -> None:
    link_run(tmp_path)
    tables = {k: v for k, v in scipy.io.loadmat(tmp_path / "run.mat").items() if k.startswith("data_")}
    k = np.arange(300)
    theta, alpha = 3e-3 * k**2, np.where(k < 100, 0.0, 50.0 - 1e-3 * k**2)  # [deg]
    tables["data_th11"][:, 2], tables["data_th12"][:, 2] = theta, low_pass(alpha, 0.002)
    scipy.io.savemat(tmp_path / "late.mat", tables)
    first, second = load_two_dof_link(tmp_path / "late.mat")
    assert (first.N, second.N) == (198, 298)
    expected = np.deg2rad(np.where(k < 100, 6e-3, 4e-3)[:298]) / 0.002**2
    np.testing.assert_allclose(second.signals["acceleration of link 1 [rad/s^2]"], expected, rtol=1e-3)
    assert len(first.signals["acceleration of link 2 [rad/s^2]"]) == 198
    tables["data_th12"][:, 2] = low_pass(np.where(k < 250, 0.0, 1.0), 0.002)
    scipy.io.savemat(tmp_path / "later.mat", tables)
    with pytest.raises(InputError, match=r"has 48 samples with the deflection of link 1, but .* needs 71"):
        load_two_dof_link(tmp_path / "later.mat")


def test_both_stages_are_one_recording_while_both_are_logged(tmp_path: Path) -> None:
    written = link_run(tmp_path)
    tables = {k: v for k, v in scipy.io.loadmat(tmp_path / "run.mat").items() if k.startswith("data_")}
    tables["data_th12"][:, 2] = low_pass(np.where(np.arange(300) < 100, 0.0, 1.0 + np.arange(300)), 0.002)
    scipy.io.savemat(tmp_path / "late.mat", tables)
    first, second = load_two_dof_link(tmp_path / "late.mat")
    both = stages_together(first, second)
    assert both.channels == rf.joints.two_stage_link().channels
    assert (both.N, both.start) == (198, pytest.approx(3.2))
    np.testing.assert_array_equal(both.u, written["Im1"][1:-1][100:])
    np.testing.assert_array_equal(both.signals["current of motor 2 [A]"], written["Im2"][1:-1][100:])
    np.testing.assert_array_equal(both.y[:, :2], first.y)
    np.testing.assert_array_equal(both.y[:, 2:], second.y[100:])
    assert both.signals.keys() == set(rf.joints.two_stage_link().signals)
    elsewhere = dataclasses.replace(second, source="other.mat, stage 2")
    for wrong in ((first, second.slice(0, 200)), (second, first), (first, elsewhere)):
        with pytest.raises(InputError, match="Stages 1 and 2 of one run are needed"):
            stages_together(*wrong)


def test_the_other_link_explains_what_a_link_does(measured: Measured) -> None:
    """Regression of the acceleration of link 2 on its deflection, its damping and the motion of link 1.

    More than 60 % of the variance is left without the motion of link 1, and less than 25 % with it.
    """
    for run in measured("two_dof_link")[1::2]:
        theta, alpha = run.y.T
        own = savgol_filter(theta + alpha, 71, 5, deriv=2, delta=run.Ts)
        spring, damping = (savgol_filter(alpha, 71, 5, deriv=n, delta=run.Ts) for n in (0, 1))
        carried = run.signals["acceleration of link 1 [rad/s^2]"]
        left = []
        for causes in ([spring, damping], [spring, damping, carried]):
            A = np.column_stack([*causes, np.ones(run.N)])[500:-100]  # from 1 s on, with all deflections
            b = own[500:-100]
            left.append(np.var(b - A @ np.linalg.lstsq(A, b, rcond=None)[0]) / np.var(b))
        assert left[0] > 0.6 and left[1] < 0.25


def test_other_files_are_not_taken_for_a_link_run(tmp_path: Path) -> None:
    link_run(tmp_path)
    scipy.io.savemat(tmp_path / "other.mat", {"data_Im1": np.ones((60, 3))})
    with pytest.raises(InputError, match="lacks data_th11, data_th12, data_Im2"):
        load_two_dof_link(tmp_path / "other.mat")
    (tmp_path / "data_own_th12.mat").unlink()
    with pytest.raises(InputError, match=r"data_own_th12\.mat does not exist"):
        load_two_dof_link(tmp_path / "data_own_Im1.mat")
    late = np.column_stack([np.arange(300) / 500 + 9.0, np.zeros(300), np.ones(300)])
    scipy.io.savemat(tmp_path / "data_own_th12.mat", {"data_th12": late})
    with pytest.raises(InputError, match="different times"):
        load_two_dof_link(tmp_path / "data_own_Im1.mat")
    narrow = dict.fromkeys((f"data_{name}" for name in SIGNALS), np.ones((60, 2)))
    scipy.io.savemat(tmp_path / "narrow.mat", narrow)
    with pytest.raises(InputError, match="lacks data_Im1, data_th11"):
        load_two_dof_link(tmp_path / "narrow.mat")
    (tmp_path / "damaged.mat").write_bytes(b"MATLAB 5.0" * 30)
    with pytest.raises(InputError, match=r"damaged\.mat cannot be read"):
        load_two_dof_link(tmp_path / "damaged.mat")


def test_the_deflections_of_the_link_lie_on_the_counts_of_their_converter(measured: Measured) -> None:
    runs = measured("two_dof_link")
    assert [run.N for run in runs] == [9998, 9998, 9217, 9617]
    for run, stage, bits in zip(runs, (1, 2, 1, 2), (16, 16, 14, 14), strict=True):
        step = GAUGE_RAD_PER_VOLT[stage] * 20 / 2**bits  # a converter of -10 V to 10 V
        assert run.resolution["alpha"] == step
        counts = (run.channel("alpha") - run.channel("alpha")[0]) / step
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
        theta = run.channel("theta") / run.resolution["theta"]
        np.testing.assert_allclose(theta, np.round(theta), atol=1e-6)


def test_the_constants_of_the_link_are_the_laboratorys(measured: Measured) -> None:
    """The linear preset is the state-space model that the laboratory stored beside its data."""
    measured("two_dof_link")
    stored = scipy.io.loadmat(fetch("two_dof_link")[0])
    for stage in (1, 2):
        linear = linearise(rf.joints.two_dof_link(stage))
        np.testing.assert_allclose(linear.A, stored[f"A{stage}"], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(linear.B, stored[f"B{stage}"][:, 0], rtol=1e-4)
        gauge = stored[f"K{stage}_strain_b"] * stored[f"K{stage}_defl_b"]
        assert GAUGE_RAD_PER_VOLT[stage] == pytest.approx(gauge.item(), rel=1e-12)
    assert stored["wcfa"].item() == pytest.approx(GAUGE_FILTER_FREQUENCY)
    assert stored["zetaf"].item() == GAUGE_FILTER_DAMPING


def test_link_1_swings_where_its_constants_say(measured: Measured) -> None:
    """The frequency of link 1 by a regression of (theta + alpha)'' = -(K / J) alpha.

    It is 0.7 to 1.1 times the frequency from the constants of the laboratory, for any motion of the hub.
    """
    constants = TWO_DOF_LINK[1]
    expected = np.sqrt(constants["stiffness"] / constants["arm_inertia"])
    for run in measured("two_dof_link")[::2]:
        theta, alpha = run.y.T
        acceleration = savgol_filter(theta + alpha, 41, 3, deriv=2, delta=run.Ts)[100:-100]
        smooth = savgol_filter(alpha, 41, 3)[100:-100]
        square = -np.polyfit(smooth, acceleration, 1)[0]
        assert 0.7 * expected < np.sqrt(square) < 1.1 * expected


def test_link_2_moves_against_its_hub_above_the_resonance(measured: Measured) -> None:
    """Above the resonance at 5.2 Hz, alpha / theta = w^2 / (w_n^2 - w^2) is negative.

    The measured phase agrees, but not where the filter of the gauges is left in the data.
    """
    measured("two_dof_link")
    logged = [load_two_dof_link(path, filtered=True)[1] for path in fetch("two_dof_link")[:2]]
    for run, behind in zip(measured("two_dof_link")[1::2], logged, strict=True):
        cosines = []
        for each in (run, behind):
            f, cross = csd(*each.y.T, fs=1 / each.Ts, nperseg=2500)
            band = cross[(f > 6.2) & (f < 7.7)].sum()
            cosines.append(np.cos(np.angle(band)))
        assert cosines[0] < -0.95
        assert cosines[1] > 0.8


def test_the_motors_of_the_link_do_work(measured: Measured) -> None:
    for run, stage in zip(measured("two_dof_link"), (1, 2, 1, 2), strict=True):
        torque = TWO_DOF_LINK[stage]["torque_per_current"] * run.u
        speed = savgol_filter(run.channel("theta"), 21, 3, deriv=1, delta=run.Ts)
        assert np.mean(torque * speed) > 0  # friction dissipates the power of the motor
        # The speed is at most the no-load speed at 28 V, by the constants of the maker.
        assert np.max(np.abs(speed)) < {1: 28 / 0.119 / 100, 2: 28 / 0.0232 / 50}[stage]


def test_no_third_stage() -> None:
    with pytest.raises(InputError, match="stages 1 and 2"):
        rf.joints.two_dof_link(3)


def servo_run(path: Path, samples: int = 200, **changes: Any) -> np.ndarray:
    """Write a synthetic log at uneven times, linear in time; its times are returned [s]."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.005, 0.007, samples))
    entries = [
        {"timestamp": time, "goal_position": 2 * time, "position": time - 1, "torque_enable": k < 150}
        for k, time in enumerate(t)
    ]
    run = {"trajectory": "ramp", "kp": 300, "entries": entries} | changes
    path.write_text(json.dumps(run))
    return t


def test_a_servo_log_is_resampled_and_ends_with_the_torque(tmp_path: Path) -> None:
    t = servo_run(tmp_path / "run.json")
    run = load_bam_xl330(tmp_path / "run.json")
    assert (run.Ts, run.start, run.channels) == (0.005, t[0], ("theta",))
    assert (run.input_name, run.input_unit, run.units) == ("goal", "rad", ("rad",))
    assert t[149] - 0.005 < run.t[-1] <= t[149] + 1e-9
    np.testing.assert_allclose(run.u, 2 * run.t, atol=1e-12)
    np.testing.assert_allclose(run.y[:, 0], run.t - 1, atol=1e-12)
    assert dict(run.constants) == {"hub.position_servo.gain": 300.0}
    for word in ("ramp", "gain 300", "resampled to 5 ms", "torque is off"):
        assert word in run.source
    assert load_bam_xl330_released(tmp_path / "run.json") is None  # off for less than a second
    t = servo_run(tmp_path / "long.json", samples=400)
    rest = load_bam_xl330_released(tmp_path / "long.json")
    assert rest is not None and rest.start == t[150] and t[-1] - 0.005 < rest.t[-1] <= t[-1] + 1e-9
    np.testing.assert_allclose(rest.y[:, 0], rest.t - 1, atol=1e-12)
    assert dict(rest.constants) == {"hub.position_servo.gain": 300.0, "hub.position_servo.enabled": 0.0}
    # It ends where the torque is on again.
    run = json.loads((tmp_path / "long.json").read_text())
    for entry in run["entries"][380:]:
        entry["torque_enable"] = True
    (tmp_path / "again.json").write_text(json.dumps(run))
    rest = load_bam_xl330_released(tmp_path / "again.json")
    assert rest is not None and rest.start == t[150] and t[379] - 0.005 < rest.t[-1] <= t[379] + 1e-9


@pytest.mark.parametrize(
    "changes", [{"entries": [{"timestamp": 0.0}]}, {"entries": None}, {"entries": []}], ids=str
)
def test_other_files_are_not_taken_for_a_servo_log(tmp_path: Path, changes: dict[str, Any]) -> None:
    servo_run(tmp_path / "run.json", **changes)
    with pytest.raises(InputError, match=r"run\.json"):
        load_bam_xl330(tmp_path / "run.json")


def test_a_servo_log_with_a_gap_is_refused(tmp_path: Path) -> None:
    servo_run(tmp_path / "run.json")
    run = json.loads((tmp_path / "run.json").read_text())
    run["entries"] = run["entries"][:50] + run["entries"][60:]
    (tmp_path / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match="without a gap"):
        load_bam_xl330(tmp_path / "run.json")
    run["entries"] = [entry for entry in run["entries"] if not entry["torque_enable"]]
    (tmp_path / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match="torque is off in the first sample"):
        load_bam_xl330(tmp_path / "run.json")
    (tmp_path / "run.json").write_text("t,u\n0,1")
    with pytest.raises(InputError, match="cannot be read as a log"):
        load_bam_xl330(tmp_path / "run.json")


def test_a_released_arm_swings_about_its_lowest_point(measured: Measured) -> None:
    """Four of twelve logs have a part without torque, in which the servo does not hold the arm.

    The half period there is that of a small swing of the pendulum, to 15 %.
    """
    measured("bam_xl330")
    runs = [load_bam_xl330_released(path) for path in rf.data.fetch("bam_xl330")]
    released = [r for r in runs if r is not None]
    assert len(runs) == 12 and len(released) == 4
    for r in released:
        angle = r.y[:, 0]
        assert r.N * r.Ts == pytest.approx(4.0, abs=0.02) and abs(angle[-1]) < 0.06
        turns = np.flatnonzero(np.diff(np.sign(angle - angle[-1])))
        half = np.pi * np.sqrt(0.0069 / (0.49 * 9.81 * 0.1))  # of a small swing [s]
        assert len(turns) >= 4 and np.median(np.diff(turns[:4])) * r.Ts == pytest.approx(half, rel=0.15)
        assert r.constants["hub.position_servo.enabled"] == 0.0


def test_the_servo_follows_better_with_more_gain(measured: Measured) -> None:
    runs = measured("bam_xl330")
    assert len(runs) == 12
    assert {run.Ts for run in runs} == {0.005}
    for name, samples in (("sin_sin", 1200), ("lift_and_drop", 400), ("sin_time_square", 1200)):
        chosen = [run for run in runs if name in run.source]
        assert [f"gain {kp}" in run.source for run, kp in zip(chosen, (100, 200, 400, 800), strict=True)]
        errors = [np.sqrt(np.mean((run.u - run.y[:, 0]) ** 2)) for run in chosen]
        assert errors == sorted(errors, reverse=True)
        for run in chosen:
            assert pytest.approx(samples, abs=1) == run.N
            assert run.resolution == {"theta": COUNT}
            np.testing.assert_allclose(run.u, chosen[0].u, atol=0.03)  # one trajectory for all gains
    # A goal was computed 3.5 ms before the position beside it was read.
    for run in runs:
        if "sin_time_square" in run.source:
            np.testing.assert_allclose(run.u, np.sin((run.t - 0.0035) ** 2), atol=0.015)


def so101_motion(folder: Path, ending: str = "", joints: int = 6) -> np.ndarray:
    """Write a synthetic motion, linear in time; its times are returned [s]."""
    folder.mkdir(exist_ok=True)
    t = np.cumsum(np.random.default_rng(2).uniform(0.0199, 0.0202, 100))
    slopes = np.arange(joints, dtype=float)  # the goal of the first joint does not change
    for log, offset in (("control", 0.0), ("state_motor", 0.5)):
        lines = ["type,timestamp,positions"]
        lines += [f'{log.upper()},{time * 1e6},"{(slopes * time + offset).tolist()}"' for time in t]
        content = "\n".join(lines).encode()
        packed = gzip.compress(content) if ending else content
        (folder / f"wave.{log}.csv{ending}").write_bytes(packed)
    return t


def test_a_motion_is_read_joint_by_joint_packed_or_not(tmp_path: Path) -> None:
    t = so101_motion(tmp_path / "plain")
    so101_motion(tmp_path / "packed", ".gz")
    plain = load_so101(tmp_path / "plain" / "wave.control.csv")
    packed = load_so101(tmp_path / "packed" / "wave.state_motor.csv.gz")
    assert len(plain) == len(packed) == 5
    for k, (run, other) in enumerate(zip(plain, packed, strict=True), start=1):
        np.testing.assert_array_equal(run.y, other.y)
        np.testing.assert_array_equal(run.u, other.u)
        np.testing.assert_allclose(run.u, k * run.t, atol=1e-12)
        np.testing.assert_allclose(run.y[:, 0], k * run.t + 0.5, atol=1e-12)
        assert f"wave, {SO101_JOINTS[k]}," in run.source
        assert (run.start, run.input_name) == (t[0], "goal")
        assert run.input_unit == run.units[0] == ("" if k == 5 else "rad")


def test_other_files_are_not_taken_for_a_motion(tmp_path: Path) -> None:
    so101_motion(tmp_path / "five", joints=5)
    with pytest.raises(InputError, match="positions of 6 joints"):
        load_so101(tmp_path / "five" / "wave.control.csv")
    so101_motion(tmp_path / "half", ".gz")
    damaged = tmp_path / "half" / "wave.state_motor.csv.gz"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(InputError, match="packed by gzip"):
        load_so101(tmp_path / "half" / "wave.control.csv.gz")
    damaged.unlink()
    with pytest.raises(InputError, match=r"wave\.state_motor\.csv does not exist"):
        load_so101(tmp_path / "half" / "wave.control.csv.gz")
    (tmp_path / "log.control.csv").write_text("t,u\n0,1\n")
    with pytest.raises(InputError, match="cannot be read as a log"):
        load_so101(tmp_path / "log.control.csv")


def test_the_six_servos_follow_their_goals(measured: Measured) -> None:
    runs = measured("so101")
    assert len(runs) == 35
    assert {run.Ts for run in runs} == {0.02006}
    for run in runs:
        jaw = "Jaw" in run.source
        assert run.duration > 40
        assert run.resolution["theta"] == (1 / 1523 if jaw else COUNT)
        theta = run.y[:, 0]
        late = [np.corrcoef(run.u[: run.N - k], theta[k:])[0, 1] for k in range(3, 60)]
        assert max(late) > 0.78
        assert max(late) > np.corrcoef(run.u, theta)[0, 1]  # the position is later than the goal
        assert 0.6 < np.std(theta) / np.std(run.u) < 1.0
    binary = [run for run in runs if run.source.startswith("prbs")]
    for run in binary:
        high, low = run.u.max(), run.u.min()
        assert high - low == pytest.approx(0.24)
        assert np.mean(np.minimum(high - run.u, run.u - low) < 0.001) > 0.95
    elbow = [run.source.split(", ")[1] for run in runs if run.source.startswith("single_joint_elbow")]
    assert elbow == ["Pitch", "Elbow"]


def test_the_steps_of_the_six_servos_are_those_of_their_logs(measured: Measured) -> None:
    measured("so101")
    states = [path for path in fetch("so101") if "state_motor" in path.name]
    for path in states[:2]:
        content = path.read_bytes()
        text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
        positions = np.array([json.loads(line.split('"')[1]) for line in text.splitlines()[1:]])
        steps = np.array([COUNT] * 5 + [1 / 1523])
        counts = 2 * positions / steps  # the middle of some joints lies between two counts
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


def test_a_packed_file_stands_for_the_original(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    so101_motion(tmp_path / "so101")
    files = []
    for log in ("control", "state_motor"):
        path = tmp_path / "so101" / f"wave.{log}.csv"
        digest = sha256(path.read_bytes()).hexdigest()
        files.append(PublicFile(f"so101/{path.name}", "a/b", "0" * 40, "x", digest, log == "state_motor"))
    own = PublicDataset("own", "a motion", "rad", "MIT", "this test", tuple(files), load_so101)
    monkeypatch.setitem(DATASETS, "own", own)
    plain = load_dataset("own", tmp_path)
    assert len(plain) == 5  # the companion file is not read as another motion
    for file in files:
        path = tmp_path / file.name
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    packed = load_dataset("own", tmp_path)
    for run, other in zip(plain, packed, strict=True):
        np.testing.assert_array_equal(run.y, other.y)
    path = tmp_path / f"{files[0].name}.gz"
    path.write_bytes(gzip.compress(b"another file"))
    with pytest.raises(InputError, match="SHA-256"):
        fetch("own", tmp_path)
    path.write_bytes(b"no gzip")
    with pytest.raises(InputError, match="packed by gzip"):
        fetch("own", tmp_path)
