"""Fits a map of splines through the simulator, as smooth as the data ask and orthogonal to the physics."""

import dataclasses

import numpy as np
import scipy
from jaxtyping import Float, Int

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.refit import MAX_COORDINATE_STEP, choose_process_noise
from rotflex_jax.effects.learned import LearnedTorque
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, after_trial, begin

# A step that lowers the penalised cost by less is the last with its process noise [nat].
MIN_STEP_NATS = 0.3
MAP_RULES = Rules(damping=1e-6, least=1e-9, increase=20)
# Steps tried from one linearisation.
TRIALS_PER_STEP = 6
# Steps with one process noise, and how often it is chosen.
STEPS_PER_NOISE, NOISE_CHOICES = 6, 3
# Largest smoothness, and the one beyond which a map is flat, as multiples of the smallest (weights as large
# as the torque of the motor).
MAX_SMOOTHNESS, FLAT_SMOOTHNESS = 1e7, 1e6
# Neighbouring samples are correlated: slopes of the likelihood are independent over such stretches [s].
INDEPENDENT_SECONDS = 0.5


@dataclasses.dataclass(frozen=True)
class MapEquations:
    """Normal equations of a fit with a map, in unconstrained coordinates.

    Attributes:
        H: Curvature of half the sum of squared whitened innovations.
        g: Its slope.
        rest: Coordinates that are no weight of the map: physics, offsets, first states.
        physics: Those of the physics alone.
        weights: Those of the weights.
        cost: Half the sum of squares.
        excess: How many times the slope scatters more than independent innovations would make it.
    """

    H: Float[np.ndarray, "M M"]
    g: Float[np.ndarray, " M"]
    rest: Int[np.ndarray, " A"]
    physics: Int[np.ndarray, " B"]
    weights: Int[np.ndarray, " W"]
    cost: float
    excess: float

    def projected(self) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, " W"]]:
        """Curvature and slope along the weights with all other coordinates at their optimum."""
        solved = np.linalg.lstsq(
            self.H[np.ix_(self.rest, self.rest)],
            np.c_[self.H[np.ix_(self.rest, self.weights)], self.g[self.rest]],
            rcond=1e-12,
        )[0]
        across = self.H[np.ix_(self.weights, self.rest)]
        H = self.H[np.ix_(self.weights, self.weights)] - across @ solved[:, :-1]
        return (H + H.T) / 2, self.g[self.weights] - across @ solved[:, -1]


def map_equations(problem: LikelihoodProblem, h: Hypothesis, weights: list[int]) -> MapEquations:
    """Normal equations at a hypothesis whose free parameters include the weights of a map."""
    seen = problem.seen
    e, J = problem.slopes([h])
    w, W = h.whitener(e[0], seen), h.whitener(J[0, : h.moved], seen)
    H, g = FitCoordinates.of(h, problem.windows).sums(w, W)
    own = np.array([h.free.index(i) for i in weights])
    rest = np.setdiff1d(np.arange(len(g)), own)
    width = max(round(INDEPENDENT_SECONDS / float(problem.dataset.data.Ts[0])), 1)
    edges = np.arange(0, w.shape[1], width)
    stretches = np.add.reduceat(np.sum(W[own] * w[None], axis=-1), edges, axis=-1)
    scatter = np.sum(stretches**2, axis=(1, 2)) / np.maximum(np.diag(H)[own], 1e-300)
    observed = np.diag(H)[own] > 1e-6 * np.diag(H)[own].max()
    return MapEquations(
        H,
        g,
        rest,
        rest[rest < len(h.free)],
        own,
        0.5 * float(np.sum(w**2)),
        max(1.0, float(scatter[observed].mean())),
    )


def position_differences(effect: LearnedTorque) -> Float[np.ndarray, "D W"]:
    """Differences of neighbouring weights along the position."""
    return np.kron(np.diff(np.eye(effect.count[0]), axis=0), np.eye(effect.count[1]))


def penalties(effect: LearnedTorque) -> list[Float[np.ndarray, "W W"]]:
    """Squared differences of neighbours along position and along speed, and squared weights.

    First differences, because a torque may jump: where friction reverses, neighbouring weights may differ.
    """
    across = np.kron(np.eye(effect.count[0]), np.diff(np.eye(effect.count[1]), axis=0))
    whole = np.eye(effect.count[0] * effect.count[1])
    return [D.T @ D for D in (position_differences(effect), across, whole) if len(D)]


@dataclasses.dataclass(frozen=True)
class FittedMap:
    """A fitted map.

    Attributes:
        hypothesis: With its weights among the free parameters.
        basis: Columns: directions of the weights that the physics cannot imitate.
        covariance: Of the weights in unconstrained coordinates, everything else being free.
        flat: Whether the recordings ask for no dependence on the position.
        equations: At the fit.
    """

    hypothesis: Hypothesis
    basis: Float[np.ndarray, "W D"]
    covariance: Float[np.ndarray, "W W"]
    flat: bool
    equations: MapEquations


