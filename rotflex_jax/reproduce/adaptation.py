"""The paper's algorithm: LMS on the weights of a second-order Volterra model (Figs. 5, 6 and 9)."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.adaptive.learning import learning_curve
from rotflex_jax.adaptive.moments import Moments
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.basis.orthogonalise import GramSchmidt, Hermite
from rotflex_jax.fit import least_squares
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce import signals
from rotflex_jax.reproduce.prediction import Prediction, predict
from rotflex_jax.reproduce.records import Records, symmetric
from rotflex_jax.reproduce.settings import Settings
from rotflex_jax.series import Series

KEPT = 400
"""Points of a path that are kept."""
NOISE = 0.2
"""Share of its end value that a path may wander and still be said to settle."""
SIGNIFICANT = 4.0
"""Standard errors by which a coefficient must differ from zero before it can settle on anything."""


@dataclasses.dataclass(frozen=True)
class Adaptation:
    """What the adaptive filter did.

    Attributes:
        model: With the last weights, frozen; None after a divergence.
        size: Number of weights.
        prediction: Made before the run.
        times: Iterations (K,).
        paths: Watched coefficient of every run (runs, K).
        mean_path: What the prediction says of their mean (K,).
        target: Where it should end: least squares over all runs.
        settle: Iterations to 95 % of the way, by an exponential through the mean of the runs; None where
            the noise hides it.
        crossed: First iteration at which the mean of the runs is within 5 % of the target.
        symmetric: The watched coefficient where friction and dead zone are symmetric (K,), if simulated.
        online: A-priori errors of the last half of the run, relative to the variance (NMSE). Not an error
            of the model: the weights move with the data.
        passes: How often the training records were gone through.
        status: "ok", or "diverged at sample k".
    """

    model: Series | None
    size: int
    prediction: Prediction
    times: np.ndarray
    paths: np.ndarray
    mean_path: np.ndarray
    target: float
    settle: float | None
    crossed: int | None
    symmetric: np.ndarray | None
    online: float
    passes: int
    status: str


def adapt(s: Settings, records: Records, say: Callable[[str], None]) -> Adaptation:
    """Predict, run, freeze.

    Args:
        s: Settings.
        records: To learn from.
        say: Told of every step.
    """
    series = Volterra(Delays(s.memory), order=2, constant=s.constant, layout=s.layout)
    basis = _transformed(s, series, records)
    index = watched(s, series)
    theory = moments(s, basis, records)
    prediction = predict(s, basis.degrees, theory, index)
    say(
        f"predicted: a quadratic step size of {prediction.step_sizes[2]:.3g} settles after "
        f"{prediction.settle:.0f} iterations"
    )
    phi, y = _stacked(basis, records.train, records.channel)
    passes = max(1, int(np.ceil(2 * s.settle_at / len(y)))) if records.measured else 1
    phi, y = np.tile(phi, (passes, 1)), np.tile(y, passes)
    every = max(1, len(y) // KEPT)
    lms = LMS(mu=prediction.mu)
    say("LMS")
    first = run(lms, phi, y, keep_every=every)
    raw = lambda path: np.stack([_raw(basis, w) for w in path])[:, index]  # noqa: E731
    paths, fits = [raw(first.path)], [least_squares(series, list(records.train), records.channel)]
    for number, record in enumerate(records.repeats, start=2):
        say(f"LMS: run {number} of {len(records.repeats) + 1}")
        again = run(lms, *_stacked(basis, (record,), records.channel), keep_every=every)
        paths.append(raw(again.path)[: len(paths[0])])
        fits.append(least_squares(series, record, records.channel))
    target = np.mean([fit.weights for fit in fits], axis=0)
    # Runs are independent, so their t-values add up like this.
    certain = abs(sum(fit.t[index] for fit in fits)) / np.sqrt(len(fits)) > SIGNIFICANT
    same = None
    if not records.measured:
        say("LMS: symmetric friction")
        twin = symmetric(s, records.train[0])
        same = raw(run(lms, *_stacked(basis, (twin,), records.channel), keep_every=every).path)
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
        same,
        online_nmse(first.errors, y),
        passes,
        first.status,
    )


def watched(s: Settings, series: Volterra) -> int:
    """Position of the coefficient of Fig. 9 among the weights."""
    one, two = s.coefficient
    kernels = [series.kernels(weights) for weights in np.eye(series.size)]
    found = [k for k, kernel in enumerate(kernels) if series.degrees[k] == 2 and kernel[2][one, two] != 0]
    return found[0]


def _transformed(s: Settings, series: Volterra, records: Records) -> Any:
    """The basis whose weights LMS moves: the series itself, or orthogonal combinations of its regressors."""
    if s.transform == "hermite":
        lags = np.arange(s.memory)
        r = signals.autocovariance(s, s.memory) if not records.measured else _sample_covariance(s, records)
        return Hermite.of(series, r[np.abs(lags[:, None] - lags)])
    if s.transform == "gram_schmidt":
        return GramSchmidt.of(series, records.train[0].u)
    return series


def _sample_covariance(s: Settings, records: Records) -> np.ndarray:
    lagged = np.concatenate([Delays(s.memory).outputs(r.u)[r.n_init :] for r in records.train])
    return (lagged.T @ lagged / len(lagged))[0]


def _stacked(basis: Any, records: Sequence[Recording], channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and output of several records, without the samples whose past is unknown."""
    phi = [np.asarray(basis.regressors(r.u.astype(float)))[r.n_init :] for r in records]
    y = [r.channel(channel)[r.n_init :].astype(float) for r in records]
    return np.concatenate(phi), np.concatenate(y)


