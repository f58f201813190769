"""The grey-box fit: parameters of the physics, first states and bounds, by damped least squares."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import StackedRecordings, prepare, process_noise_ports
from rotflex_jax.fit.inference import (
    Combination,
    RecordingSlopes,
    combined_covariance,
    curvature,
    estimates,
    sandwich,
)
from rotflex_jax.fit.problem import (
    Coordinates,
    FreeCoordinates,
    RunInputs,
    residuals_and_slopes,
    summed_equations,
)
from rotflex_jax.fit.result import Fit
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Mechanism, kalman_gains
from rotflex_jax.mechanism.validation import process_noise_of
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import (
    Minimum,
    NormalEquations,
    Progress,
    Rules,
    Status,
    minimise,
)
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.recording.listing import SHORTEST_TO_FIT, listed
from rotflex_jax.runtime.xla import double_precision, mesh_of, one_thread

if TYPE_CHECKING:
    from rotflex_jax.fit.optimistix_adapter import Minimiser


FirstState = Literal["fitted", "measured"]
ProcessNoise = Mapping[str, float] | None
"""Port -> intensity of the process torque [(N m)^2 s]; None for a free run."""

# A step that would lower the negative log-likelihood by less than this is not taken [nat]. A relative
# tolerance would stop a long recording many nats short of the optimum. A stage that only leads to the next
# one may stop earlier.
LAST_STAGE_TOLERANCE, EARLY_STAGE_TOLERANCE = 1e-3, 1.0
# A fit also ends where so many steps lower the cost by less than this [nat]: along a curved valley, or
# towards a bound.
PROGRESS_STEPS, LEAST_PROGRESS = 8, 0.1
# Minimisations of the last stage at most, each with the scale that the one before left; they end where it
# changes by less than this share, with measured first states after so many at least.
MAX_RESCALINGS, SCALE_TOLERANCE, RESCALINGS_OF_MEASURED_STATES = 5, 0.02, 4
# A start is far where its run misses a channel by more than this share of the channel's standard deviation.
FAR_START_ERROR = 0.7
# Of two attempts whose costs differ by less, one that converged is better [nat].
EQUAL_COST = 0.1
_STATUS = {
    Status.CONVERGED: "converged",
    Status.DIVERGED: "diverged: the model error at the start is not finite",
    Status.UNSOLVED: "stopped: a step has no finite solution; the model diverges near these numbers",
}


@dataclasses.dataclass(frozen=True)
class FitAttempt:
    """Where a sequence of stages ended.

    Attributes:
        flat: All coordinates.
        inputs: What the last runs were made with, with the scale of the last residuals.
        status: "converged", or why not.
        steps: Iterations.
        history: Half the squared error after each minimisation.
        start_error: Error of the run at the start, as a share of the standard deviation of each channel.
        cost: Negative log-likelihood with the last scale, constants left out; infinite if diverged.
    """

    flat: Float[np.ndarray, " F"]
    inputs: RunInputs
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
        recordings: One or several.
        free: Which coordinates are adjusted.
        data: The recordings, stacked.
        noise: Standard deviation of the sensor noise.
        measured: Whether first states are held at what the first samples show.
        max_steps: Most iterations of a minimisation.
        minimiser: Solver of optimistix, or None for the toolkit's own.
        say: Called with lines of progress.
    """

    model: Model
    recordings: Sequence[Recording]
    free: FreeCoordinates
    data: StackedRecordings
    noise: Float[np.ndarray, " C"]
    measured: bool
    max_steps: int
    minimiser: "Minimiser | None"
    say: Callable[[str], None]

    def attempt(self, flat: Float[np.ndarray, " F"], stages: Sequence[ProcessNoise]) -> FitAttempt:
        """One stage after the other, from a start; each but the last only until it is near its end."""
        seen = self.data.seen > 0
        spread = np.maximum(np.std(self.data.y[seen], axis=0), self.noise)
        error = lambda costs, scale: np.sqrt(2 * costs / np.sum(seen)) * scale  # noqa: E731
        scale, start_error = self.noise, np.full_like(spread, np.inf)
        history, steps, status = [], 0, "converged"
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            for repetition in range(MAX_RESCALINGS if last else 1):
                if self.measured:
                    flat = self._with_measured_states(flat)
                inputs = self._inputs(flat, stage, scale)
                found = self._minimum(flat, inputs, LAST_STAGE_TOLERANCE if last else EARLY_STAGE_TOLERANCE)
                flat, steps = self._with_free(flat, found.x), steps + found.evaluations
                status = _STATUS.get(found.status, f"stopped after {self.max_steps} steps")
                if not history:
                    start_error = error(found.first.costs, scale) / spread
                history.append(found.cost)
                new = error(found.equations.costs, scale)
                settled = np.all(np.abs(np.log(new / scale)) < SCALE_TOLERANCE)
                scale = np.where(np.isfinite(new), np.maximum(new, self.noise * 0.1), scale)
                # States that the first samples show follow the parameters, fitted with the former ones.
                enough = RESCALINGS_OF_MEASURED_STATES if self.measured else 0
                if status != "converged" or (settled and repetition + 1 >= enough):
                    break
        inputs = inputs._replace(scale=jnp.asarray(scale))
        cost = float(np.sum(seen) * np.sum(np.log(scale)))
        if status.startswith("diverged") or not np.isfinite(cost):
            cost = np.inf
        return FitAttempt(flat, inputs, status, steps, history, start_error, cost)

    def _model(self, flat: np.ndarray) -> Model:
        values = _common_values(self.model.mechanism, self.free.coordinates.values(flat))
        return dataclasses.replace(self.model, mechanism=self.model.mechanism.with_values(values))

    def _with_free(self, flat: np.ndarray, x: np.ndarray) -> np.ndarray:
        flat = flat.copy()
        flat[self.free.index] = x
        return flat

    def _with_measured_states(self, flat: np.ndarray) -> np.ndarray:
        """The first states that the first samples show to the model."""
        c, there, flat = self.free.coordinates, self._model(flat), flat.copy()
        for r, recording in enumerate(self.recordings):
            flat[c.state_index(r)] = there._start(recording)[: c.states]
        return flat

    def _inputs(self, flat: np.ndarray, stage: ProcessNoise, scale: np.ndarray) -> RunInputs:
        here = self._model(flat)
        gain = lambda r: kalman_gains(here.at(r).mechanism, [stage or {}], self.noise, r.Ts)[0]  # noqa: E731
        K = np.stack([gain(r) for r in self.recordings])
        gates = np.ones(len(here.mechanism.effects))
        return RunInputs(*jax.tree.map(jnp.asarray, (gates, self.data, K, scale)))

    def _minimum(self, flat: np.ndarray, inputs: RunInputs, tolerance: float) -> Minimum:
        """The least squared error near a point, by the free coordinates."""
        if self.minimiser is not None:
            from rotflex_jax.fit.optimistix_adapter import minimise_by  # takes long to import

            return minimise_by(self.minimiser, self.free, flat, inputs, self.max_steps)

        def linearised(x: np.ndarray) -> NormalEquations:
            return jax.device_get(summed_equations(self.free, self._with_free(flat, x), inputs))

        def tell(progress: Progress) -> None:
            self.say(f"fit: {progress.evaluations} steps, cost {progress.cost:.1f}")

        return minimise(
            linearised,
            flat[self.free.index],
            Rules(enough=tolerance, window=PROGRESS_STEPS, least_progress=LEAST_PROGRESS),
            limit=self.free.step_limit,
            max_steps=self.max_steps,
            report=tell,
        )


