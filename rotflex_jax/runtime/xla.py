"""Settings of JAX and of this machine: fast loops, compilation cache, precision, threads and devices.

Importing the package changes no setting. The first computation starts XLA, unless it was started before, with
an option by which each loop over samples is compiled into one function (`start_with_fast_loops`).
"""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_context
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Num
from threadpoolctl import ThreadpoolController

from rotflex_jax import checks
from rotflex_jax.errors import InputError

# A step with play, memories and friction touches about 17 KB for each direction of its derivatives; above the
# limit a run takes 2.7 to 4.4 times as long. Loops with matrix products of 64 to 300 rows do not get slower.
_OPTION, _LIMIT = "xla_cpu_small_while_loop_byte_threshold", 2**21
FAST_LOOPS_FLAG = f"--xla_backend_extra_options={_OPTION}={_LIMIT}"
"""Option that `enable_fast_loops` adds to `XLA_FLAGS`, with the default limit."""


def enable_fast_loops(limit: int = _LIMIT) -> bool:
    """Ask XLA to compile a small loop on the CPU into one function, not one call per operation.

    A scan over the samples of a recording spends most of its time starting operations. XLA fuses a
    whole loop if one iteration touches fewer bytes than a limit, 1024 by default.
    A higher limit makes simulating and fitting a joint five to twelve times faster.

    The first computation of the package sets this option by itself, unless XLA was started before. XLA reads
    `XLA_FLAGS` only when it starts, so call this function first if other JAX code runs before the package.

    Args:
        limit: Memory that one iteration may touch [bytes]. Much larger values slow down loops with
            large matrix products.

    Returns:
        True if `XLA_FLAGS` now contains the option. A value that the user chose is kept, and nothing is
        changed if `XLA_FLAGS` names a file of flags.

    Example:
        >>> import os
        >>> kept = os.environ.pop("XLA_FLAGS", None)
        >>> enable_fast_loops()
        True
        >>> os.environ["XLA_FLAGS"]
        '--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=2097152'
        >>> _ = os.environ.pop("XLA_FLAGS") if kept is None else os.environ.update(XLA_FLAGS=kept)
    """
    limit = checks.whole(limit, "limit", 1)
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if _OPTION in flags:
        return True
    if flags and not flags.startswith("-"):
        return False
    # XLA merges several --xla_backend_extra_options, so the options of the user stay in force.
    os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={limit}".strip()
    return True


def enable_compilation_cache(folder: str | Path | None = None) -> Path | None:
    """Stores compiled code on disk, so that the next run of the program starts quickly.

    Do not call it in a library: the setting holds for the whole process. Old entries are not removed; you can
    delete the folder at any time. The files there are run as programs: use a folder that only you can write
    to, and do not use a folder that somebody gave to you.

    Args:
        folder: Folder for compiled code; by default in the user's cache folder. Without this argument, a
            folder that the user chose before (`JAX_COMPILATION_CACHE_DIR`) is kept. The shortest compilation
            time from which code is stored (`JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS`) is kept if it is
            set; otherwise all code is stored.

    Returns:
        The folder in use, or None if the folder cannot be written (then nothing is changed).
    """
    if not (folder is None or isinstance(folder, str | os.PathLike)):
        raise InputError(
            f"Argument `folder` must be a path, but is {checks.shown(folder)}; give for instance 'programs'."
        )
    import jax

    chosen = jax.config.values["jax_compilation_cache_dir"]
    if folder is not None or not chosen:
        if folder is None:
            import pooch

            folder = Path(pooch.os_cache("rotflex_jax")) / "compiled"
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return None
        if not os.access(folder, os.W_OK):
            return None
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Most programs compile in less than the one second that JAX requires, and a search needs dozens of them.
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return Path(folder or chosen)


def enable_fast_start() -> None:
    """Set both options; for an application, before its first computation."""
    enable_fast_loops()
    enable_compilation_cache()


_starting = threading.Lock()


@functools.cache
def start_with_fast_loops() -> None:
    """Start XLA with the option of `enable_fast_loops`, unless it has been started; keeps the environment.

    XLA reads its options once, when it starts.
    """
    with _starting:
        before = os.environ.get("XLA_FLAGS")
        try:
            if enable_fast_loops():
                jax.devices()
        finally:
            if before is None:
                os.environ.pop("XLA_FLAGS", None)
            else:
                os.environ["XLA_FLAGS"] = before


@functools.cache
def loops_are_fast() -> bool:
    """Whether XLA compiles a loop over samples into one function, in this process."""
    start_with_fast_loops()
    x = np.ones(400, np.float32)  # one iteration touches more than the default limit
    turn = lambda c, _: (jnp.tanh(c), None)  # noqa: E731
    program = jax.jit(lambda c: jax.lax.scan(turn, c, None, length=1000)).lower(x).compile()
    return "xla_cpu_small_call" in (program.as_text() or "")


def working_precision(*arrays: Num[np.ndarray, "..."]) -> contextlib.AbstractContextManager:
    """Context in which JAX computes at once, and keeps float64 if any of `arrays` is float64.

    Outside of it the JAX configuration of the user is not changed.
    """
    return _at_once(any(np.asarray(a).dtype == np.float64 for a in arrays))


def double_precision() -> contextlib.AbstractContextManager:
    """Context in which JAX computes at once and in float64, as fits and discovery need."""
    return _at_once(True)


