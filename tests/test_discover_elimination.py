"""Backward elimination of an effect beside a law that contains it."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import small_problem as sp

import rotflex_jax.effects as fx
from rotflex_jax.discover import search, stepwise
from rotflex_jax.discover.hypothesis import (
    CandidateStart,
    Hypothesis,
    handed_over,
    usual_start,
    with_effect,
    without,
)
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel, build, scales
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.models.model import Model

COULOMB, STRIBECK = EffectLocation("coulomb", "hub"), EffectLocation("stribeck", "hub")
ARM = EffectLocation("coulomb", "arm")
SIZES = {COULOMB: [0.004], STRIBECK: [0.003, 0.002, 0.5], ARM: [0.001]}


@pytest.fixture(scope="module")
def s() -> SuperModel:
    wanted = ((fx.Coulomb, "hub"), (fx.Stribeck, "hub"), (fx.Coulomb, "arm"))
    wanted += ((fx.Gravity, "hub"), (fx.Cogging, "hub"))
    return build(sp.baseline(), wanted, scales(Model(sp.baseline()), sp.recordings(sp.records()), 0.1))


def holding(s: SuperModel, *locations: EffectLocation) -> Hypothesis:
    """The baseline with effects of these sizes."""
    h = sp.unfitted(s)
    for location in locations:
        h = with_effect(s, h, CandidateStart(location, np.array(SIZES[location])), 1.0)
    return h


def simulated(s: SuperModel, h: Hypothesis) -> np.ndarray:
    """A free run with the effects of a hypothesis."""
    gates = tuple(s.gates(h.locations))  # one program for all
    model = Model(s.mechanism.with_values(h.mean_values(s)), sp.SOLVER, gates)
    return model.simulate(sp.recordings(sp.records())[0])


def test_a_law_that_contains_an_effect_takes_over_its_size(s):
    """The level of Coulomb friction is added to that of Stribeck friction, so the free run stays the same.

    Without this addition the run changes by more than 20 times the noise.
    """
    both = holding(s, COULOMB, STRIBECK, ARM)
    y = simulated(s, both)
    one = handed_over(s, both, COULOMB)
    assert COULOMB not in one.locations and {STRIBECK, ARM} <= set(one.locations)
    values = one.mean_values(s)[s.parameter_indices(STRIBECK)]
    np.testing.assert_allclose(values, [0.007, 0.002, 0.5], rtol=1e-9)
    np.testing.assert_allclose(simulated(s, one), y, atol=1e-9)
    assert np.abs(simulated(s, without(s, both, COULOMB)) - y).max() > 20 * sp.NOISE[0]
    # There is no law in the model that contains these effects at their ports, nor one for calibrations.
    assert handed_over(s, both, ARM) is handed_over(s, both, STRIBECK) is None
    assert all(handed_over(s, both, p) is None for p in s.calibrations)
    # Cogging contains gravity at one of its periods only; at others its amplitudes cannot take over gravity.
    gravity, cogging = EffectLocation("gravity", "hub"), EffectLocation("cogging", "hub")
    assert cogging.contains(gravity)
    turning = with_effect(s, with_effect(s, both, usual_start(s, gravity), 1.0), usual_start(s, cogging), 1.0)
    assert handed_over(s, turning, gravity) is None


@pytest.mark.parametrize("locations", [(COULOMB, STRIBECK), (COULOMB, ARM)])
def test_of_two_levels_at_one_port_one_is_needless(s, monkeypatch: pytest.MonkeyPatch, locations):
    """Coulomb friction beside Stribeck friction at the hub is left out, even if nothing is refitted.

    Beside Coulomb friction at the arm it stays.
    """
    true = simulated(s, holding(s, *locations))

    def costs(hypotheses: list[Hypothesis]) -> list[np.ndarray]:
        return [-0.5 * np.sum(((simulated(s, h) - true) / sp.NOISE) ** 2, axis=1) for h in hypotheses]

    def evaluated(problem, hypotheses: list[Hypothesis], **_) -> list[Hypothesis]:
        """Log-likelihoods of free runs, no fit."""
        return [
            dataclasses.replace(h, densities=np.array([d, 0 * d]), blocks=d.reshape(8, -1).sum(axis=1))
            for h, d in zip(hypotheses, costs(hypotheses), strict=True)
        ]

    problem = SimpleNamespace(supermodel=s, measured_values=2 * len(true))
    at = SimpleNamespace(problem=problem)
    alike = ValidatedHypothesis(sp.unfitted(s), np.zeros(2), sp.unfitted(s), np.ones(2))
    horizons = SimpleNamespace(prediction=at, free_run=at, validated=lambda *_: alike)
    monkeypatch.setattr(stepwise, "refit", evaluated)
    (h,) = evaluated(problem, [holding(s, *locations)])
    needed = stepwise.eliminate(horizons, h, h, list(locations))
    for h in (needed.prediction, needed.free_run):
        assert set(h.locations) - set(s.calibrations) == {
            p for p in locations if p != COULOMB or ARM in locations
        }
        np.testing.assert_allclose(simulated(s, h), true, atol=1e-9)


@pytest.mark.parametrize(("blocks", "needed"), [(1, False), (3, False), (5, True), (40, True)])
def test_a_gain_from_a_few_moments_needs_no_effect(
    monkeypatch: pytest.MonkeyPatch, blocks: int, needed: bool
) -> None:
    """A gain of 100 nats in k of 40 equal blocks has z = sqrt(39 k / (40 - k)), above two from k = 4 on."""
    gain = np.where(np.arange(40) < blocks, 100.0 / blocks, 0.0)
    held: Any = SimpleNamespace(locations=(COULOMB, ARM), log_likelihood=100.0, blocks=gain)
    less = SimpleNamespace(locations=(ARM,), log_likelihood=0.0, blocks=np.zeros(40))
    problem = SimpleNamespace(supermodel=SimpleNamespace(calibrations=()), measured_values=1e4)
    at = SimpleNamespace(problem=problem)
    horizons: Any = SimpleNamespace(prediction=at, free_run=at, validated=lambda *_: None)
    monkeypatch.setattr(stepwise, "refit_without", lambda problem, h, tested, **_: [less] * len(tested))
    monkeypatch.setattr(stepwise, "parameter_count", lambda *_: 1)
    monkeypatch.setattr(stepwise, "_need", lambda *_: False)
    assert (stepwise.eliminate(horizons, held, held, [COULOMB, ARM]).prediction is held) is needed


@pytest.mark.parametrize(("count", "loss"), [(1, 2.0), (3, 12.0)])
@pytest.mark.parametrize("side", [0.99, 1.01], ids=["below", "above"])
def test_one_effect_replaces_an_effect_with_an_offset_in_each_recording(
    monkeypatch: pytest.MonkeyPatch, count: int, loss: float, side: float
) -> None:
    """It may lose 2 nats and half a log N for each parameter that it saves: count - 1 of exp(10) values.

    Symmetric friction and an offset have 1 + count parameters, asymmetric friction has 2.
    """
    rich, offset = EffectLocation("coulomb_asymmetric", "hub"), EffectLocation("voltage_offset", "input")
    candidate = SimpleNamespace(amplitudes=np.array([True, True]), probes=[[np.array([0.02, 0.02])]])
    indices = {COULOMB: [0], rich: [1, 2], offset: [3]}
    s = SimpleNamespace(calibrations=(offset,), candidates={rich: candidate}, parameter_indices=indices.get)
    h = SimpleNamespace(
        mean_values=lambda s: np.full(4, 0.02), x0=np.zeros((count, 1, 4)), log_likelihood=0.0
    )
    found = SimpleNamespace(log_likelihood=-side * loss)
    validated = SimpleNamespace(hypothesis=h, with_trained_calibrations=lambda s: h)
    problem: Any = SimpleNamespace(supermodel=s, measured_values=np.exp(10.0))
    validation: Any = SimpleNamespace(short_run_errors=lambda h, locations: np.ones(2))
    for name, stub in {
        "without": lambda s, h, location: h,
        "with_effect": lambda *_: h,
        "refit": lambda *_, **__: [found],
        "parameter_count": lambda *_: 1,
        "is_physical": lambda *_: True,
        "validate": lambda *_: validated,
    }.items():
        monkeypatch.setattr(stepwise, name, stub)
    final: Any = validated
    merged = stepwise.merge_effects(problem, validation, final, [COULOMB, offset])
    assert (merged is not None) is (side < 1)
    if merged:
        assert (merged.effect, merged.replaced, merged.same_count) == (rich, (COULOMB, offset), count == 1)


@pytest.mark.parametrize("more", [COULOMB, STRIBECK])
def test_the_law_that_is_left_has_gained_what_was_found_first(s, monkeypatch: pytest.MonkeyPatch, more):
    """Stribeck friction gets the rivals of the Coulomb friction that it replaces.

    It also gets the gain and the score of Coulomb friction if this gain is larger.
    """
    left, elsewhere = holding(s, STRIBECK, ARM), EffectLocation("gravity", "hub")
    alike = ValidatedHypothesis(left, np.zeros(2), left, np.ones(2))
    current = dataclasses.replace(alike, hypothesis=holding(s, COULOMB, STRIBECK, ARM), free_run=alike)
    problem = SimpleNamespace(supermodel=s)
    horizons = SimpleNamespace(validated=lambda *_: alike, prediction=SimpleNamespace(problem=problem))
    state = SearchState(Model(sp.baseline()), horizons, lambda line: None, current)
    state.scores = {COULOMB: 10.0, STRIBECK: 5.0, ARM: 3.0}
    sizes = {p: 100.0 if p == more else 20.0 for p in state.scores}
    state.gains = {p: (HorizonGain(x, 9.0, 0.5, x), None) for p, x in sizes.items()}
    state.rivals = {COULOMB: [elsewhere, STRIBECK], STRIBECK: [EffectLocation("cogging", "hub")], ARM: []}
    monkeypatch.setattr(search, "eliminate", lambda *_: stepwise.Eliminated(left, left, {}, []))
    search._eliminate(state)
    assert state.gains[STRIBECK][0].gain == 100.0 and state.gains[ARM][0].gain == 20.0
    assert state.scores == {COULOMB: 10.0, STRIBECK: 10.0 if more == COULOMB else 5.0, ARM: 3.0}
    assert state.rivals[STRIBECK] == [EffectLocation("cogging", "hub"), elsewhere] and state.rivals[ARM] == []
    assert state.current is alike is state.tried[0]
