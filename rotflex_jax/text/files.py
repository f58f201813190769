"""Writing of files, completely or not at all."""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError

UNFINISHED: set[Path] = set()
"""Temporary files that are being written; code that ends the process must delete them."""


def path_of(given: Any) -> Path:
    """The path that was given as text or as a path.

    Raises:
        InputError: Something else was given, such as a number, which would denote an open file.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise InputError(f"The path of a file is needed, but {shown(given)} was given; give its name as text.")


def is_search_result(content: Any) -> bool:
    """Whether the content of a JSON file is the result of a search, as `--json` writes it."""
    return isinstance(content, dict) and {"verdict", "rounds", "baseline"} <= set(content)


def without_folder(path: Path) -> InputError:
    """The error for a file whose folder does not exist."""
    return InputError(
        f"{path} cannot be written, since the folder {path.parent} does not exist; create it or name another."
    )


def write_file(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Writes a temporary file and renames it in one step, so that an old file is kept until then.

    Args:
        path: Path of the file; a device or a pipe is written to directly.
        content: Text, written in UTF-8, or bytes.

    Returns:
        The path.

    Raises:
        InputError: The file cannot be written: a full disk, no such folder, no permission.
    """
    path = path_of(path)
    data = content if isinstance(content, bytes) else content.encode()
    place = Path(os.path.realpath(path))  # a symbolic link is kept, and its target is replaced
    part = place.with_name(f".{place.name[:100]}.{os.getpid()}.part")
    try:
        if place.exists() and not place.is_file():
            place.write_bytes(data)
            return path
        try:
            UNFINISHED.add(part)
            with part.open("wb") as file:
                file.write(data)
            if place.exists():
                if not os.access(place, os.W_OK):
                    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
                shutil.copymode(place, part)
            part.replace(place)
        finally:
            part.unlink(missing_ok=True)
            UNFINISHED.discard(part)
    except OSError as error:
        if not place.parent.exists():
            raise without_folder(path) from error
        raise InputError(
            f"{path} cannot be written ({error.strerror or error}); make space or name another place."
        ) from error
    return path
