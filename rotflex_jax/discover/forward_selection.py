"""One round of forward selection: candidates scored, the best refitted, and one effect or a pair added."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

from rotflex_jax.discover.checkpoint import AddedEffect, beginning
from rotflex_jax.discover.hypothesis import CandidateStart, generalisations, parameter_count
from rotflex_jax.discover.pairs import find_pair, is_unexplained
from rotflex_jax.discover.score_test import Score, promising_at_both
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import (
    choose,
    describe,
    horizon_gains,
    replaced_by,
    validate_from_best_states,
)
from rotflex_jax.discover.stepwise import refit_candidates, refit_near_predictions
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis

# Candidates of both rankings together that are refitted in a round, the best of each beside them, and rounds.
REFITTED, ROUNDS = 4, 4


class Promising(NamedTuple):
    """Candidates that are worth a refit.

    Attributes:
        scores: Of predictions; effects that contain one that is on have none.
        starts: Where refits of predictions start.
        runs_starts: Where those of free runs start.
    """

    scores: list[Score]
    starts: list[CandidateStart]
    runs_starts: list[CandidateStart]


def score_candidates(state: SearchState) -> Promising:
    """The candidates with the best scores at both horizons, and effects that contain one that is on."""
    current, s = state.current, state.problem.supermodel
    left = len(s.candidates) - len(state.scores)
    state.say(beginning("score", f"round {len(state.scores) + 1}: scoring {left} candidates"))
    listed, runs = state.rank()
    chosen = promising_at_both(listed, runs, REFITTED)
    known = {x.location for x, _ in chosen}
    further = [c for c in generalisations(s, current.hypothesis) if c.location not in known]
    return Promising(
        [x for x, _ in chosen],
        [*(x.start for x, _ in chosen), *further],
        [*(y.start for _, y in chosen), *further],
    )


def _refit_and_validate(
    state: SearchState, starts: list[CandidateStart], runs_starts: list[CandidateStart]
) -> list[ValidatedHypothesis]:
    """The current model with each candidate, refitted and validated; what is not plausible is left out."""
    current, s, horizons = state.current, state.problem.supermodel, state.horizons
    assert current.free_run
    grown = refit_candidates(state.problem, current.hypothesis, starts)
    # A shape that predictions have found is worth a start of free runs.
    informed = [
        dataclasses.replace(y, others=(*y.others, h.mean_values(s)[s.parameter_indices(y.location)]))
        for y, h in zip(runs_starts, grown, strict=True)
    ]
    problem = horizons.free_run.problem
    runs = refit_candidates(problem, current.free_run.hypothesis, informed)
    runs = refit_near_predictions(problem, runs, grown)
    validated = [
        dataclasses.replace(
            horizons.validated(h, f, current),
            location=c.location,
            parameter_count=parameter_count(s, h, c.location),
        )
        for h, f, c in zip(grown, runs, starts, strict=True)
        if state.is_plausible(h, c.location) and state.is_plausible(f, c.location)
    ]
    validated = validate_from_best_states(state.validation, validated)
    state.tried += validated
    return validated


def add_best(state: SearchState, promising: Promising) -> bool:
    """Refit what is promising and add what validation data prefer; False where they prefer none of it."""
    scored, starts, runs_starts = promising
    if not starts:
        return False
    state.say(beginning("refit", "refitting " + ", ".join(str(start.location) for start in starts)))
    candidates = _refit_and_validate(state, starts, runs_starts)
    data, current = state.problem.dataset.data, state.current
    for candidate in candidates:
        state.say("  " + describe(candidate, current))
    winner, rivals = choose(candidates, current, data, state.problem.noise)
    if winner is None or winner.location is None:
        return False
    if more := _refit_replaced(state, winner, [c.location for c in candidates if c.location]):
        scored = [*scored, *(s for s, _ in more)]
        winner, rivals = choose([*candidates, *(c for _, c in more)], current, data, state.problem.noise)
        assert winner and winner.location
    nats = next((s.nats for s in scored if s.location == winner.location), 0.0)
    not_distinguished = tuple(r.location for r in rivals if r.location)
    added = AddedEffect(winner.location, nats, not_distinguished, horizon_gains(winner, current))
    state.add(winner, [added])
    return True


def _refit_replaced(
    state: SearchState, winner: ValidatedHypothesis, tried: Sequence[EffectLocation]
) -> list[tuple[Score, ValidatedHypothesis]]:
    """Candidates in whose place the winner may stand, refitted without it, where it leaves something."""
    if not is_unexplained(state.horizons, winner):
        return []
    before = tuple(t.listed for t in state.score_tests(state.current))
    after = tuple(t.listed for t in state.score_tests(winner))
    assert winner.location
    locations = replaced_by(winner.location, before, after, tried)
    if not locations:
        return []
    state.say("refitting what it may stand for: " + ", ".join(map(str, locations)))
    first, second = ({x.location: x for x in listed} for listed in before)
    more = _refit_and_validate(
        state, [first[p].start for p in locations], [second[p].start for p in locations]
    )
    for candidate in more:
        state.say("  " + describe(candidate, state.current))
    return [(first[c.location], c) for c in more if c.location]


def add_pair(state: SearchState, rounds: int) -> bool:
    """Add two effects that are needed together, where something is left; False where there are none.

    Args:
        state: What was found so far.
        rounds: Most effects that the search may add.
    """
    if len(state.scores) + 2 > rounds:
        return False
    if state.tests is None or not is_unexplained(state.horizons, state.current):
        return False
    state.say(beginning("pairs", "scoring pairs of candidates"))
    tests = state.score_tests(state.current)
    pair, tried = find_pair(state.horizons, state.current, tests, state.is_plausible, state.say, state.tried)
    state.tried += tried
    if pair is None:
        return False
    nats = {x.location: x.nats for x in tests[0].listed}
    state.add(
        pair.found,
        [
            AddedEffect(p, nats.get(p, 0.0), tuple(pair.rivals[p]), horizon_gains(pair.found, less))
            for p, less in pair.members.items()
        ],
    )
    return True
