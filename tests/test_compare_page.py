"""Output of a comparison: errors by horizon and one step ahead, tables, figures, page, command line."""

import dataclasses
import json
import re
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.cli import app
from rotflex_jax.compare import Comparison, Fitted
from rotflex_jax.compare.method import errors_by_horizon, horizon_segments
from rotflex_jax.compare.page import drawn, horizons, overlays, ranks, spectra
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime import xla


def recorded(N: int = 1200, seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(N)
    y = np.column_stack([0.3 * np.sin(2 * t), 0.05 * np.sin(9 * t)])
    return Recording(u=np.cos(2 * t), y=y + 1e-3 * rng.normal(size=y.shape), Ts=0.01, source="<made & up>")


@dataclasses.dataclass(frozen=True)
class Drifts:
    """A method whose free run has an error that grows with the time since the last sample it may use."""

    name: str
    slope: float
    family: str = "other"
    title: str = "drifts"

    def fit(self, model: Model, train: Sequence[Recording], say: object) -> Fitted:
        def simulate(r: Recording) -> np.ndarray:
            ahead = np.maximum(np.arange(r.N) - r.n_init + 1, 0) * r.Ts
            return (
                np.column_stack([0.3 * np.sin(2 * r.t), 0.05 * np.sin(9 * r.t)]) + self.slope * ahead[:, None]
            )

        def predict(r: Recording) -> np.ndarray:
            return np.concatenate([r.y[:1], r.y[:-1]]) + self.slope

        return Fitted(SimpleNamespace(simulate=simulate), 3, f"slope {self.slope:g}", predict)


@dataclasses.dataclass(frozen=True)
class Fails:
    name: str = "fails"
    title: str = "<b>always</b> fails"

    def fit(self, model: Model, train: Sequence[Recording], say: object) -> Fitted:
        raise ArithmeticError("no inverse")


@pytest.fixture(scope="module")
def table() -> Comparison:
    methods = [
        Drifts("slow", 0.01, "series"),
        Drifts("fast", 1.0, "linear"),
        Drifts("slower", 0.05, "series"),
        Fails(),
    ]
    return rf.compare(recorded(), methods)


def test_error_grows_with_the_horizon_as_it_was_made_to(table: Comparison) -> None:
    told = table["fast"].horizon
    assert told is not None
    ends = np.round(np.array(told.seconds) / 0.01).astype(int)
    for channel, noise in table.noise_floor.items():
        starts = np.concatenate([[0], ends[:-1]])
        expected = [
            np.sqrt(np.mean((0.01 * np.arange(a + 1, b + 1)) ** 2)) for a, b in zip(starts, ends, strict=True)
        ]
        np.testing.assert_allclose(told.rmse[channel], expected, atol=5 * noise)
    assert told.seconds[-1] == pytest.approx(table.window_seconds)
    (test,) = table.test
    assert told.runs == len(horizon_segments([test], table.window_seconds)) > 3


def test_horizons_of_recordings_of_several_sampling_periods() -> None:
    """The drift of 1 rad/s, of which each recording shows the part within the interval."""
    fine, coarse = recorded(), recorded(2400, seed=1).decimate(2)
    fitted = Drifts("fast", 1.0).fit(Model(rf.joints.paper()), [fine], print)

    def expected(Ts: float, ends: np.ndarray) -> np.ndarray:
        counts = np.round(ends / Ts).astype(int)
        starts = np.concatenate([[0], counts[:-1]])
        return np.array(
            [np.mean((Ts * np.arange(a + 1, b + 1)) ** 2) for a, b in zip(starts, counts, strict=True)]
        )

    for order in ((fine, coarse), (coarse, fine)):
        told = errors_by_horizon(fitted.simulator, order, 2.0)
        assert told.seconds[-1] == pytest.approx(2.0)
        ends = np.array(told.seconds)
        parts = horizon_segments(order, 2.0)
        share = np.mean([r.Ts == 0.01 for r in parts])
        squares = share * expected(0.01, ends) + (1 - share) * expected(0.02, ends)
        np.testing.assert_allclose(told.rmse["theta"], np.sqrt(squares), atol=5e-3)


def test_a_free_run_cannot_look_ahead_at_any_horizon() -> None:
    test = recorded()
    cheat = SimpleNamespace(simulate=lambda r: r.y)
    told = errors_by_horizon(cheat, [test], 2.0)
    assert min(told.rmse["theta"][5:]) > 1e-2


def test_one_step_ahead_is_told_apart(table: Comparison) -> None:
    """Errors of one-step predictions are reported beside those of free runs."""
    (test,), row = table.test, table["slow"]
    e = test.y[test.n_init :] - test.y[test.n_init - 1 : -1] - 0.01
    assert list(row.rmse_one_step.values()) == pytest.approx(np.sqrt(np.mean(e**2, axis=0)).tolist())
    rows = {r["method"]: r for r in json.loads(json.dumps(table.to_dict(), allow_nan=False))["rows"]}
    assert rows["slow"]["held_out_rmse_one_step"] == row.rmse_one_step
    assert rows["slow"]["horizon"]["runs"] == row.horizon.runs  # type: ignore[union-attr]
    assert rows["fails"]["horizon"] is None
    assert table.best is table["slow"]


def test_the_best_of_each_family(table: Comparison) -> None:
    assert [row.method for row in table.best_of_each_family] == ["slow", "fast"]


def test_markdown_has_a_row_for_each_method_and_a_line_for_each_failure(table: Comparison) -> None:
    lines = table.to_markdown().splitlines()
    counts = {line.count("|") for line in lines if line.startswith("|")}
    assert len(counts) == 1
    assert [line.split("|")[1].strip() for line in lines[2:6]] == ["slow", "slower", "fast", "sensor noise"]
    assert "- fails: failed: ArithmeticError: no inverse" in lines


def test_a_frame_has_the_numbers_of_the_rows(table: Comparison) -> None:
    pytest.importorskip("pandas")
    frame = table.to_frame()
    assert frame.loc["slow", "rmse_theta"] == table["slow"].rmse["theta"]
    assert frame.loc["fails", "status"] == "failed"
    assert frame.loc["fast", "worst_alpha"] == table["fast"].worst["alpha"]


def test_a_noise_far_below_all_errors_does_not_stretch_the_ranks(table: Comparison) -> None:
    quiet = dataclasses.replace(table, noise_floor={c: 1e-9 * v for c, v in table.noise_floor.items()})
    for figure, off in ((ranks(table), False), (ranks(quiet), True)):
        for ax in figure.axes:
            assert any("off to the left" in t.get_text() for t in ax.texts) is off
            assert any(line.get_label() == "sensor noise" for line in ax.get_lines()) is not off


def test_every_axis_has_a_unit(table: Comparison) -> None:
    for figure in (overlays(table), spectra(table), horizons(table), ranks(table), table.plot()):
        labels = [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]
        assert labels and all(re.search(r"\[.+\]", text) for text in labels)
    drawn = {line.get_label() for ax in overlays(table).axes for line in ax.get_lines()}
    assert {"measured", "slow (series)", "fast (linear)"} <= drawn
    assert "slower (series)" not in drawn


def test_the_page_is_complete_and_safe(table: Comparison, tmp_path) -> None:
    page = table.report(tmp_path / "new")
    text = page.read_text(encoding="utf-8")
    assert page.name == "comparison.html"
    for word in (
        "slow",
        "fast",
        "slower",
        "no inverse",
        "&lt;made &amp; up&gt;",
        "&lt;b&gt;always&lt;/b&gt; fails",
    ):
        assert word in text
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text
    assert text.count("<img") == 4
    told = json.loads((tmp_path / "new" / "comparison.json").read_text(encoding="utf-8"))
    assert told == json.loads(json.dumps(table.to_dict()))
    (tmp_path / "file").write_text("")
    with pytest.raises(rf.InputError, match="folder"):
        table.report(tmp_path / "file")


def test_a_page_where_every_method_failed(tmp_path) -> None:
    text = rf.compare(recorded(), [Fails()]).report(tmp_path).read_text(encoding="utf-8")
    assert "No method gave a result" in text and "no inverse" in text


def test_the_command_writes_the_page(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(xla, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(xla, "enable_compilation_cache", lambda: None)
    record, file = recorded(600), tmp_path / "run.csv"
    columns = np.c_[record.t, record.u, record.y]
    np.savetxt(file, columns, delimiter=",", header="t,voltage,theta,alpha", comments="")
    line = ["compare", str(file), "--report", str(tmp_path / "page")]
    with pytest.raises(SystemExit) as left:
        app.main([*line, "--methods", "arx,subspace"])
    assert left.value.code == 0
    assert "comparison.html" in capsys.readouterr().out
    assert (tmp_path / "page" / "comparison.html").exists()
    with pytest.raises(SystemExit) as left:
        app.main([*line, "--methods", "arx", "--quick"])
    assert left.value.code == 2
    assert "--quick and --methods" in capsys.readouterr().err


def test_of_a_fast_signal_only_so_many_swings_are_drawn() -> None:
    t = 1e-3 * np.arange(5000)
    fast, slow = np.sin(2 * np.pi * 50 * t), np.sin(2 * np.pi * 0.5 * t)
    count = {name: drawn(Recording(u=y, y=y, Ts=1e-3)) for name, y in {"fast": fast, "slow": slow}.items()}
    assert count["slow"] == 5000
    assert count["fast"] == pytest.approx(600, abs=20)  # sixty crossings of the mean
