"""The sets of effects that a search has fitted on its way, with what the recordings say for each."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.horizon import Horizons, SearchHorizon
from rotflex_jax.discover.probabilities import FittedSet
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis

# Fits of one set whose log-likelihoods differ by no more than this in training are the same fit [nat].
AS_LIKELY_NATS = 1.0


def set_names(locations: Iterable[EffectLocation]) -> frozenset[str]:
    """Effects as the names of a set."""
    return frozenset(f"{p.effect}@{p.port}" for p in locations)


def fitted_sets(
    horizons: Horizons,
    at_both: Sequence[ValidatedHypothesis],
    at_reported: Sequence[ValidatedHypothesis],
    reported: SearchHorizon,
    machine: Sequence[EffectLocation],
) -> list[FittedSet]:
    """Every set once, the first of `at_both` first.

    Calibrations are in every model of the search. Whether one is a property of the machine was decided
    apart, and where it is, it belongs to every set.

    Args:
        horizons: With the training recordings.
        at_both: Fitted at both horizons.
        at_reported: Fitted at one.
        reported: That one.
        machine: Calibrations that belong to the machine.
    """
    s = horizons.prediction.problem.supermodel
    at_prediction: dict[frozenset[str], list[ValidatedHypothesis]] = {}
    at_free_run: dict[frozenset[str], list[ValidatedHypothesis]] = {}
    known: dict[frozenset[str], None] = {}
    for v in (*at_both, *at_reported):
        effects = [p for p in v.hypothesis.locations if p not in s.calibrations]
        names = set_names([*effects, *machine])
        known[names] = None
        free = v.free_run or (v if reported is horizons.free_run else None)
        if free:
            at_free_run.setdefault(names, []).append(free)
        if v is not free:
            at_prediction.setdefault(names, []).append(v)
    return [
        FittedSet(n, best_blocks(at_prediction.get(n, ())), best_blocks(at_free_run.get(n, ())))
        for n in known
    ]


def best_blocks(fits: Sequence[ValidatedHypothesis]) -> Float[np.ndarray, " B"] | None:
    """What each half second says for the best fit of a set at one horizon; None without any.

    Fits that are as likely in training differ on validation data by the minimum in which the search for
    first states ended, which must not decide between sets.
    """
    if not fits:
        return None
    likeliest = max(v.hypothesis.log_likelihood for v in fits)
    equal = [v for v in fits if v.hypothesis.log_likelihood >= likeliest - AS_LIKELY_NATS]
    return max(equal, key=lambda v: v.log_likelihood).blocks
