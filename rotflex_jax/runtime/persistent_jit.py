"""`jax.jit` with a persistent cache of traced programs, and compiler options for fast compilation.

For a loop of many small operations the newer fusion emitters of XLA take as long as the rest of the compiler,
and the loop runs no faster; so the older ones are used, where this XLA has the option. Nor is a program split
for several compiler threads, which is more work in total: a search compiles several programs at once anyway.

The compilation cache of JAX saves compilation, but the program has to be traced first, and for a mechanism
with thirty effects tracing takes longer than execution. So the traced program is stored as well, under a hash
of everything that tracing depends on: the function, structure and solver, the shapes and types of the
arrays, the source of this package, the version and the settings of JAX. Any difference gives another hash.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from jax import export
from jax.core import Tracer

_PACKAGE, _SOURCES = __name__.partition(".")[0], sorted(Path(__file__).parents[1].rglob("*.py"))
# The source as loaded by this process; nothing is stored if a file has changed since about then.
_LOADED, _ABOUT = time.time(), 10.0
_SOURCE = hashlib.sha256(b"".join(file.read_bytes() for file in _SOURCES)).hexdigest()
# Versions of the source whose programs stay on disk, such as working copy, installed, and for comparison.
_VERSIONS = 3
# Settings that a program is traced with and that a context may change.
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision")
# What `jax.export` writes its files with.
_WRITES = importlib.util.find_spec("flatbuffers") is not None
# With these settings JAX does more at each call than run a program.
_WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
_FOR_COMPILER = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
_programs: list["PersistentJit"] = []


class PersistentJit:
    """`jax.jit` of a pure function whose first arguments are static, kept on disk beside JAX's own cache.

    Do not differentiate it or map over it: write the function that is to be traced inside of it. Nothing is
    kept where no folder is set (`enable_compilation_cache`). On other devices than a CPU, and inside of
    other programs, it is `jax.jit` and nothing else.

    Args:
        function: Pure; a function of a module of this package that returns an array, a tuple of them, or a
            named tuple that `jax.export` knows (`register_namedtuple_serialization`).
        static: How many of the first arguments are static.
    """

    def __init__(self, function: Callable[..., Any], static: int) -> None:
        self.jitted = jax.jit(function, static_argnums=tuple(range(static)))
        self._static = static
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._held: dict[Any, Callable[..., Any]] = {}
        _programs.append(self)

    def __call__(self, *arguments: Any) -> Any:
        """What the function returns."""
        known, leaves = arguments[: self._static], jax.tree.leaves(arguments[self._static :])
        if _plain() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return self.jitted(*arguments)
        tree = jax.tree.structure(arguments[self._static :])
        kinds = tuple(jax.typeof(leaf) for leaf in leaves)
        settings = tuple(getattr(jax.config, s) for s in _SETTINGS)
        key = (known, tree, kinds, settings)
        if key not in self._held:
            texts = [static_key(x) for x in known]
            lasting = _keeps() and all(texts) and _unchanged()
            name = f"{self._name}{texts}{tree}{kinds}{settings}" if lasting else ""
            self._held[key] = self._made(known, tree, leaves, name)
        return self._held[key](*leaves)

    def __len__(self) -> int:
        """How many programs the process holds: one per structure and shapes of the arguments."""
        return len(self._held) + self.jitted._cache_size()  # pyright: ignore[reportAttributeAccessIssue]

    def release_programs(self) -> None:
        """Let go of the programs in memory."""
        self._held.clear()

    def _made(self, known: tuple[Any, ...], tree: Any, leaves: list[Any], name: str) -> Callable[..., Any]:
        """The program for arguments like these as a function of their leaves; on disk if it has a name."""

        def flat(*leaves: Any) -> Any:
            return self.jitted(*known, *jax.tree.unflatten(tree, leaves))

        if not name:
            return jax.jit(flat, compiler_options=_options())
        file = _folder() / hashlib.sha256(name.encode()).hexdigest()
        program = _read(file)
        if program is None:
            program = export.export(jax.jit(flat))(*leaves)
            _write(program.serialize(), file)
        # Also a new program is compiled in this form, so that the compilation cache finds it again.
        return jax.jit(program.call, compiler_options=_options())


def persistent_jit(static: int) -> Callable[[Callable[..., Any]], PersistentJit]:
    """Decorator: the function as a `PersistentJit`, its first `static` arguments static."""
    return lambda function: PersistentJit(function, static)


def release_programs() -> None:
    """Releases all programs in memory; those on disk stay."""
    for program in _programs:
        program.release_programs()


def static_key(value: Any) -> str:
    """A text that identifies a static value; empty where there is none.

    It exists for values made of numbers, strings and classes of this package. The equation of an effect of a
    user may change unnoticed, so programs with one are not stored.

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
    else:
        yield f"{kind.__module__}.{kind.__qualname__}"
        fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
        yield from _parts(tuple(getattr(value, f.name) for f in fields))


