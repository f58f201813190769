"""Readers of the public recordings: from a file, or the files of one run, to Recordings.

Angles become radians. A log with uneven sampling times is resampled, and its `source` states this.
"""

import csv
import gzip
import json
import math
import os
import zlib
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rotflex_jax.data.binary import read_mat
from rotflex_jax.data.files import readable_file
from rotflex_jax.data.tables import unreadable
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import even_spacing
from rotflex_jax.recording.smoothing import smoothed

LABORATORY = MappingProxyType(
    {
        "R_m": (2.6, "ohm"),
        "k_t": (0.00768, "N m/A"),
        "k_m": (0.00768, "V s/rad"),
        "K_g": (70.0, "-"),
        "eta_g": (0.9, "-"),
        "eta_m": (0.69, "-"),
        "B_hub": (0.004, "N m s/rad"),
        "J_hub": (0.002584, "kg m^2"),
        "J_arm": (0.003894, "kg m^2"),
        "K": (1.0142, "N m/rad"),
    }
)
"""Parameters given by the laboratory: name -> value and unit; dry friction is not among them."""

COUNT = 2 * math.pi / 4096
"""One count of the encoders [rad]."""


def load_rotflex(path: str | os.PathLike[str]) -> Recording:
    """Reads one ROTFLEX run: motor voltage, servo angle and deflection, converted from degrees to radians.

    A student laboratory logged two closed-loop runs at 500 Hz with 4096-count encoders. The reference is a
    square wave of 30 degrees; one run has feedback of theta, the other of theta + alpha. Between the steps
    dry friction holds the hub at rest, away from the reference.

    Args:
        path: path of the MAT file.

    Returns:
        The recording with the channels theta and alpha [rad].

    Raises:
        InputError: the file is missing or damaged, or lacks the variables of such a run.
    """
    file = readable_file(path)
    variables = read_mat(file)
    missing = {"data_vm", "data_theta", "data_alpha"} - set(variables)
    if missing:
        raise InputError(
            f"{file.name} lacks {', '.join(sorted(missing))}, which the public ROTFLEX runs have; "
            "read another file with load(path, input=..., outputs=...)."
        )
    t, u = np.asarray(variables["data_vm"], dtype=np.float64).T
    theta = np.asarray(variables["data_theta"])[:, 2]  # time, reference, measured
    alpha = np.asarray(variables["data_alpha"])[:, 1]
    return Recording(
        u=u,
        y=np.deg2rad(np.column_stack([theta, alpha])),
        Ts=even_spacing(t, f"{file.name}: the time"),
        source=file.name,
        start=float(t[0]),
        resolution={"theta": COUNT, "alpha": COUNT},
    )


ARM_LENGTH = 0.45
"""Distance from the hub to the tip of the rotary arm [m]."""


def load_emps(path: str | os.PathLike[str]) -> Recording:
    """Reads a run of the Electro-Mechanical Positioning System: motor voltage to position.

    The force is 35.1507 N per volt. Protocol: free run, the first 20 samples for initialisation.

    Args:
        path: path of the MAT file.

    Returns:
        The recording with the channel position [m].

    Source:
        Janot, Gautier, Brunot 2019, Data set and reference models of EMPS.
    """
    file = readable_file(path)
    variables = read_mat(file)
    return Recording(
        u=variables["vir"],
        y=variables["qm"],
        Ts=even_spacing(np.asarray(variables["t"]), f"{file.name}: the time"),
        channels=("position",),
        units=("m",),
        n_init=20,
        source=file.name,
    )


