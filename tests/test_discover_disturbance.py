"""Periodic disturbance: found with frequency and amplitude if there is one, otherwise no candidate."""

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects import Coulomb, Motor, PeriodicDisturbance, VoltageDrift, VoltageOffset

FS, SECONDS, FREQUENCY, SIZE = 200.0, 10.0, 3.3, 0.15
CANDIDATES = [(Coulomb, "hub"), (PeriodicDisturbance, "input"), (VoltageDrift, "input")]


def recording(size: float, seed: int) -> rf.Recording:
    """From an independent simulator: friction at the hub, and a sine at the motor that is not recorded."""
    u = rf.data.excitation.noise(round(SECONDS * FS), 1 / FS, seed=seed)
    wave = size * np.sin(2 * np.pi * FREQUENCY * np.arange(len(u)) / FS + seed)
    r = make_record({("coulomb", "hub"): {"level": 0.02}}, seed=seed, fs=FS, played=u + wave)
    return rf.Recording(u=u, y=r["y"], Ts=1 / FS, accept=("units",))


@pytest.fixture(scope="module")
def disturbed():
    said: list[str] = []
    parts = recording(SIZE, 3).split(0.7)
    found = rf.discover(rf.joints.paper(), *parts, candidates=CANDIDATES, rounds=3, progress=said.append)
    assert f"round 1: scoring {len(found.ranking)} candidates" in said and len(found.ranking) == 3
    return found


def test_a_disturbance_is_named_with_its_frequency_and_size_beside_friction(disturbed) -> None:
    assert disturbed.verdict is Verdict.FOUND
    found = {r.effect: r for r in disturbed.rounds}
    assert set(found) == {"coulomb", "periodic_disturbance"}
    p = found["periodic_disturbance"].parameters
    assert p["frequency"].value == pytest.approx(FREQUENCY, abs=0.01)
    # The true motor is up to 20 % stronger or weaker than the model's, whose torque per volt is trusted.
    assert np.hypot(p["sine"].value, p["cosine"].value) == pytest.approx(SIZE, rel=0.1)
    assert f"{FREQUENCY:.1f}" in found["periodic_disturbance"].sentence


def test_its_phase_is_that_of_each_recording(disturbed) -> None:
    """Errors on validation data are computed with the phase fitted to them, not with that of training."""
    (of_validation,) = disturbed.final.of_validation
    trained, own = (
        m.mechanism.effect("periodic_disturbance", "input") for m in (disturbed.model, of_validation)
    )
    assert own.frequency == trained.frequency
    phases = [np.arctan2(e.cosine, e.sine) for e in (trained, own)]
    # Validation data begin after seven seconds, where their time is zero again.
    moved = 2 * np.pi * own.frequency * 0.7 * SECONDS
    assert np.angle(np.exp(1j * (phases[1] - phases[0] - moved))) == pytest.approx(0, abs=0.3)
    validation = disturbed.validation[0]
    errors = [
        rf.metrics.rmse(validation, m.simulate(validation))["theta"] for m in (of_validation, disturbed.model)
    ]
    assert (
        disturbed.final.held_out_rmse["theta"] == pytest.approx(errors[0], rel=0.05)
        and errors[1] > 2 * errors[0]
    )
    assert any("comes from outside and belongs to each recording" in note for note in disturbed.notes)


def test_any_of_several_recordings_may_have_it() -> None:
    """One of two training recordings has a disturbance, and it is found.

    The reported parameters are those of the model, since the mean of phases of recordings has no meaning.
    """
    runs = [recording(0.0, 5).slice(0, 1200), recording(SIZE, 6).slice(0, 1200)]
    found = rf.discover(
        rf.joints.paper() + Coulomb("hub", level=0.02),
        runs,
        recording(SIZE, 7).slice(0, 1200),
        candidates=[(PeriodicDisturbance, "input"), (VoltageDrift, "input")],
        rounds=1,
    )
    (only,) = found.rounds
    effect = found.model.mechanism.effect("periodic_disturbance", "input")
    assert only.effect == "periodic_disturbance" and effect.frequency == pytest.approx(FREQUENCY, abs=0.03)
    for name in ("sine", "cosine"):
        assert only.parameters[name].value == pytest.approx(getattr(effect, name))
        assert only.parameters[name].value == pytest.approx(
            0.0, abs=0.05
        )  # of the first recording, which has none


def test_without_a_line_it_is_no_candidate() -> None:
    said: list[str] = []
    given = [*CANDIDATES, (VoltageOffset, "input"), (Motor, "hub")]
    parts = recording(0.0, 4).split(0.7)
    found = rf.discover(rf.joints.paper(), *parts, candidates=given, rounds=1, progress=said.append)
    assert [r.effect for r in found.rounds] == ["coulomb"]
    assert "periodic_disturbance" not in {x.effect for x in found.ranking}
    assert "voltage_drift" in {x.effect for x in found.ranking}
    without = "without periodic_disturbance at input, as the errors have no line that the input lacks"
    assert f"round 1: scoring {len(found.ranking)} candidates; {without}" in said
    (note,) = [n for n in found.notes if n.startswith("Not among the candidates")]
    assert note.endswith(": voltage offset, direct-current motor at the hub."), note
