"""Friction that differs between the runs of a search.

Friction changes with temperature, wear and load. One size for several runs may fit none of them, and friction
would then be refused, whatever its law.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, with_own_friction
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.selection import FREE_RUN_BETTER, FREE_RUN_Z, SUPPORT_Z, paired_gain
from rotflex_jax.discover.stepwise import refit_from_contained
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import Horizons
from rotflex_jax.effects.base import DRY_FRICTION


class Refits(NamedTuple):
    """Models with one candidate each, in the same order at both horizons.

    Attributes:
        predictions: The models fitted to predictions.
        free_runs: The models fitted to free runs.
    """

    predictions: list[Hypothesis]
    free_runs: list[Hypothesis]


def refit_with_own_friction(horizons: Horizons, refits: Refits, starts: Sequence[CandidateStart]) -> Refits:
    """Refits of friction repeated with a size for each recording, where all runs are clearly better so.

    A single run cannot show such a difference.

    Args:
        horizons: Training recordings at both horizons.
        refits: Models with one candidate each.
        starts: The candidate of each model, with its start of a refit to free runs.
    """
    prediction, free_run = horizons.prediction.problem, horizons.free_run.problem
    if not free_run.several_runs:
        return refits
    s, kept = free_run.supermodel, Refits(list(refits.predictions), list(refits.free_runs))
    own = [with_own_friction(s, h, c.location) for h, c in zip(refits.free_runs, starts, strict=True)]
    asked = [k for k, h in enumerate(own) if h.sizes != refits.free_runs[k].sizes]
    fitted = refit(free_run, [own[k] for k in asked])
    fitted = refit_from_contained(free_run, fitted, [starts[k] for k in asked])
    taken = {
        k: h for k, h in zip(asked, fitted, strict=True) if _better_in_each(free_run, h, refits.free_runs[k])
    }
    again = [with_own_friction(s, refits.predictions[k], starts[k].location) for k in taken]
    for (k, h), prediction_fit in zip(taken.items(), refit(prediction, again), strict=True):
        kept.predictions[k], kept.free_runs[k] = prediction_fit, h
    return kept


def baseline_with_own_friction(
    horizons: Horizons, prediction: Hypothesis, free_run: Hypothesis
) -> tuple[Hypothesis, Hypothesis]:
    """The user's model with friction of its own size in each recording (`refit_with_own_friction`).

    Args:
        horizons: Training recordings at both horizons.
        prediction: The user's model fitted to predictions.
        free_run: The user's model fitted to free runs.
    """
    laws = [e for e in horizons.prediction.problem.supermodel.baseline.effects if e.law_of == DRY_FRICTION]
    refits = Refits([prediction], [free_run])
    for effect in laws:
        start = CandidateStart(EffectLocation(effect.name, effect.at), np.zeros(0))
        refits = refit_with_own_friction(horizons, refits, [start])
    return refits.predictions[0], refits.free_runs[0]


def _better_in_each(problem: LikelihoodProblem, h: Hypothesis, other: Hypothesis) -> bool:
    """Whether free runs are clearly better with a hypothesis than with another one, in each recording too."""
    gain, z = paired_gain(h.blocks, other.blocks)
    ends = np.cumsum(problem.block_counts)[:-1]
    each = zip(*(np.split(x.blocks, ends) for x in (h, other)), strict=True)
    better = gain / len(h.blocks) > FREE_RUN_BETTER and z > FREE_RUN_Z
    return better and all(paired_gain(*blocks)[1] > SUPPORT_Z for blocks in each)


def own_friction_notes(s: SuperModel, h: Hypothesis) -> tuple[str, ...]:
    """Sentences on sizes of friction that differ between the training runs, with their values."""
    names, specs, values = s.mechanism.parameter_names, s.mechanism.parameter_specifications, h.values(s)
    return tuple(
        f"{names[i]} differs between the training recordings: "
        + ", ".join(f"{v:.3g} {specs[i].unit}" for v in values[:, i])
        + "; other parts of these runs get the value of their run, other runs the mean."
        for i in h.sizes
    )
