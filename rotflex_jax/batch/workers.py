"""A batch in processes of this machine or on the workers of a Dask scheduler.

Plain `multiprocessing` is used: `ProcessPoolExecutor` breaks as a whole when one process dies, does not tell
which recording the process had, and cannot stop a running task. A process and a pipe for each worker can do
all of this, without another package.
"""

import contextlib
import logging
import os
import signal
import uuid
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from itertools import islice
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any

from rotflex_jax.batch.task import Record, SearchTask, carry_out, prepared, record
from rotflex_jax.errors import InputError, optional
from rotflex_jax.runtime.xla import bind_to_cores, cores, enable_fast_start

# Largest number of attempts at a recording whose process dies.
MOST_ATTEMPTS = 3
# Memory of a process [bytes]: this much is reserved for each. A process with more is replaced by a new one
# before its next recording; most of its memory is compiled code, which is read from disk again.
PROCESS_MEMORY = 3.5e9


def in_processes(jobs: Iterable[tuple[int, SearchTask]], workers: int) -> Generator[tuple[int, Record]]:
    """Searches recordings in parallel, and yields each result as soon as it is available.

    A recording whose process dies is searched again in a new process; the others are not affected.

    Args:
        jobs: Number and task of each recording; taken when a process is free.
        workers: Largest number of processes.

    Raises:
        InputError: No process could start.
    """
    jobs = iter(jobs)
    first = list(islice(jobs, workers))
    busy = [_Worker(*job, share=(k, len(first))) for k, job in enumerate(first)]
    try:
        while busy:
            ready = connection.wait([worker.pipe for worker in busy])
            for worker in [worker for worker in busy if worker.pipe in ready]:
                try:
                    found = worker.receive()
                except (EOFError, OSError):
                    found = worker.restart()
                if found is None:
                    continue
                yield worker.number, found
                following = next(jobs, None)
                if following is None:
                    busy.remove(worker)
                    worker.pipe.close()  # this ends the process
                else:
                    worker.take(*following)
    finally:
        for worker in busy:
            worker.process.kill()


def workers_here() -> int:
    """Number of processes for which this machine has cores and memory."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not known on this system
        return cores()
    return max(1, min(cores(), int(memory // PROCESS_MEMORY)))


class _Worker:
    """A process and its current recording."""

    def __init__(self, number: int, task: SearchTask, share: tuple[int, int]) -> None:
        self.number, self.task, self.share = number, task, share
        self.deaths, self.started = 0, False
        self._start()

    def _start(self) -> None:
        # Spawned, because a fork of a process that has used JAX may hang.
        context = get_context("spawn")
        self.pipe, other_end = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(other_end, PROCESS_MEMORY, self.share), daemon=True
        )
        self.process.start()
        other_end.close()  # so that the pipe closes when the process ends

    def take(self, number: int, task: SearchTask) -> None:
        """Starts another recording."""
        self.number, self.task, self.deaths = number, task, 0
        if self.pipe.closed:
            self._start()
        else:
            self._send()

    def _send(self) -> None:
        with contextlib.suppress(OSError):  # a dead process is noticed when the pipe is read
            self.pipe.send(self.task)

    def receive(self) -> Record | None:
        """The result; None if the process has just started and only now receives its task."""
        found: Any = self.pipe.recv()
        if found is None:
            self.started = True
            self._send()
        return found

    def restart(self) -> Record | None:
        """Starts the recording again in a new process; after too many attempts, a record of the failure."""
        self.pipe.close()
        self.process.join()
        status = self.process.exitcode
        if not self.started:
            raise InputError(
                f"A worker process ended before it could begin (exit status {status}), but a fleet needs "
                'some; in a script, call fleet below `if __name__ == "__main__":`.'
            )
        self.deaths += status != 0  # status 0: it ended by itself because of its memory, before this task
        if self.deaths == MOST_ATTEMPTS:
            attempts = f"It ended its process {MOST_ATTEMPTS} times"
            return record("broken", f"{attempts} (exit status {status}): too little memory?")
        self._start()
        return None


def _serve(pipe: Any, memory: float, share: tuple[int, int]) -> None:
    """Main loop of a worker process, until there is no more task or it uses too much memory."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent ends this one
    bind_to_cores(*share)
    enable_fast_start()
    pipe.send(None)
    with contextlib.suppress(EOFError):
        pipe.send(carry_out(pipe.recv()))
        while _memory() < memory:
            pipe.send(carry_out(pipe.recv()))


def _memory() -> float:
    """Memory of this process [bytes]; 0 on systems other than Linux, where it is not known."""
    file = Path("/proc/self/statm")
    return int(file.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if file.exists() else 0.0


# Longest wait for the answer of a scheduler [s], and recordings in its queue beyond one per worker thread.
SCHEDULER_TIMEOUT, QUEUED_RECORDINGS = 10, 4


def on_cluster(jobs: Iterable[tuple[int, SearchTask]], scheduler: str) -> Generator[tuple[int, Record]]:
    """Searches recordings on a cluster, and yields each result as soon as it is available.

    The scheduler gives a recording whose worker died to another worker. Only a few more recordings than there
    are workers are queued at the scheduler at any time, so a million of them need no memory there.

    Args:
        jobs: Number and task of each recording; taken when a worker will soon be free.
        scheduler: Address of the scheduler, `tcp://HOST:8786`.

    Raises:
        InputError: Dask is not installed, no scheduler answers, or the scheduler stops.
    """
    distributed: Any = optional("distributed", "A fleet on a scheduler")
    try:
        client = distributed.Client(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"No Dask scheduler answers at {scheduler} ({' '.join(str(error).split())}); start one with "
            "`dask scheduler`, or give none to use the processes of this machine."
        ) from None
    gone = InputError(
        f"The scheduler at {scheduler} went away; start it again and repeat the call, which goes on where it "
        "stopped."
    )
    # When the scheduler is gone, each kind of call fails in a different way.
    lost = (OSError, TimeoutError, CancelledError, RuntimeError)
    jobs, running = iter(jobs), {}
    with _without_its_log(), client:
        done = distributed.as_completed(loop=client.loop)

        def fill() -> None:
            while len(running) < QUEUED_RECORDINGS + threads():
                job = next(jobs, None)
                if job is None:
                    return
                try:
                    future = client.submit(prepared, job[1], key=f"rotflex-{uuid.uuid4().hex}", pure=False)
                except lost:
                    raise gone from None
                running[future] = job[0]
                done.add(future)

        def threads() -> int:
            try:
                return sum(client.nthreads().values())
            except lost:
                raise gone from None

        fill()
        for future in done:
            number = running.pop(future)
            if future.status == "error":
                fault = future.exception()
                found = record("broken", f"{type(fault).__name__}: {fault}")
            elif future.status == "finished":
                try:
                    found = future.result()
                except lost:
                    raise gone from None
            else:
                raise gone
            yield number, found
            fill()


@contextlib.contextmanager
def _without_its_log() -> Iterator[None]:
    """Silences Dask, which logs the loss of a scheduler with tracebacks, repeatedly while it reconnects."""
    # Each part of Dask has a log level of its own.
    parts = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    levels = {log: log.level for log in map(logging.getLogger, ("distributed", *parts))}
    for log in levels:
        log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for log, level in levels.items():
            log.setLevel(level)
