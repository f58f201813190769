"""The sets of effects that a search has fitted on its way, with what the recordings say for each."""

from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax.discover.horizon import Horizons, SearchHorizon
from rotflex_jax.discover.hypothesis import parameter_count
from rotflex_jax.discover.probabilities import FittedSet, HorizonEvidence
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
    count: dict[frozenset[str], int] = {}
    for v in (*at_both, *at_reported):
        h = v.hypothesis
        effects = [p for p in h.locations if p not in s.calibrations]
        names = set_names([*effects, *machine])
        count.setdefault(names, sum(parameter_count(s, h, p) for p in effects))
        free = v.free_run or (v if reported is horizons.free_run else None)
        if free:
            at_free_run.setdefault(names, []).append(free)
        if v is not free:
            at_prediction.setdefault(names, []).append(v)
    return [
        FittedSet(n, k, best_evidence(at_prediction.get(n, ())), best_evidence(at_free_run.get(n, ())))
        for n, k in count.items()
    ]


def best_evidence(fits: Sequence[ValidatedHypothesis]) -> HorizonEvidence | None:
    """What the best fit of a set says at one horizon; None without any.

    Fits that are as likely in training differ on validation data by the minimum in which the search for
    first states ended, which must not decide between sets.
    """
    if not fits:
        return None
    likeliest = max(v.hypothesis.log_likelihood for v in fits)
    equal = [v for v in fits if v.hypothesis.log_likelihood >= likeliest - AS_LIKELY_NATS]
    return evidence_of(max(equal, key=lambda v: v.log_likelihood))


def evidence_of(v: ValidatedHypothesis) -> HorizonEvidence:
    """What each half second says for a hypothesis at its horizon."""
    # Where runs validate each other, the blocks of training are the same samples once more.
    return HorizonEvidence(v.blocks, np.zeros(0) if v.folds else v.hypothesis.blocks)
