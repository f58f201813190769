"""The rotary arm: rigid, fitted to one run and evaluated on others; flexible, fitted to part of one run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rotflex_jax as rf
from public_machines.free_runs import error, fitted
from public_machines.rounds import Say, estimates, labels, told
from rotflex_jax.effects import Coulomb, VoltageOffset


def rigid(say: Say) -> dict[str, Any]:
    _, slow, fast, other = rf.data.load_dataset("rotary_arm")
    tests = {"gain 8": fast, "gains 1 and 3": other}
    found = _learnt(rf.joints.rotary_arm(), [slow], tests, say)
    # The arm rests most of the time, and predictions at rest contain little information on the parameters.
    # So the model is also fitted to free runs.
    by_hand = rf.joints.rotary_arm() + Coulomb(at="hub", level=0.03)
    for label, machine in (
        ("the machine with dry friction, fitted to free runs", by_hand),
        ("the same with an offset of the voltage", by_hand + VoltageOffset(offset=0.01)),
    ):
        say(label)
        learnt = fitted(machine, slow, 60)
        row = {"model": label, "trained": 1e3 * error(learnt, slow)} | _errors(rf.Model(learnt), tests)
        found["rows"].append(row)
    return found


def flexible(say: Say) -> dict[str, Any]:
    run = rf.data.load_dataset("rotary_arm")[0]
    train, test = run.split(0.7)
    return _learnt(rf.joints.rotary_arm(flexible=True), [train], {"last 30 %": test}, say)


def _learnt(
    start: rf.Mechanism, train: Sequence[rf.Recording], tests: dict[str, rf.Recording], say: Say
) -> dict[str, Any]:
    result = rf.discover(start, train, list(tests.values()), progress=say)
    rows = [
        {"model": label, "estimates": estimates(stage)} | _errors(stage.model, tests)
        for label, stage in zip(labels(result), result.stages, strict=True)
    ]
    return told(result) | {"unit": "mrad", "rows": rows, "published": {}, "constants": {}}


def _errors(model: rf.Model, tests: dict[str, rf.Recording]) -> dict[str, Any]:
    """Errors of a free run over each test, and of free runs over windows of 2 s of all tests [mrad]."""
    free = {
        f"{name}, {channel}": 1e3 * error
        for name, test in tests.items()
        for channel, error in rf.metrics.rmse(test, model.simulate(test)).items()
    }
    unseen = list(tests.values())
    runs = [model.simulate_windows(t, 2.0) for t in unseen]
    short = 1e3 * rf.metrics.windowed_rmse(unseen, [model.measured(t) for t in unseen], runs, 2.0)
    return {"free run": free, "windows": dict(zip(model.mechanism.channels, short.tolist(), strict=True))}
