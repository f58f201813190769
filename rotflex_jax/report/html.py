"""The report as one HTML page that needs no other file and no network."""

import json
from functools import cache
from pathlib import Path

import jinja2

from rotflex_jax.discover.result import Discovery
from rotflex_jax.errors import InputError
from rotflex_jax.report.content import content


def write(discovery: Discovery, folder: Path) -> Path:
    """Write `report.html` and `result.json`; returns the path of the page."""
    page = render(discovery)
    text = json.dumps(discovery.to_dict(), indent=2, ensure_ascii=False) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(text, encoding="utf-8")
        (folder / "report.html").write_text(page, encoding="utf-8")
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(
            f"{folder} cannot hold the report, since {error.filename or folder} is a file and no "
            "folder; name another folder."
        ) from error
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written to ({error.strerror or error}), but the report needs a "
            "folder of its own; name another folder."
        ) from error
    return folder / "report.html"


def render(discovery: Discovery) -> str:
    """The page as text."""
    return _template().render(content(discovery))


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rotflex_jax.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2")
