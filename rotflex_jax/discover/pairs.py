"""Pairs of effects that are added together where a search of single effects stops unexplained.

Two effects may hide each other: alone, each is refused, since it explains less than the errors that the lack
of the other one causes. The score test gives, without a run, what two candidates would gain together. The
best few pairs are refitted at both horizons, and validation data decide by the rules for single effects. A
pair must pass these rules compared with the current model and with each of its members alone.

The score test is of first order, and its slopes say little about dry friction in a poor model. So one more
pair is refitted: the effect that, refitted alone, gained most in predictions, and the one that gained most in
free runs. Each may have been refused because of errors that the other one explains.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import (
    CandidateStart,
    Hypothesis,
    parameter_count,
    with_candidate,
)
from rotflex_jax.discover.likelihood import LikelihoodProblem, process_noise_gain, refit
from rotflex_jax.discover.score_test import PairScore, PairStart, ScoreTest
from rotflex_jax.discover.selection import (
    TRAIN_NATS,
    admissible,
    best_window_rmse,
    distinguished,
    gains_in_words,
    likelier_of_each,
    predictions_apart,
    shares_at_each,
    shares_of_gain,
)
from rotflex_jax.discover.stepwise import START_SHARES, refit_near_predictions, refit_without
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.discover.validation import Horizons, ValidatedHypothesis, validate
from rotflex_jax.discover.verdict import NEAR_FLOOR, TORQUE_NATS
from rotflex_jax.effects import CATALOG
from rotflex_jax.runtime.xla import on_threads

# Number of candidates of which pairs are scored; number of pairs that are refitted for their score, and for
# the gain beyond the scores of their members.
PAIRED, BEST_PAIRS, SYNERGETIC_PAIRS = 10, 2, 1

Pair = tuple[EffectLocation, EffectLocation]


def is_unexplained(horizons: Horizons, current: ValidatedHypothesis) -> bool:
    """Whether short free runs are above the noise, or process noise still improves predictions."""
    problem = horizons.prediction.problem
    if bool(np.any(best_window_rmse(current) > NEAR_FLOOR * problem.noise)):
        return True
    return not process_noise_gain(problem, current.hypothesis) <= TORQUE_NATS  # so too if it is not finite


def best_candidates(prediction: ScoreTest, free_run: ScoreTest, most: int) -> list[EffectLocation]:
    """Candidates with the largest first-order gains, as shares of the best one, summed over both horizons."""
    share: dict[EffectLocation, float] = {}
    for test in (prediction, free_run):
        gains = {s.location: s.start.expected_gain for s in test.listed}
        best = max(gains.values(), default=0.0)
        for p, gain in gains.items():
            share[p] = share.get(p, 0.0) + (max(gain, 0.0) / best if best > 0 else 0.0)
    return sorted((p for p in share if share[p] > 0), key=lambda p: -share[p])[:most]


def promising_pairs(prediction: ScoreTest, free_run: ScoreTest) -> list[tuple[PairScore, PairScore]]:
    """Pairs worth a refit with their scores at both horizons, best first.

    At one horizon at least, the score of a pair must exceed the score of its better member by `TRAIN_NATS`.
    """
    chosen = best_candidates(prediction, free_run, PAIRED)
    tests = [{p.locations: p for p in test.pairs(chosen)} for test in (prediction, free_run)]
    common = [p for p in tests[0] if p in tests[1]]
    wanted = [p for p in common if any(t[p].nats > 0 and t[p].more > TRAIN_NATS for t in tests)]
    wanted = [p for p in wanted if not _is_a_simpler_one(p, tests)]
    if not wanted:
        return []

    def shares(value: Callable[[PairScore], float]) -> dict[Pair, float]:
        most = [max(max(value(t[p]) for p in wanted), 1e-9) for t in tests]
        return {p: sum(max(value(t[p]), 0.0) / m for t, m in zip(tests, most, strict=True)) for p in wanted}

    by_score, by_synergy = shares(lambda s: s.nats), shares(lambda s: s.synergy)
    best = sorted(wanted, key=lambda p: -by_score[p])[:BEST_PAIRS]
    together = [p for p in sorted(wanted, key=lambda p: -by_synergy[p]) if by_synergy[p] > 0]
    best += [p for p in together if p not in best][:SYNERGETIC_PAIRS]
    return [(tests[0][p], tests[1][p]) for p in best]


def best_refitted(
    s: SuperModel, current: ValidatedHypothesis, known: Sequence[ValidatedHypothesis]
) -> tuple[PairStart, PairStart] | None:
    """The two effects with the largest gains on validation data when each alone was added to a model.

    They are the effect with the largest gain in predictions and the one with the largest gain in free runs.
    If these are one effect, or laws of the same thing, the effect with the largest sum of both gains (as
    shares of the largest) is paired with the next one that is neither.

    Args:
        s: The super-model.
        current: The model.
        known: Models that were fitted and validated, among them models with one effect more.

    Returns:
        Where a refit of both effects starts, for predictions and for free runs; None if there is no such
        pair.
    """
    effects = s.without_calibrations
    now = effects(current.hypothesis.locations)
    one_more = [v for v in known if v.location and v.location not in now and v.free_run]
    one_more = [v for v in one_more if effects(v.hypothesis.locations) == now | {v.location}]
    alone = {v.location: v for v in likelier_of_each(one_more) if v.location}

    def ranked(shares: Float[np.ndarray, " K"]) -> list[EffectLocation]:
        share = dict(zip(alone, shares, strict=True))
        return sorted((p for p in alone if share[p] > 0), key=lambda p: -share[p])

    prediction, free_run = shares_at_each(list(alone.values()), current)
    leading = zip(ranked(prediction)[:1], ranked(free_run)[:1], strict=False)
    best = ranked(prediction + free_run)
    options = [(a, b) for a, b in (*leading, *((best[0], p) for p in best[1:])) if a != b]
    unlike = ((a, b) for a, b in options if b not in s.other_laws(a) and not a.is_related_to(b))
    pair = next(unlike, None)
    if pair is None:
        return None

    def start(fits: Sequence[Hypothesis]) -> PairStart:
        ends = zip(pair, fits, strict=True)
        a, b = (CandidateStart(p, h.mean_values(s)[s.parameter_indices(p)]) for p, h in ends)
        return PairStart((a, b), alone=tuple(fits))

    fits = [alone[p] for p in pair]
    return start([v.hypothesis for v in fits]), start([v.free_run.hypothesis for v in fits if v.free_run])


def _with_models(scored: PairStart, refitted: PairStart) -> PairStart:
    """The start of a pair from its score, with the models that have either effect, in the same order."""
    models = dict(zip(refitted.locations, refitted.alone, strict=True))
    return dataclasses.replace(scored, alone=tuple(models[p] for p in scored.locations))


def _is_a_simpler_one(pair: Pair, tests: Sequence[dict[Pair, PairScore]]) -> bool:
    """Whether a pair gains nothing over another pair with a simpler effect in the place of a richer one."""
    for rich, other in (pair, pair[::-1]):
        for name in CATALOG[rich.effect].contains:
            simple = EffectLocation(name, rich.port)
            known = [q for q in ((simple, other), (other, simple)) if all(q in t for t in tests)]
            if any(all(t[pair].gain < t[q].gain + 1.0 for t in tests) for q in known):
                return True
    return False


def refit_pairs(
    problem: LikelihoodProblem, current: Hypothesis, pairs: Sequence[PairStart]
) -> list[Hypothesis]:
    """The current model with each pair added and refitted, from the likeliest of several starts.

    Starts have several shares of the amplitudes. Both effects are added to the current model, or one of them
    to a model that already has the other one.
    """
    s, starts = problem.supermodel, []
    for pair in pairs:
        a, b = pair.starts
        grown = [with_candidate(s, with_candidate(s, current, a, x), b, x) for x in START_SHARES]
        for h, other in zip(pair.alone, (b, a), strict=False):
            grown += [with_candidate(s, h, other, x) for x in START_SHARES]
        starts.append(problem.likeliest(grown))
    return refit(problem, starts)


def validated_pairs(
    horizons: Horizons,
    beside: ValidatedHypothesis,
    pairs: Sequence[tuple[PairStart, PairStart]],
    is_plausible: Callable[[Hypothesis, EffectLocation], bool],
    grown: Sequence[Hypothesis] | None = None,
) -> dict[Pair, ValidatedHypothesis]:
    """A model with each pair, refitted and validated at both horizons; implausible fits are left out.

    Args:
        horizons: Training and validation recordings at both horizons.
        beside: The model to which pairs are added.
        pairs: Where the refits start, for predictions and for free runs.
        is_plausible: Whether an effect of a hypothesis is physical, and of a size that the recordings reach.
        grown: The models with the pairs, if they were refitted to predictions before.
    """
    problem, runs_problem = horizons.prediction.problem, horizons.free_run.problem
    assert beside.free_run
    if grown is None:
        grown = refit_pairs(problem, beside.hypothesis, [a for a, _ in pairs])
    runs = refit_pairs(runs_problem, beside.free_run.hypothesis, [b for _, b in pairs])
    runs = refit_near_predictions(runs_problem, runs, grown)
    plausible = [
        (h, f, start.locations)
        for h, f, (start, _) in zip(grown, runs, pairs, strict=True)
        if all(is_plausible(x, p) for x in (h, f) for p in start.locations if p in x.locations)
    ]
    found = horizons.all_validated([(h, f) for h, f, _ in plausible], beside)
    count = functools.partial(parameter_count, problem.supermodel)
    return {
        pair: dataclasses.replace(v, parameter_count=sum(count(h, p) for p in pair))
        for v, (h, _, pair) in zip(found, plausible, strict=True)
    }


def pairs_passed_by(
    horizons: Horizons,
    beside: ValidatedHypothesis,
    pairs: Sequence[tuple[PairScore, PairScore]],
    found: ValidatedHypothesis,
    is_plausible: Callable[[Hypothesis, EffectLocation], bool],
    say: Callable[[str], None],
    known: Sequence[ValidatedHypothesis] = (),
) -> tuple[list[ValidatedHypothesis], list[Pair]]:
    """Fit the best pairs of the start of a search that single steps have missed.

    Each step of a search adds the best single effect. It may miss two effects that explain the recordings
    only together, if another effect imitates a part of both. Pairs are fitted if the search has found two
    effects or more, but not both effects of the pair.

    Args:
        horizons: Training and validation recordings at both horizons.
        beside: The model at the start of the search.
        pairs: The best pairs for this model.
        found: The model at the end of the search.
        is_plausible: Whether an effect of a hypothesis is physical, and of a size that the recordings reach.
        say: Called with lines of progress.
        known: Models that were fitted before.

    Returns:
        Models that were fitted and validated at both horizons; and pairs that validation data prefer to the
        model found, or do not distinguish from it.
    """
    s = horizons.prediction.problem.supermodel
    effects = s.without_calibrations(found.hypothesis.locations)
    fitted = {s.without_calibrations(v.hypothesis.locations) for v in known}
    passed = (pair for pair in pairs if not effects >= set(pair[0].locations))
    others = [pair for pair in passed if frozenset(pair[0].locations) not in fitted]
    if len(effects) < 2 or not others:
        return [], []
    named = ", ".join(_named(a.locations) for a, _ in others)
    say(f"testing pairs of effects that single steps did not find: {named}")
    grown = refit_pairs(horizons.prediction.problem, beside.hypothesis, [a for a, _ in others])
    predictions = on_threads(lambda h: validate(horizons.prediction.validation, h, beside), grown)
    tried: dict[Pair, ValidatedHypothesis] = {}
    for h, v, scores in zip(grown, predictions, others, strict=True):
        pair = scores[0].locations
        if not predictions_apart(found, v):
            tried |= validated_pairs(horizons, beside, [scores], is_plausible, [h])
        # If predictions are clearly worse with the pair, it is not fitted to free runs. Then it has no
        # probability: where predictions count little, it would seem as good as the model found.
        elif all(is_plausible(h, p) for p in pair):
            tried[pair] = v
    _say_gains(tried, found, others, say)
    fitted_at_both = [v for v in tried.values() if v.free_run]
    return fitted_at_both, [p for p, v in tried.items() if not distinguished(found, v)]


def _say_gains(
    tried: dict[Pair, ValidatedHypothesis],
    over: ValidatedHypothesis,
    pairs: Sequence[tuple[PairStart, PairStart]],
    say: Callable[[str], None],
) -> None:
    """Report a line of progress for each refitted pair: its gains over a model, or that it is left out."""
    for pair in (start.locations for start, _ in pairs):
        if (v := tried.get(pair)) is not None:
            say(f"  {_named(pair)}: " + gains_in_words(v, over))
        else:
            say(f"  left out: {_named(pair)}, since its parameters are not plausible")


@dataclasses.dataclass(frozen=True)
class FoundPair:
    """Two effects that are needed together.

    Attributes:
        found: The model with both effects.
        members: Each effect -> the model without it.
        rivals: Each effect -> effects that are not distinguished from it in a pair with the other member.
    """

    found: ValidatedHypothesis
    members: dict[EffectLocation, ValidatedHypothesis]
    rivals: dict[EffectLocation, list[EffectLocation]]


def find_pair(
    horizons: Horizons,
    current: ValidatedHypothesis,
    tests: tuple[ScoreTest, ScoreTest],
    is_plausible: Callable[[Hypothesis, EffectLocation], bool],
    say: Callable[[str], None],
    known: Sequence[ValidatedHypothesis] = (),
) -> tuple[FoundPair | None, list[ValidatedHypothesis]]:
    """The best pair that passes all tests, or None; and all models that were fitted and validated.

    Args:
        horizons: Training and validation recordings at both horizons.
        current: The model so far.
        tests: Its score tests of predictions and of free runs.
        is_plausible: Whether an effect of a hypothesis is physical, and of a size that the recordings reach.
        say: Called with lines of progress.
        known: Models that were fitted and validated at both horizons before. The effects with the largest
            gains are taken from them, and models with one member of a pair that are among them are not fitted
            again.
    """
    s = horizons.prediction.problem.supermodel
    pairs: list[tuple[PairStart, PairStart]] = [*promising_pairs(*tests)]
    if best := best_refitted(s, current, known):
        places = set(best[0].locations)
        same = [p for p in pairs if set(p[0].locations) == places]
        pairs = [p for p in pairs if set(p[0].locations) != places]
        pairs += [(_with_models(a, best[0]), _with_models(b, best[1])) for a, b in same] or [best]
    if not pairs:
        return None, []
    say("looking one step further, refitting " + ", ".join(_named(a.locations) for a, _ in pairs))
    problem = horizons.prediction.problem
    measured, noise = problem.measured_values, problem.noise
    tried = validated_pairs(horizons, current, pairs, is_plausible)
    _say_gains(tried, current, pairs, say)
    able = {p: v for p, v in tried.items() if admissible(v, current, measured, noise)}
    everyone = list(tried.values())
    if not able:
        return None, everyone
    shares = dict(zip(able, shares_of_gain(list(able.values()), current), strict=True))
    fitted = {frozenset(v.hypothesis.locations): v for v in known if v.free_run}
    for pair in sorted(able, key=lambda p: -shares[p]):
        found, members = able[pair], {}
        for p in pair:
            left = frozenset(found.hypothesis.locations) - {p}
            if left not in fitted:
                fitted[left] = _without(horizons, found, p, current)
                everyone.append(fitted[left])
            less = fitted[left]
            count = parameter_count(s, found.hypothesis, p)
            if not admissible(dataclasses.replace(found, parameter_count=count), less, measured, noise):
                say(f"  {_named(pair)}: no better than without {p}")
                break
            members[p] = less
        if len(members) == len(pair):
            return FoundPair(found, members, _rivals(pair, able)), everyone
    return None, everyone


def _named(pair: Pair) -> str:
    return f"{pair[0]} with {pair[1]}"


def _without(
    horizons: Horizons, found: ValidatedHypothesis, location: EffectLocation, current: ValidatedHypothesis
) -> ValidatedHypothesis:
    """A model without one effect, refitted and validated at both horizons."""
    assert found.free_run
    at = (
        (horizons.prediction.problem, found.hypothesis),
        (horizons.free_run.problem, found.free_run.hypothesis),
    )
    prediction, runs = on_threads(lambda one: refit_without(*one, [location])[0], at)
    return horizons.validated(prediction, runs, current)


def _rivals(pair: Pair, able: dict[Pair, ValidatedHypothesis]) -> dict[EffectLocation, list[EffectLocation]]:
    """For each member, effects that replace it in another admissible pair that is not distinguished."""
    rivals: dict[EffectLocation, list[EffectLocation]] = {p: [] for p in pair}
    for other, v in able.items():
        mine, theirs = set(pair) - set(other), set(other) - set(pair)
        if len(mine) == 1 and not distinguished(able[pair], v):
            rivals[mine.pop()].append(theirs.pop())
    return rivals
