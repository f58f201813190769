"""Interface of the methods of the comparison, and their free runs over recordings that they have not seen."""

import abc
import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rotflex_jax import metrics
from rotflex_jax.checks import Progress, choose, shown
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.recording.samples import of_one_period


@runtime_checkable
class Simulator(Protocol):
    """A model that can simulate a recording."""

    @abc.abstractmethod
    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run: outputs from the input and the first `n_init` samples of the outputs."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """The model that a method has learned from recordings.

    Attributes:
        simulator: Simulates other recordings; a `Model`, or any object with `simulate`.
        parameters: Number of fitted parameters.
        note: Phrase with information for the reader of the table; "" for none.
        predict: Function for one-step-ahead predictions, each from the input and the outputs before it; None
            for a method without a predictor.
    """

    simulator: Simulator
    parameters: int
    note: str = ""
    predict: Callable[[Recording], Float[np.ndarray, "N C"]] | None = None


@runtime_checkable
class Method(Protocol):
    """One way to learn a model from recordings.

    Attributes:
        name: Short name, for tables and the command line.
        title: Description as a phrase.
    """

    @property
    @abc.abstractmethod
    def name(self) -> str: ...  # noqa: D102
    @property
    @abc.abstractmethod
    def title(self) -> str: ...  # noqa: D102

    @abc.abstractmethod
    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Learn a model from recordings that have exactly the channels of `model`, in its order.

        Args:
            model: Physical model of the user; a black-box method ignores it.
            train: Recordings to learn from.
            say: Called with a short phrase now and then.

        Returns:
            The learned model. If the method raises an error, its row states the error.
        """
        ...


METHODS: dict[str, Method] = {}
"""Methods by name, in the order in which `compare` runs them."""


def register(method: Method) -> Method:
    """Enter a method under its name.

    Args:
        method: An object with `name`, `title` and `fit`.

    Returns:
        The same object.

    Raises:
        InputError: The method lacks one of these, or another method has the same name.
    """
    _check(method)
    if METHODS.get(method.name, method) != method:
        raise InputError(
            f"A method named {method.name!r} was registered, but there is one already; choose another name."
        )
    METHODS[method.name] = method
    return method


def selected_methods(methods: Iterable[str | Method] | None) -> tuple[Method, ...]:
    """Methods given by name or as objects; all registered methods for None."""
    if methods is None:
        return tuple(METHODS.values())
    if not isinstance(methods, str | Method | Iterable):
        raise InputError(
            f"Argument `methods` must be a list of methods, but is {shown(methods)}; write for instance "
            "['arx', 'grey_box']."
        )
    listed = [methods] if isinstance(methods, (str, Method)) else list(methods)
    found: dict[str, Method] = {}
    for item in listed:
        method = METHODS[choose(item.strip(), METHODS, "method")] if isinstance(item, str) else item
        _check(method)
        if found.get(method.name, method) != method:
            raise InputError(
                f"Two methods named {method.name!r} were given, but a row needs a name of its own; "
                "rename one of them."
            )
        found[method.name] = method
    if not found:
        raise InputError(f"No method was given; choose from {', '.join(METHODS)}.")
    return tuple(found.values())


def _check(method: Any) -> None:
    if not isinstance(method, Method):
        raise InputError(
            f"{method!r} was given as a method, but a method has name, title and "
            f"fit(model, train, say); give one of {', '.join(METHODS)}, or such an object."
        )


# A run has diverged when its distance from the start exceeds this many ranges of the measurements.
DIVERGENCE_FACTOR = 100.0


def hide_outputs(recording: Recording, seconds: float | None = None) -> Recording:
    """The recording with its outputs held constant where a model must not use them.

    Args:
        recording: The recording to simulate.
        seconds: Length of the windows [s]; a model may use the first `n_init` samples of each window. If
            None, it may use only those of the recording.
    """
    k = np.arange(recording.N)
    hidden = k >= recording.n_init if seconds is None else metrics.counted(recording, seconds)
    last = np.maximum.accumulate(np.where(hidden, 0, k))
    return dataclasses.replace(recording, y=recording.y[last], accept=ACCEPTABLE)


def free_runs(simulator: Simulator, recordings: Sequence[Recording]) -> tuple[Float[np.ndarray, "_ C"], ...]:
    """One free run over each recording, none of which can use outputs after `n_init` samples."""
    return tuple(_with_recording_shape(simulator.simulate(hide_outputs(r)), r) for r in recordings)


