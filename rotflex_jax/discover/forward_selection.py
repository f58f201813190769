"""One round of forward selection: score candidates, refit the best, and add one effect or a pair."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

from rotflex_jax.discover.checkpoint import AddedEffect, beginning
from rotflex_jax.discover.friction_of_runs import (
    Refits,
    refit_with_own_friction,
    validated_with_own_friction,
)
from rotflex_jax.discover.hypothesis import CandidateStart, generalisations, parameter_count
from rotflex_jax.discover.pairs import best_candidates, find_pair, is_unexplained
from rotflex_jax.discover.score_test import Score, candidates_to_score, promising_at_both
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import (
    choose,
    describe,
    horizon_gains,
    likelier_of_each,
    replaced_by,
    validate_from_best_states,
)
from rotflex_jax.discover.stepwise import refit_candidates, refit_near_predictions
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import DRY_FRICTION
from rotflex_jax.effects.labels import law_of
from rotflex_jax.runtime.xla import on_threads

# Number of candidates that are refitted in a round, to which the best one of each horizon is added, and
# largest number of rounds.
REFITTED, ROUNDS = 4, 4
# Number of laws of dry friction that are refitted beside a model beside which none is tried, see
# `_dry_friction`. The simplest law at the same port is added.
FRICTION_LAWS = 2


class Promising(NamedTuple):
    """Candidates that are worth a refit.

    Attributes:
        beside: The model to which they are added.
        scores: Scores in predictions; candidates that contain an effect with memory that is on have none.
        starts: Starts of refits to predictions.
        runs_starts: Starts of refits to free runs.
    """

    beside: ValidatedHypothesis
    scores: list[Score]
    starts: list[CandidateStart]
    runs_starts: list[CandidateStart]

    @classmethod
    def at(
        cls, beside: ValidatedHypothesis, scores: Sequence[list[Score]], places: Sequence[EffectLocation]
    ) -> "Promising":
        """Candidates at given locations, with starts from the scores for a model at both horizons."""
        first, second = ({x.location: x for x in listed} for listed in scores)
        found = [first[p] for p in places]
        return cls(beside, found, [x.start for x in found], [second[p].start for p in places])


def score_candidates(state: SearchState) -> list[Promising]:
    """The candidates with the best scores for each model to which they may be added."""
    state.say(beginning("score", f"round {len(state.scores) + 1}: scoring {_scored(state)}"))
    found = [_promising(state, state.origin)]
    if state.origin is not state.current:
        state.say("the model as it is was fitted far from the values given: candidates beside both")
        found.append(_promising(state, state.current))
    # Where friction differs between runs, its slopes with one size are small. Further rounds: other motors.
    if state.problem.several_runs or state.scores:
        found += _dry_friction(state, found)
    return [p for p in found if p.starts]


def _scored(state: SearchState) -> str:
    """The number of candidates that a round scores, and those that it leaves out, in words."""
    s, h = state.problem.supermodel, state.origin.hypothesis
    scored = candidates_to_score(s, h, state.error_lines(state.origin))
    left_out = [str(p) for p in s.candidates if p not in (*scored, *h.locations)]
    without = f"; without {', '.join(left_out)}, as the errors have no line that the input lacks"
    return f"{len(scored)} candidates" + without * bool(left_out)


def _promising(state: SearchState, beside: ValidatedHypothesis) -> Promising:
    """The candidates with the best scores at both horizons, and `generalisations` of effects that are on."""
    listed, runs = state.rank(beside)
    chosen = promising_at_both(listed, runs, REFITTED)
    known = {x.location for x, _ in chosen}
    further = generalisations(state.problem.supermodel, beside.hypothesis)
    further = [c for c in further if c.location not in known]
    return Promising(
        beside,
        [x for x, _ in chosen],
        [*(x.start for x, _ in chosen), *further],
        [*(y.start for _, y in chosen), *further],
    )


def add_dry_friction(state: SearchState, promising: Sequence[Promising]) -> bool:
    """Add dry friction at a motor if the first round adds nothing; False if none passes.

    It is tried beside each model of the round beside which no dry friction was tried.

    Every machine has dry friction. But its slopes say little about it if the inertia or the damping of the
    model compensates for it, or if another missing effect explains far more. After an effect was found, no
    friction is added in this way: the effect may itself represent the friction (for example a dead zone of
    the input), and friction in addition would only follow errors.

    Args:
        state: The search with what it has found so far.
        promising: Candidates that the round has tried.
    """
    chosen = _dry_friction(state, promising)
    return bool(chosen) and add_best(state, chosen)


def _dry_friction(state: SearchState, promising: Sequence[Promising]) -> list[Promising]:
    """Laws of dry friction at the motors, beside each model of the round beside which none is tried.

    They belong to the first round. In a machine with several motors, further rounds have laws at the other
    motors once there is dry friction at one. There are none if the model explains the recordings.

    Args:
        state: The search with what it has found so far.
        promising: Candidates that the round tries.
    """
    s = state.problem.supermodel
    motors = {port for port in s.baseline.port_vectors if s.baseline.has_motor(port)}
    driven = motors | {e.port for e in s.baseline.effects if e.signal}
    there = {e.port for e in s.baseline.effects if law_of(e.name) == DRY_FRICTION}
    there |= {p.port for p in state.current.hypothesis.locations if law_of(p.effect) == DRY_FRICTION}
    ports = driven - there
    if (state.scores or there) and not there & driven:
        return []
    if not ports or not is_unexplained(state.horizons, state.current):
        return []
    chosen = []
    for beside in [state.origin] if state.origin is state.current else [state.origin, state.current]:
        tried = [start.location for p in promising if p.beside is beside for start in p.starts]
        if any(law_of(p.effect) == DRY_FRICTION and (not there or p.port in ports) for p in tried):
            continue
        tests = state.score_tests(beside)
        order = best_candidates(*tests, len(s.candidates))
        laws = [p for p in order if law_of(p.effect) == DRY_FRICTION and p.port in ports]
        # The simplest law converges from starts far away, where richer ones often do not.
        simplest = [p for p in laws if p.port == laws[0].port and not CATALOG[p.effect].contains]
        laws = list(dict.fromkeys([*laws[:FRICTION_LAWS], *simplest]))
        if laws:
            chosen.append(Promising.at(beside, [test.listed for test in tests], laws))
    return chosen


def refit_and_validate(
    state: SearchState,
    beside: ValidatedHypothesis,
    starts: list[CandidateStart],
    runs_starts: list[CandidateStart],
) -> list[ValidatedHypothesis]:
    """A model with each candidate, refitted and validated at both horizons; implausible fits are left out.

    Args:
        state: The search; the models join `state.tried`.
        beside: The model to which candidates are added.
        starts: Starts of refits to predictions.
        runs_starts: Starts of refits to free runs.
    """
    s, horizons = state.problem.supermodel, state.horizons
    assert beside.free_run
    grown = refit_candidates(state.problem, beside.hypothesis, starts)
    state.say("  predictions are fitted, free runs follow")
    # The values fitted to predictions are one more start of the refits to free runs.
    informed = [
        dataclasses.replace(y, others=(*y.others, h.mean_values(s)[s.parameter_indices(y.location)]))
        for y, h in zip(runs_starts, grown, strict=True)
    ]
    problem = horizons.free_run.problem
    runs = refit_candidates(problem, beside.free_run.hypothesis, informed)
    runs = refit_near_predictions(problem, runs, grown)
    grown, runs = refit_with_own_friction(horizons, Refits(grown, runs), informed)
    state.say("  free runs are fitted, validation follows")
    plausible = []
    for h, f, location in zip(grown, runs, (c.location for c in starts), strict=True):
        if fault := state.fault(h, location) or state.fault(f, location):
            state.say(f"  left out: {location}, since {fault}")
        else:
            plausible.append((h, f, location))
    found = horizons.all_validated([(h, f) for h, f, _ in plausible], beside)
    validated = [
        dataclasses.replace(v, location=location, parameter_count=parameter_count(s, h, location))
        for v, (h, _, location) in zip(found, plausible, strict=True)
    ]
    validated = on_threads(lambda v: validated_with_own_friction(horizons, v, beside), validated)
    validated = validate_from_best_states(state.validation, validated)
    state.tried += validated
    return validated


def add_best(state: SearchState, promising: Sequence[Promising]) -> bool:
    """Refit promising candidates and add the one that validation data prefer; False if none passes."""
    scored, refitted = [], []
    for beside, scores, starts, runs_starts in promising:
        state.say(beginning("refit", "refitting " + ", ".join(str(start.location) for start in starts)))
        scored += scores
        refitted += refit_and_validate(state, beside, starts, runs_starts)
    candidates = likelier_of_each(refitted)
    measured, current = state.problem.measured_values, state.current
    for candidate in candidates:
        state.say("  " + describe(candidate, current))
    winner, rivals = choose(candidates, current, measured, state.problem.noise, bool(state.still))
    if winner is None or winner.location is None:
        return False
    if more := _refit_replaced(state, winner, [c.location for c in candidates if c.location]):
        scored = [*scored, *(s for s, _ in more)]
        candidates = [*candidates, *(c for _, c in more)]
        winner, rivals = choose(candidates, current, measured, state.problem.noise, bool(state.still))
        assert winner and winner.location
    nats = max((s.nats for s in scored if s.location == winner.location), default=math.nan)
    not_distinguished = tuple(r.location for r in rivals if r.location)
    added = AddedEffect(winner.location, nats, not_distinguished, horizon_gains(winner, current))
    state.add(winner, [added])
    return True


def _refit_replaced(
    state: SearchState, winner: ValidatedHypothesis, tried: Sequence[EffectLocation]
) -> list[tuple[Score, ValidatedHypothesis]]:
    """Candidates in whose place the winner may stand, refitted without it, if something is unexplained."""
    if not is_unexplained(state.horizons, winner):
        return []
    before = tuple(t.listed for t in state.score_tests(state.origin))
    after = tuple(t.listed for t in state.score_tests(winner))
    assert winner.location
    locations = replaced_by(winner.location, before, after, tried)
    if not locations:
        return []
    state.say("refitting effects that are similar to it: " + ", ".join(map(str, locations)))
    beside, scores, *starts = Promising.at(state.origin, before, locations)
    more = refit_and_validate(state, beside, *starts)
    for candidate in more:
        state.say("  " + describe(candidate, state.current))
    known = {x.location: x for x in scores}
    return [(known[c.location], c) for c in more if c.location]


def add_pair(state: SearchState, rounds: int) -> bool:
    """Add two effects that are needed together, if something is unexplained; False if no pair passes.

    Pairs are added to the current model only, not to the nominal one.

    Args:
        state: The search with what it has found so far.
        rounds: Largest number of effects that the search may add.
    """
    if len(state.scores) + 2 > rounds:
        return False
    if not is_unexplained(state.horizons, state.current):
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
            AddedEffect(p, nats.get(p, math.nan), tuple(pair.rivals[p]), horizon_gains(pair.found, less))
            for p, less in pair.members.items()
        ],
    )
    return True
