"""Quick ways through a step, taken where they lead to the same result as the general one."""

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
    """What a quick way gives if it suffices for all that is computed side by side, else the general way.

    Only the chosen one is computed, under `jax.vmap` as well.

    Args:
        quick: Gives where the quick way leads to the result of the general one, and that way.
        general: The general way; right wherever the result is used.
    """
    if not _tracing.shortcuts:
        return general()
    suffices, way = quick()
    return jax.lax.cond(_everywhere(jnp.all(suffices)), way, general)


@contextlib.contextmanager
def without_shortcuts() -> Iterator[None]:
    """Steps that are traced in here go the general way.

    For a reader of what is evaluated in a step, who needs one way through it.
    """
    before, _tracing.shortcuts = _tracing.shortcuts, False
    try:
        yield
    finally:
        _tracing.shortcuts = before


@jax.custom_batching.custom_vmap
def _everywhere(suffices: Bool[Array, ""]) -> Bool[Array, ""]:
    """The same, for all of a batch: a choice for each of its members would compute both ways for all."""
    return suffices


@_everywhere.def_vmap
def _(size: int, batched: list[bool], suffices: Bool[Array, "_"]) -> tuple[Bool[Array, ""], bool]:
    return jnp.all(suffices), False
