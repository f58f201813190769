"""Pages that need no other file and no network: their templates, and the folder they are written to."""

import datetime
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from rotflex_jax.errors import InputError
from rotflex_jax.text.files import write_file


def fill_template(package: str, name: str, content: Mapping[str, Any]) -> str:
    """A page as text.

    Args:
        package: Whose template it is; all share `page.html.j2` and one style sheet.
        name: Of the template.
        content: What it fills in; plain text, which it escapes. The date is added.
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
    """Write files into a folder, which is created; files of these names are replaced.

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
