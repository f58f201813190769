"""The model of a search that ends unexplained is fitted once more, to training and validation data."""

import dataclasses
import functools
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scipy.stats

import rotflex_jax as rf
from rotflex_jax.discover import conclusion
from rotflex_jax.discover.final_fit import MOST_WORSE, log_error_ratio
from rotflex_jax.discover.final_structure import FinalStructure, FittedStructure
from rotflex_jax.discover.result import RunErrors
from rotflex_jax.discover.selection import choose
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.tables import FITTED_TO_ALL, error_lists, final_fit_sentence, parameter_rows
from rotflex_jax.effects import Coulomb, VoltageDrift, VoltageOffset
from rotflex_jax.experiment import until_decided
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.parameters import Estimate

MODULE = sys.modules[log_error_ratio.__module__]
STRUCTURE = sys.modules[FinalStructure.__module__]
INERTIA, DRIVE, DAMPING = 0.0075, 48.4 * 0.0107 / 3.29, (48.4 * 0.0107) ** 2 / 3.29
LEVEL, OFFSET, CANDIDATES = "hub.coulomb.level", "input.voltage_offset.offset", [(Coulomb, "hub")]


def run(level: float, offset: float, seed: int, N: int = 3000, excess: float = 0.0):
    """An arm without a spring under a noisy voltage.

        J w' = c (u + offset) - b w - friction

    in explicit steps of 0.1 ms, with static friction. With an `excess` the friction falls with the speed
    (Stribeck), on a scale of 1 rad/s. The encoder has steps of 0.5 mrad.
    """
    Ts, fine = 0.002, 20
    rng, h = np.random.default_rng(seed), Ts / fine
    u = np.repeat(rng.normal(0.0, 1.5, N // 50), 50)
    y, q, w = np.empty((N, 1)), 0.0, 0.0
    for k in range(N):
        y[k] = round((q + 1e-4 * rng.standard_normal()) / 5e-4) * 5e-4
        drive = DRIVE * (u[k] + offset)
        for _ in range(fine):
            friction = level + excess * np.exp(-(w**2))
            if w == 0.0 and abs(drive) <= friction:
                break
            direction = np.sign(w if w else drive)
            after = w + h * (drive - DAMPING * w - friction * direction) / INERTIA
            w = 0.0 if after * w < 0 else after
            q += h * w
    return rf.Recording(u, y, Ts, channels=("theta",), n_init=50)


@pytest.fixture(scope="module")
def runs():
    """Runs for training, validation and testing; the friction of the last is between that of the others."""
    return run(0.05, 0.0, 0), run(0.075, 0.0, 1), run(0.07, 0.0, 2)


@pytest.fixture(scope="module")
def arm():
    return rf.joints.rotary_arm(flexible=False)


@pytest.fixture(scope="module")
def found(runs, arm):
    train, validation, test = runs
    return rf.discover(arm, train, validation, test=test, candidates=CANDIDATES, rounds=1)


@pytest.fixture(scope="module")
def searched_error(runs, arm) -> float:
    """Error over 2 s of validation data of a search without candidates."""
    train, validation, _ = runs
    found = rf.discover(arm, train, validation, candidates=[], rounds=0, calibrate_seconds=0.0)
    return found.final.held_out_rmse_windows["theta"]


def level_of(model: rf.Model) -> float:
    return float(model.mechanism.named_values[LEVEL])


def short_runs_miss(model: rf.Model, r: rf.Recording) -> float:
    """Root mean square error over windows of 2 s, without the first `n_init` samples of each window."""
    e, window = (model.simulate_windows(r, 2.0) - r.y)[:, 0], round(2.0 / r.Ts)
    counted = [part[r.n_init :] for part in np.split(e, range(window, r.N, window))]
    return float(np.sqrt(np.mean(np.concatenate(counted) ** 2)))


def test_it_has_learnt_from_both(found, runs):
    """The final fit has a level between those of both runs, and a smaller error on the test run."""
    last, (_, _, test) = found.final_fit, runs
    assert found.verdict == "unexplained" and last is not None
    assert found.model is last.model
    assert level_of(found.final.model) == pytest.approx(0.05, rel=0.05)
    assert 0.055 < level_of(found.model) < 0.08
    assert short_runs_miss(found.model, test) < 0.6 * short_runs_miss(found.final.model, test)


def test_its_errors_are_those_of_its_model(found, runs):
    last, (train, validation, test) = found.final_fit, runs
    assert last.test.windows["theta"] == pytest.approx(short_runs_miss(last.model, test), rel=1e-6)
    whole = rf.metrics.rmse(test, last.model.simulate(test))["theta"]
    assert last.test.whole["theta"] == pytest.approx(whole, rel=1e-6)
    # `rf.fit` gives the same; fitted to training data alone, it gives the errors `trained`. Friction of the
    # validation run differs by half, too little to have a size of its own in a model that leaves errors.
    structure, local = found.final.model.mechanism, list(last.fit.local)
    if OFFSET in local:
        structure = structure + rf.effects.VoltageOffset("input")
    how = {"first": "measured", "window_seconds": 2.0}
    both = rf.fit(structure, [train, validation], local=local, **how).model
    assert level_of(both) == pytest.approx(level_of(found.model), rel=0.02)
    alone = rf.fit(structure, train, local=[n for n in local if n == OFFSET], **how).model
    assert last.trained.windows["theta"] == pytest.approx(short_runs_miss(alone, validation), rel=0.2)


def test_its_errors_without_validation_data_are_with_the_friction_of_their_run(arm):
    """Friction of the validation run is nearly twice that of training, and falls with the speed in both.

    The errors `trained` are those of a fit to training data, with a level that `rf.fit` finds in the
    validation run while all else is held. A constant friction leaves errors, so the model has a final fit.
    """
    train, validation = run(0.05, 0.0, 0, excess=0.03), run(0.11, 0.0, 1, excess=0.03)
    found = rf.discover(arm, train, validation, candidates=CANDIDATES, rounds=1, calibrate_seconds=0.0)
    assert found.verdict == "unexplained" and LEVEL in found.final.friction_of_validation
    how = {"first": "measured", "window_seconds": 2.0}
    alone = rf.fit(found.final.model.mechanism, train, **how).model
    held = alone.mechanism.trust(*(n for n in alone.mechanism.parameter_names if n != LEVEL))
    own = rf.fit(held, validation, **how).model
    assert level_of(own) > 1.5 * level_of(alone)
    assert short_runs_miss(own, validation) < 0.2 * short_runs_miss(alone, validation)
    trained = found.final_fit.trained.windows["theta"]
    assert trained == pytest.approx(short_runs_miss(own, validation), rel=0.1)


def test_offsets_stay_with_their_runs(arm, monkeypatch):
    """Another run gets no offset; a later part of a fitted run gets the offset of this run."""
    monkeypatch.setattr(MODULE, "MOST_WORSE", np.inf)
    train = run(0.06, 0.03, 0)
    validation, rest = run(0.06, -0.03, 1, N=4500).split(2 / 3)
    model = arm + Coulomb("hub", level=0.02)
    found = rf.discover(model, train, validation, test=rest, candidates=[], rounds=0)
    last = found.final_fit
    assert [e.value for e in last.fit.local[OFFSET]] == pytest.approx([0.03, -0.03], abs=0.003)
    assert OFFSET not in last.model.mechanism.parameter_names
    assert OFFSET not in [e.name for e in found.estimates]
    assert level_of(last.model) == pytest.approx(0.06, rel=0.02)
    own = found.model_of(rest)
    assert own == last.fit.model_of(1) == found.model_of(validation)
    assert found.model_of(run(0.06, 0.0, 2)) == last.model
    assert last.test.windows["theta"] == pytest.approx(short_runs_miss(own, rest), rel=1e-6)
    assert short_runs_miss(own, rest) < 0.5 * short_runs_miss(last.model, rest)


def test_what_runs_have_in_common_of_their_offsets_is_carried_over(arm, monkeypatch):
    """For runs with offsets of 0.06 and 0.02 V, the model to use has an offset of 0.03 V."""
    monkeypatch.setattr(MODULE, "MOST_WORSE", np.inf)
    given = run(0.06, 0.06, 0), run(0.06, 0.02, 1)
    found = rf.discover(arm + Coulomb("hub", level=0.02), *given, candidates=[], rounds=0)
    value = found.model.mechanism.named_values
    assert value[OFFSET] == pytest.approx(0.03, abs=0.003)  # 0.04 (1 - 0.0008 / (2 0.04^2))
    estimate = next(e for e in found.estimates if e.name == OFFSET)
    assert estimate.value == value[OFFSET]
    assert estimate.std == pytest.approx(0.02, abs=0.003)  # standard deviation of the mean of two
    assert [n for n in found.notes if f"the model to use has {value[OFFSET]:+.3g} V." in n]


def test_what_most_runs_have_in_common_may_not_suit_a_run_of_validation_data(arm):
    """For offsets of 0.06, 0.06 and 0 V, 0.03 V would be carried over.

    This does not suit the validation run, which has no offset. So the model to use has no offset either.
    """
    train, validation = [run(0.06, 0.06, 0), run(0.06, 0.06, 1)], run(0.06, 0.0, 2)
    found = rf.discover(arm + Coulomb("hub", level=0.02), train, validation, candidates=[], rounds=0)
    last = found.final_fit
    assert last is not None and [e.value for e in last.fit.local[OFFSET]] == pytest.approx(
        [0.06, 0.06, 0.0], abs=0.005
    )
    assert OFFSET not in last.model.mechanism.parameter_names
    assert OFFSET not in last.to_dict()["parameters"]


def test_of_two_calibrations_one_may_be_carried_over(monkeypatch):
    """The common part of offsets of 0.06 and 0.02 V is 0.03 V; that of biases of 4 and -4 mrad is zero."""
    monkeypatch.setattr(MODULE, "MOST_WORSE", np.inf)
    joint, given = rf.joints.paper() + Coulomb("hub", level=0.02), []
    truth = joint.with_values({LEVEL: 0.03}) + rf.effects.CubicSpring("joint", stiffness=20.0)
    for seed, (offset, bias) in enumerate(((0.06, 0.004), (0.02, -0.004))):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.normal(0.0, 2.0, 60), 50)
        own = truth + rf.effects.VoltageOffset("input", offset=offset)
        y = rf.simulate(own + rf.effects.SensorBias("alpha", bias=bias), u, 0.002)
        y = y + 2e-4 * rng.standard_normal(y.shape)
        given.append(rf.Recording(u, y, 0.002, channels=("theta", "alpha"), n_init=50))
    found = rf.discover(joint, *given, candidates=[], rounds=0)
    value, local = values_of(found.model), found.final_fit.fit.local
    # The missing cubic spring shifts both biases alike.
    assert np.diff([e.value for e in local["alpha.sensor_bias.bias"]]) == pytest.approx(-0.008, abs=5e-4)
    assert value[OFFSET] == pytest.approx(0.03, abs=0.003)
    assert "alpha.sensor_bias.bias" not in value
    assert "alpha.sensor_bias.bias" not in found.final_fit.to_dict()["parameters"]


def test_an_offset_is_carried_over_where_validation_data_are_better_with_it(monkeypatch):
    """Errors are 1 without offsets, 0.9 with the first, 0.95 with two, 0.8 with the first and the last."""
    errors = {"": 1.0, "a": 0.9, "ab": 0.95, "ac": 0.8}

    def carrying(on: str) -> SimpleNamespace:
        return SimpleNamespace(on=on, own=("a", "b", "c"), carrying=lambda location: carrying(on + location))

    def errors_of(validation, each, on):
        return RunErrors({}, {"theta": errors[on]})

    monkeypatch.setattr(MODULE, "errors_as_trained", errors_of)
    tried: Any = SimpleNamespace(fits=(), structure=carrying(""))
    evaluation: Any = SimpleNamespace(validation=None)
    assert MODULE._with_offsets_that_help(tried, evaluation).on == "ac"


@pytest.mark.parametrize("kept_for", ["its use", "validation data", ""])
def test_an_offset_of_the_one_run_that_it_hardly_needs_is_left_out(arm, monkeypatch, kept_for):
    """Validation data of the same run are better with the offset, but other runs do not have it.

    It stays if free runs are clearly better with it, or if the fit without it is refused.
    """
    asked, errors_of = [], MODULE._on_validation

    def prefer(last, a, b, every=False):
        asked.append([OFFSET in fit.model.mechanism.parameter_names for fit in (a, b)])
        return kept_for == "its use"

    def far_off(structure, trained, evaluation):
        errors = errors_of(structure, trained, evaluation)
        worse = 9 if kept_for == "validation data" and not structure.on else 1
        return RunErrors(errors.whole, {c: worse * e for c, e in errors.windows.items()})

    monkeypatch.setattr(MODULE._FinalFitBuilder, "runs_prefer", prefer)
    monkeypatch.setattr(MODULE, "_on_validation", far_off)
    if not kept_for:
        monkeypatch.setattr(MODULE, "MOST_WORSE", np.inf)
        monkeypatch.setattr(MODULE, "WINDOWS_APART", np.inf)
    train, validation = run(0.06, 0.03, 0, N=4500).split(2 / 3)
    other, model = run(0.06, 0.0, 1), arm + Coulomb("hub", level=0.02)
    found = rf.discover(model, train, validation, test=other, candidates=[], rounds=0)
    last, offset = found.final_fit, ("voltage_offset", "input")
    assert asked == [[True, False]]
    assert found.offsets == ((offset,) if kept_for else ())
    assert last.left_out == (() if kept_for else (offset,))
    assert (OFFSET in last.fit.model.mechanism.parameter_names) == bool(kept_for)
    assert ("It is without voltage offset, which" in final_fit_sentence(found)) != bool(kept_for)
    listed = json.loads(json.dumps(found.to_dict()))["final_fit"]["left_out"]
    assert listed == ([] if kept_for else [{"effect": "voltage_offset", "port": "input"}])
    missed = short_runs_miss(found.model_of(other), other)
    assert last.test.windows["theta"] == pytest.approx(missed, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "common"),
    [
        ((0.02, 0.02, 0.02), 0.02),
        ((0.03, -0.03), 0.0),
        ((0.0, 0.0), 0.0),
        ((0.06, 0.02), 0.03),
        ((0.06, 0.06, 0.0), 0.03),
        ((3.0, -1.0), 0.0),
    ],
)
def test_what_runs_have_in_common(values, common):
    """The values by hand: m max(0, 1 - s^2 / (K m^2)) from the mean m and variance s^2 of K runs."""
    each = [Estimate(OFFSET, v, 1e-4, (v - 2e-4, v + 2e-4), "V") for v in values]
    found = STRUCTURE._common(each)
    assert found.value == pytest.approx(common)
    assert found.std == pytest.approx(np.std(values, ddof=1) / np.sqrt(len(values)))
    if len(values) == 2:  # one degree of freedom: the quantile of a Cauchy distribution
        half = np.tan(np.pi * 0.475) * found.std
        assert found.ci95 == pytest.approx((common - half, common + half))


