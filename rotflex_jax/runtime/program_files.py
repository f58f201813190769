"""Files of compiled programs: the folder, the names of files, and how they are read and written.

A program is stored under a hash of everything on which it depends: the function, structure and solver, the
shapes and types of the arrays, the source of this package, the versions and settings of JAX, and the
processor. Any difference gives another hash. A file contains the hash of its own content; a damaged file is
replaced. A stored program is machine code: do not share its folder with people whom you do not trust.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import os
import pickle
import platform
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.runtime.xla import FAST_LOOPS_FLAG, loops_are_fast, start_with_fast_loops

_PACKAGE, _SOURCES = __name__.partition(".")[0], sorted(Path(__file__).parents[1].rglob("*.py"))
# The source that this process has loaded; nothing is stored if a file has changed since about that time.
_LOADED, _ABOUT = time.time(), 10.0
_SOURCE = hashlib.sha256(b"".join(file.read_bytes() for file in _SOURCES)).hexdigest()
# Number of versions whose programs stay on disk; another source of the package, another JAX or setting of it,
# and another processor each make a version.
_VERSIONS = 6
# Settings on which tracing depends and which a context may change.
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision")
# Largest size [bytes] of the programs of one version on disk; how many programs are written between checks.
MOST_BYTES, _CHECK_EVERY = 1_000_000_000, 64
FOLDER_VARIABLE = "ROTFLEX_PROGRAMS"
"""Environment variable with the folder of compiled programs; with `off` no programs are kept."""


@dataclasses.dataclass
class _Storage:
    """Where programs are kept: in a chosen folder, in the default folder, or not at all."""

    chosen: Path | None = None
    off: bool = False
    written: int = 0
    lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)


_storage = _Storage()


def keep_programs(folder: str | Path | bool = True) -> None:
    """Choose where compiled programs are kept, for this process.

    Args:
        folder: The folder; True for the default folder, which `programs_folder` returns; False to keep none.

    Raises:
        InputError: The argument is neither a path nor a truth value, or it is the path of a file.
    """
    if not isinstance(folder, bool | str | Path) or folder == "":
        raise InputError(
            f"Argument `folder` must be a path, True or False, but is {checks.shown(folder)}; give True for "
            "the usual folder."
        )
    if not isinstance(folder, bool) and (path := Path(folder).expanduser()).exists() and not path.is_dir():
        raise InputError(f"Argument `folder` must be a folder, but {folder} is a file; give another one.")
    _storage.off = folder is False
    _storage.chosen = None if isinstance(folder, bool) else Path(folder).expanduser()


def programs_folder() -> Path | None:
    """Folder of compiled programs.

    Returns:
        The folder that `keep_programs` or the environment variable `ROTFLEX_PROGRAMS` chose; else a folder
        within the compilation cache of JAX, if the user has enabled that; else a folder in the user's cache.
        None if programs are not kept.
    """
    start_with_fast_loops()
    if _storage.off or len(jax.devices()) > 1 or jax.default_backend() != "cpu":
        return None
    if _storage.chosen is not None:
        return _storage.chosen
    if named := os.environ.get(FOLDER_VARIABLE):
        return None if named == "off" else Path(named).expanduser()
    values = jax.config.values
    beside = values["jax_compilation_cache_dir"] if values["jax_enable_compilation_cache"] else None
    if beside and "://" not in beside:
        return Path(beside) / "programs"
    return _usual_folder()


def version_folder() -> Path | None:
    """Folder of the programs that this version of the package can use on this machine.

    Returns:
        The folder; None if programs are not kept, or if the source on disk is not what this process has
        loaded.
    """
    folder = programs_folder()
    return folder / _surroundings() if folder is not None and _unchanged() else None


def file_name(text: str) -> str:
    """Name of the file for what a text identifies."""
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def _usual_folder() -> Path:
    import pooch

    return Path(pooch.os_cache("rotflex_jax")) / "compiled" / "programs"  # as the command line has it


def _surroundings() -> str:
    """Hash of everything on which all programs depend."""
    values = {n: v for n, v in jax.config.values.items() if "cache" not in n and n not in SETTINGS}
    parts = (_SOURCE, jax.__version__, metadata.version("jaxlib"), sorted(values.items()), _processor())
    options = [o for o in os.environ.get("XLA_FLAGS", "").split() if o != FAST_LOOPS_FLAG]
    parts = (*parts, options, loops_are_fast())
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


@functools.cache
def _processor() -> str:
    """Description of the processor, on which machine code depends."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(errors="replace").splitlines() if known.exists() else []
    chosen = {line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))}
    return f"{platform.system()} {platform.machine()} {platform.processor()} {sorted(chosen)}"


def _unchanged() -> bool:
    """Whether the source on disk is the same that this process has loaded."""
    return all(file.exists() and file.stat().st_mtime < _LOADED - _ABOUT for file in _SOURCES)


def prepare_loading() -> None:
    """Prepare JAX for programs from files; once is enough, and any thread may call it."""
    with _storage.lock:
        _prepare()


