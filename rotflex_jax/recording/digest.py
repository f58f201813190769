"""Digests of what a result rests on: a stored result is that of the same recording or of another one."""

import hashlib
from collections.abc import Sequence

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.recording.recording import Recording

FEWEST_MOVING = 20
"""Samples that differ from the one before; with fewer, two recordings may be alike by chance."""
LEAST_SHARED = 0.25
"""Share of the shorter recording that both must have in common to be called pieces of one."""
_PROBES = 16


def content(recording: Recording) -> tuple[bytes, ...]:
    """All of a recording that a computation can depend on, as bytes; not the name of its file."""
    r = recording
    labels = (r.Ts, r.channels, r.units, r.input_name, r.input_unit)
    labels = (*labels, r.n_init, r.start, r.accept, sorted(r.resolution.items()))
    labels = (*labels, sorted(r.constants.items()))
    own = (repr(labels).encode(), *(np.ascontiguousarray(a).tobytes() for a in (r.u, r.y)))
    # States that no sensor measures start where a run over the recording before ends.
    return own if r.continues is None else (*own, *content(r.continues))


def digest_of(*parts: bytes) -> str:
    """SHA-256 of several parts, each counted with its length."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big") + part)
    return found.hexdigest()


def digest_of_recordings(recordings: Sequence[Recording]) -> str:
    """Digest of all that a fit can depend on in several recordings, in their order."""
    return digest_of(*(part for r in recordings for part in content(r)))


def shared_samples(a: Recording, b: Recording) -> int:
    """How many samples two recordings have in common because both were cut from one, 0 if they were not.

    They count as cut from one where one is shifted against the other such that the whole stretch in which
    both have samples is the same, number for number, in input and outputs. Standstill proves nothing: the
    first `LEAST_SHARED` of the shorter one must have `FEWEST_MOVING` samples that differ from the one before.
    """
    if a.Ts != b.Ts or a.y.shape[1] != b.y.shape[1]:
        return 0
    first, second = (np.column_stack([r.u, r.y]) + 0.0 for r in (a, b))  # one zero, without a sign
    return max(_shared_from(first, second), _shared_from(second, first))


def _shared_from(a: np.ndarray, b: np.ndarray) -> int:
    """Samples of the longest stretch that begins with the first sample of `b`."""
    least = max(int(np.ceil(LEAST_SHARED * min(len(a), len(b)))), FEWEST_MOVING)
    if least > min(len(a), len(b)):
        return 0
    moving = 1 + np.flatnonzero(np.any(b[1:least] != b[: least - 1], axis=1))
    if len(moving) < FEWEST_MOVING:
        return 0
    # A few samples that differ from the one before leave next to no other shift to be compared as a whole.
    shifts = np.arange(len(a) - least + 1)
    for at in moving[np.linspace(0, len(moving) - 1, _PROBES).astype(int)]:
        shifts = shifts[np.all(a[shifts + at] == b[at], axis=1)]
    for shift in shifts:
        length = min(len(a) - shift, len(b))
        if np.array_equal(a[shift : shift + length], b[:length]):
            return int(length)
    return 0


def check_apart(fitted: Sequence[Recording], unseen: Sequence[Recording], purpose: str, reason: str) -> None:
    """Refuses data that were fitted in the place of data that no fit has seen.

    Args:
        fitted: Recordings that a fit sees.
        unseen: Those that it must not see.
        purpose: What each of the two is for, such as "to fit and to validate".
        reason: Why they must differ, and what to give instead.

    Raises:
        InputError: One of the first is one of the second, or both have samples of one measurement.
    """
    for a in fitted:
        for b in unseen:
            same = a is b or (a.Ts == b.Ts and np.array_equal(a.u, b.u) and np.array_equal(a.y, b.y))
            if same:
                raise InputError(f"The same recording was given {purpose}, but {reason}.")
            if shared := shared_samples(a, b):
                raise InputError(
                    f"Recordings with the same {shared} samples were given {purpose}, but {reason}."
                )