def values_of(model: rf.Model) -> dict[str, float]:
    return model.mechanism.named_values


@pytest.fixture
def fits(monkeypatch):
    """Records fits: model, recordings, local parameters, result; and structures with their best fits."""
    each, best, fit, fit_structures = [], [], STRUCTURE.fit, MODULE.fit_structures

    def noted(model, recordings, **how):
        each.append((model, recordings, how["local"], fit(model, recordings, **how)))
        return each[-1][-1]

    def all_noted(asked):
        ends = fit_structures(asked)
        best.extend((*a, end.fit) for a, end in zip(asked, ends, strict=True))
        return ends

    monkeypatch.setattr(STRUCTURE, "fit", noted)
    monkeypatch.setattr(MODULE, "fit_structures", all_noted)
    return SimpleNamespace(each=each, best=best)


def test_an_end_that_the_recordings_do_not_reach_is_taken_only_alone(monkeypatch):
    """It is not taken even if it is likelier than the others. A fit without a finite cost comes last."""
    remark = Remark("hub.cogging.periods", "beyond the recordings", "")
    bound = Remark("hub.lugre.damping", "at a bound", "")

    def ends(*kinds: tuple[float, tuple[Remark, ...]]) -> float:
        structure = SimpleNamespace(starts=range(len(kinds)), local=(), window_seconds=2.0, first="measured")
        of_starts = [SimpleNamespace(cost=cost, remarks=remarks) for cost, remarks in kinds]
        monkeypatch.setattr(STRUCTURE, "fit", lambda start, recordings, **how: of_starts[start])
        return STRUCTURE.fit_structures([(structure, [])])[0].fit.cost

    assert ends((-5.0, (remark,)), (-3.0, (bound,)), (-2.0, ())) == -3.0
    assert ends((-5.0, (remark,)), (-6.0, (remark,))) == -6.0
    assert ends((np.nan, ()), (-5.0, ())) == ends((np.nan, ()), (-5.0, (remark,))) == -5.0


