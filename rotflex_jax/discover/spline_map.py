"""Fits of spline maps of a torque through the simulator, orthogonal to the physics, and formulas for them."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator

import numpy as np
import scipy
from jaxtyping import Float, Int, Real

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem, choose_process_noise, in_blocks
from rotflex_jax.effects.learned import LearnedTorque
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, after_trial, begin

# Steps with one process noise end when a step lowers the penalised cost by less than this [nat].
MIN_STEP_NATS = 0.3
MAP_RULES = Rules(damping=1e-6, least=1e-9, increase=20)
# Largest number of trial steps from one linearisation.
TRIALS_PER_STEP = 6
# Largest number of steps with one process noise, and number of rounds, each with another process noise.
STEPS_PER_NOISE, NOISE_CHOICES = 6, 3
# Largest smoothness, and smoothness beyond which a map counts as flat, as multiples of the smallest one,
# which allows weights as large as the torque of the motor.
MAX_SMOOTHNESS, FLAT_SMOOTHNESS = 1e7, 1e6


@dataclasses.dataclass(frozen=True)
class MapEquations:
    """Normal equations of a fit with a map, in unconstrained coordinates.

    Attributes:
        H: Curvature of half the sum of squared whitened innovations.
        g: Gradient of half the sum of squared whitened innovations.
        rest: Indices of coordinates other than the weights of the map: physics, offsets, first states.
        physics: Indices of the coordinates of the physics alone.
        weights: Indices of the weights of the map.
        cost: Half the sum of squared whitened innovations.
        excess: Variance of the gradient over its variance for independent innovations (mean over the
            weights), at least 1.
    """

    H: Float[np.ndarray, "M M"]
    g: Float[np.ndarray, " M"]
    rest: Int[np.ndarray, " A"]
    physics: Int[np.ndarray, " B"]
    weights: Int[np.ndarray, " W"]
    cost: float
    excess: float

    def projected(self) -> tuple[Float[np.ndarray, "W W"], Float[np.ndarray, " W"]]:
        """Curvature and gradient along the weights, with all other coordinates at their optimum."""
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
    # Neighbouring samples are correlated: gradients of the likelihood count as independent between blocks.
    blocks = [in_blocks(slopes, problem.dataset.data) for slopes in np.sum(W[own] * w[None], axis=-1)]
    scatter = np.sum(np.square(blocks), axis=1) / np.maximum(np.diag(H)[own], 1e-300)
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
    """Matrix that gives the differences of neighbouring weights along the position."""
    return np.kron(np.diff(np.eye(effect.count[0]), axis=0), np.eye(effect.count[1]))


def penalties(effect: LearnedTorque) -> list[Float[np.ndarray, "W W"]]:
    """Penalty matrices of squared differences along position and along speed, and of squared weights.

    They use first differences, since a torque may jump: neighbouring weights may differ where friction
    reverses.
    """
    across = np.kron(np.eye(effect.count[0]), np.diff(np.eye(effect.count[1]), axis=0))
    whole = np.eye(effect.count[0] * effect.count[1])
    return [D.T @ D for D in (position_differences(effect), across, whole) if len(D)]


@dataclasses.dataclass(frozen=True)
class FittedMap:
    """A fitted map.

    Attributes:
        hypothesis: The hypothesis with the weights of the map among its free parameters.
        covariance: Covariance of the weights in unconstrained coordinates, with everything else free.
        flat: Whether the map hardly depends on the position, by its smoothness.
        equations: Normal equations at the fit.
    """

    hypothesis: Hypothesis
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
    """Fit a map to the innovations with a smoothness penalty, whose weights maximise the marginal likelihood.

    Damped Gauss-Newton steps alternate with updates of the smoothness and of the process noise.

    The map is orthogonal to `excluded`, the torques that the physics of the model can give at the port. A
    torque proportional to the speed, for example, belongs to the damper. So the parameters of the physics
    stay unique.

    Args:
        problem: Likelihood of the training recordings.
        h: The model without the map, at its optimum.
        effect: The map, which gives the number of splines.
        weights: Indices of its weights in the super-model's values.
        excluded: Combinations of the weights (in columns) that stay zero.
        size: Size of a large weight [in unconstrained coordinates].

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
    """Smoothness of larger marginal likelihood, by repeated updates of Fellner and Schall."""
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
    """One step that lowers the penalised cost: the new hypothesis, the decrease of the cost, the damping."""
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
    limit[np.searchsorted(rest, equations.physics)] = problem.step_limits(h)[equations.physics]
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


