"""A type checker for the import hook of jaxtyping: shapes and types of arrays, as annotations state them.

Other annotations are not checked: a parameter of an effect is a `float` that JAX may trace.
"""

import dataclasses
import functools
import inspect
import itertools
from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import BeartypeConf, beartype

CONFIGURATION = BeartypeConf(is_pep484_tower=True)  # a whole number is a float, as in annotations


def holds_array(hint: Any) -> bool:
    """Whether an annotation states the shape of an array somewhere."""
    own = inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray)
    return own or any(holds_array(part) for part in get_args(hint))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a check of its arrays."""
    hints = {name: hint for name, hint in function.__annotations__.items() if holds_array(hint)}
    function.__annotations__ = hints
    return beartype(conf=CONFIGURATION)(function) if hints else function


# So many calls of each function are checked in a process. Shapes differ between tests, not between the
# thousands of calls that one search makes.
CALLS = 50
_always = jaxtyping.jaxtyped


@functools.wraps(_always)
def _at_first(*given: Any, **options: Any) -> Any:
    """The decorator of the hook, for functions that have arrays, and for their first calls.

    The hook wraps every function of the package, and a call of one takes about 0.1 ms more then.
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
