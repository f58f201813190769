"""The grey-box fit: free parameters of a mechanism from recordings, with intervals."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.fit.dataset import padded_length, prepare
from rotflex_jax.fit.discretisation_bias import coarse_step, finer_steps
from rotflex_jax.fit.greybox_problem import LEAST_SCALE, FitAttempt, FitPoint, FitStage, GreyBoxProblem
from rotflex_jax.fit.held_constants import with_held_constants
from rotflex_jax.fit.inference import (
    Combination,
    RecordingSlopes,
    combined_covariance,
    curvature,
    estimates,
    sandwich,
)
from rotflex_jax.fit.plausibility import Reach, at_bounds, beyond_recordings, check_signs, physical_ranges
from rotflex_jax.fit.problem import RunLayout
from rotflex_jax.fit.result import Fit, FitOptions, RunResidual
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.mechanism import process_noise_of
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, digest_of_recordings, listed
from rotflex_jax.runtime.xla import double_precision, mesh_of, one_thread

if TYPE_CHECKING:
    from rotflex_jax.fit.optimistix_adapter import Minimiser

FirstState = Literal["fitted", "measured"]


def report(
    problem: GreyBoxProblem,
    end: FitAttempt,
    e: Float[np.ndarray, "R N C"],
    J: Float[np.ndarray, "R N C D"],
    options: FitOptions | None = None,
) -> Fit:
    """The result of a fit: estimates with intervals.

    A parameter at an end of its range is held there, and intervals of other parameters are conditional on
    that.

    Args:
        problem: The problem of the fit.
        end: The optimum.
        e: Errors at the optimum.
        J: Slopes of the errors along the directions of each recording.
        options: Options of the fit; the defaults if None.
    """
    model, data, point, windows = problem.model, problem.dataset.data, end.point, end.stage.windows
    m, coordinates, seen = model.mechanism, problem.coordinates(point, windows), data.seen > 0
    of_runs = [e[r, s] for r, s in enumerate(seen)]
    residual = np.concatenate(of_runs)
    deviation = _rms(residual)
    scale = np.maximum(deviation, LEAST_SCALE * problem.dataset.noise)
    values, stretch = problem.physical(point)
    common = problem.common(values)
    at_end = problem.at_ends(point)
    moves = ~problem.held_by_ends(point, windows)
    place = np.cumsum(moves) - 1
    parts = [
        RecordingSlopes(p.J[..., moves[p.columns]], p.e, place[p.columns[moves[p.columns]]])
        for p in coordinates.parts(e / scale, J / scale[:, None], seen)
    ]
    H = curvature(parts, int(moves.sum()))
    covariance = _spread_out(sandwich(parts, H), moves)
    names, specs = m.parameter_names, m.parameter_specifications
    finer = finer_steps(problem, end, e, scale, parts, H, covariance)
    combinations = _combinations(m, point, coordinates, stretch)
    free = [c for c in combinations if c is not None]
    free_names = tuple(name for name, c in zip(names, combinations, strict=True) if c is not None)
    rows = [(name, c.rows) for name, c in zip(free_names, free, strict=True)]
    cost = float(np.sum(len(residual) * (np.log(deviation) + 0.5 * np.log(2 * np.pi) + 0.5)))
    notes = [at_end.get(name, "") for name in names]
    fitted = m.with_values(common)
    found = estimates(names, common, specs, combinations, covariance, notes)
    found = with_held_constants(fitted, found)
    reach = Reach.of(model, problem.dataset.recordings)
    return Fit(
        model=dataclasses.replace(model, mechanism=fitted),
        cost=cost,
        status=end.status,
        parameters=found,
        noise=dict(zip(m.channels, deviation.tolist(), strict=True)),
        covariance=combined_covariance(covariance, free),
        free_names=free_names,
        steps=end.steps,
        history=tuple(end.history),
        local=_local_estimates(m, point, coordinates, values, stretch, covariance),
        remarks=(*at_bounds(found), *beyond_recordings(fitted, reach), *coarse_step(finer, rows)),
        options=options or FitOptions(),
        Ts=problem.dataset.recordings[0].Ts,
        n_init=problem.dataset.recordings[0].n_init,
        data=digest_of_recordings(problem.dataset.recordings),
        residuals=tuple(
            RunResidual(run.source, dict(zip(m.channels, _rms(own).tolist(), strict=True)))
            for run, own in zip(problem.dataset.recordings, of_runs, strict=True)
        ),
    )


def _rms(e: Float[np.ndarray, "N C"]) -> Float[np.ndarray, " C"]:
    return np.sqrt(np.mean(e**2, axis=0))


def _combinations(
    m: Mechanism, point: FitPoint, coordinates: FitCoordinates, stretch: Float[np.ndarray, "R P"]
) -> list[Combination | None]:
    """Each parameter as a combination of the coordinates, a local one as its mean; None for a trusted one.

    Args:
        m: The mechanism.
        point: Says which parameters are common and which are local.
        coordinates: The coordinates of the fit.
        stretch: Derivatives of the values of each recording by the unconstrained ones.
    """

    def combination(i: int, name: str) -> Combination | None:
        if name in m.trusted:
            return None
        if i not in point.local:
            return Combination([point.free.index(i)], stretch[:1, i])
        rows = _local_rows(point, coordinates, i, len(stretch))
        return Combination(rows, stretch[:, i] / len(rows))

    return [combination(i, name) for i, name in enumerate(m.parameter_names)]


def _local_estimates(
    m: Mechanism,
    point: FitPoint,
    coordinates: FitCoordinates,
    values: Float[np.ndarray, "R P"],
    stretch: Float[np.ndarray, "R P"],
    covariance: Float[np.ndarray, "M M"],
) -> dict[str, tuple[Estimate, ...]]:
    """Local parameter -> its estimates in each recording.

    Args:
        m: The mechanism.
        point: Says which parameters are common and which are local.
        coordinates: The coordinates of the fit.
        values: Values of the parameters in each recording.
        stretch: Their derivatives by the unconstrained ones.
        covariance: Covariance of the coordinates.
    """
    found = {}
    for i in sorted(point.local):
        name, R = m.parameter_names[i], len(values)
        rows = _local_rows(point, coordinates, i, R)
        own = [Combination([row], factor) for row, factor in zip(rows, stretch[:, i : i + 1], strict=True)]
        kinds = [m.parameter_specifications[i]] * R
        found[name] = estimates([name] * R, values[:, i], kinds, own, covariance)
    return found


def _local_rows(point: FitPoint, coordinates: FitCoordinates, i: int, recordings: int) -> list[int]:
    """The coordinate of a local parameter in each recording."""
    k = point.local.index(i)
    return [int(coordinates.local_columns(r)[k]) for r in range(recordings)]


def _spread_out(covariance: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The covariance of all coordinates, nan for coordinates that are held."""
    whole = np.full((len(moves), len(moves)), np.nan)
    whole[np.ix_(moves, moves)] = covariance
    return whole