def test_it_starts_from_usual_values_too_and_takes_the_likelier_end(runs, arm, fits, monkeypatch):
    """Starts: parameters of the search; the same with usual shapes of the effects found; all as given.

    In the last one the effects found have usual values, and the user's model is as given.
    """
    monkeypatch.setattr(MODULE, "MOST_WORSE", np.inf)
    # Fits with friction of its own size in each run would follow, which are not looked at.
    monkeypatch.setattr(MODULE._FinalFitBuilder, "with_own_friction", lambda last, candidate: candidate)
    train, validation, _ = runs
    rf.discover(arm, train, validation, candidates=[(rf.effects.Stribeck, "hub")], rounds=1)
    sizes, inertia = ["hub.stribeck.level", "hub.stribeck.excess"], "hub.inertia.inertia"
    alone = [end for structure, given, end in fits.best if len(given) == 1]
    for structure, given, end in fits.best[: len(alone) + 1]:
        searched, usual, fresh, *more = map(values_of, structure.starts)
        assert [usual[n] for n in (*sizes, inertia)] == [searched[n] for n in (*sizes, inertia)]
        assert usual["hub.stribeck.speed"] != searched["hub.stribeck.speed"]
        assert fresh["hub.stribeck.speed"] == usual["hub.stribeck.speed"]
        assert all(fresh[n] != searched[n] for n in sizes)
        assert {n: fresh[n] for n in values_of(rf.Model(arm))} == pytest.approx(values_of(rf.Model(arm)))
        ends = [
            e
            for m, r, local, e in fits.each
            if (len(r), local) == (len(given), structure.local) and any(m is s for s in structure.starts)
        ]
        # A fit with a Stribeck speed that the arm has not reached is taken only if there is no other.
        reached = [e for e in ends if not any(r.kind == "beyond the recordings" for r in e.remarks)]
        assert len(ends) == len(structure.starts) and end.cost == min(e.cost for e in reached or ends)
        # The fit to all recordings also starts from the fit to training recordings.
        assert more in ([],) if len(given) == 1 else more[0] in [values_of(e.model) for e in alone]


