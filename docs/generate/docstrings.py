"""Docstrings as they are: plain text with `code` in backticks and equations as indented blocks.

reStructuredText gives `|u|` and `2 * x` meanings of its own, and sets an indented block as a quotation. The
docstrings stay what a person reads in an editor; here they are translated.
"""

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Arguments|Attributes|Returns|Raises|Source|Example|Examples|Yields):$")


def plain(line: str) -> str:
    """A line of text in which marks mean themselves; what stands in backticks is code."""
    parts = re.split(r"(``[^`]*``|`[^`]*`)", line)
    for k in range(0, len(parts), 2):
        parts[k] = re.sub(r"([|*\\]|_(?=\W|$))", r"\\\1", parts[k])
    return "".join(parts)


def translated(lines: list[str]) -> list[str]:
    """The lines of a docstring as reStructuredText, before its sections are read."""
    out: list[str] = []
    section, equation, doctest, opened = False, False, False, False
    for number, line in enumerate(lines):
        text = line.strip()
        indented = line.startswith("    ")
        if not text:
            doctest = False
            out.append(line)
            continue
        if not indented:
            section, equation = bool(SECTION.match(text)), False
        elif not section and not lines[number - 1].strip() and not equation:
            equation = not text.startswith(">>>")
            if equation:
                out += [".. code-block:: text", ""]
        doctest = doctest or text.startswith(">>>")
        # A pair of backticks may run over the end of a line.
        if equation or doctest:
            out.append(line)
            continue
        if opened:
            line = "`" + line
        whole = line.count("`") % 2 == 0
        written = plain(line if whole else line + "`")
        if opened:
            written = written[1:]
        opened = not whole
        out.append(written if whole else written[:-1])
    return out


def translate(app: "Sphinx", what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Before napoleon reads the sections."""
    lines[:] = translated(lines)


def setup(app: "Sphinx") -> dict[str, bool]:
    """Enter the translation."""
    app.connect("autodoc-process-docstring", translate, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
