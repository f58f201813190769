"""Held-out likelihood decides, and it may decide for a set.

Two candidates whose held-out log-likelihoods differ by less than their scatter over half-second blocks
are reported together; a richer effect must beat the simpler one that it contains beyond doubt.
"""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax.discover.lanes import Bench, Hypothesis
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.residuals import Data
from rotflex_jax.model import Model, window_starts
from rotflex_jax.recording import Recording

BLOCK_SECONDS = 0.5
# An effect must gain this on held-out data [nat], beyond this many deviations of the block gains, and
# this on the training data after half a log N per number that it needs, beyond as many deviations.
HELD_OUT_NATS, HELD_OUT_Z, TRAIN_NATS, TRAIN_Z = 5.0, 1.5, 8.0, 2.0
# Mean log error of free runs over short windows: near the sensor noise it may rise by no more than the
# first, elsewhere it must fall by the second.
WINDOWS_WORSE, WINDOWS_BETTER = 0.02, 0.01
# Two effects are told apart by this many deviations of their paired block differences.
SEPARATE_Z = 2.0


@dataclasses.dataclass(frozen=True)
class Trial:
    """A refitted hypothesis on data it never saw.

    Attributes:
        hypothesis: Fitted to the training recordings.
        blocks: Held-out log-likelihood of each half second [nat].
        adapted: The same physics, with first states and calibrations of the held-out recordings.
        windows: Held-out error of short free runs, per channel.
        place: What it adds to the hypothesis it is compared with.
        numbers: How many numbers that takes.
    """

    hypothesis: Hypothesis
    blocks: np.ndarray
    adapted: Hypothesis
    windows: np.ndarray
    place: Place | None = None
    numbers: int = 0

    @property
    def held_out(self) -> float:
        """Held-out log-likelihood [nat]."""
        return float(np.sum(self.blocks))


