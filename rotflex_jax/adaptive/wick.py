"""Moments of Gaussian vectors by pairing."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis.monomials import Index
from rotflex_jax.errors import InputError


def exponents(terms: Sequence[Index], size: int) -> np.ndarray:
    """Monomials as powers (P, size): z0 z0 z2, that is (0, 0, 2), of a vector of three is 2, 0, 1."""
    powers = np.zeros((len(terms), size), dtype=np.int64)
    for row, term in enumerate(terms):
        np.add.at(powers[row], list(term), 1)
    return powers


class Wick:
    """Moments of a zero-mean Gaussian vector, remembered once they are known.

        E[z_i z^b] = sum_j b_j R_ij E[z^(b - e_j)]

    Every entry is paired with each of the others in turn; equal partners count as often as they occur.

    Args:
        covariance: of the vector, (n, n).

    Source: Isserlis 1918, Biometrika 12; Wick 1950.

    >>> Wick(np.eye(2)).moment((4, 2))  # E[z0^4] E[z1^2]
    3.0
    """

    def __init__(self, covariance: Float[np.ndarray, "n n"]) -> None:
        self.covariance = checked_covariance(covariance)
        self._rows = self.covariance.tolist()
        self._known: dict[tuple[int, ...], float] = {(0,) * len(self._rows): 1.0}

    def moment(self, powers: tuple[int, ...]) -> float:
        """E[z0^powers0 z1^powers1 ...]."""
        if powers in self._known:
            return self._known[powers]
        total = 0.0
        if sum(powers) % 2 == 0:
            i = next(k for k, power in enumerate(powers) if power)
            rest = [*powers]
            rest[i] -= 1
            for j, count in enumerate(rest):
                if count:
                    rest[j] -= 1
                    total += count * self._rows[i][j] * self.moment(tuple(rest))
                    rest[j] += 1
        self._known[powers] = total
        return total

    def products(self, left: np.ndarray, right: np.ndarray) -> Float[np.ndarray, "A B"]:
        """E[z^left_a z^right_b] for powers `left` (A, n) and `right` (B, n)."""
        # Few different products stand behind the many entries: number them, and compute each once.
        base = int(left.max(initial=0) + right.max(initial=0)) + 1
        if base ** left.shape[1] >= 2**62:
            raise InputError(
                f"Moments of degree {base - 1} of {left.shape[1]} entries are too many to number; "
                "use regressors of a simulated or recorded input instead."
            )
        weight = base ** np.arange(left.shape[1], dtype=np.int64)
        codes, where = np.unique(np.add.outer(left @ weight, right @ weight), return_inverse=True)
        digits = codes[:, None] // weight % base
        values = np.array([self.moment(tuple(row)) for row in digits.tolist()])
        return values[where].reshape(len(left), len(right))


def checked_covariance(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The covariance in float64.

    Raises:
        InputError: it is not square, symmetric, finite and without negative eigenvalues.
    """
    R = np.asarray(covariance, dtype=float)
    if R.ndim != 2 or R.shape[0] != R.shape[1] or not len(R) or not np.all(np.isfinite(R)):
        raise InputError(
            f"A covariance must be a square matrix of finite numbers, but has the shape {R.shape}; "
            "give for instance ar1_covariance(0.5, 5)."
        )
    if (
        not np.allclose(R, R.T, atol=1e-9 * np.abs(R).max())
        or np.linalg.eigvalsh(R)[0] < -1e-9 * np.abs(R).max()
    ):
        raise InputError(
            "A covariance must be symmetric without negative eigenvalues, but the one given is not; "
            "compute it from the regressors as phi' phi / N."
        )
    return R
