"""The rotary arm: one run with the rigid arm to learn from and others to judge on; one cut in two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rotflex_jax as rf
from public_machines.rounds import Say, estimates, labels, told


def rigid(say: Say) -> dict[str, Any]:
    _, slow, fast, other = rf.data.load_dataset("rotary_arm")
    return _learnt(rf.joints.rotary_arm(), [slow], {"gain 8": fast, "gains 1 and 3": other}, say)


def flexible(say: Say) -> dict[str, Any]:
    run = rf.data.load_dataset("rotary_arm")[0]
    train, test = run.split(0.7)
    return _learnt(rf.joints.rotary_arm(flexible=True), [train], {"last 30 %": test}, say)


def _learnt(
    start: rf.Mechanism, train: Sequence[rf.Recording], tests: dict[str, rf.Recording], say: Say
) -> dict[str, Any]:
    result = rf.discover(start, train, list(tests.values()), progress=say)
    rows = [
        {
            "model": label,
            "free run": {
                f"{name}, {channel}": 1e3 * error
                for name, test in tests.items()
                for channel, error in rf.metrics.rmse(test, stage.model.simulate(test)).items()
            },
            "windows": {c: 1e3 * e for c, e in stage.held_out_rmse_windows.items()},
            "estimates": estimates(stage),
        }
        for label, stage in zip(labels(result), result.stages, strict=True)
    ]
    return told(result) | {"unit": "mrad", "rows": rows, "published": {}, "constants": {}}
