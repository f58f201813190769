"""Sparse identification of nonlinear dynamics (SINDy) with an input: equations with few terms, by pysindy."""

import dataclasses
import itertools
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import Fitted, require_one_sampling_period
from rotflex_jax.compare.sparse_equations import Piece, SparseEquations, Terms, costs, refined
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

Smoothing = tuple[str, int | float]
"""`savgol` with a window in samples, or `spline` with the cutoff period of its smoothing in samples."""


def smoothed_derivatives(recording: Recording, smoothing: Smoothing) -> Float[np.ndarray, "N K"]:
    """Outputs, speeds and accelerations after smoothing, in three blocks of C columns.

    Raises:
        InputError: The kind of smoothing does not exist.
    """
    y, (kind, width) = recording.y.astype(float), smoothing
    if kind == "savgol":
        window = _window_length(width, recording.N)
        parts = [
            np.asarray(
                scipy.signal.savgol_filter(y, window, min(3, window - 1), deriv=d, delta=recording.Ts, axis=0)
            )
            for d in range(3)
        ]
        return np.concatenate(parts, axis=1)
    if kind != "spline":
        raise InputError(f"A smoothing is 'savgol' or 'spline', but {kind!r} was given; name one of these.")
    splines = [_spline(c, width) for c in y.T]
    t = np.arange(recording.N, dtype=float)
    return np.concatenate(
        [
            np.stack([s.derivative(d)(t) / recording.Ts**d if d else s(t) for s in splines], axis=1)
            for d in range(3)
        ],
        axis=1,
    )


