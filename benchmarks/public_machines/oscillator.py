"""The Silverbox: search on the first part of the official training recording; official test errors."""

from __future__ import annotations

from typing import Any

import rotflex_jax as rf
from public_machines.rounds import Say, estimates, labels, told

# A quarter of the training recording suffices for three or four effects, and takes a quarter of the time.
SAMPLES = 16000


def run(say: Say) -> dict[str, Any]:
    benchmark = rf.data.benchmark("silverbox")
    smooth = rf.Exponential(order=4, substeps=2, between="smooth")
    result = rf.discover(
        rf.Model(rf.joints.silverbox(), smooth), *benchmark.train.slice(0, SAMPLES).split(0.7), progress=say
    )
    rows = [
        {"model": label, "free run": benchmark.score(stage.model), "estimates": estimates(stage)}
        for label, stage in zip(labels(result), result.stages, strict=True)
    ]
    say("the last model with a held input")
    held = rf.fit(
        rf.Model(result.model.mechanism, rf.Exponential(order=4, substeps=2)),
        benchmark.train.slice(0, SAMPLES),
    )
    rows.append(
        {"model": "the last with an input held between samples", "free run": benchmark.score(held.model)}
    )
    return told(result) | {
        "unit": benchmark.unit,
        "rows": rows,
        "published": {p.method: dict(p.errors) for p in benchmark.published},
        "constants": {},
    }
