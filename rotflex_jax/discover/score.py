"""Which effect would explain the innovations best, before any refit.

Every candidate sits in the super-model with its amplitude at zero. The slope of the innovations along
the amplitude, whitened, less its projection on everything the baseline can still move, says how much
likelihood the effect would gain to first order (Rao's score statistic). Where a small amplitude does
nothing yet (play that is smaller than what a tooth covers in a moment), the change of the innovations
from a run at full size takes the place of the slope.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.lanes import Bench, Directions, Lane
from rotflex_jax.discover.probing import Absent, probe
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.supermodel import Candidate, Place
from rotflex_jax.effects import CATALOG

# An effect that can gain this much (chi-square) is found about every other time: both the training and
# the held-out part must have their share of it.
VISIBLE = 40.0
# Directions per pass.
PROBES = 8
# A sudden effect acts at its size: this share of it at most.
MOST = 1.5
# Shapes beside the best one at which a refit may start.
SHAPES = 2


@dataclasses.dataclass(frozen=True)
class Score:
    """A candidate's score.

    Attributes:
        place: Effect and port.
        gain: Log-likelihood gained to first order [nat].
        nats: The same, less half a log N per number it needs.
        start: Parameter values where a refit should start.
        excited: Whether an effect of plausible size would have been visible.
        unconfounded: Norm of the projected slope over the norm of the slope.
        smallest: Factor of the plausible size that would just have been visible.
        others: Starts at the next best shapes.
    """

    place: Place
    gain: float
    nats: float
    start: np.ndarray
    excited: bool
    unconfounded: float
    smallest: float
    others: tuple[np.ndarray, ...] = ()


@dataclasses.dataclass(frozen=True)
class _Probe:
    """One direction of the test: candidate, alternative, member of the alternative."""

    candidate: Candidate
    shape: int
    member: int


def _packed(candidates: list[Candidate]) -> list[list[_Probe]]:
    """Probes that share a lane: as many as it has directions, of each candidate one shape only."""
    batches: list[list[_Probe]] = []
    for c in candidates:
        for shape, group in enumerate(c.probes):
            mine = [_Probe(c, shape, member) for member in range(len(group))]
            room = [b for b in batches if len(b) + len(mine) <= PROBES]
            if apart := [b for b in room if all(p.candidate is not c for p in b)]:
                apart[0].extend(mine)
            else:
                batches.append(mine)
    return batches


def _lane_for(bench: Bench, h: Hypothesis, probes: list[_Probe]) -> Lane:
    """The hypothesis with candidates on at zero amplitude, or off where they have no amplitude."""
    values = h.values(bench)
    gates = bench.supermodel.gates(h.places)
    for p in probes:
        c = p.candidate
        for k, i in enumerate(c.parameters):
            values[:, i] = 0.0 if c.amplitudes[k] else c.probes[p.shape][0][k]
        gates[c.effect] = 1.0 if any(c.amplitudes) else 0.0
    return Lane(values, h.x0, gates, h.K)


def scores(judge: Judge, h: Hypothesis) -> list[Score]:
    """Scores of all candidates that are not yet in the hypothesis, best first."""
    bench, seen = judge.bench, judge.bench.data.seen
    candidates = [c for c in bench.supermodel.candidates.values() if c.place not in h.places]
    if not candidates:
        return []
    gentle = [c for c in candidates if not c.sudden]
    families = bench.supermodel.families(gentle)
    batches = [(family, probes) for family in families for probes in _packed(family)]
    present = h.lane(bench)
    e, J = bench.slopes([present], [h.directions(bench, max(judge.directions(), h.moved))])
    w = h.whitener(e[0], seen)
    N = _expanded(h, h.whitener(J[0, : h.moved], seen))
    jobs = [Absent(family, _lane_for(bench, h, part), _tangents(bench, h, part)) for family, part in batches]
    J = probe(bench, present, jobs) if jobs else ()
    Q = np.linalg.qr(N.T / np.maximum(np.linalg.norm(N, axis=1), 1e-300))[0]
    r = w.ravel()
    r = r - Q @ (Q.T @ r)
    columns: dict[tuple[Place, int], list[np.ndarray]] = {}
    for (_, part), slopes in zip(batches, J, strict=True):
        W = h.whitener(slopes[: len(part)], seen).reshape(len(part), -1)
        for p, column in zip(part, W, strict=True):
            columns.setdefault((p.candidate.place, p.shape), []).append(column)
    for (place, shape), change in _changes(bench, h, e[0], [c for c in candidates if c.sudden]):
        columns[place, shape] = [h.whitener(change, seen).ravel()]
    headroom = float(np.exp(h.whitener.log_det / (2 * e.shape[-1])) / np.exp(np.mean(np.log(judge.noise))))
    ground = _Ground(Q, r, columns, float(np.sum(seen)) * e.shape[-1], max(headroom, 1.0))
    found = [_score(c, ground) for c in candidates]
    return sorted(found, key=lambda s: -s.nats)


def _tangents(bench: Bench, h: Hypothesis, part: list[_Probe]) -> Directions:
    """Directions of probes: along amplitudes by their values, along effects without any by the gate."""
    R, P = len(h.x0), len(h.z)
    E, m = len(bench.supermodel.mechanism.effects), h.x0.shape[1]
    d = Directions(np.zeros((PROBES, R, P)), np.zeros((PROBES, m)), np.zeros((PROBES, E)))
    for row, p in enumerate(part):
        c = p.candidate
        if not any(c.amplitudes):
            d.gates[row, c.effect] = 1.0
            continue
        for k, i in enumerate(c.parameters):
            if c.amplitudes[k]:
                d.values[row, :, i] = c.probes[p.shape][p.member][k]
    return d


def _changes(
    bench: Bench, h: Hypothesis, e: np.ndarray, sudden: list[Candidate]
) -> Iterator[tuple[tuple[Place, int], np.ndarray]]:
    """For every shape of a sudden candidate, what it changes in the innovations (R, N, C)."""
    keys, lanes = [], []
    for c in sudden:
        places = (*h.places, c.place)
        for shape, (member,) in enumerate(c.probes):
            values = h.values(bench)
            values[:, c.parameters] = member
            keys.append((c.place, shape))
            lanes.append(Lane(values, h.seated(bench, places), bench.supermodel.gates(places), h.K))
    if lanes:
        yield from zip(keys, bench.innovations(lanes) - e, strict=True)


def _expanded(h: Hypothesis, W: np.ndarray) -> np.ndarray:
    """Nuisance directions as rows (D', R N C); local ones once per recording."""
    shared, R = len(h.free), W.shape[1]
    rows = [W[k].ravel() for k in range(shared)]
    for k in range(shared, h.moved):
        for r in range(R):
            one = np.zeros_like(W[k])
            one[r] = W[k, r]
            rows.append(one.ravel())
    return np.array(rows)


@dataclasses.dataclass(frozen=True)
class _Ground:
    """What all candidates are measured against.

    Attributes:
        Q: Orthonormal basis of what the hypothesis can still move (M, D').
        r: Whitened innovations less their projection on Q (M,).
        columns: (place, alternative) -> whitened slopes, one per probe (M,).
        samples: Numbers measured.
        headroom: Innovations over sensor noise: how much smaller they would be if the model were right.
    """

    Q: np.ndarray
    r: np.ndarray
    columns: dict[tuple[Place, int], list[np.ndarray]]
    samples: float
    headroom: float


def _score(c: Candidate, ground: _Ground) -> Score:
    """The best alternative of a candidate, with starts at the next best ones."""
    alternatives = [_alternative(c, shape, ground) for shape in range(len(c.probes))]
    best, *rest = sorted(alternatives, key=lambda s: -s.nats)
    return dataclasses.replace(best, others=tuple(s.start for s in rest[:SHAPES] if s.gain > 0))


def _alternative(c: Candidate, shape: int, ground: _Ground) -> Score:
    group = np.array(c.probes[shape], float)
    J = np.array(ground.columns[(c.place, shape)]).T
    start = group[0].copy()
    if not np.all(np.isfinite(J)):
        return Score(c.place, -np.inf, -np.inf, start, False, 0.0, np.inf)
    full = np.linalg.norm(J, axis=0)
    J = J - ground.Q @ (ground.Q.T @ J)
    left = np.linalg.norm(J, axis=0)
    a = _nonnegative(J, ground.r, c)
    a = np.minimum(a, MOST) if c.sudden else a
    moved = J @ a
    gain = float(-moved @ ground.r - 0.5 * moved @ moved)
    df = max(int(np.count_nonzero(a)), 1) + (1 if len(c.probes) > 1 else 0)
    if any(c.amplitudes):
        start = np.where(c.amplitudes, a @ group, start)
    strongest = max(float(left.max()) * ground.headroom, 1e-300)
    return Score(
        c.place,
        gain,
        gain - 0.5 * df * float(np.log(ground.samples)),
        start,
        excited=strongest**2 > VISIBLE,
        unconfounded=float((left / np.maximum(full, 1e-300)).max()),
        smallest=float(np.sqrt(VISIBLE) / strongest),
    )


def _nonnegative(J: np.ndarray, r: np.ndarray, c: Candidate) -> np.ndarray:
    """Amplitudes that lower |r + J a| most, none of them negative where only positive ones exist."""
    keep = np.linalg.norm(J, axis=0) > 1e-9 * max(float(np.linalg.norm(r)), 1e-300)
    a = np.zeros(J.shape[1])
    while keep.any():
        part = np.linalg.lstsq(J[:, keep], -r, rcond=1e-8)[0]
        if not c.one_sided or np.all(part >= 0):
            a[keep] = part
            break
        drop = np.flatnonzero(keep)[np.argmin(part)]
        keep[drop] = False
    return a


def promising(listed: list[Score], most: int) -> list[Score]:
    """Scores worth a refit, best first.

    A richer effect that gains nothing to first order over the simpler one it contains (a friction that
    is the same both ways, say) would only be refitted to the same model.
    """
    gains = {s.place: s.gain for s in listed}
    worth = []
    for s in (s for s in listed if s.nats > 0):
        name, port = s.place
        simpler = [gains[c, port] for c in CATALOG[name].contains if (c, port) in gains]
        if all(s.gain > g + 1.0 for g in simpler):
            worth.append(s)
    return worth[:most]