@contextlib.contextmanager
def _at_once(double: bool) -> Iterator[None]:
    """Context in which JAX computes numbers, also while it traces a function of the user."""
    start_with_fast_loops()
    with eval_context(), jax.enable_x64(True) if double else contextlib.nullcontext():
        yield


Parameters = ParamSpec("Parameters")
Job = TypeVar("Job")
Result = TypeVar("Result")


def one_thread(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorator: inside the function, linear algebra runs on one thread."""

    @functools.wraps(function)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with _loaded().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return run


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_threads(run: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
    """Results of independent calls, on as many threads as there are cores.

    A scan keeps one core busy, and compiled code runs without the lock of Python. Nested calls run one after
    another on the thread of the outer call, because all threads may be busy with outer calls. If a call
    fails, or the user stops the program, the other running calls end before the error is raised, at the
    latest when they call this function.

    Args:
        run: Function to call; no two calls may run a program that spreads over devices. A program that
            several calls need is compiled once, by the first of them.
        jobs: Arguments of the calls.
    """
    outer: threading.Event | None = getattr(_own, "stopped", None)
    if outer is not None and outer.is_set():
        raise CancelledError
    if len(jobs) <= 1 or outer is not None:
        return [run(job) for job in jobs]
    settings, stopped = np.geterr(), threading.Event()  # a thread has its own settings

    def on_thread(job: Job) -> Result:
        _own.stopped = stopped
        with np.errstate(**settings):
            return run(job)

    begun = [_threads().submit(on_thread, job) for job in jobs]
    try:
        return [each.result() for each in begun]
    except BaseException:
        stopped.set()
        raise
    finally:
        wait([each for each in begun if not each.cancel()])


# For each of the threads below: whether the call for which it works has been stopped.
_own = threading.local()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores())


def bind_to_cores(place: int, of: int) -> None:
    """Bind this process, number `place` of `of` equal processes, to its own cores, if the system allows it.

    Threads that migrate between cores slow each other down. Call it before the first computation of JAX,
    which starts as many threads as it finds cores.
    """
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        n, alone = len(mine), place % len(mine)
        chosen = mine[place * n // of : (place + 1) * n // of] if of <= n else mine[alone : alone + 1]
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, chosen)


@functools.cache
def _loaded() -> ThreadpoolController:
    """The loaded thread-pool libraries of this process; finding them takes as long as a small fit."""
    import scipy.linalg  # noqa: F401 - JAX uses its library, and only loaded libraries can be limited

    return ThreadpoolController()


_ROWS = "rows"


def mesh_of(devices: Sequence[Any] | None = None) -> Mesh | None:
    """A one-dimensional mesh of devices, for `spread`.

    Args:
        devices: the devices; all devices of this process if None, unless `jax.default_device` names one. With
            `jax.distributed`, `jax.devices()` are the devices of all processes; then every process must make
            the same call with the same numbers.

    Returns:
        The mesh; None for a single device, which needs no mesh.

    >>> mesh_of(jax.devices()[:1]) is None
    True
    """
    if devices is None and jax.config.values["jax_default_device"] is not None:
        return None
    chosen = jax.local_devices() if devices is None else checks.entries(devices)
    if chosen is None or not all(isinstance(device, jax.Device) for device in chosen):
        raise InputError(
            f"Argument `devices` must be a list of devices, but is {checks.shown(devices)}; give for "
            "instance jax.devices()."
        )
    return Mesh(np.array(chosen), (_ROWS,)) if len(chosen) > 1 else None


def spread(function: Callable[..., Any], mesh: Mesh | None) -> Callable[..., Any]:
    """The same function, distributed over devices: each device computes a part of the rows.

        spread(f, mesh)(rows, *shared) = f(rows, *shared)   to rounding

    For use inside `jax.jit`, with `mesh` static. The rows must be independent, and `function` must take any
    number of them. The last row is repeated up to a multiple of the number of devices, so a few rows more
    than devices cost a second pass on all devices. Not for rows that take microseconds: sending them costs
    more.

    Devices of one process do not wait for each other if their number divides the number of rows. Otherwise,
    and with several processes, all devices receive the whole result at the end. XLA ends a program in which
    one device waits for another longer than a minute, so the rows must then take similar times.

    Args:
        function: function of rows (K, ...) and of arguments that all rows share; its results have one entry
            for each row, (K, ...).
        mesh: from `mesh_of`; with None the function is returned unchanged.

    Returns:
        A function whose results every process has as a whole; they may be distributed over the devices of one
        process.
    """
    if mesh is None:
        return function

    def run(rows: Any, *shared: Any) -> Any:
        K = len(jax.tree.leaves(rows)[0])
        full = jnp.minimum(jnp.arange(-(-K // mesh.size) * mesh.size), K - 1)
        parts = jax.shard_map(
            function,
            mesh=mesh,
            in_specs=(PartitionSpec(_ROWS), *(PartitionSpec() for _ in shared)),
            out_specs=PartitionSpec(_ROWS),
            check_vma=False,  # a scan inside starts with the same carry on all devices
        )(jax.tree.map(lambda x: jnp.asarray(x)[full], rows), *shared)
        alone = all(device.process_index == jax.process_index() for device in mesh.devices.flat)
        if alone and len(full) == K:
            return parts
        whole = jax.lax.with_sharding_constraint(parts, NamedSharding(mesh, PartitionSpec()))
        return jax.tree.map(lambda x: x[:K], whole)

    return run
