"""`jax.jit` whose compiled programs are kept on disk, and compiler options for fast compilation.

For a loop of many small operations, the newer fusion emitters of XLA take as long as the rest of the
compiler, and the loop runs no faster. Therefore the older emitters are used, if this XLA has the option. A
program is also not split for several compiler threads, which is more work in total: a search compiles several
programs at once anyway.

Tracing and compiling a mechanism takes seconds, running it milliseconds. Therefore the compiled program is
stored under a hash of everything on which it depends: the function, structure and solver, the shapes and
types of the arrays, the source of this package, the versions and settings of JAX, and the processor. Any
difference gives another hash. A file contains the hash of its own content; a damaged file is replaced. A
stored program is machine code: do not share its folder with people whom you do not trust.
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
# The source that this process has loaded; nothing is stored if a file has changed since about that time.
_LOADED, _ABOUT = time.time(), 10.0
_SOURCE = hashlib.sha256(b"".join(file.read_bytes() for file in _SOURCES)).hexdigest()
# Number of versions whose programs stay on disk; another source of the package, another JAX or setting of it,
# and another processor each make a version.
_VERSIONS = 6
# Settings on which tracing depends and which a context may change.
_SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision")
# Largest size [bytes] of the programs of one version on disk; how many programs are written between checks.
MOST_BYTES, _CHECK_EVERY = 1_000_000_000, 64
FOLDER_VARIABLE = "ROTFLEX_PROGRAMS"
"""Environment variable with the folder of compiled programs; with `off` no programs are kept."""
# With these settings JAX does more at each call than run a program.
_WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
_FOR_COMPILER = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
_programs: list["PersistentJit"] = []
# Programs in memory, the most recently used at the end. Each takes about 14 MB, and 0.1 s to load it again.
# If there are more than the first number, the least recently used are released, down to the second number.
MOST_HELD, LEFT_HELD = 96, 72
_recent: collections.OrderedDict["_Held", None] = collections.OrderedDict()
_recent_lock = threading.Lock()
_thread = threading.local()


# For each active `loaded_ahead`: names of the files of the programs used, in order of first use.
_notes: list[dict[str, None]] = []
# Programs that threads are loading from files before they are needed.
_coming: dict[Path, Future[Callable[..., Any] | None]] = {}
# Lists that were used to load programs ahead, since programs were last released.
_loaded_by: set[Path] = set()


@dataclasses.dataclass(frozen=True, eq=False)
class _Held:
    """A program in memory, the dictionary that holds it, and its file if it has one."""

    program: Callable[..., Any]
    place: dict[Any, "_Held"]
    key: Any
    file: Path | None


class _Paused:
    """Switches the cyclic garbage collection off while any thread makes programs, if it was on.

    Tracing makes so many objects that Python would scan all objects of the process again and again while
    every thread waits, which takes a tenth of the time of a first search.
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
    """Where programs are kept: in a chosen folder, in the default folder, or not at all."""

    chosen: Path | None = None
    off: bool = False
    written: int = 0
    lock: threading.Lock = dataclasses.field(default_factory=threading.Lock)


_storage = _Storage()


