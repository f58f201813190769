"""The loop: compare, locate, propose, add, watch the held-out error fall, stop when nothing is missing."""

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from rotflex_jax.discover.calibrations import own_notes, settle
from rotflex_jax.discover.decide import choose, describe, on_equal_terms, samples_of
from rotflex_jax.discover.fine import refined
from rotflex_jax.discover.grow import is_physical, richer
from rotflex_jax.discover.heldout import Away, held_out
from rotflex_jax.discover.lanes import Bench
from rotflex_jax.discover.locate import locate
from rotflex_jax.discover.merge import merged
from rotflex_jax.discover.milestone import milestone
from rotflex_jax.discover.moves import (
    begin,
    eliminate,
    ladder,
    remaining_rivals,
    with_each,
)
from rotflex_jax.discover.proposal import with_proposal
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.result import Discovery, Ranked, Round
from rotflex_jax.discover.room import make_room
from rotflex_jax.discover.scales import scales
from rotflex_jax.discover.score import Score, promising, scores
from rotflex_jax.discover.stages import Scribe
from rotflex_jax.discover.supermodel import Place, build
from rotflex_jax.discover.verdict import judge_end
from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import first_states, roomy, sensor_noise, stack
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.threads import one_thread

Progress = Callable[[str], None]

# Candidates that are refitted in a round, and rounds at most.
REFITTED, ROUNDS = 4, 4


@one_thread
# A trial may diverge; its cost, which is then not finite, says so.
@np.errstate(over="ignore", invalid="ignore")
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
        candidates: (effect class, port) pairs; if None the catalogue's first family, at the places that
            answer to those of the flexible joint (`mechanism.roles`).
        rounds: Most effects to add.
        window_seconds: Length of the windows of the short held-out runs [s].
        progress: Called with a line of text at each stage.

    Returns:
        Discovery.

    Raises:
        InputError: No recording, channels that the model lacks, or one that moves against the model.
    """
    began, say = time.perf_counter(), progress or (lambda _: None)
    make_room()
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    trained = (train,) if isinstance(train, Recording) else tuple(train)
    unseen = (test,) if isinstance(test, Recording) else tuple(test)
    if not model.mechanism.free_names:
        raise InputError("All parameters are trusted, but discovery fits the model; release one.")
    check_signs(model, (*trained, *unseen))
    data = stack(trained, model, roomy(trained))
    torque = torque_scale(model.mechanism, data)
    wanted = list(search_places(model.mechanism) if candidates is None else candidates)
    supermodel = build(model.mechanism, wanted, scales(model, trained, torque))
    noise = sensor_noise((*trained, *unseen), model)
    ports = tuple(everywhere(model.mechanism, 1.0))
    # The super-model has friction contacts at every port, of which few are ever switched on.
    solver = (
        dataclasses.replace(model.solver, passes=2) if isinstance(model.solver, Exponential) else model.solver
    )
    judge = Judge(Bench(supermodel, solver, data), noise, torque, ports)
    # One length for both, where that makes no run on training data longer, is compiled for once.
    as_long = max(roomy(trained), roomy(unseen))
    away = Away(
        Judge(Bench(supermodel, solver, stack(unseen, model, as_long)), noise, torque, ports),
        unseen,
        first_states(model, unseen),
        window_seconds,
    )

    say("fitting the model as it is")
    now = begin(judge, supermodel, model, trained)
    base = held_out(away, now)
    channels = model.mechanism.channels
    own_units = {c: unseen[0].units[unseen[0].channels.index(c)] for c in channels}
    say(milestone("as it is", channels, own_units, base.windows, noise))
    ranking: list[Score] = []
    taken: list[tuple[Place, float]] = []
    passed = [base.hypothesis]
    equivalents: dict[Place, list[Place]] = {}
    samples = samples_of(data)
    for number in range(rounds):
        say(f"round {number + 1}: scoring {len(supermodel.candidates) - len(taken)} candidates")
        listed = scores(judge, base.hypothesis)
        ranking = ranking or listed
        chosen = promising(listed, REFITTED)
        chosen += [s for s in richer(judge, base.hypothesis) if s.place not in {c.place for c in chosen}]
        if not chosen:
            break
        say("refitting " + ", ".join(f"{s.place[0]} at {s.place[1]}" for s in chosen))
        grown = with_each(judge, base.hypothesis, chosen)
        trials = [
            dataclasses.replace(held_out(away, h, base), place=s.place, numbers=len(s.start))
            for h, s in zip(grown, chosen, strict=True)
            if is_physical(judge, h, s.place)
        ]
        trials = on_equal_terms(away, trials)
        for t in trials:
            say("  " + describe(t, base, data))
        winner, rivals = choose(trials, base, data, noise)
        if winner is None or winner.place is None:
            break
        place = winner.place
        score = next(s.nats for s in chosen if s.place == place)
        taken.append((place, score))
        equivalents[place] = [t.place for t in rivals if t.place]
        say(milestone(f"+ {place[0]} at {place[1]}", channels, own_units, winner.windows, noise))
        base = dataclasses.replace(winner, place=None, numbers=0)
        passed.append(base.hypothesis)

    say("checking that each effect is needed")
    final, worth = eliminate(judge, base.hypothesis, [p for p, _ in taken], samples)
    order = [p for p, _ in taken if p in final.places]
    order += sorted(set(final.places) - set(order), key=lambda p: -worth[p])
    final, order, own, left_out = settle(judge, away, final, order)
    came = dict(taken)
    kept = remaining_rivals(judge, away, final, equivalents, [p for p in order if p in came])
    if one := merged(judge, away, final, order):
        final, left_out, came = one.final, (*left_out, one.note), {**came, one.law: came[one.simpler]}
        order = [one.law if p == one.simpler else p for p in order if p not in one.gone[1:]]
        kept[one.law] = [*kept.get(one.simpler, []), *(one.gone if one.alike else ())]
    final = refined(judge, final)
    say("simulating the held-out recordings")
    trials = [held_out(away, h, base) for h in ladder(judge, final, order, own, passed)]
    scribe = Scribe(judge, away, model.solver)
    stages = [scribe.stage(t, order[:k]) for k, t in enumerate(trials)]
    steps = [
        Round(
            effect=place[0],
            port=place[1],
            equivalent=tuple(kept.get(place, [])),
            parameters=scribe.own_estimates(stage, place),
            stage=stage,
            score=came.get(place, worth.get(place, 0.0)),
            held_out_gain_nats=stage.log_likelihood - before.log_likelihood,
            sentence=stages[-1].model.mechanism.sentence(stages[-1].model.mechanism.effect(*place)),
            equation=stages[-1].model.mechanism.effect(*place).equation,
        )
        for place, before, stage in zip(order, stages, stages[1:], strict=False)
    ]
    longest = max((*trained, *unseen), key=lambda r: r.N)
    residual = model.measured(longest) - stages[0].model.simulate_windows(longest, window_seconds)
    floor = dict(zip(model.mechanism.channels, noise.tolist(), strict=True))
    verdict, sentence = judge_end(steps, stages[-1], floor, ranking, unseen)
    found = Discovery(
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
        notes=(*own_notes(judge, away, trials[-1], own), *left_out),
    )
    return with_proposal(found)
