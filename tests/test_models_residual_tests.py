"""A model against a recording: figure with the fit, tests of the residuals, frequency response."""

import dataclasses
import json

import numpy as np
import pytest
from scipy import signal
from test_cli import DEMO, recorded, run, write  # noqa: F401 - fixtures
from test_report import two_rounds

import rotflex_jax as rf
from rotflex_jax.discover.explanation import Explanation, model_tests
from rotflex_jax.errors import InputError
from rotflex_jax.models.comparison import default_labels
from rotflex_jax.models.model import Model
from rotflex_jax.models.residual_tests import frequency_response, residual_tests
from rotflex_jax.report import simulation
from rotflex_jax.report.figures import pictures
from rotflex_jax.report.page import render

NOISE = 5e-4


def simulated(model, N: int = 3000, Ts: float = 0.004, seed: int = 0) -> rf.Recording:
    """Simulation of a model with white sensor noise, as a recording."""
    rng = np.random.default_rng(seed)
    u = rf.data.excitation.multisine(N, Ts, rms=1.5)
    blank = rf.Recording(u=u, y=rng.standard_normal((N, 2)), Ts=Ts)
    y = Model(model).simulate(blank, x0=[0.0, 0.0, 0.0, 0.0])
    return rf.Recording(u=u, y=y + NOISE * rng.standard_normal((N, 2)), Ts=Ts, source="bench.csv")


@pytest.fixture(scope="module")
def recording() -> rf.Recording:
    return simulated(rf.joints.paper())


def test_autocorrelation_is_that_of_its_definition() -> None:
    rng = np.random.default_rng(3)
    e, u = rng.standard_normal((400, 2)), rng.standard_normal(400)
    tests = residual_tests(e, u, 0.01, ["a", "b"], most=10)
    x, v = e[:, 1] - e[:, 1].mean(), u - u.mean()
    for k in (0, 3, 10):
        assert tests.autocorrelation[1, k] == pytest.approx(np.sum(x[: 400 - k] * x[k:]) / np.sum(x**2))
    scale = np.sqrt(np.sum(x**2) * np.sum(v**2))
    later, earlier = list(tests.input_lags).index(4), list(tests.input_lags).index(-4)
    assert tests.cross_correlation[1, later] == pytest.approx(np.sum(v[:-4] * x[4:]) / scale)
    assert tests.cross_correlation[1, earlier] == pytest.approx(np.sum(v[4:] * x[:-4]) / scale)


@pytest.mark.parametrize("coloured", [False, True])
def test_bands_hold_what_they_promise(coloured: bool) -> None:
    # If the hypothesis of a test holds, 1 % of the lags lie outside its band, over many realisations.
    rng = np.random.default_rng(0)
    outside_white, outside_input = [], []
    for _ in range(200):
        e, u = rng.standard_normal(2000), rng.standard_normal(2000)
        if coloured:  # half of the lags lie outside a band for white signals
            e, u = (signal.lfilter([1.0], [1.0, -0.9], x) for x in (e, u))
        tests = residual_tests(e[:, None], u, 0.01, ["theta"])
        outside_white.append(tests.outside_white[:, 1:].mean())
        outside_input.append(tests.outside_input.mean())
    assert np.mean(outside_input) == pytest.approx(0.01, abs=0.007)
    if coloured:
        assert np.mean(outside_white) > 0.5
    else:
        assert np.mean(outside_white) == pytest.approx(0.01, abs=0.004)


def test_what_a_model_lacks_shows_in_its_residuals(recording) -> None:
    def outside(joint) -> tuple[float, float]:
        e = recording.y - Model(joint).simulate(recording)
        m = recording.n_init
        tests = residual_tests(e[m:], recording.u[m:], recording.Ts, recording.channels)
        return tests.outside_white.mean(), tests.outside_input[:, tests.input_lags >= 0].mean()

    right, wrong = outside(rf.joints.paper()), outside(rf.joints.paper(stiffness=1.6))
    assert max(right) < 0.1
    assert min(wrong) > 0.5


def test_too_short_residuals_are_refused() -> None:
    with pytest.raises(InputError, match="30 samples"):
        residual_tests(np.zeros((30, 1)), np.zeros(30), 0.01, ["theta"])


