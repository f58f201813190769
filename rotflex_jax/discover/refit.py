"""Maximum-likelihood refits of hypotheses, several at once: parameters, first states, process noise."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.lanes import Bench
from rotflex_jax.discover.whiten import fit_whitener, log_likelihood
from rotflex_jax.mechanism import kalman_gains
from rotflex_jax.mechanism.assembly import Layout

# Levenberg-Marquardt stops on this decrease of the negative log-likelihood [nat]; a relative tolerance
# leaves tens of nats on a long recording and makes false discoveries.
NATS = 0.3
# Largest step of an unconstrained coordinate: a factor e of a positive parameter.
LONGEST = 1.0
# Turns of a refit beyond the usual number, and what such a turn has to gain [nat].
MORE, MUCH = 5, 10.0
# Largest process torque, as a share of the intensity that a torque as large as the motor's, drawn anew
# at each sample, would have.
HORIZON = 1e-3


@dataclasses.dataclass(frozen=True)
class Judge:
    """The recordings that parameters are fitted to, and what scales the comparison.

    Attributes:
        bench: Training recordings.
        noise: Deviation of the sensor noise per channel (C,).
        torque: Torque [N m] that moves the machine, scale of process torques.
        ports: Ports at which process torques act.
    """

    bench: Bench
    noise: np.ndarray
    torque: float
    ports: tuple[str, ...]

    def directions(self) -> int:
        """Directions per slope pass: enough for a few effects on top of the baseline."""
        s = self.bench.supermodel
        most = len(s.baseline_free) + len(s.local) + 2 * len(s.baseline.coordinates) + 4
        return -(-most // 4) * 4

    @property
    def horizon(self) -> tuple[float, float]:
        """Least and largest intensity of process torques that is tried [(N m)^2 s].

        The least is a free run in all but name. The largest keeps the memory of the predictor long
        against the sampling period: a predictor that forgets within a few samples follows any motion
        and no longer tells one model from another, whatever its likelihood.
        """
        unit = self.torque**2 * float(self.bench.data.Ts[0])
        return 1e-9 * unit, HORIZON * unit

    def with_process_noise(self, h: Hypothesis, intensity: dict[str, float]) -> Hypothesis:
        """The hypothesis with gains for another process noise."""
        K = self.gains(h, [intensity])[0]
        return dataclasses.replace(h, K=K, process_noise=intensity)

    def gains(self, h: Hypothesis, intensities: Sequence[dict[str, float]]) -> list[np.ndarray]:
        """Gains (R, n, C) of the baseline's linear part, one per intensity."""
        s, data = self.bench.supermodel, self.bench.data
        values = h.values(self.bench).mean(axis=0)
        mechanism = s.clean(values, ())
        by_period = {Ts: kalman_gains(mechanism, intensities, self.noise, Ts) for Ts in set(data.Ts.tolist())}
        K = np.stack([by_period[Ts] for Ts in data.Ts.tolist()], axis=1)
        full = np.zeros((*K.shape[:2], Layout.of(s.mechanism.structure).size, K.shape[3]))
        full[:, :, s.baseline_states] = K
        return list(full)

    def likelihood(self, e: np.ndarray) -> float:
        """Log-likelihood of innovations (R, N, C) under the whitener that they give [nat].

        Minus infinity where a run diverges.
        """
        return log_likelihood(e, self.bench.data.seen, self.noise) if np.all(np.isfinite(e)) else -np.inf

    def judged(self, h: Hypothesis, e: np.ndarray) -> Hypothesis:
        """The hypothesis with the whitener and likelihood that its innovations (R, N, C) give."""
        seen = self.bench.data.seen
        whitener = fit_whitener(e, seen, self.noise)
        return dataclasses.replace(h, whitener=whitener, densities=whitener.log_densities(e, seen))


