"""A fleet in processes of this machine.

Plain `multiprocessing`: `ProcessPoolExecutor` breaks as a whole when one process dies, does not say whose
recording it was, and cannot stop what is running. A process and a pipe per worker can do both, and need
no package.
"""

import contextlib
import os
import signal
from collections.abc import Generator, Iterable
from itertools import islice
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any

from rotflex_jax.errors import InputError
from rotflex_jax.fastloops import quicken
from rotflex_jax.fleet.task import Record, Task, carry_out, record
from rotflex_jax.threads import cores, keep_to_share

# Times a recording may end its process before it is given up.
TRIES = 3
# Memory of a process [bytes]: so much is counted on for each, and one that has more is replaced by a new one
# before its next recording. Compiled code is most of it, and comes back from disk.
ROOM = 3.5e9


def in_processes(jobs: Iterable[tuple[int, Task]], workers: int) -> Generator[tuple[int, Record]]:
    """Searches recordings side by side, and gives each result as it comes.

    A recording whose process dies is begun again in a new one; no other notices.

    Args:
        jobs: Number and task; drawn when a process is free.
        workers: Most processes.

    Raises:
        InputError: No process could begin.
    """
    jobs = iter(jobs)
    begun = list(islice(jobs, workers))
    lanes = [_Lane(*job, share=(place, len(begun))) for place, job in enumerate(begun)]
    try:
        while lanes:
            ready = connection.wait([lane.line for lane in lanes])
            for lane in [lane for lane in lanes if lane.line in ready]:
                try:
                    found = lane.told()
                except (EOFError, OSError):
                    found = lane.died()
                if found is None:
                    continue
                yield lane.number, found
                following = next(jobs, None)
                if following is None:
                    lanes.remove(lane)
                    lane.line.close()  # at which the process ends
                else:
                    lane.take(*following)
    finally:
        for lane in lanes:
            lane.process.kill()


def workers_here() -> int:
    """As many processes as this machine has cores and memory for."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # a system that does not tell
        return cores()
    return max(1, min(cores(), int(memory // ROOM)))


class _Lane:
    """A process and the recording it is at."""

    def __init__(self, number: int, task: Task, share: tuple[int, int]) -> None:
        self.number, self.task, self.share = number, task, share
        self.deaths, self.began = 0, False
        self._start()

    def _start(self) -> None:
        # Spawned, since a fork of a process that has used JAX may hang.
        context = get_context("spawn")
        self.line, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, ROOM, self.share), daemon=True)
        self.process.start()
        far.close()  # so that the end of the process is the end of the line

    def take(self, number: int, task: Task) -> None:
        """Go on with another recording."""
        self.number, self.task, self.deaths = number, task, 0
        if self.line.closed:
            self._start()
        else:
            self._send()

    def _send(self) -> None:
        with contextlib.suppress(OSError):  # a process that is gone is noticed when the line is read
            self.line.send(self.task)

    def told(self) -> Record | None:
        """What the process found; None where it has only just begun and now has its task."""
        found: Any = self.line.recv()
        if found is None:
            self.began = True
            self._send()
        return found

    def died(self) -> Record | None:
        """Begin again, or give the recording up."""
        self.line.close()
        self.process.join()
        status = self.process.exitcode
        if not self.began:
            raise InputError(
                f"A worker process ended before it could begin (exit status {status}), but a fleet needs "
                'some; in a script, call fleet below `if __name__ == "__main__":`.'
            )
        self.deaths += status != 0  # with 0 it left of its own accord, before it had seen this task
        if self.deaths == TRIES:
            return record(
                "broken", f"It ended its process {TRIES} times (exit status {status}): too little memory?"
            )
        self._start()
        return None


def _serve(line: Any, room: float, share: tuple[int, int]) -> None:
    """The life of a worker process, until there is nothing more to do or it has grown too large."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; who started this one ends it
    keep_to_share(*share)
    quicken()
    line.send(None)
    with contextlib.suppress(EOFError):
        line.send(carry_out(line.recv()))
        while _memory() < room:
            line.send(carry_out(line.recv()))


def _memory() -> float:
    """Of this process [bytes]; 0 where the system does not tell (anywhere but on Linux)."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if told.exists() else 0.0
