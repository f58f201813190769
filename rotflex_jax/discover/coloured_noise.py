"""Whether the errors of a model are the coloured noise of a sensor: an AR(1) whatever the motion."""

import math

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.models.model import Model
from rotflex_jax.models.residual_tests import residual_tests
from rotflex_jax.recording import Recording

# A coefficient of less colours too little to matter.
LEAST_COLOUR = 0.2
# Chance of refusing an AR(1) where the errors are one, of each of the tests.
FALSE_REFUSAL = 1e-3
# Lags at which what an AR(1) leaves must be white.
LAGS = 25
# Samples that any of these tests need.
LEAST_SAMPLES = 400


def coloured_noise(
    e: Float[np.ndarray, " N"], motion: Float[np.ndarray, "N M"], u: Float[np.ndarray, " N"], Ts: float
) -> float | None:
    """The coefficient of an AR(1) that explains an error, where nothing of the motion remains in it.

        e(t) = a e(t-1) + w(t)

    `w` must be white (Ljung and Box), independent of the input, and neither its mean nor its size may follow
    the motion: F tests of regressions of w and of |w| on positions, speeds, their signs and squares.

    Args:
        e: Errors of free runs of one channel.
        motion: Simulated signals and their derivatives.
        u: Input.
        Ts: Sampling period [s].

    Returns:
        `a`, or None where the errors are something else, or nearly white.

    Source: G. M. Ljung and G. E. P. Box, Biometrika 65, 1978.
    """
    N = len(e) - 1
    if N < LEAST_SAMPLES or not np.all(np.isfinite(e)) or np.ptp(e) == 0:
        return None
    x = e - e.mean()
    a = float(x[1:] @ x[:-1] / (x[:-1] @ x[:-1]))
    w = x[1:] - a * x[:-1]
    if not LEAST_COLOUR < a < 1:
        return None
    tests = residual_tests(w[:, None], u[1:], Ts, ("error",), LAGS)
    r = tests.autocorrelation[0, 1:]
    ljung_box = N * (N + 2) * float(np.sum(r**2 / (N - np.arange(1, LAGS + 1))))
    if scipy.stats.chi2.sf(ljung_box, LAGS - 1) < FALSE_REFUSAL:
        return None
    # Of 26 lags with 1 % each, four or more are outside once in 10,000 cases.
    if tests.outside_input[0][tests.input_lags >= 0].sum() >= 4:
        return None
    z = motion[1:] / np.maximum(motion[1:].std(axis=0), 1e-300)
    regressors = np.column_stack([z, np.sign(z), z**2])
    if any(_depends(y, regressors) for y in (w, np.abs(w))):
        return None
    return a


def _depends(y: Float[np.ndarray, " N"], regressors: Float[np.ndarray, "N K"]) -> bool:
    """Whether a regression explains more than chance does, by an F test."""
    X = regressors - regressors.mean(axis=0)
    y = y - y.mean()
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    K, N = int(np.linalg.matrix_rank(X)), len(y)
    ratio = (float(y @ y) - float(left @ left)) / K / max(float(left @ left) / (N - K - 1), 1e-300)
    return scipy.stats.f.sf(ratio, K, N - K - 1) < FALSE_REFUSAL


def coloured_sensors(model: Model, recording: Recording, runs: Float[np.ndarray, "N C"]) -> dict[str, float]:
    """Channel -> coefficient of an AR(1), for a model of whose errors nothing else remains.

    Args:
        model: That was fitted.
        recording: One that it was not fitted to.
        runs: Its free run over that recording.

    Returns:
        Empty where a channel has errors that are neither white nor an AR(1).
    """
    y = np.asarray(model.measured(recording), float)
    # That of the run, since what is measured has the noise in it.
    motion, first = np.column_stack([runs, np.gradient(runs, recording.Ts, axis=0)]), recording.n_init
    found = {}
    for channel, error in zip(model.mechanism.channels, (y - runs).T, strict=True):
        given = error[first:], motion[first:], recording.u[first:].astype(float), recording.Ts
        a = coloured_noise(*given)
        if a is not None:
            found[channel] = a
        elif not _is_white(error[first:]):
            return {}
    return found


def _is_white(e: Float[np.ndarray, " N"]) -> bool:
    """Whether an error has little memory of itself."""
    x = e - e.mean()
    power = float(x @ x)
    return power > 0 and abs(float(x[1:] @ x[:-1])) / power < LEAST_COLOUR + 2 / math.sqrt(len(e))


def advice(coloured: dict[str, float]) -> tuple[str, ...]:
    """What to do where sensors have coloured noise, in a sentence; nothing for none."""
    if not coloured:
        return ()
    listed = " and ".join(f"{c} ({a:.2g})" for c, a in coloured.items())
    return (
        f"What remains is no torque: the free-run errors of {listed} are an AR(1) with that coefficient from "
        "one sample to the next, whatever the motion. Sensor noise is taken for white here; look for a "
        "filter or a drifting zero of the sensor, and judge the model by its free runs.",
    )
