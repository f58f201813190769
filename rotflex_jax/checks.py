"""Checks of arguments of the public functions; an invalid argument is refused with one sentence."""

import difflib
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Float, Num, Shaped

from rotflex_jax.errors import InputError

Given = ParamSpec("Given")
Made = TypeVar("Made")
Progress = Callable[[str], Any]
"""Function that receives lines of text on the progress of a computation."""


def shown(value: Any) -> str:
    """The given value as text, short enough for a sentence.

    >>> shown(np.float64(0.5)), shown("run.csv"), shown([1, 2, 3]), shown(int)
    ('0.5', "'run.csv'", 'a list', 'the class int')
    """
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | complex | str):
        text = repr(value)
        return text if len(text) <= 60 else f"{text[:57]}..."
    return _with_article(type(value).__name__)


def _with_article(name: str) -> str:
    """A name of a class behind its indefinite article."""
    return f"an {name}" if name[0].lower() in "aeiou" else f"a {name}"


def real(value: Any) -> float:
    """A real number as a float; NaN for anything else, also for True and False."""
    try:
        array = np.asarray(value)
        if array.ndim or array.dtype.kind not in "iuf":
            return math.nan
        return float(array)
    except (TypeError, ValueError, OverflowError):
        return math.nan


SMALLEST, LARGEST = 1e-100, 1e100
"""Range of accepted numbers; no physical quantity is beyond it, and products of larger ones can overflow."""


def number(
    value: Any,
    name: str,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    unit: str = "",
    example: str,
) -> float:
    """A finite number within limits.

    Args:
        value: The value that was given.
        name: Name of the argument.
        above: The number must be larger than this.
        least: The number must not be smaller than this.
        below: The number must be smaller than this.
        unit: Unit in words or as a symbol.
        example: Valid value that the message suggests.

    Raises:
        InputError: The value is no such number.

    >>> number(float("nan"), "seconds", above=0, unit="s", example="2.0")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `seconds` must be a finite number above 0 [s], but is nan; \
give for instance 2.0.
    """
    found = real(value)
    sized = abs(found) <= LARGEST and (found == 0 or abs(found) >= SMALLEST)
    if sized and found > above and least <= found < below:
        return found
    limits = [f"above {above:g}"] * (above > -math.inf) + [f"from {least:g}"] * (least > -math.inf)
    limits += [f"below {below:g}"] * (below < math.inf)
    size = "a finite number" if sized or not math.isfinite(found) else "a number of usual size"
    what = " ".join([size, *[" and ".join(limits)] * bool(limits), *[f"[{unit}]"] * bool(unit)])
    raise InputError(f"Argument `{name}` must be {what}, but is {shown(value)}; give for instance {example}.")


def positive(value: Any, name: str, unit: str = "s", example: str = "2.0") -> float:
    """A finite number above zero."""
    return number(value, name, above=0, unit=unit, example=example)


LARGEST_COUNT = 2**31 - 1
"""Largest whole number that is accepted as a count."""


def whole(value: Any, name: str, least: int, most: float = LARGEST_COUNT) -> int:
    """A whole number that is neither too small nor too large.

    >>> whole(2.5, "memory", 1)
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `memory` must be a whole number from 1, but is 2.5; \
give for instance 1.
    """
    found = real(value)
    if not math.isfinite(found) or found != int(found) or not least <= found <= most:
        limit = f" to {most:g}" if found > most else ""
        raise InputError(
            f"Argument `{name}` must be a whole number from {least}{limit}, but is {shown(value)}; "
            f"give for instance {least}."
        )
    return int(value)