LAWS = [(Coulomb, "hub"), (rf.effects.Stribeck, "hub")]
LAWS_ON = tuple((law.name, port) for law, port in LAWS)


@pytest.fixture
def coulomb_found(monkeypatch):
    """Make a search choose the simpler law for any data, and not replace it at the end."""
    monkeypatch.setattr(sys.modules[choose.__module__], "_clearly_better", lambda *given: False)
    monkeypatch.setattr(sys.modules[rf.discover.__module__], "take_better_laws", lambda state: ())


def falling(seed: int) -> rf.Recording:
    """A run with friction that falls with the speed; the level differs between runs."""
    return run((0.02, 0.03, 0.025)[seed], 0.0, seed, excess=0.1)


def test_a_law_that_free_runs_prefer_by_far_stands_in_the_model_to_use(
    arm, coulomb_found, tmp_path, monkeypatch
):
    train, validation, test = map(falling, range(3))
    found = rf.discover(arm, train, validation, test=test, candidates=LAWS, rounds=1)
    last = found.final_fit
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert last.laws == ((("coulomb", "hub"), ("stribeck", "hub")),)
    assert ("stribeck", "hub") in found.added and ("coulomb", "hub") not in found.added
    values = last.model.mechanism.named_values
    assert LEVEL not in values and values["hub.stribeck.excess"] == pytest.approx(0.1, rel=0.2)
    assert last.test.windows["theta"] == pytest.approx(short_runs_miss(last.model, test), rel=1e-6)
    assert last.test.windows["theta"] < 0.5 * found.final.test.windows["theta"]
    told = json.loads(json.dumps(found.to_dict()))["final_fit"]
    assert told["laws"] == [{"found": ["coulomb", "hub"], "used": ["stribeck", "hub"]}]
    assert "Stribeck friction at the hub in the place of Coulomb friction at the hub" in str(found)
    read = rf.Model.load(found.save(tmp_path / "model.json"))
    np.testing.assert_array_equal(read.mechanism.values, last.model.mechanism.values)
    assert found.model_of(train).mechanism.effect("stribeck", "hub")
    # The table of a report has the meaning of the new parameters.
    (row,) = [r for r in parameter_rows(found) if r.name == "hub.stribeck.excess"]
    assert row.meaning and not row.held
    # The next experiment compares the effect found with its equivalent, in the model of the search.
    asked = []
    monkeypatch.setattr(
        conclusion, "next_experiment", lambda model, *pair, **how: asked.append((model, pair))
    )
    added = dataclasses.replace(found.rounds[0], equivalent=(("stribeck", "hub"),))
    conclusion.proposed(dataclasses.replace(found, rounds=(added,)))
    assert asked == [(found.final.model, (("coulomb", "hub"), ("stribeck", "hub")))]
    # Models of probable sets start from the parameters of the search.
    monkeypatch.setattr(until_decided, "fit", lambda model, recordings: model)
    models, _ = until_decided.models_of(found, lambda line: None)
    (coulomb,) = [m for name, m in models.items() if name == "coulomb@hub"]
    assert level_of(rf.Model.of(coulomb.mechanism)) == level_of(found.final.model)


def test_a_law_where_runs_validate_each_other(arm, coulomb_found):
    """Each run validates the law fitted to the other, which has smaller errors than the law found."""
    given = [falling(seed) for seed in range(2)]
    found = rf.discover(arm, given, candidates=LAWS, rounds=1)
    last = found.final_fit
    assert last.laws == ((("coulomb", "hub"), ("stribeck", "hub")),)
    assert values_of(found.model)["hub.stribeck.excess"] == pytest.approx(0.1, rel=0.2)
    seen = np.sqrt(np.mean([short_runs_miss(found.model_of(r), r) ** 2 for r in given]))
    assert seen < 0.5 * last.searched.windows["theta"]
    assert seen < last.trained.windows["theta"] < last.searched.windows["theta"]


def test_a_law_may_pass_where_the_one_found_does_not(arm, coulomb_found, monkeypatch):
    """The fit with Coulomb friction is refused for its errors on validation data; Stribeck friction passes.

    Without Stribeck friction among the candidates there is no final fit.
    """
    errors_of = MODULE._on_validation

    def far_off(structure, trained, evaluation):
        errors = errors_of(structure, trained, evaluation)
        if ("coulomb", "hub") not in structure.on:
            return errors
        return RunErrors(errors.whole, {c: 9 * e for c, e in errors.windows.items()})

    monkeypatch.setattr(MODULE, "_on_validation", far_off)
    train, validation, _ = map(falling, range(3))
    found = rf.discover(arm, train, validation, candidates=LAWS, rounds=1)
    assert found.final_fit.laws == ((("coulomb", "hub"), ("stribeck", "hub")),)
    found = rf.discover(arm, train, validation, candidates=LAWS[:1], rounds=1)
    assert found.final_fit is None and "to the training recordings alone" in refusals(found)[0]


def test_a_law_keeps_the_offsets_that_runs_have_in_common(arm, coulomb_found):
    train, validation, test = (run(0.025, 0.05, seed, excess=0.1) for seed in range(3))
    found = rf.discover(arm, train, validation, test=test, candidates=LAWS, rounds=1)
    value = values_of(found.model)
    assert found.final_fit.laws == ((("coulomb", "hub"), ("stribeck", "hub")),)
    assert value["hub.stribeck.excess"] == pytest.approx(0.1, rel=0.2)
    assert value[OFFSET] == pytest.approx(0.05, abs=0.005)
    missed = short_runs_miss(found.model, test)
    assert found.final_fit.test.windows["theta"] == pytest.approx(missed, rel=1e-6)
    assert missed < 0.5 * short_runs_miss(found.final.model, test)


