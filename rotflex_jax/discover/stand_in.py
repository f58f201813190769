"""Signs that an effect stands in for something that the catalogue lacks.

Where the final model leaves more than sensor noise, something else is wrong with it, and an effect may have
been added because it imitates a part of that. Three signs, none of which the search decides by:

- its size differs between the windows of the recordings: an effect of the machine has one size;
- free runs change less by it than their error still is;
- predictions gain less by it than they would if their errors were the sensor noise alone.

In a model that explains its recordings none of them says anything: what is left there is noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rotflex_jax.discover.horizon import SearchHorizon
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.coordinates import orthogonal_to

# Root mean square of the change of size between windows, over the size, that an effect of the machine stays
# below, and least root mean square that it changes free runs by, over the error that is left.
SCATTER, LEAST_CHANGE = 0.15, 0.5


class WindowSizes(NamedTuple):
    """An effect in the windows of free runs.

    Attributes:
        scatter: Root mean square change of its size that the windows ask for one by one, over its size.
        change: Root mean square of what it changes in the errors, over what is left of them.
    """

    scatter: float
    change: float


def window_sizes(
    problem: LikelihoodProblem, h: Hypothesis, locations: Sequence[EffectLocation]
) -> dict[EffectLocation, WindowSizes]:
    """Whether effects have the same size in all windows of some recordings.

    In each window the amplitudes `a` of an effect are fitted to the whitened errors `w` by one Gauss-Newton
    step `d`, with slopes `J` of which the first state and the recording's own parameters are projected out,
    and all other parameters held. The scatter is the root of `sum |J d|^2 / sum |J a|^2`, the change that of
    `sum |J a|^2 / sum |w|^2`; a window counts by what the effect does there.

    Args:
        problem: Free runs over the recordings.
        h: Fitted to them, or to others. Windows in which its run diverges say nothing.
        locations: Effects of `h`; those without an amplitude, and those with values for each recording, are
            left out.
    """
    s, seen = problem.supermodel, problem.seen
    e, J = problem.slopes([h])
    w, W = h.whitener(e[0], seen), h.whitener(J[0, : h.moved], seen)
    values, derivative = (x.mean(axis=0) for x in h.physical(s))
    columns = {i: k for k, i in enumerate((*h.free, *h.local))}
    found = {}
    for location in locations:
        kind = CATALOG[location.effect]
        names = {f"{location.port}.{location.effect}.{n}" for n in kind.amplitudes}
        own = [i for i, n in enumerate(s.mechanism.parameter_names) if n in names and i in columns]
        if kind.per_recording or not own:
            continue
        moved = [columns[i] for i in own]
        beside = [k for k in range(len(h.free), h.moved) if k not in moved]
        totals = np.zeros(3)
        for r in range(len(w)):
            for _, samples in problem.windows.of(r):
                slopes = W[moved, r, samples].reshape(len(own), -1) / derivative[own, None]
                rows = np.concatenate([slopes, w[None, r, samples].reshape(1, -1)])
                others = W[beside, r, samples].reshape(len(beside), -1)
                if not (np.isfinite(rows).all() and np.isfinite(others).all()):
                    continue  # the run diverges in this window
                rows = orthogonal_to(rows, others)
                slopes, left = rows[:-1], rows[-1]
                step = np.linalg.lstsq(slopes.T, left, rcond=1e-6)[0]
                totals += [np.sum((step @ slopes) ** 2), np.sum((values[own] @ slopes) ** 2), left @ left]
        wanted, acts, rest = totals
        if acts > 0 and rest > 0:
            found[location] = WindowSizes(float(np.sqrt(wanted / acts)), float(np.sqrt(acts / rest)))
    return found


def nats_above_noise(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """What predictions would gain if their errors were the sensor noise alone [nat].

    `N log(rms / noise)`, summed over the channels whose error is above the noise.
    """
    e, counted = problem.innovations([h])[0], problem.seen > 0
    rms = np.sqrt(np.mean(e[counted] ** 2, axis=0))
    return float(np.sum(counted.sum() * np.log(np.maximum(rms / problem.noise, 1.0))))


def signs(
    horizons: tuple[SearchHorizon, SearchHorizon],
    final: ValidatedHypothesis,
    gains: dict[EffectLocation, float],
) -> dict[EffectLocation, tuple[str, ...]]:
    """Effects of an unexplained model -> why each may stand in for something else, in words.

    Args:
        horizons: Predictions and free runs.
        final: The model, fitted and validated at both.
        gains: Effects that were added -> what predictions of training and validation data gained [nat].
    """
    prediction, free_run = horizons
    runs = final.free_run
    assert runs
    sets = [(free_run.problem, runs.hypothesis)]
    rest = nats_above_noise(prediction.problem, final.hypothesis)
    if free_run.validation.folds:  # the validation recordings are those of training
        rest *= 2
    else:
        sets.append((free_run.validation.problem, runs.adapted))
        rest += nats_above_noise(prediction.validation.problem, final.adapted)
    locations = [p for p in runs.hypothesis.locations if p in gains]
    sizes = [window_sizes(problem, h, locations) for problem, h in sets]
    out = {}
    for location in locations:
        own, reasons = [x[location] for x in sizes if location in x], []
        if own and (scatter := max(x.scatter for x in own)) > SCATTER:
            reasons.append(
                f"windows of {free_run.validation.window_seconds:g} s differ by {scatter:.0%} on its size"
            )
        if own and (change := min(x.change for x in own)) < LEAST_CHANGE:
            reasons.append(f"it changes free runs by {change:.2g} of the error that is left")
        if gains[location] < rest:
            gain = gains[location]
            reasons.append(
                f"predictions gain {gain:.0f} nats by it, and {rest:.0f} are left above the sensor noise"
            )
        out[location] = tuple(reasons)
    return out
