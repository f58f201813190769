"""The sets of effects that a search has fitted on its way, with what the recordings say for each."""

from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax.discover.horizon import Horizons, SearchHorizon
from rotflex_jax.discover.hypothesis import parameter_count
from rotflex_jax.discover.probabilities import FittedSet, HorizonEvidence
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis


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
    """Every set once, the first of `at_both` first; of several fits the likeliest in training counts.

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
    found: dict[frozenset[str], tuple[ValidatedHypothesis, FittedSet]] = {}
    everyone = [(v, True) for v in at_both] + [(v, False) for v in at_reported]
    for v, both in everyone:
        h = v.hypothesis
        effects = [p for p in h.locations if p not in s.calibrations]
        names = set_names([*effects, *machine])
        known = found.get(names)
        if known and (not both or known[0].hypothesis.log_likelihood >= h.log_likelihood):
            continue
        runs = v.free_run if both else v if reported is horizons.free_run else None
        prediction = v if both or reported is horizons.prediction else None
        count = sum(parameter_count(s, h, p) for p in effects)
        row = FittedSet(names, count, prediction and evidence_of(prediction), runs and evidence_of(runs))
        found[names] = (v, row)
    return [row for _, row in found.values()]


def evidence_of(v: ValidatedHypothesis) -> HorizonEvidence:
    """What each half second says for a hypothesis at its horizon."""
    # Where runs validate each other, the blocks of training are the same samples once more.
    return HorizonEvidence(v.blocks, np.zeros(0) if v.folds else v.hypothesis.blocks)