def test_a_law_starts_from_the_fit_without_the_validation_data(arm, coulomb_found, fits):
    """The first start has the values of parameters that both laws share, the second has usual values."""
    train, validation, _ = map(falling, range(3))
    rf.discover(arm, train, validation, candidates=LAWS, rounds=1)
    coulomb = [(len(given), end) for structure, given, end in fits.best if structure.on == LAWS_ON[:1]]
    starts = next(structure.starts for structure, *_ in fits.best if structure.on == LAWS_ON[1:])
    law, usual = map(values_of, starts)
    begun = {LEVEL: law["hub.stribeck.level"], "hub.inertia.inertia": law["hub.inertia.inertia"]}
    same = [count for count, end in coulomb if begun == pytest.approx({n: end[n].value for n in begun})]
    assert same == [1] and {count for count, _ in coulomb} == {1, 2}
    assert usual["hub.inertia.inertia"] == values_of(rf.Model(arm))["hub.inertia.inertia"]
    assert usual["hub.stribeck.level"] != law["hub.stribeck.level"]


def test_a_richer_law_needs_a_use(arm, coulomb_found):
    """The true friction is Coulomb friction with a different level in each run."""
    train, validation = run(0.05, 0.0, 0), run(0.075, 0.0, 1)
    found = rf.discover(arm, train, validation, candidates=LAWS, rounds=1)
    assert found.final_fit.laws == () and LEVEL in found.model.mechanism.parameter_names


def test_a_law_that_validation_data_speak_against_is_not_taken(arm, coulomb_found, monkeypatch):
    """Stribeck friction is refused if, fitted to training data alone, it diverges on validation data."""
    errors_of = MODULE._on_validation

    def diverging(structure, trained, evaluation):
        errors = errors_of(structure, trained, evaluation)
        lost = dict.fromkeys(errors.windows, np.inf)
        return RunErrors(lost, lost) if ("stribeck", "hub") in structure.on else errors

    monkeypatch.setattr(MODULE, "_on_validation", diverging)
    train, validation, _ = map(falling, range(3))
    found = rf.discover(arm, train, validation, candidates=LAWS, rounds=1)
    assert found.final_fit.laws == () and LEVEL in found.model.mechanism.parameter_names


def comparing(recordings: list[Any]) -> Any:
    """A builder of final fits that has only what it needs to compare fits: recordings and window length."""
    state: Any = SimpleNamespace(
        validation=SimpleNamespace(window_seconds=2.0, folds=True),
        problem=SimpleNamespace(dataset=SimpleNamespace(recordings=tuple(recordings))),
    )
    return MODULE._FinalFitBuilder(state, cast(Any, None), cast(Any, None))


def test_free_runs_are_compared_by_the_likelihood_of_half_seconds(arm, runs):
    """The reference is scipy's normal density; the last block also contains the samples that are left."""
    train = runs[0].split(0.7)[0]
    fit = rf.fit(arm + Coulomb("hub", level=0.06), train, first="measured", window_seconds=2.0)
    e = (fit.model.simulate_windows(train, 2.0) - train.y)[:, 0]
    each = scipy.stats.norm.logpdf(e, scale=fit.noise["theta"]) + 0.5 * np.log(2 * np.pi)
    assert train.N == 2100
    expected = [part.sum() for part in np.split(each, range(250, 2000, 250))]
    last = comparing([train])
    (blocks,) = last.blocks(fit)
    np.testing.assert_allclose(blocks, expected)
    assert not last.runs_prefer(fit, fit)


@pytest.mark.parametrize(
    ("falls", "smaller", "preferred"),
    [
        ([0.2, 0.25, 0.15, 0.2], 0.2, True),
        ([0.2, 0.25, 0.15, 0.2], 0.09, False),  # by less than a tenth
        ([1.0, -0.1, -0.1, 0.0], 0.2, False),  # in one half second only
    ],
)
def test_a_law_is_preferred_where_free_runs_are_better_everywhere(falls, smaller, preferred, monkeypatch):
    last, before = comparing([]), np.array([1.0, 3.0, 2.0, 5.0])
    a, b = (SimpleNamespace(noise={"theta": x}) for x in (np.exp(-smaller), 1.0))
    two = [before[:2], before[2:]]
    better = [x + f for x, f in zip(two, np.split(np.array(falls), 2), strict=True)]
    monkeypatch.setattr(MODULE._FinalFitBuilder, "blocks", lambda self, f: better if f is a else two)
    assert last.runs_prefer(a, b) == preferred


@pytest.mark.parametrize(("diverges", "preferred"), [("a", False), ("b", True), ("ab", False)])
def test_a_fit_that_diverges_is_never_preferred(diverges, preferred):
    fits = [SimpleNamespace(noise={"theta": np.nan if name in diverges else 1.0}) for name in "ab"]
    assert comparing([]).runs_prefer(*fits) == preferred


@pytest.mark.parametrize(("second", "preferred"), [([4.0, 5.0], True), ([0.5, -0.4], False)])
def test_what_every_run_has_to_prefer_helps_each(second, preferred, monkeypatch):
    """With `every`, each run must be clearly better, not only all runs together."""
    last, before = comparing([]), [np.arange(6.0)] * 2
    a, b = (SimpleNamespace(noise={"theta": x}) for x in (0.5, 1.0))
    after = [before[0] + np.tile([5.0, 6.0], 3), before[1] + np.tile(second, 3)]
    monkeypatch.setattr(MODULE._FinalFitBuilder, "blocks", lambda self, f: after if f is a else before)
    assert last.runs_prefer(a, b)
    assert last.runs_prefer(a, b, every=True) == preferred


