"""Parameters of a final model, freed from the error of the integration step they were fitted with."""

import dataclasses

import numpy as np

from rotflex_jax.discover.batched_predictor import BatchedPredictor
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.refit import MAX_COORDINATE_STEP, MIN_DECREASE_NATS
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.mechanism import Exponential
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise

# Substeps in the place of one. Sixteen moved no estimate further by a third of its standard deviation.
SUBSTEP_FACTOR = 4
# Where friction holds and lets go at other samples, the slopes predict too large a decrease: what most steps
# do not need, a few refused ones find.
CORRECTION_RULES = Rules(enough=MIN_DECREASE_NATS, damping=1e-6, increase=30)
MAX_CORRECTION_STEPS = 10


def correct_discretisation_bias(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """The hypothesis after a few damped Gauss-Newton steps on the innovations of a finer integration.

        x <- x - (J'J)^-1 J'w

    with the slopes `J` of the search's own step and the whitened innovations `w` of one `SUBSTEP_FACTOR`
    times as short. Friction that builds up within a sample shifts an estimate by several of its standard
    deviations; where the motion is linear the step is exact and no parameter moves.

    Args:
        problem: With the training recordings.
        h: At its optimum.
    """
    predictor, s, seen = problem.predictor, problem.supermodel, problem.seen
    active = s.clean(h.mean_values(s), h.locations).effects
    # A linear motion is integrated exactly, and effects on voltages and readings need no integration.
    exact = all(e.exact_step for e in active)
    if exact or not isinstance(predictor.solver, Exponential):
        return h
    solver = dataclasses.replace(predictor.solver, substeps=SUBSTEP_FACTOR * predictor.solver.substeps)
    finer = BatchedPredictor(s, solver, predictor.data, predictor.constants)
    fine = dataclasses.replace(problem, predictor=finer)
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
        limit=coordinates.step_limit(MAX_COORDINATE_STEP),
        move=coordinates.moved,
        max_steps=MAX_CORRECTION_STEPS,
    )
    return h if found.x is h else problem.evaluated(found.x, problem.innovations([found.x])[0])
