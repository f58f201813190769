"""The page of an arena: the table of methods, and every answer with the truth."""

from pathlib import Path
from typing import Any

from rotflex_jax.arena.problems import MEASURED
from rotflex_jax.arena.scores import COLUMNS, FAILED, Marks, Scores, cells, name_of
from rotflex_jax.text.files import path_of, write_file
from rotflex_jax.text.markup import fill_template

HEADINGS = {
    "right": "Answers that are right as a whole, of all simulated records.",
    "named": "Hidden effects of the catalogue that were named, or effects indistinguishable from them.",
    "wrong": "Names that are not true, wrong worlds not counted.",
    "alarms": "Records with nothing hidden on which something was said to be missing.",
    "withheld": "Records whose effect has no name in the catalogue, and the answer was 'unexplained'.",
    "worlds": "Wrong worlds whose hidden effect was named.",
    "calibration": "Mean distance between a probability and how often it held; - where none was given.",
    "error": "Median error of free runs over test data, in units of the sensors' noise; - without a model.",
    "seconds": "Median time of an answer [s].",
    "failures": "Records on which the method raised, answered nonsense or took too long.",
}


def write(scores: Scores, path: str | Path) -> Path:
    """Write the page as one file; return its path."""
    return write_file(path_of(path), fill_template("rotflex_jax.arena", "arena.html.j2", content(scores)))


def content(scores: Scores) -> dict[str, Any]:
    """Values for the template; plain text that the template escapes."""
    first = scores.methods[0].rows
    simulated = [r for r in first if r.kind != MEASURED]
    return {
        "seed": scores.seed,
        "records": len(simulated),
        "seconds": f"{scores.seconds:g}",
        "limit": f"{scores.limit:g}",
        "headings": list(COLUMNS.values()),
        "meanings": [(COLUMNS[name], text) for name, text in HEADINGS.items()],
        "rows": [cells(s) for s in scores.methods],
        "methods": [s.method for s in scores.methods],
        "listed": [
            (r.record, r.kind, _hidden(r), [_answer(s.rows[k]) for s in scores.methods])
            for k, r in enumerate(simulated)
        ],
        "measured": [
            (
                f"{r.truth['machine']}, {r.truth['direction']}",
                r.truth["unit"],
                [_error(s.rows[k]) for s in scores.methods],
            )
            for k, r in enumerate(first)
            if r.kind == MEASURED
        ],
        "failed": [(s.method, r.record, r.reason) for s in scores.methods for r in s.rows if r.reason],
    }


def _hidden(row: Marks) -> str:
    return " + ".join(map(name_of, row.hidden)) or "nothing"


def _answer(row: Marks) -> dict[str, Any]:
    names = " + ".join(map(name_of, row.answered))
    text = row.verdict if not names else f"{names}, {row.verdict}" if row.verdict != "found" else names
    return {"text": text, "right": row.right}


def _error(row: Marks) -> str:
    if row.error is None:
        return "failed" if row.verdict == FAILED else "-"
    return f"{row.truth['factor'] * row.error:.3g}"
