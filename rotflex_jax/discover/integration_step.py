"""The integration step of a search: its effect on parameters and on free runs, and a shorter one.

A search integrates in the steps of the user's model, one per sample if nothing else is asked for. Reported
parameters are corrected for the bias by these steps. Where the steps are so long that most of the error of
free runs comes from them, the search goes on with shorter steps.
"""

import dataclasses

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import MIN_DECREASE_NATS, LikelihoodProblem, refit
from rotflex_jax.discover.pairs import is_unexplained
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.stepwise import as_given
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.mechanism import Exponential
from rotflex_jax.mechanism.finer_step import with_finer_steps
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise

# Where friction sticks and slips at other samples, the slopes predict too large a decrease. Most steps need
# no more damping than this; otherwise a few steps are refused until the damping is large enough.
CORRECTION_RULES = Rules(enough=MIN_DECREASE_NATS, damping=1e-6, increase=30)
MAX_CORRECTION_STEPS = 10
# Steps are too long if shorter ones change free runs by more than this share of the error that is left.
MOST_OF_ERROR = 0.5


def finer_integration(problem: LikelihoodProblem, h: Hypothesis) -> LikelihoodProblem | None:
    """The likelihood with shorter integration steps; None where `with_finer_steps` has no shorter ones."""
    s = problem.supermodel
    solver = with_finer_steps(problem.predictor.solver, s.clean(h.mean_values(s), h.locations).effects)
    return problem.with_solver(solver) if solver else None


def correct_discretisation_bias(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """The hypothesis after a few damped Gauss-Newton steps on the innovations of a finer integration.

        x <- x - (J'J)^-1 J'w

    with the slopes `J` of the integration step of the search and the whitened innovations `w` of
    `finer_integration`. Friction that builds up within a sample may shift an estimate by several of its
    standard deviations. Where the motion is linear, the step is exact and no parameter moves.

    Args:
        problem: Likelihood of the training recordings.
        h: The hypothesis at its optimum.
    """
    seen, fine = problem.seen, finer_integration(problem, h)
    if fine is None:
        return h
    coordinates = FitCoordinates.of(h, problem.windows)
    _, J = problem.slopes([h])
    W = h.whitener(J[0, : h.moved], seen)

    def linearise(x: Hypothesis) -> NormalEquations:
        w = h.whitener(fine.innovations([x])[0], seen)
        H, g = coordinates.sums(w, W)
        return NormalEquations(np.array([0.5 * np.sum(w**2)]), g, H)

    found = minimise(
        linearise,
        h,
        CORRECTION_RULES,
        limit=coordinates.step_limit(problem.step_limits(h)),
        move=coordinates.moved,
        max_steps=MAX_CORRECTION_STEPS,
    )
    return h if found.x is h else problem.with_likelihood(found.x)


def shorten_steps(state: SearchState) -> bool:
    """Integrate in shorter steps if the present ones cause most of the error; False if they do not.

    The present model is fitted again with the shorter steps, and becomes the only one that was tried: sets of
    effects that were fitted with longer steps are not compared with it.

    Args:
        state: The search, whose present model has fits at both horizons.
    """
    runs, horizons = state.current.free_run, state.horizons
    assert runs
    if not is_unexplained(horizons, state.current):
        return False
    problem, h = horizons.free_run.problem, runs.hypothesis
    fine = finer_integration(problem, h)
    if fine is None:
        return False
    coarse, shorter = (at.innovations([h])[0][problem.seen > 0] for at in (problem, fine))
    change, left = (np.sqrt(np.mean(e**2, axis=0)) for e in (shorter - coarse, coarse))
    if not np.any(change > MOST_OF_ERROR * left):  # False too where a run diverges
        return False
    solver = fine.predictor.solver
    assert isinstance(solver, Exponential)
    worst = int(np.argmax(change / problem.noise))
    channel, times = state.model.mechanism.channels[worst], change[worst] / problem.noise[worst]
    note = (
        f"Each sample is integrated in {solver.substeps} steps, since longer ones cause an error in "
        f"{channel} of {times:.2g} times the sensor noise in runs over {state.validation.window_seconds:g} s."
    )
    state.say(note)
    _integrate_in(state, solver)
    state.step_note = (note,)
    return True


def _integrate_in(state: SearchState, solver: Exponential) -> None:
    """Take another integration rule for the rest of a search, and fit its present model again."""
    given = state.model.solver
    assert isinstance(given, Exponential)
    own = dataclasses.replace(given, substeps=solver.substeps)
    state.model = dataclasses.replace(state.model, solver=own)
    state.horizons = horizons = state.horizons.with_solver(solver)
    predictions, runs = state.fits
    prediction, free_run = horizons.prediction.problem, horizons.free_run.problem
    start = prediction.with_likelihood(correct_discretisation_bias(prediction, predictions))
    (first,) = refit(prediction, [start], wide=True)
    (second,) = refit(free_run, [free_run.with_likelihood(runs)])
    state.tried = []
    state.take_refit(horizons.validated(first, second, state.current))
    if state.nominal and not state.scores:
        state.nominal = as_given(horizons)