def _with_recording_shape(run: np.ndarray, recording: Recording) -> np.ndarray:
    y_hat = np.asarray(run, float)
    if y_hat.shape != recording.y.shape:
        raise InputError(
            f"The free run has the shape {y_hat.shape}, but {recording.y.shape} is needed; "
            "simulate every sample and channel of the recording."
        )
    return y_hat


def windowed_runs(
    simulator: Simulator, recordings: Sequence[Recording], seconds: float
) -> tuple[Float[np.ndarray, "_ C"], ...]:
    """Free runs over the windows of each recording, as in a search.

    A simulator with `simulate_windows`, such as every grey box, is driven by the voltage of the whole
    recording, so that a delay, a lag or a drift continues from window to window. A black box (difference
    equation, state space, series) estimates its state, or the input before, from the first samples of a
    recording. It therefore runs over each window as over a separate recording.

    Args:
        simulator: It uses the input and the first `n_init` samples of each window.
        recordings: The recordings to simulate.
        seconds: Length of the windows [s].
    """
    whole = getattr(simulator, "simulate_windows", None)
    if whole is not None:
        return tuple(_with_recording_shape(whole(hide_outputs(r, seconds), seconds), r) for r in recordings)
    runs = []
    for r in recordings:
        starts = metrics.window_starts(r, seconds)[0].tolist()
        segments = [r.slice(i, j) for i, j in zip(starts, [*starts[1:], r.N], strict=True)]
        segments = [dataclasses.replace(segment, n_init=r.n_init) for segment in segments]
        runs.append(np.concatenate(free_runs(simulator, segments)))
    return tuple(runs)


def one_step_predictions(
    predict: Callable[[Recording], Float[np.ndarray, "_ C"]], recordings: Sequence[Recording]
) -> tuple[Float[np.ndarray, "_ C"], ...]:
    """Predictions one step ahead; each uses every sample before the predicted one."""
    return tuple(np.asarray(predict(recording), float) for recording in recordings)


def simulation_time(simulator: Simulator, recordings: Sequence[Recording]) -> float:
    """Time of the free runs [s]; run them once before, so that compilation is not counted."""
    start = time.perf_counter()
    free_runs(simulator, recordings)
    return time.perf_counter() - start


def divergence_reason(
    runs: Sequence[Float[np.ndarray, "_ C"]], recordings: Sequence[Recording], ranges: Float[np.ndarray, " C"]
) -> str:
    """Sentence on when the first run diverged; "" if no run diverged.

    Args:
        runs: Free runs.
        recordings: The recordings that they simulate.
        ranges: Range of each channel in all data.
    """
    limit = np.where(ranges > 0, DIVERGENCE_FACTOR * ranges, np.inf)
    for y_hat, recording in zip(runs, recordings, strict=True):
        start = recording.y[: recording.n_init].mean(axis=0)
        # In this form NaN counts as outside.
        outside = ~(np.abs(y_hat - start) <= limit).all(axis=1) | ~np.isfinite(y_hat).all(axis=1)
        if outside.any():
            seconds = float(np.argmax(outside)) * recording.Ts
            when = f"after {seconds:.3g} s"
            return f"the free run leaves the measured range {DIVERGENCE_FACTOR:g} times over {when}"
    return ""


def error_metrics(
    recordings: Sequence[Recording], runs: Sequence[Float[np.ndarray, "_ C"]]
) -> dict[str, dict[str, float]]:
    """Metric -> channel -> value, over all recordings together, without the first `n_init` samples."""
    y = np.concatenate([r.y[r.n_init :] for r in recordings]).astype(float)
    y_hat = np.concatenate([run[r.n_init :] for r, run in zip(recordings, runs, strict=True)])
    formulas = {
        "rmse": metrics.rmse,
        "nrmse": metrics.nrmse,
        "fit_percent": metrics.fit_percent,
        "worst": metrics.max_error,
    }
    with np.errstate(all="ignore"):
        return {
            name: dict(zip(recordings[0].channels, formula(y, y_hat).tolist(), strict=True))
            for name, formula in formulas.items()
        }