class PersistentJit:
    """`jax.jit` of a pure function whose first arguments are static; compiled programs are kept on disk.

    Do not differentiate it or map over it: do this inside the function instead. On devices other than a CPU
    or than the first one, and inside of other programs, it is the same as `jax.jit`.

    Args:
        function: Pure function of a module of this package that returns arrays, in tuples or named tuples.
        static: Number of leading arguments that are static.
        optimisation_level: Optimisation level of LLVM; the default of XLA, 3, if None. At level 1 loops over
            samples run as fast as at level 3 and compile in four fifths of the time; runs with derivatives
            need level 3. Level 0 is for large programs that run a few times: they compile in half of the
            time, but loops take five to ten times as long.
        only_known: Whether it is the same as `jax.jit` too where static arguments have no `static_key`: a
            function of a user may hold traced values, and a mesh of devices places arrays on each of them.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        static: int,
        optimisation_level: int | None = None,
        only_known: bool = False,
    ) -> None:
        self.jitted = jax.jit(function, static_argnums=tuple(range(static)))
        level = optimisation_level
        self._level = {} if level is None else {"xla_backend_optimization_level": level}
        self._static, self._only_known = static, only_known
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._held: dict[Any, _Held] = {}
        self._made_here = 0
        # Programs that a thread is making; other threads that need the same program wait.
        self._in_work: dict[Any, Future[None]] = {}
        _programs.append(self)

    def __call__(self, *arguments: Any) -> Any:
        """The result of the function."""
        start_with_fast_loops()
        known, leaves = arguments[: self._static], jax.tree.leaves(arguments[self._static :])
        if _plain() or any(isinstance(leaf, Tracer) for leaf in leaves) or _elsewhere(leaves):
            return self.jitted(*arguments)
        if self._only_known and not static_key(known):
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
            with _recent_lock:
                self._made_here += 1
        finally:  # after a failure, the next waiting thread makes the program itself
            with _recent_lock:
                self._in_work.pop(key).set_result(None)
        _used(held)
        return result

    def _awaited(self, key: Any) -> _Held | None:
        """The program that another thread makes, after a wait; None if this thread has to make it."""
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
        """The file of the program for these arguments; None if it is not kept on disk."""
        texts, folder = [*map(static_key, known), _tree_key(tree)], programs_folder()
        if folder is None or not all(texts) or not _unchanged():
            return None
        name = f"{self._name}{texts}{kinds}{settings}"
        return folder / _surroundings() / hashlib.sha256(name.encode()).hexdigest()

    def __len__(self) -> int:
        """Number of programs in memory: one for each structure and shapes of the arguments."""
        return len(self._held) + self._of_jax

    @property
    def programs_made(self) -> int:
        """Number of programs compiled or loaded so far; it stays the same when programs are released."""
        return self._made_here + self._of_jax

    @property
    def _of_jax(self) -> int:
        return self.jitted._cache_size()  # pyright: ignore[reportAttributeAccessIssue]

    def release_programs(self) -> None:
        """Release the programs in memory."""
        with _recent_lock:
            for held in list(self._held.values()):
                _recent.pop(held, None)
        self._held.clear()

    def _made(
        self, known: tuple[Any, ...], tree: Any, leaves: list[Any], file: Path | None
    ) -> tuple[Callable[..., Any], Any]:
        """The program for such arguments as a function of their leaves, and its result for these arguments.

        The program is kept in the file, if there is one.
        """

        def flat(*leaves: Any) -> Any:
            return self.jitted(*known, *jax.tree.unflatten(tree, leaves))

        program = jax.jit(flat, compiler_options=_options() | self._level)
        began = time.perf_counter()
        stored = None if file is None else _read(file, leaves)
        if stored is not None:
            _count(loaded=1)
            return stored
        # Compiled here even where it is not kept: inside of another program, which may hold these arguments
        # as constants, JAX compiles nothing with options.
        with _without_garbage_collection:
            compiled = program.lower(*leaves).compile()
        _count(compiled=1, seconds=time.perf_counter() - began)
        if file is not None:
            _write(compiled, file)
        return compiled, compiled(*leaves)


def persistent_jit(
    static: int, optimisation_level: int | None = None, only_known: bool = False
) -> Callable[[Callable[..., Any]], PersistentJit]:
    """Decorator that makes a function a `PersistentJit`; arguments as in `PersistentJit`."""
    return lambda function: PersistentJit(function, static, optimisation_level, only_known)


def make_ahead(function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function on a separate thread, only to make the programs that it needs; its result is dropped.

    For programs that are needed soon, so that they are made while the caller waits for something else. A
    thread that needs a program in the making waits for it, so that no program is made twice. The call ends
    early if the first program that it needs is already in memory. Its errors are not reported: they occur
    again where the result is needed.

    Args:
        function: Pure function that sets the precision it needs by itself.
        arguments: Arguments of the function.
    """
    start_with_fast_loops()
    # A new thread does not inherit the settings of a context.
    if not _plain() and all(getattr(jax.config, s) is None for s in _SETTINGS[1:]):
        # An ending interpreter accepts no more work: the main thread may end before the calling thread.
        with contextlib.suppress(RuntimeError):
            _ahead().submit(_try, function, arguments)