def as_array(value: Any) -> Shaped[np.ndarray, "..."]:
    """What was given as an array; an array of an object where NumPy makes none, as of unequal rows."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError):
        return np.asarray(None)


def vector(values: Any, name: str, count: int | None = None, *, example: str) -> Float[np.ndarray, " N"]:
    """A vector of finite real numbers.

    Args:
        values: The values that were given.
        name: Name of the argument.
        count: Required number of entries; None for any number.
        example: Valid value that the message suggests.

    Raises:
        InputError: The values are no such vector.
    """
    found = as_array(values)
    plain = found.dtype.kind in "biuf" and found.ndim == 1 and count in (None, len(found))
    plain = plain and not np.ma.is_masked(values)
    if plain and np.all(np.isfinite(found)):
        return found.astype(float)
    many = "numbers" if count is None else "one number" if count == 1 else f"{count} numbers"
    raise InputError(
        f"Argument `{name}` must be {many}, finite and in a row, but is {shown(values)}"
        f"{f' of shape {found.shape}' if found.dtype.kind in 'iuf' else ''}; give for instance {example}."
    )


def instance(value: Any, kind: type, name: str, hint: str) -> None:
    """Refuses a value that is no instance of `kind`; `hint` states how to get one."""
    if not isinstance(value, kind):
        needed = _with_article(kind.__name__)
        raise InputError(f"Argument `{name}` must be {needed}, but is {shown(value)}; {hint}.")


def one_of(value: Any, name: str, choices: Iterable[str]) -> str:
    """A word, which must be one of the choices."""
    listed = tuple(choices)
    if isinstance(value, str) and value in listed:
        return value
    raise InputError(
        f"Argument `{name}` must be one of {', '.join(map(repr, listed))}, but is {shown(value)}; "
        "give one of these."
    )


def closest(name: str, choices: Iterable[str]) -> str:
    """The choice that is spelled most like a name; empty if none is like it."""
    return next(iter(difflib.get_close_matches(name, list(choices), n=1)), "")


def choose(name: str, choices: Iterable[str], what: str) -> str:
    """`name` if it is one of the choices; otherwise an `InputError` that suggests the closest choice."""
    listed = list(choices)
    if name in listed:
        return name
    close = closest(name, listed)
    hint = f"did you mean {close}?" if close else f"choose from {', '.join(listed)}."
    raise InputError(f"There is no {what} called {name!r}; {hint}")


def known_arguments(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """The same function, which refuses arguments that it does not have, or lacks, with one sentence.

    Its signature stays as it is. For functions and classes with many arguments by name.

    >>> @known_arguments
    ... def joint(*, stiffness: float = 1.0, damping: float = 0.0) -> None: ...
    >>> joint(stifness=2)
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: joint was given stifness=2, but accepts stiffness, damping; \
did you mean stiffness?
    """

    @functools.wraps(function)
    def checked(*values: Given.args, **named: Given.kwargs) -> Made:
        try:
            return function(*values, **named)
        except TypeError:
            _check_arguments(function, values, named)
            raise  # the arguments fit, and the error comes from within

    return checked


def _check_arguments(function: Callable[..., Any], values: tuple[Any, ...], named: dict[str, Any]) -> None:
    """Refuse arguments that do not fit the signature of a function, or of a class given by its `__init__`."""
    signature = inspect.signature(function)
    try:
        signature.bind(*values, **named)
        return
    except TypeError:
        pass
    what = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]
    every = {n: p for n, p in signature.parameters.items() if n != "self"}
    values = values[len(signature.parameters) - len(every) :]
    accepted = ", ".join(every)
    if unknown := [n for n in named if n not in every]:
        close = closest(unknown[0], every)
        given, hint = f"{unknown[0]}={shown(named[unknown[0]])}", f"did you mean {close}?" if close else ""
        raise InputError(
            f"{what} was given {given}, but accepts {accepted or 'no argument'}; {hint or 'leave it out.'}"
        )
    placed = [n for n, p in every.items() if p.kind is not p.KEYWORD_ONLY]
    if len(values) > len(placed):
        raise InputError(
            f"{what} was given {shown(values[len(placed)])} without a name, but accepts {accepted}; write "
            "NAME=VALUE with one of these."
        )
    if twice := [n for n in placed[: len(values)] if n in named]:
        raise InputError(
            f"{what} was given {twice[0]} twice, by its place and by its name, but needs it once; leave "
            "one of them out."
        )
    needed = [n for n, p in every.items() if p.default is p.empty]
    missing = [n for n in needed if n not in (*named, *placed[: len(values)])]
    raise InputError(
        f"{what} was given no {missing[0]}, but needs {', '.join(needed)}; add {missing[0]}=VALUE."
    )


def yes_or_no(value: Any, name: str) -> bool:
    """True or False; values that only count as true or false are refused."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise InputError(f"Argument `{name}` must be True or False, but is {shown(value)}; give one of them.")


def entries(value: Any) -> tuple[Any, ...] | None:
    """The entries of a sequence; None for a text, a mapping, a table and a value that is no sequence."""
    if isinstance(value, str | bytes | Mapping) or hasattr(value, "columns"):
        return None
    try:
        return tuple(value)
    except TypeError:
        return None


def names(value: Any, name: str) -> tuple[str, ...]:
    """Several names in a sequence; a single text is refused, because its letters would count as names."""
    listed = entries(value)
    if listed is not None and all(isinstance(entry, str) for entry in listed):
        return listed
    hint = f"write [{value!r}]" if isinstance(value, str) else "give for instance ['hub']"
    raise InputError(f"Argument `{name}` must be a list of names, but is {shown(value)}; {hint}.")


def progress(given: Any) -> Progress:
    """The function that receives lines of progress; for None, a function that does nothing."""
    if given is None:
        return lambda _: None
    if callable(given):
        return given
    raise InputError(
        f"Argument `progress` must be a function that takes a line of text, but is {shown(given)}; "
        "give for instance print."
    )


def seed(value: Any) -> Any:
    """A seed: a whole number from 0, or a generator of NumPy."""
    return value if isinstance(value, np.random.Generator) else whole(value, "seed", 0, math.inf)


def signal(u: Any, name: str = "u") -> Float[np.ndarray, " N"]:
    """A signal as an array: float32 if it was given in single or half precision, else float64.

    Raises:
        InputError: The signal has more than one column, is complex or empty, is masked, or is not finite.
    """
    array = as_array(u)
    if array.dtype.kind not in "iuf" or array.ndim != 1 or not array.size:
        what = f"{array.dtype.name} of shape {array.shape}" if array.dtype != object else shown(u)
        raise InputError(
            f"Argument `{name}` must be real numbers of shape (N,), one per sample, but is {what}; "
            "give one signal."
        )
    if np.ma.is_masked(u):  # an array that is made of it has the numbers below the mask
        raise InputError(f"Argument `{name}` has masked samples, but all are needed; cut or refill them.")
    if not all_finite(array):
        k = int(np.argmin(np.isfinite(array)))
        raise InputError(
            f"Argument `{name}` must be finite, but is {array[k]} at sample {k}; cut the signal there."
        )
    return array.astype(np.float32 if array.dtype in (np.float16, np.float32) else np.float64, copy=False)


def all_finite(x: Num[np.ndarray, "..."]) -> bool:
    """Whether all numbers are finite; usually needs no array of results."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.sum(x)) or np.isfinite(x).all())
