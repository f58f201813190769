"""Numbers of a final model, freed from the error of the integration step they were fitted with."""

import dataclasses

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.lanes import Bench
from rotflex_jax.discover.refit import NATS, Judge, moved, whitened_sums
from rotflex_jax.effects.kinds import Actuation, Linear, Sensing
from rotflex_jax.mechanism import Exponential

# Steps in the place of one. Sixteen moved no estimate further by a third of its deviation.
FINER = 4
# Shares of a Gauss-Newton step that are tried side by side, and steps at most.
SHARES, TURNS = (1.0, 0.5, 0.2, 0.05), 3


def refined(judge: Judge, h: Hypothesis) -> Hypothesis:
    """The hypothesis after a Gauss-Newton step or two on the innovations of a finer integration.

        x <- x - (J'J)^-1 J'w

    with the slopes `J` of the search's own step and the whitened innovations `w` of one `FINER` times as
    short. Friction that builds up within a sample shifts an estimate by several of its deviations; where
    the motion is linear the step is exact and nothing moves.

    Args:
        judge: With the training recordings.
        h: At its optimum.
    """
    bench, seen = judge.bench, judge.bench.data.seen
    on = bench.supermodel.clean(h.values(bench).mean(axis=0), h.places).effects
    # Of a linear part the step is exact; voltages and readings are no matter of the step.
    exact = all(isinstance(e, Linear | Actuation | Sensing) for e in on)
    if exact or not isinstance(bench.solver, Exponential):
        return h
    finer = dataclasses.replace(bench.solver, substeps=FINER * bench.solver.substeps)
    fine = Bench(bench.supermodel, finer, bench.data)
    _, J = bench.slopes([h.lane(bench)], [h.directions(bench, max(judge.directions(), h.moved))])
    W = h.whitener(J[0, : h.moved], seen)
    best, w = h, h.whitener(fine.innovations([h.lane(bench)])[0], seen)
    for _ in range(TURNS):
        H, g = whitened_sums(h, w, W)
        size = np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = -np.linalg.lstsq(H / np.outer(size, size), g / size, rcond=1e-10)[0] / size
        # Where friction holds and lets go at other samples, the slopes promise too much.
        tried = [moved(best, share * step) for share in SHARES]
        ws = h.whitener(fine.innovations([t.lane(bench) for t in tried]), seen)
        costs = np.nan_to_num(0.5 * np.sum(ws**2, axis=(1, 2, 3)), nan=np.inf)
        k, gain = int(np.argmin(costs)), 0.5 * float(np.sum(w**2)) - float(np.min(costs))
        if gain > 0:
            best, w = tried[k], ws[k]
        if gain < NATS:
            break
    return h if best is h else judge.judged(best, bench.innovations([best.lane(bench)])[0])
