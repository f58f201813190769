"""A comparison as a table of words."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rotflex_jax.compare.table import Comparison, Row


def cells(comparison: "Comparison") -> list[list[str]]:
    """The table in words: headings, the methods that came through, the sensor noise."""
    units = dict(zip(comparison.test[0].channels, comparison.test[0].units, strict=True))
    head = ["method"]
    for what in (f"{comparison.window_seconds:g} s rms", "rms", "worst"):
        head += [f"{c} {what} [{_readable(0.0, unit)[1]}]" for c, unit in units.items()]
    head += [f"{c} fit [%]" for c in units]
    head += [f"{c} 1 step [{_readable(0.0, unit)[1]}]" for c, unit in units.items()]
    head += ["fitted", "fit [s]", "simulate [s]"]
    body = []
    for row in comparison.rows:
        if row.status == "ok":
            lengths = [
                _digits(_readable(errors[c], unit)[0])
                for errors in (row.rmse_windows, row.rmse, row.worst)
                for c, unit in units.items()
            ]
            shares = [f"{row.fit_percent[c]:.2f}" for c in units]
            ahead = [_digits(_one_step(row, c, unit)) for c, unit in units.items()]
            times = [_digits(row.fit_seconds), _digits(row.simulate_seconds)]
            body.append([row.method, *lengths, *shares, *ahead, str(row.parameters), *times])
    floor = [_digits(_readable(comparison.noise_floor[c], unit)[0]) for c, unit in units.items()]
    noise = ["sensor noise", *floor, *floor]
    return [head, *body, noise + [""] * (len(head) - len(noise))]


def aligned(cells: Sequence[Sequence[str]]) -> list[str]:
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


def _one_step(row: "Row", channel: str, unit: str) -> float | None:
    return _readable(row.rmse_one_step[channel], unit)[0] if channel in row.rmse_one_step else None


def _digits(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.3g}"