def windowed_errors(
    simulator: Simulator, recordings: Sequence[Recording], seconds: float
) -> dict[str, float]:
    """Channel -> root mean square error of `windowed_runs`, over all recordings together."""
    runs = windowed_runs(simulator, recordings, seconds)
    with np.errstate(all="ignore"):
        rms = metrics.windowed_rmse(recordings, [r.y for r in recordings], runs, seconds)
    return dict(zip(recordings[0].channels, rms.tolist(), strict=True))


# Largest number of intervals of time for which errors are reported, and of free runs that are averaged.
HORIZON_POINTS, HORIZON_RUNS = 16, 12


@dataclasses.dataclass(frozen=True)
class Horizon:
    """Root mean square error of free runs as a function of the time since the last measured sample they use.

    Attributes:
        seconds: End of each interval of time [s].
        rmse: Channel -> error within each interval [unit].
        runs: Number of runs.
    """

    seconds: tuple[float, ...]
    rmse: dict[str, tuple[float, ...]]
    runs: int


def horizon_segments(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """Stretches of equal length from all recordings, evenly spread; they may overlap.

    Args:
        recordings: Test recordings.
        seconds: Horizon of the free runs [s].
    """
    segments = []
    for r in recordings:
        length = min(r.N, r.n_init + max(2, round(seconds / r.Ts)))
        count = max(1, HORIZON_RUNS // len(recordings))
        starts = np.unique(np.linspace(0, r.N - length, count).astype(int))
        segments += [r.slice(int(i), int(i) + length) for i in starts]
    return segments


def errors_by_horizon(simulator: Simulator, recordings: Sequence[Recording], seconds: float) -> Horizon:
    """Error as a function of the horizon, in intervals that grow with it.

    A grey box is driven by the voltage of the whole recording, as in windows (`windowed_runs`).

    Args:
        simulator: The model to evaluate.
        recordings: Test recordings; an interval has at least one sample of each sampling period.
        seconds: Horizon [s].
    """
    if isinstance(simulator, Model):
        pairs = [simulator.behind_actuation(r) for r in recordings]
        simulator, recordings = pairs[0][0], [r for _, r in pairs]
    parts = horizon_segments(recordings, seconds)
    runs = free_runs(simulator, parts)
    longest = max(r.Ts for r in recordings)
    ahead = max(1, int(min((r.N - r.n_init) * r.Ts for r in parts) / longest + 1e-6))
    edges = np.unique(np.round(np.geomspace(1, ahead, HORIZON_POINTS)).astype(int))
    squares = []
    with np.errstate(all="ignore"):
        for r, y_hat in zip(parts, runs, strict=True):
            e = (r.y - y_hat)[r.n_init :]
            ends = [0, *np.floor(edges * longest / r.Ts + 1e-6).astype(int).tolist()]
            squares.append([np.mean(e[a:b] ** 2, axis=0) for a, b in itertools.pairwise(ends)])
        rms = np.sqrt(np.mean(squares, axis=0))  # (intervals, C)
    return Horizon(
        tuple((edges * longest).tolist()),
        {c: tuple(v.tolist()) for c, v in zip(recordings[0].channels, rms.T, strict=True)},
        len(parts),
    )


def split_for_validation(train: Sequence[Recording], share: float) -> tuple[list[Recording], list[Recording]]:
    """First part of each recording, for the fit, and last part, for validation."""
    parts = [recording.split(share) for recording in train]
    return [a for a, _ in parts], [b for _, b in parts]


def require_one_sampling_period(recordings: Sequence[Recording], what: str) -> None:
    """Refuse recordings with different sampling periods, for which no single sampled model holds.

    Raises:
        InputError: The sampling periods differ by more than rounding.
    """
    if not of_one_period(r.Ts for r in recordings):
        raise InputError(
            f"The recordings have different sampling periods, but {what} has one; decimate them to the same."
        )


def validation_cost(simulator: Simulator, recordings: Sequence[Recording]) -> float:
    """Mean over the channels of the logarithm of the free-run error; infinite if a run diverges.

    Args:
        simulator: The model to evaluate.
        recordings: Validation parts of the training recordings; one run over each.
    """
    with np.errstate(all="ignore"):
        runs = free_runs(simulator, recordings)
        e = np.concatenate([(r.y - y_hat)[r.n_init :] for r, y_hat in zip(recordings, runs, strict=True)])
        cost = float(np.mean(np.log(np.sqrt(np.mean(e**2, axis=0)) + 1e-300)))
    return np.inf if np.isnan(cost) else cost