@one_thread
def fit(
    mechanism: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    *,
    process_noise: Mapping[str, float] | None = None,
    local: Sequence[str] = (),
    first: FirstState = "fitted",
    window_seconds: float | None = None,
    robust: float | None = None,
    max_steps: int = 60,
    restarts: int = 8,
    minimiser: "Minimiser | None" = None,
    devices: Sequence[Any] | None = None,
    progress: Callable[[str], None] | None = None,
    throw: bool = False,
) -> Fit:
    """Fit the free parameters of a mechanism to recordings.

        minimise  sum_k |(y_k - y_hat_k) / s|^2   over free parameters and first states

    `y_hat` is a free run, or, with `process_noise`, the prediction of a steady-state Kalman filter that
    assumes white torques of this intensity. In a free run the model must be right over the whole recording.
    Where physics is missing, the parameters are biased to compensate for it; predictions bias them less. The
    scale `s` of each channel is the standard deviation of its residuals, at every step of the fit.

    If the model of a machine is incomplete, the cost of free runs has many local minima: friction that stops
    a little earlier shifts everything that follows. If the first attempt starts far from the motion, or does
    not converge, a second attempt begins with short predictions, which are easy to match from far away. If
    errors of free runs are then still far above the noise, or no attempt has converged, the fit restarts. The
    first restart begins at the given parameters with free runs of 0.2 s (longer if there would be more than
    200 of them), and goes on with longer free runs up to the length of the fit. Further restarts begin at
    random parameters around the best end, alternately near it and far from it, until three ends have the same
    cost. The end with the least cost is the result.

    A fit has converged if steps bring less than a small part of a standard deviation of the parameters. If
    errors are correlated over many samples, this limit is larger in nats, since the likelihood then counts
    the same information many times. Parameters stay within the physical range that their effects declare; a
    damper may be negative as long as the damping of its port is not. A parameter at an end of its range, or
    of a size far beyond what the recordings reach, is named in `remarks`.

    One integration step per sample is too long for some effects, above all for dry friction. If an estimate
    would move by more than a standard deviation with shorter steps, and the recordings are no less likely
    with them, `remarks` names the settings to use. The fit itself keeps its steps.

    Args:
        mechanism: Mechanism to fit; its values are the start, and its trusted parameters are held. Effects
            that the gates of a model switch off are left out.
        recordings: One or several recordings. Parameters are common, and each recording has its own first
            state.
        process_noise: Port -> intensity of the process noise [(N m)^2 s]; None for a free run.
        local: Full names of parameters that have a value for each recording, such as an offset.
        first: "fitted" to fit first states to all samples; "measured" to fit those of each set of parameters
            to the first `n_init` samples alone, as a simulation of a recording does. Then the slopes of the
            errors contain `dx0/dp = -(Jx'Jx)^-1 Jx'Jp`, over these samples. Where nothing returns the machine
            to a position, fitted first states hide a drift of the model.
        window_seconds: Length of windows after which free runs start again [s], each time from a first state
            of its own: the parameters are then the best ones for free runs of this length. Delays and lags
            continue across windows, and memories start from the values that a run over the whole recording
            has there, as in the errors over windows.
        robust: Errors beyond this many standard deviations count linearly and not by their square. Use it,
            for instance with 1.5, if the model is far off for some of the time and should be right for the
            rest. The standard deviation follows from the median of the errors; `noise` and intervals are
            computed from the errors bent in this way. None for squares throughout.
        max_steps: Largest number of iterations of each minimisation, of which there are several.
        restarts: Largest number of restarts of a fit to free runs; 0 for none, which is several times as
            fast. Fits to predictions and robust fits have none.
        minimiser: Solver of optimistix that replaces the toolkit's own Levenberg-Marquardt, for instance
            `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`. It holds measured first states; they are measured again
            before it is called again.
        devices: Devices of this process among which several recordings are divided; all of them if None,
            unless `jax.default_device` names one.
        progress: Called with a line of text now and then.
        throw: Raise an error instead of reporting a failure in `status`.

    Returns:
        Fit, whose model has the fitted parameters, and for a local parameter the mean over recordings.
        `local` has the values of each recording, and `model_of` gives the model with them.

    Raises:
        InputError: If there is nothing to fit, if a local name is no free parameter, or if a channel moves
            against the model.
        RuntimeError: If the fit failed and `throw` is set.
    """
    model = Model.of(mechanism).without_gates()
    given = list(listed(recordings, shortest=SHORTEST_TO_FIT))
    m, say = model.mechanism, checks.progress(progress)
    names = m.parameter_names
    if process_noise is not None:
        process_noise = process_noise_of(m, process_noise)
    checks.one_of(first, "first", get_args(FirstState))
    max_steps, throw = checks.whole(max_steps, "max_steps", 1), checks.yes_or_no(throw, "throw")
    restarts = checks.whole(restarts, "restarts", 0)
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
    if robust is not None:
        robust = checks.positive(robust, "robust", "", "1.5, or None for squares throughout")
        if minimiser is not None:
            raise InputError(
                "A robust fit was asked for with a minimiser of optimistix, but only the toolkit's own bends "
                "errors; leave one of the two out."
            )
    if window_seconds is not None:
        checks.positive(window_seconds, "window_seconds", "s", "2.0, or None for whole recordings")
    check_signs(model, given)
    # A robust fit only begins with squares, and its large errors would cause restarts in vain.
    problem = _problem(model, given, first, max_steps, 0 if robust else restarts, minimiser, devices, say)
    asked = None if process_noise is None else dict(process_noise)
    low, high = (tuple(end.tolist()) for end in problem.ranges)
    options = FitOptions(asked, local, first, window_seconds, max_steps, problem.restarts, ranges=(low, high))
    with double_precision():
        end = problem.solve([names.index(n) for n in local], process_noise, window_seconds)
        if robust is not None and np.isfinite(end.cost):
            problem, end = problem.robust(end, robust)
            assert problem.bend is not None
            options = dataclasses.replace(options, bend=tuple(problem.bend.tolist()))
        if throw and end.status != "converged":
            raise RuntimeError(f"The fit did not converge: {end.status}.")
        return report(problem, end, *problem.errors(end.point, end.stage, end.K), options)