def smoothed_input(
    recording: Recording, smoothing: Smoothing, order: int, held: bool = True
) -> Float[np.ndarray, " N"]:
    """The input as it appears in smoothed derivatives of order `order`.

    A differentiating filter smooths the true derivative; the kernel of this smoothing is the kernel of the
    filter, integrated `order` times. An acceleration that is smoothed like this belongs to an input that is
    smoothed by the same kernel. A regression on the input itself is biased, and the more so, the faster the
    input changes.
    """
    u = recording.u.astype(float)
    # A second difference belongs to the mean of the input held before it and the input held after it, a
    # first difference to the input held after it.
    between = u if not held else (u + np.concatenate([u[:1], u[:-1]])) / 2
    after = u if held else (u + np.concatenate([u[1:], u[-1:]])) / 2
    kind, width = smoothing
    if kind == "spline":
        return _spline(between, width)(np.arange(len(u), dtype=float))
    window = _window_length(width, len(u))
    once = -np.cumsum(scipy.signal.savgol_coeffs(window, min(3, window - 1), deriv=order, use="dot"))
    # Summation by parts: once for first differences; twice, and one sample later, for second differences.
    kernel, x = (once, after) if order == 1 else (np.concatenate([[0.0], -np.cumsum(once)[:-1]]), between)
    return np.correlate(np.pad(x, window // 2, mode="edge"), kernel, mode="valid")


def _window_length(width: float, N: int) -> int:
    return min(int(width) // 2 * 2 + 1, (N - 1) // 2 * 2 + 1)


def _spline(x: np.ndarray, width: float) -> "scipy.interpolate.BSpline":
    """Smoothing spline whose cutoff period is `width` samples."""
    t = np.arange(len(x), dtype=float)
    return scipy.interpolate.make_smoothing_spline(t, x, lam=(width / (2 * np.pi)) ** 4)


Span = tuple[float, float]
"""Beginning and end of a part of a recording, as shares of its length."""


@dataclasses.dataclass(frozen=True)
class SINDy:
    """Equations of motion with few terms, by sequentially thresholded least squares.

    The states are the outputs and their speeds, from smoothing. The relation of an output to its speed is
    given and not fitted. The smoothing, the threshold, the powers, and whether the equations give
    accelerations or rates are chosen by the best free runs over validation parts of the training recordings,
    at their end and at their beginning. The input is smoothed like the accelerations. Not for coarse sensors
    at a high sampling rate, where the result depends on the smoothing; the note states how much.

    Source: Brunton, Proctor and Kutz 2016, PNAS 113; ensembles Fasel et al. 2022, Proc. R. Soc. A 478;
    weak form Messenger and Bortz 2021, Multiscale Model. Simul. 19.

    Attributes:
        name: Short name.
        title: Description in words.
        variant: `plain`, `ensemble` (median of fits to random bags of samples) or `weak` (without
            accelerations).
        smoothings: Kinds of smoothing to choose from.
        thresholds: Thresholds to choose from, for terms and rates of size one.
        orders: Orders to choose from: 2 for accelerations, 1 for rates of the outputs.
        degrees: Degrees to choose from: 1 without powers in the library, 3 with powers.
        share: Share of each recording to fit to; the rest is for validation.
        seconds: Length of the validation runs [s]; in addition, free runs over a whole recording must not
            diverge.
        bags: Number of fits in an ensemble.
        free_runs: Whether the weights are refined for free runs, which is not part of SINDy.
    """

    name: str = "sindy"
    title: str = "sparse equations of motion, thresholded least squares"
    variant: Literal["plain", "ensemble", "weak"] = "plain"
    smoothings: tuple[Smoothing, ...] = (
        ("savgol", 15),
        ("savgol", 41),
        ("spline", 5),
        ("spline", 20),
    )
    thresholds: tuple[float, ...] = (0.0, 0.01, 0.03, 0.1)
    orders: tuple[int, ...] = (2, 1)
    degrees: tuple[int, ...] = (1, 3)
    share: float = 0.7
    seconds: float = 2.0
    bags: int = 20
    free_runs: bool = False
    family: str = "sindy"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose and fit the equations; of `model` only the intersample behaviour of the input is used."""
        ps = _pysindy()
        held = getattr(getattr(model, "solver", None), "between", "held") != "smooth"
        require_one_sampling_period(train, "the smoothing")
        tried: list[tuple[float, tuple[int, int], Smoothing, float]] = []
        # Fitted to the first part and validated on the rest; then fitted to the last part.
        folds: tuple[tuple[Span, Span], ...] = (
            ((0.0, self.share), (self.share, 1.0)),
            ((1 - self.share, 1.0), (0.0, 1 - self.share)),
        )
        for smoothing in self.smoothings:
            states = [smoothed_derivatives(r, smoothing) for r in train]
            for order, degree in itertools.product(self.orders, self.degrees):
                terms = _library(train[0], states, order, degree, held)
                total = np.zeros(len(self.thresholds))
                for fitted, validated in folds:
                    rows = self._rows(terms, train, states, smoothing, fitted)
                    W = np.stack([self._weights(ps, rows, threshold) for threshold in self.thresholds])
                    total += costs(terms, W, self._pieces(train, states, validated), train, states)
                tried += [
                    (float(c) / 2, (order, degree), smoothing, t)
                    for c, t in zip(total, self.thresholds, strict=True)
                ]
            say(f"{smoothing[0]} {smoothing[1]:g}: log error {min(tried)[0]:.2f}")
        cost, (order, degree), smoothing, threshold = min(tried)
        if not np.isfinite(cost):
            raise RuntimeError("every choice of smoothing and threshold diverges in free run")
        states = [smoothed_derivatives(r, smoothing) for r in train]
        terms = _library(train[0], states, order, degree, held)
        W, remark = self._weights(ps, self._rows(terms, train, states, smoothing, (0.0, 1.0)), threshold), ""
        if self.free_runs:
            first = self._weights(
                ps, self._rows(terms, train, states, smoothing, (0.0, self.share)), threshold
            )
            W, remark = self._refined(terms, W, first, train, states, say)
        found = SparseEquations(terms, W, train[0].Ts)
        chosen = f"{smoothing[0]} over {smoothing[1]:g} samples, threshold {threshold:g}"
        words = f"{chosen}, order {order}, powers to {degree}; {_describe_sensitivity(tried)}{remark}"
        return Fitted(found, int(np.count_nonzero(W)), words, found.predict)

    def _refined(
        self,
        terms: Terms,
        W: np.ndarray,
        first: np.ndarray,
        train: Sequence[Recording],
        states: list[np.ndarray],
        say: Progress,
    ) -> tuple[np.ndarray, str]:
        """Weights refined for free runs, if refining the weights of the first part helps over the rest."""
        last = self._pieces(train, states, (self.share, 1.0))
        part = refined(terms, first, self._pieces(train, states, (0.0, self.share)), train[0].Ts)
        before, after = costs(terms, np.stack([first, part]), last, train, states)
        say(f"refined for free runs: log error {before:.2f} to {after:.2f}")
        if not after < before:
            return W, "; refining its weights for free runs did not help and was dropped"
        whole = refined(terms, W, self._pieces(train, states, (0.0, 1.0)), train[0].Ts)
        there = costs(terms, whole[None], last, train, states)[0]
        return (whole if np.isfinite(there) else part), "; its weights refined for free runs"

    def _rows(
        self,
        terms: Terms,
        train: Sequence[Recording],
        states: list[np.ndarray],
        smoothing: Smoothing,
        span: Span,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Terms (N, P) and rates (N, C) from a part of each recording."""
        rows, targets = [], []
        C, edge = len(terms.channels), 10
        for r, x in zip(train, states, strict=True):
            i, j = (round(s * r.N) for s in span)
            if self.variant == "weak":
                u = r.u.astype(float)
                if terms.held:
                    u = (u + np.concatenate([u[:1], u[:-1]])) / 2
                T, dT = _test_functions(j - i, terms.order, r.Ts)
                rows.append(T @ terms.values(_state_columns(x[i:j], terms), u[i:j]))
                targets.append(dT @ r.y[i:j].astype(float))
            else:
                i, j = max(i, edge), min(j, r.N - edge)
                u = smoothed_input(r, smoothing, terms.order, terms.held)
                rows.append(terms.values(_state_columns(x[i:j], terms), u[i:j]))
                targets.append(x[i:j, terms.order * C : (terms.order + 1) * C])
        return np.vstack(rows), np.vstack(targets)

    def _weights(
        self, ps: Any, rows: tuple[np.ndarray, np.ndarray], threshold: float
    ) -> Float[np.ndarray, "P C"]:
        """Weights by an optimiser of pysindy, applied to terms and rates of size one."""
        phi, rate = rows
        size, out = np.sqrt(np.mean(phi**2, axis=0)), np.sqrt(np.mean(rate**2, axis=0))
        size, out = np.where(size > 0, size, 1.0), np.where(out > 0, out, 1.0)
        phi, rate = phi / size, rate / out
        with np.errstate(all="ignore"):
            if self.variant == "ensemble":
                seeds = np.random.default_rng(0)
                bags = [seeds.integers(0, len(phi), len(phi)) for _ in range(self.bags)]
                W = np.median([_sparse_weights(ps, phi[b], rate[b], threshold) for b in bags], axis=0)
            else:
                W = _sparse_weights(ps, phi, rate, threshold)
        return W / size[:, None] * out

    def _pieces(self, train: Sequence[Recording], states: list[np.ndarray], span: Span) -> list[Piece]:
        """Segments of equal length for free runs, from a part of each recording."""
        bounds = [[round(s * r.N) for s in span] for r in train]
        length = min(min(j - i for i, j in bounds), max(8, round(self.seconds / train[0].Ts)))
        return [
            Piece(x[k], r.u[k : k + length].astype(float), r.y[k : k + length].astype(float))
            for (i, j), r, x in zip(bounds, train, states, strict=True)
            for k in range(i, j - length + 1, length)
        ]


def _library(recording: Recording, states: list[np.ndarray], order: int, degree: int, held: bool) -> Terms:
    C = len(recording.channels)
    speed = np.concatenate([x[:, (order - 1) * C : order * C] for x in states])
    width = np.maximum(0.03 * np.sqrt(np.mean(speed**2, axis=0)), 1e-12)
    return Terms(recording.channels, order, degree, tuple(width.tolist()), held)


def _state_columns(x: np.ndarray, terms: Terms) -> np.ndarray:
    return x[..., : terms.order * len(terms.channels)]


def _sparse_weights(ps: Any, phi: np.ndarray, rate: np.ndarray, threshold: float) -> Float[np.ndarray, "P C"]:
    with warnings.catch_warnings():
        # If a threshold leaves no term, the weights are zero, and free runs show whether that is good.
        warnings.simplefilter("ignore")
        optimiser = ps.STLSQ(threshold=threshold, alpha=1e-6, max_iter=30)
        optimiser.fit(phi, rate)
    return np.asarray(optimiser.coef_, float).T


def _test_functions(
    n: int, order: int, Ts: float
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, "K n"]]:
    """Smooth test functions that are zero at their ends, and their derivatives for integration by parts."""
    half = max(6, min(60, n // 8))
    t = np.arange(-half, half + 1) / half
    bump = np.polynomial.Polynomial([1, 0, -1]) ** 4
    values = bump(t)
    slopes = (-1) ** order * bump.deriv(order)(t) / (half * Ts) ** order
    starts = np.arange(0, n - 2 * half, max(1, half // 6))
    T, dT = np.zeros((len(starts), n)), np.zeros((len(starts), n))
    for k, i in enumerate(starts):
        T[k, i : i + 2 * half + 1], dT[k, i : i + 2 * half + 1] = values, slopes
    return T, dT


def _describe_sensitivity(tried: list[tuple[float, tuple[int, int], Smoothing, float]]) -> str:
    """How much the result depends on the choices, in words."""
    best = min(tried)
    finite = [t[0] for t in tried if np.isfinite(t[0])]
    factor = np.exp(np.median(finite) - best[0])
    per = {s: min(t[0] for t in tried if t[2] == s) for s in {t[2] for t in tried}}
    spread = np.exp(max((c for c in per.values() if np.isfinite(c)), default=best[0]) - best[0])
    return (
        f"on the part that chose, the median of {len(tried)} choices has {factor:.2g} times its error, "
        f"the worst smoothing {spread:.2g} times, {len(tried) - len(finite)} diverge"
    )


def _pysindy() -> Any:
    try:
        import pysindy
    except ImportError as error:
        raise InputError(
            "SINDy needs the package pysindy, which is not installed; install it with "
            '`pip install "rotflex_jax[baselines]"`.'
        ) from error
    return pysindy
