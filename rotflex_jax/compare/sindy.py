"""Sparse identification of nonlinear dynamics with an input: a law with few terms, by pysindy."""

import dataclasses
import itertools
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import scipy.interpolate
import scipy.signal
from jaxtyping import Float

from rotflex_jax.compare.held_in import one_period
from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.compare.sparse_terms import SparseLaw, Terms, motions
from rotflex_jax.errors import InputError
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

Smoothing = tuple[str, float]
"""`savgol` with a window in samples, or `spline` with the cutoff of its smoothing in samples."""


@dataclasses.dataclass(frozen=True)
class SINDy:
    """A law of motion with few terms, by sequentially thresholded least squares.

    States are the outputs and their speeds, from smoothing; that a speed is the rate of its output is
    not fitted. How the data are smoothed, the threshold, and whether the law gives accelerations or
    rates are those with the best free runs over the last part of the training recordings. Not for
    coarse sensors at a high sampling rate, where smoothing decides the answer: the note says how much
    it did here.

    Source: Brunton, Proctor and Kutz 2016, PNAS 113; ensembles Fasel et al. 2022, Proc. R. Soc. A 478;
    weak form Messenger and Bortz 2021, Multiscale Model. Simul. 19.

    Attributes:
        name: Short.
        title: In words.
        variant: `plain`, `ensemble` (median of fits to bags of samples) or `weak` (without
            accelerations).
        smoothings: Ways to smooth to choose from.
        thresholds: To choose from, for terms and rates of size one.
        orders: To choose from: 2 for accelerations, 1 for rates of the outputs.
        degrees: To choose from: 1 without powers in the library, 3 with them.
        share: First part of each recording; the rest decides.
        seconds: Length of the free runs that decide [s]; those over all of a recording must not diverge.
        bags: Fits of an ensemble.
    """

    name: str = "sindy"
    title: str = "a sparse law of motion, thresholded least squares"
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
    family: str = "sindy"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the model."""
        ps = _pysindy()
        one_period(train, "the smoothing")
        tried: list[tuple[float, tuple[int, int], Smoothing, float]] = []
        for smoothing in self.smoothings:
            states = [smooth(r, smoothing) for r in train]
            for order, degree in itertools.product(self.orders, self.degrees):
                terms = _terms(train[0], states, order, degree)
                W = [
                    self._weights(ps, terms, train, states, threshold, self.share)
                    for threshold in self.thresholds
                ]
                costs = self._costs(terms, np.stack(W), train, states)
                tried += [
                    (c, (order, degree), smoothing, t) for c, t in zip(costs, self.thresholds, strict=True)
                ]
            say(f"{smoothing[0]} {smoothing[1]:g}: log error {min(tried)[0]:.2f}")
        cost, (order, degree), smoothing, threshold = min(tried)
        if not np.isfinite(cost):
            raise RuntimeError("every choice of smoothing and threshold diverges in free run")
        states = [smooth(r, smoothing) for r in train]
        terms = _terms(train[0], states, order, degree)
        W = self._weights(ps, terms, train, states, threshold, 1.0)
        law = SparseLaw(terms, W, train[0].Ts)
        chosen = f"{smoothing[0]} over {smoothing[1]:g} samples, threshold {threshold:g}"
        words = f"{chosen}, order {order}, powers to {degree}; {_sensitivity(tried)}"
        return Fitted(law, int(np.count_nonzero(W)), words, law.predict)

    def _weights(
        self,
        ps: Any,
        terms: Terms,
        train: Sequence[Recording],
        states: list[np.ndarray],
        threshold: float,
        share: float,
    ) -> Float[np.ndarray, "P C"]:
        """Weights from the first part of the recordings, by an optimiser of pysindy."""
        rows, targets = [], []
        for r, x in zip(train, states, strict=True):
            n, C = round(share * r.N), len(terms.channels)
            u = r.u[:n].astype(float)
            # A smoothed sample lies between the input held before it and the one held after it.
            u = (u + np.concatenate([u[:1], u[:-1]])) / 2
            phi = terms.values(_state(x[:n], terms), u)
            if self.variant == "weak":
                T, dT = _tests(n, terms.order, r.Ts)
                rows.append(T @ phi)
                targets.append(dT @ r.y[:n].astype(float))
            else:
                rows.append(phi[10:-10])
                targets.append(x[10 : n - 10, terms.order * C : (terms.order + 1) * C])
        phi, rate = np.vstack(rows), np.vstack(targets)
        size, out = np.sqrt(np.mean(phi**2, axis=0)), np.sqrt(np.mean(rate**2, axis=0))
        size, out = np.where(size > 0, size, 1.0), np.where(out > 0, out, 1.0)
        phi, rate = phi / size, rate / out
        with np.errstate(all="ignore"):
            if self.variant == "ensemble":
                seeds = np.random.default_rng(0)
                bags = [seeds.integers(0, len(phi), len(phi)) for _ in range(self.bags)]
                each = np.stack([_thresholded(ps, phi[b], rate[b], threshold) for b in bags])
                W = np.median(each, axis=0)
            else:
                W = _thresholded(ps, phi, rate, threshold)
        return W / size[:, None] * out

    def _costs(
        self,
        terms: Terms,
        W: Float[np.ndarray, "K P C"],
        train: Sequence[Recording],
        states: list[np.ndarray],
    ) -> list[float]:
        """Mean log error of free runs from smoothed states, over the last parts."""
        C = len(terms.channels)
        lengths = [r.N - round(self.share * r.N) for r in train]
        length = min(min(lengths), max(8, round(self.seconds / train[0].Ts)))
        x0, u, y = [], [], []
        for r, x, left in zip(train, states, lengths, strict=True):
            for i in range(r.N - left, r.N - length + 1, length):
                x0.append(_state(x[i], terms))
                u.append(r.u[i : i + length])
                y.append(r.y[i : i + length])
        with np.errstate(all="ignore"):
            start = np.broadcast_to(np.array(x0), (len(W), len(x0), len(x0[0])))
            runs = motions(terms, W, start, np.array(u, float), train[0].Ts)[..., :C]
            rms = np.sqrt(np.mean((runs - np.array(y, float)) ** 2, axis=(1, 2)))
            cost = np.mean(np.log(rms + 1e-300), axis=1)
            for r, x in zip(train, states, strict=True):
                start = np.broadcast_to(_state(x[0], terms), (len(W), 1, terms.order * C))
                whole = motions(terms, W, start, r.u[None].astype(float), r.Ts)[:, 0, :, :C]
                reach = np.max(np.abs(whole - r.y[0]) / np.maximum(np.ptp(r.y, axis=0), 1e-300), axis=(1, 2))
                cost = np.where(reach < 20, cost, np.inf)
        return [float(c) if np.isfinite(c) else np.inf for c in cost]


def smooth(recording: Recording, smoothing: Smoothing) -> Float[np.ndarray, "N 3C"]:
    """Outputs, speeds and accelerations after smoothing, one block of columns after the other."""
    y, (kind, width) = recording.y.astype(float), smoothing
    if kind == "savgol":
        window = min(int(width) // 2 * 2 + 1, (recording.N - 1) // 2 * 2 + 1)
        parts = [
            np.asarray(
                scipy.signal.savgol_filter(y, window, min(3, window - 1), deriv=d, delta=recording.Ts, axis=0)
            )
            for d in range(3)
        ]
        return np.concatenate(parts, axis=1)
    if kind != "spline":
        raise InputError(f"A smoothing is 'savgol' or 'spline', but {kind!r} was given; name one of these.")
    # The smoother of a random walk of the acceleration's integral: its cutoff is the width.
    t = np.arange(recording.N, dtype=float)
    splines = [scipy.interpolate.make_smoothing_spline(t, c, lam=(width / (2 * np.pi)) ** 4) for c in y.T]
    return np.concatenate(
        [
            np.stack([s.derivative(d)(t) / recording.Ts**d if d else s(t) for s in splines], axis=1)
            for d in range(3)
        ],
        axis=1,
    )


def _terms(recording: Recording, states: list[np.ndarray], order: int, degree: int) -> Terms:
    C = len(recording.channels)
    speed = np.concatenate([x[:, (order - 1) * C : order * C] for x in states])
    width = np.maximum(0.03 * np.sqrt(np.mean(speed**2, axis=0)), 1e-12)
    return Terms(recording.channels, order, degree, tuple(width.tolist()))


def _state(x: np.ndarray, terms: Terms) -> np.ndarray:
    return x[..., : terms.order * len(terms.channels)]


def _thresholded(ps: Any, phi: np.ndarray, rate: np.ndarray, threshold: float) -> Float[np.ndarray, "P C"]:
    with warnings.catch_warnings():
        # Where a threshold leaves no term, the law is zero, and its free run says what that is worth.
        warnings.simplefilter("ignore")
        optimiser = ps.STLSQ(threshold=threshold, alpha=1e-6, max_iter=30)
        optimiser.fit(phi, rate)
    return np.asarray(optimiser.coef_, float).T


def _tests(n: int, order: int, Ts: float) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, "K n"]]:
    """Smooth bumps that end at zero, and their derivatives with the sign of integration by parts."""
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


def _sensitivity(tried: list[tuple[float, tuple[int, int], Smoothing, float]]) -> str:
    """How much the choices matter, in words."""
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
