"""The score test: how much log-likelihood each candidate would gain, to first order and without a refit.

Every candidate is in the super-model with its amplitude at zero. The slopes of the innovations along the
amplitudes are whitened, and their projection on everything that the baseline can still change is subtracted.
They give the log-likelihood that the effect would gain to first order (Rao's score statistic). Some effects
do nothing at small amplitudes, such as play that is smaller than the motion of a tooth within a sample. For
these, the change of the innovations in a run at full size replaces the slope.

If the size that gains most is not plausible, such as an encoder that is off centre by a radian, the score is
what the largest plausible share of it gains. Otherwise effects that no refit can keep would take the places
of others among the few that are refitted.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import ParameterSet
from rotflex_jax.discover.candidate_slopes import MOST_LINES, Slopes, candidate_sensitivities
from rotflex_jax.discover.hypothesis import CandidateStart, Hypothesis, is_physical, with_candidate
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.supermodel import Candidate, EffectLocation, ErrorLine, SuperModel
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.coordinates import FitCoordinates, Projection
from rotflex_jax.latent.in_time import periodic_torques
from rotflex_jax.runtime.persistent_jit import make_ahead
from rotflex_jax.runtime.xla import on_threads

# An effect with this chi-square is found in about half of all cases: it must show both in the training and in
# the validation data.
DETECTABLE_CHI2 = 40.0
# Largest amplitude of an effect with a threshold, as a multiple of the size at which it was run.
MAX_THRESHOLD_AMPLITUDE = 1.5
# A candidate is not refitted if the sum of its scores of both horizons is below this share of the best sum.
LEAST_SHARE = 0.25
# Number of shapes, besides the best one, at which a refit may start.
EXTRA_SHAPES = 2
# The largest plausible share of a size is at least the first, and found in this number of halvings.
LEAST_PLAUSIBLE_SHARE, HALVINGS = 1e-3, 6


@dataclasses.dataclass(frozen=True)
class Score:
    """Score of a candidate.

    Attributes:
        start: Start of a refit, with the gain in log-likelihood to first order.
        nats: This gain less half a log N for each parameter of the candidate [nat].
        excited: Whether an effect of plausible size would have been visible.
        orthogonal_fraction: Norm of the slope after projection, divided by its norm before.
        detection_limit: Smallest size that would have been visible, as a factor of the plausible size.
    """

    start: CandidateStart
    nats: float
    excited: bool
    orthogonal_fraction: float
    detection_limit: float

    @property
    def location(self) -> EffectLocation:
        """Effect and port."""
        return self.start.location


def residual_lines(problem: LikelihoodProblem, h: Hypothesis) -> tuple[ErrorLine, ...]:
    """Lines in the spectrum of the innovations that the input does not have, the clearest first.

    Args:
        problem: Likelihood of predictions of recordings.
        h: Hypothesis fitted to predictions.
    """
    found: list[tuple[float, ErrorLine]] = []
    data, innovations = problem.dataset.recordings, problem.innovations([h])[0]
    for r, (recording, e, seen) in enumerate(zip(data, innovations, problem.seen, strict=True)):
        first, last = recording.n_init, int(np.sum(seen))
        for x in e[first:last].T if np.all(np.isfinite(e[:last])) else ():
            lines = periodic_torques(x, recording.u[first:last], recording.Ts)
            found += [
                (x.amplitude / max(x.interval[1] - x.amplitude, 1e-300), ErrorLine(x.frequency, r))
                for x in lines
            ]
    longest = max(r.duration for r in data)
    chosen: list[ErrorLine] = []
    for _, line in sorted(found, reverse=True):
        if all(abs(line.frequency - other.frequency) > 2 / longest for other in chosen):
            chosen.append(line)
    return tuple(chosen[:MOST_LINES])


def candidates_to_score(
    s: SuperModel, h: Hypothesis, lines: Sequence[ErrorLine]
) -> dict[EffectLocation, Candidate]:
    """Candidates that are not yet in a hypothesis, by location.

    A periodic disturbance has one shape for each line; without lines it is not among them.
    """
    absent = (c.at_lines(lines) for location, c in s.candidates.items() if location not in h.locations)
    return {c.location: c for c in absent if c}


def score_test(
    problem: LikelihoodProblem,
    h: Hypothesis,
    lines: Sequence[ErrorLine] = (),
    is_plausible: Callable[[Hypothesis, EffectLocation], bool] | None = None,
) -> "ScoreTest":
    """The score test of all candidates that are not yet in a hypothesis.

    Args:
        problem: Likelihood of the recordings at one horizon.
        h: The hypothesis to which candidates would be added.
        lines: Lines at which a periodic disturbance is tried; without lines none is tried.
        is_plausible: Whether an effect of a hypothesis is of a plausible size; if None, whether its
            parameters lie in their physical ranges.
    """
    s, seen = problem.supermodel, problem.seen
    tried = candidates_to_score(s, h, lines)
    candidates = list(tried.values())
    if not candidates:
        return ScoreTest([], {}, None)
    is_plausible = is_plausible or functools.partial(is_physical, s)
    thresholds = [c for c in candidates if c.threshold]
    make_ahead(lambda: list(_changes(problem, h, np.zeros(1), thresholds)))
    e, J = problem.slopes([h])
    w = h.whitener(e[0], seen)
    coordinates = FitCoordinates.of(h, problem.windows)
    orthogonal = coordinates.orthogonal_to(h.whitener(J[0, : h.moved], seen))
    smooth = [c for c in candidates if not c.threshold]
    found = candidate_sensitivities(problem.predictor, h.parameter_set(s), smooth, problem.windows.index)
    found = [slopes for slopes in found if slopes.probes]
    keys = [[(p.candidate.location, p.shape) for p in probes] for probes, _ in found]
    if changes := list(_changes(problem, h, e[0], thresholds)):
        keys.append([key for key, _ in changes])
        found.append(Slopes((), np.stack([change for _, change in changes])))
    columns: dict[tuple[EffectLocation, int], list[_Column]] = {}
    project = lambda slopes: _columns(h.whitener(slopes.J, seen), orthogonal)  # noqa: E731
    for group, projected in zip(keys, on_threads(project, found), strict=True):
        for key, column in zip(group, projected, strict=True):
            columns.setdefault(key, []).append(column)
    headroom = float(np.exp(h.whitener.log_det / (2 * e.shape[-1])) / np.exp(np.mean(np.log(problem.noise))))
    r = orthogonal(w[None])[0]
    share = functools.partial(_plausible_share, s, h, is_plausible)
    projected = _Projected(r, columns, problem.measured_values, max(headroom, 1.0), share)
    listed = sorted((_score(c, projected) for c in candidates), key=lambda found: -found.nats)
    return ScoreTest(listed, tried, projected)


def _plausible_share(
    s: SuperModel,
    h: Hypothesis,
    is_plausible: Callable[[Hypothesis, EffectLocation], bool],
    starts: Sequence[CandidateStart],
) -> float:
    """The largest share of the sizes of candidates, at most 1, at which each of them is plausible.

    It is 1 if they are not plausible even where they are nearly absent, for then sizes are not the reason.
    """

    def plausible(share: float) -> bool:
        return all(is_plausible(with_candidate(s, h, x, share), x.location) for x in starts)

    low, high = LEAST_PLAUSIBLE_SHARE, 1.0
    if plausible(high) or not plausible(low):
        return 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if plausible(middle) else (low, middle)
    return low


def _changes(
    problem: LikelihoodProblem, h: Hypothesis, e: np.ndarray, candidates: list[Candidate]
) -> Iterator[tuple[tuple[EffectLocation, int], np.ndarray]]:
    """For every shape of candidates with a threshold, the change of innovations at full size (R, N, C)."""
    s, keys, parameter_sets = problem.supermodel, [], []
    for c in candidates:
        locations = (*h.locations, c.location)
        for shape, (member,) in enumerate(c.probes):
            values = h.values(s)
            values[:, c.parameters] = member
            keys.append((c.location, shape))
            x0 = h.initial_state_for(s, locations)
            parameter_sets.append(ParameterSet(values, x0, s.gates(locations), h.K))
    if parameter_sets:
        yield from zip(keys, problem.innovations_of(parameter_sets) - e, strict=True)


class _Column(NamedTuple):
    """Whitened slopes along one probe.

    Attributes:
        size: Norm of the slopes; not finite where a run diverges.
        left: The slopes after projection: the part that the hypothesis cannot imitate.
    """

    size: float
    left: Float[np.ndarray, " M"]


def _columns(whitened: Float[np.ndarray, "K R N C"], orthogonal: Projection) -> list[_Column]:
    sizes = np.sqrt(np.einsum("krnc,krnc->k", whitened, whitened))
    whitened[~np.isfinite(sizes)] = 0.0
    return [_Column(float(size), left) for size, left in zip(sizes, orthogonal(whitened), strict=True)]


@dataclasses.dataclass(frozen=True)
class _Projected:
    """Innovations and slopes of all candidates, without the part that the hypothesis can still explain.

    Attributes:
        r: Whitened innovations after projection.
        columns: (location, shape) -> slopes, one per probe.
        samples: Number of measured values.
        headroom: Size of the innovations over the sensor noise, at least 1: the factor by which the
            innovations would be smaller if the model were right.
        plausible_share: The largest share of the sizes of candidates at which each of them is plausible.
    """

    r: Float[np.ndarray, " M"]
    columns: dict[tuple[EffectLocation, int], list[_Column]]
    samples: float
    headroom: float
    plausible_share: Callable[[Sequence[CandidateStart]], float]

    def of(self, location: EffectLocation, shape: int) -> Float[np.ndarray, "k M"] | None:
        """Slopes of a shape after projection; None where they are not finite."""
        found = self.columns[(location, shape)]
        return np.array([c.left for c in found]) if all(np.isfinite(c.size) for c in found) else None

    def limited(
        self, starts: Sequence[CandidateStart], scaled: Sequence[tuple[bool, ...]]
    ) -> tuple[CandidateStart, ...]:
        """Starts of candidates that are added together, at the largest plausible share of their sizes.

        The gain is a parabola of the share `x`, with its largest value `g` at 1, hence `x (2 - x) g`.

        Args:
            starts: The starts, with the gain of all of them together.
            scaled: For each start, which of its values are sizes.
        """
        x = self.plausible_share(starts)
        return tuple(
            dataclasses.replace(
                start,
                values=np.where(sizes, x * start.values, start.values),
                expected_gain=x * (2.0 - x) * start.expected_gain,
            )
            for start, sizes in zip(starts, scaled, strict=True)
        )


def _score(c: Candidate, projected: _Projected) -> Score:
    """The score of a candidate at its best shape, with starts at the next best shapes too."""
    shapes = [_score_of_shape(c, shape, projected) for shape in range(len(c.probes))]
    best, *rest = sorted(shapes, key=lambda s: -s.nats)
    others = tuple(s.start.values for s in rest[:EXTRA_SHAPES] if s.start.expected_gain > 0)
    return dataclasses.replace(best, start=dataclasses.replace(best.start, others=others))


def _score_of_shape(c: Candidate, shape: int, projected: _Projected) -> Score:
    group = np.array(c.probes[shape], float)
    rows, values = projected.of(c.location, shape), group[0].copy()
    if rows is None:
        start = CandidateStart(c.location, values, expected_gain=-np.inf)
        return Score(start, -np.inf, False, 0.0, np.inf)
    full = np.array([column.size for column in projected.columns[(c.location, shape)]])
    J, left = rows.T, np.linalg.norm(rows, axis=1)
    a = _amplitudes(J, projected.r, c)
    a = np.minimum(a, MAX_THRESHOLD_AMPLITUDE) if c.threshold else a
    explained = J @ a
    gain = float(-explained @ projected.r - 0.5 * explained @ explained)
    df = max(int(np.count_nonzero(a)), 1) + (1 if len(c.probes) > 1 else 0)
    if any(c.amplitudes):
        values = np.where(c.amplitudes, a @ group, values)
    strongest = max(float(left.max()) * projected.headroom, 1e-300)
    (start,) = projected.limited([CandidateStart(c.location, values, expected_gain=gain)], [c.scaled])
    return Score(
        start,
        start.expected_gain - 0.5 * df * float(np.log(projected.samples)),
        excited=strongest**2 > DETECTABLE_CHI2,
        orthogonal_fraction=float((left / np.maximum(full, 1e-300)).max()),
        detection_limit=float(np.sqrt(DETECTABLE_CHI2) / strongest),
    )


def _amplitudes(J: np.ndarray, r: np.ndarray, c: Candidate) -> np.ndarray:
    """Amplitudes a that minimise |r + J a|, none of them negative if the candidate is one-sided."""
    keep = np.linalg.norm(J, axis=0) > 1e-9 * max(float(np.linalg.norm(r)), 1e-300)
    a = np.zeros(J.shape[1])
    while keep.any():
        found = np.linalg.lstsq(J[:, keep], -r, rcond=1e-8)[0]
        if not c.one_sided or np.all(found >= 0):
            a[keep] = found
            break
        drop = np.flatnonzero(keep)[np.argmin(found)]
        keep[drop] = False
    return a


@dataclasses.dataclass(frozen=True)
class PairStart:
    """Where a refit of two candidates starts.

    Attributes:
        starts: Start of each candidate.
        alone: Models with the first and with the second candidate, to which a refit may add the other one.
    """

    starts: tuple[CandidateStart, CandidateStart]
    alone: tuple[Hypothesis, ...] = dataclasses.field(default=(), kw_only=True)

    @property
    def locations(self) -> tuple[EffectLocation, EffectLocation]:
        """Effects and ports."""
        return self.starts[0].location, self.starts[1].location


@dataclasses.dataclass(frozen=True)
class PairScore(PairStart):
    """Score of two candidates together.

    Attributes:
        gain: Gain in log-likelihood to first order [nat].
        nats: This gain less half a log N for each parameter of the two [nat].
        more: `nats` less the score of the better candidate alone [nat].
        synergy: `gain` less the sum of the gains of both candidates alone [nat]: what each hides of the
            other.
    """

    gain: float
    nats: float
    more: float
    synergy: float


@dataclasses.dataclass(frozen=True)
class ScoreTest:
    """Scores of all candidates for one hypothesis, and of any two of them together.

    Attributes:
        listed: Scores, best first.
        candidates: Candidates that were tested.
        projected: Innovations and slopes from which scores are computed; None without candidates.
    """

    listed: list[Score]
    candidates: dict[EffectLocation, Candidate]
    projected: _Projected | None

    def pairs(self, locations: Sequence[EffectLocation]) -> list[PairScore]:
        r"""Scores of all pairs of some candidates, in closed form.

        .. math:: 2 g = b_2^T G_2^{-1} b_2, \qquad G = J_\perp^T J_\perp, \quad b = J_\perp^T r

        with the rows and columns of the two candidates; no model is run. Each pair has the shapes that gain
        most together. If one candidate of a pair contains the other, the pair is one effect and is left out.

        Args:
            locations: Locations of candidates that were tested.
        """
        if self.projected is None:
            return []
        shapes = [_shapes(self.candidates[p], self.projected) for p in locations]
        rows = np.concatenate([s.columns for group in shapes for s in group] or [np.zeros((0, 1))])
        gram = _Gram(rows @ rows.T, rows @ self.projected.r if len(rows) else np.zeros(0))
        last, by_shape = 0, []
        for group in shapes:
            ends = last + np.cumsum([len(s.columns) for s in group], dtype=int)
            by_shape.append([(s, np.arange(e - len(s.columns), e)) for s, e in zip(group, ends, strict=True)])
            last = int(ends[-1]) if len(ends) else last
        alone = {s.location: s for s in self.listed}
        found = []
        for i, a in enumerate(by_shape):
            for b in by_shape[i + 1 :]:
                if a and b and not a[0][0].candidate.location.is_related_to(b[0][0].candidate.location):
                    found.append(self._best_pair(gram, a, b, alone))
        return found

    def _best_pair(
        self,
        gram: "_Gram",
        a: "list[tuple[_Shape, np.ndarray]]",
        b: "list[tuple[_Shape, np.ndarray]]",
        alone: dict[EffectLocation, Score],
    ) -> PairScore:
        """The score of two candidates at the shapes that gain most together."""
        assert self.projected
        price = 0.5 * float(np.log(self.projected.samples))
        best = None
        for first, i in a:
            for second, j in b:
                values, gain = gram.solved([(first, i), (second, j)])
                pair = (first, values[: len(i)]), (second, values[len(i) :])
                count = sum(max(int(np.count_nonzero(v)), 1) + (len(s.candidate.probes) > 1) for s, v in pair)
                penalty = price * count
                if best is None or gain - penalty > best[0] - best[1]:
                    best = gain, penalty, pair
        assert best
        gain, penalty, pair = best
        starts = [CandidateStart(s.candidate.location, s.values(v), expected_gain=gain) for s, v in pair]
        one, other = self.projected.limited(starts, [s.candidate.scaled for s, _ in pair])
        gain = one.expected_gain
        each = [alone[p] for p in (one.location, other.location)]
        better = max(0.0, *(s.nats for s in each))
        promised = sum(max(s.start.expected_gain, 0.0) for s in each)
        more, synergy = gain - penalty - better, gain - promised
        return PairScore((one, other), gain, gain - penalty, more, synergy)


class _Shape(NamedTuple):
    """A candidate at one of its shapes, with its slopes after projection (k, M)."""

    candidate: Candidate
    shape: int
    columns: Float[np.ndarray, "k M"]

    def values(self, amplitudes: Float[np.ndarray, " k"]) -> Float[np.ndarray, " P"]:
        """Parameter values of the candidate for amplitudes along the directions of the shape."""
        group = np.array(self.candidate.probes[self.shape], float)
        mean = amplitudes @ group if any(self.candidate.amplitudes) else group[0]
        return np.where(self.candidate.amplitudes, mean, group[0])


def _shapes(c: Candidate, projected: _Projected) -> list[_Shape]:
    """The shapes of a candidate whose slopes are finite."""
    found = []
    for shape in range(len(c.probes)):
        if (rows := projected.of(c.location, shape)) is not None:
            found.append(_Shape(c, shape, rows))
    return found


class _Gram(NamedTuple):
    """Inner products of all projected slopes with each other and with the innovations."""

    G: Float[np.ndarray, "K K"]
    b: Float[np.ndarray, " K"]

    def solved(self, shapes: Sequence[tuple[_Shape, np.ndarray]]) -> tuple[np.ndarray, float]:
        """Amplitudes of the columns of some shapes that gain most together, and their gain [nat].

        Amplitudes of one-sided candidates are not negative.
        """
        rows = np.concatenate([i for _, i in shapes])
        positive = np.concatenate([np.full(len(i), s.candidate.one_sided) for s, i in shapes])
        size = np.sqrt(np.diag(self.G)[rows])
        # Columns are scaled to norm one, since their sizes differ by powers of ten.
        keep = size > 1e-9 * max(float(size.max()), 1e-300)
        a = np.zeros(len(rows))
        G = self.G[np.ix_(rows, rows)] / np.outer(np.where(keep, size, 1.0), np.where(keep, size, 1.0))
        b = self.b[rows] / np.where(keep, size, 1.0)
        while keep.any():
            found = np.linalg.lstsq(G[np.ix_(keep, keep)], -b[keep], rcond=1e-10)[0]
            negative = np.flatnonzero(keep)[(found < 0) & positive[keep]]
            if not len(negative):
                a[keep] = found
                break
            full = np.zeros(len(rows))
            full[keep] = found
            keep[negative[np.argmin(full[negative])]] = False
        most = np.concatenate(
            [np.full(len(i), MAX_THRESHOLD_AMPLITUDE if s.candidate.threshold else np.inf) for s, i in shapes]
        )
        a[keep] = np.minimum(a[keep], most[keep] * size[keep])  # columns of norm zero have no amplitude
        return a / np.where(keep, size, 1.0), float(-a @ b - 0.5 * a @ G @ a)


def promising_at_both(prediction: list[Score], free_run: list[Score], most: int) -> list[tuple[Score, Score]]:
    """Candidates worth a refit with their scores of predictions and of free runs, best first.

    Where another part of the model is wrong, the scores of either horizon may mislead. So candidates are
    ordered by their share of the best score, summed over both horizons, and the best one of each horizon is
    always among them.
    """
    both = (prediction, free_run)
    worth = [promising(listed) for listed in both]
    highest = [max((s.nats for s in listed), default=1.0) for listed in worth]
    share: dict[EffectLocation, float] = {}
    for listed, best in zip(worth, highest, strict=True):
        for s in listed:
            share[s.location] = share.get(s.location, 0.0) + s.nats / best
    enough = LEAST_SHARE * max(share.values(), default=0.0)
    order = sorted((p for p in share if share[p] >= enough), key=lambda p: share[p], reverse=True)
    chosen = [*order[:most], *(listed[0].location for listed in worth if listed)]
    first, second = ({s.location: s for s in listed} for listed in both)
    return [(first[p], second[p]) for p in dict.fromkeys(chosen)]


def promising(listed: list[Score]) -> list[Score]:
    """Scores of candidates worth a refit, best first.

    A richer effect that gains nothing to first order over the simpler effect that it contains is left out,
    since its refit would give the same model. An example is an asymmetric friction that is the same in both
    directions.
    """
    gains = {s.location: s.start.expected_gain for s in listed}
    worth = []
    for s in (s for s in listed if s.nats > 0):
        contained = (EffectLocation(name, s.location.port) for name in CATALOG[s.location.effect].contains)
        simpler = [gains[c] for c in contained if c in gains]
        if all(s.start.expected_gain > g + 1.0 for g in simpler):
            worth.append(s)
    return worth