def lead(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """By how many nats blocks `a` lead blocks `b`, and how many deviations that is."""
    d = a - b
    spread = float(np.std(d, ddof=1)) * np.sqrt(len(d)) if len(d) > 1 else np.inf
    return float(d.sum()), float(d.sum()) / max(spread, 1e-12)


@dataclasses.dataclass(frozen=True)
class Away:
    """The held-out side.

    Attributes:
        judge: With the held-out recordings on its bench.
        recordings: The same, as recordings.
        first: First states to begin with (R, m).
        seconds: Length of the windows of short free runs [s].
    """

    judge: Judge
    recordings: Sequence[Recording]
    first: np.ndarray
    seconds: float

    def runner(self, h: Hypothesis, places: Iterable[Place], recording: int) -> Model:
        """A model of one held-out recording; all share the super-model's compiled code, gates apart."""
        bench = self.judge.bench
        s = bench.supermodel
        mechanism = s.mechanism.with_values(h.values(bench)[recording])
        return Model(mechanism, bench.solver, tuple(s.gates(places)))

    def windows(self, runs: Sequence[np.ndarray]) -> np.ndarray:
        """Root mean square error per channel of short free runs, their first samples not counted."""
        data = self.judge.bench.data
        total, count = np.zeros(data.y.shape[-1]), 0
        for r, recording in enumerate(self.recordings):
            counts = np.ones(recording.N, bool)
            for start in window_starts(recording, self.seconds)[0]:
                counts[start : start + recording.n_init] = False
            e = (data.y[r, : recording.N] - runs[r])[counts]
            total, count = total + np.sum(e**2, axis=0), count + len(e)
        return np.sqrt(total / max(count, 1))


def held_out(away: Away, h: Hypothesis) -> Trial:
    """Log-likelihood of held-out recordings under a trained hypothesis, in blocks.

    Physics, process noise and whitener are the trained ones. What belongs to one recording alone (first
    state, calibrations) is fitted to it, by Gauss-Newton with secant slopes.

    Args:
        away: The held-out recordings.
        h: Trained hypothesis.
    """
    bench, R = away.judge.bench, len(away.first)
    own = np.tile(h.own.mean(axis=0), (R, 1))
    now = dataclasses.replace(h, x0=away.first.copy(), own=own)
    now = away.judge.with_process_noise(now, h.process_noise)
    e = bench.innovations([now.lane(bench)])[0]
    for _ in range(10):
        gained, now, e = _settle(bench, now, e)
        if gained < 0.05:
            break
    blocks = in_blocks(h.whitener.log_densities(e, bench.data.seen), bench.data)
    runs = [
        away.runner(now, h.places, r).simulate_windows(recording, away.seconds)
        for r, recording in enumerate(away.recordings)
    ]
    return Trial(h, blocks, now, away.windows(runs))


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


def in_blocks(density: np.ndarray, data: Data) -> np.ndarray:
    """Sums over blocks; the last, shorter block of each recording joins its neighbour."""
    out = []
    for row, seen, Ts in zip(density, data.seen, data.Ts, strict=True):
        N = int(seen.sum())
        width = max(round(BLOCK_SECONDS / float(Ts)), 1)
        edges = np.arange(0, max(N - width, 0) + 1, width)
        out.append(np.add.reduceat(row[:N], edges))
    return np.concatenate(out)


def describe(trial: Trial, base: Trial, data: Data) -> str:
    """One line: what a trial gained."""
    assert trial.place
    nats, z = lead(trial.blocks, base.blocks)
    train, train_z = _trained_lead(trial, base, data)
    gain = np.exp(-_change(trial, base))
    return (
        f"{trial.place[0]} at {trial.place[1]}: {nats:.0f} nats on held-out data (z {z:.1f}), {train:.0f} "
        f"on training data (z {train_z:.1f}), free runs {gain:.2f} times better"
    )


def _trained_lead(a: Trial, b: Trial, data: Data) -> tuple[float, float]:
    return lead(in_blocks(a.hypothesis.densities, data), in_blocks(b.hypothesis.densities, data))


def _change(trial: Trial, base: Trial) -> float:
    """Mean log ratio of the errors of short free runs; negative where the trial is better."""
    return float(np.mean(np.log(trial.windows / base.windows)))


def admissible(trial: Trial, base: Trial, data: Data, noise: np.ndarray) -> bool:
    """Whether what the trial adds is there beyond doubt.

    Args:
        trial: The richer hypothesis.
        base: Without what it adds.
        data: Training recordings.
        noise: Deviation of the sensor noise per channel.
    """
    nats, z = lead(trial.blocks, base.blocks)
    train, train_z = _trained_lead(trial, base, data)
    needed = TRAIN_NATS + 0.5 * trial.numbers * np.log(samples_of(data))
    # Likelihood speaks of the next samples, a user of free runs: neither may say no. Far from the sensor
    # noise, an effect that leaves free runs as they were is a way to bend, not a discovery.
    far = bool(np.any(base.windows > 2 * noise))
    limit = -WINDOWS_BETTER if far else WINDOWS_WORSE
    enough = nats > HELD_OUT_NATS and z > HELD_OUT_Z and train > needed and train_z > TRAIN_Z
    return enough and _change(trial, base) < limit


def choose(
    trials: list[Trial], base: Trial, data: Data, noise: np.ndarray
) -> tuple[Trial | None, list[Trial]]:
    """The best admissible trial and those that cannot be told from it; arguments as in `admissible`."""
    able = [t for t in trials if admissible(t, base, data, noise)]
    if not able:
        return None, []
    winner = max(able, key=lambda t: t.held_out)
    simpler = [t for t in able if _contained(t, winner) and not _clearly(winner, t, base)]
    if simpler:
        winner = max(simpler, key=lambda t: t.held_out)
    rivals = [t for t in able if t is not winner and not _contained(winner, t) and not _contained(t, winner)]
    return winner, [t for t in rivals if not told_apart(winner, t, data)]


def told_apart(winner: Trial, rival: Trial, data: Data) -> bool:
    """Whether all recordings together, block by block, prefer the winner beyond doubt."""
    a, b = (np.concatenate([t.blocks, in_blocks(t.hypothesis.densities, data)]) for t in (winner, rival))
    return lead(a, b)[1] >= SEPARATE_Z


def _contained(small: Trial, large: Trial) -> bool:
    """Whether `large` has the effect of `small` as a special case."""
    assert small.place and large.place
    return small.place[1] == large.place[1] and small.place[0] in CATALOG[large.place[0]].contains


def _clearly(rich: Trial, simple: Trial, base: Trial) -> bool:
    """Whether the richer effect earns its extra numbers on held-out and on training data."""
    nats, z = lead(rich.blocks, simple.blocks)
    train = rich.hypothesis.log_likelihood - simple.hypothesis.log_likelihood
    share = nats / max(lead(rich.blocks, base.blocks)[0], 1e-9)
    return nats > 10 and z > 2.5 and train > 20 and share > 0.003


def samples_of(data: Data) -> float:
    """Numbers measured."""
    return float(np.sum(data.seen)) * data.y.shape[-1]