def _common_values(m: Mechanism, values: Float[np.ndarray, "R P"]) -> Float[np.ndarray, " P"]:
    """Means over recordings; what is trusted is the mechanism's own, whatever a recording knows of it."""
    free = np.array([name not in m.trusted for name in m.parameter_names])
    return np.where(free, values.mean(axis=0), m.values)


def report(
    problem: GreyBoxProblem,
    end: FitAttempt,
    e: Float[Array, "R N C"],
    J: Float[Array, "R N C D"],
) -> Fit:
    """Estimates with intervals.

    Args:
        problem: What was fitted to what.
        end: The optimum.
        e: Scaled errors there.
        J: Their slopes by the directions of each recording.
    """
    model, data, coordinates, index = (
        problem.model,
        problem.data,
        problem.free.coordinates,
        problem.free.index,
    )
    m = model.mechanism
    slopes, left, seen = np.asarray(J), np.asarray(e), data.seen > 0
    parts = [RecordingSlopes(slopes[r, s], left[r, s], problem.free.columns[r]) for r, s in enumerate(seen)]
    residual = np.concatenate([part.e for part in parts])
    each = range(coordinates.owning)
    z = np.tile(end.flat[: coordinates.parameters], (len(each), 1))
    for i in coordinates.local:
        z[:, i] = [end.flat[coordinates.local_index(r, i)] for r in each]
    values, stretch = coordinates.transform.physical(z)
    common = _common_values(m, values)
    H = curvature(parts, len(index))
    covariance = sandwich(parts, H)
    row_of = {int(k): row for row, k in enumerate(index)}
    names, specs = m.parameter_names, m.parameter_specifications
    combinations: list[Combination | None] = []
    local: dict[str, tuple[Estimate, ...]] = {}
    for i, name in enumerate(names):
        if name in m.trusted:
            combinations.append(None)
        elif i in coordinates.local:
            rows = [row_of[coordinates.local_index(r, i)] for r in each]
            combinations.append(Combination(rows, stretch[:, i] / len(rows)))
            own = [
                Combination([row], factor) for row, factor in zip(rows, stretch[:, i : i + 1], strict=True)
            ]
            kinds = [specs[i]] * len(rows)
            local[name] = estimates([name] * len(rows), values[:, i], kinds, own, covariance)
        else:
            combinations.append(Combination([row_of[i]], stretch[:1, i]))
    free = [c for c in combinations if c is not None]
    free_names = tuple(name for name, c in zip(names, combinations, strict=True) if c is not None)
    together = np.zeros((len(index), len(free)))
    for column, combination in enumerate(free):
        together[combination.rows, column] = 1.0
    deviation = np.sqrt(np.mean(residual**2, axis=0)) * np.asarray(end.inputs.scale)
    cost = float(np.sum(len(residual) * (np.log(deviation) + 0.5 * np.log(2 * np.pi) + 0.5)))
    return Fit(
        model=dataclasses.replace(model, mechanism=m.with_values(common)),
        cost=cost,
        status=end.status,
        parameters=estimates(names, common, specs, combinations, covariance),
        noise=dict(zip(m.channels, deviation.tolist(), strict=True)),
        covariance=combined_covariance(covariance, free),
        free_names=free_names,
        steps=end.steps,
        history=tuple(end.history),
        weakest=_weakest(together.T @ H @ together, list(free_names)),
        local=local,
    )


