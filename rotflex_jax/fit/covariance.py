"""How sure an estimate is when the residuals are correlated in time, as those of a wrong model are."""

import numpy as np


def correlation_length(e: np.ndarray) -> int:
    """Samples after which the autocorrelation of residuals (N, C) stays small; at most N / 10."""
    N = len(e)
    longest = 1
    for column in (e - e.mean(axis=0)).T:
        spectrum = np.abs(np.fft.rfft(column, 2 * N)) ** 2
        r = np.fft.irfft(spectrum)[: N // 10 + 1]
        if r[0] <= 0:
            continue
        large = np.flatnonzero(np.abs(r / r[0]) > max(0.05, 2 / np.sqrt(N)))
        # Beyond the first gap of small values lies noise of the estimate itself.
        gaps = np.flatnonzero(np.diff(large) > 1)
        last = large[gaps[0]] if len(gaps) else large[-1]
        longest = max(longest, int(last) + 1)
    return max(1, min(2 * longest, N // 10))


def sandwich(J: np.ndarray, e: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Covariance of least-squares estimates that autocorrelation and unequal variance do not fool.

        H^-1 S H^-1,  H = sum J_k' J_k,  S = sum over lags of Bartlett-weighted products of J_k' e_k

    The iid formula sigma^2 H^-1 makes intervals many times too narrow where the model is incomplete.

    Args:
        J: Derivative of the scaled residuals (N, C, D).
        e: Scaled residuals (N, C).
        segments: Number of the recording each sample belongs to (N,); products do not cross recordings.

    Returns:
        Covariance (D, D); nan where the residuals are not finite.

    Source: Newey and West 1987, Econometrica 55.
    """
    D = J.shape[2]
    if not (np.isfinite(J).all() and np.isfinite(e).all()):
        return np.full((D, D), np.nan)
    H = np.einsum("nci,ncj->ij", J, J)
    scores = np.einsum("nci,nc->ni", J, e)
    S = np.zeros((D, D))
    for segment in np.unique(segments):
        g = scores[segments == segment]
        width = correlation_length(e[segments == segment])
        # Sums over all stretches of `width` samples give exactly the Bartlett kernel.
        padded = np.concatenate([np.zeros((width, D)), g, np.zeros((width - 1, D))])
        total = np.cumsum(padded, axis=0)
        sums = total[width:] - total[:-width]
        S += sums.T @ sums / width
    n, k = len(scores), D
    inverse = np.linalg.pinv(H, rcond=1e-14, hermitian=True)
    return inverse @ S @ inverse * (n / max(n - k, 1))