def _try(function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    if threading.main_thread().is_alive():  # not while the process ends
        _thread.may_stop = True
        with contextlib.suppress(Exception), np.errstate(all="ignore"):
            function(*arguments)


class _NothingToMakeError(Exception):
    """Ends a call of `make_ahead` that has no program to make."""


@functools.cache
def _ahead() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="programs")


@contextlib.contextmanager
def loaded_ahead(*like: Any) -> Iterator[None]:
    """Within this context, the programs that the last such block used are loaded on threads ahead of use.

    Loading links machine code outside of Python, so it runs in parallel with the first fits. Programs that
    are not used are released. Only the first such block of a process loads: later blocks find the shared
    programs in memory, and would load programs of searches in other processes.

    Args:
        like: Static values; blocks with equal values share a list of programs.
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
        with contextlib.suppress(RuntimeError):  # an ending interpreter accepts no more work
            _coming.update({file: _loaders().submit(_stored_program, file) for file in wanted})


@functools.cache
def _loaders() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="loading")


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


@dataclasses.dataclass(frozen=True)
class Performance:
    """Settings of this process that determine the speed of compiled programs; `str` gives one line.

    Attributes:
        folder: Folder of compiled programs; None if they are not kept.
        programs: Number of programs there, of this version of the package on this processor.
        size: Size of these programs [bytes].
        fast_loops: Whether XLA compiles a loop over samples into one function. False if other JAX code
            started XLA before, with other options.
        cores: Number of cores that the process may use.
        platform: Platform on which JAX computes.
    """

    folder: Path | None
    programs: int
    size: int
    fast_loops: bool
    cores: int
    platform: str

    def __str__(self) -> str:
        """One line for the user."""
        kept = "compiled programs are not kept"
        if self.folder:
            kept = f"{self.programs} compiled programs ({self.size / 1e6:.0f} MB) are kept in {self.folder}"
        loops = "loops over samples are compiled into one function each"
        if self.platform == "cpu" and not self.fast_loops:
            loops = "slow loops: JAX had started before; call rotflex_jax.enable_fast_loops() first of all"
        return f"{kept}; {loops}; {self.cores} cores, {self.platform}"


def performance() -> Performance:
    """Settings of this process that determine the speed of compiled programs; see `Performance`.

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
    """Releases all programs in memory; programs on disk stay."""
    with _recent_lock:
        _recent.clear()
        _loaded_by.clear()
    for program in _programs:
        program.release_programs()
    _return_memory()


class ProgramCounts(NamedTuple):
    """Programs that this process has made so far.

    Attributes:
        compiled: Number of programs that it compiled.
        loaded: Number of programs that it loaded from disk.
        seconds: Elapsed time of tracing and compiling, added over all threads [s].
    """

    compiled: int = 0
    loaded: int = 0
    seconds: float = 0.0


_counts = [ProgramCounts()]


def program_counts() -> ProgramCounts:
    """Programs that this process has made so far; subtract two results for the programs between two calls."""
    return _counts[0]


def _count(compiled: int = 0, loaded: int = 0, seconds: float = 0.0) -> None:
    with _recent_lock:
        c = _counts[0]
        _counts[0] = ProgramCounts(c.compiled + compiled, c.loaded + loaded, c.seconds + seconds)


def _used(held: _Held) -> None:
    """Notes that a program was used; if there are too many in memory, releases the least recently used."""
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
        if old.place.get(old.key) is old:  # not a program that another thread has made meanwhile
            old.place.pop(old.key, None)
    del released
    _return_memory()


