"""The result of a comparison: one row per method, best first, and the sensor noise."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rotflex_jax.compare.method import Simulator
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Errors = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Row:
    """One method.

    Attributes:
        method: Its name.
        title: What it is.
        status: `ok`, `diverged` or `failed`.
        reason: Why it failed or diverged; "" where it did not.
        note: What else to know: its order, what it left out or added.
        rmse: Channel -> root mean square error of one free run over the held-out data [unit].
        nrmse: The same over the standard deviation of the measurement [-].
        fit_percent: 100 (1 - nrmse) [%].
        worst: Largest error of that free run [unit].
        rmse_windows: Root mean square error of free runs that start anew every few seconds [unit].
        parameters: How many numbers were fitted; None where the method failed.
        fit_seconds: Time to learn [s], with the compilation of code that no earlier method needed.
        simulate_seconds: Time of the free runs over the held-out data, compiled before [s].
        simulator: What the method learnt; None where it failed.
        simulated: Its free run over each held-out recording (N, C).
    """

    method: str
    title: str
    status: str = "ok"
    reason: str = ""
    note: str = ""
    rmse: Errors = dataclasses.field(default_factory=dict)
    nrmse: Errors = dataclasses.field(default_factory=dict)
    fit_percent: Errors = dataclasses.field(default_factory=dict)
    worst: Errors = dataclasses.field(default_factory=dict)
    rmse_windows: Errors = dataclasses.field(default_factory=dict)
    parameters: int | None = None
    fit_seconds: float | None = None
    simulate_seconds: float | None = None
    simulator: Simulator | None = dataclasses.field(default=None, repr=False)
    simulated: tuple[np.ndarray, ...] = dataclasses.field(default=(), repr=False)

    @property
    def score(self) -> float:
        """Mean over the channels of the log of `rmse`; infinite unless the method is `ok`."""
        if self.status != "ok":
            return math.inf
        return float(np.mean([math.log(max(e, 1e-300)) for e in self.rmse.values()]))

    def to_dict(self, window_seconds: float) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "method": self.method,
            "title": self.title,
            "status": self.status,
            "reason": self.reason,
            "note": self.note,
            "held_out_rmse": _plain(self.rmse),
            "held_out_rmse_windows": {"seconds": window_seconds, **_plain(self.rmse_windows)},
            "held_out_nrmse": _plain(self.nrmse),
            "held_out_fit_percent": _plain(self.fit_percent),
            "held_out_worst": _plain(self.worst),
            "parameters": self.parameters,
            "fit_seconds": self.fit_seconds,
            "simulate_seconds": self.simulate_seconds,
        }


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Methods side by side.

    Attributes:
        rows: One per method, the smallest free-run error first, what diverged or failed last.
        train: Recordings that were learnt from.
        test: Recordings that no method saw beyond their first `n_init` samples.
        noise_floor: Channel -> standard deviation of the sensor noise [unit].
        window_seconds: Length of the windows [s].
        elapsed_s: Time taken [s].
    """

    rows: tuple[Row, ...]
    train: tuple[Recording, ...]
    test: tuple[Recording, ...]
    noise_floor: Errors
    window_seconds: float
    elapsed_s: float

    @property
    def best(self) -> Row | None:
        """The method with the smallest error of one free run (geometric mean over the channels)."""
        return self.rows[0] if self.rows and self.rows[0].status == "ok" else None

    def __getitem__(self, method: str) -> Row:
        """The row of a method."""
        for row in self.rows:
            if row.method == method:
                return row
        raise InputError(
            f"The row of {method!r} was asked for, but the table has "
            f"{', '.join(row.method for row in self.rows)}; name one of these."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, schema 1."""
        return {
            "schema": 1,
            "best": self.best.method if self.best else None,
            "rows": [row.to_dict(self.window_seconds) for row in self.rows],
            "noise_floor": _plain(self.noise_floor),
            "train": [_described(r) for r in self.train],
            "test": [_described(r) for r in self.test],
            "elapsed_s": self.elapsed_s,
        }

    def cells(self) -> list[list[str]]:
        """The table in words: headings, the methods that came through, the sensor noise."""
        units = dict(zip(self.test[0].channels, self.test[0].units, strict=True))
        head = ["method"]
        for what in (f"{self.window_seconds:g} s rms", "rms", "worst"):
            head += [f"{c} {what} [{_readable(0.0, unit)[1]}]" for c, unit in units.items()]
        head += [f"{c} fit [%]" for c in units]
        head += ["fitted", "fit [s]", "simulate [s]"]
        body = []
        for row in self.rows:
            if row.status == "ok":
                lengths = [
                    _digits(_readable(errors[c], unit)[0])
                    for errors in (row.rmse_windows, row.rmse, row.worst)
                    for c, unit in units.items()
                ]
                shares = [f"{row.fit_percent[c]:.2f}" for c in units]
                times = [_digits(row.fit_seconds), _digits(row.simulate_seconds)]
                body.append([row.method, *lengths, *shares, str(row.parameters), *times])
        floor = [_digits(_readable(self.noise_floor[c], unit)[0]) for c, unit in units.items()]
        noise = ["sensor noise", *floor, *floor]
        return [head, *body, noise + [""] * (len(head) - len(noise))]

    def __str__(self) -> str:
        """The table, then a line for each method that has something to say."""
        lines = _aligned(self.cells())
        for row in self.rows:
            said = "; ".join(filter(None, (row.reason, row.note)))
            state = "" if row.status == "ok" else f"{row.status}: "
            if said or state:
                lines.append(f"{row.method}: {state}{said}")
        return "\n".join(lines)


def _aligned(cells: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a plain table; headings in two lines, so that it stays narrow."""
    halves = [[h.rpartition(" ")[0] for h in cells[0]], [h.rpartition(" ")[2] for h in cells[0]]]
    halves[0][0], halves[1][0] = "", cells[0][0]
    rows = [*halves, *cells[1:]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            [
                row[0].ljust(widths[0]),
                *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)),
            ]
        ).rstrip()
        for row in rows
    ]


def _readable(value: float, unit: str) -> tuple[float, str]:
    """Degrees where a person reads an angle."""
    return (math.degrees(value), "deg") if unit == "rad" else (value, unit)


def _digits(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.3g}"


def _described(recording: Recording) -> dict[str, Any]:
    return {
        "source": recording.source,
        "start_s": recording.start,
        "seconds": recording.duration,
        "samples": recording.N,
        "n_init": recording.n_init,
    }


def _plain(values: Errors) -> dict[str, float | None]:
    return {k: float(v) if math.isfinite(v) else None for k, v in values.items()}
