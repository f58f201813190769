"""Scores of methods: constructed answers, methods in files of users, failures, data a method receives."""

import json
import math
import os
import pickle
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena import problems as of, scores as scoring
from rotflex_jax.arena.method import Answer, Apart, ArenaFailure, Here, understood
from rotflex_jax.arena.problems import MEASURED, NOTHING, ONE, OUT, TWO, WORLD, Problem, drawn
from rotflex_jax.arena.rivals.motion import Motion
from rotflex_jax.arena.rivals.terms import _hysteresis, terms
from rotflex_jax.arena.scores import MethodScore, Scores, calibration_error, failed, marked, run_error, score
from rotflex_jax.cli import app
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.linear import StateSpace
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model

MODEL = Model(rf.joints.paper())
COULOMB, DELAY, GRAVITY = ("coulomb", "hub"), ("delay", "input"), ("gravity", "arm")


def problem(kind, hidden=(), forgiven=()):
    return Problem(kind, (), (), MODEL, (), tuple(hidden), tuple(forgiven), {}, {})


EVERY = [
    problem(ONE, [COULOMB]),
    problem(TWO, [COULOMB, DELAY]),
    problem(NOTHING),
    problem(NOTHING),
    problem(OUT, [("worm", "hub")]),
    problem(WORLD, [GRAVITY], [("viscous", "hub")]),
]


def scored(answers):
    return MethodScore(
        "m", tuple(marked(p, a, k) for k, (p, a) in enumerate(zip(EVERY, answers, strict=True)))
    )


def said(*effects, unexplained=False, **chances):
    return Answer(tuple(effects), unexplained, chances.get("p", {}), False, 1.0)


def test_a_perfect_answer_is_right_everywhere():
    perfect = [
        said(COULOMB, p={COULOMB: 1.0, DELAY: 0.0}),
        said(DELAY, COULOMB),
        said(),
        said(),
        said(unexplained=True),
        said(("viscous", "hub"), GRAVITY),
    ]
    s = scored(perfect)
    assert (s.right, s.named, s.withheld, s.worlds) == ((6, 6), (3, 3), (1, 1), (1, 1))
    assert (s.alarms, s.wrong, s.worlds_wrong, s.failures) == ((0, 2), 0, 0, 0)
    assert s.calibration == 0.0 and s.brier == 0.0


def test_silence_raises_no_alarm_and_names_nothing():
    s = scored([said()] * 6)
    assert (s.right, s.named, s.withheld, s.worlds) == ((2, 6), (0, 3), (0, 1), (0, 1))
    assert (s.alarms, s.wrong) == ((0, 2), 0)
    assert s.calibration is None and s.brier is None


def test_probabilities_too_small_to_count_have_no_calibration():
    s = scored([said(p={COULOMB: 0.001})] * 6)
    assert s.calibration is None and s.brier is not None
    json.dumps(s.summary(), allow_nan=False)
    assert "nan" not in scoring.cells(s)


def test_one_name_always_is_an_alarm_wherever_it_is_not_true():
    s = scored([said(COULOMB, p={COULOMB: 0.9})] * 6)
    # Right only where it is the one hidden effect; of two effects it names one.
    assert (s.right, s.named, s.worlds) == ((1, 6), (2, 3), (0, 1))
    assert (s.alarms, s.withheld, s.wrong, s.worlds_wrong) == ((2, 2), (0, 1), 3, 1)
    # The probability 0.9 is claimed six times, and the effect is there twice.
    assert s.calibration == pytest.approx(0.9 - 2 / 6)
    assert s.brier == pytest.approx((2 * 0.1**2 + 4 * 0.9**2) / 6)


def test_unexplained_always_is_right_outside_the_catalogue_only():
    s = scored([said(unexplained=True)] * 6)
    assert (s.right, s.named, s.withheld, s.alarms) == ((1, 6), (0, 3), (1, 1), (2, 2))
    assert scored([*[said()] * 4, said(COULOMB, unexplained=True), said()]).wrong == 1


def test_look_alikes_count_and_failures_count_as_wrong():
    row = marked(problem(ONE, [("sensor_gain", "theta")]), said(("sensor_gain", "alpha")), 1)
    assert row.right and row.hits == 1 and not row.wrong
    s = MethodScore("m", tuple(failed(p, "The method raised.", k, 2.0) for k, p in enumerate(EVERY)))
    assert (s.right, s.alarms, s.withheld, s.failures, s.seconds) == ((0, 6), (0, 2), (0, 1), 6, None)


