"""Bands around the free run of a search's result, over a recording that it may know something of.

    a search that ends unexplained and has a final fit: around the run of that fit, the model to use
    otherwise:                                          of the mixture of its probable sets of effects

An offset of the voltage or a bias of a sensor belongs to a run. A run that was fitted has its own; of another
one nothing is known but how large they were in the runs that were fitted, and its band is wider by that.
"""

import math
from collections.abc import Sequence

from rotflex_jax.discover.result import KnownRuns, SearchResult
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.fit.bands import Bands, BandSource, FitForRun, mixed_bands, scatter
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism.roles import calibrations
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording


def bands_of_final_fit(
    result: SearchResult, recording: Recording, level: float, known: Sequence[Recording]
) -> Bands:
    """The band around the run of `result.model_of(recording)`.

    Windows of the final fit start again every few seconds, so free runs over what was fitted say what the
    model lacks.

    Args:
        result: A search with a final fit.
        recording: Its input and first samples are used.
        level: Probability.
        known: Recordings by which the error of the model is measured; those that were fitted if none.
    """
    assert result.final_fit is not None
    fit, fitted = result.final_fit.fit, result.final_fit.recordings
    runs = KnownRuns.of(result.train, result.validation)._replace(recordings=fitted)

    def for_run(r: Recording) -> FitForRun:
        has, k = result.model_of(r).mechanism.named_values, runs.index(r)
        values = {name: has.get(name, 0.0) for name in fit.local}  # an offset that the model lacks is zero
        own = {
            name: scatter(each, values[name])
            if k is None
            else scatter([each[k]], values[name]) + _more_than_of_mean(each[k], fit[name])
            for name, each in fit.local.items()
        }
        return FitForRun(fit.with_values(values), own)

    measured_by = [(for_run(r), r) for r in known or fitted]
    return mixed_bands([BandSource(for_run(recording), 1.0, measured_by)], recording, level)


def bands_of_sets(
    result: SearchResult,
    fits: Sequence[tuple[Fit, float]],
    recording: Recording,
    level: float,
    known: Sequence[Recording],
) -> Bands:
    """The band of the mixture of sets of effects.

    Args:
        result: A search.
        fits: Its probable sets fitted to the training recordings, each with its probability.
        recording: Its input and first samples are used.
        level: Probability.
        known: Recordings by which the error of each model is measured. Where there are none and the search
            ends unexplained, its validation recordings.
    """
    runs = KnownRuns.of(result.train, result.validation)
    baseline = result.baseline.model.mechanism
    given = {(e.name, e.at) for e in baseline.effects}  # the machine's own, in `model_of` for every run
    calibrating = {f"{port}.{effect}." for effect, port in set(calibrations(baseline)) - given}

    def for_run(fit: Fit, r: Recording) -> FitForRun:
        if runs.compared or runs.index(r) is not None:
            return FitForRun(fit, {})
        of_run = [n for n in fit.free_names if any(n.startswith(each) for each in calibrating)]
        own = {n: scatter([fit[n]], 0.0) for n in of_run}
        return FitForRun(fit.with_values(dict.fromkeys(of_run, 0.0)), own)

    if not known and result.verdict == Verdict.UNEXPLAINED:
        known = result.validation
    sources = [
        BandSource(for_run(fit, recording), weight, [(for_run(fit, r), r) for r in known])
        for fit, weight in fits
    ]
    return mixed_bands(sources, recording, level)


def _more_than_of_mean(own: Estimate, mean: Estimate) -> float:
    """Variance of the value of a run beyond that of the mean over runs, which the covariance of a fit has."""
    more = own.std**2 - mean.std**2
    return max(more, 0.0) if math.isfinite(more) else 0.0
