"""The evidence with which an input distinguishes two models, and gradient ascent on the input.

T-optimality: the rival is fitted to the run of the true model, and half the squared whitened residuals are
the log-likelihood by which the true model is expected to win.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.checks import Progress
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.rival_fit import (
    SHAPE_FACTORS,
    RivalFit,
    RivalModel,
    best_rival_fit,
    free_run_from_rest,
    input_gradient,
)
from rotflex_jax.experiment.standard_inputs import Limits

# A model counts as nested in its rival if the rival reproduces its run up to this share of the evidence of
# the opposite case, or up to an evidence that no recording would decide by [nat].
NESTED_SHARE, NEGLIGIBLE_EVIDENCE = 0.05, 10.0
# Exponent of the smooth maximum whose gradient replaces the gradient of a peak.
SMOOTH_MAXIMUM_EXPONENT = 24


def peak_slope(y: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N C"]:
    """Derivative of the logarithm of each channel's peak, a smooth maximum, by its samples."""
    size = np.maximum(np.max(np.abs(y), axis=0), 1e-300)
    power = np.abs(y / size) ** (SMOOTH_MAXIMUM_EXPONENT - 1) * np.sign(y)
    return power / np.sum(np.abs(y / size) ** SMOOTH_MAXIMUM_EXPONENT, axis=0) / size


@dataclasses.dataclass(frozen=True, eq=False)
class Discrimination:
    """Both models under one voltage, each fitted by its rival.

    Attributes:
        outputs: Runs of A and of B.
        rival_fits: B fitted to the run of A, and A fitted to the run of B.
        counted: Which of the two directions count.
    """

    outputs: Float[np.ndarray, "2 N C"]
    rival_fits: tuple[RivalFit, RivalFit]
    counted: tuple[bool, bool] = (True, True)

    @property
    def nats(self) -> float:
        """Expected log-likelihood by which the true model wins, in the direction with less evidence [nat]."""
        return min(self._counted_nats)

    @property
    def mean_nats(self) -> float:
        """Geometric mean of the directions that count: the objective of an input optimisation [nat].

        The evidence of one direction may be bounded, for instance by the size of a play. The gradient of the
        smaller evidence alone would then not improve the other direction.
        """
        return float(np.exp(np.mean(np.log(np.maximum(self._counted_nats, 1e-12)))))

    @property
    def _counted_nats(self) -> list[float]:
        """Evidence of each direction that counts; zero if a fit failed, because then nothing is known."""
        pairs = zip(self.rival_fits, self.counted, strict=True)
        return [f.nats if np.isfinite(f.nats) else 0.0 for f, counts in pairs if counts]