def test_calibration_is_the_mean_distance_of_claim_and_share():
    events = [scoring.Event(0.25, k < 1) for k in range(4)] + [scoring.Event(0.95, True)] * 4
    assert calibration_error(events) == pytest.approx((4 * 0 + 4 * 0.05) / 8)
    assert math.isnan(calibration_error([]))


def test_what_is_no_answer_is_refused_in_a_sentence():
    for given, phrase in [
        (None, "None"),
        ("coulomb", "'nothing missing'"),
        (3.0, "3.0"),
        (["coulomb"], "'coulomb@hub'"),
        (["glue@hub"], "no such effect"),
        (["coulomb@knee"], "'hub'"),
        ({"effect": []}, "'effect'"),
        ({"probabilities": {"coulomb@hub": 1.5}}, "between 0 and 1"),
        ({"unexplained": "yes"}, "True or False"),
        ({"model": "mine"}, "simulate"),
    ]:
        with pytest.raises(InputError, match=phrase):
            understood(given, MODEL)
    found, model = understood({"effects": ["coulomb@hub", COULOMB], "model": rf.joints.paper()}, MODEL)
    assert found.effects == (COULOMB,) and isinstance(model, Model)
    for nothing in ("nothing missing", [], (), {"effects": None}):
        assert understood(nothing, MODEL)[0] == Answer()
    assert understood("unexplained", MODEL)[0].unexplained
    sums = understood({"probabilities": {COULOMB: 1 + 2e-15}}, MODEL)[0]
    assert sums.probabilities == {COULOMB: 1.0}


@pytest.fixture(scope="module")
def three() -> list[Problem]:
    """Three short problems of one seed."""
    return drawn(3, 11, 4.0)


def test_records_are_those_of_their_seed(three):
    again, other = drawn(3, 11, 4.0), drawn(3, 12, 4.0)
    assert [p.given() for p in again] == [p.given() for p in three]
    assert [p.truth for p in again] == [p.truth for p in three]
    assert [p.given() for p in other] != [p.given() for p in three]
    kinds = [p.kind for p in drawn_kinds(24, 5)]
    shares = {ONE: 12, NOTHING: 4, OUT: 4, TWO: 2, WORLD: 2}
    assert {k: kinds.count(k) for k in shares} == shares
    assert kinds != [p.kind for p in drawn_kinds(24, 6)]


