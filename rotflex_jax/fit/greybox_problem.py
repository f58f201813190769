"""What a grey-box fit solves, by damped least squares: free runs or predictions, in stages, within bounds."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
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
"""Port -> intensity of the process torque [(N m)^2 s]; None for a free run."""

# A step that would lower the negative log-likelihood by less than this is not taken [nat]. A relative
# tolerance would stop a long recording many nats short of the optimum. A stage that only leads to the next
# one may stop earlier.
LAST_STAGE_TOLERANCE, EARLY_STAGE_TOLERANCE = 1e-3, 1.0

# A fit also ends where so many steps lower the cost by less than this [nat]: along a curved minimum, or
# towards a bound.
PROGRESS_STEPS, LEAST_PROGRESS = 8, 0.1

# States that the first samples show, or that a run over the whole recording leaves in memories, follow the
# parameters: the last stage is repeated with new ones until they converge, at least and at most so often.
LEAST_REPETITIONS, MOST_REPETITIONS, SETTLED = 4, 6, 0.1

# The scale of a channel is this share of the sensor's noise at least.
LEAST_SCALE = 0.1

# A start is far where its run misses a channel by more than this share of the channel's standard deviation.
FAR_START_ERROR = 0.7

# Horizons on the way to a long one: the first [s], how many times longer the next is, and the largest share
# of the long one that is worth a stage. The first is longer where there would be more windows than this: each
# has a first state that is eliminated from each step.
SHORTEST_HORIZON, NEXT_HORIZON, LONGEST_SHARE, MOST_WINDOWS = 0.2, 10**0.5, 0.75, 200

# An end is one where the slopes promise no more than this share of a nat for each coordinate.
RUGGED = 0.5

# Of two attempts whose costs differ by less, one that converged is better [nat].
EQUAL_COST = 0.1

# How often a robust fit determines which errors are large.
ROBUST_REPETITIONS = 2

# Standard deviation of a normal number, by the median of its size.
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
    """Results of all recordings, NumPy arrays, in the place of those of each call of a program."""
    first, *others = jax.device_get(results)
    return jax.tree.map(lambda *parts: np.concatenate(parts), first, *others) if others else first


@dataclasses.dataclass(frozen=True)
class FitPoint:
    """Where a fit is.

    Attributes:
        free: Parameters that all recordings share and that are fitted.
        local: Fitted parameters that each recording has for itself.
        z: Unconstrained values of all parameters.
        local_z: Of the recordings' own.
        x0: First states of the windows, complete.
    """

    free: tuple[int, ...]
    local: tuple[int, ...]
    z: Float[np.ndarray, " P"]
    local_z: Float[np.ndarray, "R L"]
    x0: Float[np.ndarray, "R W n"]


@dataclasses.dataclass(frozen=True)
class FitStage:
    """What is fitted in one stage: free runs of some length, or predictions.

    Attributes:
        windows: Where runs start again.
        process_noise: Of the predictor; None for free runs.
    """

    windows: Windows
    process_noise: ProcessNoise = None


@dataclasses.dataclass(frozen=True)
class FitAttempt:
    """Where a sequence of stages ended.

    Attributes:
        point: The parameters and first states.
        stage: The last one.
        K: Gains of the last runs.
        status: "converged", or why not.
        steps: Iterations.
        history: Negative log-likelihood after each minimisation, constants left out [nat].
        start_error: Error of the run at the start, as a share of the standard deviation of each channel.
        cost: Negative log-likelihood, constants left out; infinite if diverged.
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
        """Smaller for a better attempt."""
        return self.cost + EQUAL_COST * (self.status != "converged")

    @property
    def doubtful(self) -> bool:
        """Whether another way may end better: the start was far away, or this way did not converge."""
        return self.status != "converged" or not np.all(self.start_error <= FAR_START_ERROR)


