"""`rotflex experiment`: bad input is refused with one sentence, and the input for the rig is written."""

import json
from pathlib import Path

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.cli.app import main
from rotflex_jax.cli.experiment import _limits
from rotflex_jax.data.files import save_csv
from rotflex_jax.errors import InputError
from rotflex_jax.joints import emps, paper


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A short recording of a machine with a delay."""
    r = make_record({("delay", "input"): {"time": 0.006}}, seed=110, seconds=4.0, fs=200.0)
    recording = rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"])
    return save_csv(recording, tmp_path_factory.mktemp("run") / "run.csv")


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        main(["experiment", *map(str, arguments)])
    return int(left.value.code or 0)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (["--between", "delay@input", "delay@input", "--voltage", "5"], "twice"),
        (["--between", "dely@input", "lag@input", "--voltage", "5"], "did you mean delay"),
        (["--between", "coulomb", "lag@input", "--voltage", "5"], "given no port"),
        (["--between", "delay@input", "lag@input", "--voltage", "-5"], "positive number in V"),
        (["--between", "delay@input", "lag@input"], "--voltage"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--seconds", "0.1"], "200 to 10000000"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--seconds", "0"], "--seconds 20"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--seconds", "1e9"], "10000000 samples"),
        (
            ["--between", "delay@input", "lag@input", "--voltage", "5", "--travel", "-3"],
            "given -3, but needs",
        ),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--deflection", "0"], "in deg;"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--error", "0.1"], "--state only"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--max-seconds", "9"], "--state only"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--save", "/none/x.csv"], "does not"),
        (["--between", "delay@input", "lag@input", "--voltage", "5", "--save", "-"], "stdout"),
    ],
)
def test_bad_input_is_one_sentence(run, changes, match, capsys):
    assert called("--fit", run, *changes) == 2
    told = capsys.readouterr().err.strip()
    assert match in told and told.startswith("rotflex: ") and "\n" not in told


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (["--error", "7"], "--error was given 7, but it is the probability"),
        (["--error", "0"], "between 0 and 0.5"),
        (["--max-seconds", "-3"], "--max-seconds was given -3, but the experiment needs at least 1 s"),
        (["--max-seconds", "inf"], "--max-seconds 60"),
    ],
)
def test_an_impossible_end_is_refused_before_anything_is_fitted(
    run, changes, match, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("rotflex_jax.fit", None)
    state = tmp_path / "state.json"
    between = ("--between", "delay@input", "lag@input", "--voltage", "5", "--state", state)
    assert called("--fit", run, *between, *changes) == 2
    told = capsys.readouterr().err.strip()
    assert match in told and told.startswith("rotflex: ") and "\n" not in told


def test_limits_are_in_degrees_or_millimetres():
    found = _limits(paper(), 5.0, 90.0, 180.0, 36.0)
    assert (found.voltage, found.slew) == (5.0, 90.0)
    assert (found.travel, found.deflection) == pytest.approx((np.pi, np.pi / 5))
    assert _limits(emps(), 5.0, np.inf, 120.0, np.inf).travel == pytest.approx(0.12)
    with pytest.raises(InputError, match="--deflection 5 was given, but the model has one output, position;"):
        _limits(emps(), 5.0, np.inf, 120.0, 5.0)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--continue", "none.json"], "no recording of its"),
        (["--continue", "none.json", "run.csv"], "cannot be read"),
        (["--continue", "none.json", "run.csv", "--voltage", "5"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--travel", "5"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--seconds", "5"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--rank-only"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--model", "paper"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--substeps", "4"], "leave them out"),
        (["--continue", "none.json", "run.csv", "--intersample", "smooth"], "leave them out"),
        (["run.csv"], "belongs to --continue"),
        (["--fit", "run.csv", "--between", "coulomb@hub", "--voltage", "4"], "given --voltage in the place"),
        (["--between", "coulomb@hub", "--fit", "run.csv", "--voltage", "4"], "needs two effects"),
        (["--between", "delay@input", "lag@input", "--voltage", "5"], "--fit is missing"),
        (["--fit", "run.csv", "--voltage", "5"], "--between is missing"),
        (
            ["--fit", "run.csv", "--between", "a", "b", "--voltage", "5", "--or", "lag@input"],
            "--state only",
        ),
    ],
)
def test_what_does_not_go_together_is_said_in_a_sentence(arguments, match, capsys):
    assert called(*arguments) == 2
    told = capsys.readouterr().err.strip()
    assert match in told and told.startswith("rotflex: ") and "\n" not in told


def test_a_state_that_is_none_is_said_in_a_sentence(run, tmp_path, capsys):
    for text, match in (
        ("{", "is not JSON"),
        ("{}", "holds something else"),
        ("[1]", "holds something else"),
    ):
        (tmp_path / "state.json").write_text(text)
        assert called("--continue", tmp_path / "state.json", run) == 2
        assert match in capsys.readouterr().err


def test_no_state_and_no_recording_is_written_over(run, tmp_path, capsys):
    command = ["--fit", run, "--between", "delay@input", "lag@input", "--voltage", 6, "--state"]
    for state, kept in ((run, run), (tmp_path / "s.json", tmp_path / "s_001.csv")):
        kept.touch()
        before = kept.read_bytes()
        assert called(*command, state) == 2
        told = capsys.readouterr().err
        assert "is there already" in told or "written over" in told
        assert kept.read_bytes() == before


@pytest.mark.slow
def test_an_experiment_goes_on_one_command_at_a_time(run, tmp_path, capsys):
    """Voltages are played on the independent simulator, from rest each time, until the delay is found."""
    state, between = tmp_path / "state.json", ["--between", "delay@input", "lag@input"]
    limits = ["--voltage", 6, "--deflection", 10, "--rank-only", "--json", "-"]
    assert called("--fit", run, *between, *limits, "--state", state) == 0
    for k in range(8):
        told = json.loads(capsys.readouterr().out)
        if told["next"] is None:
            break
        u = np.loadtxt(told["next"]["file"], delimiter=",", skiprows=2)[:, 1]
        assert np.max(np.abs(u)) <= 6.0 and told["next"]["file"].endswith(f"_{k + 1:03d}.csv")
        truth = {("delay", "input"): {"time": 0.006}}
        y = make_record(truth, seed=110, fs=200.0, played=u)["y"]
        answer = save_csv(rf.Recording(u=u, y=y, Ts=0.005, accept=("saturated",)), tmp_path / "answer.csv")
        assert called("--continue", state, answer, "--accept", "saturated", "--json", "-") == 0
    assert told["verdict"] == "decided" and told["best"] == "delay@input"
    assert called("--continue", state, answer) == 2
    assert "has ended" in capsys.readouterr().err


@pytest.mark.slow
def test_the_best_standard_input_is_written(run, tmp_path, capsys):
    file, picture = tmp_path / "next.csv", tmp_path / "next.png"
    wanted = ["--voltage", 2, "--deflection", 10, "--seconds", 4, "--rank-only", "--json", "-"]
    files = ["--save", file, "--plot", picture]
    assert called("--fit", run, "--between", "delay@input", "lag@input", *wanted, *files) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["separates"] == ["delay@input", "lag@input"] and told["file"] == str(file)
    t, voltage = np.loadtxt(file, delimiter=",", skiprows=2).T
    assert len(t) == 800 and np.max(np.abs(voltage)) <= 2.0
    assert told["evidence"]["nats"] == max(r["nats"] for r in told["table"]) > 0
    assert picture.stat().st_size > 10_000
