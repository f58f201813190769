"""What the search does with hypotheses: begin, add, remove, swap, and build up again."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.decide import TRAIN_NATS, TRAIN_Z, lead, told_apart
from rotflex_jax.discover.heldout import Away, held_out, in_blocks
from rotflex_jax.discover.hypothesis import Hypothesis, seat
from rotflex_jax.discover.refit import Judge, levenberg_marquardt, refit
from rotflex_jax.discover.score import Score
from rotflex_jax.discover.supermodel import CALIBRATIONS, Place, SuperModel
from rotflex_jax.discover.whiten import Whitener, log_likelihood
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.kinds import Memory
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


def with_each(judge: Judge, base: Hypothesis, promising: list[Score]) -> list[Hypothesis]:
    """The base with each candidate added and refitted, never likelier without than with it.

    First order overshoots where an effect is strongly nonlinear, so a refit starts at the likeliest of
    several shares of the amplitude; one that still ends below the base starts again from next to nothing.
    A law with memory takes the place of the simpler one that it contains: two of them in parallel would
    be a third law.
    """
    shapes = [
        (i, dataclasses.replace(s, start=x)) for i, s in enumerate(promising) for x in (s.start, *s.others)
    ]
    starts = [[_grown(judge, base, s, share) for share in SHARES] for _, s in shapes]
    likely = likelihoods(judge, [h for row in starts for h in row]).reshape(len(starts), -1)
    likeliest = [row[int(np.argmax(ll))] for row, ll in zip(starts, likely, strict=True)]
    chosen, last = _best_shapes(judge, [i for i, _ in shapes], likeliest), {}
    for (i, _), row in zip(shapes, starts, strict=True):
        last.setdefault(i, row[-1])
    refitted = refit(judge, chosen)
    worse = [i for i, h in enumerate(refitted) if h.log_likelihood < base.log_likelihood]
    if worse:
        again = refit(judge, [last[i] for i in worse])
        for i, h in zip(worse, again, strict=True):
            refitted[i] = h if h.log_likelihood > base.log_likelihood else last[i]
    return refitted


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
    seen = judge.bench.data.seen
    return np.array([log_likelihood(e, seen, judge.noise) if np.all(np.isfinite(e)) else -np.inf for e in es])


def _grown(judge: Judge, h: Hypothesis, score: Score, share: float) -> Hypothesis:
    """The hypothesis with one more effect, or with it in the place of simpler ones that it contains."""
    s, (name, port) = judge.bench.supermodel, score.place
    simpler = [(c, port) for c in CATALOG[name].contains if (c, port) in h.places]
    if not simpler or not issubclass(CATALOG[name], Memory):
        return _with(judge, h, score, share)
    values, known = h.values(judge.bench).mean(axis=0), {}
    for place in simpler:
        names = [s.mechanism.parameter_names[i].rpartition(".")[2] for i in s.parameter_indices(place)]
        known |= dict(zip(names, values[s.parameter_indices(place)], strict=True))
        h = without(judge, h, place)
    start = score.start.copy()
    for k, i in enumerate(s.candidates[score.place].parameters):
        parameter = s.mechanism.parameter_names[i].rpartition(".")[2]
        if parameter in known:
            # What the simpler law has already keeps its size; the share is for the rest.
            amplitude = s.candidates[score.place].amplitudes[k]
            start[k] = known[parameter] / (share if amplitude else 1.0)
    return _with(judge, h, dataclasses.replace(score, start=start), share)


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
    places = (*h.places, score.place)
    return dataclasses.replace(
        h, places=places, free=(*h.free, *c.parameters), z=z, x0=h.seated(judge.bench, places)
    )


def is_physical(judge: Judge, h: Hypothesis, place: Place) -> bool:
    """Whether the effect's numbers lie in their physical range."""
    s = judge.bench.supermodel
    values = h.values(judge.bench).mean(axis=0)
    specs = s.mechanism.parameter_specifications
    return all(specs[i].physical[0] <= values[i] <= specs[i].physical[1] for i in s.parameter_indices(place))


def without(judge: Judge, h: Hypothesis, place: Place) -> Hypothesis:
    """The hypothesis less one effect, its other numbers as they are."""
    s = judge.bench.supermodel
    gone = set(s.parameter_indices(place))
    kept = [k for k, i in enumerate(h.local) if i not in gone]
    places = tuple(p for p in h.places if p != place)
    return dataclasses.replace(
        h,
        places=places,
        x0=h.seated(judge.bench, places),
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
        rivals = refit(judge, [without(judge, h, p) for p in on_trial], turns=1)
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
        swapped.append(_with(judge, without(judge, final, p), start, 0.4))
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
            h = without(judge, h, place)
        below.append(h)
    return [*(refit(judge, below, wide=True, turns=2) if below else []), final]
