"""Results on disk: a file for each recording, with a digest of its inputs; which recordings are finished."""

import dataclasses
import functools
import inspect
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rotflex_jax import __version__
from rotflex_jax.batch.result import RecordingRow
from rotflex_jax.batch.task import Record, Search, SearchTask, code_text, of_main, record, subjects
from rotflex_jax.checks import real, shown
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import content, digest_of
from rotflex_jax.text.files import write_file

RESULTS, MODELS, PAGES = "recordings", "models", "pages"
RESULT_SCHEMA = 1


def digest_of_search(
    model: Model, search: Search, share: float, reading: Mapping[str, Any], places: Iterable[str]
) -> str:
    """Digest of everything that the searches have in common; the same in every process."""
    m = model.mechanism
    physics = (m.coordinates, m.ports, m.effects, m.outputs, sorted(m.trusted), m.units)
    text = repr(
        (__version__, physics, model.solver, model.gates, _named(search), share, sorted(reading.items()))
    )
    files = [Path(place).read_bytes() for place in places if place.endswith(".py")]
    written = code_text((search, *(s for s in subjects(model, search) if of_main(s))))
    return digest_of(text.encode(), written.encode(), *files)


def digest_of_recording(source: Path | Recording, common: str) -> str:
    """Digest of a recording and of its search.

    Raises:
        OSError: The file cannot be read.
    """
    if isinstance(source, Recording):
        return digest_of(common.encode(), *content(source))
    return digest_of(common.encode(), source.read_bytes())


def _named(search: Any) -> str:
    """Name of a function with its bound arguments; the same in every process."""
    if isinstance(search, functools.partial):
        words = sorted((name, _written(value)) for name, value in search.keywords.items())
        return f"{_named(search.func)}{_written(search.args)}{words!r}"
    return f"{search.__module__}.{search.__qualname__}"


def _written(value: Any) -> str:
    """An argument as text; functions by their names, because their `repr` contains an address."""
    if isinstance(value, list | tuple):
        return f"{type(value).__name__}({', '.join(map(_written, value))})"
    if isinstance(value, functools.partial) or inspect.isroutine(value):
        return _named(value)
    return repr(value)


def names_of(sources: Sequence[Path | Recording]) -> list[str]:
    """A name for each recording that is valid for a file: the name of its file if that is unique.

    >>> names_of([Path("a/run.csv"), Path("b/run.csv"), Path("b/step.csv")])[2]
    'step'
    """
    plain = [s.stem if isinstance(s, Path) else Path(s.source).stem or "recording" for s in sources]
    plain = ["".join(c if c.isalnum() or c in "-_.+" else "_" for c in name) for name in plain]
    count = Counter(plain)
    return [
        name if count[name] == 1 else _apart(f"{name}-{_short(source, number)}", count)
        for number, (name, source) in enumerate(zip(plain, sources, strict=True), 1)
    ]


def _apart(name: str, taken: Container[str]) -> str:
    """The name, with underscores at its end until it differs from names that are taken."""
    while name in taken:
        name += "_"
    return name


def _short(source: Path | Recording, number: int) -> str:
    if isinstance(source, Recording):
        return str(number)
    return digest_of(os.path.realpath(source).encode())[:8]


def write(folder: Path, record: Record) -> None:
    """Writes the model and the page of a result, then the result; each completely or not at all."""
    record = {"schema": RESULT_SCHEMA, **record}
    model, page, name = record.pop("model"), record.pop("page", None), f"{record['name']}.json"
    for path, text in ((folder / MODELS / name, model), (page_of(folder, record["name"]), page)):
        if text is None:  # a file of an earlier search does not belong to this one
            path.unlink(missing_ok=True)
        else:
            write_file(path, text)
    write_file(folder / RESULTS / name, json.dumps(record, indent=1) + "\n")


def page_of(folder: Path, name: str) -> Path:
    """Path of the page of a recording, whether or not it exists."""
    return folder / PAGES / f"{name}.html"


