"""Bands around the free run of a search's result, over a recording that it may know something of.

    a search that ends unexplained: the final fit, the model to use
    otherwise:                      the mixture of its probable sets of effects

An offset of the voltage or a bias of a sensor belongs to a run. A run that was fitted has its own; of another
one nothing is known but how large they were in the runs that were fitted, and its band is wider by that.
"""

import dataclasses
from collections.abc import Mapping, Sequence

from rotflex_jax.discover.result import KnownRuns, SearchResult
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.fit.bands import Bands, BandSource, mixed_bands
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism.roles import calibrations
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

    def standing_for(r: Recording) -> Fit:
        m, k = result.model_of(r).mechanism, runs.index(r)
        values = dict(zip(m.parameter_names, m.values.tolist(), strict=True))
        used = {name: values.get(name, 0.0) for name in fit.local}  # what is not in the model does nothing
        # Nothing is in doubt where the run has been fitted with this very value.
        doubtful = {n: each for n, each in fit.local.items() if k is None or each[k].value != used[n]}
        return dataclasses.replace(_with_values(fit, used), local=doubtful)

    measured_by = tuple((standing_for(r), r) for r in known or fitted)
    return mixed_bands([BandSource(standing_for(recording), 1.0, measured_by)], recording, level)


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

    def standing_for(fit: Fit, r: Recording) -> Fit:
        if runs.compared or runs.index(r) is not None:
            return fit
        own = [n for n in fit.free_names if any(n.startswith(each) for each in calibrating)]
        unknown = dataclasses.replace(fit, local={**fit.local, **{n: (fit[n],) for n in own}})
        return _with_values(unknown, dict.fromkeys(own, 0.0))

    if not known and result.verdict == Verdict.UNEXPLAINED:
        known = result.validation
    sources = [
        BandSource(standing_for(fit, recording), weight, tuple((standing_for(fit, r), r) for r in known))
        for fit, weight in fits
    ]
    return mixed_bands(sources, recording, level)


def _with_values(fit: Fit, values: Mapping[str, float]) -> Fit:
    """The fit with other values of some parameters in its model."""
    m = fit.model.mechanism.with_values(dict(values))
    return dataclasses.replace(fit, model=dataclasses.replace(fit.model, mechanism=m))
