"""The cores of this process, and one thread for linear algebra: matrices are small, and threads only wait."""

import contextlib
import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Given = ParamSpec("Given")
Returned = TypeVar("Returned")


def one_thread(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """Decorator: inside the function linear algebra runs in one thread."""

    @functools.wraps(function)
    def run(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        with _loaded().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return run


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_to_share(place: int, of: int) -> None:
    """Keep this process, one of several alike, to cores of its own, where the system lets it.

    Threads that wander between cores slow each other down. Call it before JAX computes, which begins as many
    threads as it finds cores.
    """
    if hasattr(os, "sched_setaffinity"):
        mine = sorted(os.sched_getaffinity(0))
        n, alone = len(mine), place % len(mine)
        chosen = mine[place * n // of : (place + 1) * n // of] if of <= n else mine[alone : alone + 1]
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, chosen)


@functools.cache
def _loaded() -> ThreadpoolController:
    """The libraries of this process; to look for them takes as long as a small fit."""
    import scipy.linalg  # noqa: F401 - JAX borrows its library, and only what is loaded can be held back

    return ThreadpoolController()