def read(folder: Path, name: str, digest: str) -> Record | None:
    """The stored result of the same search of the same recording; None if there is no valid one."""
    try:
        known = json.loads((folder / RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    same = isinstance(known, dict) and known.get("schema") == RESULT_SCHEMA and known.get("digest") == digest
    return known if same and known.get("state") in ("done", "refused") and _is_whole(known) else None


def _is_whole(known: Record) -> bool:
    """Whether a file has all entries of a row of the summary, with the right types."""
    try:
        row = RecordingRow.of(known)
        errors = (row.before, row.after, row.whole_before, row.whole_after, row.noise)
        words = [row.name, row.source, row.reason, *(e for each in errors for e in each)]
        words += [w for effect, port, others in row.effects for w in (effect, port, *sum(others, ()))]
        numbers = [row.seconds, *(v for each in errors for v in each.values() if v is not None)]
        numbers += [] if row.window_seconds is None else [row.window_seconds]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        return False
    verdicts = {v.value for v in Verdict} if known["state"] == "done" else {""}
    right = all(isinstance(w, str) for w in words) and all(math.isfinite(real(x)) for x in numbers)
    return right and row.verdict in verdicts


def created(folder: str | os.PathLike[str], pages: bool = False) -> Path:
    """The folder of the results, created if needed, with a folder for pages if there will be some.

    Raises:
        InputError: The folder cannot be created.
    """
    if not isinstance(folder, str | os.PathLike):
        raise InputError(
            f"Argument `folder` must be a path, but is {shown(folder)}; give for instance 'fleet'."
        )
    try:
        for part in (RESULTS, MODELS, *([PAGES] if pages else [])):
            (Path(folder) / part).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot hold the results ({error.strerror or error}), but they need a folder of "
            "their own; name another."
        ) from None
    return Path(folder)


Source = Path | Recording


class BatchProgress:
    """Finished and unfinished recordings of a batch, with a row and a file for each finished recording.

    Args:
        sources: Files or recordings.
        task: Task of every recording, without its source.
        common: Digest of everything that the searches have in common.
        folder: Folder of the results.
        progress: Called with a line of text for each finished recording.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        task: SearchTask,
        common: str,
        folder: Path,
        progress: Callable[[str], None],
    ) -> None:
        self.sources, self.task, self.common, self.folder = sources, task, common, folder
        self.progress = progress
        self.names = names_of(sources)
        self.start, self.new = time.perf_counter(), 0
        self._digests: dict[int, str] = {}
        self._rows: dict[int, RecordingRow] = {}

    @property
    def rows(self) -> tuple[RecordingRow, ...]:
        """Rows of the finished recordings, in the order given."""
        return tuple(self._rows[number] for number in sorted(self._rows))

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self.start

    def unfinished(self) -> Iterator[tuple[int, SearchTask]]:
        """Number and task of each recording that no earlier call finished; files are read when needed."""
        for number, source in enumerate(self.sources):
            try:
                self._digests[number] = digest_of_recording(source, self.common)
            except OSError as error:
                fault = f"{source} cannot be read ({error.strerror or error}); see that it can."
                self.finish(number, record("broken", fault))
                continue
            known = read(self.folder, self.names[number], self._digests[number])
            if known is None:
                yield number, dataclasses.replace(self.task, source=source)
            else:
                # A file with the same content may have moved.
                self._rows[number] = RecordingRow.of({**known, **self._labels(number)}, known=True)

    def finish(self, number: int, found: Record) -> None:
        """Stores a result and reports it."""
        found = {**self._labels(number), "digest": self._digests.get(number, ""), **found}
        write(self.folder, found)
        row = self._rows[number] = RecordingRow.of(found)
        self.new += 1
        summary = row.reason or f"{row.verdict.replace('_', ' ')} {row.found}".strip()
        rest = len(self.sources) - len(self._rows)
        left = f"; about {_duration(self.elapsed / self.new * rest)} left" if rest else ""
        self.progress(
            f"{len(self._rows)} of {len(self.sources)}: {row.name}: {summary} ({row.seconds:.0f} s{left})"
        )

    def _labels(self, number: int) -> dict[str, str]:
        source = self.sources[number]
        origin = source.source if isinstance(source, Recording) else str(source)
        return {"name": self.names[number], "source": origin}


def _duration(seconds: float) -> str:
    """A duration in a suitable unit.

    >>> _duration(50), _duration(400), _duration(90000)
    ('50 s', '7 min', '25 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.0f} h"