def drawn_kinds(records, seed):
    """Problems with drawn kinds, without any simulation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(of, "_record", lambda kind, places, *_: problem(kind, places))
        patch.setattr(of, "_world", lambda _: problem(WORLD))
        return drawn(records, seed)


def reachable(value, seen):
    """Collect in `seen` what can be reached from an object by attributes, items and bases of arrays."""
    if id(value) in seen or callable(value) or isinstance(value, type(sys) | type):
        return
    seen[id(value)] = value
    inner = list(value.items()) if isinstance(value, dict) else []
    inner += list(value) if isinstance(value, list | tuple | set | frozenset) else []
    inner += list(getattr(value, "__dict__", {}).items())
    if isinstance(value, np.ndarray) and value.base is not None:
        inner.append(value.base)
    for x in inner:
        reachable(x, seen)


def test_a_method_cannot_reach_the_truth(three):
    for p in three:
        given, asked = pickle.loads(p.given()), pickle.loads(p.asked())
        seen: dict = {}
        reachable((given, asked), seen)
        # Of the test recordings, only voltage and first samples can be reached, also through bases of arrays.
        arrays = [v for v in seen.values() if isinstance(v, np.ndarray) and v.dtype == float]
        for r in p.runs():
            last = set(r.y[-300:, 0].tolist()) - {0.0}
            assert len(last) > 3
            for a in (x for x in arrays if x.ndim == 2):
                assert not any(np.array_equal(x, r.y[-300:, 0]) for x in windows(a[:, 0], 300))
        for r in asked:
            assert np.all(r.y[r.n_init - 1 :] == r.y[r.n_init - 1])
        floats = {v for v in seen.values() if isinstance(v, float)}
        drawn_ones = set(p.truth["plant"].values()) - set(p.model.mechanism.values.tolist())
        assert len(drawn_ones) > 4 and not drawn_ones & floats
        assert p.truth["seed"] not in {v for v in seen.values() if isinstance(v, int)}
        sources = {v for v in seen.values() if isinstance(v, str) and "arena" in v}
        assert sources == {"arena"}


def windows(x, width):
    return np.lib.stride_tricks.sliding_window_view(x, width) if len(x) >= width else []


def test_a_recording_does_not_tell_where_it_is_from(three):
    whole = rf.Recording(
        u=three[0].train[0].u, y=three[0].train[0].y, Ts=0.002, source="wrong world 3001, train"
    )
    seen: dict = {}
    reachable(pickle.loads(pickle.dumps(of._alone(whole.slice(700, 1400)))), seen)
    assert not any("3001" in v for v in seen.values() if isinstance(v, str))
    assert sum(isinstance(v, rf.Recording) for v in seen.values()) == 1


class Truth:
    """A model that returns the measured outputs plus a known number of standard deviations of the sensors."""

    def __init__(self, problem, off):
        self.known = {
            r.u.tobytes(): r.y + off * np.array(list(problem.noise.values())) for r in problem.runs()
        }

    def simulate(self, recording):
        return self.known[recording.u.tobytes()]


def test_the_error_is_counted_in_deviations_of_the_sensors(three):
    p = three[0]
    for off in (1.0, 4.0):
        here = Here(lambda train, validation, p=p, off=off: {"model": Truth(p, off)})
        assert here.answer(p.given(), 60.0).has_model
        assert run_error(p, here.simulate(p.asked())) == pytest.approx(off)
    wrong = Here(lambda train, validation: {"model": Short()})
    wrong.answer(p.given(), 60.0)
    with pytest.raises(ArenaFailure, match="shape"):
        wrong.simulate(p.asked())


class Short:
    def simulate(self, recording):
        return recording.y[:-1]


STRANGER = """
    import os, sys, time

    print("a method may print")

    def answer(train, validation):
        assert sys.stdin.read() == ""
        assert {r.source for r in train + validation} == {"arena"}
        return ["coulomb@hub"]

    def moods(train, validation, model):
        mood, _, left = open(__file__ + ".moods").read().partition(" ")
        open(__file__ + ".moods", "w").write(left)
        if mood == "raises":
            raise RuntimeError("no idea")
        if mood == "nonsense":
            return ["glue@knee"]
        if mood == "leaves":
            sys.exit(3)
        if mood == "dies":
            os._exit(7)
        if mood == "sleeps":
            time.sleep(600)
        return "unexplained"

    number = 5
