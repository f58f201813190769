"""Searches evaluated on test data: effects that were named, and errors of free runs with and without offset.

Shared by B0 (wrong worlds) and B9 (measured machines).
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax.effects import VoltageOffset
from rotflex_jax.text.numbers import json_numbers

ESTABLISHED, PROVISIONAL = "established", "provisional"
WINDOW = 2.0
"""Length of the short free runs, and of the beginning of a recording to which an offset is fitted [s]."""

# Number of offsets on a grid; half width of the first grid as a share of the largest voltage; number of
# grids, each finer than the one before.
TRIED, SHARE, ROUNDS = 21, 0.1, 3

Recordings = Sequence[rf.Recording]
Errors = dict[str, float | None]


def searched(
    model: rf.Mechanism | rf.Model,
    train: Recordings,
    validation: Recordings,
    test: Recordings,
    progress: Callable[[str], None] | None = None,
) -> rf.Discovery:
    """Runs a search; `rf.discover` is given the test recordings if its version can report errors on them."""
    parameters = inspect.signature(rf.discover).parameters
    knows_test = "test" in parameters and "validation" in parameters
    options: dict[str, Any] = {"test": list(test)} if knows_test else {}
    return rf.discover(
        model, list(train), list(validation), window_seconds=WINDOW, progress=progress, **options
    )


def named(result: rf.Discovery) -> list[dict[str, Any]]:
    """Effects that a search found, from its JSON; without a `status` there, they count as established."""
    return [
        {
            "effect": r["effect"],
            "port": r["port"],
            "equivalent": [[e["effect"], e["port"]] for e in r["equivalent"]],
            "status": r.get("status", ESTABLISHED),
            "doubt": r.get("doubt", ""),
            "nats": r["evidence"]["held_out_gain_nats"],
            "score": r["evidence"]["score"],
        }
        for r in result.to_dict()["rounds"]
    ]


def errors(model: rf.Model | Callable[[rf.Recording], rf.Model], recordings: Recordings) -> dict[str, Any]:
    """Root mean square errors of free runs over recordings to which the model was not fitted.

    Args:
        model: fitted model, or a function that gives the model of a recording.
        recordings: one or several; the first `n_init` samples of each determine its first state.

    Returns:
        `whole` and `windows` (of `WINDOW` seconds) by channel; `whole_calibrated` and `windows_calibrated`
        with a voltage offset for each recording, fitted to its first `WINDOW` seconds; `offsets` [V].
        Errors that are not finite are None, and so are calibrated errors of machines that accept no offset.
    """
    bare = [(model if isinstance(model, rf.Model) else model(r), r) for r in recordings]
    own = [(calibrated(m, r), r) for m, r in bare]
    found: dict[str, Any] = {"whole": _whole(bare), "windows": _windows(bare)}
    known = [(m, r) for (m, _), r in ((pair, r) for pair, r in own if pair is not None)]
    complete = len(known) == len(own)
    found["whole_calibrated"] = _whole(known) if complete else None
    found["windows_calibrated"] = _windows(known) if complete else None
    found["offsets"] = [pair[1] for pair, _ in own if pair is not None] if complete else None
    return found


def calibrated(model: rf.Model, recording: rf.Recording) -> tuple[rf.Model, float] | None:
    """The model with a voltage offset that is fitted to the beginning of a recording, and the offset [V].

    The offset minimises the squared error of the first channel over the first `WINDOW` seconds, on refined
    grids. It replaces an offset that the model already has. None if the machine accepts no offset.
    """
    name = "input.voltage_offset.offset"
    try:
        known = name in model.mechanism.parameter_names
        shifted = model if known else model + VoltageOffset(offset=0.0)
    except rf.InputError:
        return None
    beginning = recording.slice(0, min(recording.N, round(WINDOW / recording.Ts) + 1))
    y, first = shifted.measured(beginning)[:, 0], beginning.n_init

    def with_offset(offset: float) -> rf.Model:
        return shifted.with_values({name: offset})

    def missed(offset: float) -> float:
        e = (y - with_offset(offset).simulate(beginning)[:, 0])[first:]
        squared = float(np.mean(e**2))
        return squared if math.isfinite(squared) else math.inf

    centre, width = 0.0, SHARE * float(np.abs(recording.u).max())
    for _ in range(ROUNDS):
        grid = np.linspace(centre - width, centre + width, TRIED)
        centre = float(grid[int(np.argmin([missed(float(v)) for v in grid]))])
        width *= 2 / (TRIED - 1)
    return with_offset(centre), centre


def _whole(pairs: Sequence[tuple[rf.Model, rf.Recording]]) -> Errors:
    """Errors of one free run over each recording, over the samples of all recordings together."""
    each = []
    for model, r in pairs:
        e = (model.measured(r) - model.simulate(r))[r.n_init :]
        each.append((np.sum(e**2, axis=0), len(e)))
    rms = np.sqrt(sum(s for s, _ in each) / sum(n for _, n in each))
    return _plain(pairs[0][0], rms)


def _windows(pairs: Sequence[tuple[rf.Model, rf.Recording]]) -> Errors:
    """Errors of free runs that start again every `WINDOW` seconds."""
    recordings = [r for _, r in pairs]
    measured = [m.measured(r) for m, r in pairs]
    runs = [m.simulate_windows(r, WINDOW) for m, r in pairs]
    return _plain(pairs[0][0], rf.metrics.windowed_rmse(recordings, measured, runs, WINDOW))


def _plain(model: rf.Model, rms: Any) -> Errors:
    values = np.asarray(rms, float).tolist()
    return json_numbers(dict(zip(model.mechanism.channels, values, strict=True)))
