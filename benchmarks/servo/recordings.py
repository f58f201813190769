"""The recordings of the XL-330, their division into training and test data, and errors of free runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.measured import SHARE
from rotflex_jax.effects.motor import DYNAMIXEL_GAIN_SCALE
from servo.friction_models import GRAVITY, Logs

MASS, LENGTH = 0.49, 0.1
GAINS = (100, 200, 400, 800)
MOTIONS = ("sin_sin", "lift_and_drop", "sin_time_square")


def gain(recording: rf.Recording) -> int:
    """P gain of the firmware."""
    return round(recording.constants["hub.position_servo.gain"])


def motion(recording: rf.Recording) -> str:
    """Name of the motion."""
    return next(name for name in MOTIONS if f" {name}," in recording.source)


@dataclasses.dataclass(frozen=True)
class Split:
    """Recordings for training and for the test.

    Attributes:
        name: Motion or gain that is left out of the training.
        train: Training recordings.
        test: Test recordings: all with the motion or gain that is left out.
    """

    name: str
    train: tuple[rf.Recording, ...]
    test: tuple[rf.Recording, ...]

    @property
    def search(self) -> tuple[rf.Recording, ...]:
        """Training data of a search, the first 70 % of each training recording."""
        return tuple(r.split(SHARE)[0] for r in self.train)

    @property
    def validation(self) -> tuple[rf.Recording, ...]:
        """Validation data of a search, the rest of each training recording."""
        return tuple(r.split(SHARE)[1] for r in self.train)


def splits(recordings: Sequence[rf.Recording]) -> dict[str, Split]:
    """Splits by name, in each of which one motion or one gain is left out."""

    def one(name: str, of: Callable[[rf.Recording], object], left_out: object) -> Split:
        train = tuple(r for r in recordings if of(r) != left_out)
        return Split(name, train, tuple(r for r in recordings if of(r) == left_out))

    listed = [one(f"motion {m}", motion, m) for m in MOTIONS]
    listed += [one(f"gain {g}", gain, g) for g in GAINS]
    return {s.name: s for s in listed}


def logs(recordings: Sequence[rf.Recording]) -> Logs:
    """Recordings for the extended friction models."""
    N = max(r.N for r in recordings)
    pad = lambda x: np.pad(np.asarray(x, float), (0, N - len(x)))  # noqa: E731
    slopes = [np.polyfit(np.arange(r.n_init) * r.Ts, r.y[: r.n_init, 0], 1)[0] for r in recordings]
    return Logs(
        goal=np.array([pad(r.u) for r in recordings]),
        angle=np.array([pad(r.y[:, 0]) for r in recordings]),
        length=np.array([r.N for r in recordings]),
        slope=np.array([gain(r) * DYNAMIXEL_GAIN_SCALE for r in recordings]),
        supply=np.array([r.constants["hub.position_servo.supply"] for r in recordings]),
        start=np.array([(r.y[0, 0], v) for r, v in zip(recordings, slopes, strict=True)]),
        Ts=recordings[0].Ts,
        load=MASS * GRAVITY * LENGTH,
        inertia=MASS * LENGTH**2,
    )


def errors(runs: Sequence[np.ndarray], recordings: Sequence[rf.Recording]) -> dict[str, dict[str, float]]:
    """Mean absolute and root mean square error of each recording [deg]; `n_init` samples are not counted."""
    found = {}
    for run, r in zip(runs, recordings, strict=True):
        e = np.rad2deg(np.asarray(run).reshape(-1)[: r.N] - r.y[:, 0])[r.n_init :]
        found[f"{motion(r)} {gain(r)}"] = {
            "mean": float(np.mean(np.abs(e))),
            "rms": float(np.sqrt(np.mean(e**2))),
        }
    return found