def _raw(basis: Any, weights: np.ndarray) -> np.ndarray:
    """Weights of the Volterra series."""
    return basis.raw_weights(weights) if hasattr(basis, "raw_weights") else weights


def _mean_path(
    theory: Moments, mu: np.ndarray, basis: Any, target: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """What theory says of the mean of the Volterra weights (K, P), on their way to `target`."""
    back = np.stack([_raw(basis, w) for w in np.eye(basis.size)], axis=1)
    end = np.linalg.lstsq(back, target, rcond=None)[0]
    return learning_curve(theory, mu, end, times).weights @ back.T


def moments(s: Settings, basis: Any, records: Records) -> Moments:
    """Of the regressors: from the input's filter alone, or from measured input."""
    if records.measured or s.transform != "none":
        return Moments.of_regressors(_stacked(basis, records.train, records.channel)[0])
    lags = np.arange(s.memory)
    R1 = signals.autocovariance(s, s.memory)[np.abs(lags[:, None] - lags)]
    return Moments.gaussian(R1, sorted(set(basis.degrees.tolist())), s.layout)


def online_nmse(errors: np.ndarray, y: np.ndarray) -> float:
    """Of the a-priori errors, over the last half."""
    half = len(y) // 2
    if not np.all(np.isfinite(errors)):
        return float("nan")
    return float(np.sum(errors[half:] ** 2) / np.sum((y[half:] - y[half:].mean()) ** 2))


def settling(times: np.ndarray, path: np.ndarray, target: float) -> tuple[float | None, int | None]:
    """Iterations to 95 % of the way: of an exponential towards the target, and of the path itself.

        path ~ target (1 - exp(-t / tau)),  settled at ln(20) tau

    Gradient noise moves the path about; the exponential averages over it. Nothing settles where the noise
    is a fifth of the target or more, or where the path is still far from its end.

    >>> t = np.arange(0.0, 5000.0, 10.0)
    >>> settle, crossed = settling(t, 2.0 * (1 - np.exp(-t / 1000.0)), 2.0)
    >>> round(settle), crossed
    (2996, 3000)
    """
    from scipy.optimize import minimize_scalar  # takes long to import

    if not target or not np.all(np.abs(path) < 100 * np.abs(target)):  # noise, or a filter that runs away
        return None, None
    way = path / target
    inside = np.flatnonzero(np.abs(way - 1) < 0.05)
    crossed = int(times[inside[0]]) if len(inside) else None
    left = lambda log_tau: way - 1 + np.exp(-times / np.exp(log_tau))  # noqa: E731
    span = np.log(times[1] / 10), np.log(times[-1] * 10)
    best = minimize_scalar(lambda log_tau: np.sum(left(log_tau) ** 2), bounds=span, method="bounded")
    tau = float(np.exp(best.x))
    seen = np.std(left(best.x)) < NOISE and 2 * tau < times[-1]
    return (float(np.log(20) * tau) if seen else None), crossed
