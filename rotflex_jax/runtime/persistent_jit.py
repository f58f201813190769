"""`jax.jit` whose compiled programs are kept on disk, and compiler options for fast compilation.

For a loop of many small operations the newer fusion emitters of XLA take as long as the rest of the compiler,
and the loop runs no faster; so the older ones are used, where this XLA has the option. Nor is a program split
for several compiler threads, which is more work in total: a search compiles several programs at once anyway.

Tracing and compiling a mechanism takes seconds, running it milliseconds. So the compiled program is stored
under a hash of everything that it depends on: the function, structure and solver, the shapes and types of the
arrays, the source of this package, the versions and settings of JAX, the processor. Any difference gives
another hash. A file carries the hash of its own content; one that is damaged is replaced. A stored program is
machine code: its folder must not be shared with people who are not trusted.
"""

import collections
import contextlib
import ctypes
import dataclasses
import enum
import functools
import gc
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
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.runtime.xla import FAST_LOOPS_FLAG, cores, loops_are_fast, start_with_fast_loops

_PACKAGE, _SOURCES = __name__.partition(".")[0], sorted(Path(__file__).parents[1].rglob("*.py"))
# The source as loaded by this process; nothing is stored if a file has changed since about then.
_LOADED, _ABOUT = time.time(), 10.0
_SOURCE = hashlib.sha256(b"".join(file.read_bytes() for file in _SOURCES)).hexdigest()
# Versions whose programs stay on disk, by source of the package, JAX with its settings, and processor.
_VERSIONS = 6
# Settings that a program is traced with and that a context may change.
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision")
# Programs on disk: at most so many bytes of one version of the source, checked after so many are written.
MOST_BYTES, _CHECK_EVERY = 1_000_000_000, 64
FOLDER_VARIABLE = "ROTFLEX_PROGRAMS"
"""Environment variable with the folder of compiled programs; `off` keeps none."""
# With these settings JAX does more at each call than run a program.
_WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
_FOR_COMPILER = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
_programs: list["PersistentJit"] = []
# Programs held in memory, that used last at the end: each takes some 14 MB, and loading it again 0.1 s. Where
# there are more than the first number, those not used for longest are released down to the second.
MOST_HELD, LEFT_HELD = 96, 72
_recent: collections.OrderedDict["_Held", None] = collections.OrderedDict()
_recent_lock = threading.Lock()
_thread = threading.local()


# Names of the files of programs that are used inside of each `loaded_ahead`, in order of their first use.
_notes: list[dict[str, None]] = []
# Programs that threads load from their files before they are needed.
_coming: dict[Path, Future[Callable[..., Any] | None]] = {}
# Lists by which programs were loaded ahead since programs were released last.
_loaded_by: set[Path] = set()


@dataclasses.dataclass(frozen=True, eq=False)
class _Held:
    """A program in memory, where it is held, and its file if it has one."""

    program: Callable[..., Any]
    place: dict[Any, "_Held"]
    key: Any
    file: Path | None


class _Paused:
    """While programs are made, by any thread, the search of cyclic garbage rests, if it was on.

    Tracing makes so many objects that Python goes through all that the process holds again and again, and
    meanwhile every thread waits: a tenth of the time of a first search.
    """

    def __init__(self) -> None:
        self._lock, self._users, self._was_on = threading.Lock(), 0, False

    def __enter__(self) -> None:
        with self._lock:
            if not self._users:
                self._was_on = gc.isenabled()
                gc.disable()
            self._users += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users and self._was_on:
                gc.enable()


_without_garbage_collection = _Paused()


@dataclasses.dataclass
class _Storage:
    """Where programs are kept: a folder that was chosen, the usual one, or none."""

    chosen: Path | None = None
    off: bool = False
    written: int = 0
    lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)


_storage = _Storage()


