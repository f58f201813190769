"""A stopped search continues from its finished rounds; lines of progress and the time left."""

import copy
import json
import math
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from spindle import PAIRS, SPINDLE, spun

import rotflex_jax as rf
from rotflex_jax.cli import main, terminal
from rotflex_jax.cli.rounds import RoundsSoFar
from rotflex_jax.discover.checkpoint import AddedEffect, TimeLeft, beginning, digest_of_search
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import Horizons
from rotflex_jax.errors import InputError
from rotflex_jax.recording.recording import content


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> tuple[rf.Discovery, Path]:
    """A finished search, and the file that it would have left if stopped after its first round."""
    folder = tmp_path_factory.mktemp("stopped")
    rounds, left = RoundsSoFar(folder / "found.json"), folder / "left.json"

    def follow(line: str) -> None:
        if line.startswith("+ "):
            assert rounds.file is not None and not left.exists()
            shutil.copy(rounds.file, left)

    result = rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, progress=rounds.following(follow))
    rounds.remove()
    return result, left


def test_ends_as_if_it_had_not_been_stopped(searched: tuple[rf.Discovery, Path]) -> None:
    whole, left = searched
    said: list[str] = []
    again = rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, resume=left, progress=said.append)
    assert (again.verdict, [r.effect for r in again.rounds]) == (whole.verdict, ["coulomb"])
    for a, b in zip(again.final.estimates, whole.final.estimates, strict=True):
        assert a.value == pytest.approx(b.value, abs=0.02 * b.std if b.free else 0), a.name
    assert again.rounds[0].score == whole.rounds[0].score
    assert again.rounds[0].prediction.gain == pytest.approx(whole.rounds[0].prediction.gain, rel=1e-3)
    assert [r.effect for r in again.ranking] == [r.effect for r in whole.ranking]
    # Neither the baseline nor the first round is fitted again, and a note states this.
    assert "fitting the model as it is" not in said and not any("round 1" in line for line in said)
    assert any("went on after one round" in note for note in again.notes)
    assert not any("went on" in note for note in whole.notes)


def test_rounds_found_before_count_among_the_rounds(searched: tuple[rf.Discovery, Path]) -> None:
    said: list[str] = []
    found = rf.discover(
        SPINDLE, *spun().split(0.7), candidates=PAIRS, rounds=1, resume=searched[1], progress=said.append
    )
    assert len(found.rounds) == 1 and not any(line.startswith("round") for line in said)


@pytest.mark.parametrize("other", ["recording", "model", "candidates", "window"])
def test_nothing_goes_on_from_another_search(searched: tuple[rf.Discovery, Path], other: str) -> None:
    model = SPINDLE.trust("shaft.inertia.inertia") if other == "model" else SPINDLE
    parts = spun(seed=2 if other == "recording" else 1).split(0.7)
    pairs, seconds = PAIRS[: 1 if other == "candidates" else 2], 1.0 if other == "window" else 2.0
    with pytest.raises(InputError, match="left by a search of other recordings"):
        rf.discover(model, *parts, candidates=pairs, window_seconds=seconds, resume=searched[1])


def _damaged() -> dict[str, object]:
    return {
        "no JSON": "{",
        "another file": {"schema": 1, "verdict": "found"},
        "no stages": {"stages": []},
        "of an older version": {"stages": [{"model": "as it is", "held_out_rmse_windows": {}}]},
        "a list": [1, 2],
        "deep": "[" * 100_000,
    }


@pytest.mark.parametrize("kind", _damaged())
def test_files_that_hold_no_search(kind: str, tmp_path: Path) -> None:
    path, content = tmp_path / "x.stopped.json", _damaged()[kind]
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=r"holds no models|left by a search"):
        rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, resume=path)


@pytest.mark.parametrize(
    "where",
    ["z", "local_z", "x0", "K", "locations", "free", "process_noise", "a port", "an intensity", "order"],
)
def test_changed_numbers_are_refused(searched: tuple[rf.Discovery, Path], where: str, tmp_path: Path) -> None:
    written = json.loads(searched[1].read_text())
    stages = [copy.deepcopy(entry["search"]) for entry in written["stages"]]
    bad = {
        "z": [1.0],
        "local_z": [[10**400]],
        "x0": [[["nan"]]],
        "K": None,
        "locations": [["unknown", "shaft"]],
        "free": [10**6],
    }
    if where == "order":
        stages.reverse()
    elif where in ("a port", "an intensity"):
        noise = {"nowhere": 1e-6} if where == "a port" else {"shaft": float("nan")}
        stages[0]["prediction"]["process_noise"] = noise
    else:
        stages[0]["prediction"][where] = bad.get(where, 7)
    path = tmp_path / "x.stopped.json"
    path.write_text(json.dumps({"stages": [{"search": stage} for stage in stages]}))
    with pytest.raises(InputError, match="holds no models that a search can go on from"):
        rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, resume=path)


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(InputError, match=r"cannot be read .No such file"):
        rf.discover(SPINDLE, *spun().split(0.7), candidates=PAIRS, resume="gone.stopped.json")


