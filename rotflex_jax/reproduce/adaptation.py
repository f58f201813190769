"""The paper's algorithm: LMS on the weights of a second-order Volterra model (Figs. 5, 6 and 9)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Real

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.adaptive.learning_curve import learning_curve, settling_step_size
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.adaptive.step_sizes import Stability, analyse
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.basis.orthogonalise import GramSchmidt, Hermite
from rotflex_jax.fit import least_squares
from rotflex_jax.models.series import Series
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce.records import Records, autocovariance, symmetric
from rotflex_jax.reproduce.settings import Settings


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Step sizes, and their convergence as predicted by theory before any run.

    Attributes:
        eigenvalue: Eigenvalue of the direction in which the observed coefficient converges.
        step_sizes: Degree -> step size.
        mu: Step size of each weight.
        settle: Iterations after which the mean of the coefficient is within 5 % of its final value.
        stability: Stability margin and excess error.
    """

    eigenvalue: float
    step_sizes: dict[int, float]
    mu: Float[np.ndarray, " P"]
    settle: float
    stability: Stability


def settling_eigenvalue(
    covariance: Float[np.ndarray, "P P"], degrees: Int[np.ndarray, " P"], index: int
) -> float:
    """The eigenvalue that determines how fast a quadratic weight converges.

    The constant converges fast and absorbs the mean of the products, so the covariance of the products about
    their means is decisive. The result is its eigenvalue for the eigenvector with the largest share of the
    weight. With a white input of variance 1 it is 2 for a square and 1 for a product of two samples.

    Args:
        covariance: Second moments of the regressors.
        degrees: Degree of every regressor.
        index: Index of the regressor that belongs to the weight.

    >>> R = np.array([[1.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    >>> settling_eigenvalue(R, np.array([0, 2, 2]), 1), settling_eigenvalue(R, np.array([0, 2, 2]), 2)
    (2.0, 1.0)
    """
    pick, constant = np.flatnonzero(degrees == 2), np.flatnonzero(degrees == 0)
    centred = covariance[np.ix_(pick, pick)]
    for k in constant:
        mean = covariance[pick, k]
        centred = centred - np.outer(mean, mean) / covariance[k, k]
    values, vectors = np.linalg.eigh(centred)
    share = vectors[pick.tolist().index(index)] ** 2
    # Eigenvectors of nearly equal eigenvalues are arbitrary within their span, so their shares are added.
    alike = np.isclose(values[:, None], values[None, :], rtol=0.05)
    return float(values[np.argmax(alike @ share + 1e-9 * share)])


def predict(s: Settings, degrees: Int[np.ndarray, " P"], moments: Moments, index: int) -> Prediction:
    """Step sizes with the predicted convergence; a quadratic step size that is not given follows `settle_at`.

        mu2 = ln 20 / (settle_at eigenvalue)

    Args:
        s: Settings `mu1`, `mu2`, `settle_at`.
        degrees: Degree of every regressor.
        moments: Moments of the regressors.
        index: Index of the observed coefficient.
    """
    eigenvalue = settling_eigenvalue(moments.R, degrees, index)
    mu2 = s.mu2 or settling_step_size(eigenvalue, s.settle_at)
    sizes = {0: s.mu1, 1: s.mu1, 2: mu2}
    mu = np.array([sizes[int(d)] for d in degrees])
    return Prediction(eigenvalue, sizes, mu, float(np.log(20) / (mu2 * eigenvalue)), analyse(moments, mu))


