"""The report of a search as one HTML page."""

import json
from pathlib import Path

from rotflex_jax.discover.result import Discovery
from rotflex_jax.report.content import content
from rotflex_jax.report.page import save, template


def write(discovery: Discovery, folder: Path) -> Path:
    """Write `report.html` and `result.json`; returns the path of the page."""
    text = json.dumps(discovery.to_dict(), indent=2, ensure_ascii=False) + "\n"
    save(folder, {"result.json": text, "report.html": render(discovery)})
    return folder / "report.html"


def render(discovery: Discovery) -> str:
    """The page as text."""
    return template("report.html.j2").render(content(discovery))