def test_friction_may_belong_to_each_run(arm):
    """Friction is 0.03 N m in the training run, and 0.12 N m in the run of validation and test data."""
    train, (validation, rest) = run(0.03, 0.0, 0), run(0.12, 0.0, 1, N=6000).split(0.5)
    other = run(0.07, 0.0, 2)
    model = arm + Coulomb("hub", level=0.06)
    found = rf.discover(model, train, validation, test=[rest, other], candidates=[], rounds=0)
    last = found.final_fit
    assert last.friction == (LEVEL,)
    assert [e.value for e in last.fit.local[LEVEL]] == pytest.approx([0.03, 0.12], rel=0.05)
    # A later part of a fitted run gets the friction of this run, an unknown run gets the mean.
    assert level_of(found.model_of(rest)) == pytest.approx(0.12, rel=0.05)
    assert level_of(found.model_of(other)) == level_of(found.model) == pytest.approx(0.075, rel=0.05)
    misses = [short_runs_miss(found.model_of(r), r) ** 2 for r in (rest, other)]
    assert last.test.windows["theta"] == pytest.approx(np.sqrt(np.mean(misses)), rel=1e-3)
    whole = [found.model_of(r).simulate(r)[r.n_init :] - r.y[r.n_init :] for r in (rest, other)]
    assert last.test.whole["theta"] == pytest.approx(
        float(np.sqrt(np.mean(np.concatenate(whole) ** 2))), rel=1e-3
    )
    assert last.to_dict()["friction_of_runs"] == {LEVEL: [e.value for e in last.fit.local[LEVEL]]}
    assert re.search(r"hub\.coulomb\.level 0\.0[23]\d*, 0\.1[12]\d* N m", final_fit_sentence(found))
    (row,) = [row for row in parameter_rows(found) if row.name == LEVEL]
    assert re.fullmatch(r"mean of runs with 0\.0[23]\d*, 0\.1[12]\d*", row.note)


@pytest.mark.parametrize(
    ("left", "preferred", "taken"), [(0.5, False, True), (2.9, False, False), (2.9, True, True)]
)
def test_a_large_offset_that_becomes_small_is_friction_of_the_run(left, preferred, taken, monkeypatch):
    """Friction of its own is taken where every run prefers it, or where it takes the place of an offset."""
    last = comparing([object(), object()])
    last = dataclasses.replace(last, evaluation=SimpleNamespace(runs=SimpleNamespace(compared=True)))
    monkeypatch.setattr(MODULE._FinalFitBuilder, "recordings", (object(), object()))
    monkeypatch.setattr(MODULE._FinalFitBuilder, "searched", None)
    monkeypatch.setattr(MODULE, "log_error_ratio", lambda a, b: 0.0)
    monkeypatch.setattr(MODULE._FinalFitBuilder, "runs_prefer", lambda self, a, b, every: preferred)
    last.state.say = lambda text: None
    own = SimpleNamespace(fit="own", own_offsets=np.array([[0.2], [left]]))
    monkeypatch.setattr(MODULE, "fit_structures", lambda asked: [own])
    fitted = SimpleNamespace(
        fit="shared",
        structure=SimpleNamespace(friction=()),
        own_offsets=np.array([[0.2], [3.0]]),
        with_own_friction=lambda: SimpleNamespace(friction=(LEVEL,)),
    )
    candidate = MODULE._Candidate(cast(Any, SimpleNamespace(errors=None)), cast(Any, fitted))
    assert last.with_own_friction(candidate).fitted is (own if taken else fitted)


def test_offsets_of_runs_are_in_typical_sizes(arm):
    """The typical size is 0.05 V. Friction of its own size in each run is no offset, nor is a drift."""
    mechanism = arm + Coulomb("hub") + VoltageOffset("input") + VoltageDrift("input")
    drift = next(n for n in mechanism.parameter_names if "voltage_drift" in n)
    local = {OFFSET: [0.1, -0.02], LEVEL: [0.03, 0.06], drift: [9.0, 9.0]}
    fit: Any = SimpleNamespace(
        local={n: [SimpleNamespace(value=v) for v in values] for n, values in local.items()}
    )
    calibrations = [mechanism.parameter_names.index(OFFSET)]
    structure: Any = SimpleNamespace(supermodel=SimpleNamespace(mechanism=mechanism, local=calibrations))
    np.testing.assert_allclose(FittedStructure(structure, fit).own_offsets, [[2.0], [-0.4]])
    del fit.local[OFFSET]
    assert FittedStructure(structure, fit).own_offsets.size == 0


def test_friction_that_runs_share_stays_the_machine_s(arm):
    train, validation = run(0.06, 0.03, 0), run(0.06, -0.03, 1)
    found = rf.discover(arm + Coulomb("hub", level=0.02), train, validation, candidates=[], rounds=0)
    assert found.final_fit.friction == ()
    assert level_of(found.model) == pytest.approx(0.06, rel=0.05)


def test_data_may_speak_against_it(runs, arm, monkeypatch):
    """A final fit with errors above the limit is refused with a note, and the search's model is used."""
    monkeypatch.setattr(MODULE, "MOST_WORSE", -np.inf)
    train, validation, _ = runs
    found = rf.discover(arm, train, validation, candidates=[], rounds=0)
    assert found.verdict == "unexplained" and found.final_fit is None
    assert found.model is found.final.model and found.to_dict()["final_fit"] is None
    assert final_fit_sentence(found) == ""
    (note,) = refusals(found)
    assert "on validation data are" in note


def refusals(found: rf.Discovery) -> list[str]:
    """Notes on a final fit that was refused."""
    return [n for n in found.notes if n.startswith("The model to use is that of the search, not one")]


def test_it_is_saved_and_told(found, runs, tmp_path: Path, monkeypatch):
    # The page without its figures, which take most of the time.
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    monkeypatch.setattr(rf.Discovery, "identifiability", lambda self: None)
    read = rf.Model.load(found.save(tmp_path / "model.json"))
    np.testing.assert_array_equal(read.mechanism.values, found.model.mechanism.values)
    told = json.loads(json.dumps(found.to_dict()))["final_fit"]
    assert told["parameters"][LEVEL]["value"] == level_of(found.model)
    assert set(told["parameters"]) == set(found.model.mechanism.parameter_names)
    assert told["test_rmse_windows"]["theta"] == found.final_fit.test.windows["theta"]
    by_title = {errors.title: errors.errors for errors in error_lists(found)}
    assert FITTED_TO_ALL in by_title["Test data"] and FITTED_TO_ALL not in by_title["Validation data"]
    assert "measured first states" in final_fit_sentence(found)
    assert str(found).endswith(final_fit_sentence(found))
    row = next(r for r in parameter_rows(found) if r.name == LEVEL)
    assert len(row.stages) == len(found.stages) + 1
    page = found.report(tmp_path / "report", learned=False).read_text()
    assert FITTED_TO_ALL in page and "training and validation recordings together" in page
    # The error at the top of the page is that of the model to use on test data.
    top = page[page.index("error over 2 s of test data") :]
    shown = next(float(x) for x in re.findall(r"→ </span>([\d.]+) deg", top))
    assert shown == pytest.approx(np.rad2deg(short_runs_miss(found.model, runs[2])), rel=0.01)


