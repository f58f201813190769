"""The loop: compare, locate, propose, add, watch the held-out error fall, stop when nothing is missing."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from rotflex_jax.discover.decide import (
    TRAIN_NATS,
    Away,
    Trial,
    choose,
    describe,
    held_out,
    samples_of,
    told_apart,
)
from rotflex_jax.discover.lanes import Bench, Hypothesis
from rotflex_jax.discover.locate import locate
from rotflex_jax.discover.refit import Judge, refit
from rotflex_jax.discover.result import Discovery, Ranked, Round
from rotflex_jax.discover.scales import scales
from rotflex_jax.discover.score import Score, scores
from rotflex_jax.discover.stages import Scribe
from rotflex_jax.discover.supermodel import CALIBRATIONS, Place, SuperModel, build
from rotflex_jax.discover.verdict import judge_end
from rotflex_jax.discover.whiten import Whitener, log_likelihood
from rotflex_jax.effects import CATALOG, candidates as first_family
from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import first_states, sensor_noise, stack
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording

Progress = Callable[[str], None]

# Candidates that are refitted in a round, and rounds at most.
REFITTED, ROUNDS = 4, 4


def discover(
    mechanism: Mechanism | Model,
    train: Recording | Sequence[Recording],
    test: Recording | Sequence[Recording],
    *,
    candidates: Iterable[tuple[type[Effect], str]] | None = None,
    rounds: int = ROUNDS,
    window_seconds: float = 2.0,
    progress: Progress | None = None,
) -> Discovery:
    """Find the physical effects that a model lacks, and say how sure that is.

    The baseline is fitted as a predictor whose process noise the data choose; all candidate effects are
    scored at once by the slope of its innovations; the best are refitted; likelihood on held-out data
    decides, for one effect or for a set that the recordings cannot tell apart. Repeated until nothing is
    gained, then every effect must show that the model is worse without it.

    Args:
        mechanism: The user's model; its numbers are the start.
        train: Recordings to fit.
        test: Recordings that no fit sees; at most their own first state and offsets are adapted when
            likelihoods are compared, and only the first `n_init` samples for the errors reported.
        candidates: (effect class, port) pairs; the catalogue's first family if None.
        rounds: Most effects to add.
        window_seconds: Length of the windows of the short held-out runs [s].
        progress: Called with a line of text at each stage.

    Returns:
        Discovery.

    Raises:
        InputError: No recording, or channels that the model lacks.
    """
    began, say = time.perf_counter(), progress or (lambda _: None)
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    trained = (train,) if isinstance(train, Recording) else tuple(train)
    unseen = (test,) if isinstance(test, Recording) else tuple(test)
    if not model.mechanism.free_names:
        raise InputError("All parameters are trusted, but discovery fits the model; release one.")
    data = stack(trained, model)
    torque = torque_scale(model.mechanism, data)
    wanted = list(first_family() if candidates is None else candidates)
    supermodel = build(model.mechanism, wanted, scales(model, trained, torque))
    noise = sensor_noise((*trained, *unseen), model)
    ports = tuple(everywhere(model.mechanism, 1.0))
    # The super-model has friction contacts at every port, of which few are ever switched on.
    solver = (
        dataclasses.replace(model.solver, passes=2) if isinstance(model.solver, Exponential) else model.solver
    )
    judge = Judge(Bench(supermodel, solver, data), noise, torque, ports)
    away = Away(
        Judge(Bench(supermodel, solver, stack(unseen, model)), noise, torque, ports),
        unseen,
        first_states(model, unseen),
        window_seconds,
    )

    say("fitting the model as it is")
    now = _baseline(judge, supermodel, model, trained)
    base = held_out(away, now)
    ranking: list[Score] = []
    taken: list[tuple[Place, float]] = []
    passed = [base.hypothesis]
    equivalents: dict[Place, list[Place]] = {}
    samples = samples_of(data)
    for number in range(rounds):
        say(f"round {number + 1}: scoring {len(supermodel.candidates) - len(taken)} candidates")
        listed = scores(judge, base.hypothesis)
        ranking = ranking or listed
        promising = [s for s in listed if s.nats > 0][:REFITTED]
        if not promising:
            break
        say("refitting " + ", ".join(f"{s.place[0]} at {s.place[1]}" for s in promising))
        refitted = _refitted(judge, base.hypothesis, promising)
        trials = [
            dataclasses.replace(held_out(away, h), place=s.place, numbers=len(s.start))
            for h, s in zip(refitted, promising, strict=True)
            if _physical(judge, h, s.place)
        ]
        for t in trials:
            say("  " + describe(t, base, data))
        winner, rivals = choose(trials, base, data, noise)
        if winner is None or winner.place is None:
            break
        place = winner.place
        score = next(s.nats for s in promising if s.place == place)
        taken.append((place, score))
        equivalents[place] = [t.place for t in rivals if t.place]
        say(f"added {place[0]} at {place[1]}")
        base = dataclasses.replace(winner, place=None, numbers=0)
        passed.append(base.hypothesis)

    say("checking that each effect is needed")
    final, worth = _eliminated(judge, base.hypothesis, [p for p, _ in taken], samples)
    order = [p for p, _ in taken if p in final.places]
    order += sorted(set(final.places) - set(order), key=lambda p: -worth[p])
    order, own = _carried_over(away, held_out(away, final), order)
    kept = _still_rivals(judge, away, final, equivalents, [p for p in order if p in dict(taken)])
    say("simulating the held-out recordings")
    trials = [held_out(away, h) for h in _ladder(judge, final, order, own, passed)]
    scribe = Scribe(judge, away, model.solver)
    stages = [scribe.stage(t, order[:k]) for k, t in enumerate(trials)]
    steps = [
        Round(
            effect=place[0],
            port=place[1],
            equivalent=tuple(kept.get(place, [])),
            parameters=scribe.own_estimates(stage, place),
            stage=stage,
            score=dict(taken)[place] if place in dict(taken) else worth[place],
            held_out_gain_nats=stage.log_likelihood - before.log_likelihood,
            sentence=stage.model.mechanism.effect(*place).sentence(),
            equation=CATALOG[place[0]].equation,
        )
        for place, before, stage in zip(order, stages, stages[1:], strict=False)
    ]
    longest = max((*trained, *unseen), key=lambda r: r.N)
    residual = model.measured(longest) - stages[0].model.simulate_windows(longest, window_seconds)
    floor = dict(zip(model.mechanism.channels, noise.tolist(), strict=True))
    verdict, sentence = judge_end(steps, stages[-1], floor, ranking, unseen)
    return Discovery(
        verdict=verdict,
        sentence=sentence,
        train=trained,
        test=unseen,
        baseline=stages[0],
        rounds=tuple(steps),
        ranking=tuple(Ranked(*s.place, s.nats, s.excited, s.unconfounded, s.smallest) for s in ranking),
        where=locate(
            longest,
            residual,
            model.mechanism.channels,
            noise,
            model.mechanism,
            window_seconds=window_seconds,
        ),
        noise_floor=floor,
        elapsed_s=time.perf_counter() - began,
        notes=_notes(judge, away, trials[-1], own),
    )


def _baseline(judge: Judge, s: SuperModel, model: Model, trained: Sequence[Recording]) -> Hypothesis:
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


def _refitted(judge: Judge, base: Hypothesis, promising: list[Score]) -> list[Hypothesis]:
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


def _physical(judge: Judge, h: Hypothesis, place: Place) -> bool:
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


def _eliminated(
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
        weakest = min(surplus, key=lambda p: surplus[p])
        if surplus[weakest] >= 0:
            return h, worth
        h = rivals[on_trial.index(weakest)]
    return h, {}


def _still_rivals(
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
        start = Score(r, 0.0, np.array(c.probes[0]).max(axis=0), True, 1.0, 1.0)
        swapped.append(_with(judge, _without(judge, final, p), start, 0.4))
    best = held_out(away, final)
    trials = [held_out(away, h) for h in refit(judge, swapped)]
    same = {pr for pr, t in zip(pairs, trials, strict=True) if not told_apart(best, t, judge.bench.data)}
    return {p: [r for r in open_[p] if (p, r) in same] for p in found}


def _carried_over(away: Away, final: Trial, order: list[Place]) -> tuple[list[Place], list[Place]]:
    """Effects of the machine, and calibrations that belong to the training recordings alone.

    A calibration is one of the machine if its trained value makes the held-out free runs better.
    """
    kept, own = list(order), []
    for place in [p for p in order if p in CALIBRATIONS]:
        with_it, without = (
            away.windows(
                [
                    away.runner(_trained(final, away), places, r).simulate_windows(recording, away.seconds)
                    for r, recording in enumerate(away.recordings)
                ]
            )
            for places in (kept, [p for p in kept if p != place])
        )
        if float(np.mean(np.log(with_it / without))) >= 0:
            kept.remove(place)
            own.append(place)
    return kept, own


def _trained(trial: Trial, away: Away) -> Hypothesis:
    """The trained hypothesis shaped for the held-out recordings, calibrations as trained."""
    h = trial.hypothesis
    R = len(away.recordings)
    return dataclasses.replace(trial.adapted, own=np.tile(h.own.mean(axis=0), (R, 1)))


def _ladder(
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
    return [*(refit(judge, below, turns=1) if below else []), final]


def _notes(judge: Judge, away: Away, final: Trial, own: list[Place]) -> tuple[str, ...]:
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