@dataclasses.dataclass(frozen=True)
class GreyBoxProblem:
    """What is fitted to what, and how.

    Attributes:
        model: Mechanism and solver.
        dataset: The recordings.
        layout: What runs are compiled for.
        ranges: Least and largest unconstrained value of each parameter.
        max_steps: Most iterations of a minimisation.
        restarts: Most restarts.
        minimiser: Solver of optimistix, or None for the toolkit's own.
        say: Called with lines of progress.
        bend: Errors of each channel beyond which they count by their size; None where all count by their
            square.
    """

    model: Model
    dataset: Dataset
    layout: RunLayout
    ranges: tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]
    max_steps: int
    restarts: int
    minimiser: "Minimiser | None"
    say: Callable[[str], None]
    bend: Float[np.ndarray, " C"] | None

    def start(self, local: Sequence[int], windows: Windows) -> FitPoint:
        """The point of the model as it is."""
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
        """Unconstrained <-> physical, by the declared bounds."""
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
        """Means over recordings; what is trusted is the mechanism's own, whatever a recording knows of it."""
        m = self.model.mechanism
        free = np.array([name not in m.trusted for name in m.parameter_names])
        return np.where(free, values.mean(axis=0), m.values)

    def coordinates(self, point: FitPoint, windows: Windows) -> FitCoordinates:
        """What moves."""
        return FitCoordinates(len(point.free), len(point.local), self.layout.states, windows)

    def attempt(self, point: FitPoint, stages: Sequence[FitStage]) -> FitAttempt:
        """One stage after the other, from a start; each but the last only until it is near its end."""
        history, steps, status = [], 0, "converged"
        start_error = np.full(len(self.dataset.noise), np.inf)
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            if number:
                point = self._at_windows(point, stage.windows)
            follows, best = self._follows(stage), None
            renews = stage.process_noise is not None
            point, K = self._with_shown_states(point, stage), self._gains(point, stage)
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
                    # What counts is the run from the states that go with these parameters.
                    point = self._with_shown_states(point, stage)
                if renews:  # and the prediction with the gain that goes with them
                    K = self._gains(point, stage)
                if follows or renews:
                    cost = self.equations(point, stage, K).cost
                history.append(float(cost))
                if best is None or cost < best[0]:
                    best = cost, point, K, status
                worth = repetition + 1 < LEAST_REPETITIONS or history[-1] < history[-2] - SETTLED
                # Without a step, what follows the parameters is what it was.
                if status != "converged" or not moved or not worth:
                    break
            assert best
            cost, point, K, status = best
        cost = float(cost) if np.isfinite(cost) else np.inf
        return FitAttempt(point, stage, K, status, steps, history, start_error, cost)

    def _status(self, found: Minimum) -> str:
        """How a minimisation ended, in words."""
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
        """Standard deviation of each channel."""
        seen = self.dataset.data.seen > 0
        return np.maximum(np.std(self.dataset.data.y[seen], axis=0), self.dataset.noise)

    def equations(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> LikelihoodEquations:
        """Likelihood and its quadratic model at a point."""
        e, J = self.errors(point, stage, K)
        return likelihood_equations(
            self.coordinates(point, stage.windows),
            e,
            J,
            self.dataset.data.seen,
            LEAST_SCALE * self.dataset.noise,
            self._room(point, stage.windows),
        )

    def errors(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> tuple[Float[np.ndarray, "R N C"], Float[np.ndarray, "R N C D"]]:
        """Errors of the runs and their slopes, bent where large ones count less; zero where none counts."""
        values, slopes = self.physical(point)
        moved = np.array((*point.free, *point.local))
        inputs = self._run_inputs(point, stage, K)
        y_hat, J = _joined(
            [
                runs_with_slopes(self.layout, values[rows], slopes[rows], moved, *given)
                for rows, given in inputs
            ]
        )
        seen = self.dataset.data.seen[:, :, None] > 0
        e, J = np.where(seen, y_hat - self.dataset.data.y, 0.0), np.where(seen[..., None], J, 0.0)
        return (e, J) if self.bend is None else bent(e, J, self.bend)

    def errors_alone(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> Float[np.ndarray, "R N C"]:
        """The same errors by runs without slopes, which cost less."""
        values, _ = self.physical(point)
        inputs = self._run_inputs(point, stage, K)
        y_hat = _joined([runs(self.layout, values[rows], *given) for rows, given in inputs])
        e = np.where(self.dataset.data.seen[:, :, None] > 0, y_hat - self.dataset.data.y, 0.0)
        return e if self.bend is None else bent(e, np.zeros((*e.shape, 0)), self.bend)[0]

    @functools.cached_property
    def _calls(self) -> list[tuple[slice, StackedRecordings]]:
        """Which recordings run in one call of a program, with their samples on the device.

        One at a time, so that a program does not depend on how many there are; all at once where devices
        share them.
        """
        R = len(self.dataset.recordings)
        calls = [slice(0, R)] if self.layout.mesh else [slice(r, r + 1) for r in range(R)]
        data = self.dataset.data
        return [(rows, StackedRecordings(*(jnp.asarray(part[rows]) for part in data))) for rows in calls]

    def _run_inputs(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> list[tuple[slice, tuple[Any, ...]]]:
        """Recordings that run together; first states, samples, gains and windows as programs take them."""
        many = point.x0.shape[1] > 1
        x0, window = (point.x0, stage.windows.index) if many else (point.x0[:, 0], None)
        return [
            (rows, (x0[rows], samples, K[rows], None if window is None else window[rows]))
            for rows, samples in self._calls
        ]

    def robust(self, end: FitAttempt, beyond: float) -> tuple["GreyBoxProblem", FitAttempt]:
        """The same problem with large errors bent, and its end.

        What is large follows from the median of the errors, which large ones do not move, and once more
        where that fit ends. The fit begins where that by squares has ended, and where that has begun: large
        errors may have led it elsewhere.

        Args:
            end: Of a fit by squares.
            beyond: Errors that are bent, in standard deviations of a normal number with that median.
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
        """The model of a recording."""
        return self.model.with_values(self.physical(point)[0][recording])

    def horizons(self, seconds: float | None, process_noise: ProcessNoise) -> list[Windows]:
        """Windows of some seconds, or whole recordings, behind those of shorter horizons for restarts.

        They have the same number of windows, so that all share one compiled program. Fits of recordings of
        other lengths share it too, since the number is rounded up: with restarts to the most that they need.
        A solver of optimistix would compile a program for each; predictions, and fits without restarts, have
        no use for shorter horizons.
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
        """The best end of the ways that are worth trying."""
        *shorter, horizon = self.horizons(window_seconds, process_noise)
        start, last = self.start(local, horizon), FitStage(horizon, process_noise)
        ends = [self.attempt(start, [last])]
        if ends[0].doubtful:
            self.say("fit: again, from short predictions")
            # Torques as large as those of the motion make the filter follow the data within a few samples.
            m = self.model.mechanism
            short = process_noise_ports(m, (0.03 * self.dataset.torque_scale) ** 2)
            ends.append(self.attempt(start, [FitStage(horizon, short), last]))
        if process_noise is None:
            ends += self._restarts(start, ends, [*map(FitStage, shorter), last])
        best = min(ends, key=lambda attempt: attempt.rank)
        return dataclasses.replace(best, steps=sum(end.steps for end in ends))

    def _restarts(
        self, start: FitPoint, ends: Sequence[FitAttempt], way: Sequence[FitStage]
    ) -> list[FitAttempt]:
        """Further ends: of a restart from the start, then of those around the best end so far.

        Args:
            start: Where the fit has started.
            ends: Where it has ended.
            way: Horizons from the shortest to that of the fit, if there are shorter ones.
        """
        more, random = list[FitAttempt](), np.random.default_rng(0)
        for number in range(self.restarts):
            best = min((*ends, *more), key=lambda attempt: attempt.rank)
            if self._settled(best, [*ends, *more]):
                break
            self.say(f"fit: restart {number + 1} of at most {self.restarts}, cost so far {best.cost:.1f}")
            if number == 0 and len(way) > 1:
                more.append(self.attempt(self._at_windows(start, way[0].windows), way))
            elif number % 2:
                more.append(self.attempt(self._moved_by_chance(best, NEAR, random), way[-1:]))
            else:
                point = self._moved_by_chance(best, FAR, random)
                more.append(self.attempt(self._at_windows(point, way[0].windows), way))
        return more

    def _settled(self, best: FitAttempt, ends: Sequence[FitAttempt]) -> bool:
        """Whether the best of some ends explains the data, or so many agree that no other is expected."""
        here = self.equations(best.point, best.stage, best.K)
        if best.status == "converged" and not misses_something(here.scale, self.dataset.noise):
            return True
        return enough([end.cost for end in ends], here.nats_that_count)

    def _moved_by_chance(self, end: FitAttempt, distance: float, random: np.random.Generator) -> FitPoint:
        """The shared parameters of an end moved by chance, within their physical ranges."""
        free, z = list(end.point.free), end.point.z.copy()
        bounded = self._limit(end.point, end.stage.windows)[: len(free)] < np.inf
        z[free] = moved_by_chance(z[free], bounded, distance, random)
        return dataclasses.replace(end.point, z=np.clip(z, *self.ranges))

    def at_ends(self, point: FitPoint) -> dict[str, str]:
        """Parameters at the end of the range of a healthy machine, with a remark."""
        names, found = self.model.mechanism.parameter_names, {}
        for i in (*point.free, *point.local):
            z = point.local_z[:, point.local.index(i)] if i in point.local else point.z[i : i + 1]
            for bound, which in zip(self.ranges, ("lower", "upper"), strict=True):
                if np.any(z == bound[i]):
                    found[names[i]] = AT_BOUND[which]
        return found

    def held_by_ends(self, point: FitPoint, windows: Windows) -> Bool[np.ndarray, " M"]:
        """Coordinates that are at the end of their range."""
        room = self._room(point, windows)
        return (room[0] == 0) | (room[1] == 0)

    def _follows(self, stage: FitStage) -> bool:
        """Whether first states are held at what the parameters imply, wholly or in part."""
        unseen = len(rest_state(self.model.mechanism.structure, np.float64)) > self._moving
        return not self.layout.states or (
            unseen and stage.windows.number > 1 and max(stage.windows.counts) > 1
        )

    @property
    def _moving(self) -> int:
        return 2 * len(self.model.mechanism.coordinates)

    def _at_windows(self, point: FitPoint, windows: Windows) -> FitPoint:
        """The same parameters, with the first states where fits of these windows start."""
        x0 = point.x0.copy()
        x0[..., : self._moving] = windows.first_states
        return dataclasses.replace(point, x0=x0)

    def _with_shown_states(self, point: FitPoint, stage: FitStage) -> FitPoint:
        """First states that the first samples show, where they are held, and memories of a whole run."""
        if not self._follows(stage):
            return point
        x0 = point.x0.copy()
        for r, recording in enumerate(self.dataset.recordings):
            there = self.model_at(point, r)
            begins = np.array([samples.start for _, samples in stage.windows.of(r)])
            moving = x0[r, : len(begins), : self._moving] if self.layout.states else None
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

    def _room(self, point: FitPoint, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
        """How far each coordinate may go down (not positive) and up (not negative)."""
        c = self.coordinates(point, windows)
        room = np.full((2, c.size), np.inf) * np.array([[-1], [1]])
        for own, bound in zip(room, self.ranges, strict=True):
            own[: c.shared] = (bound - point.z)[list(point.free)]
            for r, z in enumerate(point.local_z):
                own[c.local_columns(r)] = bound[list(point.local)] - z
        return room[0], room[1]

    def _limit(self, point: FitPoint, windows: Windows) -> Float[np.ndarray, " M"]:
        """Largest step of each coordinate: a parameter with a bound by a factor of e."""
        specs = self.model.mechanism.parameter_specifications
        bounded = np.array([bool(np.isfinite(s.lower) or np.isfinite(s.upper)) for s in specs])
        most = np.where(bounded, LARGEST_STEP, np.inf)
        return self.coordinates(point, windows).step_limit(most[[*point.free, *point.local]])

    def _minimum(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"], tolerance: float
    ) -> Minimum:
        """The least cost near a point."""
        if self.minimiser is not None:
            from rotflex_jax.fit.optimistix_adapter import minimise_by  # takes long to import

            return minimise_by(self.minimiser, self, point, stage, K)
        coordinates = self.coordinates(point, stage.windows)

        def tell(progress: Progress) -> None:
            self.say(f"fit: {progress.evaluations} steps, cost {progress.cost:.1f}")

        return minimise(
            lambda at: self.equations(at, stage, K),
            point,
            Rules(enough=tolerance, window=PROGRESS_STEPS, least_progress=LEAST_PROGRESS),
            limit=self._limit(point, stage.windows),
            move=coordinates.moved,
            unit=lambda equations: equations.nats_that_count,
            max_steps=self.max_steps,
            report=tell,
        )
