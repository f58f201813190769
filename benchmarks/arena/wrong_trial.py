"""Rows of B0 for wrong worlds: one simulated machine, the search, and its score.

The module imports JAX, so it must be imported after the settings of a process are made.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

from arena.probability import told as probabilities_told
from evaluation import ESTABLISHED, PROVISIONAL, errors, named, searched
from rotflex_jax.arena.marking import alike
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.wrong_worlds import World, world
from rotflex_jax.text.numbers import json_number


def marks(
    hidden: Place | None, besides: Iterable[Sequence[Place]], rounds: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Compares an answer with the truth of a world.

    Args:
        hidden: effect that should be named, or None.
        besides: right names of each further error of the world.
        rounds: effects that were found, with `effect`, `port`, `equivalent` and `status`.

    Returns:
        `named`: whether the hidden effect, or one that no recording distinguishes from it, is found or listed
        as equivalent to a found effect; `named_established`: the same among established effects; `first`:
        whether it is the first found effect that is no further error of the world; `wrong_established` and
        `wrong_provisional`: found effects that are neither the hidden effect nor a further error, also not by
        an equivalent. The first three are None if nothing is hidden.
    """
    wanted = set() if hidden is None else alike(hidden)
    # Names of further errors are neither required nor wrong.
    forgiven = {p for names in besides for p in names}
    wrong: dict[str, list[list[str]]] = {ESTABLISHED: [], PROVISIONAL: []}
    hits, first = [], None
    for r in rounds:
        said = {(r["effect"], r["port"]), *(tuple(p) for p in r["equivalent"])}
        hit = bool(said & wanted)
        hits += [r["status"]] * hit
        if not hit and not said & forgiven:
            wrong[r["status"]].append([r["effect"], r["port"]])
        # A further error may be found first, since it is true.
        if first is None and (hit or not said & forgiven):
            first = hit
    return {
        "named": None if hidden is None else bool(hits),
        "named_established": None if hidden is None else ESTABLISHED in hits,
        "first": None if hidden is None else bool(first),
        "wrong_established": wrong[ESTABLISHED],
        "wrong_provisional": wrong[PROVISIONAL],
    }


def told(w: World) -> dict[str, Any]:
    """The entries of a row for the world itself."""
    return {
        "world": w.seed,
        "kind": w.kind,
        "hidden": None if w.hidden is None else list(w.hidden),
        "parameters": w.parameters,
        "besides": [asdict(b) for b in w.besides],
        "visible": w.visible,
        "samples": w.train.N,
        "Ts": w.train.Ts,
        **w.truth,
    }


def trial(job: dict[str, Any], tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Simulates one world, searches it and scores the answer; a failure gives a row with its error.

    Args:
        job: `world`, its seed; `keep_evidence` to store the evidence from which the probabilities of sets
            follow.
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
        w = world(job["world"])
        row.update(told(w))
        wall, cpu = time.perf_counter(), time.process_time()
        result = searched(w.model, [w.train], [w.validation], [w.test], say)
        row["wall_s"] = time.perf_counter() - wall
        row["cpu_s"] = time.process_time() - cpu
        rounds = named(result)
        row.update(
            marks(w.hidden, [b.names for b in w.besides], rounds),
            rounds=rounds,
            verdict=result.verdict.value,
            sentence=result.sentence,
            notes=list(result.notes),
            ranking=[[s.effect, s.port, json_number(s.score)] for s in result.ranking[:8]],
            noise_floor=dict(result.noise_floor),
            **probabilities_told(result, job.get("keep_evidence", False)),
            errors={
                name: {
                    stage: errors(model, [recording])
                    for stage, model in (("baseline", result.baseline.model), ("final", result.final.model))
                }
                for name, recording in (("validation", w.validation), ("test", w.test))
            },
        )
    except Exception as problem:  # recorded as a row with its error
        row["error"] = f"{type(problem).__name__}: {problem}"
        row["traceback"] = traceback.format_exc()
    row["lines"] = lines
    return row
