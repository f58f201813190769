"""Files written whole or not at all."""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError

UNFINISHED: set[Path] = set()
"""Files that are being written, beside their places; whoever ends the process meanwhile takes them away."""


def path_of(given: Any) -> Path:
    """A path of what was given as one.

    Raises:
        InputError: Something else, such as a number, which would name an open file.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise InputError(f"The path of a file is needed, but {shown(given)} was given; give its name as text.")


def without_folder(path: Path) -> InputError:
    """What is said of a file whose folder does not exist."""
    return InputError(
        f"{path} cannot be written, since the folder {path.parent} does not exist; create it or name another."
    )


def write_file(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file beside its place and put it there in one step: an old file stays until then.

    Args:
        path: Of the file; a device or a pipe is written to as it is.
        content: Text, written in UTF-8, or bytes.

    Returns:
        The path.

    Raises:
        InputError: It cannot be written: a full disk, no such folder, no permission.
    """
    path = path_of(path)
    data = content if isinstance(content, bytes) else content.encode()
    place = Path(os.path.realpath(path))  # a link goes on pointing to the file
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
