"""The paper's experiment: its settings, its predictions, and the command from end to end."""

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.cli import app
from rotflex_jax.errors import InputError
from rotflex_jax.fit import least_squares
from rotflex_jax.mechanism import Exponential
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce import Settings, models, records as sources, reproduce
from rotflex_jax.reproduce.adaptation import (
    adapt,
    moments,
    predict,
    settling,
    settling_eigenvalue,
    watched_index,
)
from rotflex_jax.reproduce.experiment import Reproduction, short_memory_errors
from rotflex_jax.reproduce.models import grey_box, linearised, nmse
from rotflex_jax.reproduce.plants import plant, response
from rotflex_jax.reproduce.records import from_measured, simulated
from rotflex_jax.reproduce.settings import linear_joint, machine_rows, symmetric_twin
from rotflex_jax.runtime import xla

SHORT = {"samples": 1500, "held_out": 800, "runs": 2, "step": 0.005}


def quiet(step: str) -> None:
    pass


@pytest.fixture(scope="module")
def short() -> Reproduction:
    return reproduce(Settings(**SHORT))


# Settings -------------------------------------------------------------------------------------------


def test_every_setting_says_where_it_comes_from_and_why() -> None:
    rows = Settings.table()
    assert {row["source"] for row in rows} == {"paper", "assumption", "numerics"}
    assert all(len(row["why"]) > 10 or row["source"] == "paper" for row in rows)
    # Settings that the paper does not give must be marked as assumptions.
    open_questions = {
        "Ts",
        "filter",
        "cutoff",
        "samples",
        "mu1",
        "mu2",
        "sign",
        "scenario",
        "coefficient",
        "seed",
    }
    assert {row["name"] for row in rows if row["source"] == "assumption"} >= open_questions
    json.dumps(rows)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"Ts": "0"}, "above 0"),
        ({"Ts": "soon"}, "number"),
        ({"memory": 5.5}, "whole number"),
        ({"memory": 1}, "at least 2"),
        ({"scenario": "S9"}, "S5p"),
        ({"filter": "brick"}, "butterworth"),
        ({"coefficient": "1,5"}, "0 to 4"),
        ({"coefficient": "1"}, "two lags"),
        ({"constant": "maybe"}, "True"),
        ({"samples": "inf"}, "whole number"),
        ({"cutof": 5}, "cutoff"),
        ({"filter": "butterworth", "cutoff": 6.0}, "half the sampling rate"),
        ({"pulse_width": 0.01}, "one sample"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_in_words(change: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Settings().replace(change)


def test_settings_are_read_from_text() -> None:
    s = Settings().replace(
        {"memory": "4", "coefficient": "2,1", "constant": "no", "Ts": "5e-2", "sign": "-1"}
    )
    assert (s.memory, s.coefficient, s.constant, s.Ts, s.sign) == (4, (1, 2), False, 0.05, -1)
    assert [row["name"] for row in s.rows() if row["changed"]] == [
        "sign",
        "Ts",
        "memory",
        "constant",
        "coefficient",
    ]


def test_numbers_of_the_machine_are_settings_too() -> None:
    s = Settings().replace({"hub.coulomb.level": "0.05", "input.voltage_offset.offset": 0.2})
    rows = {row["name"]: row for row in machine_rows(s)}
    changed = {name: row["value"] for name, row in rows.items() if row["changed"]}
    assert changed == {"hub.coulomb.level": 0.05, "input.voltage_offset.offset": 0.2}
    assert rows["hub.coulomb.level"]["source"] == "assumption"
    assert rows["hub.inertia.inertia"]["source"] == "paper"
    # The twin with symmetric friction has the same friction, and no offset at all.
    twin = symmetric_twin(s).named_values
    assert twin["hub.coulomb.level"] == 0.05
    assert "input.voltage_offset.offset" not in twin
    for change, word in (
        ({"hub.coulomb.level": -1.0}, "between 0"),
        ({"hub.glue.level": 1.0}, "hub.coulomb.level"),
    ):
        with pytest.raises(InputError, match=word):
            machine_rows(Settings().replace(change))


# Input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("filter", ["ar1", "butterworth", "fir"])
def test_variance_is_exactly_that_of_the_settings(filter: str) -> None:
    s = Settings(filter=filter, Ts=0.02, cutoff=5.0, variance=2.0)
    r = sources.autocovariance(s, 30)
    assert r[0] == pytest.approx(2.0, rel=1e-12)
    u = sources.filtered_noise(s, 60000, 3)
    effective = len(u) / (1 + 2 * np.sum((r / r[0]) ** 2))
    assert np.var(u) == pytest.approx(2.0, abs=4 * 2.0 * np.sqrt(2 / effective))
    sample = np.mean(u[:-4] * u[4:])
    assert sample == pytest.approx(r[4], abs=0.1)


def test_autocovariance_of_the_butterworth_filter_is_that_of_its_spectrum() -> None:
    from scipy.signal import butter, freqz

    s = Settings(filter="butterworth", Ts=0.02, cutoff=5.0)
    w = np.linspace(0, np.pi, 20001)
    power = np.abs(freqz(*butter(sources.BUTTERWORTH_ORDER, 5.0, fs=50.0), w)[1]) ** 2
    expected = [np.trapezoid(power * np.cos(k * w), w) for k in range(8)]
    np.testing.assert_allclose(sources.autocovariance(s, 8), np.array(expected) / expected[0], atol=1e-6)


# Least error of a short memory ----------------------------------------------------------------------


def test_least_error_of_five_samples_has_its_tabulated_values() -> None:
    s = Settings()
    intervals = np.array([0.001, 0.01, 0.02, 0.05, 0.1])
    white = models.least_nmse(s, linear_joint(s), intervals, white=True)
    np.testing.assert_allclose(white, [0.9986, 0.6581, 0.4463, 0.0682, 0.00054], atol=1e-4)
    coloured = models.least_nmse(s, linear_joint(s), intervals)
    np.testing.assert_allclose(coloured, [0.8559, 0.5805, 0.5319, 0.0596, 0.00055], atol=1e-4)


# Prediction and Figure 9 ----------------------------------------------------------------------------


def test_eigenvalue_of_white_input_is_two_for_a_square_and_one_for_a_product() -> None:
    s = Settings(cutoff=1e3)  # nearly white
    basis = Volterra(Delays(5))
    theory = moments(s, basis, simulated(dataclasses.replace(s, **(SHORT | {"runs": 1}))))
    square, product = (watched_index(Settings(coefficient=lags), basis) for lags in ((1, 1), (1, 2)))
    assert settling_eigenvalue(theory.R, basis.degrees, square) == pytest.approx(2.0)
    assert settling_eigenvalue(theory.R, basis.degrees, product) == pytest.approx(1.0)
    prediction = predict(s, basis.degrees, theory, square)
    assert prediction.step_sizes[2] == pytest.approx(2.14e-4, rel=2e-3)  # ln 20 / (7000 * 2)


def test_moments_from_the_filter_are_those_of_the_regressors() -> None:
    s = Settings(Ts=0.05, samples=40000, held_out=200, runs=1, scenario="S0", step=0.05)
    records, basis = simulated(s), Volterra(Delays(5))
    phi = basis.regressors(records.train[0].u)[10:]
    np.testing.assert_allclose(moments(s, basis, records).R, phi.T @ phi / len(phi), atol=0.15)


@pytest.mark.parametrize("lags", [(1, 1), (1, 2)])
def test_the_coefficient_settles_when_it_was_predicted_to(lags: tuple[int, int]) -> None:
    # A strong quadratic kernel, so that gradient noise does not hide the rise.
    s = Settings(
        scenario="S5s", samples=8000, held_out=200, runs=8, step=0.01, settle_at=3000, coefficient=lags
    )
    found = adapt(s, simulated(s), quiet)
    assert found.prediction.settle == pytest.approx(3000)
    assert found.settle == pytest.approx(3000, rel=0.1)
    assert settling(found.times, found.mean_path, found.target)[0] == pytest.approx(3000, rel=0.08)


def test_noise_about_zero_settles_nowhere() -> None:
    t = np.arange(0.0, 5000.0, 10.0)
    noise = 1e-5 * np.random.default_rng(0).standard_normal(len(t))
    assert settling(t, noise, 1e-5)[0] is None
    assert settling(t, noise, 0.0) == (None, None)


@pytest.mark.parametrize("transform", ["hermite", "gram_schmidt"])
def test_orthogonalised_regressors_lead_to_the_same_kernels(transform: str) -> None:
    s = Settings(
        scenario="S5s", transform=transform, samples=4000, held_out=200, runs=1, step=0.01, settle_at=500
    )
    found = adapt(s, simulated(s), quiet)
    assert found.status == "ok"
    assert found.paths[0, -1] == pytest.approx(found.target, rel=0.3)
    assert found.mean_path[-1] == pytest.approx(found.target, rel=0.01)


# Friction without a quadratic kernel ----------------------------------------------------------------


def test_symmetric_friction_has_no_quadratic_kernel_and_an_offset_has() -> None:
    u = sources.filtered_noise(Settings(), 1500, 4)
    basis = Volterra(Delays(5))

    def quadratic(name: str) -> np.ndarray:
        pair = [
            Recording(u=v, y=response(plant(name), v, 0.1, step=0.005)[:, 1], Ts=0.1, channels="alpha")
            for v in (u, -u)
        ]
        return least_squares(basis, pair, "alpha").weights[basis.degrees == 2]

    assert np.max(np.abs(quadratic("S1"))) < 1e-12
    assert np.max(np.abs(quadratic("S6"))) > 1e-3


# The pulse ------------------------------------------------------------------------------------------


def test_linearised_joint_on_the_pulse_of_the_symmetric_machine() -> None:
    s = Settings(scenario="S1", Ts=0.01, samples=200, held_out=200, runs=1, step=5e-4)
    row = linearised(simulated(s))
    assert row.pulses[0] == pytest.approx(0.0570, abs=2e-4)
    assert row.pulses[0] == pytest.approx(row.pulses[1], rel=1e-9)  # a symmetric machine


def test_within_the_pulse_every_model_of_five_samples_rests_on_its_plateau(short: Reproduction) -> None:
    for name in ("M=5 quadratic, LMS", "M=5 quadratic", "M=5 linear"):
        row = short.row(name)
        kernels = row.series.kernels()
        for pulse, answer in zip(short.records.pulses, row.pulse_hat, strict=True):
            A = pulse.height
            law = kernels[0] + A * np.sum(kernels[1]) + A**2 * np.sum(kernels.get(2, 0.0))
            inside = answer[5 + 4 : 5 + 10]  # the pulse begins at sample 5 and lasts 10
            np.testing.assert_allclose(inside, law, rtol=1e-9, atol=1e-15)
            np.testing.assert_allclose(answer[5 + 10 + 4 :], kernels[0], atol=1e-15)


# Errors ---------------------------------------------------------------------------------------------


def test_errors_of_the_table_are_those_of_plain_least_squares(short: Reproduction) -> None:
    train, test = short.records.train[0], short.records.test[0]

    def columns(u: np.ndarray, quadratic: bool) -> np.ndarray:
        lags = np.stack([np.concatenate([np.zeros(k), u[: len(u) - k]]) for k in range(5)], axis=1)
        i, j = np.triu_indices(5)
        parts = [np.ones((len(u), 1)), lags] + ([lags[:, i] * lags[:, j]] if quadratic else [])
        return np.hstack(parts)

    for name, quadratic in (("M=5 linear", False), ("M=5 quadratic", True)):
        n = train.n_init
        w = np.linalg.lstsq(columns(train.u, quadratic)[n:], train.channel("alpha")[n:])[0]
        y, y_hat = test.channel("alpha")[n:], (columns(test.u, quadratic) @ w)[n:]
        expected = np.sum((y - y_hat) ** 2) / np.sum((y - y.mean()) ** 2)
        assert short.row(name).held_out == pytest.approx(expected, rel=1e-6)


def test_the_paper_s_weights_come_from_the_plain_recursion(short: Reproduction) -> None:
    a, train = short.adaptation, short.records.train[0]
    phi = Volterra(Delays(5)).regressors(train.u)[train.n_init :]
    y, w, errors = train.channel("alpha")[train.n_init :], np.zeros(21), []
    for row, measured in zip(phi, y, strict=True):
        errors.append(measured - w @ row)
        w = w + a.prediction.mu * errors[-1] * row
    np.testing.assert_allclose(a.model.weights, w, rtol=1e-9, atol=1e-14)
    half = len(y) // 2
    assert a.online == pytest.approx(nmse([y[half:]], [y[half:] - np.array(errors)[half:]]))


def test_online_error_hides_what_the_frozen_weights_show() -> None:
    found = short_memory_errors(Settings(seed=2), N=6000)
    assert found.online < 0.8 * found.least_squares
    assert found.frozen > 1.05 * found.least_squares
    assert found.least_squares == pytest.approx(0.856, abs=0.08)  # the exact bound of a linear joint


def test_a_filter_that_runs_away_is_reported() -> None:
    s = Settings(mu2=0.2, **SHORT)
    found = adapt(s, simulated(s), quiet)
    assert found.status.startswith("diverged at sample")
    assert found.model is None
    assert not found.prediction.stability.stable


# The command ----------------------------------------------------------------------------------------


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            app.main(["reproduce", *map(str, arguments)])
        return left.value.code, *capsys.readouterr()

    yield run


def settings_as_options(settings: dict) -> list[str]:
    return [text for name, value in settings.items() for text in ("--set", f"{name}={value}")]


def test_command_writes_figures_page_and_numbers(
    run: Callable, tmp_path: Path, short: Reproduction, monkeypatch: pytest.MonkeyPatch
) -> None:
    def known(settings: Settings, *, joint: object, progress: Callable[[str], None]) -> Reproduction:
        assert settings == short.settings  # the options are passed on
        assert joint is None  # no recording to compare with
        progress("predicted")
        return short

    monkeypatch.setattr("rotflex_jax.reproduce.reproduce", known)
    out, file = tmp_path / "out", tmp_path / "result.json"
    status, shown, progress = run("--out", out, "--json", file, *settings_as_options(SHORT))
    assert status == 0, progress
    names = {"figure_07", "figure_08", "figure_09", "figure_10", "figure_11", "span", "trap", "kernels"}
    assert {p.stem for p in out.glob("*.png")} == names
    assert all(p.stat().st_size > 5000 for p in out.glob("*.png"))
    page = (out / "reproduce.html").read_text()
    for text in ("Figure 7.", "Figure 11.", "assumption", "M=5 quadratic, LMS", "linearised joint", "7000"):
        assert text in page
    rest = page.replace("http://www.w3.org", "")  # names of XML formats, which are not loaded
    assert "http:" not in rest and "https:" not in rest
    assert "M=5 quadratic, LMS" in shown
    assert "predicted" in progress
    result = json.loads(file.read_text())
    assert result == json.loads((out / "result.json").read_text())
    assert result["figure_9"]["predicted_settle"] == pytest.approx(7000)
    for row, expected in zip(result["models"], short.rows, strict=True):
        assert (row["name"], row["held_out_nmse"]) == (expected.name, expected.held_out)


def recorded(file: Path, seconds: float = 40.0, Ts: float = 0.02) -> Path:
    u = sources.filtered_noise(Settings(Ts=Ts), round(seconds / Ts), 5)
    y = response(plant("S1"), u, Ts, step=0.005)
    table = np.column_stack([Ts * np.arange(len(u)), u, y])
    np.savetxt(file, table, delimiter=",", header="t,voltage,theta,alpha", comments="", fmt="%.9g")
    return file


def test_recordings_take_the_place_of_the_simulation(run: Callable, tmp_path: Path) -> None:
    file, out = recorded(tmp_path / "run.csv"), tmp_path / "out"
    status, shown, progress = run("--data", file, "--out", out, "--json", "-")
    assert status == 0, progress
    result = json.loads(shown)
    assert result["data"]["measured"]
    assert "pulse" not in shown.split('"models"')[1].replace('"pulse_nmse": {}', "")
    assert "No pulse was recorded" in (out / "reproduce.html").read_text()
    # The same decimation by hand: every fifth sample and the mean of the voltage, from each of five starts.
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    u, alpha = table[:, 1], table[:, 3]

    def rows(u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        phi, out = [], []
        for start in range(5):
            groups = (len(u) - 4) // 5  # as many from each start
            v, z = u[start : start + 5 * groups].reshape(groups, 5).mean(1), y[start::5][:groups]
            lags = np.stack([v[4 - k : groups - k] for k in range(5)], axis=1)
            phi.append(np.hstack([np.ones((groups - 4, 1)), lags]))
            out.append(z[4:])
        return np.vstack(phi), np.concatenate(out)

    cut = round(0.7 * len(u))
    (phi, y), (phi_test, y_test) = rows(u[:cut], alpha[:cut]), rows(u[cut:], alpha[cut:])
    y_hat = phi_test @ np.linalg.lstsq(phi, y)[0]
    linear = next(row for row in result["models"] if row["name"] == "M=5 linear")
    assert linear["held_out_nmse"] == pytest.approx(nmse([y_test], [y_hat]), rel=1e-5)


def test_equations_with_friction_take_their_place_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = plant("S1").without("dead_zone", "input")
    u = sources.filtered_noise(Settings(Ts=0.02), 2000, 6)
    train, test = Recording(u=u, y=response(machine, u, 0.02, step=0.005), Ts=0.02).split(0.7)
    records = from_measured(Settings(), [train], [test], linear_joint(Settings()))

    def true_fit(model: Model, parts: list[Recording]) -> SimpleNamespace:
        added = {(e.name, e.at) for e in model.mechanism.effects[-3:]}
        assert added == {("coulomb", "hub"), ("coulomb", "joint"), ("voltage_offset", "input")}
        assert [part.duration for part in parts] == [pytest.approx(28.0)]  # all of it, before decimation
        return SimpleNamespace(model=Model(machine, Exponential(substeps=4)))

    monkeypatch.setattr("rotflex_jax.reproduce.models.fit", true_fit)
    row = grey_box(records, quiet)
    # The remaining error comes from the first state, which is estimated from ten samples.
    assert row.held_out < 1e-4 < linearised(records).held_out / 100
    # Both outputs are decimated like the recording, to the same samples.
    assert [len(y) for y in row.y_hat] == [r.N for r in records.test] == [len(y) for y in records.linearised]
    one = {"channels": ("alpha",), "units": ("rad",), "resolution": {}}
    alone = [dataclasses.replace(r, y=r.y[:, 1:], **one) for r in (train, test)]
    lacking = from_measured(Settings(), [alone[0]], [alone[1]], linear_joint(Settings()))
    assert grey_box(lacking, quiet) is None


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--data", "nowhere.csv"), "does not exist"),
        (("--set", "Ts"), "name and a value"),
        (("--set", "colour=red"), "no setting"),
        (("--set", "hub.coulomb.level=rough"), "number"),
        (("--set", "hub.glue.level=1"), "hub.coulomb.level"),
        (("--scenario", "S99"), "S5s"),
        (("--set", "Ts=-1"), "above 0"),
        (("--Ts", "0.002"), "--set Ts=0.002"),
        (("--held-out", "b.csv"), "without --data"),
        (("--split", "0.5"), "--split was given without --data"),
        (("--joint", "quanser_2002"), "--joint was given without --data"),
        (("--degrees",), "how to read a file was given without --data"),
        (("--split", "2", "--data", "a.csv"), "between 0 and 1"),
        (("--split", "0.5", "--data", "rotflex"), "the second is held out"),
        (("--degrees", "--data", "rotflex"), "its files are read as they need"),
        (("--joint", "rigid"), "joint"),
        (("--nonsense",), "--help"),
    ],
)
def test_bad_arguments_end_with_one_sentence(run: Callable, arguments: tuple[str, ...], word: str) -> None:
    status, shown, error = run(*arguments)
    assert status == 2
    assert word in error
    assert error.startswith("rotflex: ")
    assert error.count("\n") == 1
    assert not shown


def test_recordings_that_do_not_fit_are_refused(run: Callable, tmp_path: Path) -> None:
    file, out = recorded(tmp_path / "run.csv", seconds=3.0), tmp_path / "out"
    for arguments, word in (
        (("--data", file), "longer recording"),
        (("--data", file, "--set", "Ts=0.03"), "multiple"),
        (("--data", file, "--set", "Ts=0.001"), "multiple of that; give --set Ts="),
        (("--data", file, "--output", "theta"), "deflection"),
        (("--data", file, "--data", file), "twice"),
        (("--data", file, "--out", file), "folder"),
    ):
        status, _, error = run("--out", out, *arguments)
        assert (status, error.count("\n")) == (2, 1), error
        assert word in error
    assert not out.exists()


def test_list_of_settings(run: Callable) -> None:
    status, shown, _ = run("--list")
    assert status == 0
    assert all(row["name"] in shown for row in Settings.table())
