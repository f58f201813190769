"""Linear least squares from a triangular factor, and the rows of a regression."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.basis import Basis
from rotflex_jax.basis.bank import require_basis
from rotflex_jax.checks import whole
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import listed
from rotflex_jax.recording.samples import of_one_period

# Singular values below this share of the largest one are rounding errors: columns are linearly dependent.
DEPENDENT_COLUMN_SHARE = 1e-12
ROWS_PER_FACTOR = 8192  # rows that are factored at once


@dataclasses.dataclass(frozen=True)
class Solution:
    """Weights of a linear least-squares problem.

    Attributes:
        w: Weights (P,).
        basis: Directions (P, r) in which least squares determines the weights; `w` lies in their span.
        shrink: Factor by which a ridge multiplies the least-squares solution along each direction (r,).
        rank: Number r of directions.
        condition: Largest over smallest eigenvalue of `phi' phi` within these directions.
    """

    w: Float[np.ndarray, " P"]
    basis: Float[np.ndarray, "P r"]
    shrink: Float[np.ndarray, " r"]
    rank: int
    condition: float


def factor(A: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "K K"]:
    """R of the QR decomposition `A = Q R`, computed by blocks of rows without storing Q.

    Source: Golub, Plemmons and Sameh 1988 (QR of a tall matrix by blocks of rows).
    """
    K = A.shape[1]
    R = np.zeros((0, K))
    for start in range(0, len(A), ROWS_PER_FACTOR):
        R = np.linalg.qr(np.concatenate([R, A[start : start + ROWS_PER_FACTOR]]), mode="r")
    return np.concatenate([R, np.zeros((max(K - len(R), 0), K))])


def solve(R: Float[np.ndarray, "K columns"], ridge: float = 0.0) -> Solution:
    """Least squares from the triangular factor of `[phi, y]`.

        minimise |y - phi w|^2 + ridge |w|^2

    Without a ridge, linearly dependent columns share the weight (minimum norm); equal columns get equal
    weights.
    """
    A, z = R[:, :-1], R[:, -1]
    size = np.linalg.norm(A, axis=0)
    # A ridge penalises unscaled weights. Without a ridge, columns are scaled so that the rank does not depend
    # on their sizes.
    unit = np.where(size > 0, size, 1.0) if ridge == 0 else np.ones_like(size)
    U, s, Vt = np.linalg.svd(A / unit, full_matrices=False)
    kept = s > DEPENDENT_COLUMN_SHARE * max(s.max(initial=0.0), 1e-300)
    U, s, V = U[:, kept], s[kept], Vt[kept].T
    shrink = s**2 / (s**2 + ridge)
    basis = V / unit[:, None]
    w = basis @ (shrink / s * (U.T @ z))
    raw = np.linalg.svd(A @ np.linalg.qr(basis)[0], compute_uv=False) if len(s) else np.ones(1)
    condition = float((raw[0] / raw[-1]) ** 2) if raw[-1] > 0 else np.inf
    return Solution(w, basis, shrink, len(s), condition)


def squared_error(R: Float[np.ndarray, "K columns"], w: Float[np.ndarray, " P"]) -> float:
    """|y - phi w|^2 for the rows of which a triangular factor is given."""
    return float(np.sum((R[:, -1] - R[:, :-1] @ w) ** 2))


# Number of ridges that a cross-validation tries, from the level of rounding to the mean eigenvalue.
RIDGES = 31


def cross_validated_ridge(
    parts: list[Float[np.ndarray, "K K"]],
) -> tuple[float, Float[np.ndarray, " G"]]:
    """The ridge with the least error on blocks left out in turn.

    Args:
        parts: Triangular factor of each block.

    Returns:
        The best ridge, and all ridges that were tried.
    """
    P = parts[0].shape[1] - 1
    power = sum(np.sum(R[:, :-1] ** 2) for R in parts) / P
    ridges = power * np.logspace(-14, 0, RIDGES)
    errors = np.zeros(RIDGES)
    for k, held in enumerate(parts):
        R = factor(np.concatenate([p for j, p in enumerate(parts) if j != k]))
        # One decomposition gives the weights of all ridges, as columns.
        U, s, Vt = np.linalg.svd(R[:, :-1], full_matrices=False)
        filtered = s[:, None] / (s[:, None] ** 2 + ridges) * (U.T @ R[:, -1])[:, None]
        errors += np.sum((held[:, -1:] - held[:, :-1] @ (Vt.T @ filtered)) ** 2, axis=0)
    return float(ridges[np.argmin(errors)]), ridges


@dataclasses.dataclass(frozen=True)
class RegressionRows:
    """Rows of a regression.

    Attributes:
        phi: Regressors.
        y: Targets.
        segments: Number of the recording of each row.
    """

    phi: Float[np.ndarray, "N P"]
    y: Float[np.ndarray, " N"]
    segments: Int[np.ndarray, " N"]

    @classmethod
    def of(
        cls, basis: Basis, recordings: Sequence[Recording], channel: str, skip: int | None
    ) -> "RegressionRows":
        """Rows of all recordings without their first samples.

        Args:
            basis: Basis, which is applied to each recording from its start.
            recordings: At least one recording.
            channel: Output channel.
            skip: Samples at the start of each recording to leave out; its `n_init` if None.
        """
        require_basis(basis)
        parts = []
        for number, recording in enumerate(recordings):
            start = recording.n_init if skip is None else whole(skip, "skip", 0)
            if not 0 <= start < recording.N:
                raise InputError(
                    f"The first {start} samples are left out, but recording {number} has {recording.N}; "
                    "give a smaller `skip`, or longer recordings."
                )
            phi = basis.regressors(recording.u.astype(float))[start:]
            parts.append((phi, recording.channel(channel)[start:].astype(float), np.full(len(phi), number)))
        return cls(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def blocks(self, count: int) -> Int[np.ndarray, " N"]:
        """Number of the contiguous block to which each row belongs; no block crosses recordings.

        Blocks are contiguous because neighbouring samples are correlated: shuffled ones are not independent.
        """
        N = len(self.y)
        found, first = np.zeros(N, int), 0
        for segment in np.unique(self.segments):
            own = np.flatnonzero(self.segments == segment)
            pieces = min(len(own), max(1, round(count * len(own) / N)))
            found[own] = first + np.arange(len(own)) * pieces // len(own)
            first += pieces
        return found


def checked_recordings(
    recordings: Recording | Sequence[Recording], channel: str | None
) -> tuple[list[Recording], str]:
    """A list of recordings with one sampling period, and the channel.

    Raises:
        InputError: If there is no recording, if sampling periods differ, or if no channel is named and there
            are several.
    """
    found = list(listed(recordings))
    periods = sorted({r.Ts for r in found})
    if not of_one_period(periods):
        raise InputError(
            f"The recordings have the sampling periods {', '.join(f'{p:g} s' for p in periods)}, but a "
            "series has one; decimate them to the same."
        )
    if channel is None:
        if len(found[0].channels) > 1:
            raise InputError(
                f"The recording has the channels {', '.join(found[0].channels)}, but a series has one "
                "output; say which with `channel`."
            )
        channel = next(iter(found[0].channels))
    for recording in found:
        recording.channel(channel)
    return found, channel