@dataclasses.dataclass(frozen=True)
class DiscriminationProblem:
    """Two rival models at one sampling period, with the limits of the machine.

    Attributes:
        pair: A and B.
        Ts: Sampling period [s].
        limits: Limits of the machine.
        variations: Other parameter values that A may have, for the predicted peaks.
        counted: Whether the run of A and the run of B count; the run of a nested model does not.
    """

    pair: tuple[RivalModel, RivalModel]
    Ts: float
    limits: Limits
    variations: Sequence[Float[np.ndarray, " P"]] = ()
    counted: tuple[bool, bool] = (True, True)

    def evaluate(
        self, u: Float[np.ndarray, " N"], last: Discrimination | None = None, thorough: bool = False
    ) -> Discrimination:
        """Runs of both models, and each model fitted to the run of the other.

        Args:
            u: Voltage [V].
            last: Result for a similar voltage, to start from.
            thorough: Whether to start also from several shapes of the rival's effect, and keep the best fit.
        """
        runs = [free_run_from_rest(model, u, self.Ts) for model in self.pair]
        fits = []
        for k, y in enumerate(runs):
            rival = self.pair[1 - k]
            starts = [rival.start if last is None else last.rival_fits[k].unknowns]
            if thorough:
                starts += [rival.start] * (last is not None) + starts_with_other_shapes(rival)
            fits.append(best_rival_fit(rival, u, y, self.Ts, starts))
        return Discrimination(np.array(runs), (fits[0], fits[1]), self.counted)

    def without_nested_direction(self, results: Sequence[Discrimination]) -> "DiscriminationProblem":
        """The problem without a direction that no input can distinguish.

        If one model is nested in the other (Coulomb friction in Stribeck friction), or if its effect is
        negligible at the size that fits the other, the other model reproduces every run of it. Only the
        opposite direction can then be distinguished.

        Args:
            results: Results for inputs of many kinds.
        """
        nats = np.array([[fit.nats for fit in result.rival_fits] for result in results])
        a, b = np.max(nats, axis=0, where=np.isfinite(nats), initial=0.0)
        counted = (
            bool(a > min(NESTED_SHARE * b, NEGLIGIBLE_EVIDENCE)),
            bool(b > min(NESTED_SHARE * a, NEGLIGIBLE_EVIDENCE)),
        )
        return dataclasses.replace(self, counted=counted if any(counted) else (True, True))

    def relative_peaks(self, outputs: Float[np.ndarray, "2 N C"]) -> Float[np.ndarray, "2 C"]:
        """Peak divided by its limit, for each model and channel."""
        return np.max(np.abs(outputs), axis=1) / self.limits.outputs(outputs.shape[-1])

    def gradient(
        self, u: Float[np.ndarray, " N"], result: Discrimination, penalty: Float[np.ndarray, "2 C"]
    ) -> Float[np.ndarray, " N"]:
        """Gradient of `log(mean_nats) - sum penalty * log(peak)` with respect to the voltage [1/V].

        Args:
            u: Voltage [V].
            result: Result for this voltage.
            penalty: Weight of the peak of each model in each channel.
        """
        total = np.zeros_like(u)
        for k, fit in enumerate(result.rival_fits):
            slope = peak_slope(result.outputs[k])
            true, rival = self.pair[k], self.pair[1 - k]
            weight = self.counted[k] / sum(self.counted) / max(fit.nats, 1e-12)
            total += input_gradient(true, rival, fit.unknowns, u, self.Ts, weight, -penalty[k] * slope)
        return total

    def peaks(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " C"]:
        """Largest |output| of each channel in runs of A, of B, and of A with other parameters."""
        a, b = self.pair
        varied = [dataclasses.replace(a, mechanism=a.mechanism.with_values(v)) for v in self.variations]
        runs = [free_run_from_rest(model, u, self.Ts) for model in (a, b, *varied)]
        return np.max([np.max(np.abs(y), axis=0) for y in runs], axis=0)

    def scaled_to_limits(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        """The voltage, reduced until every predicted peak is within its limit.

        Raises:
            InputError: The machine leaves its limits even with almost no input.
        """
        for _ in range(30):
            peaks = self.peaks(u)
            excess = float(np.max(peaks / self.limits.outputs(len(peaks))))
            if excess <= 1:
                return u
            u = u * 0.998 / min(excess, 5.0)
        raise InputError(
            "The model is predicted to leave the limits on travel or deflection under the smallest voltage, "
            "which an offset in it may do; widen the limits, shorten the experiment, or take the offset out."
        )


def starts_with_other_shapes(rival: RivalModel) -> list[Float[np.ndarray, " D"]]:
    """Starts of a rival fit with other shapes of the effect; one parameter is changed at a time."""
    effect = rival.effect()
    names, starts = rival.mechanism.parameter_names, []
    for name, value in effect.values.items():
        full = effect.full_name(name)
        if name in effect.amplitudes or names.index(full) not in rival.free or value == 0:
            continue
        spec = effect.declared()[name]
        for factor in SHAPE_FACTORS:
            if spec.lower < factor * value < spec.upper:
                m = rival.mechanism.with_values({full: factor * value})
                starts.append(dataclasses.replace(rival, mechanism=m).start)
    return starts


# Periods that are simulated in one evaluation: one from rest, the others near the periodic motion.
SIMULATED_PERIODS = 2
# Penalty of a peak beyond its limit: zero within the limit, quadratic up to this logarithm of the excess,
# then linear with this weight. Evidence grows at most with the square of an input, so a weight above two
# suffices.
PENALTY_WIDTH, PENALTY_WEIGHT = 0.04, 5.0
MAX_EVALUATIONS = 60
# Root-mean-square steps in units of the voltage limit, and the share of the last direction that is kept.
FIRST_ASCENT_STEP, SMALLEST_ASCENT_STEP, LONGEST_ASCENT_STEP, MOMENTUM = 0.3, 2e-3, 20.0, 0.5
# Number of evaluations after which the rival fits start from several shapes again.
RESTART_INTERVAL = 20


def peak_penalty(
    excess: Float[np.ndarray, "*shape"],
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape"]]:
    """Penalty of each peak beyond its limit, and its derivative.

    Args:
        excess: Logarithm of each peak over its limit.
    """
    quadratic = np.clip(excess, 0.0, PENALTY_WIDTH)
    linear = np.maximum(excess - PENALTY_WIDTH, 0.0)
    penalty = PENALTY_WEIGHT * (quadratic**2 / (2 * PENALTY_WIDTH) + linear)
    return penalty, PENALTY_WEIGHT * quadratic / PENALTY_WIDTH


@dataclasses.dataclass(frozen=True)
class PenalisedEvidence:
    """The objective for one period of an input.

    Attributes:
        value: Logarithm of the mean evidence, less the penalties of peaks beyond their limits.
        gradient: Gradient with respect to each sample of the period, in units of the voltage limit.
        result: Result for this input in both directions.
    """

    value: float
    gradient: Float[np.ndarray, " M"]
    result: Discrimination


@dataclasses.dataclass(frozen=True)
class InputObjective:
    """Evidence of a periodic input, with a penalty if predicted peaks exceed the limits.

    Attributes:
        problem: Rival models and limits.
        peak_factors: For each channel, factor by which other parameters of the model raise its peaks.
    """

    problem: DiscriminationProblem
    peak_factors: Float[np.ndarray, " C"]

    def voltage(
        self, x: Float[np.ndarray, " M"]
    ) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
        """The voltage [V] for a period in units of the limit, and the source samples of each sample.

        The mean of the period is subtracted: a constant torque would make the machine drift.
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
        penalty, steepness = peak_penalty(excess)
        g = p.gradient(u, result, steepness)
        # The gradient of a sample is attributed to the samples of the period that determine it.
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
    """One period [V] with which the two models are better distinguished than with the start.

    The method is gradient ascent with momentum, clipped to the limit. The step is lengthened after a gain and
    shortened otherwise. Evidence grows with the square of an input, so the best inputs are at the limits,
    where methods that expect a smooth optimum make little progress.

    Args:
        problem: Rival models and limits.
        period: Period at the start [V].
        evaluations: Largest number of evaluations.
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
