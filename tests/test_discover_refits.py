"""Refits of candidates from starts that are far too large."""

from typing import NamedTuple

import numpy as np
import pytest
import small_problem as sp

import rotflex_jax.effects as fx
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, usual_start, with_candidate
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.stepwise import fit_baseline, refit_candidates
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel, build, scales
from rotflex_jax.models.model import Model

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
    data = sp.dataset(found)
    s = build(sp.baseline(), WANTED, scales(Model(sp.baseline()), found, data.torque_scale))
    problem = LikelihoodProblem.of(s, sp.SOLVER, data, ("hub", "joint"))
    return Fitted(s, problem, fit_baseline(problem))


@pytest.mark.parametrize(
    ("location", "size"),
    [(LAG, [0.3]), (DELAY, [0.3]), (GRAVITY, [50.0, -80.0])],
    ids=lambda x: x.effect if isinstance(x, EffectLocation) else "",
)
def test_a_model_with_one_more_effect_fits_no_worse(fitted: Fitted, location, size):
    """The effect is absent from the recordings, and its start is a hundred times a plausible size.

    At a size of zero the model is the baseline, so the likelihood at the optimum is no lower.
    """
    start = CandidateStart(location, np.array(size), expected_gain=5.0)
    (at_start,) = fitted.problem.log_likelihoods(
        [with_candidate(fitted.supermodel, fitted.baseline, start, 1.0)]
    )
    assert at_start < fitted.baseline.log_likelihood - 1000
    (grown,) = refit_candidates(fitted.problem, fitted.baseline, [start])
    gain = grown.log_likelihood - fitted.baseline.log_likelihood
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