def load_silverbox(path: str | os.PathLike[str]) -> list[Recording]:
    """Reads the Silverbox, an electronic oscillator with a cubic spring: voltage to voltage.

    Protocol: free run, the first 50 samples for initialisation.

    Args:
        path: path of the MAT file.

    Returns:
        The official parts with the channel output [V]: a multisine for training, one for testing, an arrow
        of growing amplitude, and the arrow without amplitudes beyond those of the first part.

    Source:
        Wigren, Schoukens 2013, Three free data sets for development and benchmarking in nonlinear
        system identification.
    """
    file = readable_file(path)
    variables = read_mat(file)
    whole = Recording(
        u=variables["V1"],
        y=variables["V2"],
        Ts=1 / 610.35,
        channels=("output",),
        units=("V",),
        n_init=50,
        source=file.name,
    )
    ranges = {
        "multisine": (40650, 105712),
        "multisine, held out": (105712, 127400),
        "arrow": (100, 40575),
        "arrow without extrapolation": (100, 32100),
    }
    return [replace(whole.slice(i, j), source=f"{file.name}, {part}") for part, (i, j) in ranges.items()]


def load_rotary_arm(path: str | os.PathLike[str]) -> Recording:
    """Reads a run of a geared motor with a rigid or a flexible arm, rounded to 1 mrad and 1 mm.

    Motor constants: gear ratio 48.4, 0.0107 N m/A, 3.29 ohm. The time is in milliseconds, although the header
    may state another unit. The tip of the flexible arm was measured as a distance, which is positive when the
    tip lags behind the hub: after a step of the voltage it has the sign of the hub's motion. The deflection
    is `alpha = -tip / 0.45 m`, so that theta + alpha points at the tip.

    Args:
        path: path of the text file.

    Returns:
        The recording with the channel theta [rad] and, for the flexible arm, alpha [rad].
    """
    file = readable_file(path)
    t, theta, tip, *_ = columns = np.loadtxt(file, skiprows=1).T
    flexible = bool(np.any(tip))
    alpha = -tip / ARM_LENGTH
    return Recording(
        u=columns[6],
        y=np.column_stack([theta, alpha] if flexible else [theta]),
        Ts=even_spacing(t / 1000, f"{file.name}: the time"),
        source=file.name,
        resolution={"theta": 1e-3, **({"alpha": 1e-3 / ARM_LENGTH} if flexible else {})},
    )


LINK_STEP = MappingProxyType({1: COUNT / 100, 2: COUNT / 50})
"""Encoder step of each stage of the two-link machine, at the output of its gear [rad]."""

GAUGE_RAD_PER_VOLT = MappingProxyType({1: 1.286e-4 * 106.03674540682414, 2: 1.235e-4 * 151.36857892763405})
"""Deflection of each link per volt of its strain gauge, from the laboratory's file [rad/V]."""

GAUGE_FILTER_FREQUENCY, GAUGE_FILTER_DAMPING = 4 * math.pi, 0.9
"""Frequency (2 Hz) [rad/s] and damping ratio of the low-pass filter through which deflections were logged."""

ACCELERATION_SAMPLES, ACCELERATION_DEGREE = 71, 5
"""Length (0.14 s at 500 Hz) and degree of the local polynomials that give the acceleration of a link.

They keep 97 % of the acceleration at 5 Hz, where link 2 oscillates, 70 % at 10 Hz, and almost nothing above
20 Hz, where the gauges have noise. Cubic polynomials over 0.08 s pass as much noise, but keep only 89 % and
61 %.
"""


