"""Pieces of HTML with every text escaped, and pages that need no other file and no network."""

import base64
import datetime
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2

from rotflex_jax.errors import InputError
from rotflex_jax.text.files import write_file

_CARD = "border-left:3px solid #0f6f86;padding:2px 0 2px 12px;margin:4px 0;line-height:1.4"
_TABLE = "border-collapse:collapse;margin:6px 0;font-variant-numeric:tabular-nums"
_CELL = "padding:1px 14px 1px 0;vertical-align:top;white-space:nowrap;border:0"


def card(title: str, *parts: str) -> str:
    """A block with a title; its parts are HTML already.

    >>> card("Fit of <a>", paragraph("b & c"))[-59:]
    '<strong>Fit of &lt;a&gt;</strong><div>b &amp; c</div></div>'
    """
    inside = "".join(part for part in parts if part)
    return f'<div class="rotflex" style="{_CARD}"><strong>{escape(title)}</strong>{inside}</div>'


def paragraph(text: str) -> str:
    """A line of text."""
    return f"<div>{escape(text)}</div>"


def bullets(texts: Iterable[str]) -> str:
    """Lines of text with bullets; empty without lines."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul style="margin:4px 0">{items}</ul>' if items else ""


def folded(title: str, part: str) -> str:
    """A part that opens on a click; empty without a part."""
    return f"<details><summary>{escape(title)}</summary>{part}</details>" if part else ""


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> str:
    """A table of texts.

    Args:
        headings: Heading of each column.
        rows: Cells of each row.
        words: Number of columns with words; the columns after them contain numbers and are aligned right.
    """

    def line(cells: Sequence[str], tag: str) -> str:
        sides = ("left" if k < words else "right" for k in range(len(cells)))
        return "".join(
            f'<{tag} style="{_CELL};text-align:{side}">{escape(cell)}</{tag}>'
            for cell, side in zip(cells, sides, strict=True)
        )

    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    if not body:
        return ""
    head = f"<thead><tr>{line(headings, 'th')}</tr></thead>"
    return f'<div style="overflow-x:auto"><table style="{_TABLE}">{head}<tbody>{body}</tbody></table></div>'


def picture(svg: str, says: str) -> str:
    """A drawing as an HTML image that contains its own data.

    Args:
        svg: The drawing; the result is empty if it is empty.
        says: Description of the drawing for readers who cannot see it.
    """
    if not svg:
        return ""
    data = base64.b64encode(svg.encode()).decode("ascii")
    return (
        f'<img alt="{escape(says)}" src="data:image/svg+xml;base64,{data}" '
        'style="max-width:100%;height:auto;display:block;margin:6px 0"/>'
    )


def fill_template(package: str, name: str, content: Mapping[str, Any]) -> str:
    """An HTML page as text, from a template.

    Args:
        package: Package of the template; all packages share `page.html.j2` and one style sheet.
        name: Name of the template.
        content: Content of the template as plain text, which the template escapes. The date is added.
    """
    date = datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M")
    return _template(package, name).render({**content, "date": date})


@cache
def _template(package: str, name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p) for p in (package, "rotflex_jax.text")]),
        autoescape=jinja2.select_autoescape(("html.j2",)),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Writes files into a folder, which is created if needed; files with these names are replaced.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            write_file(folder / name, data)
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


def as_json(values: Mapping[str, Any]) -> str:
    """Plain values as the text of a JSON file."""
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"
