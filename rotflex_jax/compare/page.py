"""The page of a comparison: every method on the same recording, with its figures."""

import math
from pathlib import Path
from typing import Any

from rotflex_jax.compare.figures import FIGURES, line_styles
from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.text.numbers import multiple, plain_number, readable, together
from rotflex_jax.text.plotting import by_section
from rotflex_jax.text.templates import as_json, fill_template, write_files

# An error within this factor of the least of its column is marked.
NEAR_BEST = 1.05


def write(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.html` and `comparison.json`; returns the path of the page."""
    files = {"comparison.json": as_json(comparison.to_dict()), "comparison.html": render(comparison)}
    write_files(folder, files)
    return folder / "comparison.html"


def render(comparison: Comparison) -> str:
    """The page as text."""
    return fill_template("rotflex_jax.compare", "comparison.html.j2", content(comparison))


def content(comparison: Comparison) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    units = dict(zip(comparison.test[0].channels, comparison.test[0].units, strict=True))
    good = [row for row in comparison.rows if row.status == "ok"]
    colours = {row.method: style[0] for row, style in line_styles(comparison)}
    return {
        "summary": _summary(comparison),
        "seconds": f"{comparison.window_seconds:g}",
        "headings": [f"{c} [{readable(1.0, u)[1]}]" for c, u in units.items()],
        "rows": [_row(row, comparison, units, good, colours) for row in good],
        "noise": [plain_number(readable(comparison.noise_floor[c], u)[0]) for c, u in units.items()],
        "bad": [
            (row.method, row.title, row.status, together(row.reason))
            for row in comparison.rows
            if row.status != "ok"
        ],
        "notes": [(row.method, row.title, together(row.note)) for row in good],
        "pictures": by_section(FIGURES.pictures(comparison).values()) if good else {},
        "recordings": [
            {
                "use": use,
                "source": r.source,
                "span": f"{r.start:g} to {r.start + r.duration:g} s",
                "samples": f"{r.N}, of which a model may see the first {r.n_init}",
            }
            for use, listed in (("fitted", comparison.train), ("held out", comparison.test))
            for r in listed
        ],
        "elapsed": f"{comparison.elapsed_s:.0f}",
        "source": next((r.source for r in comparison.test if r.source), ""),
    }


def _summary(comparison: Comparison) -> str:
    best = comparison.best
    if best is None:
        return "No method gave a result: each failed, or its free run left the measured range."
    units = dict(zip(comparison.test[0].channels, comparison.test[0].units, strict=True))
    said = []
    for c, u in units.items():
        value, read = readable(best.rmse[c], u)
        floor = comparison.noise_floor.get(c, 0.0)
        times = f", {multiple(best.rmse[c] / floor)} times the noise of the sensor" if floor > 0 else ""
        said.append(f"{c} {plain_number(value)} {read}{times}")
    others = [row.method for row in comparison.best_of_each_family[1:]]
    tail = f" Best of the other families: {', '.join(others)}." if others else ""
    return (
        f"Closest in one free run over the held-out data is {best.method}, {best.title}: "
        f"{'; '.join(said)} rms.{tail}"
    )


def _row(
    row: Row, comparison: Comparison, units: dict[str, str], good: list[Row], colours: dict[str, str]
) -> dict[str, Any]:
    def cells(name: str, marked: bool = True) -> list[dict[str, Any]]:
        made = []
        for c, u in units.items():
            value = getattr(row, name).get(c, math.nan)
            least = min(
                (e for r in good if math.isfinite(e := getattr(r, name).get(c, math.nan))), default=math.nan
            )
            made.append(
                {
                    "value": plain_number(readable(value, u)[0]) if math.isfinite(value) else "–",
                    "best": marked and math.isfinite(value) and value <= NEAR_BEST * least,
                }
            )
        return made

    return {
        "method": row.method,
        "title": row.title,
        "family": row.family,
        "colour": colours.get(row.method, ""),
        "whole": cells("rmse"),
        "windows": cells("rmse_windows"),
        "worst": cells("worst"),
        "step": cells("rmse_one_step"),
        "nrmse": [plain_number(row.nrmse[c], 2) if math.isfinite(row.nrmse[c]) else "–" for c in units],
        "fit": [f"{row.fit_percent[c]:.1f}" if math.isfinite(row.fit_percent[c]) else "–" for c in units],
        "parameters": row.parameters,
        "fit_s": plain_number(row.fit_seconds, 3),
        "run_ms": plain_number(1e3 * row.simulate_seconds, 3) if row.simulate_seconds is not None else "–",
    }