class PersistentJit:
    """`jax.jit` of a pure function whose first arguments are static; compiled programs are kept on disk.

    Do not differentiate it or map over it: write the function that is to be traced inside of it. On other
    devices than a CPU, and inside of other programs, it is `jax.jit` and nothing else.

    Args:
        function: Pure; a function of a module of this package that returns arrays, in tuples or named tuples.
        static: How many of the first arguments are static.
        optimisation_level: Of LLVM; what XLA takes by itself, 3, if None. At level 1 loops over samples run
            as fast as at level 3 and compile in four fifths of the time; runs with slopes need level 3.
            Level 0 is for large programs that run a few times: they compile in half of the time, and loops
            take five to ten times as long.
    """

    def __init__(
        self, function: Callable[..., Any], static: int, optimisation_level: int | None = None
    ) -> None:
        self.jitted = jax.jit(function, static_argnums=tuple(range(static)))
        level = optimisation_level
        self._level = {} if level is None else {"xla_backend_optimization_level": level}
        self._static = static
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._held: dict[Any, _Held] = {}
        # Programs that a thread is making; another one that needs the same waits.
        self._in_work: dict[Any, Future[None]] = {}
        _programs.append(self)

    def __call__(self, *arguments: Any) -> Any:
        """What the function returns."""
        start_with_fast_loops()
        known, leaves = arguments[: self._static], jax.tree.leaves(arguments[self._static :])
        if _plain() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return self.jitted(*arguments)
        tree = jax.tree.structure(arguments[self._static :])
        kinds = tuple(jax.typeof(leaf) for leaf in leaves)
        settings = tuple(getattr(jax.config, s) for s in _SETTINGS)
        key = (known, tree, kinds, settings)
        held = self._held.get(key) or self._awaited(key)
        if held is not None:
            if getattr(_thread, "may_stop", False):
                raise _NothingToMakeError
            _used(held)
            return held.program(*leaves)
        _thread.may_stop = False
        try:
            file = self._file(known, tree, kinds, settings)
            program, result = self._made(known, tree, leaves, file)
            held = self._held[key] = _Held(program, self._held, key, file)
        finally:  # where it failed, the next thread that waits makes it itself
            with _recent_lock:
                self._in_work.pop(key).set_result(None)
        _used(held)
        return result

    def _awaited(self, key: Any) -> _Held | None:
        """The program that another thread makes, once it is there; None where this thread is to make it."""
        while True:
            with _recent_lock:
                held, begun = self._held.get(key), self._in_work.get(key)
                if held is not None:
                    return held
                if begun is None:
                    self._in_work[key] = Future()
                    return None
            begun.result()

    def _file(self, known: tuple[Any, ...], tree: Any, kinds: Any, settings: Any) -> Path | None:
        """Where the program of some arguments is kept; None where it is not."""
        texts, folder = [static_key(x) for x in known], programs_folder()
        if folder is None or not all(texts) or not _unchanged():
            return None
        name = f"{self._name}{texts}{tree}{kinds}{settings}"
        return folder / _surroundings() / hashlib.sha256(name.encode()).hexdigest()

    def __len__(self) -> int:
        """How many programs the process holds: one per structure and shapes of the arguments."""
        return len(self._held) + self.jitted._cache_size()  # pyright: ignore[reportAttributeAccessIssue]

    def release_programs(self) -> None:
        """Let go of the programs in memory."""
        with _recent_lock:
            for held in list(self._held.values()):
                _recent.pop(held, None)
        self._held.clear()

    def _made(
        self, known: tuple[Any, ...], tree: Any, leaves: list[Any], file: Path | None
    ) -> tuple[Callable[..., Any], Any]:
        """The program for arguments like these as a function of their leaves, and what it gives for them.

        It is kept in the file, if any.
        """

        def flat(*leaves: Any) -> Any:
            return self.jitted(*known, *jax.tree.unflatten(tree, leaves))

        program = jax.jit(flat, compiler_options=_options() | self._level)
        began = time.perf_counter()
        stored = None if file is None else _read(file, leaves)
        if stored is not None:
            _count(loaded=1)
            return stored
        if file is None:
            with _without_garbage_collection:
                result = program(*leaves)
            _count(compiled=1, seconds=time.perf_counter() - began)
            return program, result
        with _without_garbage_collection:
            compiled = program.lower(*leaves).compile()
        _count(compiled=1, seconds=time.perf_counter() - began)
        _write(compiled, file)
        return compiled, compiled(*leaves)


