"""What a method is: it learns from recordings, and the result can simulate another one."""

import abc
import dataclasses
import difflib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

Progress = Callable[[str], None]


@runtime_checkable
class Simulator(Protocol):
    """What can simulate a recording."""

    @abc.abstractmethod
    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run: outputs from the input and the first `n_init` samples of the outputs."""
        ...


@dataclasses.dataclass(frozen=True)
class Fitted:
    """What a method learned from recordings.

    Attributes:
        simulator: Simulates other recordings; a `Model`, or an object of the method's own.
        parameters: Number of fitted parameters.
        note: What a reader of the table must know, as a phrase; "" for nothing.
        predict: Outputs one step ahead, each from the input and the outputs before it; None
            for a method that has no predictor.
    """

    simulator: Simulator
    parameters: int
    note: str = ""
    predict: Callable[[Recording], Float[np.ndarray, "N C"]] | None = None


@runtime_checkable
class Method(Protocol):
    """One way to learn a model from recordings.

    Attributes:
        name: Short, for tables and the command line.
        title: What it is, as a phrase.
    """

    @property
    @abc.abstractmethod
    def name(self) -> str: ...  # noqa: D102
    @property
    @abc.abstractmethod
    def title(self) -> str: ...  # noqa: D102

    @abc.abstractmethod
    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Learn from recordings that have exactly the model's channels, in its order.

        Args:
            model: The user's physics; a black box ignores it.
            train: Recordings to learn from.
            say: Called with a short phrase now and then.

        Returns:
            What was learned. Whatever is raised becomes a row that says so.
        """
        ...


METHODS: dict[str, Method] = {}
"""Methods by name, in the order in which `compare` runs them."""


def register(method: Method) -> Method:
    """Enter a method under its name.

    Args:
        method: An object with `name`, `title` and `fit`.

    Returns:
        The same object.

    Raises:
        InputError: It lacks one of these, or another method has the name.
    """
    _check(method)
    if METHODS.get(method.name, method) != method:
        raise InputError(
            f"A method named {method.name!r} was registered, but there is one already; choose another name."
        )
    METHODS[method.name] = method
    return method


def selected_methods(methods: Iterable[str | Method] | None) -> tuple[Method, ...]:
    """Methods given by name or as objects; all registered ones for None."""
    if methods is None:
        return tuple(METHODS.values())
    if not isinstance(methods, str | Method | Iterable):
        raise InputError(
            f"Argument `methods` must be a list of methods, but is {shown(methods)}; write for instance "
            "['arx', 'grey_box']."
        )
    listed = [methods] if isinstance(methods, (str, Method)) else list(methods)
    found: dict[str, Method] = {}
    for item in listed:
        method = _method_by_name(item) if isinstance(item, str) else item
        _check(method)
        if found.get(method.name, method) != method:
            raise InputError(
                f"Two methods named {method.name!r} were given, but a row needs a name of its own; "
                "rename one of them."
            )
        found[method.name] = method
    if not found:
        raise InputError(f"No method was given; choose from {', '.join(METHODS)}.")
    return tuple(found.values())


def _method_by_name(name: str) -> Method:
    name = name.strip()
    if name in METHODS:
        return METHODS[name]
    close = difflib.get_close_matches(name, METHODS, n=1)
    hint = f"did you mean {close[0]}?" if close else f"choose from {', '.join(METHODS)}."
    raise InputError(f"There is no method called {name!r}; {hint}")


def _check(method: Any) -> None:
    if not isinstance(method, Method):
        raise InputError(
            f"{method!r} was given as a method, but a method has name, title and "
            f"fit(model, train, say); give one of {', '.join(METHODS)}, or such an object."
        )
