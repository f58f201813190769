"""Gradient ascent on every sample of one period of an input, through the simulations of both models."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.experiment.discrimination import Discrimination, DiscriminationProblem

Progress = Callable[[str], None]

# Periods that are simulated for one evaluation: one from rest, the others near the periodic motion.
SIMULATED_PERIODS = 2
# Penalty of a peak beyond its limit: zero within, quadratic up to this logarithm of the excess, then linear
# with this weight. Evidence grows at most with the square of an input, so a weight above two suffices.
PENALTY_WIDTH, PENALTY_WEIGHT = 0.04, 5.0
MAX_EVALUATIONS = 60
# Root mean square steps in units of the voltage limit, and the share of the last direction that is kept.
FIRST_ASCENT_STEP, SMALLEST_ASCENT_STEP, LONGEST_ASCENT_STEP, MOMENTUM = 0.3, 2e-3, 20.0, 0.5
# Evaluations between those that start the rival fits from several shapes.
RESTART_INTERVAL = 20


@dataclasses.dataclass(frozen=True)
class PenalisedEvidence:
    """The objective at one period of an input.

    Attributes:
        value: Logarithm of the mean evidence, less the penalties of peaks beyond their limits.
        gradient: Along each sample of the period, per voltage limit.
        result: Evidence of both directions under it.
    """

    value: float
    gradient: Float[np.ndarray, " M"]
    result: Discrimination


@dataclasses.dataclass(frozen=True)
class InputObjective:
    """Evidence of a periodic input, penalised where predicted peaks leave the limits.

    Attributes:
        problem: Rival models and limits.
        peak_factors: Factor by which other parameters of the model raise its peaks, per channel.
    """

    problem: DiscriminationProblem
    peak_factors: Float[np.ndarray, " C"]

    def voltage(
        self, x: Float[np.ndarray, " M"]
    ) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """The voltage [V] for a period in units of the limit, and the samples that each follows.

        The period's mean is taken off: a constant torque would make the machine drift.
        """
        p = self.problem
        repeated = np.tile(p.limits.voltage * (x - x.mean()), SIMULATED_PERIODS)
        return p.limits.playable_with_sources(repeated, p.Ts)

    def evaluate(
        self, x: Float[np.ndarray, " M"], last: Discrimination | None, thorough: bool = False
    ) -> PenalisedEvidence:
        """Value and gradient at a period in units of the voltage limit."""
        p = self.problem
        u, low, high = self.voltage(x)
        result = p.evaluate(u, last, thorough)
        excess = np.log(np.maximum(p.relative_peaks(result.outputs) * self.peak_factors, 1e-12))
        quadratic = np.clip(excess, 0.0, PENALTY_WIDTH)
        penalty = PENALTY_WEIGHT * (
            quadratic**2 / (2 * PENALTY_WIDTH) + np.maximum(excess - PENALTY_WIDTH, 0.0)
        )
        g = p.gradient(u, result, PENALTY_WEIGHT * quadratic / PENALTY_WIDTH)
        # A clipped sample does not follow its source; the gradient of the others goes back to theirs.
        by_source = (np.bincount(low, g, len(u)) + np.bincount(high, g, len(u))) / 2
        period = p.limits.voltage * by_source.reshape(SIMULATED_PERIODS, -1).sum(axis=0)
        value = np.log(result.mean_nats) - float(np.sum(penalty))
        return PenalisedEvidence(value, period - period.mean(), result)


def optimise_input(
    problem: DiscriminationProblem,
    period: Float[np.ndarray, " M"],
    evaluations: int = MAX_EVALUATIONS,
    progress: Progress | None = None,
) -> Float[np.ndarray, " M"]:
    """One period [V] under which the two models are more distinct, from a start.

    Gradient ascent with momentum, clipped to the limit; a step that gains is lengthened, one that does not is
    cut. Evidence grows with the square of an input, so the best inputs lie at the limits, where methods that
    expect a smooth minimum make little progress.

    Args:
        problem: Rival models and limits.
        period: Where to start [V].
        evaluations: Evaluations at most.
        progress: Called with a line of text now and then.
    """
    say = progress or (lambda _: None)
    limit = problem.limits.voltage
    x = np.clip((period - period.mean()) / limit, -1.0, 1.0)
    C = len(problem.pair[0].mechanism.channels)
    u = InputObjective(problem, np.ones(C)).voltage(x)[0]
    nominal = np.max(np.abs(problem.evaluate(u).outputs), axis=(0, 1))
    peak_factors = np.maximum(problem.peaks(u) / np.maximum(nominal, 1e-300), 1.0)
    objective = InputObjective(problem, peak_factors)
    best = objective.evaluate(x, None, thorough=True)
    direction, step = best.gradient, FIRST_ASCENT_STEP
    for k in range(1, evaluations):
        size = np.sqrt(np.mean(direction**2))
        if step < SMALLEST_ASCENT_STEP or not size > 0:
            break
        trial = np.clip(x + step * direction / size, -1.0, 1.0)
        new = objective.evaluate(trial, best.result, thorough=k % RESTART_INTERVAL == 0)
        if new.value > best.value:
            x, best, step = trial, new, min(1.6 * step, LONGEST_ASCENT_STEP)
            ratio = np.linalg.norm(best.gradient) / max(float(np.linalg.norm(direction)), 1e-300)
            direction = MOMENTUM * ratio * direction + best.gradient
        else:
            step /= 4
        if k % 10 == 0:
            nats = f"{best.result.nats:.3g} nats in {SIMULATED_PERIODS} periods"
            say(f"  {k} of {evaluations} evaluations, {nats}")
    return limit * (x - x.mean())
