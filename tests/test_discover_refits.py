"""Refits of candidates from starts that are far too large."""

from typing import NamedTuple

import numpy as np
import pytest
import small_problem as sp

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, usual_start, with_candidate
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.stepwise import fit_baseline, refit_candidates
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import as_free_run
from rotflex_jax.fit.dataset import Windows

WANTED = [(fx.Lag, "input"), (fx.Delay, "input"), (fx.Gravity, "hub"), (fx.ChannelDelay, "alpha")]
LAG, DELAY, GRAVITY, LATE = (EffectLocation(cls.name, port) for cls, port in WANTED)


class Fitted(NamedTuple):
    """Recordings without a hidden effect, and the model fitted to them."""

    supermodel: SuperModel
    problem: LikelihoodProblem
    baseline: Hypothesis


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    found = sp.recordings(sp.records(0.0))
    s = sp.supermodel_of(WANTED, found)
    problem = sp.problem(found, s)
    return Fitted(s, problem, fit_baseline(problem))


@pytest.mark.parametrize("free_run", [False, True])
def test_a_model_with_one_more_effect_fits_no_worse(fitted: Fitted, free_run: bool):
    """The weight is absent from the recordings, and its start is larger than the motor's torque by far.

    At a size of zero the model is the baseline, so the likelihood at the optimum is no lower.
    """
    problem, baseline = fitted.problem, fitted.baseline
    if free_run:
        problem = problem.of_free_runs(Windows.whole(problem.dataset))
        (baseline,) = refit(problem, [as_free_run(problem, baseline)])
    start = CandidateStart(GRAVITY, np.array([50.0, -80.0]), expected_gain=5.0)
    (at_start,) = problem.log_likelihoods([with_candidate(fitted.supermodel, baseline, start, 1.0)])
    assert at_start < baseline.log_likelihood - 1000
    (grown,) = refit_candidates(problem, baseline, [start])
    gain = grown.log_likelihood - baseline.log_likelihood
    # The fit ends where a step gains less than 0.3 nat. Two further parameters gain about one nat by chance.
    assert -0.3 < gain < 5.0


@pytest.mark.parametrize("location", [LAG, DELAY, GRAVITY, LATE], ids=lambda p: p.effect)
def test_an_effect_vanishes_with_its_share(fitted: Fitted, location):
    """With a small share of its start, a candidate changes the likelihood by a small share too."""
    start = usual_start(fitted.supermodel, location)
    shares = [1.0, 1e-1, 1e-3]
    starts = [with_candidate(fitted.supermodel, fitted.baseline, start, share) for share in shares]
    lost = fitted.baseline.log_likelihood - fitted.problem.log_likelihoods(starts)
    assert lost[0] > 50 and lost[0] > lost[1] > lost[2]
    assert lost[2] < 0.05 * lost[0]


def test_a_richer_law_fitted_to_free_runs_also_starts_from_the_law_that_it_contains():
    """LuGre friction is hidden. From its usual start alone the fit ends in a local minimum, 400 nats too low.

    Coulomb friction fits far worse than that minimum, but the optimum is reached from its fit. Reference: the
    log-likelihood of white noise of the sensors' size, `-n log(2 pi e sigma^2) / 2` with a standard deviation
    of `sqrt(n / 2)`.
    """
    wanted = [(fx.Coulomb, "hub"), (fx.LuGre, "hub")]
    made = [
        make_record(
            {("lugre", "hub"): {"level": 0.03}}, seed=seed, seconds=1.6, fs=400.0, perturb=0.0, rms=1.5
        )
        for seed in (21, 22)
    ]
    found = sp.recordings(tuple(made))
    s = sp.supermodel_of(wanted, found)
    problem = sp.problem(found, s)
    baseline = fit_baseline(problem)
    free = problem.of_free_runs(Windows.whole(problem.dataset))
    (begin,) = refit(free, [as_free_run(free, baseline)])
    starts = [usual_start(s, EffectLocation(cls.name, port)) for cls, port in wanted]
    coulomb, lugre = refit_candidates(free, begin, starts)
    n = sum(r.y.size for r in found)
    of_noise = sum(-0.5 * r.y.shape[0] * np.log(2 * np.pi * np.e * sp.NOISE**2).sum() for r in found)
    assert coulomb.log_likelihood < of_noise - 1000
    assert lugre.log_likelihood > of_noise - 3 * np.sqrt(n / 2)