def whitened_sums(h: Hypothesis, w: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`J'J` and `J'w` of whitened innovations (R, N, C) and slopes (D, R, N, C).

    Directions of local parameters and first states belong to one recording each, so they open a block
    per recording.
    """
    shared, R = len(h.free), w.shape[0]
    each = h.moved - shared
    size = shared + R * each
    H, g = np.zeros((size, size)), np.zeros(size)
    for r in range(R):
        J = W[: h.moved, r].reshape(h.moved, -1)
        G, b = J @ J.T, J @ w[r].ravel()
        where = np.r_[:shared, shared + r * each : shared + (r + 1) * each]
        H[np.ix_(where, where)] += G
        g[where] += b
    return H, g


def moved(h: Hypothesis, step: np.ndarray) -> Hypothesis:
    """The hypothesis after a step in its coordinates."""
    shared, local = len(h.free), len(h.local)
    z = h.z.copy()
    z[list(h.free)] += np.clip(step[:shared], -LONGEST, LONGEST)
    rest = step[shared:].reshape(len(h.x0), -1)
    own = h.own + np.clip(rest[:, :local], -LONGEST, LONGEST)
    return dataclasses.replace(h, z=z, own=own, x0=h.x0 + rest[:, local:])


def levenberg_marquardt(judge: Judge, hypotheses: list[Hypothesis], steps: int = 8) -> list[Hypothesis]:
    """Fit all hypotheses, whiteners and process noise held; returns them with new whiteners."""
    bench, seen = judge.bench, judge.bench.data.seen
    count = max(judge.directions(), max(h.moved for h in hypotheses))
    now = list(hypotheses)
    damping = np.full(len(now), 1e-4)
    active = list(range(len(now)))
    innovations: list[np.ndarray] = [np.empty(0)] * len(now)
    for _ in range(steps):
        if not active:
            break
        lanes = [now[i].lane(bench) for i in active]
        e, J = bench.slopes(lanes, [now[i].directions(bench, count) for i in active])
        waiting: dict[int, tuple[np.ndarray, np.ndarray, float]] = {}
        for k, i in enumerate(active):
            innovations[i] = e[k]
            h = now[i]
            w, W = h.whitener(e[k], seen), h.whitener(J[k, : h.moved], seen)
            waiting[i] = (*whitened_sums(h, w, W), 0.5 * float(np.sum(w**2)))
        still = []
        for _ in range(5):  # shorter and shorter steps until the cost falls
            trials = {i: moved(now[i], _step(H, g, damping[i])) for i, (H, g, _) in waiting.items()}
            if not trials:
                break
            order = list(trials)
            tried = bench.innovations([trials[i].lane(bench) for i in order])
            for i, e_new in zip(order, tried, strict=True):
                cost = 0.5 * float(np.sum(now[i].whitener(e_new, seen) ** 2))
                gain = waiting[i][2] - cost
                if gain > 0:
                    now[i], innovations[i] = trials[i], e_new
                    damping[i] = max(damping[i] / 10, 1e-9)
                    if gain > NATS:
                        still.append(i)
                    del waiting[i]
                else:
                    damping[i] = damping[i] * 20 if np.isfinite(cost) else damping[i] * 1e3
        active = still
    return [judge.judged(h, e) for h, e in zip(now, innovations, strict=True)]


def _step(H: np.ndarray, g: np.ndarray, damping: float) -> np.ndarray:
    D = np.diag(H)
    scale = 1 / np.sqrt(np.maximum(D, 1e-12 * max(float(D.max()), 1e-300)))
    A = H * np.outer(scale, scale)
    try:
        return -scale * np.linalg.solve(A + (damping + 1e-12) * np.eye(len(A)), scale * g)
    except np.linalg.LinAlgError:
        return -scale * np.linalg.lstsq(A, scale * g, rcond=1e-10)[0]


def _grid(center: dict[str, float], factors: Sequence[float] | np.ndarray) -> list[dict[str, float]]:
    """All combinations of factors on two axes; on more, one axis at a time."""
    ports = list(center)
    if len(ports) <= 2:
        mesh = np.stack(np.meshgrid(*[factors] * len(ports), indexing="ij"), -1).reshape(-1, len(ports))
    else:
        mesh = np.array(
            [[f if i == j else 1.0 for j in range(len(ports))] for i in range(len(ports)) for f in factors]
        )
    return [{p: center[p] * f for p, f in zip(ports, row, strict=True)} for row in mesh]


def choose_process_noise(judge: Judge, h: Hypothesis, wide: bool = False) -> Hypothesis:
    """The process noise under which the innovations are likeliest, within `judge.horizon`.

    Zero is a free run, a large intensity follows the data within a few samples. Where the model is right
    it falls to the smallest value of the grid by itself; where it does not, something is missing.
    """
    least, most = judge.horizon
    tried: list[dict[str, float]] = []
    if wide:
        levels = np.geomspace(least, most, 4) / most
        h = _likeliest(judge, h, _grid(dict.fromkeys(judge.ports, most), levels), tried)
    for factor in (10.0, 10**0.5):
        trials = _grid(h.process_noise, (1 / factor, 1.0, factor))
        trials = [{p: min(max(v, least), most) for p, v in t.items()} for t in trials]
        h = _likeliest(judge, h, trials, tried)
    return h


def _likeliest(
    judge: Judge, h: Hypothesis, trials: list[dict[str, float]], tried: list[dict[str, float]]
) -> Hypothesis:
    """The likeliest process noise; `h` has that of the ones tried before, none of which is run again."""
    new = [t for k, t in enumerate(trials) if t not in (*trials[:k], *tried)]
    if not new:
        return h
    gains, lane = judge.gains(h, new), h.lane(judge.bench)
    es = judge.bench.innovations([lane._replace(K=K) for K in gains])
    likelihoods = [judge.likelihood(e) for e in es]
    best, first = int(np.argmax(likelihoods)), not tried
    tried += new
    if not first and likelihoods[best] <= h.log_likelihood:
        return h
    return judge.judged(dataclasses.replace(h, K=gains[best], process_noise=new[best]), es[best])


def refit(judge: Judge, hypotheses: list[Hypothesis], wide: bool = False, turns: int = 3) -> list[Hypothesis]:
    """Alternate parameters and process noise until the likelihood settles.

    A little is left after so many turns; what still gains much goes on, `MORE` turns at most: stopped on
    its way, the right effect may look worse than a wrong one that has arrived.
    """
    now = levenberg_marquardt(judge, hypotheses)
    settled = [False] * len(now)
    for turn in range(turns + MORE if turns else 0):
        moving = [i for i in range(len(now)) if not settled[i]]
        if not moving:
            break
        chosen = [choose_process_noise(judge, now[i], wide and turn == 0) for i in moving]
        new = levenberg_marquardt(judge, chosen)
        for i, h in zip(moving, new, strict=True):
            gain = h.log_likelihood - now[i].log_likelihood
            # The whitener may trade a little likelihood between turns; keep the better of the two.
            now[i] = h if gain > 0 else now[i]
            settled[i] = gain < (1.0 if turn + 1 < turns else MUCH)
    return now
