"""Which recordings of a fleet are finished, and what came out."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rotflex_jax.fleet import kept
from rotflex_jax.fleet.result import Row
from rotflex_jax.fleet.task import Record, Task, record
from rotflex_jax.recording import Recording

Source = Path | Recording


class Ledger:
    """Keeps a row and a file for every recording that is finished.

    Args:
        sources: Files or recordings.
        task: What is done with each; its own source does not count.
        common: Digest of what all have in common.
        folder: Where the files go.
        say: Called with a line of text for each that is finished.
    """

    def __init__(
        self, sources: Sequence[Source], task: Task, common: str, folder: Path, say: Callable[[str], None]
    ) -> None:
        self.sources, self.task, self.common, self.folder, self.say = sources, task, common, folder, say
        self.names = kept.names_of(sources)
        self.began, self.new = time.perf_counter(), 0
        self._digests: dict[int, str] = {}
        self._rows: dict[int, Row] = {}

    @property
    def rows(self) -> tuple[Row, ...]:
        """Those that are finished, in the order in which they were given."""
        return tuple(self._rows[number] for number in sorted(self._rows))

    @property
    def elapsed(self) -> float:
        """Since the beginning [s]."""
        return time.perf_counter() - self.began

    def unfinished(self) -> Iterator[tuple[int, Task]]:
        """Number and task of each that no earlier call has finished, looked at one by one when asked for."""
        for number, source in enumerate(self.sources):
            try:
                self._digests[number] = kept.digest_of_recording(source, self.common)
            except OSError as error:
                fault = f"{source} cannot be read ({error.strerror or error}); see that it can."
                self.finish(number, record("broken", fault))
                continue
            known = kept.read(self.folder, self.names[number], self._digests[number])
            if known is None:
                yield number, dataclasses.replace(self.task, source=source)
            else:
                # The same content may by now have another place.
                self._rows[number] = Row.of({**known, **self._labels(number)}, known=True)

    def finish(self, number: int, found: Record) -> None:
        """Write down what was found."""
        found = {**self._labels(number), "digest": self._digests.get(number, ""), **found}
        kept.write(self.folder, found)
        row = self._rows[number] = Row.of(found)
        self.new += 1
        told = row.reason or f"{row.verdict.replace('_', ' ')} {row.found}".strip()
        rest = len(self.sources) - len(self._rows)
        left = f"; about {_duration(self.elapsed / self.new * rest)} left" if rest else ""
        self.say(f"{len(self._rows)} of {len(self.sources)}: {row.name}: {told} ({row.seconds:.0f} s{left})")

    def _labels(self, number: int) -> dict[str, str]:
        source = self.sources[number]
        origin = source.source if isinstance(source, Recording) else str(source)
        return {"name": self.names[number], "source": origin}


def _duration(seconds: float) -> str:
    """In the unit that a person would take.

    >>> _duration(50), _duration(400), _duration(90000)
    ('50 s', '7 min', '25 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.0f} h"
