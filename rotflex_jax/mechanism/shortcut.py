"""Faster computations of a step, used where they give the same result as the general computation."""

import contextlib
import threading
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Shaped


class _Tracing(threading.local):
    shortcuts = True


_tracing = _Tracing()


Way = Callable[[], Shaped[Array, "n *S"]]


def shortcut(quick: Callable[[], tuple[Bool[Array, "*S"], Way]], general: Way) -> Shaped[Array, "n *S"]:
    """The result of a quick computation if it is right for all states side by side, else of the general one.

    Only the chosen computation is carried out, also under `jax.vmap`.

    Args:
        quick: Returns where the quick computation gives the result of the general one, and the quick
            computation itself.
        general: The general computation; right wherever its result is used.
    """
    if not _tracing.shortcuts:
        return general()
    suffices, way = quick()
    return jax.lax.cond(_everywhere(jnp.all(suffices)), way, general)


@contextlib.contextmanager
def without_shortcuts() -> Iterator[None]:
    """Within this context, steps are traced with the general computation.

    For code that records the evaluations within a step, and therefore needs a single sequence of them.
    """
    before, _tracing.shortcuts = _tracing.shortcuts, False
    try:
        yield
    finally:
        _tracing.shortcuts = before


@jax.custom_batching.custom_vmap
def _everywhere(suffices: Bool[Array, ""]) -> Bool[Array, ""]:
    """The argument, combined over a batch: a choice for each member would compute both branches for all."""
    return suffices


@_everywhere.def_vmap
def _(size: int, batched: list[bool], suffices: Bool[Array, "_"]) -> tuple[Bool[Array, ""], bool]:
    return jnp.all(suffices), False
