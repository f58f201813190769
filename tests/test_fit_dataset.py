"""Recordings prepared for fits, and runs that restart at windows against separate runs of the windows."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import small_problem as sp

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.discover.evaluation import calibrate
from rotflex_jax.discover.likelihood import refit
from rotflex_jax.discover.score_test import score_test
from rotflex_jax.discover.stepwise import fit_baseline, refit_candidates
from rotflex_jax.discover.validation import Horizons, as_free_run, validate
from rotflex_jax.errors import InputError
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import Windows, padded_length, prepare
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    outputs_with_sensitivities,
)
from rotflex_jax.mechanism.simulate import simulate
from rotflex_jax.metrics import counted, window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.persistent_jit import program_counts
from rotflex_jax.runtime.xla import double_precision

SECONDS = 0.6


@pytest.fixture(scope="module")
def horizons() -> Horizons:
    """Recordings with friction at the hub, which the baseline lacks, and further ones for validation."""
    train, unseen = (sp.problem(sp.recordings(sp.records(0.02, seeds))) for seeds in ((21, 22), (23, 24)))
    return Horizons.of(Model(sp.baseline()), train, unseen, SECONDS)


@pytest.fixture(scope="module")
def moved(horizons):
    """A hypothesis for free runs, with a different first state in each window."""
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
    """Outputs of each window equal those of a simulation of this part of the voltage alone."""
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
    """Friction at the hub has a score above 50 nats, with a level within 50 % of the true 0.02 N m."""
    problem = horizons.free_run.problem
    h = refit(problem, [as_free_run(problem, sp.fitted(horizons.prediction.problem))])[0]
    found = {x.location: x for x in score_test(problem, h).listed}[sp.HUB]
    assert found.nats > 50 and found.start.values[0] == pytest.approx(0.02, rel=0.5)


def test_sensors_with_states_of_their_own_start_again_too():
    """A delayed channel with cross-talk in windows, as a free run and as a predictor with zero gain.

    Outputs equal separate simulations of the windows, and slopes their difference quotients.
    """
    machine = sp.baseline() + fx.ChannelDelay("alpha", time=0.004) + fx.CrossTalk("alpha", share=0.02)
    rng, Ts, N, (W, n), P = np.random.default_rng(3), 0.0025, 90, (3, 6), len(machine.values)
    u, x0 = np.repeat(rng.uniform(-4, 4, N // 10), 10), rng.normal(0, 0.05, (W, n))
    window = np.repeat(np.arange(W, dtype=np.int32), N // W)
    name = machine.parameter_names.index("alpha.channel_delay.time")

    def alone(values: np.ndarray) -> np.ndarray:
        moved = machine.with_values(values)
        return np.concatenate([simulate(moved, u[window == k], Ts, x0[k], sp.SOLVER) for k in range(W)])

    values, nudge = machine.values, 1e-7 * (np.arange(P) == name)
    expected, slope = alone(values), (alone(values + nudge) - alone(values - nudge)) / 2e-7
    with double_precision():
        gates = jnp.ones(len(machine.effects))
        samples = RecordingSamples(*map(jnp.asarray, (u, np.zeros((N, 2)), np.ones(N), Ts, window)))
        ways = TangentDirections(jnp.eye(P)[None, name], jnp.zeros((1, len(gates))), jnp.zeros((1, n)))
        for K in (None, jnp.zeros((n, 2))):
            numbers = RunParameters(jnp.asarray(values), gates, jnp.asarray(x0), K)
            y, J = outputs_with_sensitivities(machine.structure, sp.SOLVER, numbers, ways, samples)
            np.testing.assert_allclose(y, expected, rtol=0, atol=1e-11)
            np.testing.assert_allclose(J[..., 0], slope, rtol=0, atol=1e-6 * np.abs(slope).max())


def test_a_late_channel_is_seen_at_both_horizons():
    """The score test finds a delay of alpha by one sample, and a refit gains what the score predicts."""
    made = tuple(dataclasses.replace(r, y=late(r.y)) for r in sp.recordings(sp.records(0.0)))
    wanted = [(fx.ChannelDelay, "alpha"), (fx.CrossTalk, "alpha"), *sp.WANTED]
    s = sp.supermodel_of(wanted, made)
    problem = sp.problem(made, s)
    both = Horizons.of(Model(sp.baseline()), problem, None, SECONDS)
    h = fit_baseline(both.prediction.problem)
    runs = refit(both.free_run.problem, [as_free_run(both.free_run.problem, h)])[0]
    for at, fitted in ((both.prediction.problem, h), (both.free_run.problem, runs)):
        best, second, *_ = score_test(at, fitted).listed
        assert best.location == ("channel_delay", "alpha") and best.nats > 100 > second.nats
        grown = refit_candidates(at, fitted, [best.start])[0]
        assert grown.log_likelihood - fitted.log_likelihood > 0.9 * best.start.expected_gain
        time = grown.mean_values(s)[s.parameter_indices(best.location)]
        np.testing.assert_allclose(time, 1 / 400, rtol=0.05)


def late(y: np.ndarray) -> np.ndarray:
    """The second channel one sample later."""
    return np.column_stack([y[:, 0], np.concatenate([y[:1, 1], y[:-1, 1]])])


def test_a_recording_that_is_left_out_has_no_say(horizons):
    """A fit without a recording does not depend on the samples of that recording."""
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
    mine, theirs = (refit(p, [as_free_run(p, h)])[0] for p in (first.train, other))
    np.testing.assert_array_equal(mine.z, theirs.z)


def test_runs_that_validate_each_other_are_fits_without_each(horizons):
    """The parameters that validate each run are those of a fit to the other run alone."""
    both = Horizons.of(Model(sp.baseline()), horizons.prediction.problem, None, SECONDS).free_run
    h = refit(both.problem, [as_free_run(both.problem, sp.fitted(horizons.prediction.problem))])[0]
    found = validate(both.validation, h)
    assert len(found.folds) == 2 and len(found.blocks) == len(h.blocks)
    for k, fold in enumerate(both.validation.folds):
        alone = refit(fold.train, [as_free_run(fold.train, h)])[0]
        values = found.adapted.values(both.problem.supermodel)[k]
        np.testing.assert_allclose(
            values[list(h.free)], alone.mean_values(both.problem.supermodel)[list(h.free)], rtol=2e-3
        )


def test_the_first_seconds_give_a_run_its_offset(horizons):
    """0.1 V is subtracted from the recorded voltage: the offsets are 0.1 V plus the +-20 mV of the runs."""
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


def test_runs_that_validate_each_other_count_by_their_samples():
    """The error of all runs is that of their samples together: a short run does not count like a long one."""
    long, short = sp.recordings(sp.records(0.0))
    made = (long, short.slice(0, short.N // 4))
    problem = sp.problem(made, sp.supermodel_of(sp.WANTED, made))
    both = Horizons.of(Model(sp.baseline()), problem, None, SECONDS).free_run
    h = as_free_run(both.problem, fit_baseline(problem))
    found = validate(both.validation, h)
    each = [
        validate(fold.validation, fitted).window_rmse
        for fold, fitted in zip(both.validation.folds, found.folds, strict=True)
    ]
    samples = [counted(r, SECONDS).sum() for r in made]
    together = np.sqrt(np.average(np.square(each), axis=0, weights=samples))
    np.testing.assert_allclose(found.window_rmse, together, rtol=1e-3)


def test_one_recording_alone_cannot_validate_itself():
    from rotflex_jax import discover

    (one, *_) = sp.recordings(sp.records(0.0))
    with pytest.raises(InputError, match=r"recording\.split"):
        discover(sp.baseline(), one)


MODEL = rf.Model(rf.joints.paper())


def recording(N: int, Ts: float, size: float = 1.0) -> rf.Recording:
    u = size * np.sin(np.arange(N) / 20)
    y = rf.simulate(MODEL.mechanism, u, Ts) + 1e-3 * np.random.default_rng(N).normal(size=(N, 2))
    return rf.Recording(u=u, y=y, Ts=Ts, accept=("units",))


def test_shorter_recordings_are_padded_with_samples_that_do_not_count():
    both = recording(300, 0.004), recording(200, 0.005)
    data = prepare(MODEL, both, length=padded_length(both)).data
    assert data.y.shape == (2, 320, 2) and data.u.shape == data.seen.shape == (2, 320)
    np.testing.assert_array_equal(data.seen.sum(axis=1), [300, 200])
    np.testing.assert_array_equal(data.Ts, [0.004, 0.005])
    for r, u, y, seen in zip(both, data.u, data.y, data.seen > 0, strict=True):
        np.testing.assert_array_equal(u[seen], r.u)
        np.testing.assert_array_equal(y[seen], r.y)
        assert not y[~seen].any()


def test_samples_that_do_not_count_are_no_part_of_the_errors():
    """The errors of each recording are cut to its own length, and an unseen recording has no part."""
    rng = np.random.default_rng(3)
    model = Model(sp.baseline())
    long, *_ = sp.recordings(sp.records(0.02, (21,)))
    short = long.split(100 / long.N)[0]
    dataset = prepare(model, [long, short])
    windows, seen = Windows.whole(dataset), dataset.data.seen
    coordinates = FitCoordinates(3, 0, 0, windows)
    e = rng.normal(size=dataset.data.y.shape) * seen[:, :, None]
    J = rng.normal(size=(*e.shape, 3)) * seen[:, :, None, None]
    parts = coordinates.parts(e, J, seen)
    assert [len(p.e) for p in parts] == [long.N, short.N]
    of_each = [e[r, : n.N] for r, n in enumerate((long, short))]
    for p, mine in zip(parts, of_each, strict=True):
        np.testing.assert_array_equal(p.e, mine)
    left_out = coordinates.parts(e, J, seen * np.array([[1.0], [0.0]]))
    assert len(left_out) == 1 and left_out[0].columns.tolist() == [0, 1, 2]


def test_noise_and_torque_are_those_of_the_recordings_or_taken_over():
    small, large = recording(900, 0.004), recording(900, 0.004, size=3.0)
    first = prepare(MODEL, [small], noise_of=[large])
    np.testing.assert_allclose(first.noise, 1e-3, rtol=0.15)
    other = prepare(MODEL, [large])
    assert other.torque_scale == pytest.approx(3 * first.torque_scale)
    assert first.first_states.shape == other.first_states.shape == (1, 4)
    like = prepare(MODEL, [large], like=first)
    assert like.noise is first.noise and like.torque_scale == first.torque_scale
    np.testing.assert_array_equal(like.first_states, other.first_states)


@pytest.mark.parametrize(("longest", "length"), [(1000, 1024), (1024, 1024), (1025, 1152), (1152, 1152)])
def test_lengths_come_in_eight_steps_to_the_next_power_of_two(longest, length):
    assert padded_length([recording(400, 0.01), recording(longest, 0.01)]) == length


def test_without_a_recording_there_is_nothing_to_prepare():
    assert padded_length([]) == 0
    with pytest.raises(rf.InputError, match="No recording"):
        prepare(MODEL, [])


@pytest.mark.parametrize("how", [{"window_seconds": 0.5, "restarts": 0}, {"first": "measured"}], ids=str)
def test_a_fit_compiles_nothing_for_other_lengths_or_more_recordings(how):
    """Also if all recordings together are so long that restarts begin with longer windows."""
    first, longer, shorter = (recording(N, 0.02) for N in (1000, 1024, 964))
    rf.fit(MODEL, first, **how)

    def made() -> int:
        counts = program_counts()
        return counts.compiled + counts.loaded

    before = made()
    for given in (longer, [longer, shorter], [first, shorter, longer]):
        rf.fit(MODEL, given, **how)
    assert made() == before
    rf.fit(MODEL, recording(1025, 0.02), **how)  # the next padded length
    assert made() > before
