"""Bands of a search's result: the model in their middle, and the uncertainty of the offset of a run."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.discover import Discovery
from rotflex_jax.discover.bands import bands_of_sets
from rotflex_jax.discover.result import SearchResult
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects import Inertia, Motor, VoltageOffset
from rotflex_jax.fit import Fit
from rotflex_jax.fit.bands import Bands
from rotflex_jax.recording.recording import joined

N, TS, NOISE = 300, 0.01, 1e-3
CONSTANT, OFFSET = "hub.motor.torque_constant", "input.voltage_offset.offset"
TORQUE_PER_VOLT = 0.01 * 10.0 / 2.0 / 0.01  # torque constant, gear, resistance, inertia [rad/s^2/V]
OWN = "own of each recording"


def axis() -> rf.Mechanism:
    """A double integrator, whose torque constant is free."""
    motor = Motor("hub", torque_constant=0.01, back_emf=0.0, resistance=2.0, gear_ratio=10.0)
    m = rf.Mechanism(("theta",), {"hub": (1.0,)}, (Inertia("hub", inertia=0.01), motor), {"theta": "hub"})
    return m.trust(*(name for name in m.parameter_names if name != CONSTANT))


@functools.cache
def run(seed: int, offset: float) -> rf.Recording:
    u = rf.data.excitation.multisine(N, TS, seed=seed)
    y = rf.simulate(axis(), u + offset, TS) + NOISE * np.random.default_rng(seed).normal(size=(N, 1))
    return rf.Recording(u=u, y=y, Ts=TS, channels=("theta",))


def searched(
    train: list[rf.Recording], validation: list[rf.Recording], carried: float | None
) -> SimpleNamespace:
    """A search that ends unexplained, with the final fit of the axis and an offset of the voltage.

    Args:
        train: Training recordings.
        validation: Validation recordings; the fit is to both.
        carried: Offset of the model to use; None if it has no such effect.
    """
    runs = joined([*train, *validation])
    fit = rf.fit(axis() + VoltageOffset("input"), runs, local=[OFFSET])
    m = fit.model.mechanism
    m = m.without("voltage_offset", "input") if carried is None else m.with_values({OFFSET: carried})
    model = dataclasses.replace(fit.model, mechanism=m)
    # As for offsets with a common part: the interval follows from their scatter, the covariance stays.
    apart = [dataclasses.replace(e, std=0.07) if e.name == OFFSET else e for e in fit.parameters]
    fit = dataclasses.replace(fit, parameters=tuple(apart))
    result = SimpleNamespace(
        train=tuple(train),
        validation=tuple(validation),
        model=model,
        offsets=(("voltage_offset", "input"),) if carried is not None else (),
        baseline=SimpleNamespace(model=rf.Model(axis())),
        final_fit=SimpleNamespace(fit=fit, recordings=runs),
        verdict=Verdict.UNEXPLAINED,
    )
    result.model_of = functools.partial(SearchResult.model_of, result)
    return result


def bands(result: SimpleNamespace, recording: rf.Recording, **known: rf.Recording) -> Bands:
    return Discovery.prediction_bands(result, recording, **known)


def per_volt(recording: rf.Recording) -> np.ndarray:
    """Change of the angle by an offset of 1 V, less the part that a fitted first state removes [rad/V]."""
    t = TS * np.arange(recording.N)
    X, moved = np.column_stack([np.ones(len(t)), t]), TORQUE_PER_VOLT * t**2 / 2
    head = slice(0, recording.n_init)
    return np.abs(moved - X @ np.linalg.lstsq(X[head], moved[head])[0])


def test_an_unknown_run_has_an_offset_about_as_far_off_as_those_of_fitted_runs():
    """The standard deviation of its offset is that of the fitted offsets about the value in the model.

    This value is not their mean.
    """
    other = run(7, 0.4)
    result = searched([run(1, 0.1)], [run(2, 0.3)], carried=0.15)
    found = bands(result, other)
    np.testing.assert_allclose(found.middle, result.model.simulate(other), atol=1e-9)
    spread = np.sqrt(0.2**2 / 2 + (0.2 - 0.15) ** 2)  # variance of 0.1 and 0.3, squared shift of their mean
    np.testing.assert_allclose(found.parts[OWN][:, 0], spread * per_volt(other), rtol=0.02, atol=1e-9)


def test_a_run_that_was_fitted_has_its_own_offset():
    result = searched([run(1, 0.1)], [run(2, 0.3)], carried=0.15)
    for recording in (run(2, 0.3), dataclasses.replace(run(2, 0.3), source="again")):
        found = bands(result, recording)
        fit = result.final_fit.fit
        i = fit.free_names.index(OFFSET)
        more = np.sqrt(fit.local[OFFSET][1].std ** 2 - fit.covariance[i, i])  # than the variance of the mean
        np.testing.assert_allclose(found.parts[OWN][:, 0], more * per_volt(recording), rtol=0.02, atol=1e-9)
        np.testing.assert_allclose(found.middle, result.model_of(recording).simulate(recording), atol=1e-9)
    assert np.std(found.middle - recording.y) < 2 * NOISE


def test_one_run_alone_says_how_large_an_offset_may_be():
    """The model has no offset, and the offset of the one fitted run is 0.2 V.

    The band of another run is around zero offset, with a standard deviation of 0.2 V.
    """
    whole, other = run(3, 0.2), run(7, -0.3)
    train, validation = whole.split(0.7)
    result = searched([train], [validation], carried=None)
    found = bands(result, other)
    np.testing.assert_allclose(found.middle, result.model.simulate(other), atol=1e-9)
    np.testing.assert_allclose(found.parts[OWN][:, 0], 0.2 * per_volt(other), rtol=0.05, atol=1e-9)
    # A part of the fitted run is simulated without its offset too, so its band is as wide.
    part = bands(result, validation)
    np.testing.assert_allclose(part.parts[OWN][:, 0], 0.2 * per_volt(validation), rtol=0.05, atol=1e-9)


def test_whole_runs_that_were_fitted_say_what_the_final_fit_lacks():
    """If the final fit is wrong, errors over the fitted runs widen its bands to the given probability."""
    result = searched([run(1, 0.1)], [run(2, 0.3)], carried=0.15)
    fit = result.final_fit.fit
    wrong = fit.model.mechanism.with_values({CONSTANT: 0.012})
    result.final_fit.fit = dataclasses.replace(fit, model=rf.Model(wrong))
    each = [bands(result, r).coverage()["theta"] for r in (run(1, 0.1), run(2, 0.3))]
    assert np.mean(each) == pytest.approx(0.9, abs=0.03)
    known = bands(result, run(1, 0.1), known=run(2, 0.3))
    assert (
        known.parts["what the model lacks"][0] != bands(result, run(1, 0.1)).parts["what the model lacks"][0]
    )


def one_set(train: rf.Recording) -> Fit:
    return rf.fit(axis() + VoltageOffset("input"), train)


def test_sets_do_not_give_another_run_the_offset_of_the_only_one():
    whole, other = run(3, 0.2), run(7, -0.3)
    train, validation = whole.split(0.7)
    result = searched([train], [validation], carried=None)
    result.verdict, fit = Verdict.FOUND, one_set(train)
    found = bands_of_sets(result, [(fit, 1.0)], other, 0.9, ())
    np.testing.assert_allclose(
        found.parts[OWN][:, 0], fit[OFFSET].value * per_volt(other), rtol=0.05, atol=1e-9
    )
    same = bands_of_sets(result, [(fit, 1.0)], validation, 0.9, ())
    assert OWN not in same.parts and same.coverage()["theta"] > 0.8
    result.validation = (other,)  # two runs were compared, so the offset belongs to the machine
    assert OWN not in bands_of_sets(result, [(fit, 1.0)], run(8, 0.2), 0.9, ()).parts
    # An offset of the user's own model belongs to the machine too.
    result.validation = (validation,)
    result.baseline = SimpleNamespace(model=rf.Model(axis() + VoltageOffset("input")))
    assert OWN not in bands_of_sets(result, [(fit, 1.0)], other, 0.9, ()).parts


def test_validation_data_say_what_the_sets_of_an_unexplained_search_lack():
    """If a set is wrong, errors over validation data widen its band, but only of an unexplained search."""
    train, validation = run(3, 0.2), run(4, 0.2)
    result, fit = searched([train], [validation], carried=0.2), one_set(train)
    wrong = dataclasses.replace(fit, model=rf.Model(fit.model.mechanism.with_values({CONSTANT: 0.012})))
    found = bands_of_sets(result, [(wrong, 1.0)], validation, 0.9, ())
    assert found.coverage()["theta"] == pytest.approx(0.9, abs=0.02)
    result.verdict = Verdict.FOUND
    assert bands_of_sets(result, [(wrong, 1.0)], validation, 0.9, ()).coverage()["theta"] < 0.6
