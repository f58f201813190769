"""Joints of the SO-101: the same model, whose gain and motor nobody has written down."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax import effects as fx
from servo import friction_models
from servo.evolved import Box, evolved_alike, evolved_models
from servo.friction_models import Logs

# Learnt from these motions, judged on the other one, of joints that carry little.
TRAIN, TEST = ("multisine", "chirp_sweep"), "step_response"
JOINTS = ("Rotation", "Elbow", "Wrist_Pitch", "Wrist_Roll")

INERTIA, SUPPLY = 0.03, 7.4
SUBSTEPS = 4
"""Steps of one sample of 20 ms."""

# What the models M1 to M6 need here beside friction; the arm's weight at this joint is unknown too.
ARM_BOX: Box = {"slope": (0.5, 12.0), "load": (0.0, 2.0)}
ARM_MOTOR: Box = {
    "kt": (0.1, 5.0),
    "R": (0.5, 40.0),
    "armature": (0.0, 0.0),
    "q_offset": (-np.pi, np.pi),
    "base": (0.0, 0.5),
}
# The box of an evolution over the numbers of the grey box.
GREY_BOX: Box = {
    "hub.position_servo.gain": (3.0, 72.0),
    "hub.position_servo.torque_constant": (0.1, 5.0),
    "hub.position_servo.resistance": (0.5, 40.0),
    "hub.gravity.sine": (-2.0, 2.0),
    "hub.gravity.cosine": (-2.0, 2.0),
    "hub.coulomb.level": (0.0, 0.5),
    "input.delay.time": (0.0, 0.05),
}


def logs(recordings: list[rf.Recording]) -> Logs:
    """The recordings as the extended friction models take them, `SUBSTEPS` steps a sample, goals held."""
    N = max(r.N for r in recordings) * SUBSTEPS
    pad = lambda x: np.pad(np.repeat(x, SUBSTEPS), (0, N - SUBSTEPS * len(x)))  # noqa: E731
    slopes = [np.polyfit(np.arange(r.n_init) * r.Ts, r.y[: r.n_init, 0], 1)[0] for r in recordings]
    many = np.ones(len(recordings))
    return Logs(
        goal=np.array([pad(r.u) for r in recordings]),
        angle=np.array([pad(r.y[:, 0]) for r in recordings]),
        length=np.array([r.N * SUBSTEPS for r in recordings]),
        slope=many,
        supply=SUPPLY * many,
        start=np.array([(r.y[0, 0], v) for r, v in zip(recordings, slopes, strict=True)]),
        Ts=recordings[0].Ts / SUBSTEPS,
        load=0.0,
        inertia=INERTIA,
    )


def arm(say: Callable[[str], None], rollouts: int) -> list[dict[str, Any]]:
    """One row per joint: errors [deg] of free runs over a motion that no fit has seen.

    Args:
        say: Called with a line for each joint.
        rollouts: Free runs of all training recordings together at most, of each evolution.
    """
    recordings = rf.data.load_dataset("so101")
    rows = []
    for joint in JOINTS:
        of = {r.source.split(",")[0]: r for r in recordings if f" {joint}," in r.source}
        if TEST not in of or not set(TRAIN) & set(of):
            continue
        train, test = [of[m] for m in TRAIN if m in of], of[TEST]
        row: dict[str, Any] = {"joint": joint, "motion": TEST, "range": float(np.rad2deg(np.ptp(test.y)))}
        away = lambda run, test=test: float(np.rad2deg(np.sqrt(np.mean((run - test.y[:, 0]) ** 2))))  # noqa: E731
        row["goal"], row["takes"] = away(test.u), {}
        # Gain, motor and load are not known: three numbers are free for stiffness, damping and limit.
        servo = rf.joints.sts3215(INERTIA, gain=16.0, supply=SUPPLY).release("hub.position_servo.gain")
        for name, mechanism in (
            ("no friction", servo),
            ("Coulomb", servo + fx.Coulomb("hub", level=0.05)),
            ("Coulomb, delay", servo + fx.Coulomb("hub", level=0.05) + fx.Delay(time=0.01)),
        ):
            model = rf.Model(mechanism, rf.Exponential(substeps=SUBSTEPS))
            began = time.perf_counter()
            fit = rf.fit(model, train)
            row["takes"][name] = {
                "seconds": time.perf_counter() - began,
                "rollouts": fit.steps * len(train),
            }
            row[name] = away(fit.model.simulate(test)[:, 0])
            row[f"{name}, fit"] = {e.name: [e.value, e.std] for e in fit.parameters if e.free}
            row[f"{name}, status"] = fit.status
        model, row["takes"]["Coulomb, delay, CMA-ES"] = evolved_alike(
            model, train, GREY_BOX, rollouts, seed=1
        )
        row["Coulomb, delay, CMA-ES"] = away(model.simulate(test)[:, 0])
        for name, found in evolved_models(logs(train), rollouts, ARM_BOX, ARM_MOTOR).items():
            run = friction_models.rollouts(found["parameters"], logs([test]))[0]
            row[name] = away(run[: test.N * SUBSTEPS : SUBSTEPS])
            row["takes"][name] = found
        say(f"so101 {joint}: " + ", ".join(f"{n} {row[n]:.2f}" for n in ("goal", *row["takes"])) + " deg")
        rows.append(row)
    return rows
