"""HTML page of one model on one recording: free run, errors, residual tests, frequency response."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax import metrics
from rotflex_jax.fit.result import Fit
from rotflex_jax.models.model import Model
from rotflex_jax.models.residual_tests import (
    FrequencyResponse,
    ResidualTests,
    frequency_response,
    residual_tests,
)
from rotflex_jax.models.run_figure import run_figure, run_view
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures.residuals import residual_figure, response_figure
from rotflex_jax.text.markup import as_json, fill_template, write_files
from rotflex_jax.text.numbers import json_numbers, plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.plotting import Picture, styled

# Name of the model in figures.
NAME = "simulated"


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A free run of a model over a recording, with its tests.

    Attributes:
        recording: The recording.
        model: The model.
        simulated: Free run of the model.
        fit: Fit from which the model comes; None if the model was not fitted.
        residuals: Tests of measured less simulated; None if the run diverges or is too short.
        measured: Frequency response of the measured outputs.
        response: Frequency response of the free run; None if it diverges.
    """

    recording: Recording
    model: Model
    simulated: Float[np.ndarray, "N C"]
    fit: Fit | None
    residuals: ResidualTests | None
    measured: FrequencyResponse
    response: FrequencyResponse | None

    @property
    def units(self) -> dict[str, str]:
        """Channel of the model -> its unit."""
        r = self.recording
        return {c: r.unit(c) for c in self.model.mechanism.channels}

    def errors(self) -> dict[str, dict[str, float]]:
        """Channel -> root mean square error, largest error [unit of the channel], fit [%]."""
        y, n = self.model.measured(self.recording), self.recording.n_init
        kinds = {"rmse": metrics.rmse, "max_error": metrics.max_error, "fit_percent": metrics.fit_percent}
        values = {name: metric(y, self.simulated, n) for name, metric in kinds.items()}
        return {c: {name: float(v[k]) for name, v in values.items()} for k, c in enumerate(self.units)}


def tested(
    recording: Recording, model: Model, simulated: Float[np.ndarray, "N C"], fit: Fit | None = None
) -> Simulation:
    """Tests a free run.

    Args:
        recording: The recording.
        model: The model.
        simulated: Free run of the model over the recording.
        fit: Fit from which the model comes; None if the model was not fitted.
    """
    y, m, u = model.measured(recording).astype(float), recording.n_init, recording.u.astype(float)
    finite, residuals, response = bool(np.all(np.isfinite(simulated))), None, None
    if finite:
        response = frequency_response(u, simulated, recording.Ts)
        if recording.N - m >= 60:
            residuals = residual_tests((y - simulated)[m:], u[m:], recording.Ts, model.mechanism.channels)
    measured = frequency_response(u, y, recording.Ts)
    return Simulation(recording, model, simulated, fit, residuals, measured, response)


def write_simulation(simulation: Simulation, folder: str | Path) -> Path:
    """Writes `simulation.html` (self-contained) and `simulation.json` into a folder, created if needed.

    Returns:
        Path of the HTML page.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    folder = Path(folder)
    page = fill_template("rotflex_jax.report", "simulation.html.j2", _content(simulation))
    write_files(folder, {"simulation.json": as_json(_plain(simulation)), "simulation.html": page})
    return folder / "simulation.html"


def _plain(simulation: Simulation) -> dict[str, Any]:
    fit = simulation.fit
    return {
        "schema": 1,
        "source": simulation.recording.source,
        "errors": {channel: json_numbers(row) for channel, row in simulation.errors().items()},
        "parameters": {e.name: e.to_dict() for e in fit.parameters} if fit else {},
        "remarks": [remark.to_dict() for remark in fit.remarks] if fit else [],
    }


def _content(simulation: Simulation) -> dict[str, Any]:
    rows = []
    for channel, error in simulation.errors().items():
        unit = simulation.units[channel]
        rms, read = readable(error["rmse"], unit)
        share = error["fit_percent"]
        rows.append(
            (
                f"{channel} [{read}]",
                plain_number(rms),
                plain_number(readable(error["max_error"], unit)[0]),
                f"{share:.1f}" if np.isfinite(share) else "–",
            )
        )
    fit = simulation.fit
    estimates = (
        [
            (e.name, unit_text(e.unit), *value_and_interval(e), e.remark)
            for e in sorted(fit.parameters, key=lambda e: not e.free)
        ]
        if fit
        else []
    )
    return {
        "source": simulation.recording.source,
        "rows": rows,
        "fitted": f"fitted before: {fit.ending}" if fit else "taken as given",
        "estimates": estimates,
        "remarks": [f"{remark.sentence}." for remark in fit.remarks] if fit else [],
        "runs": [p.on_page for p in _run_pictures(simulation)],
        "tests": simulation.residuals.sentences() if simulation.residuals else [],
        "test_pictures": [p.on_page for p in _test_pictures(simulation)],
        "model": str(simulation.model.mechanism),
    }


def _run_pictures(simulation: Simulation) -> list[Picture]:
    given = (
        simulation.recording,
        list(simulation.units),
        [(NAME, np.asarray(simulation.simulated, float))],
    )
    caption = (
        "Where the coloured line covers the grey one, the model is right. Fit is 100 % for a perfect model, "
        "0 for one that is as good as the mean. Lower rows: measured minus simulated."
    )
    description = "Measured and simulated outputs over time, with their differences."
    return [Picture("runs", run_figure(*given, "One free run"), caption, description, run_view(*given))]


def _test_pictures(simulation: Simulation) -> list[Picture]:
    drawn = []
    if simulation.residuals is not None:
        caption = (
            "What the free run leaves. Within the grey band, for 99 of 100 lags, it is white; right of zero, "
            "within the dashed lines, it is independent of the past input: then no better model of "
            "this input is to be found. One free run adds up every small torque error, so it is seldom white."
        )
        figure = styled(residual_figure)({NAME: simulation.residuals})
        drawn.append(
            Picture("tests", figure, caption, "Correlations of the residuals with their 99 % bands.")
        )
    simulated = {NAME: simulation.response} if simulation.response is not None else {}
    figure = styled(response_figure)(
        simulation.measured, simulated, simulation.units, simulation.recording.input_unit
    )
    caption = (
        "Response to the input, measured and of the free run, estimated in the same way. Coherence is the "
        "share of the output that follows the input linearly; where the measured one is low, lines are faint."
    )
    drawn.append(Picture("tests", figure, caption, "Magnitude, phase and coherence over frequency."))
    return drawn