def test_runs_that_validate_each_other(runs, arm):
    """The search has fitted all runs already, but with fitted first states."""
    found = rf.discover(arm + Coulomb("hub", level=0.02), list(runs), candidates=[], rounds=0)
    last = found.final_fit
    assert found.verdict == "unexplained" and last is not None
    assert 0.05 < level_of(found.model) < 0.08
    # Friction differs between runs, so a fit without a run has a larger error on it than the fit to all.
    seen = np.sqrt(np.mean([short_runs_miss(found.model, r) ** 2 for r in runs]))
    assert last.trained.windows["theta"] > seen


def test_what_recordings_know_is_theirs(arm, monkeypatch):
    """The inertia is a constant of each recording; the fit and its errors use the value of each."""
    inertia, given = "hub.inertia.inertia", []
    for seed, (level, J) in enumerate(((0.05, 0.0075), (0.075, 0.012), (0.07, 0.02))):
        monkeypatch.setitem(globals(), "INERTIA", J)
        r = run(level, 0.0, seed)
        given.append(dataclasses.replace(r, constants={inertia: J}))
    train, validation, test = given
    known = arm.trust(inertia) + Coulomb("hub", level=0.02)
    last = rf.discover(known, train, validation, test=test, candidates=[], rounds=0).final_fit
    missed = short_runs_miss(last.model, test)
    assert last.test.windows["theta"] == pytest.approx(missed, rel=1e-6)
    assert missed < 0.5 * short_runs_miss(last.model, dataclasses.replace(test, constants={inertia: 0.0075}))


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (0.98, None),
        # e^(1.02 * 0.2) is 1.23
        (1.02, "alone, its errors over 2 s on validation data are 1.23 times as large."),
        (np.inf, "to the training recordings alone, its runs of the validation data diverge."),
    ],
)
def test_a_clearly_worse_way_is_not_taken(runs, arm, searched_error, monkeypatch, share, said):
    """Errors on validation data of the fit to training data are set just below or above the limit."""
    train, validation, _ = runs
    theirs = searched_error
    tried, limit = MODULE._FinalFitBuilder.tried, float(np.exp(share * MOST_WORSE) * theirs)

    def on_validation(structure, trained, evaluation):
        return RunErrors({"theta": 0.0}, {"theta": 0.9 * theirs})

    def alone(last, structures):
        # With fitted first states the errors are larger still; the note has those with measured ones.
        error = {"measured": limit, "fitted": 3 * limit}
        return [
            t._replace(errors=RunErrors({"theta": 0.0}, {"theta": error[t.structure.first]}))
            for t in tried(last, structures)
        ]

    monkeypatch.setattr(MODULE, "_on_validation", on_validation)
    monkeypatch.setattr(MODULE._FinalFitBuilder, "tried", alone)
    found = rf.discover(arm, train, validation, candidates=[], rounds=0, calibrate_seconds=0.0)
    assert (found.final_fit is None) == (said is not None)
    assert [note.endswith(said or "") for note in refusals(found)] == [True] * (said is not None)


def test_where_measured_first_states_do_worse_the_fit_is_with_fitted_ones(runs, arm, monkeypatch):
    """It equals `rf.fit` to both recordings; the search, fitted to one of them, has less friction."""
    train, validation, test = runs
    tried = MODULE._FinalFitBuilder.tried

    def worse_from_measured(last, structures):
        each = tried(last, structures)
        lost = RunErrors({"theta": np.inf}, {"theta": np.inf})
        return [t._replace(errors=lost) if t.structure.first == "measured" else t for t in each]

    monkeypatch.setattr(MODULE._FinalFitBuilder, "tried", worse_from_measured)
    found = rf.discover(arm, train, validation, test=test, candidates=LAWS[:1], rounds=1)
    last = found.final_fit
    assert last.fit.options.first == found.to_dict()["final_fit"]["first"] == "fitted"
    assert refusals(found) == [] and "with fitted first states" in final_fit_sentence(found)
    structure, local = found.final.model.mechanism, list(last.fit.local)
    if OFFSET in local:
        structure = structure + rf.effects.VoltageOffset("input")
    by_hand = rf.fit(structure, [train, validation], local=local, window_seconds=2.0)
    assert level_of(found.model) == pytest.approx(by_hand[LEVEL].value, rel=1e-3)
    assert level_of(found.final.model) < 0.97 * level_of(found.model)
    missed = short_runs_miss(found.model, test)
    assert last.test.windows["theta"] == pytest.approx(missed, rel=1e-6)


@pytest.mark.parametrize(("share", "taken"), [(0.98, True), (1.02, False)])
def test_errors_that_differ_by_less_than_a_tenth_are_not_distinguished(
    runs, arm, searched_error, monkeypatch, share, taken
):
    train, validation, _ = runs
    tried, alone = MODULE._FinalFitBuilder.tried, []

    def without_validation_data(last, structures):
        alone.extend(tried(last, structures))
        return alone

    def on_validation(structure, trained, evaluation):
        return RunErrors(
            {"theta": 0.0}, {"theta": float(np.exp(0.1 * share if alone else 0.0) * searched_error)}
        )

    monkeypatch.setattr(MODULE, "_on_validation", on_validation)
    monkeypatch.setattr(MODULE._FinalFitBuilder, "tried", without_validation_data)
    found = rf.discover(arm, train, validation, candidates=[], rounds=0, calibrate_seconds=0.0)
    assert (found.final_fit is not None) == taken


def test_a_fit_that_has_failed_is_not_handed_on(runs, arm, monkeypatch):
    """A fit to all recordings with large errors on them, here by a wrong inertia, is refused with a note."""
    train, validation, _ = runs
    fit = STRUCTURE.fit

    def lost(model, recordings, **how):
        found = fit(model, recordings, **how)
        if len(recordings) < 2:
            return found
        m = found.model.mechanism.with_values({"hub.inertia.inertia": 1.0})
        return dataclasses.replace(found, model=rf.Model(m, found.model.solver))

    monkeypatch.setattr(STRUCTURE, "fit", lost)
    found = rf.discover(arm, train, validation, candidates=[], rounds=0)
    assert found.verdict == "unexplained" and found.final_fit is None
    (note,) = refusals(found)
    assert "times as large, although it was fitted to them" in note


