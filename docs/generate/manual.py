"""The manual page `rotflex.1`, from the same declarations as `rotflex --help`.

`python docs/generate/manual.py` writes `docs/rotflex.1`, which the wheel installs; `--check` only compares.
"""

import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().parents[1] / "rotflex.1"

STATUS = (
    ("0", "The command did its work, whatever the verdict."),
    ("2", "Bad input: one sentence on stderr says what was given and what is needed."),
    ("130", "Stopped by Ctrl-C; what a search has finished is kept for --continue."),
)
VARIABLES = (
    ("ROTFLEX_DATA", "Folder with the recordings of public data sets, instead of downloads."),
    ("ROTFLEX_PROGRAMS", "Folder for compiled programs, or off to keep none; share it with nobody."),
)


def page() -> str:
    """The whole manual page in the language of man(7)."""
    import typer

    from rotflex_jax import __version__
    from rotflex_jax.cli.app import app

    root = typer.main.get_command(app)
    commands = list(_commands("rotflex", root))
    lines = [
        r".\" Written by docs/generate/manual.py from the options of the program; do not edit.",
        f'.TH ROTFLEX 1 "" "rotflex_jax {__version__}" "User Commands"',
        ".SH NAME",
        rf"rotflex \- {_text(str(root.help)[0].lower() + str(root.help)[1:].rstrip('.'))}",
        ".SH SYNOPSIS",
    ]
    for name, command in commands:
        usage = " ".join(_argument(p) for p in command.params if p.param_type_name == "argument")
        lines += [".P", rf"\fB{_text(name)}\fR [\fIOPTION\fR]... {_text(usage)}".rstrip()]
    lines += [".SH OPTIONS", *_options(root), ".SH COMMANDS"]
    for name, command in commands:
        lines += [f'.SS "{_text(name)}"', *_paragraphs(str(command.help)), *_options(command)]
    lines += [".SH EXIT STATUS", *_terms(STATUS), ".SH ENVIRONMENT", *_terms(VARIABLES)]
    return "\n".join(lines) + "\n"


def _commands(name: str, command: Any) -> Iterable[tuple[str, Any]]:
    """Every command that does something, with its full name, in the order of `--help`."""
    for short, inner in command.commands.items():
        if getattr(inner, "commands", None):
            yield from _commands(f"{name} {short}", inner)
        else:
            yield f"{name} {short}", inner


def _options(command: Any) -> list[str]:
    found = [(_head(p), _meaning(p)) for p in command.params if not getattr(p, "hidden", False)]
    return _terms(found)


def _head(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return _argument(parameter)
    value = "" if parameter.is_flag else f" {parameter.metavar or parameter.name.upper()}"
    return ", ".join([*parameter.opts, *parameter.secondary_opts]) + value


def _argument(parameter: Any) -> str:
    name = str(parameter.metavar or parameter.name.upper()).removesuffix("...")
    name += "..." if parameter.nargs != 1 else ""
    return name if parameter.required else f"[{name}]"


def _meaning(parameter: Any) -> str:
    default = None if parameter.required or getattr(parameter, "is_flag", False) else parameter.default
    said = default is None or default in ("", [], ()) or not parameter.show_default
    return str(parameter.help or "") + ("" if said else f" Default: {default}.")


def _terms(pairs: Iterable[tuple[str, str]]) -> list[str]:
    return [line for head, text in pairs for line in (".TP", rf"\fB{_text(head)}\fR", _text(text))]


def _paragraphs(text: str) -> list[str]:
    found = [" ".join(part.split()) for part in re.split(r"\n\s*\n", text)]
    return [line for part in found for line in (".P", _text(part))]


def _text(text: str) -> str:
    """Text as it stands: no commands of the formatter, no hyphens that a reader could not search for."""
    text = " ".join(text.split()).replace("\\", r"\e").replace("-", r"\-")
    return r"\&" + text if text.startswith((".", "'")) else text


if __name__ == "__main__":
    sys.path.insert(0, str(FILE.parents[1]))
    if "--check" not in sys.argv[1:]:
        FILE.write_text(page(), encoding="utf-8")
    elif FILE.read_text(encoding="utf-8") != page():
        sys.exit("docs/rotflex.1 is not current: python docs/generate/manual.py writes it.")
