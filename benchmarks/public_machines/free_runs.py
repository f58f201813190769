"""Stepwise search that fits and compares by free runs over a training recording.

`rf.discover` compares predictions and short free runs. A slow effect, such as the drift of an offset, hardly
changes those but dominates a free run of 25 s. Here effects are added one at a time to the structure that
`rf.discover` found. Each candidate is fitted to a free run over the first 70 % of the recording and evaluated
by a free run over the rest, and then fitted to the last 70 % and evaluated on the first 30 %.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import rotflex_jax as rf
from public_machines.rounds import Say
from rotflex_jax.discover.supermodel import scales
from rotflex_jax.effects.base import Effect

# An effect is added only if the errors of both held-out runs fall below this share of their present values.
BETTER = 0.9
SHARE = 0.7
TYPICAL_FORCE = 500.0


def fitted(machine: rf.Mechanism, record: rf.Recording, most: int = 40) -> rf.Mechanism:
    """The machine with free parameters fitted by least squares of one free run.

    The first state is estimated from the first samples.
    """
    named = machine.named_values
    specs = dict(zip(machine.parameter_names, machine.parameter_specifications, strict=True))
    free = machine.free_names
    size = np.array([max(abs(named[n]), specs[n].typical) for n in free])
    low = np.array([specs[n].lower for n in free]) / size
    high = np.array([specs[n].upper for n in free]) / size

    def missed(z: np.ndarray) -> np.ndarray:
        now = machine.with_values(dict(zip(free, (z * size).tolist(), strict=True)))
        e = missed_by(now, record) / np.ptp(record.y, axis=0)
        return np.clip(np.nan_to_num(e.ravel(), nan=10.0), -10.0, 10.0)

    begin = np.clip(np.array([named[n] for n in free]) / size, low + 1e-6, high - 1e-6)
    # The minimum lies in a long narrow valley, so steps are scaled by the Jacobian. Sticking makes the cost
    # slightly rough, so differences for the Jacobian are not small.
    found = least_squares(
        missed, begin, bounds=(low, high), x_scale="jac", diff_step=1e-3, max_nfev=most, ftol=1e-6
    )
    return machine.with_values(dict(zip(free, (found.x * size).tolist(), strict=True)))


def missed_by(machine: rf.Mechanism, record: rf.Recording) -> np.ndarray:
    """Errors of one free run over a part of a recording, after its first `n_init` samples (N, C) [output].

    A drift of the voltage is counted from the start of the recording, not from that of the part.
    """
    name = "input.voltage_drift.rate"
    rate = machine.named_values.get(name, 0.0)
    run = rf.Model(machine).simulate(dataclasses.replace(record, u=record.u + rate * record.start))
    return (run - record.y)[record.n_init :]


def error(machine: rf.Mechanism, record: rf.Recording) -> float:
    """Root mean square error of one free run [output]."""
    return float(np.sqrt(np.mean(missed_by(machine, record) ** 2)))


def held_out(machine: rf.Mechanism, record: rf.Recording) -> tuple[float, float]:
    """Errors over the last and over the first 30 %, each with parameters fitted to the rest [output]."""
    n = round(SHARE * record.N)
    there = error(fitted(machine, record.slice(0, n)), record.slice(n, record.N))
    back = error(fitted(machine, record.slice(record.N - n, record.N)), record.slice(0, record.N - n))
    return there, back


def grow(
    machine: rf.Mechanism,
    record: rf.Recording,
    candidates: Iterable[tuple[type[Effect], str]],
    say: Say,
) -> list[dict[str, Any]]:
    """Adds the best candidate in each round, until none improves both held-out errors enough.

    Returns:
        One entry per round: `machine` before the round, its `held_out` errors, `tried` (candidate -> held-out
        errors), and `taken`, the name of the added effect, which is None in the last entry.
    """
    there = {(e.name, e.at) for e in machine.effects}
    left, found = [c for c in candidates if (c[0].name, c[1]) not in there], []
    now = fitted(machine, record)
    errors = held_out(now, record)
    for number in itertools.count():
        tried: dict[str, tuple[float, float]] = {}
        grown: dict[str, rf.Mechanism] = {}
        sizes = scales(rf.Model(now), [record], TYPICAL_FORCE)
        for cls, place in left:
            name = f"{cls.name} at {place}"
            begun = [
                now + dataclasses.replace(cls(at=place), **probe)
                for direction in cls.probes(sizes[place])
                for probe in direction
            ]
            # The effect is fitted from each of its probes, and the fit with the least error is kept.
            grown[name] = min((fitted(m, record, 12) for m in begun), key=lambda m: error(m, record))
            tried[name] = held_out(grown[name], record)
            say(f"  {name}: " + " and ".join(f"{e:.4g}" for e in tried[name]))
        better = {k: e for k, e in tried.items() if e[0] < BETTER * errors[0] and e[1] < BETTER * errors[1]}
        taken = min(better, key=lambda k: better[k][0] * better[k][1]) if better else None
        entry = {"round": number + 1, "held_out": errors, "tried": tried, "taken": taken, "machine": now}
        found.append(entry)
        say(f"free runs, round {number + 1}: {taken or 'nothing'} taken, held out before it {errors}")
        if taken is None:
            break
        now, errors = fitted(grown[taken], record), tried[taken]
        left = [(cls, place) for cls, place in left if f"{cls.name} at {place}" != taken]
    return found


def tried(grown: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rounds without machines, for JSON [output]."""
    return [{key: entry[key] for key in ("round", "held_out", "tried", "taken")} for entry in grown]