def load_two_dof_link(path: str | os.PathLike[str], *, filtered: bool = False) -> list[Recording]:
    """Reads a run of the serial link with two flexible stages: motor current to servo angle and deflection.

    A run is one file with all signals, or six files with one signal each; give any of the six. The input is
    the measured current. The converter reads the current before it writes the next command, so reading k + 1
    is the current that is held from sample k on.

    The deflections were logged through a second-order low-pass filter (2 Hz, damping ratio 0.9), integrated
    by Euler's method at 2 ms. This filter is inverted sample by sample, without any loss: the result lies on
    the counts of the converter again. At the beginning, until the offset of the gauge was determined, the log
    has a deflection of zero; this beginning is left out.

    Stage 2 is mounted on link 1 and reacts on it. Therefore each recording has the acceleration of the other
    link as a signal; the acceleration of link 2 is relative to link 1. It is the second derivative of
    theta + alpha of the other stage, in the middle of each sample, from local polynomials that reach 0.07 s
    ahead. As long as the deflection of the other stage is not logged, it is the second derivative of theta
    alone. It is less accurate for 0.07 s after the beginning of theta or alpha, and before their end.

    Args:
        path: path of a MAT file.
        filtered: whether to keep the deflections as they were filtered, also in the signals.

    Returns:
        A recording of stage 1 and a recording of stage 2, with the channels theta and alpha [rad]. Both end
        two samples before the end of the file. They have the signals "acceleration of link 2 [rad/s^2]" and
        "acceleration of link 1 [rad/s^2]".

    Raises:
        InputError: the file is missing or damaged, or lacks the variables of such a run.
    """
    file = readable_file(path)
    kind, _, signal = file.stem.rpartition("_")
    names = [f"data_{part}{stage}{k}" for stage in (1, 2) for part, k in (("Im", ""), ("th", 1), ("th", 2))]
    parts = [name.removeprefix("data_") for name in names]
    files = [file.with_name(f"{kind}_{part}.mat") for part in parts] if signal in parts else [file]
    variables: dict[str, Any] = {}
    for each in files:
        variables |= read_mat(readable_file(each))
    label = f"{kind}_*.mat" if signal in parts else file.name
    missing = [name for name in names if np.shape(variables.get(name, 0.0))[1:] != (3,)]
    if missing:
        raise InputError(
            f"{label} lacks {', '.join(missing)}, which a run of the two-link machine has; "
            "read another file with load(path, input=..., outputs=...)."
        )
    # Each signal has the columns: time, reference or command, measurement.
    signals = {
        part: np.asarray(variables[name], dtype=float) for part, name in zip(parts, names, strict=True)
    }
    t = signals["Im1"][:, 0]
    if any(not np.array_equal(x[:, 0], t) for x in signals.values()):
        raise InputError(f"{label}: the signals have different times; take all files from one run.")
    period = even_spacing(t, f"{label}: the time")
    stages: dict[int, tuple[np.ndarray, np.ndarray, int]] = {}
    for stage in (1, 2):
        theta, logged = (np.deg2rad(signals[f"th{stage}{k}"][:, 2]) for k in (1, 2))
        deflection = _before_gauge_filter(logged, period)
        first = int(np.argmax(deflection != 0))
        stages[stage] = theta[:-2], logged[:-2] if filtered else deflection, first
        if len(theta) - 2 - first < ACCELERATION_SAMPLES:
            raise InputError(
                f"{label} has {len(theta) - 2 - first} samples with the deflection of link {stage}, but its "
                f"acceleration needs {ACCELERATION_SAMPLES}; take a longer run."
            )
    recordings = []
    for stage, other in ((1, 2), (2, 1)):
        theta, alpha, first = stages[stage]
        alpha, acceleration = alpha[first:], link_acceleration(*stages[other], period)
        recordings.append(
            Recording(
                u=signals[f"Im{stage}"][1:-1, 2][first:],
                y=np.column_stack([theta[first:], alpha]),
                Ts=period,
                input_name="current",
                input_unit="A",
                source=f"{label}, stage {stage}, deflection {'behind' if filtered else 'before'} its filter",
                start=float(t[first]),
                resolution={
                    "theta": LINK_STEP[stage],
                    "alpha": None if filtered else _gauge_step(alpha, stage),
                },
                signals={f"acceleration of link {other} [rad/s^2]": acceleration[first:]},
            )
        )
    return recordings


