"""What a function or a class of the main program does, as text: a changed one gives another text.

The file of a main program changes with every recording that is added to its list, and a notebook has none. So
the compiled code counts, with the values and the functions of the main program that it uses.
"""

import dataclasses
import functools
import types
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

MAIN = ("__main__", "__mp_main__")
"""Names of the main program, here and in its worker processes."""

_PLAIN = (int, float, complex, str, bytes, bool, type(None), type(Ellipsis))


def of_main(thing: Any) -> bool:
    """Whether a function or a class is one of the main program."""
    return getattr(thing, "__module__", None) in MAIN


def code_text(subjects: Iterable[Any]) -> str:
    """Text of functions and classes of the main program, and of all of it that they use; the same each time.

    Args:
        subjects: Functions and classes; those of other modules count with their names.
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
        # What abstract classes make of the rest, and where it was written.
        if name.startswith("_abc") or name in _MADE:
            continue
        yield name
        yield from _lines(value, seen)


_MADE = frozenset(
    {"__module__", "__dict__", "__weakref__", "__doc__", "__abstractmethods__", "__annotations__"}
    | {"__static_attributes__", "__firstlineno__", "__annotate_func__", "__annotations_cache__"}
)


def _names(code: types.CodeType) -> set[str]:
    """Names that code uses, that of functions inside of it too."""
    inner = (_names(value) for value in code.co_consts if isinstance(value, types.CodeType))
    return set(code.co_names).union(*inner)
