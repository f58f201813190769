"""Offsets and biases: do they belong to the machine, to a recording alone, or to neither?"""

import numpy as np

from rotflex_jax.discover.decide import WINDOWS_BETTER
from rotflex_jax.discover.grow import without
from rotflex_jax.discover.heldout import Away, Trial, held_out
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.refit import Judge, refit
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.effects import CATALOG


def settle(
    judge: Judge, away: Away, final: Hypothesis, order: list[Place]
) -> tuple[Hypothesis, list[Place], list[Place], tuple[str, ...]]:
    """Where the calibrations of a final model belong.

    Returns:
        The final model; the effects of the machine, in order; calibrations that belong to the training
        recordings alone; and a note where calibrations were left out altogether.
    """
    asked = [p for p in order if p in judge.bench.supermodel.calibrations]
    trial = held_out(away, final)
    order, own = _carried_over(away, trial, order)
    bare = _without(judge, away, trial, order)
    if bare is None:
        return final, order, own, ()
    names = " and ".join(f"{CATALOG[p[0]].title} at {p[1]}" for p in asked)
    note = (
        f"The training data ask for {names}, but held-out runs are better with a model fitted without; "
        "left out."
    )
    return bare, [p for p in order if p in bare.places], [], (note,)


def _carried_over(away: Away, final: Trial, order: list[Place]) -> tuple[list[Place], list[Place]]:
    """Effects of the machine, and calibrations that belong to the training recordings alone.

    A calibration is one of the machine if its trained value makes the held-out free runs clearly better.
    """
    kept, own = list(order), []
    for place in [p for p in order if p in away.judge.bench.supermodel.calibrations]:
        with_it = away.short_runs(final.trained, kept)
        less = away.short_runs(final.trained, [p for p in kept if p != place])
        if float(np.mean(np.log(with_it / less))) > -WINDOWS_BETTER:
            kept.remove(place)
            own.append(place)
    return kept, own


def _without(judge: Judge, away: Away, final: Trial, order: list[Place]) -> Hypothesis | None:
    """The final model fitted without calibrations, where that runs better on the held-out recordings.

    Training recordings may ask for offsets that the held-out ones do not share; numbers fitted beside
    such offsets are then further off than those fitted as if there were none.
    """
    bare = final.hypothesis
    asked = set(bare.places) & set(judge.bench.supermodel.calibrations)
    if not asked:
        return None
    for place in asked:
        bare = without(judge, bare, place)
    bare = refit(judge, [bare])[0]
    with_them = away.short_runs(final.trained, order)
    alone = away.short_runs(held_out(away, bare).trained, [p for p in order if p in bare.places])
    return bare if float(np.mean(np.log(alone / with_them))) < -WINDOWS_BETTER else None


def own_notes(judge: Judge, away: Away, final: Trial, own: list[Place]) -> tuple[str, ...]:
    """What differs between recordings, in sentences."""
    out = []
    s = judge.bench.supermodel
    for place in own:
        for i in s.parameter_indices(place):
            unit = s.mechanism.parameter_specifications[i].unit
            trained = final.hypothesis.values(judge.bench)[:, i]
            unseen = final.adapted.values(away.judge.bench)[:, i]
            numbers = [", ".join(f"{v:+.3g} {unit}" for v in row) for row in (trained, unseen)]
            out.append(
                f"{CATALOG[place[0]].title} at {place[1]} belongs to each recording, not to the machine: "
                f"{numbers[0]} in the training data, {numbers[1]} in the held-out data; it was fitted, "
                f"but not carried over."
            )
    return tuple(out)
