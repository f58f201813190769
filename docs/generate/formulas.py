"""Formulas as drawings in the page itself: no script is fetched, and no TeX and no font is needed.

Matplotlib's own typesetting gives the outlines; they take the colour and the size of the text around them.
"""

import functools
import html
from typing import Any

import matplotlib
from docutils import nodes
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import MathTextParser
from matplotlib.path import Path
from matplotlib.textpath import TextPath
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)
SIZE = 100.0  # of an em in the coordinates of a drawing
COMMANDS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C", Path.CLOSEPOLY: "Z"}


@functools.cache
def drawing(tex: str) -> str:
    """A formula as an SVG element whose unit is the em.

    Raises:
        ValueError: something that Matplotlib does not know.
    """
    text = f"${' '.join(tex.split())}$"
    with matplotlib.rc_context({"mathtext.fontset": "cm"}):
        size = FontProperties(size=SIZE)
        width, height, depth, *_ = MathTextParser("path").parse(text, 72, size)
        outline = TextPath((0, 0), text, prop=size, usetex=False)
    steps = []
    for points, code in outline.iter_segments(curves=True, simplify=False):
        numbers = points if code != Path.CLOSEPOLY else []
        steps.append(COMMANDS[code] + " ".join(f"{-v if k % 2 else v:.0f}" for k, v in enumerate(numbers)))
    box = f"0 {depth - height:.0f} {width + 2:.0f} {height:.0f}"
    style = (
        f"width:{(width + 2) / SIZE:.2f}em;height:{height / SIZE:.2f}em;vertical-align:{-depth / SIZE:.2f}em"
    )
    label = html.escape(tex)
    return (
        f'<svg class="formula" role="img" aria-label="{label}" viewBox="{box}" style="{style}">'
        f'<path fill="currentColor" d="{"".join(steps)}"/></svg>'
    )


def _drawn(node: nodes.Element) -> str:
    """A formula that cannot be drawn is a warning at its place."""
    try:
        return drawing(node.astext())
    except ValueError as error:
        logger.warning("The formula %s cannot be drawn: %s", node.astext(), error, location=node)
        return ""


def visit_math(self: Any, node: nodes.math) -> None:
    """A formula in a line of text."""
    self.body.append(_drawn(node))
    raise nodes.SkipNode


def visit_math_block(self: Any, node: nodes.math_block) -> None:
    """A formula of its own."""
    self.body.append(f'<div class="formula">{_drawn(node)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Enter the renderer."""
    app.add_html_math_renderer("outlines", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
