"""Bands around the free run of a search's result over a recording.

    a search that ends unexplained and has a final fit: around the run of this fit, the model to use
    otherwise:                                          of the mixture of its probable sets of effects

An offset of the voltage or a bias of a sensor belongs to a run. For a run that was fitted, its own values are
known. For any other run, only the size of the offsets in the fitted runs is known, and its band is wider.
"""

from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.result import KnownRuns, SearchResult
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects.base import name_prefix
from rotflex_jax.fit.bands import Bands, BandSource, FitForRun, mixed_bands, scatter
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism.roles import calibrations
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording


def bands_of_final_fit(
    result: SearchResult, recording: Recording, level: float, known: Sequence[Recording]
) -> Bands:
    """The band around the run of `result.model_of(recording)`.

    The final fit is to windows that start again every few seconds. So free runs over the whole fitted
    recordings show the error of the model.

    Args:
        result: Result of a search with a final fit.
        recording: Recording whose input, first samples and sensor noise are used.
        level: Probability.
        known: Recordings by which the error of the model is measured; the fitted recordings if empty.
    """
    assert result.final_fit is not None
    fit, fitted = result.final_fit.fit, result.final_fit.recordings
    runs = KnownRuns.of(result.train, result.validation)._replace(recordings=fitted)

    def for_run(r: Recording) -> FitForRun:
        used, k = result.model_of(r).mechanism.named_values, runs.index(r)
        values = {name: used.get(name, 0.0) for name in fit.local}  # an offset that the model lacks is zero
        if k is None:
            own = {name: scatter(each, values[name]) for name, each in fit.local.items()}
        else:
            of_run = {name: each[k] for name, each in fit.local.items()}
            own = {n: (e.value - values[n]) ** 2 + _beyond_mean(fit, e) for n, e in of_run.items()}
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
    """The band of a mixture of sets of effects.

    Args:
        result: Result of a search.
        fits: Its probable sets, fitted to the training recordings, each with its probability.
        recording: Recording whose input, first samples and sensor noise are used.
        level: Probability.
        known: Recordings by which the error of each model is measured. If empty and the search ended
            unexplained, its validation recordings are used.
    """
    runs = KnownRuns.of(result.train, result.validation)
    baseline = result.baseline.model.mechanism
    given = {(e.name, e.at) for e in baseline.effects}  # of the user's model, in `model_of` for every run
    calibrating = {name_prefix(port, effect) for effect, port in set(calibrations(baseline)) - given}

    def for_run(fit: Fit, r: Recording) -> FitForRun:
        if runs.compared or runs.index(r) is not None:
            return FitForRun(fit, {})
        of_run = [n for n in fit.free_names if any(n.startswith(each) for each in calibrating)]
        own = {n: fit[n].value ** 2 for n in of_run}
        return FitForRun(fit.with_values(dict.fromkeys(of_run, 0.0)), own)

    if not known and result.verdict == Verdict.UNEXPLAINED:
        known = result.validation
    sources = [
        BandSource(for_run(fit, recording), weight, [(for_run(fit, r), r) for r in known])
        for fit, weight in fits
    ]
    return mixed_bands(sources, recording, level)


def _beyond_mean(fit: Fit, own: Estimate) -> float:
    """Variance of a run's own value beyond the variance of the mean over runs, which the covariance has.

    Correlations of the value with other parameters are assumed to be those of the mean.
    """
    i = fit.free_names.index(own.name)
    of_mean = float(np.nan_to_num(fit.covariance[i, i]))
    return max(own.std**2 - of_mean, 0.0) if np.isfinite(own.std) else 0.0
