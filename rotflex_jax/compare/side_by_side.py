"""Runs the methods one after another and judges each on the same held-out data."""

import dataclasses
import time
from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax import joints
from rotflex_jax.compare.horizon import against_horizon
from rotflex_jax.compare.judged import (
    errors,
    free_runs,
    left_the_range,
    one_step,
    seconds_of,
    windowed_errors,
)
from rotflex_jax.compare.method import Method, Progress, chosen
from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.errors import InputError
from rotflex_jax.fit.residuals import sensor_noise
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.threads import one_thread


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
    """Every method on the same data, judged by its free run over what it has not seen.

    All learn from the same part and are judged on the same other part, of which they see the input
    and the first `n_init` samples of the outputs: the rest is taken away before they simulate. A
    method that fails or diverges is a row that says so. The error of predictions one step ahead is
    told where a method has a predictor, and never used to rank: the last sample alone predicts the
    next one well.

    Args:
        recordings: One or several.
        methods: Names of registered methods, or objects that are methods; all registered if None,
            `rotflex_jax.compare.QUICK` are those without a long search.
        mechanism: Physics of the methods that start from it; `joints.paper()` if None.
        test: Recordings to judge on; without them, the end of each recording.
        fraction: Share of each recording to learn from, where `test` is not given [-]; 0.7 if None.
        window_seconds: Length of the short free runs [s].
        progress: Called with a line of text now and then.

    Returns:
        Comparison, best method first.

    Raises:
        InputError: An unknown method, no recording, `test` together with `fraction`, or a recording
            without the channels of the mechanism.
    """
    began, say = time.perf_counter(), progress or (lambda _: None)
    listed = chosen(methods)
    mechanism = joints.paper() if mechanism is None else mechanism
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    train, unseen = _parts(_several(recordings), test, fraction)
    train = tuple(_only(r, model) for r in train)
    unseen = tuple(_only(r, model) for r in unseen)
    rows = []
    for method in listed:
        say(f"{method.name}: learning")
        rows.append(_row(method, model, train, unseen, window_seconds, say))
    noise = sensor_noise((*train, *unseen), model)
    return Comparison(
        # Methods that failed stay in the order in which they were given.
        rows=tuple(sorted(rows, key=lambda row: row.score)),
        train=train,
        test=unseen,
        noise_floor=dict(zip(model.mechanism.channels, noise.tolist(), strict=True)),
        window_seconds=window_seconds,
        elapsed_s=time.perf_counter() - began,
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
    began = time.perf_counter()
    # Whatever goes wrong in one method must not cost the others their rows.
    try:
        fitted = method.fit(model, train, lambda text: say(f"{method.name}: {text}"))
        row = dataclasses.replace(
            row,
            note=fitted.note,
            parameters=fitted.parameters,
            fit_seconds=time.perf_counter() - began,
            simulator=fitted.simulator,
        )
        runs = free_runs(fitted.simulator, test)
        ahead = {} if fitted.predict is None else errors(test, one_step(fitted.predict, test))["rmse"]
        reason = left_the_range(runs, test, _reach((*train, *test)))
        return dataclasses.replace(
            row,
            status="diverged" if reason else "ok",
            reason=reason,
            **errors(test, runs),
            rmse_windows=windowed_errors(fitted.simulator, test, seconds),
            rmse_one_step=ahead,
            horizon=against_horizon(fitted.simulator, test, seconds),
            simulate_seconds=seconds_of(fitted.simulator, test),
            simulated=runs,
        )
    except Exception as error:
        reason = " ".join(str(error).split()) or "no reason given"
        named = reason if isinstance(error, InputError) else f"{type(error).__name__}: {reason}"
        return dataclasses.replace(row, status="failed", reason=named)


def _several(recordings: Recording | Sequence[Recording]) -> tuple[Recording, ...]:
    listed = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    if not listed:
        raise InputError("No recording was given, but at least one is needed; pass a Recording.")
    return listed


def _parts(
    recordings: tuple[Recording, ...],
    test: Recording | Sequence[Recording] | None,
    fraction: float | None,
) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """What is learnt from, and what is judged on."""
    if test is None:
        parts = [r.split(0.7 if fraction is None else fraction) for r in recordings]
        return tuple(a for a, _ in parts), tuple(b for _, b in parts)
    if fraction is not None:
        raise InputError(
            "Arguments `test` and `fraction` were both given, but what is judged on is either a "
            "recording of its own or the end of each; give one of the two."
        )
    unseen = _several(test)
    if any(r is s for r in recordings for s in unseen):
        raise InputError(
            "The same recording was given to learn from and to judge on, but a model judged on "
            "what it has seen proves nothing; leave `test` out to judge on its end."
        )
    return recordings, unseen


def _only(recording: Recording, model: Model) -> Recording:
    """The recording with the model's channels alone, in its order: the same for every method."""
    wanted = model.mechanism.channels
    if recording.channels == wanted:
        return recording
    y = model.measured(recording)
    return dataclasses.replace(
        recording,
        y=y,
        channels=wanted,
        units=tuple(recording.units[recording.channels.index(c)] for c in wanted),
        resolution={c: recording.resolution[c] for c in wanted},
        accept=ACCEPTABLE,
    )


def _reach(recordings: Sequence[Recording]) -> np.ndarray:
    """Range of each channel in all recordings."""
    return np.max([np.ptp(r.y, axis=0) for r in recordings], axis=0)
