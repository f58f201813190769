"""Results for a report beyond the search: residual tests, frequency responses, latent and learned torques."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.checks import Progress
from rotflex_jax.discover.learned_torque import LearnedTorqueResult
from rotflex_jax.discover.localise import locate_in_windows
from rotflex_jax.discover.result import SearchResult, Stage, Where
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.identifiable import Identifiability
from rotflex_jax.latent import LatentTorque, latent_torque
from rotflex_jax.models.model import Model
from rotflex_jax.models.residual_tests import (
    FrequencyResponse,
    ResidualTests,
    frequency_response,
    residual_tests,
)
from rotflex_jax.recording import Recording
from rotflex_jax.text.numbers import plain_number


@dataclasses.dataclass(frozen=True)
class ModelTests:
    """Tests of the baseline and of the final model on the longest validation recording.

    Attributes:
        recording: The longest validation recording.
        residuals: Name of the model -> tests of its innovations, which are the errors of one-step
            predictions.
        measured: Frequency response from the input to the measured outputs.
        simulated: Name of the model -> frequency response from the input to the outputs of its free run.
    """

    recording: Recording
    residuals: dict[str, ResidualTests]
    measured: FrequencyResponse
    simulated: dict[str, FrequencyResponse]


def model_tests(found: SearchResult) -> ModelTests:
    """Residual tests and frequency responses of the baseline and the final model.

    Residuals are innovations of predictions with the likeliest process noise: if a model is right, they are
    white and independent of the input. Frequency responses are estimated from free runs over the recording.
    """
    i = found.longest_validation
    recording = found.validation[i]
    stages = {"baseline": found.baseline} | ({"final model": found.final} if found.rounds else {})
    measured = np.asarray(found.baseline.model.measured(recording), float)
    residuals = {name: tests for name, s in stages.items() if (tests := _innovations(found, s, i))}
    runs = {name: np.asarray(s.simulated[i], float) for name, s in stages.items()}
    simulated = {
        name: frequency_response(recording.u, run, recording.Ts)
        for name, run in runs.items()
        if np.all(np.isfinite(run))
    }
    return ModelTests(
        recording, residuals, frequency_response(recording.u, measured, recording.Ts), simulated
    )


def _innovations(found: SearchResult, stage: Stage, i: int) -> ResidualTests | None:
    """Tests of a stage's innovations over validation recording `i`; None if they diverge or are few."""
    recording, model = found.validation[i], stage.model_on(i)
    channels, m = model.mechanism.channels, recording.n_init
    noise = [found.noise_floor.get(c) or stage.held_out_rmse_windows[c] for c in channels]
    predicted = np.asarray(model.predict(recording, stage.process_noise, noise), float)
    e = (np.asarray(model.measured(recording), float) - predicted)[m:]
    if len(e) < 60 or not np.all(np.isfinite(e)):
        return None
    return residual_tests(e, recording.u[m:].astype(float), recording.Ts, channels)


# Length of the part of a recording from which latent torques are estimated [s].
SHOWN_SECONDS = 30.0


@dataclasses.dataclass(frozen=True)
class LatentTorqueComparison:
    """Latent torques of the baseline and of the final model over the same recordings.

    Attributes:
        before: Torques that the baseline lacks.
        after: Torques that the final model lacks; None if nothing was added, or if an effect of the final
            model has no slope at zero, such as play in a gear.
    """

    before: LatentTorque
    after: LatentTorque | None

    @property
    def sentences(self) -> list[str]:
        """Sentences on the size of the torques that the models lack, and on their behaviour in time."""
        lines = []
        for port in self.before.ports:
            line = f"At the {port} the baseline lacks {self._size(self.before, port)}"
            if self.after is not None:
                line += f", the final model {self._size(self.after, port)}"
            lines.append(line + ".")
        return lines + (self.after or self.before).in_time()

    def __str__(self) -> str:
        b = self.before
        k, i = np.unravel_index(int(np.argmax(np.abs(b.torque))), b.torque.shape)
        count = len(b.Ts)
        which = f" of recording {b.recording[k] + 1}" if count > 1 else ""
        seconds = float(np.asarray(b.Ts)[b.recording].sum())
        head = (
            "Latent torque: what the models would have to be given to follow the measurement, over "
            f"{seconds:.3g} s of {'one recording' if count == 1 else f'{count} recordings'}"
        )
        largest = (
            f"The largest torque that the baseline lacks is {abs(b.torque[k, i]):.3g} {b.effort} at the "
            f"{b.ports[i]}, {b.time[k]:.4g} s{which}."
        )
        return "\n".join([head, *(f"  {line}" for line in (*self.sentences, largest))])

    def _size(self, torque: LatentTorque, port: str) -> str:
        """Size of a torque in words, also as a percentage of the motor's torque in the baseline."""
        size, scale = torque.size(port), self.before.scale
        if size < 1e-3 * scale:
            return "nothing that could be seen"
        share = plain_number(100 * size / scale, 2)
        return f"{plain_number(size, 2)} {torque.effort} rms, {share} % of the motor's torque"


