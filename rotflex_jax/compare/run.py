"""The comparison: every method learns from the same recordings and is evaluated on the same test data."""

import dataclasses
import time
from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax import checks, joints
from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import (
    Method,
    divergence_reason,
    error_metrics,
    errors_by_horizon,
    free_runs,
    one_step_predictions,
    selected_methods,
    simulation_time,
    windowed_errors,
)
from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import sensor_noise
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, check_apart, listed
from rotflex_jax.runtime.xla import one_thread


@one_thread
def compare(
    recordings: Recording | Sequence[Recording],
    methods: Iterable[str | Method] | None = None,
    *,
    mechanism: Mechanism | Model | None = None,
    test: Recording | Sequence[Recording] | None = None,
    fraction: float | None = None,
    window_seconds: float = 2.0,
    progress: Progress | None = None,
) -> Comparison:
    """Compares methods on the same data by their free runs over test data.

    All methods learn from the same training part and are evaluated on the same test part. Of the test part
    they receive the input and the first `n_init` samples of the outputs; the rest is hidden before they
    simulate. If a method fails or diverges, its row states this. The error of one-step-ahead predictions is
    reported if a method has a predictor, but never used for the ranking: the last sample alone predicts the
    next one well.

    Args:
        recordings: One or several recordings.
        methods: Names of registered methods, or objects that are methods; all registered methods if None.
            `rotflex_jax.compare.QUICK` has the methods without a long search.
        mechanism: Physical model of the methods that start from one; `joints.paper()` if None.
        test: Test recordings; if None, the end of each recording.
        fraction: Share of each recording to learn from, if `test` is not given [-]; 0.7 if None.
        window_seconds: Length of the windows of the short free runs [s].
        progress: Called with a line of text now and then.

    Returns:
        Comparison, best method first.

    Raises:
        InputError: A method is unknown, there is no recording, `test` and `fraction` are both given, or a
            recording lacks a channel of the mechanism.
    """
    start, say = time.perf_counter(), checks.progress(progress)
    chosen = selected_methods(methods)
    model = Model.of(joints.paper() if mechanism is None else mechanism)
    checks.positive(window_seconds, "window_seconds")
    train, tested = (
        tuple(_with_model_channels(r, model) for r in part)
        for part in _training_and_test(listed(recordings, shortest=SHORTEST_TO_FIT), test, fraction)
    )
    rows = []
    for method in chosen:
        say(f"{method.name}: learning")
        rows.append(_row(method, model, train, tested, window_seconds, say))
    noise = sensor_noise((*train, *tested), model)
    return Comparison(
        # Methods that failed stay in the order in which they were given.
        rows=tuple(sorted(rows, key=lambda row: row.score)),
        train=train,
        test=tested,
        noise_floor=dict(zip(model.mechanism.channels, noise.tolist(), strict=True)),
        window_seconds=window_seconds,
        elapsed_s=time.perf_counter() - start,
    )


def _row(
    method: Method,
    model: Model,
    train: tuple[Recording, ...],
    test: tuple[Recording, ...],
    seconds: float,
    say: Progress,
) -> Row:
    row = Row(method.name, method.title, family=getattr(method, "family", "other"))
    start = time.perf_counter()
    # An error in one method must not cost the other methods their rows.
    try:
        fitted = method.fit(model, train, lambda text: say(f"{method.name}: {text}"))
        row = dataclasses.replace(
            row,
            note=fitted.note,
            parameters=fitted.parameters,
            fit_seconds=time.perf_counter() - start,
            simulator=fitted.simulator,
        )
        runs = free_runs(fitted.simulator, test)
        ahead = (
            {}
            if fitted.predict is None
            else error_metrics(test, one_step_predictions(fitted.predict, test))["rmse"]
        )
        reason = divergence_reason(runs, test, _ranges((*train, *test)))
        return dataclasses.replace(
            row,
            status="diverged" if reason else "ok",
            reason=reason,
            **error_metrics(test, runs),
            rmse_windows=windowed_errors(fitted.simulator, test, seconds),
            rmse_one_step=ahead,
            horizon=errors_by_horizon(fitted.simulator, test, seconds),
            simulate_seconds=simulation_time(fitted.simulator, test),
            simulated=runs,
        )
    except Exception as error:
        reason = " ".join(str(error).split()) or "no reason given"
        named = reason if isinstance(error, InputError) else f"{type(error).__name__}: {reason}"
        return dataclasses.replace(row, status="failed", reason=named)


def _training_and_test(
    recordings: tuple[Recording, ...],
    test: Recording | Sequence[Recording] | None,
    fraction: float | None,
) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """Training and test recordings."""
    if test is None:
        parts = [r.split(0.7 if fraction is None else fraction) for r in recordings]
        return tuple(a for a, _ in parts), tuple(b for _, b in parts)
    if fraction is not None:
        raise InputError(
            "Arguments `test` and `fraction` were both given, but the test data are either "
            "recordings of their own or the end of each; give one of the two."
        )
    tested = listed(test, "test", SHORTEST_TO_FIT)
    reason = "an error on training data proves nothing; leave `test` out to use the end of the recording"
    check_apart(recordings, tested, "to learn from and as test data", reason)
    return recordings, tested


def _with_model_channels(recording: Recording, model: Model) -> Recording:
    """The recording with only the channels of the model, in its order: the same for every method."""
    wanted, y = model.mechanism.channels, model.measured(recording)
    if recording.channels == wanted:
        return recording
    return dataclasses.replace(
        recording,
        y=y,
        channels=wanted,
        units=tuple(recording.unit(c) for c in wanted),
        resolution={c: recording.resolution[c] for c in wanted},
        accept=ACCEPTABLE,
    )


def _ranges(recordings: Sequence[Recording]) -> np.ndarray:
    """Range of each channel in all recordings (C,)."""
    return np.max([np.ptp(r.y, axis=0) for r in recordings], axis=0)