def problem_of(fitted: Fit, recordings: Sequence[Recording]) -> tuple[GreyBoxProblem, FitPoint, FitStage]:
    """The problem that a fit has solved, a start with its parameters, and the stage.

    Args:
        fitted: A fit.
        recordings: The recordings that were fitted.

    Raises:
        InputError: If the recordings are not those that were fitted.
    """
    asked, m = fitted.options, fitted.model.mechanism
    own = fitted.local.values()
    if any(len(each) != len(recordings) for each in own):
        raise InputError(
            f"The fit has parameters of their own for {len(next(iter(own)))} recordings, but "
            f"{len(recordings)} were given; give those that were fitted."
        )
    problem = _problem(
        fitted.model, recordings, asked.first, asked.max_steps, asked.restarts, None, None, lambda _: None
    )
    if fitted.data and digest_of_recordings(recordings) != fitted.data:
        raise InputError(
            "Recordings, or settings of them such as n_init, differ from those of the fit, but a profile "
            "fits the same data again with one quantity held; give those that were fitted, or fit these."
        )
    if asked.ranges is not None:
        low, high = map(np.array, asked.ranges)
        problem = dataclasses.replace(problem, ranges=(low, high))
    if asked.bend is not None:
        problem = dataclasses.replace(problem, bend=np.array(asked.bend))
    windows = problem.horizons(asked.window_seconds, asked.process_noise)[-1]
    point = problem.start([m.parameter_names.index(n) for n in asked.local], windows)
    transform, local_z = problem.transform, point.local_z.copy()
    for r in range(len(recordings)):
        z = np.clip(transform.unconstrain(fitted.model_of(r).mechanism.values), *problem.ranges)
        local_z[r] = z[list(point.local)]
    return (
        problem,
        dataclasses.replace(point, local_z=local_z),
        FitStage(windows, asked.process_noise),
    )


def _problem(
    model: Model,
    recordings: Sequence[Recording],
    first: str,
    max_steps: int,
    restarts: int,
    minimiser: "Minimiser | None",
    devices: Sequence[Any] | None,
    say: Callable[[str], None],
) -> GreyBoxProblem:
    m = model.mechanism
    mesh = mesh_of(devices)
    measured = first == "measured"
    states = 0 if measured and minimiser is not None else 2 * len(m.coordinates)
    return GreyBoxProblem(
        model,
        prepare(model, recordings, length=padded_length(recordings)),
        RunLayout(m.structure, model.solver, states, mesh if len(recordings) > 1 else None),
        measured,
        physical_ranges(m),
        max_steps,
        restarts,
        minimiser,
        say,
        None,
    )
