"""What the search does with hypotheses: begin, add, remove, swap, and build up again."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.decide import TRAIN_NATS, TRAIN_Z, lead, told_apart
from rotflex_jax.discover.grow import grown, in_place_of, with_effect, without
from rotflex_jax.discover.heldout import Away, held_out, in_blocks
from rotflex_jax.discover.hypothesis import Hypothesis, seat
from rotflex_jax.discover.refit import Judge, levenberg_marquardt, refit
from rotflex_jax.discover.score import Score
from rotflex_jax.discover.supermodel import Place, SuperModel
from rotflex_jax.discover.whiten import Whitener
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.residuals import first_states
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


def begin(judge: Judge, s: SuperModel, model: Model, trained: Sequence[Recording]) -> Hypothesis:
    """The user's model with calibrations, fitted from a short, a middle and an endless horizon."""
    R, C = len(trained), len(s.mechanism.channels)
    z = s.transform.unconstrain(s.mechanism.values)
    for i in s.local:
        z[i] = 0.0
    start = Hypothesis(
        places=s.calibrations,
        free=tuple(s.baseline_free),
        local=tuple(s.local),
        z=z,
        own=np.zeros((R, len(s.local))),
        x0=seat(judge.bench, s.calibrations, first_states(model, trained)),
        K=np.zeros((0,)),
        process_noise={},
        whitener=Whitener(np.eye(1, 1).repeat(C, 0), np.diag(1 / judge.noise)),
    )
    least, most = judge.horizon
    intensities = (most, np.sqrt(least * most), least)
    # A distant start is safe only with a short horizon: all paths begin with one.
    near = judge.with_process_noise(start, dict.fromkeys(judge.ports, 100 * most))
    near = refit(judge, [near], turns=0)[0]
    paths = [judge.with_process_noise(near, dict.fromkeys(judge.ports, q)) for q in intensities]
    paths = refit(judge, paths, wide=True)
    return max(paths, key=lambda h: h.log_likelihood)


# Shares of the amplitude that the score test asks for at which a refit may start.
SHARES = (1.0, 0.4, 0.1, 0.02)
# A refit that gains less than this share of what the score test promised is stuck.
STUCK = 0.5


def with_each(judge: Judge, base: Hypothesis, promising: list[Score]) -> list[Hypothesis]:
    """The base with each candidate added and refitted.

    First order overshoots where an effect is strongly nonlinear, so a refit starts at the likeliest of
    several shares of the amplitude, and at the shape that a few steps take farthest. One that ends far
    below what the score test promised starts again from next to nothing of every shape. A law with memory
    takes the place of the simpler one that it contains: two of them in parallel would be a third law.
    """
    shapes = [
        (i, dataclasses.replace(s, start=x)) for i, s in enumerate(promising) for x in (s.start, *s.others)
    ]
    starts = [[grown(judge, base, s, share) for share in SHARES] for _, s in shapes]
    likely = likelihoods(judge, [h for row in starts for h in row]).reshape(len(starts), -1)
    likeliest = [row[int(np.argmax(ll))] for row, ll in zip(starts, likely, strict=True)]
    refitted = refit(judge, _best_shapes(judge, [i for i, _ in shapes], likeliest))
    gains = [h.log_likelihood - base.log_likelihood for h in refitted]
    stuck = {i for i, gain in enumerate(gains) if gain < STUCK * max(promising[i].gain, 0.0)}
    again = [(i, row[-1]) for (i, _), row in zip(shapes, starts, strict=True) if i in stuck]
    refitted = _begun_again(judge, refitted, again)
    # A law that contains another one is never worse: where a refit says so, it starts again from there.
    below = [
        (i, in_place_of(judge, refitted[j], [t.place], s, SHARES[-1]))
        for i, s in enumerate(promising)
        for j, t in enumerate(promising)
        if s.place[1] == t.place[1]
        and t.place[0] in CATALOG[s.place[0]].contains
        and refitted[i].log_likelihood < refitted[j].log_likelihood
    ]
    return _begun_again(judge, refitted, below)


def _begun_again(
    judge: Judge, refitted: list[Hypothesis], starts: list[tuple[int, Hypothesis]]
) -> list[Hypothesis]:
    """Refits, some from other starts (number of the candidate, start) too, and the likelier one kept."""
    best = list(refitted)
    fitted = refit(judge, [h for _, h in starts]) if starts else []
    for (i, _), h in zip(starts, fitted, strict=True):
        best[i] = max(best[i], h, key=lambda x: x.log_likelihood)
    return best


