"""EMPS: effects found by the search and then by free runs on the training recording; official test errors."""

from __future__ import annotations

from typing import Any

import rotflex_jax as rf
from public_machines.free_runs import error, fitted, grow, tried
from public_machines.rounds import Say, estimates, labels, told
from rotflex_jax.effects import VoltageDrift
from rotflex_jax.mechanism.roles import search_places


def run(say: Say) -> dict[str, Any]:
    benchmark = rf.data.benchmark("emps")
    start, train = rf.joints.emps(), benchmark.train
    # Laws with memory are left out, since the carriage stands still between strokes for milliseconds only.
    slow = {"lugre", "dahl", "bouc_wen", "backlash"}
    candidates = [place for place in search_places(start) if place[0].name not in slow]
    # A third round would add a mass of 0.3 kg that oscillates at 19 Hz, which does not improve free runs.
    result = rf.discover(start, *train.split(0.7), candidates=candidates, rounds=2, progress=say)
    rows = [
        {
            "model": label,
            "search": benchmark.score(stage.model),
            "search estimates": estimates(stage),
        }
        for label, stage in zip(labels(result), result.stages, strict=True)
    ]
    machines = [_as_found(start, stage.model.mechanism) for stage in result.stages]
    # `rf.discover` leaves out the drift, since it belongs to a recording. Here it is a candidate, since free
    # runs over the whole recording depend on it.
    grown = grow(machines[-1], train, [*candidates, (VoltageDrift, "input")], say)
    for entry in grown:
        if entry["taken"] is not None:
            rows.append({"model": f"{entry['taken'].replace(' at ', ' at the ')}, by free runs"})
    machines += [entry["machine"] for entry in grown[1:]]
    for number, (row, machine) in enumerate(zip(rows, machines, strict=True)):
        found = fitted(machine, train)
        row |= {"free run": benchmark.score(rf.Model(found)), "trained": 1e3 * error(found, train)}
        say(f"{row['model']}: {row['trained']:.2f} mm on the training record, {row['free run']}")
        if number == len(rows) - 1:  # `rf.fit` from this optimum, for intervals
            last = rf.fit(found, train, first="measured")
            row |= {"free-run estimates": estimates(last), "status": last.status}
            row["free run"] = benchmark.score(last.model)
    say("the same structure fitted to the test, as a bound")
    bound = fitted(machines[-1], benchmark.tests["pulses"])
    return told(result) | {
        "unit": benchmark.unit,
        "rows": rows,
        "free-run rounds": tried(grown),
        "bound": {"errors": benchmark.score(rf.Model(bound))},
        "published": {p.method: dict(p.errors) for p in benchmark.published},
        "constants": {c.parameter: [c.value, c.about] for c in benchmark.constants},
    }


def _as_found(start: rf.Mechanism, found: rf.Mechanism) -> rf.Mechanism:
    """The first machine with the effects that were found, without the offset that the search adds."""
    named = found.named_values
    machine = start
    for effect in found.effects:
        known = {(e.name, e.at) for e in start.effects} | {("voltage_offset", "input")}
        if (effect.name, effect.at) not in known:
            machine = machine + effect
    return machine.with_values({n: v for n, v in named.items() if n in machine.parameter_names})
