"""The page of a comparison: every method on the same recording."""

import datetime
import json
import math
from pathlib import Path
from typing import Any

from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.report.comparison_figures import horizons, looks, overlays, ranks, spectra
from rotflex_jax.report.page import save, template
from rotflex_jax.report.style import on_page
from rotflex_jax.report.wording import plain_number, readable, together

# An error within this factor of the least of its column is marked.
CLOSE = 1.05


def write(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.html` and `comparison.json`; returns the path of the page."""
    text = json.dumps(comparison.to_dict(), indent=2, ensure_ascii=False) + "\n"
    page = template("comparison.html.j2").render(content(comparison))
    save(folder, {"comparison.json": text, "comparison.html": page})
    return folder / "comparison.html"


def content(comparison: Comparison) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    units = dict(zip(comparison.test[0].channels, comparison.test[0].units, strict=True))
    good = [row for row in comparison.rows if row.status == "ok"]
    colours = {row.method: look[0] for row, look in looks(comparison)}
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
        "pictures": _pictures(comparison) if good else [],
        "recordings": [
            {
                "use": use,
                "source": r.source,
                "span": f"{r.start:g} to {r.start + r.duration:g} s",
                "samples": f"{r.N}, of which {r.n_init} may be looked at",
            }
            for use, listed in (("learnt from", comparison.train), ("judged on", comparison.test))
            for r in listed
        ],
        "elapsed": f"{comparison.elapsed_s:.0f}",
        "date": datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        "source": next((r.source for r in comparison.test if r.source), ""),
    }


def _summary(comparison: Comparison) -> str:
    best = comparison.best
    if best is None:
        return "No method came through: each failed, or its free run left the measured range."
    units = dict(zip(comparison.test[0].channels, comparison.test[0].units, strict=True))
    said = []
    for c, u in units.items():
        value, read = readable(best.rmse[c], u)
        floor = comparison.noise_floor.get(c, 0.0)
        times = (
            f", {plain_number(best.rmse[c] / floor, 2)} times the noise of the sensor" if floor > 0 else ""
        )
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
                    "best": marked and math.isfinite(value) and value <= CLOSE * least,
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


def _pictures(comparison: Comparison) -> list[dict[str, Any]]:
    drawn = (
        (
            "How the methods rank",
            ranks(comparison),
            "Dots: one free run over all held-out data. Diamonds: free runs that start anew every "
            f"{comparison.window_seconds:g} s. A dot far right of its own diamond drifts. "
            "Bold: best of its family.",
            "Error of every method on a logarithmic scale.",
        ),
        (
            "Measured and simulated",
            overlays(comparison),
            "The best method of each family. The pale stripe at the start is all that a method may look at; "
            "the grey band is what the sensor alone makes. The worst line may leave the picture.",
            "Measured and simulated outputs over time on held-out data, with their differences.",
        ),
        (
            "How far ahead",
            horizons(comparison),
            "Many short free runs, started all over the held-out data: how the error grows with the time "
            "since the last sample that was seen. A line that stays low can be trusted for long.",
            "Error against horizon on logarithmic scales.",
        ),
        (
            "What is left, by frequency",
            spectra(comparison),
            "Where a line lies on the dashed one, nothing is left to explain at these frequencies.",
            "Spectral density of the held-out error, with the level of white sensor noise.",
        ),
    )
    return [{"title": title, **on_page(figure, caption, alt)} for title, figure, caption, alt in drawn]
