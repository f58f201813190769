"""Replacement of effects of a poor final model by other laws, and rivals that remain possible.

Whatever else a model lacks may favour one law of friction, and a round refits only the laws with the best
scores. So at the end of a search, every other law of the same thing (`Effect.law_of`) and every rival of its
round is fitted in the place of an effect, at both horizons. A law replaces the effect if one horizon clearly
prefers it and the other one does not object (`better_in_place`).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.conclusion import nats_left
from rotflex_jax.discover.forward_selection import refit_and_validate
from rotflex_jax.discover.hypothesis import parameter_count, usual_start, without
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import (
    better_in_place,
    gains_in_words,
    predictions_apart,
    shares_of_gain,
    undecided,
)
from rotflex_jax.discover.stepwise import titled
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.effects import CATALOG
from rotflex_jax.parameters import bound_reached


def laws_in_question(
    state: SearchState, location: EffectLocation, on: Sequence[EffectLocation]
) -> list[EffectLocation]:
    """Laws that the final fit tries in the place of an effect, from measured first states.

    They are the laws of the same thing that the search cannot exclude in its place, and the laws that contain
    it.

    Args:
        state: A finished search, with the rivals that remain.
        location: An effect of the model. There are no laws for an effect of the user's model, or for an
            effect that is no law.
        on: All effects of the model.
    """
    if location not in state.scores:
        return []
    contains = CATALOG[location.effect].contains
    laws = [p for p in state.problem.supermodel.other_laws(location) if p not in on]
    remaining = [p for p in state.rivals.get(location, []) if p.effect not in contains]
    return [p for p in laws if p in remaining or location.effect in CATALOG[p.effect].contains]


def take_better_laws(state: SearchState) -> tuple[str, ...]:
    """Replace effects of a poor model by laws that the data prefer (`better_in_place`).

    Args:
        state: A search that has added its effects and left out those not needed.

    Returns:
        A sentence on each replacement.
    """
    s, notes = state.problem.supermodel, []
    for location in list(state.scores):
        if location not in state.current.hypothesis.locations:  # left out before, or replaced by another law
            continue
        laws = [p for p in s.other_laws(location) if p not in state.current.hypothesis.locations]
        known = _as_found(state, location)
        fitted = _in_place(state, location, laws)
        better = [v for v in fitted if better_in_place(v, known, state.problem.measured_values)]
        better = [v for v in better if not _shape_at_bound(s, v, known)]
        if not better:
            continue
        best = better[int(np.argmax(shares_of_gain(better, known)))]
        assert best.location
        state.say(f"  {best.location} instead of {location}: " + gains_in_words(best, known))
        state.replace(location, best)
        predictions = predictions_apart(best, known)
        why = (
            "predictions and free runs prefer it"
            if predictions
            else "free runs prefer it by far, and predictions do not distinguish the two"
        )
        notes.append(
            f"{titled(best.location)} has taken the place of {titled(location)}, which its round had added: "
            f"beside all that was found, {why}."
        )
    return tuple(notes)


def _shape_at_bound(s: SuperModel, rival: ValidatedHypothesis, known: ValidatedHypothesis) -> bool:
    """Whether a preferred law has a shape parameter at a bound, so that the data need yet another law.

    The fit to predictions counts only if predictions prefer the law.
    """
    assert rival.location and rival.free_run
    c, specs = s.candidates[rival.location], s.mechanism.parameter_specifications
    shape = [i for i, amplitude in zip(c.parameters, c.amplitudes, strict=True) if not amplitude]
    preferred = (rival, rival.free_run) if predictions_apart(rival, known) else (rival.free_run,)
    fits = [v.hypothesis.mean_values(s) for v in preferred]
    return any(bound_reached(float(values[i]), specs[i]) for values in fits for i in shape)


def _as_found(state: SearchState, location: EffectLocation) -> ValidatedHypothesis:
    """The final model, marked as a candidate with one of its effects."""
    count = parameter_count(state.problem.supermodel, state.current.hypothesis, location)
    return dataclasses.replace(state.current, location=location, parameter_count=count)


def undecided_rivals(state: SearchState) -> dict[EffectLocation, list[EffectLocation]]:
    """Effects of a poor model -> effects that the data do not exclude in their places.

    Args:
        state: A search that has added its effects, with the rivals of its rounds. Models that are fitted join
            `state.tried`.
    """
    s, found = state.problem.supermodel, list(state.scores)
    final = state.current
    left = nats_left(state.horizons.prediction, final)
    remaining = {}
    for location in [p for p in found if p in final.hypothesis.locations]:
        wanted = dict.fromkeys([*s.other_laws(location), *state.rivals[location]])
        rivals = [p for p in wanted if p not in final.hypothesis.locations]
        known = _as_found(state, location)
        fitted = _in_place(state, location, [p for p in rivals if not CATALOG[p.effect].line])
        for rival in fitted:
            state.say(f"  {rival.location} instead of {location}: " + gains_in_words(rival, final))
        # A periodic disturbance remains a rival without a test: it was refitted at its frequency in its
        # round.
        remaining[location] = [p for p in rivals if CATALOG[p.effect].line]
        measured = state.problem.measured_values
        remaining[location] += [
            t.location for t in fitted if t.location and undecided(known, t, left, measured)
        ]
    return remaining


def _in_place(
    state: SearchState, location: EffectLocation, rivals: Sequence[EffectLocation]
) -> list[ValidatedHypothesis]:
    """The final model with each rival in the place of an effect, fitted at both horizons unless known."""
    s, final = state.problem.supermodel, state.current
    assert final.free_run
    others = s.without_calibrations(final.hypothesis.locations) - {location}
    tried = {s.without_calibrations(v.hypothesis.locations): v for v in state.tried if v.free_run}
    known = {r: tried[others | {r}] for r in rivals if others | {r} in tried}
    starts = [usual_start(s, r) for r in rivals if r not in known]
    less = dataclasses.replace(
        final,
        hypothesis=without(s, final.hypothesis, location),
        free_run=dataclasses.replace(
            final.free_run, hypothesis=without(s, final.free_run.hypothesis, location)
        ),
    )
    fitted = []
    if starts:
        state.say(f"  fitting {', '.join(str(c.location) for c in starts)} instead of {location}")
        fitted = refit_and_validate(state, less, starts, starts)
    counts = {r: parameter_count(s, v.hypothesis, r) for r, v in known.items()}
    return [
        *(dataclasses.replace(v, location=r, parameter_count=counts[r]) for r, v in known.items()),
        *fitted,
    ]
