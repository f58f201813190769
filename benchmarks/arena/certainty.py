"""Rows of B11: whether intervals contain the true values, and how many samples lie inside prediction bands.

Each row is of one simulated machine. The module imports JAX, so it must be imported after the settings of a
process are made.
"""

from __future__ import annotations

import dataclasses
import time
import traceback
from typing import Any

import numpy as np

import rotflex_jax as rf
from arena.trial import textbook
from rotflex_jax.arena.marking import renamed
from rotflex_jax.arena.simulator.hidden import DEFAULTS, SHAPES
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.probabilities import FittedSet, probabilities
from rotflex_jax.effects import CATALOG
from rotflex_jax.mechanism import Exponential
from rotflex_jax.models.model import Model
from rotflex_jax.text.numbers import json_number

FS = 500.0
SUBSTEPS = 3
"""Integration steps for each sample.

Sticking may start and end within a sample. One step for each sample would bias the level of a friction by
about the width of its interval.
"""
LEVEL = 0.9


def true_model(places: list[Place], size: float = 1.0) -> Model:
    """The true structure with half the true sizes of the hidden effects, at which a fit starts."""
    m = textbook()
    for place in places:
        kept = SHAPES.get(place[0], set())
        half = {n: (v if n in kept else v * size / 2) for n, v in DEFAULTS[place].items()}
        m = m + CATALOG[place[0]](at=place[1], **renamed(place, half))
    return Model(m, Exponential(substeps=SUBSTEPS))


def record(job: dict[str, Any], kind: str, seconds: float) -> tuple[rf.Recording, dict[str, Any]]:
    """A recording of the machine of a job under a kind of input, and its truth."""
    places = [tuple(p) for p in job["effects"]]
    r = make_record(places, kind=kind, seed=job["seed"], size=job["size"], seconds=seconds, fs=FS)
    return rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], source="arena"), r["truth"]


def intervals(job: dict[str, Any]) -> dict[str, Any]:
    """Profile and Wald intervals of the parameters of the hidden effect; whether they contain the truth."""
    row: dict[str, Any] = dict(job)
    try:
        rec, truth = record(job, job["kind"], job["seconds"])
        (hidden,) = truth["effects"]
        place = (hidden["effect"], hidden["port"])
        true = renamed(place, hidden["parameters"], truth["plant"]["K"])
        began = time.perf_counter()
        fitted = rf.fit(true_model([place], job["size"]), rec)
        row["status"], row["fit_s"] = fitted.status, time.perf_counter() - began
        row["intervals"] = []
        for name, value in true.items():
            began = time.perf_counter()
            full = f"{place[1]}.{place[0]}.{name}"
            if full not in fitted.free_names:
                continue
            p = rf.profile(fitted, rec, full)
            estimate = fitted[full]
            row["intervals"].append(
                {
                    "name": full,
                    "truth": value,
                    "value": p.value,
                    "profile": _plain(p.interval()),
                    "held": any(a <= value <= b for a, b in p.regions()),
                    "wald": _plain(estimate.ci95),
                    "wald_held": bool(estimate.ci95[0] <= value <= estimate.ci95[1]),
                    "shape": p.shape,
                    "wald_is_poor": p.wald_is_poor,
                    "advised": full in fitted.profile_advised,
                    "gained": p.gained,
                    "factor": p.factor,
                    "points": len(p.values),
                    "s": time.perf_counter() - began,
                }
            )
    except Exception as problem:  # recorded as a row with its error
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    return row


def bands(job: dict[str, Any]) -> dict[str, Any]:
    """Coverage of bands over held-out data, for the true structure and for the textbook model.

    A recording is cut into three parts of equal length. The first is fitted, the third is held out. Each
    model has two bands: one from its fit alone, and one that also uses its errors over the second part.
    """
    row: dict[str, Any] = dict(job)
    try:
        places = [tuple(p) for p in job["effects"]]
        seconds, runs = job["seconds"], []
        whole, _ = record(job, job["kind"], 3 * seconds)
        n = whole.N // 3
        runs = [dataclasses.replace(whole.slice(k * n, (k + 1) * n), continues=None) for k in range(3)]
        train, known, held_out = runs
        began = time.perf_counter()
        fitted = rf.fit(true_model(places, job["size"]), train)
        row["status"] = fitted.status
        found = rf.prediction_bands(fitted, held_out, LEVEL)
        row["coverage"], row["shares"] = found.coverage(), found.shares
        row["with_known"] = rf.prediction_bands(fitted, held_out, LEVEL, known=known).coverage()
        wrong = rf.fit(Model(textbook(), Exponential(substeps=SUBSTEPS)), train)
        row["textbook"] = rf.prediction_bands(wrong, held_out, LEVEL).coverage()
        row["textbook_known"] = rf.prediction_bands(wrong, held_out, LEVEL, known=known).coverage()
        row["s"] = time.perf_counter() - began
    except Exception as problem:
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    return row


def cost(job: dict[str, Any]) -> dict[str, Any]:
    """Processor time [s] of profiles, identifiability, bands and probabilities, with compilation."""
    row: dict[str, Any] = dict(job)
    try:
        (place,) = (tuple(p) for p in job["effects"])
        rec, _ = record(job, job["kind"], 2 * COST_SECONDS)
        train, held_out = rec.split(0.5)
        fitted = rf.fit(true_model([place], job["size"]), train)
        names = [n for n in fitted.free_names if n.startswith(f"{place[1]}.{place[0]}.")]
        parts = {
            "profiles": lambda: [rf.profile(fitted, train, n) for n in (*names, "joint.spring.stiffness")],
            "identifiable": lambda: rf.identifiable(fitted, train),
            "bands": lambda: rf.prediction_bands(fitted, held_out, LEVEL),
            "probabilities": lambda: probabilities(twenty_sets(2 * COST_SECONDS), misfit=1.0),
        }
        row["profiled"], row["processor_s"] = len(names) + 1, {}
        for name, part in parts.items():
            began = time.process_time()
            part()
            row["processor_s"][name] = time.process_time() - began
    except Exception as problem:
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    return row


COST_SECONDS = 20.0


def twenty_sets(seconds: float) -> list[FittedSet]:
    """Random evidence, by half seconds, of twenty sets of effects, about as many as a long search fits."""
    rng, blocks = np.random.default_rng(0), round(2 * seconds)
    return [FittedSet(frozenset({f"e{k}@hub"}), *rng.normal(size=(2, blocks))) for k in range(20)]


def trial(job: dict[str, Any]) -> dict[str, Any]:
    """One row of the part that the job names."""
    return {"intervals": intervals, "bands": bands, "cost": cost}[job["part"]](job)


def _plain(pair: tuple[float, float]) -> list[float | None]:
    return [json_number(v) for v in np.asarray(pair, float).tolist()]