# Largest number of terms of a formula, least share that the last term must explain, and penalty for its
# coefficient [nat].
MAX_TERMS, MIN_TERM_SHARE, TERM_NATS = 4, 0.02, 10.0
# A term is not tried if the share of its effect that the physics cannot imitate is no larger than this.
MIN_OWN_SHARE = 1e-3
# Largest number of samples at which terms are approximated by splines.
COMPARED_SAMPLES = 5000

TermFunction = Callable[[Float[np.ndarray, "..."], Float[np.ndarray, "..."], float], Float[np.ndarray, "..."]]

# Term -> what the unit of its coefficient has after N m, and its function of position `q` [rad], speed `w`
# [rad/s] and, for some terms, a parameter `n`.
FUNCTIONS: dict[str, tuple[str, TermFunction]] = {
    "1": ("", lambda q, w, n: np.ones_like(q)),
    "q": ("/rad", lambda q, w, n: q),
    "q^2": ("/rad^2", lambda q, w, n: q**2),
    "q^3": ("/rad^3", lambda q, w, n: q**3),
    "w": (" s/rad", lambda q, w, n: w),
    "|w|": (" s/rad", lambda q, w, n: np.abs(w)),
    "w |w|": (" s^2/rad^2", lambda q, w, n: w * np.abs(w)),
    "w^3": (" s^3/rad^3", lambda q, w, n: w**3),
    "sign(w)": ("", lambda q, w, n: np.sign(w)),
    "exp(-|w|/{n:.2g}) sign(w)": ("", lambda q, w, n: np.exp(-np.abs(w) / n) * np.sign(w)),
    "sin({n:g} q)": ("", lambda q, w, n: np.sin(n * q)),
    "cos({n:g} q)": ("", lambda q, w, n: np.cos(n * q)),
    "sin({n:g} q) sign(w)": ("", lambda q, w, n: np.sin(n * q) * np.sign(w)),
    "cos({n:g} q) sign(w)": ("", lambda q, w, n: np.cos(n * q) * np.sign(w)),
}