def _best_shapes(judge: Judge, of: list[int], starts: list[Hypothesis]) -> list[Hypothesis]:
    """For each candidate (`of` says whose a start is) the start that a short fit takes farthest."""
    several = [k for k, i in enumerate(of) if of.count(i) > 1]
    now = list(starts)
    if several:
        fitted = levenberg_marquardt(judge, [now[k] for k in several], steps=4)
        for k, h in zip(several, fitted, strict=True):
            now[k] = h
    best = {}
    for i, h in zip(of, now, strict=True):
        if i not in best or h.log_likelihood > best[i].log_likelihood:
            best[i] = h
    return [best[i] for i in sorted(best)]


def likelihoods(judge: Judge, hypotheses: list[Hypothesis]) -> np.ndarray:
    """Log-likelihoods of hypotheses as they are [nat], whitened anew; minus infinity where a run diverges."""
    es = judge.bench.innovations([h.lane(judge.bench) for h in hypotheses])
    return np.array([judge.likelihood(e) for e in es])


def eliminate(
    judge: Judge, h: Hypothesis, added: list[Place], samples: float
) -> tuple[Hypothesis, dict[Place, float]]:
    """Drop, one at a time, what the model does as well without.

    The effect added last has just shown that it is needed; earlier ones may have become needless, and
    calibrations have shown nothing yet.

    Returns:
        The model with what is needed, and what each effect on trial is worth [nat].
    """
    s = judge.bench.supermodel
    while on_trial := [p for p in h.places if p not in added[-1:]]:
        rivals = refit(judge, [without(judge, h, p) for p in on_trial], turns=1)
        worth = {p: h.log_likelihood - r.log_likelihood for p, r in zip(on_trial, rivals, strict=True)}
        each = {p: len(s.parameter_indices(p)) * (len(h.x0) if p in s.calibrations else 1) for p in worth}
        surplus = {p: worth[p] - TRAIN_NATS - 0.5 * each[p] * np.log(samples) for p in worth}
        for p, r in zip(on_trial, rivals, strict=True):
            if p in s.calibrations:
                continue
            # What a few moments of the recording want, the recording does not.
            if lead(*(in_blocks(x.densities, judge.bench.data) for x in (h, r)))[1] < TRAIN_Z:
                surplus[p] = min(surplus[p], -1.0)
        weakest = min(surplus, key=lambda p: surplus[p])
        if surplus[weakest] >= 0:
            return h, worth
        h = rivals[on_trial.index(weakest)]
    return h, {}


def remaining_rivals(
    judge: Judge,
    away: Away,
    final: Hypothesis,
    rivals: dict[Place, list[Place]],
    found: list[Place],
) -> dict[Place, list[Place]]:
    """Rivals that the final model, with one of them in the place of a found effect, cannot exclude.

    What looked alike in a round may be told apart once the other effects are in the model; a rival that
    was itself found in another round is no rival.
    """
    s = judge.bench.supermodel
    open_ = {p: [r for r in rivals[p] if r not in found] for p in found}
    pairs = [(p, r) for p in found for r in open_[p]]
    if not pairs or len(found) == 1:
        return open_
    swapped = []
    for p, r in pairs:
        c = s.candidates[r]
        start = Score(r, 0.0, 0.0, np.array(c.probes[0]).max(axis=0), True, 1.0, 1.0)
        swapped.append(with_effect(judge, without(judge, final, p), start, 0.4))
    best = held_out(away, final)
    trials = [held_out(away, h) for h in refit(judge, swapped)]
    same = {pr for pr, t in zip(pairs, trials, strict=True) if not told_apart(best, t, judge.bench.data)}
    return {p: [r for r in open_[p] if (p, r) in same] for p in found}


def ladder(
    judge: Judge,
    final: Hypothesis,
    order: list[Place],
    own: list[Place],
    passed: list[Hypothesis],
) -> list[Hypothesis]:
    """The baseline alone, then with one more effect at a time, each refitted; the final model last.

    A rung that the search has been on, calibrations apart, starts from there. Calibrations that belong
    to recordings (`own`) are on every rung.
    """
    below, calibrations = [], set(judge.bench.supermodel.calibrations)
    for k in range(len(order)):
        wanted = {*order[:k], *own}
        known = [h for h in passed if wanted - calibrations == set(h.places) - calibrations]
        h = known[0] if known and wanted <= set(known[0].places) else final
        for place in set(h.places) - wanted:
            h = without(judge, h, place)
        below.append(h)
    return [*(refit(judge, below, wide=True, turns=2) if below else []), final]