PATH_POINTS = 400
"""Approximate number of points of a path that are stored."""
MOST_PATH_NOISE = 0.2
"""Largest standard deviation of a path about its exponential for which a settling time is given, as a share
of the final value."""
LEAST_T_VALUE = 4.0
"""Least t-value of a coefficient for which a settling time is given."""


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """Result of the adaptive filter.

    Attributes:
        model: Model with the last weights, frozen; None after a divergence.
        size: Number of weights.
        prediction: Prediction made before the run.
        times: Iterations at which the paths are stored.
        paths: Observed coefficient in every run.
        mean_path: Predicted mean of the observed coefficient.
        target: Final value of the observed coefficient, the mean of the least-squares fits of all runs.
        settle: Iterations to 95 % of the target, from an exponential through the mean of the runs; None if
            the noise is too large.
        crossed: First stored iteration at which the mean of the runs is within 5 % of the target.
        symmetric: Observed coefficient for a machine with symmetric friction and dead zone; None on measured
            data.
        online: A-priori errors of the last half of the run, relative to the variance (NMSE). Not an error
            of the model: the weights follow the data.
        passes: Number of passes over the training recordings.
        status: "ok", or "diverged at sample k".
    """

    model: Series | None
    size: int
    prediction: Prediction
    times: Int[np.ndarray, " K"]
    paths: Float[np.ndarray, "runs K"]
    mean_path: Float[np.ndarray, " K"]
    target: float
    settle: float | None
    crossed: int | None
    symmetric: Float[np.ndarray, " K"] | None
    online: float
    passes: int
    status: str


