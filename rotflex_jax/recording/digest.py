"""Digests of what a result rests on: a stored result is that of the same recording or of another one."""

import hashlib

import numpy as np

from rotflex_jax.recording.recording import Recording


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