def _return_memory() -> None:
    """Returns freed memory to the system, if the C library can do so."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


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


def _tree_key(tree: Any) -> str:
    """A text that identifies the structure of arguments; empty if that cannot be told for certain."""
    node = tree.node_data()
    if node is None:
        return "*"
    kind, fields = node
    # Equinox marks a field without a value, such as one that stands among the parts, by an object of its own.
    values = [None if type(f).__module__.startswith("equinox._module") else f for f in fields or ()]
    said, parts = static_key(tuple(values)), [_tree_key(part) for part in tree.children()]
    known = kind in (tuple, list, dict, type(None)) or kind.__module__.startswith(f"{_PACKAGE}.")
    if not known or not all((said, *parts)):
        return ""
    return f"{kind.__module__}.{kind.__qualname__}{said}({','.join(parts)})"


def _elsewhere(leaves: list[Any]) -> bool:
    """Whether one of the arrays is on one device, but not on the first one, for which programs are made."""
    if jax.device_count() == 1:
        return False
    places = (leaf.devices() for leaf in leaves if isinstance(leaf, jax.Array))
    return any(len(place) == 1 and place != {jax.devices()[0]} for place in places)


def _plain() -> bool:
    """Whether to use `jax.jit` alone: if JAX does not run on a CPU, or does checks at each call."""
    return jax.default_backend() != "cpu" or any(getattr(jax.config, w) for w in _WATCHED)


@functools.cache
def _options() -> dict[str, Any]:
    """Compiler options, as far as this XLA knows them."""
    known = {}
    for name, value in _FOR_COMPILER.items():
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
            known[name] = value
    return known


def _surroundings() -> str:
    """Hash of everything on which all programs depend."""
    values = {n: v for n, v in jax.config.values.items() if "cache" not in n and n not in _SETTINGS}
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


@functools.cache
def _prepare_loading() -> None:
    """Let JAX register its linear algebra, as it does when it lowers a program that needs it."""
    jax.jit(jnp.linalg.solve).lower(np.eye(1, dtype=np.float32), np.ones(1, np.float32))


def _read(file: Path, leaves: list[Any]) -> tuple[Callable[..., Any], Any] | None:
    """The program in a file and its result for these arguments; None if no program there runs with them."""
    try:
        coming = _coming.pop(file, None)
        program = _stored_program(file) if coming is None or coming.cancel() else coming.result()
        if program is None:
            return None
        # A program that JAX had loaded from its own cache, not compiled, may be stored without its functions.
        result = jax.block_until_ready(program(*leaves))
        os.utime(file)  # the most recently used is deleted last
        os.utime(file.parent)
        return program, result
    except Exception:  # missing, or from another version: it is compiled again
        return None


def _stored_program(file: Path) -> Callable[..., Any] | None:
    """The program in a file; None if the file is damaged."""
    data = file.read_bytes()
    digest, content = data[:32], data[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    with _storage.lock:
        _prepare_loading()
    return serialize_executable.deserialize_and_load(*pickle.loads(content))


def _write(program: Any, file: Path) -> None:
    """Stores a program; if that fails, the next process compiles the program again."""
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
    """Deletes the least recently used programs until at most `most` bytes are left."""
    total = 0
    for _, size, file in sorted(_stored(folder), reverse=True):
        total += size
        if total > most:
            file.unlink(missing_ok=True)


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


# Linux allows 65530 memory maps by default; above that the compiler ends the process. A search that tries
# many different structures may add about 30000.
MOST_MEMORY_MAPS = 30_000


def clear_compilation_caches(most: int = MOST_MEMORY_MAPS) -> bool:
    """Releases all compiled code if the process has many memory maps; it is compiled again if needed.

    Args:
        most: Number of memory maps that the process may have.

    Returns:
        Whether code was released; always False on systems other than Linux, where the number is not known.
    """
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") < most:
        return False
    release_programs()
    jax.clear_caches()
    return True