@dataclasses.dataclass(frozen=True)
class Term:
    """One term of a formula.

    Attributes:
        function: Key of `FUNCTIONS`.
        n: Parameter of the function: a speed [rad/s], or waves per turn; 0 where there is none.
        coefficient: Coefficient [`unit`].
        std: Standard deviation of the coefficient.
        share: Share that this term adds of what the map explains.
    """

    function: str
    n: float
    coefficient: float = 1.0
    std: float = 0.0
    share: float = 0.0

    @property
    def name(self) -> str:
        """As written in a formula."""
        return self.function.format(n=self.n)

    @property
    def unit(self) -> str:
        """Unit of the coefficient."""
        return "N m" + FUNCTIONS[self.function][0]

    def __call__(
        self, position: Real[np.ndarray, "..."], speed: Real[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Torque of the term [N m]."""
        return self.coefficient * FUNCTIONS[self.function][1](position, speed, self.n)

    def __str__(self) -> str:
        return f"{self.coefficient:.3g} {self.name}" if self.function != "1" else f"{self.coefficient:.3g}"


@dataclasses.dataclass(frozen=True)
class Formula:
    """A sum of terms that approximates a learned map.

    Attributes:
        terms: Terms, the one that explains most alone first; empty where no term explains enough.
    """

    terms: tuple[Term, ...]

    @property
    def share(self) -> float:
        """Share that the terms explain together of what the map explains."""
        return sum(t.share for t in self.terms)

    def __call__(
        self, position: Real[np.ndarray, "..."], speed: Real[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Torque of the formula [N m]."""
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        return sum((t(q, w) for t in self.terms), np.zeros(q.shape))

    def __str__(self) -> str:
        return " + ".join(map(str, self.terms)).replace("+ -", "- ") or "0"


def terms_to_try(position: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"]) -> list[Term]:
    """Terms worth trying for these positions and speeds; waves only where the port travels far enough."""
    turning, span = float(np.sqrt(np.mean(speed**2))), float(np.ptp(position))
    waves = [float(n) for n in range(1, 13) if n * span > 2.0]
    out = []
    for function in FUNCTIONS:
        own = [0.1 * turning, 0.2 * turning, 0.4 * turning, 0.8 * turning] if "exp" in function else waves
        out += [Term(function, n) for n in own] if "{n" in function else [Term(function, 0.0)]
    return out


def read_formula(
    fitted: FittedMap,
    effect: LearnedTorque,
    position: Float[np.ndarray, " N"],
    speed: Float[np.ndarray, " N"],
) -> Formula:
    """The formula of a map, found by a search for few terms in the metric of the recordings.

        minimise  (c - D a)' H (c - D a),   H: information on the weights c, with the physics projected out

    A column of `D` has the weights that approximate a term best. In this metric a term that the physics of
    the model can imitate (`w` beside a damper) has size zero, and a rounded step is as good as a sharp step
    if no sample distinguishes them. The coefficients are fitted to the data and not to the smoothed map.

    Args:
        fitted: Fitted map.
        effect: The map with its splines.
        position: Position of the port along the recordings [rad].
        speed: Speed of the port along the recordings [rad/s].

    Source: S. Chen, S. Billings and W. Luo, Int. J. Control 50, 1989 (error reduction); S. Brunton,
    J. Proctor and N. Kutz, PNAS 113, 2016 (formulas from a dictionary).
    """
    pick = np.linspace(0, len(position) - 1, min(COMPARED_SAMPLES, len(position))).astype(int)
    q, w = position[pick], speed[pick]
    Phi = effect.design(q, w) * effect.scale
    H, slope = fitted.equations.projected()
    z = fitted.hypothesis.z[[fitted.hypothesis.free[i] for i in fitted.equations.weights]]
    b = H @ z - slope
    whole = fitted.equations.H[np.ix_(fitted.equations.weights, fitted.equations.weights)]
    ridge = 1e-6 * np.trace(Phi.T @ Phi) / Phi.shape[1] * np.eye(Phi.shape[1])
    terms = terms_to_try(q, w)
    F = np.stack([t(q, w) for t in terms], axis=1)
    D = np.linalg.solve(Phi.T @ Phi + ridge, Phi.T @ F)
    G, r = D.T @ H @ D, D.T @ b
    own = np.diag(G) / np.maximum(np.einsum("ij,ik,kj->j", D, whole, D), 1e-300)
    able = [i for i in range(len(terms)) if own[i] > MIN_OWN_SHARE]
    total = float(b @ fitted.covariance @ b) / fitted.equations.excess
    chosen: list[int] = []
    explained = [0.0]
    for more in _sets(G, r, able):
        value = _explained(G, r, more)
        if value - explained[-1] < max(2 * TERM_NATS * fitted.equations.excess, MIN_TERM_SHARE * total):
            break
        chosen = more
        explained.append(value)
    if not chosen:
        return Formula(())
    inverse = np.linalg.inv(G[np.ix_(chosen, chosen)])
    a, std = inverse @ r[chosen], np.sqrt(fitted.equations.excess * np.diag(inverse))
    shares = np.diff([_explained(G, r, chosen[:k]) for k in range(len(chosen) + 1)]) / total
    return Formula(
        tuple(
            dataclasses.replace(terms[i], coefficient=float(x), std=float(s), share=float(p))
            for i, x, s, p in zip(chosen, a, std, shares, strict=True)
        )
    )


def _sets(G: np.ndarray, r: np.ndarray, able: list[int]) -> Iterator[list[int]]:
    """The best set of one term, of two, of three and so on, with the strongest term of a set first.

    All sets of one and of two terms are tried, since two terms may explain together what neither explains
    alone. Larger sets grow by one term and exchange members as long as that helps.
    """
    value = functools.partial(_explained, G, r)
    best: list[int] = []
    for size in range(1, min(MAX_TERMS, len(able)) + 1):
        if size <= 2:
            best = list(max(itertools.combinations(able, size), key=lambda pick: value(list(pick))))
        else:
            best = max(([*best, i] for i in able if i not in best), key=value)
            for _ in range(size):
                others = [i for i in able if i not in best]
                swaps = ([*best[:k], i, *best[k + 1 :]] for k in range(size) for i in others)
                better = max(swaps, key=value, default=best)
                if value(better) <= value(best) * (1 + 1e-9):
                    break
                best = better
        best = sorted(best, key=lambda i: -value([i]))
        yield best


def _explained(G: np.ndarray, r: np.ndarray, chosen: list[int]) -> float:
    """Twice the log-likelihood that terms explain; 0 if the terms are nearly linearly dependent."""
    if not chosen:
        return 0.0
    own = G[np.ix_(chosen, chosen)]
    size = np.sqrt(np.maximum(np.diag(own), 1e-300))
    if len(chosen) > 1 and np.linalg.eigvalsh(own / np.outer(size, size))[0] < 1e-4:
        return 0.0
    return float(r[chosen] @ np.linalg.solve(own, r[chosen]))