def persistent_jit(
    static: int, optimisation_level: int | None = None
) -> Callable[[Callable[..., Any]], PersistentJit]:
    """Decorator: the function as a `PersistentJit`; arguments as there."""
    return lambda function: PersistentJit(function, static, optimisation_level)


def make_ahead(function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function on a thread of its own, for the programs that it makes; its result is dropped.

    For programs that are needed soon, so that they are made while something else is waited for. Whoever needs
    a program that is being made waits for it, and none is made twice. The call ends where the process holds
    the first program that it needs. What goes wrong in it is not reported: it goes wrong again where the
    result is needed.

    Args:
        function: Pure; it enters the precision that it needs by itself.
        arguments: Of the function.
    """
    start_with_fast_loops()
    # A new thread has none of the settings of a context.
    if not _plain() and all(getattr(jax.config, s) is None for s in _SETTINGS[1:]):
        # While the interpreter ends nothing more is taken: the main thread may end before the one that calls.
        with contextlib.suppress(RuntimeError):
            _ahead().submit(_try, function, arguments)


def _try(function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    if threading.main_thread().is_alive():  # not while the process ends
        _thread.may_stop = True
        with contextlib.suppress(Exception), np.errstate(all="ignore"):
            function(*arguments)


class _NothingToMakeError(Exception):
    """Ends a call that was made ahead."""


@functools.cache
def _ahead() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="programs")


@contextlib.contextmanager
def loaded_ahead(*like: Any) -> Iterator[None]:
    """Inside, programs that the last such block has used are loaded on threads before they are needed.

    Loading is machine code that is linked, outside of Python: it goes on beside the first fits. What is not
    used in the end is let go of. Only the first such block of a process loads: later ones have in memory what
    they share, and would load what searches of other processes have found.

    Args:
        like: Static values; blocks with equal ones count as alike.
    """
    names, folder = [static_key(x) for x in like], programs_folder()
    if folder is None or not all(names) or not _unchanged():
        yield
        return
    here = folder / _surroundings()
    listed = here / "used" / hashlib.sha256(str(names).encode()).hexdigest()
    used: dict[str, None] = {}
    with _recent_lock:
        first = listed not in _loaded_by
        _loaded_by.add(listed)
        _notes.append(used)
    with contextlib.suppress(OSError, UnicodeError):
        if first:
            found = re.findall("^[0-9a-f]{64}$", listed.read_text(), re.MULTILINE)
            _load_ahead([here / name for name in found])
    try:
        yield
    finally:
        with _recent_lock:
            _notes[:] = [note for note in _notes if note is not used]
        for file in list(_coming):
            if (future := _coming.pop(file, None)) is not None:
                future.cancel()
    with contextlib.suppress(OSError):
        listed.parent.mkdir(parents=True, exist_ok=True)
        _write_file(listed, "\n".join(used).encode())


def _load_ahead(files: list[Path]) -> None:
    """Begin to load programs that are not in memory, in this order."""
    with _recent_lock:
        held = {held.file for held in _recent}
    wanted = [file for file in files if file not in held and file not in _coming]
    if wanted:
        with _storage.lock:
            _prepare_loading()
        with contextlib.suppress(RuntimeError):  # while the interpreter ends nothing more is taken
            _coming.update({file: _loaders().submit(_stored_program, file) for file in wanted})


@functools.cache
def _loaders() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="loading")


def keep_programs(folder: str | Path | bool = True) -> None:
    """Choose where compiled programs are kept, for this process.

    Args:
        folder: The folder; True for the usual one, which `programs_folder` names; False for none.

    Raises:
        InputError: Neither a path nor a truth value, or a path to a file.
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
        What `keep_programs` or the environment variable `ROTFLEX_PROGRAMS` chose; else beside the code that
        JAX stores, where the user has asked it to; else the user's cache folder. None where programs are not
        kept.
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


@dataclasses.dataclass(frozen=True)
class Performance:
    """What makes the programs of this package quick, as it is in this process; its text is one line.

    Attributes:
        folder: Where compiled programs are kept; None where they are not.
        programs: How many are there, of this version of the package on this processor.
        size: Their size [bytes].
        fast_loops: Whether XLA compiles a loop over samples into one function; not where other JAX code
            started it before, with other options.
        cores: How many cores the process may use.
        platform: Where JAX computes.
    """

    folder: Path | None
    programs: int
    size: int
    fast_loops: bool
    cores: int
    platform: str

    def __str__(self) -> str:
        """One line for a person."""
        kept = "compiled programs are not kept"
        if self.folder:
            kept = f"{self.programs} compiled programs ({self.size / 1e6:.0f} MB) are kept in {self.folder}"
        loops = "loops over samples are compiled into one function each"
        if self.platform == "cpu" and not self.fast_loops:
            loops = "slow loops: JAX had started before; call rotflex_jax.enable_fast_loops() first of all"
        return f"{kept}; {loops}; {self.cores} cores, {self.platform}"


def performance() -> Performance:
    """What makes the programs of this package quick; see `Performance`.

    >>> keep_programs(False)
    >>> str(performance()).partition(";")[0]
    'compiled programs are not kept'
    >>> keep_programs(True)
    """
    folder = programs_folder()
    sizes = [size for _, size, _ in _stored(folder / _surroundings())] if folder else []
    return Performance(folder, len(sizes), sum(sizes), loops_are_fast(), cores(), jax.default_backend())


@functools.cache
def _usual_folder() -> Path:
    import pooch

    return Path(pooch.os_cache("rotflex_jax")) / "compiled" / "programs"  # as the command line has it


def release_programs() -> None:
    """Releases all programs in memory; those on disk stay."""
    with _recent_lock:
        _recent.clear()
        _loaded_by.clear()
    for program in _programs:
        program.release_programs()
    _return_memory()


class ProgramCounts(NamedTuple):
    """Programs that this process has made so far.

    Attributes:
        compiled: How many it compiled.
        loaded: How many it loaded from disk.
        seconds: What tracing and compiling took by the clock, added over all threads [s].
    """

    compiled: int = 0
    loaded: int = 0
    seconds: float = 0.0


_counts = [ProgramCounts()]


def program_counts() -> ProgramCounts:
    """Programs that this process has made so far; the difference of two calls is what lay between them."""
    return _counts[0]


def _count(compiled: int = 0, loaded: int = 0, seconds: float = 0.0) -> None:
    with _recent_lock:
        c = _counts[0]
        _counts[0] = ProgramCounts(c.compiled + compiled, c.loaded + loaded, c.seconds + seconds)


def _used(held: _Held) -> None:
    """Notes that a program was used; where too many are held, those not used for longest are released."""
    with _recent_lock:
        _recent[held] = None
        _recent.move_to_end(held)
        if (file := held.file) is not None:
            for note in _notes:
                note[file.name] = None
        if len(_recent) <= MOST_HELD:
            return
        released = [_recent.popitem(last=False)[0] for _ in range(len(_recent) - LEFT_HELD)]
    for old in released:
        if old.place.get(old.key) is old:  # and not one that another thread has made at the same time
            old.place.pop(old.key, None)
    del released
    _return_memory()


def _return_memory() -> None:
    """Gives memory that programs have left back to the system, where the C library can."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


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
    elif isinstance(value, enum.Enum):
        yield str(value)
    elif isinstance(value, tuple):  # a named one
        yield f"{kind.__module__}.{kind.__qualname__}"
        yield from _parts(tuple(value))
    elif dataclasses.is_dataclass(value):
        yield f"{kind.__module__}.{kind.__qualname__}"
        yield from _parts(tuple(getattr(value, f.name) for f in dataclasses.fields(value)))
    else:  # an object that holds nothing is known by its class
        yield None if getattr(value, "__dict__", True) else f"{kind.__module__}.{kind.__qualname__}"


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


def _surroundings() -> str:
    """Hash of everything that all programs depend on."""
    values = {n: v for n, v in jax.config.values.items() if "cache" not in n and n not in _SETTINGS}
    parts = (_SOURCE, jax.__version__, metadata.version("jaxlib"), sorted(values.items()), _processor())
    options = [o for o in os.environ.get("XLA_FLAGS", "").split() if o != FAST_LOOPS_FLAG]
    parts = (*parts, options, loops_are_fast())
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


@functools.cache
def _processor() -> str:
    """What machine code depends on."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(errors="replace").splitlines() if known.exists() else []
    told = {line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))}
    return f"{platform.system()} {platform.machine()} {platform.processor()} {sorted(told)}"


