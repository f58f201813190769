"""A type checker for the import hook of jaxtyping that checks only annotated arrays.

Other annotations are not checked, since JAX may trace a parameter that is annotated as `float`.
"""

import dataclasses
import functools
import inspect
import itertools
from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import BeartypeConf, beartype

CONFIGURATION = BeartypeConf(is_pep484_tower=True)  # an int is accepted where a float is annotated


def holds_array(hint: Any) -> bool:
    """Whether an annotation contains a jaxtyping array."""
    own = inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray)
    return own or any(holds_array(part) for part in get_args(hint))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a check of its arrays."""
    hints = {name: hint for name, hint in function.__annotations__.items() if holds_array(hint)}
    function.__annotations__ = hints
    return beartype(conf=CONFIGURATION)(function) if hints else function


# Number of calls of each function that are checked in a process. Shapes differ between tests, not between
# the thousands of calls in one search.
CALLS = 50
_always = jaxtyping.jaxtyped


@functools.wraps(_always)
def _at_first(*given: Any, **options: Any) -> Any:
    """Replacement of `jaxtyping.jaxtyped` that checks only functions with arrays, and only their first calls.

    The hook wraps every function of the package, and each checked call takes about 0.1 ms longer.
    """
    if not given:
        return functools.partial(_at_first, **options)
    (part,) = given
    if isinstance(part, (classmethod, staticmethod)):
        return type(part)(_at_first(part.__func__, **options))
    if isinstance(part, property):
        return property(*(f and _at_first(f, **options) for f in (part.fget, part.fset, part.fdel)))
    if inspect.isclass(part):
        if dataclasses.is_dataclass(part):
            part.__init__ = _at_first(part.__init__, **options)  # type: ignore[misc]
        return part
    if not any(isinstance(hint, str) or holds_array(hint) for hint in part.__annotations__.values()):
        return part
    hooked, calls = _always(part, **options), itertools.count()

    @functools.wraps(part)
    def called(*arguments: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        return (hooked if next(calls) < CALLS else part)(*arguments, **named)

    return called


jaxtyping.jaxtyped = _at_first