def stages_together(first: Recording, second: Recording) -> Recording:
    """Both stages of a run from `load_two_dof_link` as one recording, over the time that both have.

    Args:
        first: Recording of stage 1; its current is the input.
        second: Recording of stage 2; its current is the signal "current of motor 2 [A]".

    Returns:
        A recording with the channels theta1, alpha1, theta2, alpha2 for `joints.two_stage_link`.

    Raises:
        InputError: The recordings are not stages 1 and 2 of one run.
    """
    ends = [r.start + r.N * r.Ts for r in (first, second)]
    files, stages = zip(*(r.source.split(", ")[:2] for r in (first, second)), strict=True)
    same = first.Ts == second.Ts and abs(ends[0] - ends[1]) <= first.Ts / 2 and files[0] == files[1]
    if not same or stages != ("stage 1", "stage 2"):
        raise InputError(
            f"Stages 1 and 2 of one run are needed, but {first.source!r} to {ends[0]:g} s and "
            f"{second.source!r} to {ends[1]:g} s were given; give both of one file, stage 1 first."
        )
    N = min(first.N, second.N)
    first, second = (r.slice(r.N - N, r.N) for r in (first, second))
    channels = [f"{name}{stage}" for stage in (1, 2) for name in first.channels]
    return Recording(
        u=first.u,
        y=np.column_stack([first.y, second.y]),
        Ts=first.Ts,
        channels=channels,
        units=(*first.units, *second.units),
        input_name=first.input_name,
        input_unit=first.input_unit,
        source=f"{first.source.partition(',')[0]}, both stages",
        start=first.start,
        resolution=dict(
            zip(channels, (*first.resolution.values(), *second.resolution.values()), strict=True)
        ),
        signals={"current of motor 2 [A]": second.u},
    )


def link_acceleration(
    theta: Float[np.ndarray, " N"], alpha: Float[np.ndarray, " N"], first: int, Ts: float
) -> Float[np.ndarray, " N"]:
    """Acceleration of the end of a link, theta + alpha, in the middle of each sample [rad/s^2].

    Args:
        theta: Angle of the servo [rad].
        alpha: Deflection [rad].
        first: First sample with a deflection; before it, the deflection counts as constant.
        Ts: Sampling period [s].
    """
    acceleration = _acceleration(theta, Ts)
    acceleration[first:] += _acceleration(alpha[first:], Ts)
    return acceleration


def _acceleration(x: Float[np.ndarray, " N"], Ts: float) -> Float[np.ndarray, " N"]:
    """Second derivative in the middle of each sample, from the local polynomial around that sample."""
    there, change = (smoothed(x, ACCELERATION_SAMPLES, ACCELERATION_DEGREE, n, Ts) for n in (2, 3))
    return there + Ts / 2 * change


def _before_gauge_filter(y: Float[np.ndarray, " N"], Ts: float) -> Float[np.ndarray, " N-2"]:
    """Input x of the filter `y' = v, v' = w^2 (x - y) - 2 d w v`, integrated by Euler's method."""
    w, d = GAUGE_FILTER_FREQUENCY, GAUGE_FILTER_DAMPING
    v = np.diff(y) / Ts
    return y[:-2] + (np.diff(v) / Ts + 2 * d * w * v[:-1]) / w**2


def _gauge_step(alpha: Float[np.ndarray, " N"], stage: int) -> float | None:
    """Step of the deflection from a converter of 20 V with 14 or 16 bits [rad]; None if there is no step."""
    steps = [GAUGE_RAD_PER_VOLT[stage] * 20 / 2**bits for bits in (14, 16)]
    counts = [(alpha - alpha[0]) / step for step in steps]  # without the offset of the gauge
    fits = (step for step, n in zip(steps, counts, strict=True) if np.max(np.abs(n - np.round(n))) < 0.01)
    return next(fits, None)


SERVO = "hub.position_servo"
"""Port and name of the firmware effect in the ready-made servos."""

BAM_PERIOD = 0.005
"""Sampling period to which logs of the XL-330 are resampled; they were sampled every 5.1 to 7.1 ms [s]."""