def _plain() -> bool:
    """Whether to use `jax.jit` alone: not on a CPU, or with checks at each call."""
    return jax.default_backend() != "cpu" or any(getattr(jax.config, w) for w in _WATCHED)


@functools.cache
def _options() -> dict[str, Any]:
    """For the compiler; those that this XLA knows."""
    known = {}
    for name, value in _FOR_COMPILER.items():
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
            known[name] = value
    return known


def _keeps() -> bool:
    """Whether programs are stored: where JAX stores compiled code."""
    known = jax.config.values
    folder = known["jax_compilation_cache_dir"]
    return bool(_WRITES and known["jax_enable_compilation_cache"] and folder and "://" not in folder)


def _folder() -> Path:
    """Folder of the programs of this source."""
    return Path(jax.config.values["jax_compilation_cache_dir"]) / "programs" / _surroundings()


@functools.cache
def _surroundings() -> str:
    """Hash of everything that all programs depend on."""
    values = {n: v for n, v in jax.config.values.items() if "cache" not in n and n not in _SETTINGS}
    return hashlib.sha256(f"{_SOURCE}{jax.__version__}{sorted(values.items())}".encode()).hexdigest()[:32]


def _unchanged() -> bool:
    """Whether the source on disk is what this process has loaded."""
    return all(file.exists() and file.stat().st_mtime < _LOADED - _ABOUT for file in _SOURCES)


def _read(file: Path) -> export.Exported | None:
    """The program in a file; None where there is none, or none that can be used."""
    try:
        return export.deserialize(bytearray(file.read_bytes()))
    except Exception:  # missing or damaged: it is traced again
        return None


def _write(data: bytearray, file: Path) -> None:
    """Stores a program; where that fails, the next process traces it again."""
    try:
        if not file.parent.exists():
            _clear(file.parent.parent)
            file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent)
        with os.fdopen(handle, "wb") as out:
            out.write(data)
        os.replace(name, file)  # complete or not at all, also with several processes
    except OSError:
        return


def _clear(folder: Path) -> None:
    """Deletes the oldest versions, so that with one more there are `_VERSIONS`."""
    found = sorted(folder.glob("*/"), key=lambda f: f.stat().st_mtime, reverse=True)
    for old in found[_VERSIONS - 1 :]:
        shutil.rmtree(old, ignore_errors=True)


# Linux allows 65530 by default; beyond that the compiler ends the process. One search may add some 30000
# where it tries many different structures.
MOST_MEMORY_MAPS = 30_000


def clear_compilation_caches(most: int = MOST_MEMORY_MAPS) -> bool:
    """Releases all compiled code where the process has many memory maps; it is compiled again if needed.

    Args:
        most: Maps the process may hold.

    Returns:
        Whether code was released; never where the number of maps is not known (anywhere but on Linux).
    """
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") < most:
        return False
    release_programs()
    jax.clear_caches()
    return True
