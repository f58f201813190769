"""Many recordings, each searched separately."""

import inspect
import os
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from rotflex_jax import checks
from rotflex_jax.batch import storage
from rotflex_jax.batch.result import Fleet
from rotflex_jax.batch.storage import BatchProgress, Source
from rotflex_jax.batch.task import Record, Search, SearchTask, carry_out, places_of
from rotflex_jax.batch.workers import in_processes, on_cluster, workers_here
from rotflex_jax.checks import shown
from rotflex_jax.data import load
from rotflex_jax.discover import discover
from rotflex_jax.errors import InputError
from rotflex_jax.joints.by_name import choose
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.model import Model, units_to_read
from rotflex_jax.recording import Recording


def fleet(
    mechanism: Mechanism | Model,
    recordings: Iterable[str | os.PathLike[str] | Recording],
    *,
    folder: str | os.PathLike[str],
    scheduler: str | None = None,
    workers: int | None = None,
    split: float = 0.7,
    pages: bool = False,
    search: Search = discover,
    progress: Callable[[str], None] | None = None,
    **reading: Any,
) -> Fleet:
    """Search many recordings, each separately, and summarise them.

    Each recording is split and searched, and its result is written to a separate file as soon as it is
    finished. The same call continues where an earlier one stopped. It repeats a search only if something has
    changed: the recording, the model, the share, the arguments of reading, or the version of the package. A
    recording that cannot be used gives a row with a reason. If a process or machine fails, only its time is
    lost.

    Not for recordings of one machine in one state: `discover` on all of them together is more accurate than
    separate searches. In a script, call it below `if __name__ == "__main__":`, as in every program that
    starts processes.

    Args:
        mechanism: The model from which each search starts.
        recordings: Files or recordings, of any lengths.
        folder: Folder for `summary.html`, `summary.csv`, `recordings/NAME.json`, and `models/NAME.json`,
            which `Model.load` reads.
        scheduler: Address of a Dask scheduler, `tcp://HOST:8786`, whose workers can read the files under the
            same paths and have one thread each. If None, processes of this machine are used.
        workers: Number of processes of this machine; 0 to use the calling process alone; if None, as many as
            its cores and memory allow.
        split: Share of each recording for training, at its beginning.
        pages: Whether to write `pages/NAME.html` for each recording: the report of its search, without latent
            and learned torques. The summary links to it. No page is written for a recording that was searched
            in an earlier call.
        search: Function of `(model, train, test)`, such as `functools.partial(rf.discover, rounds=2)`.
        progress: Called with a line of text for each recording.
        reading: Arguments of `rotflex_jax.load` for the files, such as `degrees=True`.

    Returns:
        One row for each recording, in the order given.

    Raises:
        InputError: There is no recording, a recording is given twice, the share is not between 0 and 1, an
            argument is unknown, the folder cannot be written, or the scheduler does not answer.
    """
    model, progress = Model.of(mechanism), checks.progress(progress)
    sources = _sources(recordings)
    if not callable(search):
        raise InputError(
            f"Argument `search` must be a function of a model and two recordings, but is {shown(search)}; "
            "leave it out for rotflex_jax.discover."
        )
    _check(sources, split, scheduler, workers, pages)
    for name in reading:
        choose(name, inspect.signature(load).parameters, "argument of load")
    places = places_of(model, search, far=scheduler is not None)
    units = output_units(model.mechanism)
    column = reading.get("input")  # `load` refuses what is no word
    to_read = units_to_read(model.mechanism, column if isinstance(column, str) else None)
    reading = {"outputs": {c: c for c in units}, "units": to_read, **reading}
    task = SearchTask(Path(), reading, split, _pickled(model, search), places, pages)
    common = storage.digest_of_search(model, search, split, reading, places)
    batch = BatchProgress(sources, task, common, storage.created(folder, pages), progress)
    try:
        with closing(_carried_out(batch.unfinished(), scheduler, workers)) as results:
            for number, found in results:
                batch.finish(number, found)
    finally:  # also if the loop is interrupted
        result = Fleet(batch.rows, len(sources), units, batch.folder, batch.elapsed)
        result.write()
        if len(batch.rows) < len(sources):
            progress(
                f"{len(batch.rows)} of {len(sources)} are finished; the same call goes on with the others"
            )
    return result


def _carried_out(
    jobs: Iterator[tuple[int, SearchTask]], scheduler: str | None, workers: int | None
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


def _sources(recordings: Any) -> list[Source]:
    """Recordings and paths of files, checked."""
    wrong = [recordings]
    if (found := checks.entries(recordings)) is not None:
        wrong = [r for r in found if not isinstance(r, Recording | str | os.PathLike)]
        if not wrong:
            return [r if isinstance(r, Recording) else Path(r) for r in found]
    raise InputError(
        f"Argument `recordings` must be a list of files or Recordings, but {shown(wrong[0])} was given; "
        "give for instance ['run1.csv', 'run2.csv']."
    )


def _check(
    sources: Sequence[Source], split: float, scheduler: str | None, workers: int | None, pages: bool
) -> None:
    """Checks the arguments before any work."""
    if not sources:
        raise InputError("No recording was given, but a fleet needs one or more; give files or recordings.")
    checks.number(split, "split", above=0, below=1, example="0.7")
    checks.yes_or_no(pages, "pages")
    if workers is not None:
        checks.whole(workers, "workers", 0)
    if not (scheduler is None or isinstance(scheduler, str)):
        raise InputError(
            f"Argument `scheduler` must be an address, but is {shown(scheduler)}; write tcp://HOST:8786."
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
