"""Tests of the models of a search against a recording: residuals, and frequency response."""

import dataclasses

import numpy as np

from rotflex_jax.discover.result import SearchResult, Stage
from rotflex_jax.models.frequency_response import FrequencyResponse, frequency_response
from rotflex_jax.models.residual_tests import ResidualTests, residual_tests
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class ModelTests:
    """What the longest validation recording says of the baseline and of the final model.

    Attributes:
        recording: Which it is.
        residuals: Name of the model -> tests of its innovations, what one-step predictions leave.
        measured: Response of the measured outputs to the input.
        simulated: Name of the model -> the same estimate of its free run.
    """

    recording: Recording
    residuals: dict[str, ResidualTests]
    measured: FrequencyResponse
    simulated: dict[str, FrequencyResponse]


def model_tests(found: SearchResult) -> ModelTests:
    """Residual tests and frequency responses of the baseline and the final model.

    Residuals are those of predictions, with the process noise that the data ask for: where a model is right
    they are white and independent of the input. Frequency responses are of free runs over the recording.
    """
    i = max(range(len(found.validation)), key=lambda k: found.validation[k].N)
    recording = found.validation[i]
    stages = {"baseline": found.baseline} | ({"final model": found.final} if found.rounds else {})
    measured = np.asarray(found.baseline.model.measured(recording), float)
    residuals = {name: tests for name, s in stages.items() if (tests := _innovations(found, s, recording))}
    runs = {name: np.asarray(s.simulated[i], float) for name, s in stages.items()}
    simulated = {
        name: frequency_response(recording.u, run, recording.Ts)
        for name, run in runs.items()
        if np.all(np.isfinite(run))
    }
    return ModelTests(
        recording, residuals, frequency_response(recording.u, measured, recording.Ts), simulated
    )


def _innovations(found: SearchResult, stage: Stage, recording: Recording) -> ResidualTests | None:
    """Tests of a stage's innovations; None where its predictions run away."""
    channels, m = stage.model.mechanism.channels, recording.n_init
    noise = [found.noise_floor.get(c) or stage.held_out_rmse_windows[c] for c in channels]
    predicted = np.asarray(stage.model.predict(recording, stage.process_noise, noise), float)
    e = (np.asarray(stage.model.measured(recording), float) - predicted)[m:]
    if len(e) < 60 or not np.all(np.isfinite(e)):
        return None
    return residual_tests(e, recording.u[m:].astype(float), recording.Ts, channels)