def load_bam_xl330(path: str | os.PathLike[str]) -> Recording:
    """Reads a run of a position servo that lifts a pendulum: goal angle to angle.

    Goal and angle were logged together, at uneven times, and are resampled to 5 ms by linear
    interpolation. When the torque is switched off, the arm falls freely. The recording ends there;
    `load_bam_xl330_released` reads the rest.

    Args:
        path: path of the JSON file.

    Returns:
        The recording with the input goal [rad] and the channel theta [rad]. Its `constants` are the gain and
        the supply of the servo, under the parameter names of `rotflex_jax.joints.xl330_pendulum`.

    Raises:
        InputError: the file is missing or damaged, or is no log of such a run.

    Source:
        Duclusaud, Passault, Padois, Ly 2024, Extended friction models for the physics simulation of servo
        actuators, arXiv 2410.08650.
    """
    log = _bam_log(path)
    if not log.on[0]:
        raise InputError(
            f"{log.file} must begin with the torque on, but its torque is off in the first sample; "
            "take another run, or read it by load_bam_xl330_released."
        )
    end = len(log.on) if log.on.all() else int(np.argmin(log.on))
    note = "" if end == len(log.on) else ", up to where the torque is off"
    return log.recording(slice(0, end), note, {})


def load_bam_xl330_released(path: str | os.PathLike[str]) -> Recording | None:
    """Reads the rest of a run of `load_bam_xl330`, after the torque is switched off: the arm falls freely.

    Args:
        path: path of the JSON file.

    Returns:
        The recording, with the constant `hub.position_servo.enabled` zero, for a servo with this parameter
        (`rotflex_jax.joints.servo`). None if the torque is never off, or for less than a second.

    Raises:
        InputError: as `load_bam_xl330`.

    Source:
        As `load_bam_xl330`.
    """
    log = _bam_log(path)
    off = np.flatnonzero(~log.on)
    if not len(off):
        return None
    after = np.flatnonzero(log.on[off[0] :])
    part = slice(int(off[0]), int(off[0] + after[0]) if len(after) else len(log.on))
    if log.t[part][-1] - log.t[part][0] < 1.0:
        return None
    return log.recording(part, ", where the torque is off", {f"{SERVO}.enabled": 0.0})


class _BamLog(NamedTuple):
    """A run of the XL-330 as it was logged.

    Attributes:
        file: name of the file.
        what: motion and gain, in words.
        t: times [s].
        goal: goal [rad].
        theta: angle [rad].
        on: whether the torque is on.
        settings: full name of a parameter -> setting of the servo.
    """

    file: str
    what: str
    t: Float[np.ndarray, " N"]
    goal: Float[np.ndarray, " N"]
    theta: Float[np.ndarray, " N"]
    on: Bool[np.ndarray, " N"]
    settings: dict[str, float]

    def recording(self, part: slice, note: str, further: dict[str, float]) -> Recording:
        """A part of the run, resampled."""
        t, Ts = self.t[part], BAM_PERIOD
        return Recording(
            u=_resampled(t, self.goal[part], Ts, self.file),
            y=_resampled(t, self.theta[part], Ts, self.file),
            Ts=Ts,
            input_name="goal",
            input_unit="rad",
            source=f"{self.what}, resampled to 5 ms{note}",
            start=float(t[0]),
            accept="constant_input" if further else (),  # without torque the goal moves nothing
            resolution={"theta": COUNT},
            constants=self.settings | further,
        )


def _bam_log(path: str | os.PathLike[str]) -> _BamLog:
    file = readable_file(path)
    try:
        run = json.loads(file.read_text(encoding="utf-8"))
        entries = run["entries"]
        on = np.array([bool(entry["torque_enable"]) for entry in entries], dtype=bool)
        columns = ("timestamp", "goal_position", "position")
        t, goal, theta = np.array([[entry[name] for name in columns] for entry in entries], dtype=float).T
        what = f"{file.name}, {run['trajectory']}, gain {run['kp']}"
        known = {"gain": run["kp"]} | ({"supply": run["vin"]} if "vin" in run else {})
        settings = {f"{SERVO}.{name}": float(value) for name, value in known.items()}
    except (ValueError, KeyError, TypeError) as error:
        raise unreadable(file, "a log of the XL-330", error) from error
    return _BamLog(file.name, what, t, goal, theta, on, settings)


SO101_JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
"""Joints of the SO-101 arm, in the order of its logs."""

SO101_PERIOD = 0.02006
"""Sampling period to which logs of the SO-101 are resampled, the mean of their own periods [s]."""

