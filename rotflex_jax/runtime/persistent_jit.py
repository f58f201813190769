"""`jax.jit` whose compiled programs are kept on disk, and compiler options for fast compilation.

For a loop of many small operations, the newer fusion emitters of XLA take as long as the rest of the
compiler, and the loop runs no faster. Therefore the older emitters are used, if this XLA has the option. A
program is also not split for several compiler threads, which is more work in total: a search compiles several
programs at once anyway.

Tracing and compiling a mechanism takes seconds, running it milliseconds. Therefore compiled programs are
stored (`rotflex_jax.runtime.program_files`) and loaded again by the next process.
"""

import collections
import contextlib
import ctypes
import dataclasses
import functools
import gc
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from rotflex_jax.runtime.program_files import (
    SETTINGS,
    file_name,
    mark_used,
    prepare_loading,
    programs_folder,
    read_program,
    static_key,
    stored_sizes,
    tree_key,
    version_folder,
    write_file,
    write_program,
)
from rotflex_jax.runtime.xla import cores, loops_are_fast, start_with_fast_loops

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
        settings = tuple(getattr(jax.config, s) for s in SETTINGS)
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
        texts = [*map(static_key, known), tree_key(tree)]
        folder = version_folder() if all(texts) else None
        return folder and folder / file_name(f"{self._name}{texts}{kinds}{settings}")

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

        began = time.perf_counter()
        stored = None if file is None else _read(file, leaves)
        if stored is not None:
            _count(loaded=1)
            return stored
        if file is not None and file.exists():
            # The file is of no use. A program that JAX loads from a cache of its own, not compiled, is stored
            # without its functions. JAX knows a program by its name too, so this one is compiled.
            flat.__name__ = f"flat_{time.time_ns():x}"
        program = jax.jit(flat, compiler_options=_options() | self._level)
        # Compiled here even where it is not kept: inside of another program, which may hold these arguments
        # as constants, JAX compiles nothing with options.
        with _without_garbage_collection:
            compiled = program.lower(*leaves).compile()
        _count(compiled=1, seconds=time.perf_counter() - began)
        if file is not None:
            write_program(compiled, file)
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
    if not _plain() and all(getattr(jax.config, s) is None for s in SETTINGS[1:]):
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
    names = [static_key(x) for x in like]
    here = version_folder() if all(names) else None
    if here is None:
        yield
        return
    listed = here / "used" / file_name(str(names))
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
        write_file(listed, "\n".join(used).encode())


def _load_ahead(files: list[Path]) -> None:
    """Begin to load programs that are not in memory, in this order."""
    with _recent_lock:
        held = {held.file for held in _recent}
    wanted = [file for file in files if file not in held and file not in _coming]
    if wanted:
        prepare_loading()
        with contextlib.suppress(RuntimeError):  # an ending interpreter accepts no more work
            _coming.update({file: _loaders().submit(read_program, file) for file in wanted})


@functools.cache
def _loaders() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="loading")


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

    >>> from rotflex_jax.runtime.program_files import keep_programs
    >>> keep_programs(False)
    >>> str(performance()).partition(";")[0]
    'compiled programs are not kept'
    >>> keep_programs(True)
    """
    sizes = stored_sizes()
    return Performance(
        programs_folder(), len(sizes), sum(sizes), loops_are_fast(), cores(), jax.default_backend()
    )


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


def _read(file: Path, leaves: list[Any]) -> tuple[Callable[..., Any], Any] | None:
    """The program in a file and its result for these arguments; None if no program there runs with them."""
    try:
        coming = _coming.pop(file, None)
        program = read_program(file) if coming is None or coming.cancel() else coming.result()
        if program is None:
            return None
        # A program that is stored without its functions, see `PersistentJit._made`, fails here.
        result = jax.block_until_ready(program(*leaves))
        mark_used(file)
        return program, result
    except Exception:  # missing, or from another version: it is compiled again
        return None


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