def _unchanged() -> bool:
    """Whether the source on disk is what this process has loaded."""
    return all(file.exists() and file.stat().st_mtime < _LOADED - _ABOUT for file in _SOURCES)


@functools.cache
def _prepare_loading() -> None:
    """Let JAX find its linear algebra, as it does when it lowers a program that needs it."""
    jax.jit(jnp.linalg.solve).lower(np.eye(1, dtype=np.float32), np.ones(1, np.float32))


def _read(file: Path, leaves: list[Any]) -> tuple[Callable[..., Any], Any] | None:
    """The program in a file and what it gives for arguments; None without one that runs with these."""
    try:
        coming = _coming.pop(file, None)
        program = _stored_program(file) if coming is None or coming.cancel() else coming.result()
        if program is None:
            return None
        # What JAX had loaded from its own cache, and not compiled, may be stored without its functions.
        result = jax.block_until_ready(program(*leaves))
        os.utime(file)  # what was used last is deleted last
        os.utime(file.parent)
        return program, result
    except Exception:  # missing, or of another version: it is compiled again
        return None


def _stored_program(file: Path) -> Callable[..., Any] | None:
    """The program in a file; None where it is damaged."""
    data = file.read_bytes()
    digest, content = data[:32], data[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    with _storage.lock:
        _prepare_loading()
    return serialize_executable.deserialize_and_load(*pickle.loads(content))


def _write(program: Any, file: Path) -> None:
    """Stores a program; where that fails, the next process compiles it again."""
    with contextlib.suppress(Exception):  # the disk is full, or this JAX cannot store this program
        content = pickle.dumps(serialize_executable.serialize(program))
        if not file.parent.exists():
            _clear(file.parent.parent)
            file.parent.mkdir(parents=True, exist_ok=True)
        _write_file(file, hashlib.sha256(content).digest() + content)
        with _storage.lock:
            _storage.written += 1
            if _storage.written % _CHECK_EVERY == 1:
                _shrink(file.parent, MOST_BYTES)


def _write_file(file: Path, content: bytes) -> None:
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
    """Deletes the programs that were not used for the longest time, down to so many bytes."""
    total = 0
    for _, size, file in sorted(_stored(folder), reverse=True):
        total += size
        if total > most:
            file.unlink(missing_ok=True)


def _stored(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """When each program in a folder was used last, its size, and its file."""
    for file in folder.glob("*"):
        with contextlib.suppress(FileNotFoundError):  # another process has deleted it
            if file.is_dir():
                continue
            yield file.stat().st_mtime, file.stat().st_size, file


def _clear(folder: Path) -> None:
    """Deletes what was used least recently, so that with one more there are programs of `_VERSIONS`.

    A folder that a user chose may hold other things, so that only folders with names like its own count.
    """
    own = (f for f in folder.glob("*/") if re.fullmatch("[0-9a-f]{32}", f.name))
    found = sorted(own, key=lambda f: f.stat().st_mtime, reverse=True)
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
