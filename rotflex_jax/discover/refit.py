"""Maximum-likelihood refits of hypotheses, several at once: parameters, first states, process noise."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.fit.coordinates import FitCoordinates
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise_together

# Levenberg-Marquardt stops on this decrease of the negative log-likelihood [nat]; a relative tolerance
# leaves tens of nats on a long recording and makes false discoveries.
MIN_DECREASE_NATS = 0.3
# A small damping from the start, as a refit starts near its optimum. Refused steps raise it quickly: at 100 a
# step is a hundredth of one down the gradient, and a fit whose cost does not fall along it ends.
REFIT_RULES = Rules(enough=MIN_DECREASE_NATS, damping=1e-4, least=1e-9, increase=20, largest=100)
# Steps tried of each fit.
MAX_STEPS = 12
# Largest step of an unconstrained coordinate: a factor e of a positive parameter.
MAX_COORDINATE_STEP = 1.0
# Alternations of a refit beyond the usual number, and what such a one has to gain [nat].
EXTRA_ALTERNATIONS, EXTRA_ALTERNATION_NATS = 5, 10.0


@dataclasses.dataclass
class _Point:
    """A hypothesis on the way of its fit, with its innovations once it was run."""

    hypothesis: Hypothesis
    innovations: Float[np.ndarray, "R N C"] | None = None

    def whitened(self, e: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Whitened innovations; the innovations are kept."""
        self.innovations = e
        return self.hypothesis.whitener(e, seen)


def levenberg_marquardt(
    problem: LikelihoodProblem, hypotheses: list[Hypothesis], max_steps: int = MAX_STEPS
) -> list[Hypothesis]:
    """Fit all hypotheses with whiteners and process noise held; returns them with new whiteners."""
    seen = problem.seen

    # Slopes come with every trial: most steps are taken, and a run alone is not much cheaper.
    def coordinates(h: Hypothesis) -> FitCoordinates:
        return FitCoordinates.of(h, problem.windows)

    def linearise(points: list[_Point]) -> list[NormalEquations]:
        equations = []
        for p, e, J in zip(points, *problem.slopes([p.hypothesis for p in points]), strict=True):
            h, w = p.hypothesis, p.whitened(e, seen)
            H, g = coordinates(h).sums(w, h.whitener(J[: h.moved], seen))
            equations.append(NormalEquations(np.array([0.5 * np.sum(w**2)]), g, H))
        return equations

    found = minimise_together(
        linearise,
        [_Point(h) for h in hypotheses],
        REFIT_RULES,
        limit=lambda i: coordinates(hypotheses[i]).step_limit(MAX_COORDINATE_STEP),
        move=lambda p, step: _Point(coordinates(p.hypothesis).moved(p.hypothesis, step)),
        max_steps=max_steps,
    )
    return [problem.evaluated(m.x.hypothesis, m.x.innovations) for m in found]


def _grid(
    center: dict[str, float], factors: Sequence[float] | Float[np.ndarray, " F"]
) -> list[dict[str, float]]:
    """All combinations of factors on two axes; on more, one axis at a time."""
    ports = list(center)
    if len(ports) <= 2:
        mesh = np.stack(np.meshgrid(*[factors] * len(ports), indexing="ij"), -1).reshape(-1, len(ports))
    else:
        mesh = np.array(
            [[f if i == j else 1.0 for j in range(len(ports))] for i in range(len(ports)) for f in factors]
        )
    return [{p: center[p] * f for p, f in zip(ports, row, strict=True)} for row in mesh]


def choose_process_noise(problem: LikelihoodProblem, h: Hypothesis, wide: bool = False) -> Hypothesis:
    """The process noise under which the innovations are likeliest, within `process_noise_range`.

    Zero is a free run, a large intensity follows the data within a few samples. Where the model is right, the
    smallest value of the grid is the likeliest; where another one is, something is missing.
    """
    if problem.free_run:
        return h
    least, most = problem.process_noise_range
    tried: list[dict[str, float]] = []
    if wide:
        levels = np.geomspace(least, most, 4) / most
        h = _likeliest(problem, h, _grid(dict.fromkeys(problem.ports, most), levels), tried)
    for factor in (10.0, 10**0.5):
        trials = _grid(h.process_noise, (1 / factor, 1.0, factor))
        trials = [{p: min(max(v, least), most) for p, v in t.items()} for t in trials]
        h = _likeliest(problem, h, trials, tried)
    return h


def _likeliest(
    problem: LikelihoodProblem, h: Hypothesis, trials: list[dict[str, float]], tried: list[dict[str, float]]
) -> Hypothesis:
    """The likeliest process noise; `h` has the best of those tried before, none of which is run again."""
    new = [t for k, t in enumerate(trials) if t not in (*trials[:k], *tried)]
    if not new:
        return h
    gains, parameter_set = problem.gains(h, new), h.parameter_set(problem.supermodel)
    es = problem.innovations_of([parameter_set._replace(K=K) for K in gains])
    likelihoods = [problem.log_likelihood(e) for e in es]
    best, first = int(np.argmax(likelihoods)), not tried
    tried += new
    if not first and likelihoods[best] <= h.log_likelihood:
        return h
    return problem.evaluated(dataclasses.replace(h, K=gains[best], process_noise=new[best]), es[best])


def refit(
    problem: LikelihoodProblem, hypotheses: list[Hypothesis], wide: bool = False, alternations: int = 3
) -> list[Hypothesis]:
    """Alternate parameters and process noise until the likelihood converges.

    After so many alternations little is left to gain. What still gains much goes on for `EXTRA_ALTERNATIONS`
    at most: stopped too early, the right effect may look worse than a wrong one that has converged.
    """
    current = levenberg_marquardt(problem, hypotheses)
    converged = [False] * len(current)
    for k in range(alternations + EXTRA_ALTERNATIONS if alternations else 0):
        moving = [i for i in range(len(current)) if not converged[i]]
        if not moving:
            break
        chosen = [choose_process_noise(problem, current[i], wide and k == 0) for i in moving]
        new = levenberg_marquardt(problem, chosen)
        for i, h in zip(moving, new, strict=True):
            gain = h.log_likelihood - current[i].log_likelihood
            # The whitener may lose a little likelihood between alternations; keep the better of the two.
            current[i] = h if gain > 0 else current[i]
            converged[i] = gain < (1.0 if k + 1 < alternations else EXTRA_ALTERNATION_NATS)
    return current