def test_what_cannot_be_fitted_costs_nothing_else(runs, arm, monkeypatch):
    """If the recordings cannot be fitted together, the result of the search remains, with a note."""

    def refuse(model, recordings, **how):
        raise rf.InputError("One channel does not move.")

    monkeypatch.setattr(STRUCTURE, "fit", refuse)
    train, validation, _ = runs
    found = rf.discover(arm, train, validation, candidates=[], rounds=0)
    assert found.verdict == "unexplained" and found.final_fit is None
    (note,) = refusals(found)
    assert note.endswith("recordings together: One channel does not move.")


def test_of_many_runs_each_third_is_left_out(monkeypatch):
    """Five runs give three fits, and each run is validated by a fit without it."""

    def fit_structures(asked):
        return [
            SimpleNamespace(of=(structure, *part), as_hypothesis=lambda: None) for structure, part in asked
        ]

    monkeypatch.setattr(MODULE, "fit_structures", fit_structures)
    monkeypatch.setattr(MODULE, "_on_validation", lambda structure, fits, evaluation: structure)
    structures: list[Any] = ["one", "another"]
    for structure, tried in zip(structures, comparing(list(range(5))).tried(structures), strict=True):
        parts = [(1, 2, 4), (0, 2, 3), (0, 1, 3, 4), (1, 2, 4), (0, 2, 3)]
        assert [fitted.of for fitted in tried.fits] == [(structure, *part) for part in parts]
        assert tried.errors is structure


def test_the_ratio_of_errors_weighs_channels_alike():
    a, b = ({"theta": 2.0, "alpha": 0.3}, {"theta": 1.0, "alpha": 0.3})
    assert log_error_ratio(RunErrors({}, a), RunErrors({}, b)) == pytest.approx(0.5 * np.log(2))
    assert log_error_ratio(RunErrors({}, a | {"alpha": np.nan}), RunErrors({}, b)) == np.inf
    assert log_error_ratio(RunErrors({}, a), RunErrors({}, b | {"alpha": np.inf})) == -np.inf
    assert log_error_ratio(RunErrors({}, a), RunErrors({}, b | {"alpha": 0.0})) > MOST_WORSE
    assert 0 < MOST_WORSE < np.log(2)


COULOMB_HUB, LAG, COGGING, BIAS, LUGRE_HUB = (
    EffectLocation(*p)
    for p in (
        ("coulomb", "hub"),
        ("lag", "input"),
        ("cogging", "arm"),
        ("sensor_bias", "alpha"),
        ("lugre", "hub"),
    )
)


def fewer_effects(needed=(), spoken_for=(), refused=()):
    """Elimination from a model with LuGre friction in the place of Coulomb's, a lag, cogging and a bias.

    Args:
        needed: Effects with which free runs of all recordings are clearly better.
        spoken_for: Effects without which runs of validation data are worse by more than a tenth.
        refused: Effects without which the fit is refused.
    """
    said, every = [], (LUGRE_HUB, LAG, COGGING, BIAS)

    def fitted(on, data):
        less = lambda left_out: SimpleNamespace(  # noqa: E731
            on=tuple(p for p in on if p not in left_out), start=data
        )
        return SimpleNamespace(structure=SimpleNamespace(on=on), fit=on, without=less)

    def tried(structures):
        (structure,) = structures
        assert structure.start == "training"  # a start fitted to all recordings would use validation data
        lost = 0.15 if set(spoken_for) - set(structure.on) else 0.0
        errors = RunErrors({}, {"theta": np.exp(lost)})
        return [MODULE._Tried([fitted(structure.on, "training")], errors)]

    last = SimpleNamespace(
        state=SimpleNamespace(
            say=said.append,
            problem=SimpleNamespace(supermodel=SimpleNamespace(calibrations=(BIAS,))),
        ),
        runs_prefer=lambda a, b: bool((set(a) - set(b)) & set(needed)),
        tried=tried,
        fitted_to_all=lambda tried: fitted(tried.structure.on, "all"),
        accepted=lambda c: MODULE.Refused("") if set(refused) - set(c.fitted.structure.on) else (),
    )
    last.without = functools.partial(MODULE._FinalFitBuilder.without, last)
    (found,) = tried([SimpleNamespace(on=every, start="training")])
    candidate = MODULE._Candidate(found, last.fitted_to_all(found), laws=((COULOMB_HUB, LUGRE_HUB),))
    return MODULE._FinalFitBuilder.without_needless_effects(last, candidate), said, last


def test_effects_that_free_runs_hardly_need_are_not_in_the_model_to_use():
    """The effect found last is tried first; the first effect and calibrations always stay."""
    found, said, _ = fewer_effects()
    assert said == [f"  without {p}" for p in (COGGING, LAG)]
    assert found.left_out == (COGGING, LAG) and found.fitted.structure.on == (LUGRE_HUB, BIAS)
    assert found.tried.structure.on == (LUGRE_HUB, BIAS) and found.laws == ((COULOMB_HUB, LUGRE_HUB),)


@pytest.mark.parametrize("reason", ["needed", "spoken_for", "refused"])
def test_an_effect_that_data_need_stays(reason):
    found, _, _ = fewer_effects(**{reason: [COGGING]})
    assert found.left_out == (LAG,) and found.fitted.structure.on == (LUGRE_HUB, COGGING, BIAS)


def test_of_a_law_in_the_place_of_one_that_was_found_that_one_is_left_out():
    """If a law is left out, the effects that it had replaced are listed, and not the law itself."""
    candidate, _, last = fewer_effects(needed=[LAG, COGGING])
    delays = EffectLocation("delay", "input"), EffectLocation("channel_delay", "alpha")
    candidate = candidate._replace(laws=tuple((p, LAG) for p in delays))
    last.runs_prefer = lambda a, b: False
    found = last.without(candidate, [LAG])
    assert found.left_out == delays and found.laws == ()
