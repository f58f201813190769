"""The next segment of a sequential experiment: the input after which a wrong answer is least probable."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rotflex_jax.checks import Progress
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.discrimination import (
    FIRST_ASCENT_STEP,
    LONGEST_ASCENT_STEP,
    MOMENTUM,
    SMALLEST_ASCENT_STEP,
    peak_penalty,
    peak_slope,
)
from rotflex_jax.experiment.result import Segment
from rotflex_jax.experiment.rival_set import BATCH, Start
from rotflex_jax.experiment.standard_inputs import StandardInput, standard_inputs

if TYPE_CHECKING:
    from rotflex_jax.experiment.sequential import SequentialExperiment

# Length of the voltage before a segment with which its simulation begins, for actuators with memory, and
# length of the rest after it during which the machine must stay within its limits [s].
BEFORE, AFTER = 0.3, 0.3
# An input is rated by the evidence of this number of repetitions, because the first one alone carries as much
# information on the parameters as on the rival.
LOOK_AHEAD = 4
# Number of draws from the distribution of each rival's parameters. The worst draw counts for the rating of an
# input, the best for giving up.
DRAWS = 3
# Least share of the distance of a parameter to its bound that a draw leaves.
LEFT_TO_BOUND = 0.2
# Levels at which each standard input is tried, as shares of what the limits allow.
LEVELS = (1.0, 0.4, 0.15, 0.06)
# Inputs whose motion has fewer standard deviations of the noise are not tried: there the rounding errors of
# an encoder are correlated from sample to sample, and carry far less information than independent errors.
QUIET = 20.0
# Number of inputs that are improved by gradient ascent, and evaluations of each.
IMPROVED, LOOKS = 4, 40
# A log-likelihood ratio with mean T has the variance 2 T; luck beyond this many deviations is disregarded.
DEVIATIONS = 2.0
# Largest number of reductions that bring an input within the limits on motion.
CUTS = 6
# Number of inputs in a table.
LISTED = 8
# Least share of the needed evidence with which an input is rated.
LEAST_SHARE = 1e-6
# Shift of a logarithm above which it is no small change; the gradient is then taken without the shift.
LARGEST_SHIFT = 1.0


class _Known(NamedTuple):
    """What is known of a rival before a segment.

    Attributes:
        machine: Most probable unconstrained free parameters of the machine.
        own: Most probable calibrations of the run.
        state: State in which the segment begins.
        state_slope: Its derivative by the D unknowns: those of the machine, calibrations, first positions and
            speeds.
        covariance: Covariance of these unknowns.
    """

    machine: Float[np.ndarray, " m"]
    own: Float[np.ndarray, " o"]
    state: Float[np.ndarray, " n"]
    state_slope: Float[np.ndarray, "n D"]
    covariance: Float[np.ndarray, "D D"]


class _Named(NamedTuple):
    """Kind and setting of an input, and its level as a share of what the limits allow."""

    kind: str
    setting: str
    level: float

    @property
    def words(self) -> str:
        """The setting with the level."""
        return self.setting + (f", x {self.level:g}" if self.level != 1 else "")


class SegmentChoice:
    """Chooses the next segment from the state of an experiment."""

    def __init__(self, e: "SequentialExperiment") -> None:
        self.e, self.r, self.limits = e, e.rivals, e.settings.limits
        self.M, self.before = e.samples, e.samples_before
        self.after = round(AFTER / self.r.Ts)
        self.p = np.maximum(e.probabilities, 1e-12)
        self.rng = np.random.default_rng([e.settings.seed, len(e.history)])
        goes_on = bool(e.runs) and e.settings.continues
        self.history = e.runs[-1].u[-self.before :] if goes_on else np.zeros(self.before)
        # The last voltage, from which the slew rate limits the next one.
        self.start = float(e.runs[-1].u[-1]) if goes_on else 0.0
        self.pose = e.runs[-1].y[0] if goes_on else np.zeros(len(self.r.structure.channels))
        self._prepare([self._known(h, goes_on) for h in range(self.r.count)], goes_on)

    def _known(self, h: int, goes_on: bool) -> _Known:
        """What is known of a rival, in a run that goes on or in one that is still to begin."""
        r, e = self.r, self.e
        m, o, q = len(r.free[h]), len(r.own), 2 * r.layout.n
        post = e.posteriors[h] if e.runs else None
        if post is not None and goes_on:
            run = len(post.unknowns) - r.run_unknowns + np.arange(o + q)
            covariance = post.covariance(e.scale, np.concatenate([np.arange(m), run]))
            return _Known(post.unknowns[:m], post.unknowns[run[:o]], post.state, post.state_slope, covariance)
        covariance = np.zeros((m + o + q, m + o + q))
        covariance[:m, :m] = r.prior_covariance[h] if post is None else post.covariance(e.scale, np.arange(m))
        covariance[m:, m:] = np.linalg.inv(r.prior_precision(h, 1)[m:, m:])
        slope = np.zeros((r.layout.size, m + o + q))
        slope[np.arange(q), m + o + np.arange(q)] = 1.0
        machine = r.prior_mean[h] if post is None else post.unknowns[:m]
        return _Known(machine, np.zeros(o), r.rest.copy(), slope, covariance)

    def _prepare(self, known: Sequence[_Known], goes_on: bool) -> None:
        """Sets for each rival the first state and parameters of its runs, directions of errors, and draws."""
        values, self.dvalues, self.dx0, self.information = [], [], [], []
        self.drawn: list[list[tuple[np.ndarray, np.ndarray]]] = []
        for h, k in enumerate(known):
            D, m = len(k.covariance), len(k.machine)
            v, slope = self.r.values_and_slopes(h, k.machine, k.own)
            dvalues, _ = self.r.directions(h, slope)
            dx = np.zeros((len(dvalues), len(k.state)))
            dx[:D] = k.state_slope.T
            values.append(v)
            self.dvalues.append(dvalues)
            self.dx0.append(dx)
            self.information.append(np.linalg.inv(k.covariance + 1e-12 * np.diag(np.diag(k.covariance))))
            # A run that is still to begin starts at rest: only the machine is drawn.
            drawn = np.ones(D) if goes_on else (np.arange(D) < m).astype(float)
            spread = k.covariance * np.outer(drawn, drawn)
            w, V = np.linalg.eigh((spread + spread.T) / 2)
            steps = (V * np.sqrt(np.maximum(w, 0))) @ self.rng.standard_normal((len(w), DRAWS))
            self.drawn.append(
                [(self._likely(v, dvalues[:D].T @ d), k.state + k.state_slope @ d) for d in steps.T]
            )
        self.values, self.x0 = np.array(values), np.array([k.state for k in known])
        self.nominal = [(k.machine, k.own) for k in known]

    def _likely(self, values: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Values of a draw: physical values after a change, at some distance from their bounds.

        A change of a hardly known logarithm would enlarge a small effect out of all proportion.
        """
        out, lower, upper = values + change, self.r.transform.lower, self.r.transform.upper
        with np.errstate(invalid="ignore"):
            out = np.where(np.isfinite(lower), np.maximum(out, lower + LEFT_TO_BOUND * (values - lower)), out)
            return np.where(
                np.isfinite(upper), np.minimum(out, upper - LEFT_TO_BOUND * (upper - values)), out
            )

    # -- runs --------------------------------------------------------------------------------------

    def _windows(self, U: np.ndarray) -> np.ndarray:
        """Voltages (B, W) with the voltage played before them, and rest after them."""
        B = len(U)
        return np.concatenate([np.tile(self.history, (B, 1)), U, np.zeros((B, self.after))], axis=1)

    def _start(self, h: np.ndarray) -> Start:
        return Start(self.values[h], self.r.gates[h], self.x0[h])

    def outputs(self, U: Float[np.ndarray, "B M"], drawn: bool = False) -> Float[np.ndarray, "B H draws W C"]:
        """Outputs (B, H, 1 or draws, W, C) from the beginning of the segment on."""
        B, H = len(U), self.r.count
        windows, rows, values, x0 = self._windows(U), [], [], []
        for b in range(B):
            for h in range(H):
                for v, x in self.drawn[h] if drawn else [(self.values[h], self.x0[h])]:
                    rows.append((b, h))
                    values.append(v)
                    x0.append(x)
        which = np.array(rows)
        start = Start(np.array(values), self.r.gates[which[:, 1]], np.array(x0))
        y = self.r.outputs(start, windows[which[:, 0]])[:, self.before :]
        return y.reshape(B, H, -1, *y.shape[1:])

    def peaks(self, U: Float[np.ndarray, "B M"], drawn: bool = True) -> Float[np.ndarray, "B C"]:
        """Largest |output| of each channel (B, C) for any rival, relative to the first sample of the run."""
        runs = [self.outputs(U)] + ([self.outputs(U, drawn=True)] if drawn else [])
        most = [np.max(np.abs(y - self.pose), axis=(1, 2, 3)) for y in runs]
        return np.nan_to_num(np.max(most, axis=0), nan=np.inf)

    def within_limits(
        self, U: Float[np.ndarray, "B M"]
    ) -> tuple[Float[np.ndarray, "B M"], Bool[np.ndarray, " B"]]:
        """Voltages, reduced until predicted peaks are within the limits, and whether they are within them."""
        U, bound = U.copy(), self.limits.outputs(len(self.pose))
        ok = np.zeros(len(U), bool)
        for k in range(CUTS + 1):
            todo = np.flatnonzero(~ok)
            if not len(todo):
                break
            excess = np.max(self.peaks(U[todo]) / bound, axis=1)
            ok[todo[excess <= 1]] = True
            over = todo[excess > 1]
            if k < CUTS:
                U[over] *= (0.98 / np.clip(excess[excess > 1], 1.02, 5.0))[:, None]
        return U, ok

    def loud(self, U: Float[np.ndarray, "B M"]) -> Bool[np.ndarray, " B"]:
        """Which inputs move a channel by far more than the noise; if none does, those that move it most."""
        y = self.outputs(U)[..., : self.M, :]
        moved = np.nan_to_num(np.max(np.ptp(y, axis=-2) / self.r.noise, axis=(1, 2, 3)), nan=np.inf)
        return moved >= min(QUIET, moved.max() / 4)

    # -- information -------------------------------------------------------------------------------

    def evidence(
        self, U: Float[np.ndarray, "B M"], repeats: Sequence[float], drawn: bool, shift: bool = False
    ) -> tuple[Float[np.ndarray, "n B H draws H"], Any]:
        """Expected log-likelihood by which h wins over r if h is true, after repetitions of each input [nat].

            c_r = min over d of  n/2 |L (y - y_r - J_r d)|^2 + 1/2 d' I_r d,     T = c_r - c_h

        Here `y` is the run of h with its most probable parameters, or with drawn parameters, to which h must
        be fitted too.

        Args:
            U: Voltages.
            repeats: Numbers of repetitions n; below one for the first part of the input.
            drawn: Whether to use drawn true parameters too.
            shift: Whether the minimising `d` and the residuals are wanted, for gradients.

        Returns:
            T (n, B, H, draws, H), and for each input and pair the residuals and `d`, if wanted.
        """
        group, parts, details = max(1, BATCH // self.r.count), [], []
        for k in range(0, len(U), group):
            part, detail = self._evidence_of(U[k : k + group], repeats, drawn, shift)
            parts.append(part)
            details += detail
        return np.concatenate(parts, axis=1), details

    def _evidence_of(
        self, U: np.ndarray, repeats: Sequence[float], drawn: bool, shift: bool
    ) -> tuple[np.ndarray, list[Any]]:
        r, H, B = self.r, self.r.count, len(U)
        hs = np.tile(np.arange(H), B)
        windows = np.repeat(self._windows(U), H, axis=0)
        y, J = r.outputs_with_slopes(
            self._start(hs), windows, np.array(self.dvalues)[hs], np.array(self.dx0)[hs]
        )
        inside = slice(self.before, self.before + self.M)
        y = y[:, inside].reshape(B, H, 1, self.M, -1)
        J = J[:, inside].reshape(B, H, *J[:, inside].shape[1:])
        true = np.concatenate([y, self.outputs(U, drawn=True)[..., : self.M, :]], axis=2) if drawn else y
        out, details = np.zeros((len(repeats), B, H, true.shape[2], H)), [{} for _ in range(B)]
        root, C = math.sqrt(self.e.scale), y.shape[-1]
        # For each number of repetitions: number of whitened outputs that it uses, and their weight.
        amounts = [(C * min(self.M, math.ceil(n * self.M - 1e-9)), max(n, 1.0)) for n in repeats]
        for b in range(B):
            for other in range(H):
                D = len(self.information[other])
                A = r.whitened(other, np.moveaxis(J[b, other, ..., :D], -1, 0)) / root
                A = A.reshape(D, -1).T
                G = {m: A[:m].T @ A[:m] for m, _ in amounts}
                for h in range(H):
                    if h == other and not drawn:
                        continue
                    e = r.whitened(other, true[b, h] - y[b, other]) / root
                    e = e.reshape(len(e), -1)
                    for i, (m, n) in enumerate(amounts):
                        c, g = np.sum(e[:, :m] ** 2, axis=1), e[:, :m] @ A[:m]
                        d = np.linalg.solve(self.information[other] + n * G[m], n * g.T)
                        out[i, b, h, :, other] = 0.5 * n * (c - np.sum(g * d.T, axis=1))
                    if shift and h != other:
                        left = e[0] - A @ d[:, 0]
                        left[m:] = 0.0  # later samples do not count
                        details[b][h, other] = (left.reshape(self.M, -1), d[:, 0])
        own = np.einsum("ibhdh->ibhd", out)
        out = np.nan_to_num(out - own[..., None], nan=0.0, posinf=0.0, neginf=0.0)
        if shift:
            for b in range(B):
                details[b]["outputs"] = y[b, :, 0]
        return out, details

    def bound(self, T: Float[np.ndarray, "*B H H"]) -> Float[np.ndarray, "*B"]:
        """Logarithm of an upper bound of the probability of a wrong answer, from evidence (..., H, H).

            sum over pairs of  sqrt(p_h p_r) exp(-T_hr / 4)

        Source: T. Kailath, The divergence and Bhattacharyya distance measures in signal selection, IEEE
            Trans. Communication Technology 15, 1967.
        """
        terms = self._terms(T)
        top = terms.max(axis=(-1, -2), keepdims=True)
        return np.asarray(np.log(np.sum(np.exp(terms - top), axis=(-1, -2))) + top[..., 0, 0])

    def _terms(self, T: np.ndarray) -> np.ndarray:
        half = 0.5 * (np.log(self.p)[:, None] + np.log(self.p)[None, :]) - math.log(2)
        return np.where(np.eye(self.r.count, dtype=bool), -np.inf, half - T / 4)

    def usefulness(self, T: Float[np.ndarray, "*B H H"]) -> Float[np.ndarray, "*B"]:
        """Evidence (...,) that would give the same bound if all pairs had it [nat]."""
        return np.asarray(4 * (self.bound(np.zeros((self.r.count,) * 2)) - self.bound(T)))

    @property
    def needed(self) -> Float[np.ndarray, "H H"]:
        """Entry (h, r): evidence for h against r at which h is decided, if r is its only rival [nat]."""
        error = self.e.settings.error
        return math.log((1 - error) / error) - np.log(self.p[:, None] / self.p[None, :])

    def seconds_until_decided(
        self, T: Float[np.ndarray, "n *B H H"], repeats: Sequence[float]
    ) -> Float[np.ndarray, "*B"]:
        """Expected time [s] until the experiment is decided, averaged over the probabilities of the models.

        If a model is true, the experiment is decided when the evidence for it is large enough against each
        other model.

        Args:
            T: Evidence after each number of repetitions, see `evidence`.
            repeats: The numbers of repetitions, increasing. Evidence is taken as linear between them, and as
                proportional to the number beyond the last.
        """
        need, other = self.needed, ~np.eye(self.r.count, dtype=bool)
        share = np.where(other & (need > 0), T / np.where(need > 0, need, 1.0), 1 / LEAST_SHARE).min(axis=-1)
        share = np.maximum.accumulate(np.maximum(share, LEAST_SHARE), axis=0)
        last = repeats[-1] / np.minimum(share[-1], 1.0)
        n, before, reached = last, (0.0, np.zeros_like(last)), np.zeros(last.shape, bool)
        for k, s in zip(repeats, share, strict=True):
            at = before[0] + (k - before[0]) * (1 - before[1]) / np.maximum(s - before[1], LEAST_SHARE)
            # A decision is noticed only when the recording is evaluated.
            n = np.where(~reached & (s >= 1), np.maximum(at, repeats[0]), n)
            reached |= s >= 1
            before = (k, s)
        return self.e.settings.segment_seconds * np.sum(self.p / self.p.sum() * n, axis=-1)

    # -- choice ------------------------------------------------------------------------------------

    def _standard(self) -> list[StandardInput]:
        """Standard inputs for one segment with new random numbers, and the last design."""
        seed = int(self.rng.integers(2**31))
        found = standard_inputs(
            self.M,
            self.r.Ts,
            self.limits,
            corners=(2.0, 5.0, 15.0, 40.0),
            highs=(6.0, 12.0, 30.0, 80.0),
            lowest=0.5,
            seed=seed,
            start=self.start,
        )
        if self.e.history and self.e.history[-1].input == "design":
            u = self.limits.playable(self.e.runs[-1].u[-self.M :], self.r.Ts, self.start)
            found.append(StandardInput("design", "as the last one", u))
        return found

    def best(self, say: Progress) -> tuple[Segment, str]:
        """The segment that is expected to decide soonest, and the reason if no segment would decide."""
        settings = self.e.settings
        named, U = self._possible()
        left = max(1.0, (settings.max_seconds - self.e.seconds) / settings.segment_seconds)
        repeats = self._amounts(left)
        T, _ = self.evidence(U, repeats, drawn=True)
        order, seconds, worth = self._rated(T, repeats)
        if settings.improve:
            n = float(
                np.clip(seconds[order[0]] / settings.segment_seconds, repeats[0], min(LOOK_AHEAD, left))
            )
            more, designs = self._designs(named, U, order, n, say)
            if more:
                new, _ = self.evidence(designs, repeats, drawn=True)
                named, U, T = named + more, np.concatenate([U, designs]), np.concatenate([T, new], axis=1)
                order, _, worth = self._rated(T, repeats)
        top, ahead = order[0], self._ahead(repeats)
        worst = np.maximum(T[ahead, top].min(axis=1), 0.0)
        segment = Segment(
            rivals=self.r.labels,
            u=U[top],
            Ts=self.r.Ts,
            input=named[top].kind,
            setting=named[top].words,
            nats=worst,
            expected_error=float(min(1.0 - self.e.probabilities.max(), math.exp(self.bound(worst)))),
            probabilities=tuple(self.e.probabilities.tolist()),
            repeats=repeats[ahead],
            peaks=dict(zip(self.r.structure.channels, self.peaks(U[top : top + 1])[0].tolist(), strict=True)),
            table=tuple((named[i].kind, named[i].words, float(worth[i])) for i in order[:LISTED]),
            tried=len(U),
            limits=self.limits,
            outputs=self.outputs(U[top : top + 1])[0, :, 0, : self.M],
            channels=self.r.structure.channels,
            units=self.r.units,
            input_unit=self.r.structure.units.input,
        )
        return segment, self._too_small(T[-1], left, named[top])

    def _possible(self) -> tuple[list[_Named], np.ndarray]:
        """Standard inputs at several levels that keep the limits and move the machine enough.

        Raises:
            InputError: If no input keeps the limits.
        """
        standard = self._standard()
        U, ok = self.within_limits(np.array([s.u for s in standard]))
        if not ok.any():
            raise InputError(
                "The machine is predicted to leave the limits on travel or deflection under the smallest "
                "voltage, which an offset or its motion may do; widen the limits, or bring it to rest first."
            )
        possible = [s for s, good in zip(standard, ok, strict=True) if good]
        named = [_Named(s.kind, s.setting, level) for level in LEVELS for s in possible]
        U = np.concatenate([level * U[ok] for level in LEVELS])
        seen = self.loud(U)
        return [n for n, good in zip(named, seen, strict=True) if good], U[seen]

    def _designs(
        self, named: list[_Named], U: np.ndarray, order: np.ndarray, n: float, say: Progress
    ) -> tuple[list[_Named], np.ndarray]:
        """The best inputs, improved by gradient for `n` repetitions; those that keep the limits."""
        starts = self._distinct(order, named)
        say(f"improving {len(starts)} inputs")
        improved = [self.limits.playable(u, self.r.Ts, self.start) for u in self._improved(U[starts], n)]
        designs, ok = self.within_limits(np.array(improved))
        ok &= self.loud(designs)
        begun = [named[i] for i, good in zip(starts, ok, strict=True) if good]
        return [_Named("design", f"from {b.kind}, {b.setting}", 1.0) for b in begun], designs[ok]

    def _amounts(self, left: float) -> tuple[float, ...]:
        """Numbers of repetitions at which inputs are rated: pieces of the first, then up to the time left."""
        pieces = [k * self.e.piece / self.M for k in range(1, math.ceil(self.M / self.e.piece))]
        more = [1.0]
        while 2 * more[-1] < left:
            more.append(2 * more[-1])
        return tuple(sorted({*pieces, *more, float(min(LOOK_AHEAD, left)), left}))

    def _ahead(self, repeats: tuple[float, ...]) -> int:
        """Index of the number of repetitions at which the worth of an input is computed."""
        return repeats.index(min(LOOK_AHEAD, repeats[-1]))

    def _rated(self, T: np.ndarray, repeats: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Order of the inputs, expected seconds and worth [nat] of each, for the worst of the draws."""
        worst = T.min(axis=3)
        seconds = self.seconds_until_decided(worst, repeats)
        worth = self.usefulness(worst[self._ahead(repeats)])
        return np.lexsort((-worth, seconds)), seconds, worth

    def _distinct(self, order: np.ndarray, named: list[_Named]) -> list[int]:
        """Indices of the best input of each of the best kinds and settings."""
        best: dict[tuple[str, str], int] = {}
        for i in order:
            best.setdefault((named[i].kind, named[i].setting), int(i))
        return list(best.values())[:IMPROVED]

    def _too_small(self, T: np.ndarray, left: float, best: _Named) -> str:
        """Reason why no input would decide in the time that is left; empty if one may.

        The reason holds if, whichever rival is true, some other rival stays possible even with the best
        input, the most favourable parameters and favourable noise.
        """
        p, H, needed = self.p, self.r.count, self.needed
        alive = [h for h in range(H) if p[h] > self.e.settings.error / (10 * H)]
        reached = np.maximum(T.max(axis=(0, 2)), 0.0)
        stuck = {}
        for h in alive:
            lucky = reached[h] + DEVIATIONS * np.sqrt(2 * reached[h])
            others = [r for r in alive if r != h and lucky[r] < needed[h, r]]
            if not others:
                return ""
            stuck[h] = max(others, key=lambda r: p[r])
        if len(alive) < 2:
            return ""
        h = max(alive, key=lambda h: p[h])
        r = stuck[h]
        names, s = self.r.labels, self.e.settings
        gain = max(float(reached[h, r]), float(reached[r, h]))
        return (
            f"No experiment within these limits distinguishes {names[h]} from {names[r]}: after "
            f"{self.e.seconds:g} s on the rig the best of {len(T)} inputs ({best.kind}, {best.words}) "
            f"would bring at most {gain:.2g} nats in the {left * s.segment_seconds:.3g} s that are left, and "
            f"{max(0.0, float(needed[h, r])):.2g} are needed."
        )

    # -- improvement by gradient -------------------------------------------------------------------

    def _value_and_slope(self, X: np.ndarray, n: float) -> tuple[np.ndarray, np.ndarray]:
        """Logarithm of the usefulness less penalties of peaks, and its gradient per unit of the limit."""
        r, H, S, Ts = self.r, self.r.count, len(X), self.r.Ts
        voltage = self.limits.voltage
        played = [self.limits.playable_with_sources(voltage * x, Ts, self.start) for x in X]
        U = np.array([u for u, _, _ in played])
        T, details = self.evidence(U, (n,), drawn=False, shift=True)
        T = T[0, :, :, 0]
        useful = np.maximum(self.usefulness(T), 1e-12)
        terms = self._terms(T)
        share = np.exp(terms - terms.max(axis=(1, 2), keepdims=True))
        share /= share.sum(axis=(1, 2), keepdims=True)
        root, C, bound = math.sqrt(self.e.scale), len(self.pose), self.limits.outputs(len(self.pose))
        value, W = np.log(useful), self.before + self.M + self.after
        rows: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]] = []
        finite = np.isfinite(bound)
        for s in range(S):
            own = np.zeros((H, W, C))
            for h in range(H):
                y = details[s]["outputs"][h] - self.pose
                excess = np.log(np.maximum(np.max(np.abs(y), axis=0) / bound, 1e-12))
                penalty, steepness = peak_penalty(np.where(finite, excess, 0.0))
                value[s] -= float(np.sum(penalty))
                own[h, self.before : self.before + self.M] -= steepness * peak_slope(y)
                for other in range(H):
                    if other == h:
                        continue
                    left, d = details[s][h, other]
                    back = r.whitened(other, left, adjoint=True) / root
                    back = n * share[s, h, other] / useful[s] * back
                    own[h, self.before : self.before + self.M] += back
                    weight = np.zeros((W, C))
                    weight[self.before : self.before + self.M] = -back
                    rows.append((s, *self._moved(other, d), weight))
                rows.append((s, h, self.values[h], self.x0[h], own[h]))
        which = np.array([row[0] for row in rows])
        start = Start(
            np.array([row[2] for row in rows]),
            r.gates[[row[1] for row in rows]],
            np.array([row[3] for row in rows]),
        )
        g = r.input_slopes(start, self._windows(U)[which], np.array([row[4] for row in rows]))
        g = np.nan_to_num(g[:, self.before : self.before + self.M])
        total = np.zeros((S, self.M))
        np.add.at(total, which, g)
        out = [
            voltage * (np.bincount(low, t, self.M) + np.bincount(high, t, self.M)) / 2
            for t, (_, low, high) in zip(total, played, strict=True)
        ]
        return value, np.array(out)

    def _moved(self, h: int, d: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """A rival with shifted unknowns: its number, values and first state."""
        m, o = len(self.r.free[h]), len(self.r.own)
        if np.any(np.abs(d[: m + o]) > LARGEST_SHIFT):
            d = np.zeros_like(d)
        machine, own = self.nominal[h]
        values = self.r.values_and_slopes(h, machine + d[:m], own + d[m : m + o])[0]
        return h, values, self.x0[h] + self.dx0[h][: len(d)].T @ d

    def _improved(self, U: np.ndarray, n: float) -> np.ndarray:
        """Inputs after gradient ascent, several at once; a gain lengthens the step, otherwise it is cut."""
        x = np.clip(U / self.limits.voltage, -1.0, 1.0)
        value, g = self._value_and_slope(x, n)
        way, step = g.copy(), np.full(len(x), FIRST_ASCENT_STEP)
        for _ in range(LOOKS):
            size = np.sqrt(np.mean(way**2, axis=1))
            if not np.any((step > SMALLEST_ASCENT_STEP) & (size > 0)):
                break
            trial = np.clip(x + (step / np.maximum(size, 1e-300))[:, None] * way, -1.0, 1.0)
            new, slope = self._value_and_slope(trial, n)
            better = new > value
            ratio = np.linalg.norm(slope, axis=1) / np.maximum(np.linalg.norm(way, axis=1), 1e-300)
            way = np.where(better[:, None], MOMENTUM * ratio[:, None] * way + slope, way)
            x, value = np.where(better[:, None], trial, x), np.where(better, new, value)
            step = np.where(better, np.minimum(1.6 * step, LONGEST_ASCENT_STEP), step / 4)
        return self.limits.voltage * x
