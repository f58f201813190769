"""Recordings as an argument: one or several, and nothing else."""

from collections.abc import Iterable
from typing import Any

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError
from rotflex_jax.recording.recording import Recording

SHORTEST_TO_FIT = 11
"""Samples below which a recording does not show the noise of its sensors: the width of the local polynomials
from which a fit estimates it."""


def listed(recordings: Any, name: str = "recordings", shortest: int = 1) -> tuple[Recording, ...]:
    """One recording, or several in any iterable, as a tuple.

    Args:
        recordings: What was given.
        name: Of the argument.
        shortest: Samples that each must have.

    Raises:
        InputError: None at all, anything else, or one that is too short.

    >>> listed("run.csv", "train")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `train` must be a Recording or a list of them, but is 'run.csv'; \
read a file with rotflex_jax.load.
    """
    if isinstance(recordings, Recording):
        found: tuple[Any, ...] = (recordings,)
    elif isinstance(recordings, Iterable) and not isinstance(recordings, str | bytes):
        found = tuple(recordings)
    else:
        found = (None,)
    wrong = [(k, r) for k, r in enumerate(found, 1) if not isinstance(r, Recording)]
    if wrong:
        number, entry = wrong[0]
        several = len(found) > 1 or isinstance(recordings, list | tuple)
        what = f"has {shown(entry)} as entry {number}" if several else f"is {shown(recordings)}"
        raise InputError(
            f"Argument `{name}` must be a Recording or a list of them, but {what}; "
            "read a file with rotflex_jax.load."
        )
    if not found:
        raise InputError(f"No recording was given as `{name}`, but at least one is needed; pass a Recording.")
    for r in found:
        if shortest > r.N:
            raise InputError(
                f"A recording in `{name}` has {r.N} samples, but at least {shortest} are needed to tell "
                "the motion from the noise of the sensors; give a longer one."
            )
    return found


def single(recording: Any, name: str = "recording", shortest: int = 1) -> Recording:
    """The one recording that was given, alone or in a list.

    Args:
        recording: What was given.
        name: Of the argument.
        shortest: Samples that it must have.

    Raises:
        InputError: None or several, anything else, or one that is too short.
    """
    found = listed(recording, name, shortest)
    if len(found) != 1:
        raise InputError(
            f"{len(found)} recordings were given as `{name}`, but one is needed; give one at a time."
        )
    return found[0]