def _weakest(H: np.ndarray, names: list[str]) -> dict[str, float]:
    """The combination of parameters that the data determine least, its largest entry 1."""
    if not np.isfinite(H).all():
        return {}
    direction = np.linalg.eigh(H)[1][:, 0]
    direction = direction / direction[np.argmax(np.abs(direction))]
    return dict(zip(names, direction.tolist(), strict=True))


@one_thread
def fit(
    mechanism: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    *,
    process_noise: Mapping[str, float] | None = None,
    local: Sequence[str] = (),
    first: FirstState = "fitted",
    window_seconds: float | None = None,
    max_steps: int = 60,
    minimiser: "Minimiser | None" = None,
    devices: Sequence[Any] | None = None,
    progress: Callable[[str], None] | None = None,
    throw: bool = False,
) -> Fit:
    """Fit the free parameters of a mechanism to recordings.

        minimise  sum_k |(y_k - y_hat_k) / s|^2   over free parameters and first states

    `y_hat` is a free run, or, with `process_noise`, the prediction of a steady Kalman filter whose
    model admits white torques of that intensity. A free run asks the model to be right over the whole
    recording; where physics is missing, it biases the parameters to hide that, and a prediction biases
    them less. Where the run or prediction at the start misses most of the motion, or the fit does not
    converge, it starts a second time with short predictions, which are easy to match from far away, and the
    better of the two ends counts. From a near start they would lead away, since they are insensitive to
    parameters that only a long run shows. The scale `s` of each channel is the standard deviation of its
    residuals.

    Args:
        mechanism: What to fit; its values are the start, its trusted parameters are held.
        recordings: One or several; parameters are common, first states are each recording's own.
        process_noise: Port -> intensity of the process torque [(N m)^2 s]; None for a free run.
        local: Full names of parameters that each recording has for itself, an offset for instance.
        first: Whether first states are fitted, or held at what the first `n_init` samples show: where
            nothing pulls the machine back, a free first position hides a drift of the model.
        window_seconds: Start again every so often [s], each time with a first state of its own and with
            memories at rest: the parameters with which free runs of that length are best.
        max_steps: Most iterations of each minimisation; there are several, each with the scale of the one
            before.
        minimiser: Solver of optimistix in the place of the toolkit's own Levenberg-Marquardt, for instance
            `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`.
        devices: Those of this process that several recordings are shared out to; all of them if None, unless
            `jax.default_device` names one.
        progress: Called with a line of text now and then.
        throw: Raise instead of reporting a failure in `status`.

    Returns:
        Fit, whose model has the fitted parameters, of a local one the mean over recordings;
        `local` has each recording's own and `model_of` the model with them.

    Raises:
        InputError: Nothing to fit, a local name that is not a free parameter, or a channel that moves
            against the model.
        RuntimeError: The fit failed and `throw` is set.
    """
    model = Model.of(mechanism)
    given = list(listed(recordings, shortest=SHORTEST_TO_FIT))
    m, say = model.mechanism, checks.progress(progress)
    names = m.parameter_names
    if process_noise is not None:
        process_noise = process_noise_of(m, process_noise)
    checks.one_of(first, "first", get_args(FirstState))
    max_steps = checks.whole(max_steps, "max_steps", 1)
    if minimiser is not None and not hasattr(minimiser, "init"):
        raise InputError(
            f"Argument `minimiser` must be a solver of optimistix, but is {checks.shown(minimiser)}; leave "
            "it out for the toolkit's own."
        )
    for name in (local := checks.names(local, "local")):
        if name not in m.free_names:
            raise InputError(
                f"Parameter {name!r} was to be local to each recording, but the free parameters are "
                f"{', '.join(m.free_names)}; name one of these."
            )
    if not m.free_names:
        raise InputError("All parameters are trusted, but a fit needs a free one; release one.")
    check_signs(model, given)
    indices = tuple(names.index(n) for n in local)
    windows, windows_of = _windows(given, window_seconds)
    dataset = prepare(model, windows)
    known = np.flatnonzero(np.any(~np.isnan(dataset.constants), axis=0)).tolist()
    coordinates = Coordinates(m.structure, (*indices, *known), len(windows), windows_of)
    flat = coordinates.flatten(m.values, dataset.first_states)
    flat = coordinates.with_constants(flat, dataset.constants)
    parameters = tuple(names.index(n) for n in m.free_names)
    mesh = mesh_of(devices) if len(windows) > 1 else None
    measured = first == "measured"
    free = FreeCoordinates(coordinates, model.solver, parameters, not measured, mesh)
    problem = GreyBoxProblem(
        model, windows, free, dataset.data, dataset.noise, measured, max_steps, minimiser, say
    )
    with double_precision():
        end = problem.attempt(flat, [process_noise])
        if end.doubtful:
            say("fit: again, from short predictions")
            # Torques as large as those of the motion make the filter follow the data within a few samples.
            short = process_noise_ports(m, (0.03 * dataset.torque_scale) ** 2)
            end = min(end, problem.attempt(flat, [short, process_noise]), key=lambda e: e.rank)
        e, J = residuals_and_slopes(problem.free, jnp.asarray(end.flat), end.inputs)
        if throw and end.status != "converged":
            raise RuntimeError(f"The fit did not converge: {end.status}.")
        return report(problem, end, e, J)


def _windows(recordings: list[Recording], seconds: float | None) -> tuple[list[Recording], tuple[int, ...]]:
    """The recordings cut into windows, and of which recording each is; whole where no length is given."""
    if seconds is None:
        return recordings, ()
    checks.positive(seconds, "window_seconds", "s", "2.0, or None for whole recordings")
    cut = []
    for number, r in enumerate(recordings):
        starts = window_starts(r, seconds)[0].tolist()
        cut += [(r.slice(i, j), number) for i, j in zip(starts, [*starts[1:], r.N], strict=True)]
    return [part for part, _ in cut], tuple(number for _, number in cut)