def test_frequency_response_is_that_of_a_known_filter() -> None:
    rng = np.random.default_rng(1)
    b, a = signal.butter(2, 0.2)
    u = rng.standard_normal(40_000)
    y = signal.lfilter(b, a, u)
    found = frequency_response(u, np.column_stack([y, -2 * y]), 0.01)
    f, h = found.frequency, signal.freqz(b, a, worN=found.frequency, fs=100.0)[1]
    low = f < 10.0  # Hz, the pass band: above it the response is estimated less accurately
    assert np.max(np.abs(found.response[0, low] - h[low])) < 0.1
    assert np.all(found.coherence[:, low] > 0.97)
    assert np.allclose(found.response[1], -2 * found.response[0])
    assert found.magnitude_db[1, 5] - found.magnitude_db[0, 5] == pytest.approx(20 * np.log10(2))


def test_coherence_falls_with_what_does_not_follow_the_input() -> None:
    rng = np.random.default_rng(2)
    u, other = rng.standard_normal((2, 40_000))
    found = frequency_response(u, (u + other)[:, None], 0.01)
    assert np.mean(found.coherence) == pytest.approx(0.5, abs=0.1)  # half of the power comes from the input


def test_a_fit_draws_itself_against_a_recording(recording) -> None:
    wrong = rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.03)
    figure = rf.compare_plot(recording, rf.joints.paper(), wrong)
    assert figure._repr_png_()[:4] == b"\x89PNG"  # what a notebook shows
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels[0] == "measured"
    fit = rf.metrics.fit_percent(recording, Model(wrong).simulate(recording))
    assert f"fit {fit['theta']:.1f} %" in labels[2]
    assert "deg rms" in labels[2]
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "theta [deg]",
        "error [deg]",
        "alpha [deg]",
        "error [deg]",
    ]
    assert figure.axes[-1].get_xlabel() == "time [s]"
    # The errors of the first model, which is the true one, are sensor noise.
    drawn = figure.axes[1].lines[0].get_ydata()
    assert np.max(np.abs(drawn)) < np.rad2deg(6 * NOISE)


def test_a_fit_has_the_same_plot(recording) -> None:
    estimate = rf.parameters.Estimate("a", 1.0, 0.1, (0.8, 1.2), "rad")
    fit = rf.Fit(Model(rf.joints.paper()), 1.0, "converged", (estimate,), {}, np.zeros((0, 0)), (), 3)
    one, two = fit.plot(recording), fit.plot(recording, seconds=2.0)
    assert "simulated: fit 9" in one.axes[0].get_legend().get_texts()[1].get_text()
    assert "free runs of 2 s" in two.get_suptitle()


def test_a_run_that_diverges_is_named_and_hides_nothing(recording) -> None:
    """The legend names it, and the axes keep the range of the measured outputs."""

    class Runaway:
        channels = ("theta", "alpha")

        def simulate(self, recording):
            return np.full(recording.y.shape, np.inf)

    figure = rf.compare_plot(recording, rf.joints.paper(), Runaway())
    assert "model 2: diverges" in figure.axes[0].get_legend().get_texts()[2].get_text()
    assert figure.axes[0].get_ylim()[1] < 10 * np.rad2deg(np.abs(recording.y[:, 0]).max())


def test_models_are_named_by_what_they_have_more() -> None:
    first, friction = Model(rf.joints.paper()), rf.effects.Coulomb(at="hub")
    assert "hub" in default_labels([first, first + friction])[1]
    assert default_labels([first + friction, first]) == ("model 1", "model 2")
    other = first + rf.effects.LuGre(at="hub")  # one law in the place of the other
    assert default_labels([first + friction, other]) == ("model 1", "model 2")


@pytest.mark.parametrize(
    ("models", "options", "said"),
    [
        ((), {}, "No model"),
        ((3.0,), {}, "no method simulate"),
        ((rf.joints.paper(),), {"labels": ["a", "b"]}, "2 names for 1 models"),
    ],
)
def test_what_cannot_be_compared_is_refused(models, options, said, recording) -> None:
    with pytest.raises(InputError, match=said):
        rf.compare_plot(recording, *models, **options)


