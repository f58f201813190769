"""A fleet on the workers of a Dask scheduler, which deals with machines that come, go and die."""

import uuid
from collections.abc import Generator, Iterable
from typing import Any

from rotflex_jax.errors import InputError, optional
from rotflex_jax.fleet.task import Record, Task, prepared, record

# How long a scheduler may take to answer [s], and recordings that wait at it for a free worker.
PATIENCE, AHEAD = 10, 4


def on_cluster(jobs: Iterable[tuple[int, Task]], scheduler: str) -> Generator[tuple[int, Record]]:
    """Searches recordings on a cluster, and gives each result as it comes.

    The scheduler gives a recording whose worker died to another one. Only a few more recordings than
    there are workers lie at the scheduler at any time, so a million of them need no room there.

    Args:
        jobs: Number and task; drawn when a worker will soon be free.
        scheduler: Its address, `tcp://HOST:8786`.

    Raises:
        InputError: Dask is not installed, no scheduler answers, or it went away.
    """
    distributed: Any = optional("distributed", "A fleet on a scheduler")
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"No Dask scheduler answers at {scheduler} ({' '.join(str(error).split())}); start one with "
            "`dask scheduler`, or give none to use the processes of this machine."
        ) from None
    jobs, running = iter(jobs), {}
    with client:
        done = distributed.as_completed(loop=client.loop)

        def fill() -> None:
            while len(running) < AHEAD + sum(client.nthreads().values()):
                job = next(jobs, None)
                if job is None:
                    return
                future = client.submit(prepared, job[1], key=f"rotflex-{uuid.uuid4().hex}", pure=False)
                running[future] = job[0]
                done.add(future)

        fill()
        for future in done:
            number = running.pop(future)
            if future.status == "finished":
                found = future.result()
            elif future.status == "error":
                fault = future.exception()
                found = record("broken", f"{type(fault).__name__}: {fault}")
            else:
                raise InputError(
                    f"The scheduler at {scheduler} went away; start it again and repeat the call, which "
                    "goes on where it stopped."
                )
            yield number, found
            fill()
