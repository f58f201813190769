"""One recording of a fleet: what a worker is sent, what it does, what it sends back."""

import contextlib
import dataclasses
import functools
import pickle
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rotflex_jax.choices import imported
from rotflex_jax.data import load
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.fastloops import quicken
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

Search = Callable[[Model, Recording, Recording], Any]
Record = dict[str, Any]
"""Plain JSON: `state` is `done`, `refused` (bad input) or `broken` (worth another try); with it go `reason`,
`seconds`, `result`, and `model`, the text of its file."""

# A search takes all of one core and much of the memory; the threads of a worker take turns.
_TURN = threading.Lock()


@dataclasses.dataclass(frozen=True)
class Task:
    """One recording, and what is done with it.

    Attributes:
        source: A file, which every worker must be able to read, or the recording itself.
        reading: Arguments of `rotflex_jax.load` for a file.
        share: Share of the recording to learn from.
        what: Pickled `(model, search)`. Bytes, since they can only be read after `places` are imported.
        places: Python files or modules with effects of the user's own.
    """

    source: Path | Recording
    reading: Mapping[str, Any]
    share: float
    what: bytes
    places: tuple[str, ...] = ()


def carry_out(task: Task) -> Record:
    """Search one recording; whatever goes wrong becomes one sentence."""
    with _TURN:
        began = time.perf_counter()
        try:
            found = record("done") | _searched(task)
        except InputError as error:
            found = record("refused", str(error))
        except (Exception, SystemExit) as error:  # one recording must not end the others
            found = record("broken", f"{type(error).__name__}: {error}")
        return found | {"seconds": time.perf_counter() - began}


def record(state: str, reason: str = "") -> Record:
    """What is known of a recording that brought no result; the reason on one line."""
    return {"state": state, "reason": " ".join(reason.split()), "seconds": 0.0, "result": None, "model": None}


def prepared(task: Task) -> Record:
    """`carry_out` in a process that nobody has prepared."""
    quicken()
    return carry_out(task)


def _searched(task: Task) -> Any:
    for place in task.places:
        imported(place)
    model, search = pickle.loads(task.what)
    source = task.source
    recording = source if isinstance(source, Recording) else load(source, **task.reading)
    found = search(model, *recording.split(task.share))
    return {"result": found.to_dict(), "model": _model(found)}


def _model(found: Any) -> str | None:
    """The file of the final model as text; None where a search brings none, or none that can be read back."""
    if not hasattr(found, "save"):
        return None
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(InputError):
        return found.save(Path(folder) / "model.json").read_text(encoding="utf-8")
    return None


def places_of(model: Model, search: Search, *, far: bool) -> tuple[str, ...]:
    """Files and modules of the user's own that a worker needs: effects that are searched or in the model.

    Args:
        model: The model.
        search: What is done with it.
        far: Whether the workers are of a cluster. Those of this machine run the main program by themselves.

    Raises:
        InputError: The main program is among them, and the workers are far.
    """
    subject: Any = search
    while isinstance(subject, functools.partial):
        subject = subject.func
    subjects: Iterable[Any] = (subject, *CATALOG.values(), *map(type, model.mechanism.effects))
    names = {s.__module__: s.__qualname__ for s in subjects if s.__module__.split(".")[0] != "rotflex_jax"}
    own = [names.pop(main) for main in ("__main__", "__mp_main__") if main in names]
    if own and far:
        raise InputError(
            f"{own[0]} was written in the main program, where the workers of a cluster cannot find it; move "
            "it to a Python file and import it."
        )
    return tuple(map(_place, names))


def _place(module: str) -> str:
    """A module of a package by its name, a file that stands alone by its path."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return module if "." in module or file is None else str(Path(file).resolve())
