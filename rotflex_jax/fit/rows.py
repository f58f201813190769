"""Regressors and targets of several recordings, one row per sample."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.basis import Basis
from rotflex_jax.basis.bank import require_basis
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Rows:
    """Attributes: regressors, targets, number of the recording of each row."""

    phi: Float[np.ndarray, "N P"]
    y: Float[np.ndarray, " N"]
    segments: Int[np.ndarray, " N"]

    @classmethod
    def of(cls, basis: Basis, recordings: Sequence[Recording], channel: str, skip: int | None) -> "Rows":
        """Rows of all recordings but their first samples.

        Args:
            basis: Sees each recording from its beginning.
            recordings: At least one.
            channel: Output.
            skip: Samples at the start of each recording to leave out; its `n_init` if None.
        """
        require_basis(basis)
        parts = []
        for number, recording in enumerate(recordings):
            start = recording.n_init if skip is None else skip
            if not 0 <= start < recording.N:
                raise InputError(
                    f"The first {start} samples are left out, but recording {number} has {recording.N}; "
                    "give a smaller `skip`, or longer recordings."
                )
            phi = basis.regressors(recording.u.astype(float))[start:]
            parts.append((phi, recording.channel(channel)[start:].astype(float), np.full(len(phi), number)))
        return cls(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def blocks(self, count: int) -> Int[np.ndarray, " N"]:
        """Number of the contiguous block each row belongs to; no block crosses recordings.

        Samples next to each other are alike, so that shuffled ones would be known beforehand.
        """
        N = len(self.y)
        found, first = np.zeros(N, int), 0
        for segment in np.unique(self.segments):
            own = np.flatnonzero(self.segments == segment)
            pieces = min(len(own), max(1, round(count * len(own) / N)))
            found[own] = first + np.arange(len(own)) * pieces // len(own)
            first += pieces
        return found


def checked(recordings: Recording | Sequence[Recording], channel: str | None) -> tuple[list[Recording], str]:
    """A list of recordings of one sampling period, and the channel.

    Raises:
        InputError: None, different periods, or several channels and no choice.
    """
    listed = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not listed:
        raise InputError("Argument `recordings` is empty, but a fit needs at least one; give a recording.")
    periods = sorted({r.Ts for r in listed})
    if periods[-1] / periods[0] - 1 > 1e-6:
        raise InputError(
            f"The recordings have the sampling periods {', '.join(f'{p:g} s' for p in periods)}, but a "
            "series has one; decimate them to the same."
        )
    if channel is None:
        if len(listed[0].channels) > 1:
            raise InputError(
                f"The recording has the channels {', '.join(listed[0].channels)}, but a series has one "
                "output; say which with `channel`."
            )
        channel = next(iter(listed[0].channels))
    for recording in listed:
        recording.channel(channel)
    return listed, channel
