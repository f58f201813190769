"""Pieces of HTML for a light or a dark notebook, with every text escaped."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

_CARD = "border-left:3px solid #0f6f86;padding:2px 0 2px 12px;margin:4px 0;line-height:1.4"
_TABLE = "border-collapse:collapse;margin:6px 0;font-variant-numeric:tabular-nums"
_CELL = "padding:1px 14px 1px 0;vertical-align:top;white-space:nowrap;border:0"


def card(title: str, *parts: str) -> str:
    """A titled block of parts that are HTML already.

    >>> card("Fit of <a>", paragraph("b & c"))[-59:]
    '<strong>Fit of &lt;a&gt;</strong><div>b &amp; c</div></div>'
    """
    inside = "".join(part for part in parts if part)
    return f'<div class="rotflex" style="{_CARD}"><strong>{escape(title)}</strong>{inside}</div>'


def paragraph(text: str) -> str:
    """A line of text."""
    return f"<div>{escape(text)}</div>"


def bullets(texts: Iterable[str]) -> str:
    """Lines of text with bullets; nothing where there are none."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul style="margin:4px 0">{items}</ul>' if items else ""


def folded(title: str, part: str) -> str:
    """A part that opens on a click; nothing where there is none."""
    return f"<details><summary>{escape(title)}</summary>{part}</details>" if part else ""


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> str:
    """A table of texts.

    Args:
        headings: One per column.
        rows: Cells.
        words: How many columns hold words; those after them hold numbers and stand to the right.
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
    """A drawing as an image that carries its own data.

    Args:
        svg: The drawing; nothing is shown where it is empty.
        says: What it shows, for those who cannot see it.
    """
    if not svg:
        return ""
    data = base64.b64encode(svg.encode()).decode("ascii")
    return (
        f'<img alt="{escape(says)}" src="data:image/svg+xml;base64,{data}" '
        'style="max-width:100%;height:auto;display:block;margin:6px 0"/>'
    )