def fit_map(
    problem: LikelihoodProblem,
    h: Hypothesis,
    effect: LearnedTorque,
    weights: list[int],
    excluded: Float[np.ndarray, "W A"],
    size: float,
) -> FittedMap:
    """Gauss-Newton on innovations and penalty; smoothness by marginal likelihood.

    The map is kept orthogonal to `excluded`, what the physics of the model gives at its port: a slope over
    the speed is the damper's, so the parameters of the physics stay unique.

    Args:
        problem: With the training recordings.
        h: The model without the map, at its optimum.
        effect: The map, for its shape.
        weights: Indices of its weights in the super-model's values.
        excluded: Combinations of the weights that stay zero.
        size: Weight that would be large [in unconstrained coordinates].

    Source: B. Györök et al., arXiv 2501.05842, 2025 (orthogonality); S. Wood and M. Fasiolo, Biometrics 73,
    2017 (smoothness).
    """
    S = penalties(effect)
    loosest = size**-2
    smoothness = np.full(len(S), loosest)
    current = dataclasses.replace(h, free=(*h.free, *weights))
    basis = scipy.linalg.null_space((excluded / np.linalg.norm(excluded, axis=0)).T, rcond=1e-9)
    for k in range(NOISE_CHOICES):
        damping = MAP_RULES.damping
        for _ in range(STEPS_PER_NOISE):
            equations = map_equations(problem, current, weights)
            smoothness = _smoother(equations, S, smoothness, basis, current.z[weights], loosest)
            penalty = equations.excess * _weighted(S, smoothness)
            current, gain, damping = _step(problem, current, equations, penalty, basis, weights, damping)
            if gain < MIN_STEP_NATS:
                break
        if k < NOISE_CHOICES - 1:
            current = choose_process_noise(problem, current, wide=k == 0)
    equations = map_equations(problem, current, weights)
    H = basis.T @ (equations.projected()[0] / equations.excess + _weighted(S, smoothness)) @ basis
    return FittedMap(
        current,
        basis,
        basis @ np.linalg.inv(H) @ basis.T,
        bool(smoothness[0] > FLAT_SMOOTHNESS * loosest),
        equations,
    )


def _weighted(S: list[np.ndarray], smoothness: np.ndarray) -> np.ndarray:
    return np.einsum("i,ijk->jk", smoothness, np.array(S))


def _smoother(
    equations: MapEquations,
    S: list[np.ndarray],
    smoothness: np.ndarray,
    basis: np.ndarray,
    z: np.ndarray,
    loosest: float,
) -> np.ndarray:
    """Smoothness of larger marginal likelihood (the update of Fellner and Schall, repeated)."""
    H, g = equations.projected()
    H, g = basis.T @ H @ basis / equations.excess, basis.T @ (H @ z - g) / equations.excess
    S = [basis.T @ s @ basis for s in S]
    for _ in range(30):
        penalty = _weighted(S, smoothness)
        V = np.linalg.inv(H + penalty)
        c, prior = V @ g, np.linalg.inv(penalty)
        free = np.array([np.sum((prior - V) * s) for s in S])
        used = np.array([c @ s @ c for s in S])
        ratio = np.clip(np.maximum(free, 1e-12) / np.maximum(used, 1e-12), 0.1, 10.0)
        new = np.clip(smoothness * ratio, loosest, MAX_SMOOTHNESS * loosest)
        if np.allclose(np.log(new), np.log(smoothness), atol=0.02):
            break
        smoothness = new
    return smoothness


def _step(
    problem: LikelihoodProblem,
    h: Hypothesis,
    equations: MapEquations,
    penalty: np.ndarray,
    basis: np.ndarray,
    weights: list[int],
    damping: float,
) -> tuple[Hypothesis, float, float]:
    """One step that lowers the penalised cost; the hypothesis, what was gained, the damping."""
    seen, rest, own = problem.seen, equations.rest, equations.weights
    free = np.zeros((len(equations.g), len(rest) + basis.shape[1]))
    free[rest, np.arange(len(rest))] = 1.0
    free[np.ix_(own, len(rest) + np.arange(basis.shape[1]))] = basis
    H, g, z = equations.H.copy(), equations.g.copy(), h.z[weights]
    H[np.ix_(own, own)] += penalty
    g[own] += penalty @ z
    before = equations.cost + 0.5 * float(z @ penalty @ z)
    penalised = NormalEquations(np.array([before]), free.T @ g, free.T @ H @ free)
    # Outputs are linear in the weights but not in the physics.
    limit = np.full(free.shape[1], np.inf)
    limit[np.searchsorted(rest, equations.physics)] = MAX_COORDINATE_STEP
    progress = begin(before, MAP_RULES._replace(damping=damping))
    for _ in range(TRIALS_PER_STEP):
        step, _ = penalised.step(float(progress.damping), limit)
        tried = FitCoordinates.of(h, problem.windows).moved(h, free @ step)
        e = problem.innovations([tried])[0]
        new = tried.z[weights]
        cost = 0.5 * float(np.sum(h.whitener(e, seen) ** 2)) + 0.5 * float(new @ penalty @ new)
        progress, accepted = after_trial(progress, cost, MAP_RULES)
        if accepted:
            return problem.evaluated(tried, e), before - cost, float(progress.damping)
    return h, 0.0, float(progress.damping)
