"""A search detects a smooth input, a channel with the opposite sign, and validation data at rest."""

import dataclasses
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import forward_selection, reading
from rotflex_jax.discover.reading import (
    held_equivalent,
    nats_if_smooth,
    opposite_signs,
    sign_note,
    still_channels,
)
from rotflex_jax.effects import Coulomb, LuGre, Stribeck
from rotflex_jax.fit.dataset import Dataset, StackedRecordings

pytestmark = pytest.mark.usefixtures("without_final_fit")

FAST, SLOW, SECONDS = 1000, 100, 12.0
FRICTIONS = [(Coulomb, "hub"), (Stribeck, "hub"), (LuGre, "hub")]


def multisine(t: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(5)
    f = np.arange(0.25, 12.0, 0.25)
    return 0.2 * np.sum(np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6, len(f))[:, None]), axis=0)


@pytest.fixture(scope="module")
def smooth() -> tuple[rf.Recording, rf.Recording]:
    """Recordings at 100 Hz of a voltage that varies between the samples, by an independent simulator."""
    t = np.arange(round(SECONDS * FAST)) / FAST
    played = multisine(t + 0.5 / FAST)  # held for 1 ms there: a delay of 0.5 ms
    r = make_record({("coulomb", "hub"): {"level": 0.03}}, seed=5, fs=FAST, played=played)
    step = FAST // SLOW
    return rf.Recording(u=multisine(t)[::step], y=r["y"][::step], Ts=1 / SLOW).split(0.7)


def test_the_middle_of_each_sample_is_held() -> None:
    k, w = np.arange(400.0), 0.9
    # A sampled and held sine has an amplitude of sin(w / 2) / (w / 2) and is half a sample late.
    found, wanted = held_equivalent(np.sin(w * k)), np.sin(w * (k + 0.5)) / np.sinc(w / (2 * np.pi))
    np.testing.assert_allclose(found[40:-40], wanted[40:-40], atol=1e-3)


def test_a_smooth_input_is_noticed_and_the_offer_names_the_right_friction(smooth) -> None:
    said: list[str] = []
    joint = rf.joints.paper()
    held = rf.discover(joint, *smooth, candidates=FRICTIONS, rounds=0, progress=said.append)
    (offer,) = [note for note in held.notes if "--intersample smooth" in note]
    assert offer in said
    model = rf.Model(joint, rf.Exponential(between="smooth", substeps=4))
    found = rf.discover(model, *smooth, candidates=FRICTIONS, rounds=1)
    assert [r.effect for r in found.rounds] == ["coulomb"]
    low, high = found.rounds[0].parameters["level"].ci95
    assert low < 0.03 < high and high - low < 0.003
    assert not any("--intersample" in note for note in found.notes)


def test_a_held_input_is_not_offered_another_reading() -> None:
    demo = rf.data.demo_recording().slice(0, 1500)
    found = rf.discover(rf.joints.paper(), *demo.split(0.7), candidates=FRICTIONS, rounds=0)
    assert not any("--intersample" in note or "hardly moves" in note for note in found.notes)