"""


@pytest.fixture(scope="module")
def stranger(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("stranger") / "my_method.py"
    file.write_text(textwrap.dedent(STRANGER))
    return file


def test_a_method_that_fails_is_scored_so_and_goes_on(stranger, three):
    moods = {
        "raises": "raised RuntimeError: no idea",
        "nonsense": "no such effect",
        "leaves": "SystemExit",
        "dies": "status 7",
        "sleeps": "longer than 3 s",
    }
    Path(f"{stranger}.moods").write_text(" ".join([*moods, "answers"]))
    with Apart(f"{stranger}:moods") as method:
        for phrase in moods.values():
            with pytest.raises(ArenaFailure, match=phrase):
                method.answer(three[0].given(), 3.0)
        assert method.answer(three[0].given(), 60.0).unexplained


def test_a_method_that_does_not_start_again_fails_on_that_record_only(tmp_path, three):
    file = tmp_path / "once.py"
    text = "import os\n\ndef answer(train, validation):\n    os._exit(7)\n"
    file.write_text(text)
    with Apart(f"{file}:answer") as method:
        with pytest.raises(ArenaFailure, match="status 7"):
            method.answer(three[0].given(), 60.0)
        file.write_text("number = 5\n")
        with pytest.raises(ArenaFailure, match="does not start again"):
            method.answer(three[0].given(), 60.0)
        file.write_text(text.replace("os._exit(7)", "return 'unexplained'"))
        assert method.answer(three[0].given(), 60.0).unexplained
    file.write_text("number = 5\n")
    with Apart(f"{file}:answer") as method, pytest.raises(InputError, match="no function"):
        method.answer(three[0].given(), 60.0)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="there are no process groups")
def test_what_a_method_started_is_stopped_with_it(tmp_path, three):
    file, alive = tmp_path / "parent.py", tmp_path / "alive"
    file.write_text(
        textwrap.dedent(f"""
        import os, subprocess, sys, time

        CHILD = "import time, pathlib\\nwhile True: pathlib.Path({str(alive)!r}).touch(); time.sleep(0.05)"

        def answer(train, validation):
            subprocess.Popen([sys.executable, "-c", CHILD])
            while not os.path.exists({str(alive)!r}):
                time.sleep(0.02)
            os._exit(7)
        """)
    )
    with Apart(f"{file}:answer") as method:
        with pytest.raises(ArenaFailure, match="status 7"):
            method.answer(three[0].given(), 60.0)
        time.sleep(0.1)
        alive.unlink()
        time.sleep(0.5)
        assert not alive.exists()


def test_a_stranger_is_scored_by_one_command(stranger, tmp_path, monkeypatch, capsys, three):
    monkeypatch.setattr(scoring, "drawn", lambda *_: three)
    page, file = tmp_path / "arena.html", tmp_path / "arena.json"
    command = ["arena", f"{stranger}:answer", "--records", "3", "--seed", "11", "--seconds", "4"]
    with pytest.raises(SystemExit) as left:
        app.main([*command, "--report", str(page), "--json", str(file)])
    assert left.value.code == 0
    row = json.loads(file.read_text())["methods"][f"{stranger}:answer"]
    assert [r["answered"] for r in row["rows"]] == [["coulomb@hub"]] * 3
    empty = sum(p.kind == NOTHING for p in three)
    assert row["summary"]["alarms"] == [empty, empty] and row["summary"]["failures"] == 0
    text = page.read_text()
    assert "seed 11" in text and all(name in text for p in three for name, _ in p.hidden)
    assert "seed 11" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        ([], "No method was given"),
        (["nowhere.py:f"], "does not exist"),
        (["{file}:number"], "no function"),
        (["{file}"], "FILE.py:NAME"),
        (["--entrants", "nobody"], "search"),
        (["{file}:answer", "--records", "0"], "records"),
        (["{file}:answer", "--limit", "0"], "limit"),
        (["{file}:answer", "--seconds", "1"], "seconds"),
        (["{file}:answer", "{file}:answer"], "twice"),
    ],
)
def test_bad_arguments_are_refused_before_any_record(stranger, arguments, phrase, capsys, monkeypatch):
    monkeypatch.setattr(scoring, "drawn", lambda *_: pytest.fail("records were drawn"))
    with pytest.raises(SystemExit) as left:
        app.main(["arena", *(a.format(file=stranger) for a in arguments)])
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert phrase in said and "Traceback" not in said


def test_several_methods_meet_the_same_records(monkeypatch, three):
    monkeypatch.setattr(scoring, "drawn", lambda *_: three)

    def spoils(train, validation, model):
        object.__setattr__(train[0], "y", np.zeros_like(train[0].y))
        return "nothing missing"

    def looks(train, validation, model):
        assert np.any(train[0].y)
        return "nothing missing"

    found = score([spoils, looks], records=3, seed=11, seconds=4.0)
    assert isinstance(found, Scores) and found.seed == 11
    assert [s.failures for s in found.methods] == [0, 0]
    assert found.methods[0].right == found.methods[1].right
    assert found.to_markdown().count("\n") == 3


def test_measured_machines_count_by_the_error_of_free_runs(measured):
    measured("emps")
    ways = [p for p in of.measured() if p.truth["machine"] == "emps"]
    assert ways and all(p.kind == MEASURED and not p.hidden for p in ways)
    p = ways[0]
    runs = [r.y + 0.002 for r in p.runs()]
    assert run_error(p, runs) == pytest.approx(0.002)
    row = marked(p, Answer(has_model=True), 1, 0.002)
    assert row.error == 0.002 and not row.wrong


def moving(q, v, a, Ts=0.002) -> Motion:
    """A motion of a joint with random linear dynamics."""
    rng = np.random.default_rng(4)
    A = np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), -np.abs(rng.normal(size=(2, 4)))])
    mass = np.array([[3.0, 1.0], [1.0, 2.0]])
    joint = StateSpace(A, np.zeros(4), np.eye(2, 4))
    u = np.cos(7 * Ts * np.arange(len(q)))
    missing = (a - np.hstack([q, v]) @ A[2:].T) @ mass.T
    return Motion(u, q, v, a, Ts, joint, mass, missing, 11, 0, 0.5)


t = 0.002 * np.arange(1500)
ANGLES = np.stack([0.8 * np.sin(2 * t), 0.1 * np.sin(5 * t + 1)], 1)
SPEEDS = np.stack([1.6 * np.cos(2 * t), 0.5 * np.cos(5 * t + 1)], 1)
ACCELERATIONS = np.stack([-3.2 * np.sin(2 * t), -2.5 * np.sin(5 * t + 1)], 1)


def column(m: Motion, place, which=0):
    """One column of the regression term of an effect."""
    return next(x for x in terms(m) if x.place == place).columns[:, :, which]


def test_regressions_have_a_column_for_the_catalogue():
    named = {x.place for x in terms(moving(ANGLES, SPEEDS, ACCELERATIONS))}
    wanted = {(kind.name, port) for kind, port in search_places(rf.joints.paper())}
    own = {("viscous", "hub"), ("viscous", "joint")}  # effects that the joint already has
    in_time = {("voltage_drift", "input"), ("periodic_disturbance", "input")}
    assert wanted - named == own | in_time | {("backlash", "hub")}


@pytest.mark.parametrize(
    ("place", "error"),
    [
        (("sensor_gain", "alpha"), lambda q: q[:, 1]),
        (("sensor_cubic", "theta"), lambda q: q[:, 0] ** 3),
        (("cross_talk", "alpha"), lambda q: q[:, 0]),
        (("eccentric_encoder", "theta"), lambda q: np.sin(q[:, 0])),
    ],
)
def test_an_error_of_a_sensor_is_what_the_balance_makes_of_it(place, error):
    true = moving(ANGLES, SPEEDS, ACCELERATIONS)
    channel = ("theta", "alpha").index(place[1])
    d, Ts = 0.01 * error(ANGLES), true.Ts
    rate = np.gradient(d, Ts, edge_order=2)
    read = [x.copy() for x in (ANGLES, SPEEDS, ACCELERATIONS)]
    for x, more in zip(read, (d, rate, np.gradient(rate, Ts, edge_order=2)), strict=True):
        x[:, channel] += more
    wrong = moving(*read)
    inner = slice(5, -5)
    np.testing.assert_allclose(
        (wrong.missing - true.missing)[inner], 0.01 * column(true, place)[inner], atol=2e-5
    )


def test_states_along_a_motion_are_those_of_their_laws():
    s, Ts = 0.3, 0.002
    steady = np.full(400, s)
    built = _hysteresis(steady, np.ones(400), 0.02, 1.0, Ts)
    way = s * Ts * np.arange(1, 401)
    np.testing.assert_allclose(built, 1 - np.exp(-way / 0.02), rtol=1e-12)
    # With beta = 1/2 the torque returns along a straight line.
    there = _hysteresis(np.concatenate([steady, -steady[:20]]), np.ones(420), 0.02, 0.0, Ts)
    np.testing.assert_allclose(np.diff(there[399:]), -s * Ts / 0.02, rtol=1e-9)
    # Far below its resonance, the mass follows its port.
    m = moving(ANGLES, SPEEDS, ACCELERATIONS)
    torque = column(m, ("second_mode", "hub"))
    late = slice(1000, None)
    np.testing.assert_allclose(torque[late, 0], ACCELERATIONS[late, 0], atol=0.05 * 3.2)
    assert not np.any(torque[:, 1])
    # For a slow input, a lag subtracts its time constant times the slope. The next term is 2 % of that.
    lag = column(m, ("lag", "input"))[late, 0]
    np.testing.assert_allclose(lag, 0.003 * 7 * np.sin(7 * t[late]), atol=6e-4)


def test_marks_are_read_back_from_their_json():
    row = marked(EVERY[1], said(COULOMB, GRAVITY, p={COULOMB: 0.7}), 2, 1.5, "a note")
    assert scoring.Marks.of(json.loads(json.dumps(row.to_dict()))) == row