def test_option_of_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "run.csv"
    file.write_text("t,u,y\n0,0,0\n")
    with pytest.raises(SystemExit) as end:
        main(["discover", str(file), "--each", "--continue", "x.stopped.json"])
    assert end.value.code == 2 and "--continue and --each" in capsys.readouterr().err


def test_what_a_recording_continues_belongs_to_it() -> None:
    """Unmeasured states start where the part before ends, so this part identifies the recording as well."""
    _, later = spun().split(0.7)
    assert later.continues is not None
    alone = copy.copy(later)
    object.__setattr__(alone, "continues", None)
    assert content(alone) == content(later)[:3] != content(later)


def test_the_same_recordings_shared_out_otherwise_are_another_search() -> None:
    a, b = spun().split(0.7)
    s: Any = SimpleNamespace(mechanism=SPINDLE)
    model = rf.Model(SPINDLE)
    assert digest_of_search(model, s, 2.0, [a, b], []) != digest_of_search(model, s, 2.0, [a], [b])


def test_nothing_is_reported_before_all_is_read(
    searched: tuple[rf.Discovery, Path],
) -> None:
    """A search that continues reports a round only once all rounds of the file are validated.

    Its reports replace this file, and a second stop must not lose rounds.
    """
    written = json.loads(searched[1].read_text())
    reached: list[int] = []

    def stop(line: str) -> None:
        if getattr(line, "errors", None) is not None:
            reached.append(len(validations))

    validations: list[int] = []
    validated = Horizons.validated

    def counted(self: Horizons, *given: Any) -> Any:
        validations.append(1)
        return validated(self, *given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Horizons, "validated", counted)
        rf.discover(
            SPINDLE, *spun().split(0.7), candidates=PAIRS, rounds=1, resume=searched[1], progress=stop
        )
    assert reached[:2] == [len(written["stages"])] * 2


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize("score", [12.5, math.nan])
def test_an_effect_that_was_added_without_a_score_is_kept(score: float) -> None:
    gain = HorizonGain(1.0, 2.0, 0.5, 3.0)
    added = AddedEffect(EffectLocation("lugre", "hub"), score, (), (gain, None))
    again = AddedEffect.from_dict(json.loads(json.dumps(added.to_dict(), allow_nan=False)))
    assert again.score == pytest.approx(score, nan_ok=True) and again._replace(score=score) == added


def test_the_time_left_is_that_of_the_steps_measured() -> None:
    clock = Clock()
    left = TimeLeft(clock)

    def after(seconds: float, kind: str) -> float | None:
        clock.now += seconds
        left.follow(beginning(kind, kind))  # pyright: ignore[reportArgumentType]
        return left.seconds()

    # The first steps compile programs, which takes an unknown time.
    assert (left.seconds(), after(1, "baseline"), after(30, "score"), after(20, "refit")) == (None,) * 4
    assert left.words() == "51 s so far"
    # Refits took 40 s. If the second round is the last one, scores, refits and two steps of other kinds
    # follow. These were not measured yet and are assumed to take as long as refits.
    assert after(40, "score") == 20 + 3 * 40
    clock.now += 15
    left.follow("  a line of no step")
    assert left.seconds() == 5 + 3 * 40
    assert left.words() == "106 s so far, about 2 min left if this round is the last"
    clock.now += 100  # longer than the first time: no estimate
    assert left.seconds() is None and left.words() == "206 s so far, longer than expected"
    # The last measurement of each kind counts, since no program was compiled in it.
    assert after(0, "refit") == 3 * 40 and after(10, "needed") == 2 * 10
    assert after(4, "finish") == 10 and left.words().endswith("about 10 s left")


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "SILENCE", 0.05)


def test_a_step_that_takes_long_is_said_again(impatient: None, capsys: pytest.CaptureFixture[str]) -> None:
    said = ""
    with terminal.progress("Searching") as step:
        step("refitting coulomb at hub")
        until = time.monotonic() + 30
        while "still" not in said and time.monotonic() < until:
            time.sleep(0.02)
            said += capsys.readouterr().err
    assert said.startswith("refitting Coulomb friction at hub (0 s so far)")
    assert "  still refitting Coulomb friction at hub (0 s; 0 s so far)" in said
    capsys.readouterr()
    time.sleep(0.15)
    assert capsys.readouterr().err == ""  # nothing more after the end


def test_a_long_line_is_shortened_when_it_is_said_again(
    impatient: None, capsys: pytest.CaptureFixture[str]
) -> None:
    told = terminal._LastLine("Searching")
    told.take("refitting " + ", ".join(f"effect{k} at hub" for k in range(20)))
    assert " … (0 s" in told.again() and len(told.again()) < 110