def test_a_recording_comes_first(recording) -> None:
    with pytest.raises(InputError, match="recording first"):
        rf.compare_plot(rf.joints.paper(), recording)


def test_the_report_shows_the_tests_that_were_computed_before(monkeypatch) -> None:
    recording = simulated(rf.joints.paper())
    stage = two_rounds().baseline
    stage = dataclasses.replace(
        stage,
        simulated=(np.asarray(stage.model.simulate(recording)),),
        windowed=(recording.y,),
        process_noise={"hub": 0.0},
    )
    found = dataclasses.replace(two_rounds(), validation=(recording,), baseline=stage, rounds=())
    tests = model_tests(found)
    assert list(tests.residuals) == list(tests.simulated) == ["baseline"]
    assert tests.residuals["baseline"].outside_white.mean() < 0.1
    clear = tests.measured.coherence[1] > 0.95
    assert clear.sum() > 10
    difference = np.abs(tests.simulated["baseline"].magnitude_db - tests.measured.magnitude_db)[1]
    assert np.quantile(difference[clear], 0.9) < 0.2
    # Writing the page must not simulate.
    monkeypatch.setattr(Model, "_run", lambda *given: pytest.fail("the page simulates"))
    monkeypatch.setattr(Model, "predict", lambda *given: pytest.fail("the page predicts"))
    explanation = Explanation(tests=tests)
    drawn = pictures(found, explanation)
    assert {"residual_tests", "frequency_response"} <= set(drawn)
    for name in ("residual_tests", "frequency_response"):
        assert all("[" in ax.get_ylabel() for ax in drawn[name].figure.axes if ax.get_ylabel())
    page = render(found, explanation)
    assert "Residuals and frequency response" in page
    assert "Baseline, theta: " in page


def test_simulate_writes_a_page(run, recorded, tmp_path) -> None:  # noqa: F811
    folder = tmp_path / "page"
    status, out, _ = run("simulate", recorded, "--report", folder)
    assert status == 0
    assert str(folder / "simulation.html") in out
    page = (folder / "simulation.html").read_text()
    assert page.count("<figure") == 3
    written = json.loads((folder / "simulation.json").read_text())
    rec = rf.load(recorded)
    y_hat = Model(rf.joints.paper()).simulate(rec)
    assert written["errors"]["theta"]["rmse"] == pytest.approx(rf.metrics.rmse(rec, y_hat)["theta"])
    assert written["errors"]["alpha"]["fit_percent"] == pytest.approx(
        rf.metrics.fit_percent(rec, y_hat)["alpha"]
    )
    assert f"{written['errors']['theta']['fit_percent']:.1f}" in page


def test_a_steady_drift_changes_no_frequency_response() -> None:
    """A straight line is taken out of each stretch, so that it adds nothing to low frequencies."""
    u = np.random.default_rng(6).standard_normal(4000)
    y = signal.lfilter([0.1], [1.0, -0.9], u)[:, None]
    drift = 0.01 * np.arange(4000)[:, None] - 7.0
    steady, drifting = frequency_response(u, y, 0.01), frequency_response(u, y + drift, 0.01)
    np.testing.assert_allclose(drifting.response, steady.response, rtol=1e-6)
    np.testing.assert_allclose(drifting.coherence, steady.coherence, rtol=1e-6)


def test_errors_on_the_page_of_a_simulation_are_in_the_unit_of_its_rows(recording, monkeypatch) -> None:
    """Errors of 0.01 rad (0.573 deg) at each sample and of 0.03 rad (1.72 deg) at one."""
    for drawn in ("_run_pictures", "_test_pictures"):
        monkeypatch.setattr(simulation, drawn, lambda made: [])
    off = np.full(recording.y.shape, 0.01)
    off[recording.n_init + 5] = 0.03
    made = simulation.tested(recording, Model(rf.joints.paper()), recording.y - off)
    first, second = simulation._content(made)["rows"]
    assert (first[0], first[1], first[2]) == ("theta [deg]", "0.574", "1.72") and second[2] == "1.72"
