"""One recording of a fleet: the task of a worker, its execution and result, and the text of its code.

The file of a main program changes with every recording that is added to its list, and a notebook has no file.
Therefore its compiled code enters the digest, with the values and functions of the main program that it uses.
"""

import contextlib
import dataclasses
import functools
import pickle
import sys
import tempfile
import threading
import time
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.data import load
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.explanation import Explanation, remaining_failures
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.joints.by_name import imported
from rotflex_jax.models.model import Model, in_units_of
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import enable_fast_start

MAIN = ("__main__", "__mp_main__")
"""Module names of the main program, in its own process and in its worker processes."""

_PLAIN = (int, float, complex, str, bytes, bool, type(None), type(Ellipsis))


def of_main(thing: Any) -> bool:
    """Whether a function or a class is defined in the main program."""
    return getattr(thing, "__module__", None) in MAIN


def code_text(subjects: Iterable[Any]) -> str:
    """Text of functions and classes of the main program and of everything there that they use.

    The text is the same in every process.

    Args:
        subjects: Functions and classes; those of other modules enter by their names.
    """
    seen: set[int] = set()
    return "\n".join(line for subject in subjects for line in _lines(subject, seen))


def _lines(thing: Any, seen: set[int]) -> Iterator[str]:
    if isinstance(thing, _PLAIN):
        yield repr(thing)
    elif isinstance(thing, types.CodeType):
        yield f"{thing.co_code.hex()} {thing.co_names} {thing.co_varnames} {thing.co_argcount}"
        for value in thing.co_consts:
            yield from _lines(value, seen)
    elif isinstance(thing, tuple | list):
        yield type(thing).__name__
        for value in thing:
            yield from _lines(value, seen)
    elif isinstance(thing, set | frozenset):
        yield from sorted("\n".join(_lines(value, seen)) for value in thing)
    elif isinstance(thing, np.ndarray):
        yield f"{thing.dtype} {thing.shape} {thing.tobytes().hex()}"
    elif isinstance(thing, types.ModuleType):
        yield thing.__name__
    elif isinstance(thing, dataclasses.Field):
        yield from _lines((thing.name, thing.default, dict(thing.metadata)), seen)
    elif dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        yield type(thing).__qualname__
        yield from _lines({f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}, seen)
    elif isinstance(thing, functools.partial):
        yield from _lines((thing.func, thing.args, thing.keywords), seen)
    elif isinstance(thing, dict):
        for key, value in thing.items():
            yield repr(key)
            yield from _lines(value, seen)
    elif isinstance(thing, types.FunctionType | type) and of_main(thing):
        if id(thing) not in seen:
            seen.add(id(thing))
            yield thing.__qualname__
            if isinstance(thing, types.FunctionType):
                yield from _function(thing, seen)
            else:
                yield from _class(thing, seen)
    elif isinstance(thing, staticmethod | classmethod):
        yield from _lines(thing.__func__, seen)
    elif isinstance(thing, property):
        yield from _lines((thing.fget, thing.fset, thing.fdel), seen)
    else:
        kind = thing if hasattr(thing, "__qualname__") else type(thing)
        yield f"{kind.__module__}.{kind.__qualname__}"


def _function(function: types.FunctionType, seen: set[int]) -> Iterator[str]:
    yield from _lines(function.__code__, seen)
    yield from _lines((function.__defaults__, function.__kwdefaults__), seen)
    for cell in function.__closure__ or ():
        yield from _lines(cell.cell_contents, seen)
    for name in sorted(_names(function.__code__)):
        if name in function.__globals__:
            yield name
            yield from _lines(function.__globals__[name], seen)


def _class(cls: type, seen: set[int]) -> Iterator[str]:
    for base in cls.__mro__[1:]:
        yield from _lines(base, seen)
    for name, value in sorted(vars(cls).items()):
        # Attributes that abstract classes add, and the place of the definition.
        if name.startswith("_abc") or name in _MADE:
            continue
        yield name
        yield from _lines(value, seen)


_MADE = frozenset(
    {"__module__", "__dict__", "__weakref__", "__doc__", "__abstractmethods__", "__annotations__"}
    | {"__static_attributes__", "__firstlineno__", "__annotate_func__", "__annotations_cache__"}
)


