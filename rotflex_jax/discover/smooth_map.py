"""Fits a map of splines through the simulator: smooth as far as the data ask, and apart from the physics."""

import dataclasses

import numpy as np
import scipy

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.refit import LONGEST, Judge, choose_process_noise, whitened_sums
from rotflex_jax.effects.learned import LearnedTorque

# A step that lowers the penalised cost by less ends a turn [nat].
NATS = 0.3
# Steps in a turn, and turns, each with a process noise of its own.
STEPS, TURNS = 6, 3
# Neighbouring weights that differ by more than what is large are this many times less likely; no less smooth
# is ever chosen, nor much more than makes a map flat.
STIFFEST, FLAT = 1e7, 1e6
# Samples next to each other tell the same: slopes of the likelihood are independent over such stretches [s].
STRETCH = 0.5


@dataclasses.dataclass(frozen=True)
class Information:
    """What recordings say of the numbers of a fit, as normal equations in unconstrained coordinates.

    Attributes:
        H: Curvature of half the sum of squared whitened innovations.
        g: Its slope.
        rest: Places of all that is no weight of the map: physics, offsets, first states.
        physics: Places of the physics alone.
        weights: Places of the weights.
        cost: Half the sum of squares.
        excess: How many times the slope scatters more than independent innovations would make it.
    """

    H: np.ndarray
    g: np.ndarray
    rest: np.ndarray
    physics: np.ndarray
    weights: np.ndarray
    cost: float
    excess: float

    def projected(self) -> tuple[np.ndarray, np.ndarray]:
        """Curvature and slope along the weights when all the rest follows at its best."""
        solved = np.linalg.lstsq(
            self.H[np.ix_(self.rest, self.rest)],
            np.c_[self.H[np.ix_(self.rest, self.weights)], self.g[self.rest]],
            rcond=1e-12,
        )[0]
        across = self.H[np.ix_(self.weights, self.rest)]
        H = self.H[np.ix_(self.weights, self.weights)] - across @ solved[:, :-1]
        return (H + H.T) / 2, self.g[self.weights] - across @ solved[:, -1]


def information(judge: Judge, h: Hypothesis, weights: list[int]) -> Information:
    """At a hypothesis whose free parameters include the weights of a map."""
    bench, seen = judge.bench, judge.bench.data.seen
    count = max(judge.directions(), h.moved)
    e, J = bench.slopes([h.lane(bench)], [h.directions(bench, count)])
    w, W = h.whitener(e[0], seen), h.whitener(J[0, : h.moved], seen)
    H, g = whitened_sums(h, w, W)
    own = np.array([h.free.index(i) for i in weights])
    rest = np.setdiff1d(np.arange(len(g)), own)
    width = max(round(STRETCH / float(bench.data.Ts[0])), 1)
    edges = np.arange(0, w.shape[1], width)
    stretches = np.add.reduceat(np.sum(W[own] * w[None], axis=-1), edges, axis=-1)
    scatter = np.sum(stretches**2, axis=(1, 2)) / np.maximum(np.diag(H)[own], 1e-300)
    felt = np.diag(H)[own] > 1e-6 * np.diag(H)[own].max()
    return Information(
        H,
        g,
        rest,
        rest[rest < len(h.free)],
        own,
        0.5 * float(np.sum(w**2)),
        max(1.0, float(scatter[felt].mean())),
    )


def steps(effect: LearnedTorque) -> np.ndarray:
    """Differences of neighbouring weights along the position (D, W)."""
    return np.kron(np.diff(np.eye(effect.count[0]), axis=0), np.eye(effect.count[1]))


def penalties(effect: LearnedTorque) -> list[np.ndarray]:
    """Squared differences of neighbours along position and along speed, and squared weights (W, W).

    First differences, because a torque may jump: where friction turns round, weights next to each other
    differ and nothing is wrong.
    """
    across = np.kron(np.eye(effect.count[0]), np.diff(np.eye(effect.count[1]), axis=0))
    whole = np.eye(effect.count[0] * effect.count[1])
    return [D.T @ D for D in (steps(effect), across, whole) if len(D)]


@dataclasses.dataclass(frozen=True)
class Mapped:
    """A fitted map.

    Attributes:
        hypothesis: With its weights among the free parameters.
        basis: Columns: directions of the weights that the physics cannot imitate (W, D).
        covariance: Of the weights in unconstrained coordinates, everything else being free (W, W).
        flat: Whether the recordings ask for no dependence on the position.
        information: At the fit.
    """

    hypothesis: Hypothesis
    basis: np.ndarray
    covariance: np.ndarray
    flat: bool
    information: Information


