"""Runs that start again at windows: against runs that begin there, in values, slopes and scores."""

import dataclasses

import numpy as np
import pytest
import small_problem as sp

from rotflex_jax.discover.coordinates import FitCoordinates
from rotflex_jax.discover.evaluation import calibrate
from rotflex_jax.discover.horizon import Horizons, as_free_run, fit_free_runs
from rotflex_jax.discover.score_test import scores
from rotflex_jax.discover.validation import validate
from rotflex_jax.discover.windows import Windows
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.simulate import simulate
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model

SECONDS = 0.6


@pytest.fixture(scope="module")
def horizons() -> Horizons:
    """Recordings with friction at the hub, which the baseline lacks; another set to validate."""
    train, unseen = (sp.problem(sp.recordings(sp.records(0.02, seeds))) for seeds in ((21, 22), (23, 24)))
    return Horizons.of(Model(sp.baseline()), train, unseen, SECONDS)


@pytest.fixture(scope="module")
def moved(horizons):
    """Any hypothesis in free runs, with first states of its own in each window."""
    problem = horizons.free_run.problem
    h = as_free_run(problem, sp.start(horizons.prediction.problem, wrong=0.05))
    return dataclasses.replace(h, x0=h.x0 + 1e-3 * np.random.default_rng(0).normal(size=h.x0.shape))


def test_windows_are_those_of_the_metrics(horizons):
    problem = horizons.free_run.problem
    for r, recording in enumerate(problem.dataset.recordings):
        starts = window_starts(recording, SECONDS)[0]
        assert problem.windows.counts[r] == len(starts) > 1
        assert [samples.start for _, samples in problem.windows.of(r)] == starts.tolist()


def test_a_window_is_a_run_that_begins_there(horizons, moved):
    """Outputs of each window against a simulation of its stretch of the voltage alone."""
    problem, s = horizons.free_run.problem, horizons.free_run.problem.supermodel
    e, data = problem.innovations([moved])[0], problem.dataset.data
    plain = s.clean(moved.mean_values(s), moved.locations)
    for r, recording in enumerate(problem.dataset.recordings):
        for k, samples in problem.windows.of(r):
            stretch = slice(samples.start, min(samples.stop, recording.N))
            y_hat = simulate(plain, data.u[r, stretch], float(data.Ts[r]), moved.x0[r, k], sp.SOLVER)
            np.testing.assert_allclose(data.y[r, stretch] - e[r, stretch], y_hat, atol=1e-10)


def test_slopes_of_windows_are_those_of_differences(horizons, moved):
    problem, step = horizons.free_run.problem, 1e-6
    coordinates = FitCoordinates.of(moved, problem.windows)
    _, J = problem.slopes([moved])
    for r, k in ((0, 0), (0, 1), (1, 1)):
        window = dict(problem.windows.of(r))[k]
        for d, column in enumerate(coordinates.columns(r, k)):
            nudge = np.zeros(coordinates.size)
            nudge[column] = step
            up, down = problem.innovations([coordinates.moved(moved, way * nudge) for way in (1, -1)])
            expected = (up - down)[r, window] / (2 * step)
            np.testing.assert_allclose(
                J[0, d, r, window], expected, rtol=0, atol=1e-5 * max(np.abs(expected).max(), 1e-6)
            )


def test_the_score_of_free_runs_foretells_what_a_fit_gains(horizons):
    """To first order: a small step of the amplitude lowers the cost as the score says."""
    problem = horizons.free_run.problem
    h = fit_free_runs(problem, sp.fitted(horizons.prediction.problem))
    found = {x.location: x for x in scores(problem, h)}[sp.HUB]
    assert found.nats > 50 and found.start.values[0] == pytest.approx(0.02, rel=0.5)


def test_a_recording_that_is_left_out_has_no_say(horizons):
    """What is fitted without it does not change with what it holds."""
    whole = horizons.free_run.problem
    h = as_free_run(whole, sp.start(horizons.prediction.problem))
    validation = Horizons.of(Model(sp.baseline()), horizons.prediction.problem, None, SECONDS)
    (first, _) = validation.free_run.validation.folds
    assert first.train.seen[0].sum() == 0 and first.train.seen[1].sum() > 0
    assert first.validation.problem.seen[1].sum() == 0
    spoilt = whole.dataset.data.y.copy()
    spoilt[0] += 1.0
    data = first.train.dataset.data._replace(y=spoilt)
    other = dataclasses.replace(
        first.train,
        predictor=dataclasses.replace(first.train.predictor, data=data),
        dataset=dataclasses.replace(first.train.dataset, data=data),
    )
    mine, theirs = (fit_free_runs(p, h) for p in (first.train, other))
    np.testing.assert_array_equal(mine.z, theirs.z)


def test_runs_that_validate_each_other_are_fits_without_each(horizons):
    """The error of each run is that of the model fitted to the other one alone."""
    both = Horizons.of(Model(sp.baseline()), horizons.prediction.problem, None, SECONDS).free_run
    h = fit_free_runs(both.problem, sp.fitted(horizons.prediction.problem))
    found = validate(both.validation, h)
    assert len(found.folds) == 2 and len(found.blocks) == len(h.blocks)
    for k, fold in enumerate(both.validation.folds):
        alone = fit_free_runs(fold.train, h)
        values = found.adapted.values(both.problem.supermodel)[k]
        np.testing.assert_allclose(
            values[list(h.free)], alone.mean_values(both.problem.supermodel)[list(h.free)], rtol=2e-3
        )


def test_the_first_seconds_give_a_run_its_offset(horizons):
    """What is taken from the recorded voltage is found beside the recordings' own, 20 mV each way."""
    problem = horizons.free_run.validation.problem
    h = sp.start(horizons.prediction.problem)
    s, offset = problem.supermodel, 0.1
    shifted = problem.dataset.data._replace(u=problem.dataset.data.u - offset)
    problem = dataclasses.replace(
        problem,
        predictor=dataclasses.replace(problem.predictor, data=shifted),
        dataset=dataclasses.replace(problem.dataset, data=shifted),
    )
    rich = dataclasses.replace(h, locations=(*h.locations, sp.HUB), z=h.z.copy())
    index = s.parameter_indices(sp.HUB)[0]
    rich.z[index] = s.transform.unconstrain(np.where(np.arange(len(h.z)) == index, 0.02, h.values(s)[0]))[
        index
    ]
    early = calibrate(problem, rich, 1.0)
    found = early.values(s)[:, s.mechanism.parameter_names.index("input.voltage_offset.offset")]
    np.testing.assert_allclose(found, [offset + 0.02, offset - 0.02], atol=0.01)
    assert Windows.whole(problem.dataset).number == 1


def test_one_recording_alone_cannot_validate_itself():
    from rotflex_jax import discover

    (one, *_) = sp.recordings(sp.records(0.0))
    with pytest.raises(InputError, match=r"recording\.split"):
        discover(sp.baseline(), one)
