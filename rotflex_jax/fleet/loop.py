"""Many recordings, each searched by itself."""

import inspect
import os
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from rotflex_jax.choices import choose
from rotflex_jax.data import load
from rotflex_jax.discover import discover
from rotflex_jax.errors import InputError
from rotflex_jax.fleet import kept
from rotflex_jax.fleet.cluster import on_cluster
from rotflex_jax.fleet.ledger import Ledger, Source
from rotflex_jax.fleet.processes import in_processes, workers_here
from rotflex_jax.fleet.result import Fleet
from rotflex_jax.fleet.task import Record, Search, Task, carry_out, places_of
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.states import output_units
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


def fleet(
    joint: Mechanism | Model,
    recordings: Iterable[str | os.PathLike[str] | Recording],
    *,
    folder: str | os.PathLike[str],
    scheduler: str | None = None,
    workers: int | None = None,
    split: float = 0.7,
    search: Search = discover,
    progress: Callable[[str], None] | None = None,
    **reading: Any,
) -> Fleet:
    """Search many recordings, each by itself, and sum them up.

    Every recording is split, searched, and written to a file of its own as soon as it is finished. The
    same call goes on where an earlier one stopped, and repeats only what has changed: the recording, the
    model, the share, how it is read, the version of the package. A recording that cannot be used is a row
    with a reason, not an end; a process or machine that dies costs only the time it had spent.

    Not for recordings of one machine in one state: `discover` of all of them together knows more than many
    searches of one. In a script, call it below `if __name__ == "__main__":`, as every program that starts
    processes.

    Args:
        joint: The model that each search starts from.
        recordings: Files, or recordings; of any lengths.
        folder: Where to write `summary.html`, `summary.csv`, `recordings/NAME.json`, and
            `models/NAME.json`, which `Model.load` reads.
        scheduler: Address of a Dask scheduler, `tcp://HOST:8786`, whose workers can read the files under the
            same paths and have one thread each; the processes of this machine if None.
        workers: Processes of this machine; 0 for none but this one; by its cores and memory if None.
        split: Share of each recording to learn from, the first part.
        search: What to do with `(model, train, test)`; `functools.partial(rf.discover, rounds=2)` for
            instance.
        progress: Called with a line of text for each recording.
        reading: Arguments of `rotflex_jax.load` for the files, such as `degrees=True`.

    Returns:
        Fleet: a row a recording, in the order given.

    Raises:
        InputError: No recording, one that is given twice, a share outside 0 to 1, an unknown argument, a
            folder that cannot be written, a scheduler that does not answer.
    """
    model = joint if isinstance(joint, Model) else Model(joint)
    sources = [r if isinstance(r, Recording) else Path(r) for r in recordings]
    _check(sources, split, scheduler, workers)
    for name in reading:
        choose(name, inspect.signature(load).parameters, "argument of load")
    places = places_of(model, search, far=scheduler is not None)
    units = output_units(model.mechanism)
    reading = {"outputs": {c: c for c in units}, "units": units, **reading}
    task = Task(Path(), reading, split, _pickled(model, search), places)
    common = kept.digest_of_search(model, search, split, reading, places)
    say = progress or (lambda _: None)
    ledger = Ledger(sources, task, common, kept.made(folder), say)
    try:
        with closing(_carried_out(ledger.unfinished(), scheduler, workers)) as results:
            for number, found in results:
                ledger.finish(number, found)
    finally:  # what stops the loop leaves a summary of what is finished
        result = Fleet(ledger.rows, len(sources), units, ledger.folder, ledger.elapsed)
        result.write()
        if len(ledger.rows) < len(sources):
            say(f"{len(ledger.rows)} of {len(sources)} are finished; the same call goes on with the others")
    return result


def _carried_out(
    jobs: Iterator[tuple[int, Task]], scheduler: str | None, workers: int | None
) -> Generator[tuple[int, Record]]:
    if scheduler is not None:
        return on_cluster(jobs, scheduler)
    if workers == 0:
        return ((number, carry_out(task)) for number, task in jobs)
    return in_processes(jobs, workers or workers_here())


def _pickled(model: Model, search: Search) -> bytes:
    try:
        return pickle.dumps((model, search))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"The model or the search cannot be sent to another process ({error}); let the search be a "
            "function of a Python file, not one that was written inside another."
        ) from None


def _check(sources: Sequence[Source], split: float, scheduler: str | None, workers: int | None) -> None:
    """Refuse before any work what would spoil all of it."""
    if not sources:
        raise InputError("No recording was given, but a fleet needs one or more; give files or recordings.")
    if not 0 < split < 1:
        raise InputError(
            f"Argument `split` is the share of each recording to learn from and must lie between 0 and 1, "
            f"but is {split:g}; give for instance 0.7."
        )
    if workers is not None and (workers < 0 or scheduler is not None):
        given = f"{workers} workers were given" + (" and a scheduler" if scheduler is not None else "")
        raise InputError(
            f"{given}, but workers are processes of this machine, 0 or more, and a scheduler has its own; "
            "give one of the two."
        )
    seen = set()
    for path in (s for s in sources if isinstance(s, Path)):
        if not path.is_file():
            fault = "is a folder" if path.is_dir() else "does not exist"
            raise InputError(f"{path} {fault}, but a recording is one file; give the paths of the files.")
        if path.resolve() in seen:
            raise InputError(f"{path} was given twice, but a recording must not count twice; name it once.")
        seen.add(path.resolve())