def fit_map(
    judge: Judge, h: Hypothesis, effect: LearnedTorque, weights: list[int], apart: np.ndarray, size: float
) -> Mapped:
    """Gauss-Newton on innovations and penalty; smoothness by marginal likelihood.

    The map is kept at right angles to `apart`, what the physics of the model gives at its port: a slope over
    the speed is the damper's, so the parameters of the physics stay unique.

    Args:
        judge: With the training recordings.
        h: The model without the map, at its optimum.
        effect: The map, for its shape.
        weights: Places of its weights in the super-model's values.
        apart: Combinations of the weights that stay zero (W, A).
        size: Weight that would be large [in unconstrained coordinates].

    Source: B. Györök et al., arXiv 2501.05842, 2025 (orthogonality); S. Wood and M. Fasiolo, Biometrics 73,
    2017 (smoothness).
    """
    S = penalties(effect)
    loosest = size**-2
    smoothness = np.full(len(S), loosest)
    now = dataclasses.replace(h, free=(*h.free, *weights))
    basis = scipy.linalg.null_space((apart / np.linalg.norm(apart, axis=0)).T, rcond=1e-9)
    for turn in range(TURNS):
        damping = 1e-6
        for _ in range(STEPS):
            found = information(judge, now, weights)
            smoothness = _smoother(found, S, smoothness, basis, now.z[weights], loosest)
            penalty = found.excess * _weighted(S, smoothness)
            now, gain, damping = _step(judge, now, found, penalty, basis, weights, damping)
            if gain < NATS:
                break
        if turn < TURNS - 1:
            now = choose_process_noise(judge, now, wide=turn == 0)
    found = information(judge, now, weights)
    H = basis.T @ (found.projected()[0] / found.excess + _weighted(S, smoothness)) @ basis
    return Mapped(now, basis, basis @ np.linalg.inv(H) @ basis.T, bool(smoothness[0] > FLAT * loosest), found)


def _set(h: Hypothesis, weights: list[int], z: np.ndarray) -> Hypothesis:
    out = h.z.copy()
    out[weights] = z
    return dataclasses.replace(h, z=out)


def _weighted(S: list[np.ndarray], smoothness: np.ndarray) -> np.ndarray:
    return np.einsum("i,ijk->jk", smoothness, np.array(S))


def _smoother(
    found: Information,
    S: list[np.ndarray],
    smoothness: np.ndarray,
    basis: np.ndarray,
    z: np.ndarray,
    loosest: float,
) -> np.ndarray:
    """Smoothness of larger marginal likelihood (the update of Fellner and Schall, some times over)."""
    H, g = found.projected()
    H, g = basis.T @ H @ basis / found.excess, basis.T @ (H @ z - g) / found.excess
    S = [basis.T @ s @ basis for s in S]
    for _ in range(30):
        penalty = _weighted(S, smoothness)
        V = np.linalg.inv(H + penalty)
        c, prior = V @ g, np.linalg.inv(penalty)
        free = np.array([np.sum((prior - V) * s) for s in S])
        used = np.array([c @ s @ c for s in S])
        ratio = np.clip(np.maximum(free, 1e-12) / np.maximum(used, 1e-12), 0.1, 10.0)
        new = np.clip(smoothness * ratio, loosest, STIFFEST * loosest)
        if np.allclose(np.log(new), np.log(smoothness), atol=0.02):
            break
        smoothness = new
    return smoothness


def _step(
    judge: Judge,
    h: Hypothesis,
    found: Information,
    penalty: np.ndarray,
    basis: np.ndarray,
    weights: list[int],
    damping: float,
) -> tuple[Hypothesis, float, float]:
    """One step, shortened until the penalised cost falls; the hypothesis, what was gained, the damping."""
    bench, seen, rest, own = judge.bench, judge.bench.data.seen, found.rest, found.weights
    turn = np.zeros((len(found.g), len(rest) + basis.shape[1]))
    turn[rest, np.arange(len(rest))] = 1.0
    turn[np.ix_(own, len(rest) + np.arange(basis.shape[1]))] = basis
    H, g, z = found.H.copy(), found.g.copy(), h.z[weights]
    H[np.ix_(own, own)] += penalty
    g[own] += penalty @ z
    H, g = turn.T @ H @ turn, turn.T @ g
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12 * np.diag(H).max()))
    before = found.cost + 0.5 * float(z @ penalty @ z)
    for _ in range(6):
        A = H * np.outer(scale, scale) + (damping + 1e-12) * np.eye(len(g))
        step = turn @ (-scale * np.linalg.solve(A, scale * g))
        # Outputs are linear in the weights but not in the physics: a long step of that shortens all.
        step *= min(1.0, LONGEST / max(float(np.abs(step[found.physics]).max(initial=0.0)), 1e-12))
        tried = _stepped(h, step)
        e = bench.innovations([tried.lane(bench)])[0]
        new = tried.z[weights]
        cost = 0.5 * float(np.sum(h.whitener(e, seen) ** 2)) + 0.5 * float(new @ penalty @ new)
        if cost < before:
            return judge.judged(tried, e), before - cost, max(damping / 10, 1e-9)
        damping = 20 * max(damping, 1e-6)
    return h, 0.0, damping


def _stepped(h: Hypothesis, step: np.ndarray) -> Hypothesis:
    """The hypothesis after a step in its coordinates."""
    shared, local = len(h.free), len(h.local)
    z = h.z.copy()
    z[list(h.free)] += step[:shared]
    rest = step[shared:].reshape(len(h.x0), -1)
    return dataclasses.replace(h, z=z, own=h.own + rest[:, :local], x0=h.x0 + rest[:, local:])