JAW_STEP = 1 / 1523
"""Quantisation step of the jaw, whose position is a share of its travel of 1523 counts."""


def load_so101(path: str | os.PathLike[str]) -> list[Recording]:
    """Reads a motion of the six servos of an SO-101 arm: goal angle to angle, joint by joint.

    A motion is two files, `*.control.csv` and `*.state_motor.csv`, plain or packed by gzip; give either. Both
    have the same sampling times, whose period varies by up to 1 %: goals and angles are resampled to 20.06 ms
    by linear interpolation. A joint whose goal does not change has no recording. Positions of the jaw are a
    share of its travel, from 0 to 1, although the log may state another unit. A servo may move at full speed
    and then stop at once, which looks like a saturated sensor; this finding is accepted.

    Args:
        path: path of one of the two files.

    Returns:
        The recordings with the input goal [rad] and the channel theta [rad], both without a unit for the jaw.
        Their `source` names the motion and the joint.

    Raises:
        InputError: a file is missing or damaged, or is no log of such a motion.
    """
    file = readable_file(path)
    motion = file.name.partition(".")[0]
    t, goals = _so101_table(_packed_or_not(file.with_name(f"{motion}.control.csv")))
    stamps, angles = _so101_table(_packed_or_not(file.with_name(f"{motion}.state_motor.csv")))
    if not np.array_equal(t, stamps):
        raise InputError(f"{motion}: goals and angles have different times; take both files from one motion.")
    recordings = []
    for joint, goal, theta in zip(SO101_JOINTS, goals.T, angles.T, strict=True):
        if np.ptp(goal) == 0:
            continue
        unit, step = ("", JAW_STEP) if joint == "Jaw" else ("rad", COUNT)
        recordings.append(
            Recording(
                u=_resampled(t, goal, SO101_PERIOD, motion),
                y=_resampled(t, theta, SO101_PERIOD, motion),
                Ts=SO101_PERIOD,
                units=unit,
                input_name="goal",
                input_unit=unit,
                source=f"{motion}, {joint}, resampled to 20.06 ms",
                start=float(t[0]),
                accept="saturated",
                resolution={"theta": step},
            )
        )
    return recordings


def _so101_table(path: Path) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 6"]]:
    """Time [s] and positions [rad] of a log."""
    try:
        rows = list(csv.DictReader(unpacked(path).decode().splitlines()))
        t = np.array([float(row["timestamp"]) for row in rows]) * 1e-6
        positions = np.array([json.loads(row["positions"]) for row in rows], dtype=float)
        if positions.ndim != 2 or positions.shape[1] != len(SO101_JOINTS):
            raise ValueError(f"there must be positions of {len(SO101_JOINTS)} joints")
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise unreadable(path, "a log of the SO-101", error) from error
    return t, positions


def _packed_or_not(path: Path) -> Path:
    """The path of the file, or of its version packed by gzip in the same folder."""
    packed = path.with_name(f"{path.name}.gz")
    return readable_file(packed if packed.exists() and not path.exists() else path)


def unpacked(path: Path) -> bytes:
    """Content of a file, unpacked if its name ends in .gz.

    Raises:
        InputError: a packed file that is damaged.
    """
    if path.suffix != ".gz":
        return path.read_bytes()
    try:
        return gzip.decompress(path.read_bytes())
    except (OSError, EOFError, zlib.error) as error:
        raise unreadable(path, "a file packed by gzip", error) from error


def _resampled(t: Float[np.ndarray, " N"], x: Float[np.ndarray, " N"], Ts: float, label: str) -> np.ndarray:
    """A signal with uneven times, interpolated linearly at even times from the first sample on."""
    steps = np.diff(t)
    if len(t) < 2 or steps.min() <= 0 or steps.max() > 2 * np.median(steps):
        raise InputError(
            f"{label} must have times that increase without a gap of two samples, but has not; "
            "take the original file."
        )
    return np.interp(t[0] + Ts * np.arange(int((t[-1] - t[0]) / Ts + 1e-6) + 1), t, x)
