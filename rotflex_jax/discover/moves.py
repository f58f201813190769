"""What the search does with hypotheses: begin, add, remove, swap, and build up again."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.decide import TRAIN_NATS, TRAIN_Z, lead, told_apart
from rotflex_jax.discover.heldout import Away, held_out, in_blocks
from rotflex_jax.discover.lanes import Hypothesis
from rotflex_jax.discover.refit import Judge, refit
from rotflex_jax.discover.score import Score
from rotflex_jax.discover.supermodel import CALIBRATIONS, Place, SuperModel
from rotflex_jax.discover.whiten import Whitener, log_likelihood
from rotflex_jax.fit.residuals import first_states
from rotflex_jax.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording


def begin(judge: Judge, s: SuperModel, model: Model, trained: Sequence[Recording]) -> Hypothesis:
    """The user's model with calibrations, fitted from a short, a middle and an endless horizon."""
    R, C = len(trained), len(s.mechanism.channels)
    specs = s.mechanism.parameter_specifications
    z = Transform.of(specs).unconstrain(s.mechanism.values)
    for i in s.local:
        z[i] = 0.0
    start = Hypothesis(
        places=s.calibrations,
        free=tuple(s.baseline_free),
        local=tuple(s.local),
        z=z,
        own=np.zeros((R, len(s.local))),
        x0=first_states(model, trained),
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


def with_each(judge: Judge, base: Hypothesis, promising: list[Score]) -> list[Hypothesis]:
    """The base with each candidate added and refitted, never likelier without than with it.

    First order overshoots where an effect is strongly nonlinear, so a refit starts at the likeliest of
    several shares of the amplitude; one that still ends below the base starts again from next to nothing.
    """
    starts = [[_with(judge, base, s, share) for share in SHARES] for s in promising]
    lanes = [h.lane(judge.bench) for row in starts for h in row]
    es = judge.bench.innovations(lanes).reshape(len(starts), len(SHARES), *judge.bench.data.y.shape)
    seen = judge.bench.data.seen
    likely = [
        [log_likelihood(e, seen, judge.noise) if np.all(np.isfinite(e)) else -np.inf for e in row]
        for row in es
    ]
    chosen = [row[int(np.argmax(ll))] for row, ll in zip(starts, likely, strict=True)]
    refitted = refit(judge, chosen)
    worse = [i for i, h in enumerate(refitted) if h.log_likelihood < base.log_likelihood]
    if worse:
        again = refit(judge, [starts[i][-1] for i in worse])
        for i, h in zip(worse, again, strict=True):
            refitted[i] = h if h.log_likelihood > base.log_likelihood else starts[i][-1]
    return refitted


def _with(judge: Judge, h: Hypothesis, score: Score, share: float) -> Hypothesis:
    """The hypothesis with one more effect, at a share of the amplitude that the score test points to."""
    s = judge.bench.supermodel
    c = s.candidates[score.place]
    specs = [s.mechanism.parameter_specifications[i] for i in c.parameters]
    size = np.abs(np.array(c.probes[0])).max(axis=0)
    start = np.where(c.amplitudes, share * score.start, score.start)
    for k, spec in enumerate(specs):
        # A bound at zero is the end of a logarithm: begin a little inside.
        if np.isfinite(spec.lower):
            start[k] = max(start[k], spec.lower + 0.05 * share * max(size[k], 1e-12))
    z = h.z.copy()
    z[list(c.parameters)] = Transform.of(specs).unconstrain(start)
    return dataclasses.replace(h, places=(*h.places, score.place), free=(*h.free, *c.parameters), z=z)


def is_physical(judge: Judge, h: Hypothesis, place: Place) -> bool:
    """Whether the effect's numbers lie in their physical range."""
    s = judge.bench.supermodel
    values = h.values(judge.bench).mean(axis=0)
    specs = s.mechanism.parameter_specifications
    return all(specs[i].physical[0] <= values[i] <= specs[i].physical[1] for i in s.parameter_indices(place))


def _without(judge: Judge, h: Hypothesis, place: Place) -> Hypothesis:
    s = judge.bench.supermodel
    gone = set(s.parameter_indices(place))
    kept = [k for k, i in enumerate(h.local) if i not in gone]
    return dataclasses.replace(
        h,
        places=tuple(p for p in h.places if p != place),
        free=tuple(i for i in h.free if i not in gone),
        local=tuple(h.local[k] for k in kept),
        own=h.own[:, kept],
    )


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
        rivals = refit(judge, [_without(judge, h, p) for p in on_trial], turns=1)
        worth = {p: h.log_likelihood - r.log_likelihood for p, r in zip(on_trial, rivals, strict=True)}
        each = {p: len(s.parameter_indices(p)) * (len(h.x0) if p in CALIBRATIONS else 1) for p in worth}
        surplus = {p: worth[p] - TRAIN_NATS - 0.5 * each[p] * np.log(samples) for p in worth}
        for p, r in zip(on_trial, rivals, strict=True):
            if p in CALIBRATIONS:
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
        swapped.append(_with(judge, _without(judge, final, p), start, 0.4))
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
    below = []
    for k in range(len(order)):
        wanted = {*order[:k], *own}
        known = [h for h in passed if wanted - set(CALIBRATIONS) == set(h.places) - set(CALIBRATIONS)]
        h = known[0] if known and wanted <= set(known[0].places) else final
        for place in set(h.places) - wanted:
            h = _without(judge, h, place)
        below.append(h)
    return [*(refit(judge, below, wide=True, turns=2) if below else []), final]