def _names(code: types.CodeType) -> set[str]:
    """Names that code uses, including the code of inner functions."""
    inner = (_names(value) for value in code.co_consts if isinstance(value, types.CodeType))
    return set(code.co_names).union(*inner)


Search = Callable[[Model, Recording, Recording], Any]
Record = dict[str, Any]
"""Plain JSON: `state` is `done`, `refused` (bad input) or `broken` (worth another try). Further entries are
`reason`, `seconds`, `result`, and the texts of the files `model` and `page`."""

# A search uses a whole core and much memory, so the threads of a worker search one after another.
_ONE_SEARCH = threading.Lock()


@dataclasses.dataclass(frozen=True)
class SearchTask:
    """One recording and its search.

    Attributes:
        source: A file, which every worker must be able to read, or the recording itself.
        reading: Arguments of `rotflex_jax.load` for a file.
        share: Share of the recording for training.
        what: Pickled `(model, search)`; it can only be unpickled after the `places` are imported.
        places: Python files or modules with effects of the user.
        pages: Whether the result includes a page.
    """

    source: Path | Recording
    reading: Mapping[str, Any]
    share: float
    what: bytes
    places: tuple[str, ...] = ()
    pages: bool = False


def carry_out(task: SearchTask) -> Record:
    """Searches one recording; an error becomes a sentence in the result."""
    with _ONE_SEARCH:
        start = time.perf_counter()
        try:
            found = record("done") | _searched(task)
        except InputError as error:
            found = record("refused", str(error))
        except (Exception, SystemExit) as error:  # it must not stop the other recordings
            found = record("broken", f"{type(error).__name__}: {error}")
        return found | {"seconds": time.perf_counter() - start}


def record(state: str, reason: str = "") -> Record:
    """The record of a recording without a result, with the reason on one line."""
    files: Record = {"model": None, "page": None}
    return {"state": state, "reason": " ".join(reason.split()), "seconds": 0.0, "result": None} | files


def prepared(task: SearchTask) -> Record:
    """`carry_out` in a process that still has the default settings."""
    enable_fast_start()
    return carry_out(task)


def _searched(task: SearchTask) -> Any:
    for place in task.places:
        imported(place)
    model, search = pickle.loads(task.what)
    source = task.source
    if isinstance(source, Recording):
        recording = source
    else:
        recording = in_units_of(model.mechanism, load(source, **task.reading))
    found = search(model, *recording.split(task.share))
    return {"result": found.to_dict(), "model": _model(found), "page": _page(found) if task.pages else None}


def _model(found: Any) -> str | None:
    """The file of the final model as text; None if there is no model, or if it could not be read back."""
    if not hasattr(found, "save"):
        return None
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(InputError):
        return found.save(Path(folder) / "model.json").read_text(encoding="utf-8")
    return None


def _page(found: Any) -> str | None:
    """The report of a search as text, without its slow parts; None if the search has no report."""
    if not isinstance(found, Discovery):
        return None
    from rotflex_jax.report.page import render  # matplotlib is loaded only where it draws

    try:
        return render(found, Explanation(remaining=remaining_failures(found)))
    except Exception:  # the result of the search is worth more than its page
        return None


def subjects(model: Model, search: Search) -> tuple[Any, ...]:
    """The search function without its bound arguments, and all effects that it may use."""
    function: Any = search
    while isinstance(function, functools.partial):
        function = function.func
    return (function, *CATALOG.values(), *map(type, model.mechanism.effects))


def places_of(model: Model, search: Search, *, far: bool) -> tuple[str, ...]:
    """Files and modules of the user that a worker needs: for the search, its effects and those of the model.

    Args:
        model: The model.
        search: The search function.
        far: Whether the workers are on a cluster; workers on this machine import the main program.

    Raises:
        InputError: The main program is among them, and the workers are on a cluster.
    """
    parts = (s for s in subjects(model, search) if s.__module__.split(".")[0] != "rotflex_jax")
    names = {s.__module__: s.__qualname__ for s in parts}
    own = [names.pop(main) for main in MAIN if main in names]
    if own and far:
        raise InputError(
            f"{own[0]} was written in the main program, where the workers of a cluster cannot find it; move "
            "it to a Python file and import it."
        )
    return tuple(map(_place, names))


def _place(module: str) -> str:
    """The name of a module in a package, or the path of a single file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return module if "." in module or file is None else str(Path(file).resolve())
