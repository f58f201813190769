"""Pages that need no other file and no network: their templates, and the folder they are written to."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import jinja2

from rotflex_jax.errors import InputError


@cache
def template(name: str, package: str = "rotflex_jax.report") -> jinja2.Template:
    """A template of a package; all share the style sheet of the report."""
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p) for p in (package, "rotflex_jax.report")]),
        autoescape=jinja2.select_autoescape(("html.j2",)),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def save(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files into a folder, which is created; files of these names are replaced.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            if isinstance(data, bytes):
                (folder / name).write_bytes(data)
            else:
                (folder / name).write_text(data, encoding="utf-8")
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
