"""An input that is smooth between its samples is noticed, and read so the right friction is named."""

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.input_reading import held_equivalent
from rotflex_jax.effects import Coulomb, LuGre, Stribeck

FAST, SLOW, SECONDS = 1000, 100, 12.0
FRICTIONS = [(Coulomb, "hub"), (Stribeck, "hub"), (LuGre, "hub")]


def multisine(t: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(5)
    f = np.arange(0.25, 12.0, 0.25)
    return 0.2 * np.sum(np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 6, len(f))[:, None]), axis=0)


@pytest.fixture(scope="module")
def smooth() -> tuple[rf.Recording, rf.Recording]:
    """100 samples a second of a voltage that goes on between them; from an independent simulator."""
    t = np.arange(round(SECONDS * FAST)) / FAST
    played = multisine(t + 0.5 / FAST)  # held there for a tenth of a sample, which delays by half of that
    r = make_record({("coulomb", "hub"): {"level": 0.03}}, seed=5, fs=FAST, played=played)
    step = FAST // SLOW
    return rf.Recording(u=multisine(t)[::step], y=r["y"][::step], Ts=1 / SLOW).split(0.7)


def test_the_middle_of_each_sample_is_held() -> None:
    k, w = np.arange(400.0), 0.9
    # Steps of a sine have its frequency with the amplitude sin(w / 2) / (w / 2), half a sample late.
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
    assert not any("--intersample" in note for note in found.notes)
