"""Friction that differs between the runs of a search.

Friction changes with temperature, wear and load. One size for several runs may fit none of them, and friction
would then be refused, whatever its law.

Where a run moves mostly in one direction, an offset of its own does the same in it as friction of another
size, and nothing is clearly better. But where the run reverses, the two differ, and offsets of drives are
small. So a run has friction of its own size, too, if a large offset of the run then becomes small.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, is_physical, with_own_friction
from rotflex_jax.discover.likelihood import refit
from rotflex_jax.discover.selection import FREE_RUN_BETTER, FREE_RUN_Z, SUPPORT_Z, is_poor, paired_gain
from rotflex_jax.discover.stepwise import refit_from_contained
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import Horizons, ValidatedHypothesis, ValidationSet
from rotflex_jax.effects.base import DRY_FRICTION

# In a poor model, friction of a validation run has a size of its own only if it differs by more than this
# factor. What else the model lacks may make free runs better with a slightly larger or smaller friction.
LARGE_DIFFERENCE = 1.75
# An offset of a run is large beyond this many typical sizes (0.1 V). It stands for friction of another size
# if it is smaller by this factor once the run has friction of its own.
LARGE_OFFSET, OFFSET_LEFT = 2.0, 0.5


class Refits(NamedTuple):
    """Models with one candidate each, in the same order at both horizons.

    Attributes:
        predictions: The models fitted to predictions.
        free_runs: The models fitted to free runs.
    """

    predictions: list[Hypothesis]
    free_runs: list[Hypothesis]


def refit_with_own_friction(horizons: Horizons, refits: Refits, starts: Sequence[CandidateStart]) -> Refits:
    """Refits of friction repeated with a size for each recording.

    They are kept where all runs are clearly better so, or where a large offset of a run then becomes small. A
    single run cannot show such a difference.

    Args:
        horizons: Training recordings at both horizons.
        refits: Models with one candidate each.
        starts: The candidate of each model, with its start of a refit to free runs.
    """
    prediction, free_run = horizons.prediction.problem, horizons.free_run.problem
    if not free_run.several_runs:
        return refits
    s, kept = free_run.supermodel, Refits(list(refits.predictions), list(refits.free_runs))
    # Offsets start at zero, or an offset would keep what it stands for.
    own = [
        _without_offsets(s, with_own_friction(s, h, c.location))
        for h, c in zip(refits.free_runs, starts, strict=True)
    ]
    asked = [k for k, h in enumerate(own) if h.sizes != refits.free_runs[k].sizes]
    fitted = refit(free_run, [own[k] for k in asked])
    fitted = refit_from_contained(free_run, fitted, [starts[k] for k in asked])
    counts, every = free_run.block_counts, range(len(free_run.block_counts))
    taken = {
        k: h
        for k, h in zip(asked, fitted, strict=True)
        if _better_in_each(h.blocks, refits.free_runs[k].blocks, counts, every)
        or offset_stood_for_friction(*(_own_offsets(s, x) for x in (refits.free_runs[k], h)))
    }
    again = [with_own_friction(s, refits.predictions[k], starts[k].location) for k in taken]
    for (k, h), prediction_fit in zip(taken.items(), refit(prediction, again), strict=True):
        kept.predictions[k], kept.free_runs[k] = prediction_fit, h
    return kept


def validated_with_own_friction(
    horizons: Horizons, found: ValidatedHypothesis, near: ValidatedHypothesis | None = None
) -> ValidatedHypothesis:
    """A model of one training recording, with friction of its own size in validation runs of other runs.

    It is the given model unless free runs over each of these validation recordings are clearly better so, or
    a large offset of one of them then becomes small. In a model that is still poor then, friction must differ
    by a large factor too. Several training recordings show by themselves whether friction differs
    (`refit_with_own_friction`).

    Args:
        horizons: Training and validation recordings at both horizons.
        found: The model, validated; friction is that of its `location`, which may be another effect.
        near: See `Horizons.validated`.
    """
    validation = horizons.free_run.validation
    unknown = validation.problem.of_other_runs
    if not unknown or len(horizons.free_run.problem.dataset.recordings) > 1:
        return found
    assert found.free_run and found.location
    s, fits = validation.problem.supermodel, (found.hypothesis, found.free_run.hypothesis)
    own = [with_own_friction(s, h, found.location) for h in fits]
    if any(h.sizes == before.sizes for h, before in zip(own, fits, strict=True)):
        return found
    tried = horizons.validated(own[0], own[1], near)
    assert tried.free_run
    counts = validation.problem.block_counts
    better = _better_in_each(tried.free_run.blocks, found.free_run.blocks, counts, unknown)
    offsets = (_own_offsets(s, v.adapted)[unknown] for v in (found.free_run, tried.free_run))
    if (
        not all(is_physical(s, v.adapted, found.location) for v in (tried, tried.free_run))
        or not (better or offset_stood_for_friction(*offsets))
        or (is_poor(tried, validation.problem.noise) and not _differs_much(s, tried.free_run, unknown))
    ):
        return found
    return dataclasses.replace(tried, location=found.location, parameter_count=found.parameter_count)


def offset_stood_for_friction(before: Float[np.ndarray, "R K"], after: Float[np.ndarray, "R K"]) -> bool:
    """Whether a large offset of a run becomes small if each run has friction of its own size.

    Args:
        before: Offsets of each run in typical sizes, in a model with one size of friction.
        after: The same in a model with friction of its own size in each run.
    """
    most, left = (float(np.abs(offsets).max(initial=0.0)) for offsets in (before, after))
    return most > LARGE_OFFSET and left < OFFSET_LEFT * most


def _own_offsets(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, "R K"]:
    """Calibrations of each recording, which have no bounds: their coordinates are in typical sizes."""
    return h.local_z[:, _calibrations(s, h)]


def _without_offsets(s: SuperModel, h: Hypothesis) -> Hypothesis:
    """A hypothesis with all calibrations of its recordings at zero."""
    local_z = h.local_z.copy()
    local_z[:, _calibrations(s, h)] = 0.0
    return dataclasses.replace(h, local_z=local_z)


def _calibrations(s: SuperModel, h: Hypothesis) -> list[int]:
    """Columns of the local parameters that are calibrations."""
    return [h.local.index(i) for i in s.local if i in h.local]


def _differs_much(s: SuperModel, tried: ValidatedHypothesis, unknown: Sequence[int]) -> bool:
    """Whether friction in each validation recording differs by `LARGE_DIFFERENCE` from that of training.

    Args:
        s: The model with all candidates.
        tried: The model with sizes of friction that were fitted to validation recordings.
        unknown: Indices of these recordings.
    """
    sizes = list(tried.hypothesis.sizes)
    trained = float(np.abs(tried.hypothesis.mean_values(s)[sizes]).max())
    each = np.abs(tried.adapted.values(s)[unknown][:, sizes]).max(axis=1)
    return bool(np.all(np.maximum(each, trained) > LARGE_DIFFERENCE * np.minimum(each, trained)))


def validated_baseline(
    horizons: Horizons, prediction: Hypothesis, free_run: Hypothesis
) -> ValidatedHypothesis:
    """The user's model, validated, with friction of its own size in each run where runs are better so.

    Args:
        horizons: Training and validation recordings at both horizons.
        prediction: The user's model fitted to predictions.
        free_run: The user's model fitted to free runs.
    """
    effects = horizons.prediction.problem.supermodel.baseline.effects
    laws = [EffectLocation(e.name, e.at) for e in effects if e.law_of == DRY_FRICTION]
    refits = Refits([prediction], [free_run])
    for location in laws:
        refits = refit_with_own_friction(horizons, refits, [CandidateStart(location, np.zeros(0))])
    found = horizons.validated(refits.predictions[0], refits.free_runs[0])
    for location in laws:
        found = validated_with_own_friction(horizons, dataclasses.replace(found, location=location))
    return dataclasses.replace(found, location=None)


def _better_in_each(
    a: Float[np.ndarray, " B"], b: Float[np.ndarray, " B"], counts: Sequence[int], asked: Sequence[int]
) -> bool:
    """Whether free runs are clearly better with model `a` than with model `b`, in each recording too.

    Args:
        a: Evidence of each block with model `a`.
        b: Evidence of each block with model `b`.
        counts: Number of blocks of each recording.
        asked: Indices of the recordings that are compared.
    """
    ends = np.cumsum(counts)[:-1]
    each = list(zip(np.split(a, ends), np.split(b, ends), strict=True))
    each = [each[k] for k in asked]
    together = [np.concatenate(blocks) for blocks in zip(*each, strict=True)]
    gain, z = paired_gain(together[0], together[1])
    better = gain / sum(counts[k] for k in asked) > FREE_RUN_BETTER and z > FREE_RUN_Z
    return better and all(paired_gain(*blocks)[1] > SUPPORT_Z for blocks in each)


def own_friction_notes(
    found: ValidatedHypothesis, validation: ValidationSet, fitted_again: bool
) -> tuple[str, ...]:
    """Sentences on sizes of friction that differ between runs, with their values.

    Args:
        found: The final model of the search.
        validation: The validation recordings.
        fitted_again: Whether the model to use is that of a final fit, which has other sizes for other runs.
    """
    s, h, problem = validation.problem.supermodel, found.hypothesis, validation.problem
    names, specs = s.mechanism.parameter_names, s.mechanism.parameter_specifications
    unknown = problem.of_other_runs
    each = {"training": h.values(s), "validation": found.adapted.values(s)[unknown]}

    def where(i: int) -> str:
        listed = {
            f"the {kind} recording{'s' * (len(values) > 1)}": ", ".join(f"{v:.3g}" for v in values[:, i])
            for kind, values in each.items()
            if len(values)
        }
        return ", ".join(f"{values} {specs[i].unit} in {recordings}" for recordings, values in listed.items())

    sentence = " The value in the validation data was fitted to them, and their errors are with it."
    fitted = sentence if unknown else ""
    others = f"other runs {'the mean' if len(each['training']) > 1 else 'the value'} of the training data."
    used = f"; other parts of these runs get the value of their run, {others}"
    if fitted_again:
        used = " (last model of the search, before the final fit)."
    return tuple(f"{names[i]} differs between runs: {where(i)}{used}{fitted}" for i in h.sizes)
