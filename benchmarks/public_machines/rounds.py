"""Result of a search as rows of a table, one for each stage."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rotflex_jax as rf

Say = Callable[[str], None]


def estimates(found: Any) -> dict[str, Any]:
    """Fitted parameters with their intervals; `found` is a stage of a search or a fit."""
    listed = found.estimates if hasattr(found, "estimates") else found.parameters
    return {e.name: e.to_dict() for e in listed if e.free}


def labels(result: rf.Discovery) -> list[str]:
    """Labels of the stages: the effect that each one adds to the stage before."""
    return ["the machine as it is", *(f"{r.effect} at {r.port}" for r in result.rounds)]


def told(result: rf.Discovery) -> dict[str, Any]:
    """Verdict, rounds, notes and conditional intervals of a search, for JSON."""
    return {
        "verdict": result.verdict,
        "sentence": result.sentence,
        "rounds": [
            {
                "effect": r.effect,
                "port": r.port,
                "sentence": r.sentence,
                "equivalent": list(map(list, r.equivalent)),
            }
            for r in result.rounds
        ],
        "notes": list(result.notes),
        "conditional_intervals": [c.to_dict() for c in result.conditional],
        "discovery_seconds": round(result.elapsed_s, 1),
    }
