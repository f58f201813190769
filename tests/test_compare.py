"""Comparison of methods: runs without held-out outputs, their errors, and failures as rows of the table."""

import dataclasses
import functools
import json
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.cli import app
from rotflex_jax.compare import ARX, METHODS, QUICK, Comparison, Fitted, Method, physics, register
from rotflex_jax.compare.arx import DifferenceEquation, fit_difference_equation
from rotflex_jax.compare.method import divergence_reason, hide_outputs, windowed_runs
from rotflex_jax.compare.series import ChannelSeries
from rotflex_jax.discover import Discovery
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime import xla

FITTED = ("textbook", "linear", "grey_box", "grey_box_predictor", "arx")


def recorded(seconds: float = 4.0, seed: int = 1) -> Recording:
    """A joint with dry friction at the hub."""
    made = make_record([("coulomb", "hub")], seconds=seconds, seed=seed)
    return Recording(u=made["u"], y=made["y"], Ts=made["Ts"])


def with_outputs(recording: Recording, y: np.ndarray) -> Recording:
    return dataclasses.replace(recording, y=y, accept=("constant", "saturated", "units"))


def scrambled(recording: Recording, start: int) -> Recording:
    """The recording with random outputs from sample `start` on."""
    y = recording.y.copy()
    y[start:] = np.random.default_rng(0).normal(0.0, 0.3, y[start:].shape)
    return with_outputs(recording, y)


@dataclasses.dataclass(frozen=True)
class Told:
    """A method whose fit and simulation are given as functions."""

    name: str
    run: Callable[[Recording], np.ndarray] | None = None
    learn: Callable[[Sequence[Recording]], None] | None = None
    title: str = "told what to do"

    def fit(self, model: Model, train: Sequence[Recording], say: Callable) -> Fitted:
        if self.learn is not None:
            self.learn(train)
        assert self.run is not None
        return Fitted(SimpleNamespace(simulate=self.run), parameters=0)


def level(recording: Recording) -> np.ndarray:
    return np.tile(recording.y[0], (recording.N, 1))


@pytest.fixture(scope="module")
def table() -> Comparison:
    friction = rf.effects.Coulomb(at="hub", level=0.01)
    return rf.compare(recorded(), FITTED, mechanism=rf.joints.paper() + friction)


def test_the_right_structure_reaches_the_noise_and_the_others_do_not(table: Comparison) -> None:
    assert {row.status for row in table.rows} == {"ok"}
    for name in ("grey_box", "grey_box_predictor"):
        for channel, noise in table.noise_floor.items():
            assert table[name].rmse[channel] < 1.1 * noise
            assert table[name].rmse_windows[channel] < 1.1 * noise
    for name in ("textbook", "linear", "arx"):
        for channel, noise in table.noise_floor.items():
            assert table[name].rmse[channel] > 4 * noise
            assert table[name].worst[channel] > table[name].rmse[channel]
            assert table[name].fit_percent[channel] < table["grey_box"].fit_percent[channel] < 100
    assert table.best is table.rows[0]
    assert table.best.method in ("grey_box", "grey_box_predictor")
    scores = [row.score for row in table.rows]
    assert scores == sorted(scores)


def test_numbers_are_counted_and_what_is_left_out_is_named(table: Comparison) -> None:
    counts = {row.method: row.parameters for row in table.rows}
    order = int(table["arx"].note.removeprefix("order "))
    assert counts == {
        "textbook": 0,
        "linear": 5,
        "grey_box": 6,
        "grey_box_predictor": 6,
        "arx": 2 * 3 * order,
    }
    assert table["linear"].note == "without coulomb at hub"
    linear = table["linear"].simulator
    assert isinstance(linear, Model)
    assert "coulomb" not in {e.name for e in linear.mechanism.effects}