@pytest.mark.parametrize(
    ("repeated", "gain", "scatter", "offered"),
    [(0.4, 25.0, 0.5, True), (0.6, 25.0, 0.5, False), (0.4, 15.0, 0.3, False), (0.4, 25.0, 2.0, False)],
    ids=["varies", "held", "small gain", "scattered gain"],
)
def test_a_smooth_input_must_gain_clearly_and_vary(
    repeated: float, gain: float, scatter: float, offered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than 20 nats and 3 standard deviations, and at most half of the samples repeat the one before."""
    rng = np.random.default_rng(1)
    steps = np.where(np.arange(200) % 10 < 10 * repeated, 0.0, rng.uniform(0.1, 0.2, 200))
    u = np.cumsum(steps * rng.choice([-1.0, 1.0], 200))
    run = rf.Recording(u=u, y=np.column_stack([u, u]), Ts=0.01, accept=("units",))
    stacked = StackedRecordings(u[None], run.y[None], np.ones((1, 200)), np.array([0.01]))
    data = Dataset((run,), stacked, np.ones(2), 1.0, np.zeros((1, 4)), np.zeros((1, 0)))
    smooth = SimpleNamespace(with_likelihood=lambda h: h)
    problem: Any = SimpleNamespace(
        dataset=data, predictor=SimpleNamespace(solver=rf.Exponential()), of_dataset=lambda given: smooth
    )
    varied = np.where(np.arange(100) % 2, scatter, -scatter)  # of zero sum
    fitted: Any = SimpleNamespace(log_likelihood=0.0, blocks=np.zeros(100))
    refitted = SimpleNamespace(blocks=gain / 100 + varied)
    monkeypatch.setattr(reading, "refit", lambda problem, starts, alternations: [refitted])
    assert nats_if_smooth(problem, fitted) == pytest.approx(gain if offered else 0.0)


@pytest.mark.parametrize(
    ("left", "other", "likelier", "named"),
    [(0.8, 0.47, 1.0, True), (0.8, 0.49, 1.0, False), (0.49, 0.1, 1.0, False), (0.8, 0.1, -1.0, False)],
    ids=["much better", "hardly better", "small error", "less likely"],
)
def test_the_limits_of_an_opposite_sign(
    left: float, other: float, likelier: float, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of at least half of the motion fall below 0.6 of their size, and the data become likelier."""
    errors = lambda h: np.array([0.0, h.error])  # noqa: E731
    problem: Any = SimpleNamespace(channel_errors=errors)
    monkeypatch.setattr(reading, "_deviations", lambda problem: np.ones(2))
    monkeypatch.setattr(reading, "_with_opposite_sign", lambda *given: problem)
    monkeypatch.setattr(reading, "values_given", lambda problem: None)
    monkeypatch.setattr(reading, "as_free_run", lambda *given: SimpleNamespace(log_likelihood=0.0))
    end = SimpleNamespace(error=other, log_likelihood=likelier)
    monkeypatch.setattr(reading, "refit", lambda *given: [end])
    fitted: Any = SimpleNamespace(error=left, log_likelihood=0.0)
    found = opposite_signs(rf.Model(rf.joints.paper()), problem, fitted, 2.0)
    assert found == ({"alpha": (left, other)} if named else {})


def test_a_tenth_of_the_motion_is_hardly_any(monkeypatch: pytest.MonkeyPatch) -> None:
    mechanism = rf.joints.paper()
    train: Any = SimpleNamespace(supermodel=SimpleNamespace(mechanism=mechanism), sizes=np.array([2.0, 0.5]))
    validation: Any = SimpleNamespace(sizes=np.array([0.19, 0.055]))
    monkeypatch.setattr(reading, "_deviations", lambda problem: problem.sizes)
    assert still_channels(train, validation) == {"theta": (2.0, 0.19)}


def signs(train: rf.Recording, validation: rf.Recording, model: rf.Mechanism) -> tuple[list[str], list[str]]:
    """Messages about signs in the notes of a search, and in its lines of progress."""
    said: list[str] = []
    found = rf.discover(model, train, validation, candidates=FRICTIONS, rounds=0, progress=said.append)
    notes, lines = ([x for x in texts if "opposite sign" in x] for texts in (found.notes, said))
    return notes, lines


def negated(r: rf.Recording) -> rf.Recording:
    return dataclasses.replace(r, y=r.y * np.array([1.0, -1.0]))


def test_a_channel_with_the_opposite_sign_is_named() -> None:
    """The fit starts far from the true stiffness of 1.6 N m/rad; the right sign gives no message."""
    r = make_record({("coulomb", "hub"): {"level": 0.03}}, kind="steps", seed=3, seconds=8.0, fs=250.0)
    runs = rf.Recording(u=r["u"], y=r["y"], Ts=1 / 250).split(0.7)
    joint = rf.joints.paper().with_values({"joint.spring.stiffness": 0.4})
    notes, lines = signs(*map(negated, runs), joint)
    assert notes == lines
    (note,) = notes
    assert note.startswith("alpha may have been recorded with the opposite sign")
    before, after = (float(x) for x in re.findall(r"([\d.]+) deg", note))
    assert after < 0.3 * before and before > 0.8 * np.rad2deg(np.std(runs[0].y[:, 1]))
    assert note.endswith("negate that column and search again.")
    assert signs(*runs, joint) == ([], [])


def test_runs_that_validate_each_other_with_columns_in_another_order() -> None:
    runs = []
    for seed in (3, 4):
        r = make_record({}, kind="steps", seed=seed, seconds=6.0, fs=250.0)
        y = np.column_stack([-r["y"][:, 1], r["y"][:, 0]])
        runs.append(rf.Recording(u=r["u"], y=y, Ts=1 / 250, channels=("alpha", "theta")))
    joint = rf.joints.paper().with_values({"joint.spring.stiffness": 0.4})
    found = rf.discover(joint, runs, candidates=FRICTIONS, rounds=0)
    (note,) = [n for n in found.notes if "opposite sign" in n]
    assert note.startswith("alpha may have been")


def test_all_channels_with_the_opposite_sign_are_an_input_with_it() -> None:
    (note,) = sign_note({"theta": (0.2, 0.1)}, {"theta": "rad"}, 2.0)
    assert "leave 11.5 deg of it, and 5.73 deg where it is negated. If so, negate the input" in note


def test_validation_data_at_rest_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The voltage is zero in the validation part, in which friction holds the hub at rest."""
    choose, told = forward_selection.choose, []

    def choose_as_told(*arguments: Any) -> Any:
        told.append(arguments[-1])
        return choose(*arguments)

    monkeypatch.setattr(forward_selection, "choose", choose_as_told)
    t = np.arange(round(10 * FAST)) / FAST
    played = np.where(t < 6.0, 2 * multisine(t), 0.0)
    r = make_record({("coulomb", "hub"): {"level": 0.03}}, seed=5, fs=FAST, played=played)
    run = rf.Recording(u=r["u"], y=r["y"], Ts=1 / FAST)
    train, still = run.slice(0, 4000), run.slice(8000, 10000)
    found = rf.discover(rf.joints.paper(), train, still, candidates=FRICTIONS, rounds=1)
    theta, alpha = (note for note in found.notes if "hardly moves" in note)
    assert told == [True]  # the rule that chooses an effect knows of it
    rf.discover(rf.joints.paper(), *train.split(0.7), candidates=FRICTIONS, rounds=1)
    assert told == [True, False]
    windows = [run.y[k : k + 2000] for k in (8000, 0, 2000)]
    rests, *both = (np.rad2deg(y.std(axis=0)) for y in windows)
    moves = np.sqrt(np.mean(np.square(both), axis=0))
    for k, note in enumerate((theta, alpha)):
        said = [float(x) for x in re.findall(r"([\d.]+) deg", note)]
        assert note.startswith(("theta ", "alpha ")[k]) and said == pytest.approx(
            [rests[k], moves[k]], rel=0.05
        )


def test_the_sign_of_a_measured_arm(measured: Callable[[str], list[rf.Recording]]) -> None:
    run, *_ = measured("rotary_arm")
    train, validation = run.slice(0, 5000).split(0.7)
    model = rf.joints.rotary_arm(flexible=True)
    assert signs(train, validation, model) == ([], [])
    ((note,), _) = signs(negated(train), negated(validation), model)
    assert note.startswith("alpha may have been recorded with the opposite sign")
