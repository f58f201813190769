"""Hypotheses on recordings they never saw: likelihood in blocks, and errors of short free runs."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis, seat
from rotflex_jax.discover.lanes import Bench
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.fit.residuals import Data
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

# Log-likelihoods are compared block by block, so that their scatter tells what is chance.
BLOCK_SECONDS = 0.5
# Log-likelihood per block [nat] of a model that diverges: finite, so that it can be compared.
DIVERGED = -1e9


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
    def trained(self) -> Hypothesis:
        """The hypothesis on the held-out recordings with calibrations as trained, not as adapted."""
        own = np.tile(self.hypothesis.own.mean(axis=0), (len(self.adapted.x0), 1))
        return dataclasses.replace(self.adapted, own=own)

    @property
    def held_out(self) -> float:
        """Held-out log-likelihood [nat]."""
        return float(np.sum(self.blocks))


@dataclasses.dataclass(frozen=True)
class Away:
    """The held-out side.

    Attributes:
        judge: With the held-out recordings on its bench.
        recordings: The same, as recordings.
        first: First positions and speeds to begin with (R, 2 n).
        seconds: Length of the windows of short free runs [s].
    """

    judge: Judge
    recordings: Sequence[Recording]
    first: np.ndarray
    seconds: float

    def runner(self, h: Hypothesis, places: Iterable[Place], recording: int) -> Model:
        """A model of one held-out recording; all share the super-model's compiled code, gates apart."""
        bench = self.judge.bench
        gates = bench.supermodel.gates(places)
        part = bench.supermodel.part(gates)
        mechanism = part.mechanism.with_values(h.values(bench)[recording, part.parameters])
        return Model(mechanism, bench.solver, tuple(gates[list(part.effects)]))

    def short_runs(self, h: Hypothesis, places: Iterable[Place]) -> np.ndarray:
        """Root mean square error per channel of short free runs with these effects."""
        on = tuple(places)
        pairs = enumerate(self.recordings)
        return self.windows([self.runner(h, on, r).simulate_windows(x, self.seconds) for r, x in pairs])

    def windows(self, runs: Sequence[np.ndarray]) -> np.ndarray:
        """Root mean square error per channel of short free runs, their first samples not counted."""
        data = self.judge.bench.data
        measured = [y[: r.N] for y, r in zip(data.y, self.recordings, strict=True)]
        return windowed_rmse(self.recordings, measured, runs, self.seconds)


def held_out(away: Away, h: Hypothesis, near: Trial | None = None) -> Trial:
    """Log-likelihood of held-out recordings under a trained hypothesis, in blocks.

    Physics and process noise are the trained ones. What belongs to one recording alone (first state,
    calibrations) is fitted to it, by Gauss-Newton with secant slopes. So is the size of the innovations:
    where no model is complete, the size in training says how well a model could bend, and a richer one
    would be punished elsewhere for having bent further, however much nearer it comes there.

    Args:
        away: The held-out recordings.
        h: Trained hypothesis.
        near: Another trial, whose first states may be the better ones to begin with: where a sensor leaves
            something open, a rough guess ends elsewhere.
    """
    bench, R = away.judge.bench, len(away.first)
    own = np.tile(h.own.mean(axis=0), (R, 1))
    now = dataclasses.replace(h, x0=seat(bench, h.places, away.first), own=own)
    now = away.judge.with_process_noise(now, h.process_noise)
    begun = [now]
    if near is not None:
        begun.append(dataclasses.replace(now, x0=near.adapted.seated(bench, h.places)))
    tried = bench.innovations([b.lane(bench) for b in begun])
    best = int(np.argmin(_costs(h, tried, bench.data.seen)))
    now, e = begun[best], tried[best]
    if not np.all(np.isfinite(e)):
        lost = np.full_like(in_blocks(bench.data.seen, bench.data), DIVERGED)
        return Trial(h, lost, now, np.full(e.shape[-1], np.inf))
    for _ in range(10):
        gained, now, e = _settle(bench, now, e)
        if gained < 0.05:
            break
    blocks = in_blocks(away.judge.judged(now, e).densities, bench.data)
    return Trial(h, blocks, now, away.short_runs(now, h.places))


def _settle(bench: Bench, h: Hypothesis, e: np.ndarray) -> tuple[float, Hypothesis, np.ndarray]:
    """One Gauss-Newton step of what belongs to each recording alone, shortened until it helps.

    Returns:
        Nats gained, the hypothesis after the step, its innovations (R, N, C).
    """
    seen, reach, local = bench.data.seen, 1e-6, len(h.local)
    nudged = bench.innovations([v.lane(bench) for v in _nudged(h, reach)])
    if not np.all(np.isfinite(nudged)):
        return 0.0, h, e
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
    costs = _costs(h, tried, seen)
    best, before = int(np.argmin(costs)), 0.5 * float(np.sum(w**2))
    if not costs[best] < before:
        return 0.0, h, e
    return before - float(costs[best]), moved[best], tried[best]


def _costs(h: Hypothesis, innovations: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Half the squared size of each row of innovations (L, R, N, C); infinite where a run diverges."""
    return np.nan_to_num(0.5 * np.sum(h.whitener(innovations, seen) ** 2, axis=(1, 2, 3)), nan=np.inf)


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
