"""Held-out likelihood decides, and it may decide for a set.

Two candidates whose held-out log-likelihoods differ by less than their scatter over half-second blocks
are reported together; a richer effect must beat the simpler one that it contains beyond doubt.
"""

import dataclasses

import numpy as np

from rotflex_jax.discover.lanes import Bench, Hypothesis
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.residuals import Data

BLOCK_SECONDS = 0.5
# An effect must gain this on held-out data [nat], beyond this many deviations of the block gains, and
# this on the training data after half a log N per number that it needs.
HELD_OUT_NATS, HELD_OUT_Z, TRAIN_NATS = 5.0, 1.5, 8.0
# Two effects are told apart by this many deviations of their paired block differences.
SEPARATE_Z = 2.0


@dataclasses.dataclass(frozen=True)
class Trial:
    """A refitted hypothesis on data it never saw.

    Attributes:
        hypothesis: Fitted to the training recordings.
        blocks: Held-out log-likelihood of each half second [nat].
        place: What it adds to the hypothesis it is compared with.
        numbers: How many numbers that takes.
    """

    hypothesis: Hypothesis
    blocks: np.ndarray
    place: Place | None = None
    numbers: int = 0

    @property
    def held_out(self) -> float:
        """Held-out log-likelihood [nat]."""
        return float(np.sum(self.blocks))


def lead(a: Trial, b: Trial) -> tuple[float, float]:
    """By how many nats `a` leads `b` on held-out data, and how many deviations that is."""
    d = a.blocks - b.blocks
    spread = float(np.std(d, ddof=1)) * np.sqrt(len(d)) if len(d) > 1 else np.inf
    return float(d.sum()), float(d.sum()) / max(spread, 1e-12)


def held_out(judge: Judge, h: Hypothesis, first: np.ndarray) -> Trial:
    """Log-likelihood of held-out recordings under a trained hypothesis, in blocks.

    Physics, process noise and whitener are the trained ones. What belongs to one recording alone (first
    state, calibrations) is fitted to it, by Gauss-Newton with secant slopes.

    Args:
        judge: With the held-out recordings on its bench.
        h: Trained hypothesis.
        first: First states to begin with (R, m).
    """
    bench, R = judge.bench, len(first)
    own = np.tile(h.own.mean(axis=0), (R, 1))
    now = dataclasses.replace(h, x0=first.copy(), own=own)
    now = judge.with_process_noise(now, h.process_noise)
    e = bench.innovations([now.lane(bench)])[0]
    for _ in range(10):
        gained, now, e = _settle(bench, now, e)
        if gained < 0.05:
            break
    return Trial(h, _blocks(h.whitener.log_densities(e, bench.data.seen), bench.data))


def _settle(bench: Bench, h: Hypothesis, e: np.ndarray) -> tuple[float, Hypothesis, np.ndarray]:
    """One Gauss-Newton step of what belongs to each recording alone, shortened until it helps.

    Returns:
        Nats gained, the hypothesis after the step, its innovations (R, N, C).
    """
    seen, reach, local = bench.data.seen, 1e-6, len(h.local)
    nudged = bench.innovations([v.lane(bench) for v in _nudged(h, reach)])
    w = h.whitener(e, seen)
    slopes = (h.whitener(nudged, seen) - w[None]) / reach
    steps = []
    for r in range(len(w)):
        J = slopes[:, r].reshape(len(slopes), -1)
        norm = np.maximum(np.linalg.norm(J, axis=1), 1e-300)
        steps.append(np.linalg.lstsq((J / norm[:, None]).T, -w[r].ravel(), rcond=1e-8)[0] / norm)
    step = np.array(steps)
    lengths = (1.0, 0.5, 0.2, 0.05, 0.01, 0.002)
    moved = [
        dataclasses.replace(h, own=h.own + k * step[:, :local], x0=h.x0 + k * step[:, local:])
        for k in lengths
    ]
    tried = bench.innovations([m.lane(bench) for m in moved])
    costs = np.nan_to_num(0.5 * np.sum(h.whitener(tried, seen) ** 2, axis=(1, 2, 3)), nan=np.inf)
    best, before = int(np.argmin(costs)), 0.5 * float(np.sum(w**2))
    if not costs[best] < before:
        return 0.0, h, e
    return before - float(costs[best]), moved[best], tried[best]


def _nudged(h: Hypothesis, reach: float) -> list[Hypothesis]:
    """The hypothesis with each number of its own moved a little in every recording."""
    out = []
    for k in range(len(h.local)):
        own = h.own.copy()
        own[:, k] += reach
        out.append(dataclasses.replace(h, own=own))
    for k in range(h.x0.shape[1]):
        x0 = h.x0.copy()
        x0[:, k] += reach
        out.append(dataclasses.replace(h, x0=x0))
    return out


def _blocks(density: np.ndarray, data: Data) -> np.ndarray:
    """Sums over blocks; the last, shorter block of each recording joins its neighbour."""
    out = []
    for row, seen, Ts in zip(density, data.seen, data.Ts, strict=True):
        N = int(seen.sum())
        width = max(round(BLOCK_SECONDS / float(Ts)), 1)
        edges = np.arange(0, max(N - width, 0) + 1, width)
        out.append(np.add.reduceat(row[:N], edges))
    return np.concatenate(out)


def describe(trial: Trial, base: Trial) -> str:
    """One line: what a trial gained."""
    assert trial.place
    nats, z = lead(trial, base)
    train = trial.hypothesis.log_likelihood - base.hypothesis.log_likelihood
    where = f"{trial.place[0]} at {trial.place[1]}"
    return f"{where}: {nats:.0f} nats on held-out data (z {z:.1f}), {train:.0f} on training data"


def admissible(trial: Trial, base: Trial, samples: float) -> bool:
    """Whether what the trial adds is there beyond doubt."""
    nats, z = lead(trial, base)
    train = trial.hypothesis.log_likelihood - base.hypothesis.log_likelihood
    needed = TRAIN_NATS + 0.5 * trial.numbers * np.log(samples)
    return nats > HELD_OUT_NATS and z > HELD_OUT_Z and train > needed


def choose(trials: list[Trial], base: Trial, samples: float) -> tuple[Trial | None, list[Trial]]:
    """The best admissible trial and those that cannot be told from it."""
    open_ = [t for t in trials if admissible(t, base, samples)]
    if not open_:
        return None, []
    winner = max(open_, key=lambda t: t.held_out)
    simpler = [t for t in open_ if _contained(t, winner) and not _clearly(winner, t, base)]
    if simpler:
        winner = max(simpler, key=lambda t: t.held_out)
    rivals = [t for t in open_ if t is not winner and not _contained(winner, t) and not _contained(t, winner)]
    return winner, [t for t in rivals if lead(winner, t)[1] < SEPARATE_Z]


def _contained(small: Trial, large: Trial) -> bool:
    """Whether `large` has the effect of `small` as a special case."""
    assert small.place and large.place
    return small.place[1] == large.place[1] and small.place[0] in CATALOG[large.place[0]].contains


def _clearly(rich: Trial, simple: Trial, base: Trial) -> bool:
    """Whether the richer effect earns its extra numbers on held-out and on training data."""
    nats, z = lead(rich, simple)
    train = rich.hypothesis.log_likelihood - simple.hypothesis.log_likelihood
    share = nats / max(lead(rich, base)[0], 1e-9)
    return nats > 10 and z > 2.5 and train > 20 and share > 0.003


def samples_of(bench: Bench) -> float:
    """Numbers measured."""
    return float(np.sum(bench.data.seen)) * bench.data.y.shape[-1]
