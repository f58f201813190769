"""Text of others, such as names from files, made harmless for a terminal and for a spreadsheet."""

import unicodedata


def printable(text: str) -> str:
    r"""A text without codes that steer a terminal; these are shown as escapes, line ends and tabs stay.

    >>> print(printable("run\x1b[2J.csv"))
    run\x1b[2J.csv
    """
    return "".join(c if c in "\n\t" or not _steers(c) else ascii(c)[1:-1] for c in text)


def _steers(character: str) -> bool:
    """Whether a character is a control code, a change of the direction of writing, or half of a pair."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")


def one_line(text: str) -> str:
    r"""The same on one line.

    >>> print(one_line("run\n.csv"))
    run\n.csv
    """
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def spreadsheet_cell(text: str) -> str:
    """A text that no spreadsheet takes for a formula: an apostrophe stands before a sign that begins one.

    >>> spreadsheet_cell("=1+1"), spreadsheet_cell("run 7")
    ("'=1+1", 'run 7')
    """
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text
