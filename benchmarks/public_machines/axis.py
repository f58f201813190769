"""EMPS: structure by discovery on 70 % of the training record, numbers by a free-run fit to all of it."""

from __future__ import annotations

from typing import Any

import rotflex_jax as rf
from public_machines.rounds import Say, estimates, labels, told
from rotflex_jax.effects import VoltageDrift, VoltageOffset
from rotflex_jax.mechanism.roles import search_places


def run(say: Say) -> dict[str, Any]:
    benchmark = rf.data.benchmark("emps")
    start = rf.joints.emps()
    # The carriage stands still between strokes for milliseconds only: laws with memory are left out.
    slow = {"lugre", "dahl", "bouc_wen", "backlash"}
    candidates = [place for place in search_places(start) if place[0].name not in slow]
    # A third round finds a part of 0.3 kg that swings at 19 Hz: nothing that a free run would notice.
    result = rf.discover(start, *benchmark.train.split(0.7), candidates=candidates, rounds=2, progress=say)
    rows = []

    def fitted_row(label: str, machine: rf.Mechanism) -> tuple[rf.Mechanism, dict[str, Any]]:
        """A fit of free runs to all of the training record, and its row."""
        say(f"free-run fit: {label}")
        fitted = rf.fit(machine, benchmark.train, first="measured")
        trained = rf.metrics.rmse(benchmark.train, fitted.model.simulate(benchmark.train))["position"]
        row = {
            "model": label,
            "free run": benchmark.score(fitted.model),
            "trained": 1e3 * trained,
            "free-run estimates": estimates(fitted),
            "status": fitted.status,
        }
        say(f"  {trained * 1e3:.2f} mm on the training record, {row['free run']}")
        return fitted.model.mechanism, row

    mechanism = start + VoltageOffset()
    for label, stage in zip(labels(result), result.stages, strict=True):
        for effect in stage.model.mechanism.effects:
            if (effect.name, effect.at) not in {(e.name, e.at) for e in mechanism.effects}:
                mechanism = mechanism + effect
        m = stage.model.mechanism
        now = mechanism.with_values(dict(zip(m.parameter_names, m.values, strict=True)))
        predictor = {"predictor": benchmark.score(stage.model), "predictor estimates": estimates(stage)}
        if label == labels(result)[0]:
            rows.append({"model": label, "free run": benchmark.score(stage.model)} | predictor)
            continue
        now, row = fitted_row(label, now)
        rows.append(row | predictor)
    now, row = fitted_row(
        "voltage_drift, which free runs of the training record ask for", now + VoltageDrift()
    )
    rows.append(row)
    say("the same structure fitted to the test, as a bound")
    bound = rf.fit(now, benchmark.tests["pulses"], first="measured")
    return told(result) | {
        "unit": benchmark.unit,
        "rows": rows,
        "bound": {"errors": benchmark.score(bound.model), "estimates": estimates(bound)},
        "published": {p.method: dict(p.errors) for p in benchmark.published},
        "constants": {c.parameter: [c.value, c.about] for c in benchmark.constants},
    }
