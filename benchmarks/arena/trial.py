"""Rows of B0: one simulated recording, the search, its score, and the oracle.

The oracle is the true structure, fitted to the same data. The module imports JAX, so it must be imported
after the settings of a process are made.
"""

from __future__ import annotations

import dataclasses
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rotflex_jax as rf
from arena.probability import told
from rotflex_jax.arena.marking import parameter_errors, renamed, scored, visible
from rotflex_jax.arena.simulator.hidden import ABSORBED, DEFAULTS, SHAPES
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.effects import CATALOG
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.text.numbers import json_number

SPLIT, WINDOW, FS = 0.7, 2.0, 500.0
BOTH = ["theta", "alpha"]


def recording(job: dict[str, Any]) -> tuple[rf.Recording, dict[str, Any]]:
    """The recording of a job, and its truth."""
    places = [tuple(p) for p in job["effects"]]
    size, seconds = job.get("size", 1.0), job["seconds"]
    r = make_record(places, kind=job["kind"], seed=job["seed"], size=size, seconds=seconds, fs=FS)
    channels = job.get("channels", BOTH)
    y = r["y"][:, [BOTH.index(c) for c in channels]]
    rec = rf.Recording(u=r["u"], y=y, Ts=r["Ts"], channels=tuple(channels), source="arena")
    return rec, r["truth"]


def textbook(channels: Sequence[str] = BOTH) -> rf.Mechanism:
    """The joint without hidden effects, with the given sensors."""
    joint = rf.joints.paper()
    return dataclasses.replace(joint, outputs=tuple(o for o in joint.outputs if o[0] in channels))


def windows_error(model: Model, test: rf.Recording) -> dict[str, float]:
    """Root mean square error of short free runs by channel, without the samples at the start of each."""
    run = model.simulate_windows(test, WINDOW)
    rms = windowed_rmse([test], [model.measured(test)], [run], WINDOW)
    return dict(zip(model.mechanism.channels, rms.tolist(), strict=True))


def oracle(places: list[Place], train: rf.Recording, test: rf.Recording) -> dict[str, Any]:
    """Errors of the true structure on validation data; its fit starts from half the default sizes."""
    m = textbook(list(train.channels))
    for place in places:
        if place in ABSORBED or (place[1] in BOTH and place[1] not in m.channels):
            continue
        kept = SHAPES.get(place[0], set())
        half = {n: (v if n in kept else v / 2) for n, v in DEFAULTS[place].items()}
        m = m + CATALOG[place[0]](at=place[1], **renamed(place, half))
    fitted = rf.fit(m, train)
    return {"windows": windows_error(fitted.model, test), "status": fitted.status}


def with_oracle(row: dict[str, Any], train: rf.Recording, test: rf.Recording) -> dict[str, Any]:
    """The row with its oracle, or without one if the catalogue lacks the hidden effect."""
    if row["outside"]:
        return row
    best = oracle([(e, p) for e, p in row["effects"]], train, test)
    return {
        **row,
        "oracle": best,
        "over_oracle": {c: row["windows"][c] / v for c, v in best["windows"].items()},
    }


def evaluated_again(row: dict[str, Any]) -> dict[str, Any]:
    """The row with a new oracle and unchanged results of the search; or with the error of the oracle."""
    try:
        return with_oracle(row, *recording(row)[0].split(SPLIT))
    except Exception as problem:  # the results of the search are kept
        return {**row, "oracle_error": f"{type(problem).__name__}: {problem}"}


def trial(job: dict[str, Any], tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Simulates one recording, searches it and scores the answer; a failure gives a row with its error.

    Args:
        job: `effects`, `kind`, `seed`, `seconds`; `size` if not 1, `channels` if not both; `keep_evidence` to
            store the evidence from which the probabilities of sets follow.
        tell: function that is called with lines of progress.

    Returns:
        A row for JSON.
    """
    row: dict[str, Any] = dict(job)
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        tell(line)

    try:
        rec, truth = recording(job)
        hidden = {(e["effect"], e["port"]): e["parameters"] for e in truth["effects"]}
        wanted = visible(hidden, job["kind"], job.get("channels", BOTH))
        train, test = rec.split(SPLIT)
        wall, cpu = time.perf_counter(), time.process_time()
        joint = textbook(list(rec.channels))
        result = rf.discover(joint, train, test, window_seconds=WINDOW, progress=say)
        row["wall_s"] = time.perf_counter() - wall
        row["cpu_s"] = time.process_time() - cpu
        rounds = [(r.effect, r.port) for r in result.rounds]
        equivalents = [list(r.equivalent) for r in result.rounds]
        row.update(
            scored(wanted, rounds, equivalents, result.verdict),
            wanted=[list(p) for p in wanted],
            verdict=result.verdict,
            sentence=result.sentence,
            rounds=[
                {
                    "effect": r.effect,
                    "port": r.port,
                    "equivalent": [list(p) for p in r.equivalent],
                    "nats": r.held_out_gain_nats,
                    "score": json_number(r.score),
                }
                for r in result.rounds
            ],
            notes=list(result.notes),
            ranking=[[s.effect, s.port, json_number(s.score), s.excited] for s in result.ranking[:8]],
            parameters=parameter_errors(
                hidden, {e.name: e for e in result.final.estimates}, truth["plant"]["K"]
            ),
            windows=result.final.held_out_rmse_windows,
            windows_baseline=result.baseline.held_out_rmse_windows,
            noise_floor=result.noise_floor,
            **told(result, job.get("keep_evidence", False)),
        )
        row = with_oracle(row, train, test)
    except Exception as problem:  # recorded as a row with its error
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    row["lines"] = lines
    return row