def adapt(s: Settings, records: Records, progress: Callable[[str], None]) -> Adaptation:
    """Predicts the convergence, runs the filter and freezes its weights.

    Args:
        s: Settings.
        records: Recordings, of which those for training are used.
        progress: Called with a line of text for every step.
    """
    series = Volterra(Delays(s.memory), order=2, constant=s.constant, layout=s.layout)
    basis = _transformed(s, series, records)
    index = watched_index(s, series)
    theory = moments(s, basis, records)
    prediction = predict(s, basis.degrees, theory, index)
    progress(
        f"predicted: a quadratic step size of {prediction.step_sizes[2]:.3g} settles after "
        f"{prediction.settle:.0f} iterations"
    )
    phi, y = _stacked(basis, records.train, records.channel)
    passes = max(1, int(np.ceil(2 * s.settle_at / len(y)))) if records.measured else 1
    phi, y = np.tile(phi, (passes, 1)), np.tile(y, passes)
    every = max(1, len(y) // PATH_POINTS)
    lms = LMS(mu=prediction.mu)
    progress("LMS")
    first = run(lms, phi, y, keep_every=every)
    raw = lambda path: np.stack([_raw(basis, w) for w in path])[:, index]  # noqa: E731
    paths, fits = [raw(first.path)], [least_squares(series, list(records.train), records.channel)]
    for number, record in enumerate(records.repeats, start=2):
        progress(f"LMS: run {number} of {len(records.repeats) + 1}")
        repeated = run(lms, *_stacked(basis, (record,), records.channel), keep_every=every)
        paths.append(raw(repeated.path)[: len(paths[0])])
        fits.append(least_squares(series, record, records.channel))
    target = np.mean([fit.weights for fit in fits], axis=0)
    # Runs are independent, so the sum of their t-values has the variance `len(fits)`.
    certain = abs(sum(fit.t[index] for fit in fits)) / np.sqrt(len(fits)) > LEAST_T_VALUE
    symmetric_path = None
    if not records.measured:
        progress("LMS: symmetric friction")
        twin = symmetric(s, records.train[0])
        symmetric_path = raw(run(lms, *_stacked(basis, (twin,), records.channel), keep_every=every).path)
    mean = np.mean(paths, axis=0)
    settle, crossed = settling(first.path_times, mean, target[index]) if certain else (None, None)
    return Adaptation(
        None if first.diverged else Series(series, _raw(basis, first.weights), records.channel, records.Ts),
        series.size,
        prediction,
        first.path_times,
        np.array(paths),
        _mean_path(theory, prediction.mu, basis, target, first.path_times)[:, index],
        float(target[index]),
        settle,
        crossed,
        symmetric_path,
        online_nmse(first.errors, y),
        passes,
        first.status,
    )


def watched_index(s: Settings, series: Volterra) -> int:
    """Index of the coefficient of Fig. 9 among the weights."""
    one, two = s.coefficient
    kernels = [series.kernels(weights) for weights in np.eye(series.size)]
    found = [k for k, kernel in enumerate(kernels) if series.degrees[k] == 2 and kernel[2][one, two] != 0]
    return found[0]


def _transformed(s: Settings, series: Volterra, records: Records) -> Any:
    """The basis whose weights LMS adapts: the series itself, or orthogonal combinations of its regressors."""
    if s.transform == "hermite":
        lags = np.arange(s.memory)
        r = autocovariance(s, s.memory) if not records.measured else _sample_covariance(s, records)
        return Hermite.of(series, r[np.abs(lags[:, None] - lags)])
    if s.transform == "gram_schmidt":
        return GramSchmidt.of(series, records.train[0].u)
    return series


def _sample_covariance(s: Settings, records: Records) -> Float[np.ndarray, " lags"]:
    lagged = np.concatenate([Delays(s.memory).outputs(r.u)[r.n_init :] for r in records.train])
    return (lagged.T @ lagged / len(lagged))[0]


def _stacked(
    basis: Any, records: Sequence[Recording], channel: str
) -> tuple[Float[np.ndarray, "N P"], Float[np.ndarray, " N"]]:
    """Regressors and output of several recordings, without the samples whose past is unknown."""
    phi = [np.asarray(basis.regressors(r.u.astype(float)))[r.n_init :] for r in records]
    y = [r.channel(channel)[r.n_init :].astype(float) for r in records]
    return np.concatenate(phi), np.concatenate(y)


def _raw(basis: Any, weights: Float[np.ndarray, " P"]) -> Float[np.ndarray, " V"]:
    """Weights of the Volterra series."""
    return basis.raw_weights(weights) if hasattr(basis, "raw_weights") else weights


def _mean_path(
    theory: Moments,
    mu: Float[np.ndarray, " P"],
    basis: Any,
    target: Float[np.ndarray, " V"],
    times: Int[np.ndarray, " K"],
) -> Float[np.ndarray, "K V"]:
    """Predicted mean of the Volterra weights, which converge to `target`."""
    back = np.stack([_raw(basis, w) for w in np.eye(basis.size)], axis=1)
    end = np.linalg.lstsq(back, target, rcond=None)[0]
    return learning_curve(theory, mu, end, times).weights @ back.T


def moments(s: Settings, basis: Any, records: Records) -> Moments:
    """Moments of the regressors: exact ones from the filter of the input, or sample moments.

    Sample moments are used for measured recordings and for transformed regressors.
    """
    if records.measured or s.transform != "none":
        return Moments.of_regressors(_stacked(basis, records.train, records.channel)[0])
    lags = np.arange(s.memory)
    R1 = autocovariance(s, s.memory)[np.abs(lags[:, None] - lags)]
    return Moments.gaussian(R1, sorted(set(basis.degrees.tolist())), s.layout)


def online_nmse(errors: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"]) -> float:
    """NMSE of the a-priori errors over the last half of a run; NaN after a divergence."""
    half = len(y) // 2
    if not np.all(np.isfinite(errors)):
        return float("nan")
    return float(np.sum(errors[half:] ** 2) / np.sum((y[half:] - y[half:].mean()) ** 2))


def settling(
    times: Real[np.ndarray, " K"], path: Float[np.ndarray, " K"], target: float
) -> tuple[float | None, int | None]:
    """Iterations to 95 % of the target, from an exponential through the path and from the path itself.

        path ~ target (1 - exp(-t / tau)),  settled at ln(20) tau

    The exponential averages over the gradient noise. The first result is None if the noise is a fifth of the
    target or more, or if the path is shorter than 2 tau.

    >>> t = np.arange(0.0, 5000.0, 10.0)
    >>> settle, crossed = settling(t, 2.0 * (1 - np.exp(-t / 1000.0)), 2.0)
    >>> round(settle), crossed
    (2996, 3000)
    """
    from scipy.optimize import minimize_scalar  # takes long to import

    if not target or not np.all(np.abs(path) < 100 * np.abs(target)):  # no target, or a filter that diverged
        return None, None
    share = path / target
    inside = np.flatnonzero(np.abs(share - 1) < 0.05)
    crossed = int(times[inside[0]]) if len(inside) else None
    left = lambda log_tau: share - 1 + np.exp(-times / np.exp(log_tau))  # noqa: E731
    span = np.log(times[1] / 10), np.log(times[-1] * 10)
    best = minimize_scalar(lambda log_tau: np.sum(left(log_tau) ** 2), bounds=span, method="bounded")
    tau = float(np.exp(best.x))
    seen = np.std(left(best.x)) < MOST_PATH_NOISE and 2 * tau < times[-1]
    return (float(np.log(20) * tau) if seen else None), crossed
