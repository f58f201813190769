"""Joints of the SO-101: the same model, whose gain and motor nobody has written down."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax import effects as fx

# Learnt from these motions, evaluated on the other one, of joints that carry little.
TRAIN, TEST = ("multisine", "chirp_sweep"), "step_response"
JOINTS = ("Rotation", "Elbow", "Wrist_Pitch", "Wrist_Roll")


def arm(say: Callable[[str], None]) -> list[dict[str, Any]]:
    """One row per joint: errors [deg] of free runs over a motion that no fit has seen."""
    recordings = rf.data.load_dataset("so101")
    rows = []
    for joint in JOINTS:
        of = {r.source.split(",")[0]: r for r in recordings if f" {joint}," in r.source}
        if TEST not in of or not set(TRAIN) & set(of):
            continue
        train, test = [of[m] for m in TRAIN if m in of], of[TEST]
        row: dict[str, Any] = {"joint": joint, "motion": TEST, "range": float(np.rad2deg(np.ptp(test.y)))}
        away = lambda run, test=test: float(np.rad2deg(np.sqrt(np.mean((run - test.y[:, 0]) ** 2))))  # noqa: E731
        row["goal"] = away(test.u)
        # Gain, supply and motor are not known: three numbers are free for stiffness, damping and limit.
        servo = rf.joints.position_servo(0.005, servo=fx.PositionServo(gain=1500.0)).release(
            "hub.position_servo.gain"
        )
        for name, mechanism in (
            ("no friction", servo),
            ("Coulomb", servo + fx.Coulomb("hub", level=0.02)),
        ):
            fit = rf.fit(mechanism, train)
            row[name] = away(fit.model.simulate(test)[:, 0])
            row[f"{name}, fit"] = {e.name: [e.value, e.std] for e in fit.parameters if e.free}
            row[f"{name}, status"] = fit.status
        say(f"so101 {joint}: {row['goal']:.2f} {row['no friction']:.2f} {row['Coulomb']:.2f} deg")
        rows.append(row)
    return rows
