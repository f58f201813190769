"""What `rotflex reproduce` leaves behind: a page, its figures as PNG, and the result as JSON."""

import io
import math
from pathlib import Path
from typing import Any

from rotflex_jax.reproduce import wording
from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.figures import FIGURES
from rotflex_jax.reproduce.wording import number
from rotflex_jax.text.plotting import Picture, by_section
from rotflex_jax.text.templates import as_json, fill_template, write_files

# Resolution of the figures [dots per inch].
DPI = 150


def write(result: Reproduction, folder: Path) -> Path:
    """Write `reproduce.html`, a PNG for every figure and `result.json`; returns the path of the page.

    Args:
        result: Of `reproduce`.
        folder: Is created; files of these names are replaced.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    drawn = FIGURES.pictures(result)
    page = fill_template("rotflex_jax.reproduce", "reproduce.html.j2", content(result, drawn))
    images = {f"{name}.png": _png(picture) for name, picture in drawn.items()}
    write_files(folder, {**images, "result.json": as_json(result.to_dict()), "reproduce.html": page})
    return folder / "reproduce.html"


def _png(picture: Picture) -> bytes:
    file = io.BytesIO()
    picture.figure.savefig(file, dpi=DPI, format="png")
    return file.getvalue()


def content(result: Reproduction, drawn: dict[str, Picture]) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    s, records = result.settings, result.records
    sources = dict.fromkeys(r.source for r in (*records.train, *records.test) if r.source)
    return {
        "headline": wording.headline(result),
        "summary": wording.summary(result),
        "tiles": _tiles(result),
        "online": wording.online(result),
        "lessons": wording.lessons(result),
        "plateau": wording.plateau(result),
        "headings": headings(result),
        "rows": _rows(result),
        "pulsed": bool(records.pulses),
        "measured": records.measured,
        "kernels": "" if result.kernels is None else str(result.kernels),
        "settings": [_setting(row) for row in result.setting_rows()],
        "pictures": by_section(drawn.values()),
        "source": ", ".join(sources) if records.measured else f"simulated, {s.scenario}",
        "elapsed": number(result.elapsed_s, 2),
    }


def headings(result: Reproduction) -> list[str]:
    """Of the columns with errors."""
    return ["held out", *(f"pulse {p.height:+g} V".replace("-", "−") for p in result.records.pulses)]


def table(result: Reproduction) -> list[list[str]]:
    """Name and errors of every model, for a terminal."""
    return [
        [row.name, str(row.size), *(number(e) for e in (row.held_out, *row.pulses))] for row in result.rows
    ]


def _tiles(result: Reproduction) -> list[dict[str, str]]:
    a, (lms, linear, physical) = result.adaptation, wording.names(result)
    errors = {name: result.row(name).held_out for name in (lms, linear, physical)}
    return [
        {
            "name": "iterations until the coefficient rests",
            "was": number(a.prediction.settle, 4),
            "value": "–" if a.settle is None else number(a.settle, 4),
            "note": "predicted → measured",
        },
        {
            "name": "held-out error (NMSE)",
            "was": f"{number(errors[physical])} → {number(errors[linear])}",
            "value": number(errors[lms]),
            "note": "linearised → identified linear → the paper's",
        },
        {
            "name": "online error of the same run",
            "was": "",
            "value": number(a.online),
            "note": "follows the data: not an error of a model",
        },
    ]


def _rows(result: Reproduction) -> list[dict[str, Any]]:
    columns = list(zip(*[(row.held_out, *row.pulses) for row in result.rows], strict=True))
    least = [min((e for e in column if math.isfinite(e)), default=math.nan) for column in columns]
    paper = wording.names(result)[0]
    return [
        {
            "name": row.name,
            "about": row.about,
            "size": row.size,
            "paper": row.name == paper,
            "errors": [
                {"value": number(e), "best": e == best}
                for e, best in zip((row.held_out, *row.pulses), least, strict=True)
            ],
        }
        for row in result.rows
    ]


def _setting(row: dict[str, Any]) -> dict[str, Any]:
    show = lambda value: f"{_plain(value)} {row['unit']}".strip()  # noqa: E731
    return row | {"value": show(row["value"]), "default": show(row["default"])}


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        pairs = (f"{v[0]}={v[1]:g}" if isinstance(v, tuple) else str(v) for v in value)
        return ", ".join(pairs) or "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
