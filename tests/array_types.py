"""A type checker for the import hook of jaxtyping: shapes and types of arrays, as annotations state them.

Other annotations are not checked: a parameter of an effect is a `float` that JAX may trace.
"""

import inspect
from collections.abc import Callable
from typing import Any, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray

CONFIGURATION = BeartypeConf(is_pep484_tower=True)  # a whole number is a float, as in annotations


def holds_array(hint: Any) -> bool:
    """Whether an annotation states the shape of an array somewhere."""
    own = inspect.isclass(hint) and issubclass(hint, AbstractArray)
    return own or any(holds_array(part) for part in get_args(hint))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a check of its arrays."""
    hints = {name: hint for name, hint in function.__annotations__.items() if holds_array(hint)}
    function.__annotations__ = hints
    return beartype(conf=CONFIGURATION)(function) if hints else function