def compare_latent_torques(
    baseline: Stage, final: Stage | None, recordings: Sequence[Recording], progress: Progress | None = None
) -> LatentTorqueComparison:
    """Latent torques with the baseline and with the final model.

    Args:
        baseline: Stage of the baseline.
        final: Stage of the final model; None if nothing was added.
        recordings: Recordings, of which the first 30 s are used.
        progress: Called with a line of text now and then.
    """
    shown = [r.slice(0, min(r.N, round(SHOWN_SECONDS / r.Ts))) for r in recordings]
    if final is None or not all(e.slope_at_zero for e in final.model.mechanism.effects):
        # An impact of teeth has no derivative: a smoother would mistake it for a torque.
        return LatentTorqueComparison(latent_torque(calibrated(baseline), shown, progress=progress), None)
    last = calibrated(final)
    first = with_effects_of(calibrated(baseline), last)
    return LatentTorqueComparison(*(latent_torque(m, shown, progress=progress) for m in (first, last)))


def calibrated(stage: Stage) -> Model:
    """The model of a stage, including the offsets that belong to its recordings."""
    m = stage.model.mechanism
    for e in stage.estimates:
        port, effect, parameter = e.name.rsplit(".", 2)
        if e.name not in m.parameter_names and effect in CATALOG:
            m = m + CATALOG[effect](at=port, **{parameter: e.value})
    return dataclasses.replace(stage.model, mechanism=m)


def with_effects_of(small: Model, large: Model) -> Model:
    """A model with the effects of a larger model added and switched off, so that both share compiled code."""
    own = small.mechanism
    present = {(e.name, e.at) for e in own.effects}
    m = large.mechanism
    missing = [e for e in own.effects if (e.name, e.at) not in {(f.name, f.at) for f in m.effects}]
    for e in missing:
        m = m + e
    values = own.named_values
    gates = tuple(1.0 if (e.name, e.at) in present else 0.0 for e in m.effects)
    return Model(m.with_values(values), large.solver, gates)


# Least coefficient of an AR(1) that counts as coloured noise.
LEAST_COLOUR = 0.2
# Probability with which each test rejects an AR(1) although the errors are one.
FALSE_REFUSAL = 1e-3
# Number of lags at which the residuals of an AR(1) must be white.
LAGS = 25
# Least number of samples for these tests.
LEAST_SAMPLES = 400


def coloured_noise(
    e: Float[np.ndarray, " N"], motion: Float[np.ndarray, "N M"], u: Float[np.ndarray, " N"], Ts: float
) -> float | None:
    """The coefficient of an AR(1) that explains an error, if the error is independent of the motion.

        e(t) = a e(t-1) + w(t)

    `w` must be white (test of Ljung and Box) and independent of the input. Neither its mean nor its size may
    depend on the motion (F tests of regressions of w and of |w| on positions, speeds, their signs and
    squares).

    Args:
        e: Errors of free runs in one channel.
        motion: Simulated signals and their derivatives.
        u: Input.
        Ts: Sampling period [s].

    Returns:
        The coefficient `a`; None if the errors are no AR(1), or nearly white.

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
    """Channels of which the errors of free runs are coloured sensor noise, an AR(1).

    Args:
        model: The fitted model.
        recording: A recording to which it was not fitted.
        runs: Its free run over this recording.

    Returns:
        Channel -> coefficient of the AR(1). Empty if a channel has errors that are neither white nor an
        AR(1).
    """
    y = np.asarray(model.measured(recording), float)
    # Motion of the free run, since the measured motion contains the noise.
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
    """Whether the autocorrelation of an error from one sample to the next is small."""
    x = e - e.mean()
    power = float(x @ x)
    return power > 0 and abs(float(x[1:] @ x[:-1])) / power < LEAST_COLOUR + 2 / math.sqrt(len(e))


def advice(coloured: dict[str, float]) -> tuple[str, ...]:
    """Advice for sensors with coloured noise, in a sentence; nothing if there are none."""
    if not coloured:
        return ()
    listed = " and ".join(f"{c} ({a:.2g})" for c, a in coloured.items())
    return (
        f"What remains is no torque: the free-run errors of {listed} are an AR(1) with that coefficient from "
        "one sample to the next, whatever the motion. Sensor noise is taken for white here; look for a "
        "filter or a drifting zero of the sensor, and compare models by their free runs.",
    )


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Everything that is computed for a report; writing the report only formats and draws it.

    Attributes:
        latent: Torques that the baseline and the final model lack; None if they were not computed.
        learned: A learned torque for what is left; None if none was requested or none can be learned.
        remaining: Where the final model still fails; empty unless effects were found and something is
            unexplained.
        tests: Tests of the residuals, and frequency responses; None if they were not computed.
        known: Identifiability of the model to use from sensors and recording; None if it was not computed.
    """

    latent: LatentTorqueComparison | None = None
    learned: LearnedTorqueResult | None = None
    remaining: tuple[Where, ...] = ()
    tests: ModelTests | None = None
    known: Identifiability | None = None


def remaining_failures(found: SearchResult) -> tuple[Where, ...]:
    """Where the final model fails on the longest validation recording, if something remains unexplained."""
    if found.verdict != Verdict.UNEXPLAINED or not found.rounds:
        return ()
    i = found.longest_validation
    recording, final = found.validation[i], found.final
    runs, seconds = final.windowed[i], final.window_seconds
    return locate_in_windows(final.model, recording, runs, found.noise_floor, seconds)