@functools.cache
def _prepare() -> None:
    """Let JAX register its linear algebra, as it does when it lowers a program that needs it."""
    jax.jit(jnp.linalg.solve).lower(np.eye(1, dtype=np.float32), np.ones(1, np.float32))


def static_key(value: Any) -> str:
    """A text that identifies a static value; empty if there is no such text.

    The text exists for values that consist of numbers, strings and classes of this package. The equation of a
    user's own effect may change unnoticed, so programs with such an effect are not stored.

    >>> from rotflex_jax.mechanism import Exponential
    >>> static_key(Exponential(order=4)).partition("(")[2][:9]
    '4,1,None,'
    """
    parts = list(_parts(value))
    return "" if None in parts else "".join(map(str, parts))


def _parts(value: Any) -> Iterator[str | None]:
    kind = type(value)
    if value is None or kind in (str, int, float, bool):
        yield repr(value)
    elif kind is tuple:
        yield "("
        for item in value:
            yield from _parts(item)
            yield ","
        yield ")"
    elif kind is frozenset:
        yield from _parts(tuple(sorted(value)))
    elif not kind.__module__.startswith(f"{_PACKAGE}."):
        yield None
    elif isinstance(value, enum.Enum):
        yield str(value)
    elif isinstance(value, tuple):  # a named tuple
        yield f"{kind.__module__}.{kind.__qualname__}"
        yield from _parts(tuple(value))
    elif dataclasses.is_dataclass(value):
        yield f"{kind.__module__}.{kind.__qualname__}"
        yield from _parts(tuple(getattr(value, f.name) for f in dataclasses.fields(value)))
    else:  # an object without attributes is identified by its class
        yield None if getattr(value, "__dict__", True) else f"{kind.__module__}.{kind.__qualname__}"


def tree_key(tree: Any) -> str:
    """A text that identifies the structure of arguments; empty if that cannot be told for certain."""
    node = tree.node_data()
    if node is None:
        return "*"
    kind, fields = node
    # Equinox marks a field without a value, such as one that stands among the parts, by an object of its own.
    values = [None if type(f).__module__.startswith("equinox._module") else f for f in fields or ()]
    said, parts = static_key(tuple(values)), [tree_key(part) for part in tree.children()]
    known = kind in (tuple, list, dict, type(None)) or kind.__module__.startswith(f"{_PACKAGE}.")
    if not known or not all((said, *parts)):
        return ""
    return f"{kind.__module__}.{kind.__qualname__}{said}({','.join(parts)})"


def read_program(file: Path) -> Callable[..., Any] | None:
    """The program in a file; None if the file is damaged."""
    data = file.read_bytes()
    digest, content = data[:32], data[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    prepare_loading()
    return serialize_executable.deserialize_and_load(*pickle.loads(content))


def mark_used(file: Path) -> None:
    """Note that a program was used: the least recently used programs and versions are deleted first."""
    os.utime(file)
    os.utime(file.parent)


def write_program(program: Any, file: Path) -> None:
    """Stores a program; if that fails, the next process compiles the program again."""
    with contextlib.suppress(Exception):  # the disk is full, or this JAX cannot store this program
        content = pickle.dumps(serialize_executable.serialize(program))
        if not file.parent.exists():
            _clear(file.parent.parent)
            file.parent.mkdir(parents=True, exist_ok=True)
        write_file(file, hashlib.sha256(content).digest() + content)
        with _storage.lock:
            _storage.written += 1
            if _storage.written % _CHECK_EVERY == 1:
                _shrink(file.parent, MOST_BYTES)


def write_file(file: Path, content: bytes) -> None:
    """Writes a file completely or not at all, also with several processes."""
    handle, name = tempfile.mkstemp(dir=file.parent)
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(content)
        os.replace(name, file)
    except OSError:
        os.unlink(name)
        raise


def _shrink(folder: Path, most: int) -> None:
    """Deletes the least recently used programs until at most `most` bytes are left."""
    total = 0
    for _, size, file in sorted(_stored(folder), reverse=True):
        total += size
        if total > most:
            file.unlink(missing_ok=True)


def stored_sizes() -> list[int]:
    """Sizes of the programs of this version on disk [bytes]."""
    folder = programs_folder()
    return [size for _, size, _ in _stored(folder / _surroundings())] if folder else []


def _stored(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Time of the last use, size and file of each program in a folder."""
    for file in folder.glob("*"):
        with contextlib.suppress(FileNotFoundError):  # another process has deleted it
            if file.is_dir():
                continue
            yield file.stat().st_mtime, file.stat().st_size, file


def _clear(folder: Path) -> None:
    """Deletes the least recently used versions, so that with one more there are `_VERSIONS` of them.

    A folder that the user chose may contain other things, so only folders whose names are such hashes count.
    """
    own = (f for f in folder.glob("*/") if re.fullmatch("[0-9a-f]{32}", f.name))
    found = sorted(own, key=lambda f: f.stat().st_mtime, reverse=True)
    for old in found[_VERSIONS - 1 :]:
        shutil.rmtree(old, ignore_errors=True)
