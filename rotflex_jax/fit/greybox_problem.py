"""The problem of a grey-box fit: damped least squares on free runs or predictions, in stages and bounds."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import (
    Dataset,
    StackedRecordings,
    Windows,
    padded_windows,
    process_noise_ports,
)
from rotflex_jax.fit.plausibility import AT_BOUND
from rotflex_jax.fit.problem import (
    LikelihoodEquations,
    RunLayout,
    likelihood_equations,
    runs,
    runs_with_slopes,
    with_measured_starts,
)
from rotflex_jax.mechanism import kalman_gains
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import (
    LARGEST_STEP,
    Minimum,
    Progress,
    Rules,
    Status,
    minimise,
)
from rotflex_jax.optimise.restarts import FAR, NEAR, enough, misses_something, moved_by_chance
from rotflex_jax.parameters import Transform

if TYPE_CHECKING:
    from rotflex_jax.fit.optimistix_adapter import Minimiser

ProcessNoise = Mapping[str, float] | None
"""Port -> intensity of the process noise [(N m)^2 s]; None for a free run."""

# A step is not taken if it would lower the negative log-likelihood by less than this [nat]. A relative
# tolerance would stop the fit of a long recording many nats short of the optimum. An early stage only leads
# to the next one and may stop earlier.
LAST_STAGE_TOLERANCE, EARLY_STAGE_TOLERANCE = 1e-3, 1.0

# A fit also ends if this number of steps lowers the cost by less than this [nat], as along a curved valley or
# towards a bound.
PROGRESS_STEPS, LEAST_PROGRESS = 8, 0.1

# Measured first states, and memories from a run over the whole recording, depend on the parameters. Within
# a minimisation the former follow to first order and the latter are held. The last stage is repeated with new
# ones until the cost converges: least and largest number of repetitions, and the least gain that is worth a
# further one [nats that count].
LEAST_REPETITIONS, MOST_REPETITIONS, SETTLED = 2, 6, 0.1

# Least scale of a channel, as a share of the sensor noise.
LEAST_SCALE = 0.1

# A start is far off if the error of its run in a channel exceeds this share of the channel's standard
# deviation.
FAR_START_ERROR = 0.7

# Shorter horizons before a long one: the first [s], the factor to the next, and the largest share of the long
# one that is worth a stage. The first is longer if there would be more windows than the last number, since
# the first state of each window is eliminated from each step.
SHORTEST_HORIZON, NEXT_HORIZON, LONGEST_SHARE, MOST_WINDOWS = 0.2, 10**0.5, 0.75, 200

# A fit counts as converged only if the quadratic model promises no more than this per coordinate [nat].
RUGGED = 0.5

# If the costs of two attempts differ by less than this [nat], an attempt that converged is better.
EQUAL_COST = 0.1

# Number of times that a robust fit determines which errors are large.
ROBUST_REPETITIONS = 2

# Standard deviation of a normal distribution over the median of the absolute value.
NORMAL_PER_MEDIAN = 1.4826

_STATUS = {
    Status.CONVERGED: "converged",
    Status.DIVERGED: "diverged: the model error at the start is not finite",
    Status.UNSOLVED: "stopped: a step has no finite solution; the model diverges near these parameters",
}


def bent(
    e: Float[np.ndarray, "R N C"], J: Float[np.ndarray, "R N C D"], bend: Float[np.ndarray, " C"]
) -> tuple[Float[np.ndarray, "R N C"], Float[np.ndarray, "R N C D"]]:
    """Errors whose squares are twice the pseudo-Huber loss `c^2 (sqrt(1 + (e/c)^2) - 1)`, and their slopes.

    Source: P. Charbonnier, L. Blanc-Feraud, G. Aubert and M. Barlaud, IEEE Trans. Image Process. 6, 1997.
    """
    root = np.sqrt(1 + (e / bend) ** 2)
    return e * np.sqrt(2 / (root + 1)), J * (np.sqrt((root + 1) / 2) / root)[..., None]


def _joined(results: Sequence[Any]) -> Any:
    """Results of several calls of a program, joined along the recordings, as NumPy arrays."""
    first, *others = jax.device_get(results)
    return jax.tree.map(lambda *parts: np.concatenate(parts), first, *others) if others else first


@dataclasses.dataclass(frozen=True)
class FitPoint:
    """A point of a fit: its parameters and first states.

    Attributes:
        free: Indices of fitted parameters that are common to all recordings.
        local: Indices of fitted parameters that have a value for each recording.
        z: Unconstrained values of all parameters.
        local_z: Unconstrained values of the local parameters of each recording.
        x0: First states of the windows, with all states of the mechanism.
    """

    free: tuple[int, ...]
    local: tuple[int, ...]
    z: Float[np.ndarray, " P"]
    local_z: Float[np.ndarray, "R L"]
    x0: Float[np.ndarray, "R W n"]


@dataclasses.dataclass
class _LinearisedPoint:
    """A point during a minimisation, with the slopes of its measured first states once it was run."""

    point: FitPoint
    starts: Float[np.ndarray, "R W m K"] | None = None


@dataclasses.dataclass(frozen=True)
class FitStage:
    """One stage of a fit: free runs of some length, or predictions.

    Attributes:
        windows: Windows at whose beginnings runs start again.
        process_noise: Process noise of the predictor; None for free runs.
    """

    windows: Windows
    process_noise: ProcessNoise = None


@dataclasses.dataclass(frozen=True)
class FitAttempt:
    """The end of a sequence of stages.

    Attributes:
        point: Parameters and first states at the end.
        stage: The last stage.
        K: Gains of the last runs.
        status: "converged", or why not.
        steps: Number of evaluations.
        history: Negative log-likelihood after each minimisation, without constants [nat].
        start_error: Error of the run at the start, as a share of the standard deviation of each channel.
        cost: Negative log-likelihood, without constants [nat]; infinite if diverged.
    """

    point: FitPoint
    stage: FitStage
    K: Float[np.ndarray, "R n C"]
    status: str
    steps: int
    history: list[float]
    start_error: Float[np.ndarray, " C"]
    cost: float

    @property
    def rank(self) -> float:
        """Sort key of attempts: the smaller, the better."""
        return self.cost + EQUAL_COST * (self.status != "converged")

    @property
    def doubtful(self) -> bool:
        """Whether another attempt may end better: the start was far off, or this attempt did not converge."""
        return self.status != "converged" or not np.all(self.start_error <= FAR_START_ERROR)


@dataclasses.dataclass(frozen=True)
class GreyBoxProblem:
    """A model, the recordings to which it is fitted, and the settings of the fit.

    Attributes:
        model: Mechanism and solver.
        dataset: The recordings.
        layout: Static data for which runs are compiled.
        measured: Whether first states are not fitted, but those that the first samples show.
        ranges: Least and largest unconstrained value of each parameter.
        max_steps: Largest number of iterations of a minimisation.
        restarts: Largest number of restarts.
        minimiser: Solver of optimistix, or None for the toolkit's own.
        say: Called with lines of progress.
        bend: Size of an error in each channel beyond which errors count linearly and not by their square;
            None if all errors count by their square.
    """

    model: Model
    dataset: Dataset
    layout: RunLayout
    measured: bool
    ranges: tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]
    max_steps: int
    restarts: int
    minimiser: "Minimiser | None"
    say: Callable[[str], None]
    bend: Float[np.ndarray, " C"] | None

    def start(self, local: Sequence[int], windows: Windows) -> FitPoint:
        """The point with the values of the model."""
        m = self.model.mechanism
        free = tuple(m.parameter_names.index(name) for name in m.free_names)
        z = np.clip(self.transform.unconstrain(m.values), *self.ranges)
        own = np.tile(z[list(local)], (len(self.dataset.recordings), 1))
        rest = rest_state(m.structure, np.float64)
        x0 = np.tile(rest, (*windows.first_states.shape[:2], 1))
        x0[..., : windows.first_states.shape[-1]] = windows.first_states
        return FitPoint(tuple(i for i in free if i not in local), tuple(local), z, own, x0)

    @property
    def transform(self) -> Transform:
        """Transform between physical values and unconstrained coordinates, by the declared bounds."""
        return Transform.of(self.model.mechanism.parameter_specifications)

    def physical(self, point: FitPoint) -> tuple[Float[np.ndarray, "R P"], Float[np.ndarray, "R P"]]:
        """Parameter values of each recording, and their derivatives by the unconstrained ones."""
        z = np.tile(point.z, (len(point.local_z), 1))
        z[:, list(point.local)] = point.local_z
        values, slopes = self.transform.physical(z)
        known = ~np.isnan(self.dataset.constants)
        m = self.model.mechanism
        held = np.array([name in m.trusted for name in m.parameter_names])
        values = np.where(held, m.values, values)
        return np.where(known, self.dataset.constants, values), np.where(known | held, 0.0, slopes)

    def common(self, values: Float[np.ndarray, "R P"]) -> Float[np.ndarray, " P"]:
        """Means of values over recordings; trusted parameters have the values of the mechanism."""
        m = self.model.mechanism
        free = np.array([name not in m.trusted for name in m.parameter_names])
        return np.where(free, values.mean(axis=0), m.values)

    def coordinates(self, point: FitPoint, windows: Windows) -> FitCoordinates:
        """The coordinates of the fit."""
        states = 0 if self.measured else self.layout.states
        return FitCoordinates(len(point.free), len(point.local), states, windows)

    def attempt(self, point: FitPoint, stages: Sequence[FitStage]) -> FitAttempt:
        """Fit one stage after the other, from a start; stages before the last end with a coarse tolerance."""
        history, steps, status = [], 0, "converged"
        start_error = np.full(len(self.dataset.noise), np.inf)
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            if number:
                point = self._at_windows(point, stage.windows)
            follows, best = self._follows(stage), None
            renews = stage.process_noise is not None
            point, K = self.with_shown_states(point, stage), self._gains(point, stage)
            for repetition in range(MOST_REPETITIONS if last and (follows or renews) else 1):
                found = self._minimum(
                    point, stage, K, LAST_STAGE_TOLERANCE if last else EARLY_STAGE_TOLERANCE
                )
                moved = found.x is not point
                point, cost, steps = found.x, found.cost, steps + found.evaluations
                status = self._status(found)
                if not history:
                    start_error = found.first.scale / self._spread
                if follows:
                    # The run from the first states that belong to these parameters counts.
                    point = self.with_shown_states(point, stage)
                if renews:  # likewise the prediction with the gain that belongs to them
                    K = self._gains(point, stage)
                if follows or renews:
                    cost = self.equations(point, stage, K).cost
                history.append(float(cost))
                if best is None or cost < best[0]:
                    best = cost, point, K, status
                worth = repetition + 1 < LEAST_REPETITIONS or (
                    history[-2] - history[-1] > SETTLED * found.equations.nats_that_count
                )
                # Without a step, first states and gains have not changed either.
                if status != "converged" or not moved or not worth:
                    break
            assert best
            cost, point, K, status = best
        cost = float(cost) if np.isfinite(cost) else np.inf
        return FitAttempt(point, stage, K, status, steps, history, start_error, cost)

    def _status(self, found: Minimum) -> str:
        """The status of a minimisation, in words."""
        status = _STATUS.get(found.status, f"stopped after {self.max_steps} steps")
        if status != "converged":
            return status
        end = found.equations
        left = end.promised() / (end.nats_that_count * len(end.gradient))
        if left <= RUGGED:
            return status
        return (
            "stopped: no step lowers the cost, though its slopes promise to move parameters by more than "
            f"{np.sqrt(2 * left):.1f} standard deviations; the cost has many local minima here"
        )

    @functools.cached_property
    def _spread(self) -> Float[np.ndarray, " C"]:
        """Standard deviation of each measured channel, at least the noise."""
        seen = self.dataset.data.seen > 0
        return np.maximum(np.std(self.dataset.data.y[seen], axis=0), self.dataset.noise)

    def equations(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> LikelihoodEquations:
        """Negative log-likelihood at a point and its quadratic model."""
        e, J, starts = self._linearised(point, stage, K)
        found = likelihood_equations(
            self.coordinates(point, stage.windows),
            e,
            J,
            self.dataset.data.seen,
            LEAST_SCALE * self.dataset.noise,
            self._distances_to_bounds(point, stage.windows),
        )
        return dataclasses.replace(found, starts=starts)

    def errors(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> tuple[Float[np.ndarray, "R N C"], Float[np.ndarray, "R N C D"]]:
        """Errors of the runs and their slopes, bent in a robust fit; zero where a sample does not count."""
        e, J, _ = self._linearised(point, stage, K)
        return e, J

    def _linearised(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "R W m K"] | None]:
        """Errors and slopes as in `errors`, and the slopes of first states that follow the parameters."""
        values, slopes = self.physical(point)
        moved, starts = np.array((*point.free, *point.local)), None
        inputs = self._run_inputs(point, stage, K)
        y_hat, J = _joined(
            [
                runs_with_slopes(self.layout, values[rows], slopes[rows], moved, *given)
                for rows, given in inputs
            ]
        )
        if self.measured:
            J, of_states = J[..., : len(moved)], J[..., len(moved) :]
            if self.layout.states and stage.process_noise is None:
                n_init = [recording.n_init for recording in self.dataset.recordings]
                J, starts = with_measured_starts(J, of_states, stage.windows, n_init)
        seen = self.dataset.data.seen[:, :, None] > 0
        e, J = np.where(seen, y_hat - self.dataset.data.y, 0.0), np.where(seen[..., None], J, 0.0)
        if self.bend is not None:
            e, J = bent(e, J, self.bend)
        return e, J, starts

    def errors_alone(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> Float[np.ndarray, "R N C"]:
        """The same errors as `errors`, from runs without slopes, which take less time."""
        values, _ = self.physical(point)
        inputs = self._run_inputs(point, stage, K)
        y_hat = _joined([runs(self.layout, values[rows], *given) for rows, given in inputs])
        e = np.where(self.dataset.data.seen[:, :, None] > 0, y_hat - self.dataset.data.y, 0.0)
        return e if self.bend is None else bent(e, np.zeros((*e.shape, 0)), self.bend)[0]

    @functools.cached_property
    def _calls(self) -> list[tuple[slice, StackedRecordings]]:
        """The recordings of each call of a program, with their samples on the device.

        Each call has one recording, so that a program does not depend on their number. If several devices
        share the recordings, one call has all of them.
        """
        R = len(self.dataset.recordings)
        calls = [slice(0, R)] if self.layout.mesh else [slice(r, r + 1) for r in range(R)]
        data = self.dataset.data
        return [(rows, jax.device_put(StackedRecordings(*(part[rows] for part in data)))) for rows in calls]

    def _run_inputs(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> list[tuple[slice, tuple[Any, ...]]]:
        """For each call of a program, its recordings, and their first states, samples, gains and windows."""
        many = point.x0.shape[1] > 1
        x0, window = (point.x0, stage.windows.index) if many else (point.x0[:, 0], None)
        return [
            (rows, (x0[rows], samples, K[rows], None if window is None else window[rows]))
            for rows, samples in self._calls
        ]

    def robust(self, end: FitAttempt, beyond: float) -> tuple["GreyBoxProblem", FitAttempt]:
        """The same problem with large errors bent (a robust fit), and its end.

        The limit for large errors follows from the median of the errors, which large errors hardly change. It
        is determined again at the end of the first robust fit. This first fit starts at the end and at the
        start of the fit by squares, which large errors may have led astray.

        Args:
            end: End of a fit by squares.
            beyond: Errors beyond this many standard deviations are bent. The standard deviation is that of a
                normal distribution with the same median.
        """
        problem, seen = self, self.dataset.data.seen > 0
        starts = [end.point, self.start(end.point.local, end.stage.windows)]
        for _ in range(ROBUST_REPETITIONS):
            e, _ = self.errors(end.point, end.stage, end.K)
            spread = NORMAL_PER_MEDIAN * np.median(np.abs(e[seen]), axis=0)
            problem = dataclasses.replace(self, bend=beyond * np.maximum(spread, self.dataset.noise))
            found = [problem.attempt(start, [end.stage]) for start in starts]
            best = min(found, key=lambda attempt: attempt.rank)
            steps = end.steps + sum(attempt.steps for attempt in found)
            end = dataclasses.replace(best, steps=steps, history=[*end.history, *best.history])
            starts = [end.point]
        return problem, end

    def model_at(self, point: FitPoint, recording: int) -> Model:
        """The model with the values of one recording."""
        return self.model.with_values(self.physical(point)[0][recording])

    def horizons(self, seconds: float | None, process_noise: ProcessNoise) -> list[Windows]:
        """Windows of each stage: shorter horizons for restarts first, last the horizon of the fit.

        All of them are filled up to the same number of windows, so that they share one compiled program. The
        number is rounded up, with restarts to the largest number that restarts need, so that fits of
        recordings of other lengths share the program too. There are no shorter horizons for a solver of
        optimistix, which would compile a program for each, for predictions, and for fits without restarts.

        Args:
            seconds: Length of the windows of the fit [s]; None for whole recordings.
            process_noise: Process noise of predictions; None for free runs.
        """
        of_seconds = functools.partial(Windows.of_seconds, self.model, self.dataset)
        lengths = [r.N * r.Ts for r in self.dataset.recordings]
        horizon, found = min(seconds or max(lengths), max(lengths)), []
        length = max(SHORTEST_HORIZON, sum(lengths) / MOST_WINDOWS)
        restarts = self.restarts and process_noise is None and self.minimiser is None
        while restarts and length < LONGEST_SHARE * horizon:
            found.append(of_seconds(length))
            length *= NEXT_HORIZON
        last = Windows.whole(self.dataset) if seconds is None else of_seconds(seconds)
        most = max(windows.number for windows in (*found, last))
        number = 1 if most == 1 else padded_windows(max(most, MOST_WINDOWS) if found else most)
        return [windows.filled_up(number) for windows in (*found, last)]

    def solve(
        self, local: Sequence[int], process_noise: ProcessNoise, window_seconds: float | None
    ) -> FitAttempt:
        """The best of all attempts: the first, one from short predictions if it is doubtful, and restarts."""
        *shorter, horizon = self.horizons(window_seconds, process_noise)
        start, last = self.start(local, horizon), FitStage(horizon, process_noise)
        ends = [self.attempt(start, [last])]
        if ends[0].doubtful:
            self.say("fit: again, from short predictions")
            # With process noise this large, the predictor follows the data within a few samples.
            m = self.model.mechanism
            short = process_noise_ports(m, (0.03 * self.dataset.torque_scale) ** 2)
            ends.append(self.attempt(start, [FitStage(horizon, short), last]))
        if process_noise is None:
            ends += self._restarts(start, ends, [*map(FitStage, shorter), last])
        best = min(ends, key=lambda attempt: attempt.rank)
        return dataclasses.replace(best, steps=sum(end.steps for end in ends))

    def _restarts(
        self, start: FitPoint, ends: Sequence[FitAttempt], stages: Sequence[FitStage]
    ) -> list[FitAttempt]:
        """Ends of restarts: first from the start of the fit, then from random points around the best end.

        Args:
            start: Start of the fit.
            ends: Ends of the attempts so far.
            stages: Stages from the shortest horizon, if there are shorter ones, to the horizon of the fit.
        """
        more, random = list[FitAttempt](), np.random.default_rng(0)
        for number in range(self.restarts):
            best = min((*ends, *more), key=lambda attempt: attempt.rank)
            if self._settled(best, [*ends, *more]):
                break
            self.say(f"fit: restart {number + 1} of at most {self.restarts}, cost so far {best.cost:.1f} nat")
            if number == 0 and len(stages) > 1:
                more.append(self.attempt(self._at_windows(start, stages[0].windows), stages))
            elif number % 2:
                more.append(self.attempt(self._moved_by_chance(best, NEAR, random), stages[-1:]))
            else:
                point = self._moved_by_chance(best, FAR, random)
                more.append(self.attempt(self._at_windows(point, stages[0].windows), stages))
        return more

    def _settled(self, best: FitAttempt, ends: Sequence[FitAttempt]) -> bool:
        """Whether the best of some ends explains the data, or so many agree that no better is expected."""
        here = self.equations(best.point, best.stage, best.K)
        if best.status == "converged" and not misses_something(here.scale, self.dataset.noise):
            return True
        return enough([end.cost for end in ends], here.nats_that_count)

    def _moved_by_chance(self, end: FitAttempt, distance: float, random: np.random.Generator) -> FitPoint:
        """A point with the common parameters of an end moved at random, within their physical ranges."""
        free, z = list(end.point.free), end.point.z.copy()
        bounded = self._limit(end.point, end.stage.windows)[: len(free)] < np.inf
        z[free] = moved_by_chance(z[free], bounded, distance, random)
        return dataclasses.replace(end.point, z=np.clip(z, *self.ranges))

    def at_ends(self, point: FitPoint) -> dict[str, str]:
        """Name of each parameter at an end of its physical range -> a remark."""
        names, found = self.model.mechanism.parameter_names, {}
        for i in (*point.free, *point.local):
            z = point.local_z[:, point.local.index(i)] if i in point.local else point.z[i : i + 1]
            for bound, which in zip(self.ranges, ("lower", "upper"), strict=True):
                if np.any(z == bound[i]):
                    found[names[i]] = AT_BOUND[which]
        return found

    def held_by_ends(self, point: FitPoint, windows: Windows) -> Bool[np.ndarray, " M"]:
        """Which coordinates are at an end of their range."""
        distances = self._distances_to_bounds(point, windows)
        return (distances[0] == 0) | (distances[1] == 0)

    def _follows(self, stage: FitStage) -> bool:
        """Whether first states, or some of them, are not fitted but follow from the parameters."""
        unseen = len(rest_state(self.model.mechanism.structure, np.float64)) > self._moving
        return self.measured or (unseen and stage.windows.number > 1 and max(stage.windows.counts) > 1)

    @property
    def _moving(self) -> int:
        return 2 * len(self.model.mechanism.coordinates)

    def _at_windows(self, point: FitPoint, windows: Windows) -> FitPoint:
        """The same parameters, with the first positions and speeds from which fits to these windows start."""
        x0 = point.x0.copy()
        x0[..., : self._moving] = windows.first_states
        return dataclasses.replace(point, x0=x0)

    def with_shown_states(self, point: FitPoint, stage: FitStage) -> FitPoint:
        """The point with measured first states, where these are not fitted, and memories from a whole run."""
        if not self._follows(stage):
            return point
        x0 = point.x0.copy()
        for r, recording in enumerate(self.dataset.recordings):
            there = self.model_at(point, r)
            begins = np.array([samples.start for _, samples in stage.windows.of(r)])
            moving = None if self.measured else x0[r, : len(begins), : self._moving]
            x0[r, : len(begins)] = there.states_at(recording, begins, moving)
        return dataclasses.replace(point, x0=x0)

    def _gains(self, point: FitPoint, stage: FitStage) -> Float[np.ndarray, "R n C"]:
        n, C = point.x0.shape[-1], len(self.dataset.noise)
        recordings = self.dataset.recordings
        if stage.process_noise is None:
            return np.zeros((len(recordings), n, C))
        return np.stack(
            [
                kalman_gains(
                    self.model_at(point, r).mechanism, [stage.process_noise], self.dataset.noise, x.Ts
                )[0]
                for r, x in enumerate(recordings)
            ]
        )

    def _distances_to_bounds(self, point: FitPoint, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
        """How far each coordinate may move down (zero or negative) and up (zero or positive)."""
        c = self.coordinates(point, windows)
        distances = np.full((2, c.size), np.inf) * np.array([[-1], [1]])
        for own, bound in zip(distances, self.ranges, strict=True):
            own[: c.shared] = (bound - point.z)[list(point.free)]
            for r, z in enumerate(point.local_z):
                own[c.local_columns(r)] = bound[list(point.local)] - z
        return distances[0], distances[1]

    def _limit(self, point: FitPoint, windows: Windows) -> Float[np.ndarray, " M"]:
        """Largest step of each coordinate; a parameter with one bound may change by a factor of e."""
        most = np.where(self.transform.bounded, LARGEST_STEP, np.inf)
        return self.coordinates(point, windows).step_limit(most[[*point.free, *point.local]])

    def _minimum(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"], tolerance: float
    ) -> Minimum:
        """The minimum of the cost from a point."""
        if self.minimiser is not None:
            from rotflex_jax.fit.optimistix_adapter import minimise_by  # takes long to import

            return minimise_by(self.minimiser, self, point, stage, K)
        coordinates = self.coordinates(point, stage.windows)

        def linearised(at: _LinearisedPoint) -> LikelihoodEquations:
            found = self.equations(at.point, stage, K)
            at.starts = found.starts
            return found

        def tell(progress: Progress) -> None:
            self.say(f"fit: {progress.evaluations} steps, cost {progress.cost:.1f} nat")

        found = minimise(
            linearised,
            _LinearisedPoint(point),
            Rules(enough=tolerance, window=PROGRESS_STEPS, least_progress=LEAST_PROGRESS),
            limit=self._limit(point, stage.windows),
            move=lambda at, step: _LinearisedPoint(coordinates.moved(at.point, step, at.starts)),
            unit=lambda equations: equations.nats_that_count,
            max_steps=self.max_steps,
            report=tell,
        )
        return dataclasses.replace(found, x=found.x.point)