@pytest.mark.parametrize("name", FITTED)
def test_no_method_uses_what_it_may_not_look_at(name: str, table: Comparison) -> None:
    (test,), simulator = table.test, table[name].simulator
    assert simulator is not None
    y_hat = simulator.simulate(test)
    np.testing.assert_array_equal(simulator.simulate(scrambled(test, test.n_init)), y_hat)
    np.testing.assert_array_equal(table[name].simulated[0], y_hat)
    # Samples that it may use change its run; otherwise the comparison above would prove nothing.
    assert not np.allclose(simulator.simulate(scrambled(test, test.n_init // 2)), y_hat)


def test_errors_are_those_of_the_metrics_on_the_same_free_run(table: Comparison) -> None:
    (test,), row = table.test, table["linear"]
    assert row.rmse == pytest.approx(rf.metrics.rmse(test, row.simulated[0]))
    assert row.nrmse == pytest.approx(rf.metrics.nrmse(test, row.simulated[0]))
    assert row.fit_percent == pytest.approx(rf.metrics.fit_percent(test, row.simulated[0]))
    assert row.worst == pytest.approx(rf.metrics.max_error(test, row.simulated[0]))


def test_windows_start_again() -> None:
    """Errors over windows are those of free runs that start again in each window."""
    table = rf.compare(recorded(7.0), ["textbook"], window_seconds=1.0)
    (test,), row = table.test, table["textbook"]
    assert (test.N, test.n_init) == (1050, 100)
    model = Model(rf.joints.paper())
    # The last 0.1 s belong to the second window. First states are estimated in each window separately.
    windowed = [model.simulate(test.slice(i, j)) for i, j in ((0, 500), (500, 1050))]
    evaluated = np.r_[100:500, 600:1050]
    expected = np.sqrt(np.mean((np.concatenate(windowed) - test.y)[evaluated] ** 2, axis=0))
    assert list(row.rmse_windows.values()) == pytest.approx(expected.tolist())
    assert row.rmse_windows["theta"] < row.rmse["theta"]


def test_a_window_has_the_voltage_of_the_whole_recording() -> None:
    """The plant is a joint whose voltage the test shifts by 25 samples; its outputs have noise of 0.1 mrad.

    Windowed runs of a model with this delay reach the noise.
    """
    Ts, late, noise = 0.004, 25, 1e-4
    rng, parts = np.random.default_rng(3), []
    for N in (1500, 1500):
        u = np.convolve(rng.normal(size=N), np.ones(20) / 4, mode="same")
        y = simulate(rf.joints.paper(), np.concatenate([np.full(late, u[0]), u[:-late]]), Ts)
        parts.append(Recording(u=u, y=y + noise * rng.normal(size=y.shape), Ts=Ts, accept=("units",)))
    joint = rf.joints.paper() + rf.effects.Delay(time=late * Ts)
    table = rf.compare(parts[0], ["textbook"], mechanism=joint, test=parts[1], window_seconds=1.0)
    row, (test,) = table["textbook"], table.test
    for channel, error in row.rmse_windows.items():
        assert error < 2 * noise, channel
        assert max(row.horizon.rmse[channel]) < 3 * noise, channel
    # The same error as in a search, which uses `simulate_windows` of the model.
    run = Model(joint).simulate_windows(test, 1.0)
    short = rf.metrics.windowed_rmse([test], [test.y], [run], 1.0)
    assert list(row.rmse_windows.values()) == pytest.approx(short.tolist())


def test_windows_are_blind_and_those_of_a_black_box_recordings_by_themselves() -> None:
    """A simulator gets only the first `n_init` outputs of each window.

    One without `simulate_windows` gets each window as a separate recording.
    """
    test, shown = recorded(2.0), []

    def run(recording: Recording, seconds: float | None = None) -> np.ndarray:
        shown.append(recording.y)
        return level(recording)

    assert 50 < test.n_init < 125
    (alone,) = windowed_runs(SimpleNamespace(simulate=run), [test], 0.5)
    assert [len(y) for y in shown] == [250] * 4
    np.testing.assert_array_equal(alone, np.repeat(test.y[::250], 250, axis=0))
    cut = np.concatenate(shown)
    shown.clear()
    windowed_runs(SimpleNamespace(simulate=run, simulate_windows=run), [test], 0.5)
    for y in (cut, *shown):
        by_window, measured = y.reshape(4, 250, 2), test.y.reshape(4, 250, 2)
        np.testing.assert_array_equal(by_window[:, : test.n_init], measured[:, : test.n_init])
        assert not np.ptp(by_window[:, test.n_init - 1 :], axis=1).any()


def test_a_method_cannot_cheat() -> None:
    cheat = Told("cheat", run=lambda recording: recording.y)
    table = rf.compare(recorded(), [cheat])
    assert table["cheat"].rmse["theta"] > 100 * table.noise_floor["theta"]
    seen = hide_outputs(table.test[0])
    m = seen.n_init
    np.testing.assert_array_equal(seen.y[:m], table.test[0].y[:m])
    assert np.ptp(seen.y[m:], axis=0).tolist() == [0, 0]


def test_a_series_finds_the_input_before_its_recording_from_the_first_outputs() -> None:
    """Reference: a convolution in numpy with an input that was constant before the recording."""
    basis, rng = Volterra(Delays(20), order=1), np.random.default_rng(2)
    weights = np.append(0.0, 0.8 ** np.arange(20.0))  # of the constant, then of each delay
    u = np.append(np.ones(100), rng.normal(size=60))
    y = np.convolve(u, weights[1:])[: len(u)]
    series = ChannelSeries(basis, weights, False, 0.01, noise=1e-6, mean=0.0, spread=1.0)
    # Without the past, samples after these outputs miss up to 0.5; its prior leaves a little.
    np.testing.assert_allclose(series.simulate(u[100:], y[100:110]), y[100:], atol=0.03)


@pytest.mark.parametrize(("ranges", "diverges"), [(99.0, False), (101.0, True)])
def test_a_run_diverges_a_hundred_ranges_from_its_start(ranges: float, diverges: bool) -> None:
    whole = recorded()
    run = np.tile(whole.y[: whole.n_init].mean(axis=0), (whole.N, 1)).astype(float)
    run[250:, 1] -= ranges * 0.3
    reason = divergence_reason([run], [whole], np.array([0.5, 0.3]))
    assert ("100 times" in reason and f"after {250 * whole.Ts:.3g} s" in reason) is diverges


def test_what_goes_wrong_is_a_row() -> None:
    def refuse(train: Sequence[Recording]) -> None:
        raise ArithmeticError("the matrix\nhas no inverse")

    growing = np.array([[[1.5, 0.0]], [[0.0, 1.5]]])
    unstable = DifferenceEquation(A=growing, B=np.ones((2, 1, 1)), Ts=0.002)
    table = rf.compare(
        recorded(),
        [
            Told("broken", learn=refuse),
            Told("unstable", run=unstable.simulate),
            Told("nowhere", run=lambda r: np.full(r.y.shape, np.nan)),
            Told("short", run=lambda r: r.y[1:]),
            Told("level", run=level),
        ],
    )
    assert table.best is not None and table.best.method == "level"
    assert table["broken"].status == table["short"].status == "failed"
    assert table["broken"].reason == "ArithmeticError: the matrix has no inverse"
    assert "shape" in table["short"].reason
    assert table["unstable"].status == table["nowhere"].status == "diverged"
    assert "after" in table["unstable"].reason
    for text in ("broken: failed: ArithmeticError", "unstable: diverged", "level"):
        assert text in str(table)
    rows = {row["method"]: row for row in json.loads(json.dumps(table.to_dict(), allow_nan=False))["rows"]}
    assert rows["nowhere"]["held_out_rmse"] == {"theta": None, "alpha": None}
    assert rows["broken"]["held_out_rmse"] == {}
    assert rows["level"]["status"] == "ok"


def test_all_wrong_has_no_best() -> None:
    table = rf.compare(recorded(), [Told("nowhere", run=lambda r: np.full(r.y.shape, np.inf))])
    assert table.best is None
    assert table.to_dict()["best"] is None


def test_json(table: Comparison) -> None:
    told = json.loads(json.dumps(table.to_dict(), allow_nan=False))
    assert told["schema"] == 1
    assert told["best"] == table.rows[0].method
    assert told["noise_floor"] == table.noise_floor
    assert [r["samples"] for r in (*told["train"], *told["test"])] == [1400, 600]
    for row in told["rows"]:
        assert row["status"] == "ok"
        assert row["held_out_rmse"] == table[row["method"]].rmse
        assert set(row["held_out_rmse_windows"]) == {"seconds", "theta", "alpha"}
        assert row["fit_seconds"] >= 0 < row["simulate_seconds"]


def test_the_table_is_read_in_degrees(table: Comparison) -> None:
    lines = str(table).splitlines()
    assert "[deg]" in lines[1]
    row = next(line for line in lines if line.startswith("linear"))
    assert f"{np.rad2deg(table['linear'].rmse['theta']):.3g}" in row
    assert lines[2].split()[0] == table.rows[0].method


def test_discovered_chooses_within_the_training_data(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fake(
        model: Model, train: list[Recording], test: list[Recording], progress: Callable
    ) -> SimpleNamespace:
        asked.append((train, test))
        return SimpleNamespace(
            verdict="unexplained",
            added=(("coulomb", "hub"),),
            model=model + rf.effects.Coulomb(at="hub", level=0.01),
        )

    monkeypatch.setattr(physics, "discover", fake)
    record = recorded()
    table = rf.compare(record, ["discovered"])
    (((first,), (last,)),) = asked
    boundary = record.duration * 0.7
    assert first.start + first.duration == pytest.approx(last.start)
    assert last.start + last.duration == pytest.approx(boundary)
    assert table.test[0].start == pytest.approx(boundary)
    row = table["discovered"]
    assert (row.note, row.parameters) == ("added Coulomb friction at hub", 6)
    assert row.rmse["theta"] < 1.1 * table.noise_floor["theta"]


@pytest.mark.slow
def test_discovered_finds_what_the_grey_box_lacks(monkeypatch) -> None:
    # Four candidates only: tests of the search itself use all candidates.
    fx = rf.effects
    pairs = [
        (fx.Coulomb, "hub"),
        (fx.QuadraticDrag, "hub"),
        (fx.CubicSpring, "joint"),
        (fx.DeadZone, "input"),
    ]
    monkeypatch.setattr(physics, "discover", functools.partial(physics.discover, candidates=pairs))
    table = rf.compare(recorded(6.0), ["grey_box", "discovered"])
    assert table.best is table["discovered"]
    assert "at hub" in table["discovered"].note
    for channel, noise in table.noise_floor.items():
        assert table["discovered"].rmse[channel] < 1.5 * noise
        assert table["grey_box"].rmse[channel] > 3 * noise


def test_least_squares_finds_the_equation_behind_clean_data() -> None:
    truth = DifferenceEquation(
        A=np.array([[[-0.8, 0.1], [1.6, 0.0]], [[0.0, -0.7], [0.2, 1.3]]]),
        B=np.array([[[0.1, 0.5], [0.2, 0.0]], [[0.0, -0.1], [-0.3, 0.4]]]),
        Ts=0.01,
        signals=("wind",),
    )
    u, wind = np.random.default_rng(0).normal(size=(2, 400))
    blank = Recording(u=u, y=np.zeros((400, 2)), Ts=0.01, accept=("constant",), signals={"wind": wind})
    m = blank.n_init  # the samples before are measured, not computed by the equation
    record = Recording(u=u[m:], y=truth.simulate(blank)[m:], Ts=0.01, signals={"wind": wind[m:]})
    found = fit_difference_equation([record], 2)
    np.testing.assert_allclose(found.A, truth.A, atol=1e-10)
    np.testing.assert_allclose(found.B, truth.B, atol=1e-10)
    table = rf.compare(record, [ARX(orders=(1, 2))])
    assert table["arx"].note == "order 2"
    assert table["arx"].rmse["theta"] < 1e-9
    with pytest.raises(rf.InputError, match="signal 'wind' is needed, but the recording has none"):
        found.simulate(record.with_signals({}))


def test_an_equation_that_looks_back_too_far_is_refused() -> None:
    table = rf.compare(recorded(), [ARX(orders=(400,))])
    assert table["arx"].status == "failed"
    assert "n_init" in table["arx"].reason


def test_channels_are_those_of_the_mechanism_in_its_order() -> None:
    record = recorded()
    wider = Recording(
        u=record.u,
        y=np.c_[record.y[:, ::-1], np.cos(record.t)],
        Ts=record.Ts,
        channels=("alpha", "theta", "current"),
        units=("rad", "rad", "A"),
    )
    methods = ["textbook", ARX(orders=(8,))]
    tables = [rf.compare(r, methods) for r in (record, wider)]
    assert tables[1].test[0].channels == ("theta", "alpha")
    for name in ("textbook", "arx"):
        assert tables[0][name].rmse == pytest.approx(tables[1][name].rmse)


def test_several_recordings_and_files_of_their_own_to_judge_on() -> None:
    a, b, c = (recorded(3.0, seed) for seed in (1, 2, 3))
    methods = ["textbook", ARX(orders=(8,))]
    table = rf.compare([a, b], methods, test=c, window_seconds=1.0)
    assert table.test[0] is c
    assert table["arx"].simulated[0].shape == c.y.shape
    split = rf.compare([a, b], methods, fraction=0.6)
    assert [r.N for r in (*split.train, *split.test)] == [900, 900, 600, 600]
    both = [
        e
        for r, y_hat in zip(split.test, split["arx"].simulated, strict=True)
        for e in (r.y - y_hat)[r.n_init :]
    ]
    assert list(split["arx"].rmse.values()) == pytest.approx(np.sqrt(np.mean(np.square(both), axis=0)))


def test_a_recording_in_degrees_is_refused_before_any_method_learns() -> None:
    recording, learned = recorded(), []
    turned = dataclasses.replace(
        recording, y=np.rad2deg(recording.y), units=("deg", "deg"), accept=("units",)
    )
    with pytest.raises(rf.InputError, match="in deg, but the output theta of the model is in rad"):
        rf.compare(turned, [Told("level", level, learned.append)])
    assert not learned


@pytest.mark.parametrize(
    ("methods", "given", "phrase"),
    [
        (["grey_bx"], {}, "did you mean grey_box"),
        (["textbook", "zzz"], {}, "choose from textbook"),
        ([], {}, "No method"),
        ([3], {}, "fit"),
        ([Told("a", run=level), Told("a")], {}, "'a'"),
        (["textbook"], {"fraction": 1.5}, "split"),
        (["textbook"], {"fraction": 0.5, "test": recorded(2.0)}, "fraction"),
        (["textbook"], {"test": []}, "No recording"),
        (["textbook"], {"mechanism": rf.joints.single_inertia()}, "channels"),
    ],
)
def test_what_cannot_be_compared_is_refused(methods: list, given: dict, phrase: str) -> None:
    record = recorded(2.0)
    if "mechanism" in given:
        record = Recording(u=record.u, y=record.y, Ts=record.Ts, channels=("a", "b"))
    with pytest.raises(rf.InputError, match=phrase):
        rf.compare(record, methods, **given)


def test_a_recording_is_not_evaluated_on_itself() -> None:
    record = recorded(2.0)
    with pytest.raises(rf.InputError, match="proves nothing"):
        rf.compare(record, ["textbook"], test=record)


def test_a_registered_method_takes_part() -> None:
    mine = Told("mine", run=level)
    assert isinstance(mine, Method)
    try:
        assert register(mine) is mine
        assert rf.compare(recorded(2.0), "mine")["mine"].status == "ok"
        with pytest.raises(rf.InputError, match="already"):
            register(Told("mine"))
        with pytest.raises(rf.InputError, match="nobody"):
            rf.compare(recorded(2.0), "mine")["nobody"]
    finally:
        METHODS.pop("mine", None)
    assert list(METHODS)[:4] == ["textbook", "linear", "grey_box", "grey_box_predictor"]
    assert set(QUICK) < set(METHODS)


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """The command line in this process: exit status, stdout, stderr."""
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            app.main([str(argument) for argument in arguments])
        assert isinstance(left.value.code, int)
        return left.value.code, *capsys.readouterr()

    return run


def test_the_command_line(run, tmp_path) -> None:
    record, file = recorded(2.0), tmp_path / "run.csv"
    columns = np.c_[record.t, record.u, record.y]
    np.savetxt(file, columns, delimiter=",", header="t,voltage,theta,alpha", comments="")
    line = "compare", file, "--methods", "textbook, arx"
    status, out, err = run(*line, "--json", tmp_path / "c.json")
    assert status == 0
    told = json.loads((tmp_path / "c.json").read_text())
    assert {row["method"] for row in told["rows"]} == {"textbook", "arx"}
    assert "theta" in out and "arx: order" in out and "learning" in err
    status, out, _ = run(*line, "--json", "-", "--split", 0.5)
    assert (status, [r["samples"] for r in json.loads(out)["test"]]) == (0, [500])
    for bad, word in (("textbook,gray_box", "grey_box"), ("", "textbook")):
        status, out, err = run("compare", file, "--methods", bad)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert word in err


def test_the_functions_are_found_beside_the_packages_of_their_name() -> None:
    assert callable(rf.compare) and callable(rf.discover)
    assert Comparison is rf.Comparison and Discovery is rf.Discovery
