"""Reads a learned map as a formula: a few physical terms that explain the recordings as well."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.discover.spline_map import FittedMap
from rotflex_jax.effects.learned import LearnedTorque

# Most terms of a formula, the share that the last of them must explain, and what its coefficient costs [nat].
MAX_TERMS, MIN_TERM_SHARE, TERM_NATS = 4, 0.02, 10.0
# A term of whose trace less than this share is left beside the physics explains nothing of its own.
MIN_OWN_SHARE = 1e-3
# Samples at which terms are compared with splines.
COMPARED_SAMPLES = 5000

TermFunction = Callable[[Float[np.ndarray, "..."], Float[np.ndarray, "..."], float], Float[np.ndarray, "..."]]

# In `q`, position [rad], and `w`, speed [rad/s], with a parameter `n` of their own where they need one.
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
        n: Its own parameter: a speed [rad/s], or waves per turn.
        coefficient: [N m and `unit`].
        std: Its standard deviation.
        share: Of what the map explains, added by this term.
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
        """Of the coefficient."""
        return "N m" + FUNCTIONS[self.function][0]

    def __call__(
        self, position: Real[np.ndarray, "..."], speed: Real[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Torque [N m]."""
        return self.coefficient * FUNCTIONS[self.function][1](position, speed, self.n)

    def __str__(self) -> str:
        return f"{self.coefficient:.3g} {self.name}" if self.function != "1" else f"{self.coefficient:.3g}"


@dataclasses.dataclass(frozen=True)
class Formula:
    """A sum of terms that stands for a learned map.

    Attributes:
        terms: In the order they were chosen; none where no term explains enough.
    """

    terms: tuple[Term, ...]

    @property
    def share(self) -> float:
        """What the terms explain together of what the map explains."""
        return sum(t.share for t in self.terms)

    def __call__(
        self, position: Real[np.ndarray, "..."], speed: Real[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Torque [N m] by the formula."""
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        return sum((t(q, w) for t in self.terms), np.zeros(q.shape))

    def __str__(self) -> str:
        return " + ".join(map(str, self.terms)).replace("+ -", "- ") or "0"


def candidates(position: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"]) -> list[Term]:
    """Terms worth trying on samples of this size; waves only where the port travels far enough."""
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
    """The formula of a map, by a search for few terms in the metric of the recordings.

        minimise  (c - D a)' H (c - D a),   H: information on the weights c, with the physics projected out

    A column of `D` has the weights that come nearest to a term. In this metric a term that the physics
    of the model can imitate (`w` beside a damper) has no size, and a rounded step is as good as a sharp
    one where no sample distinguishes them. The coefficients are those of the data, not of the smoothed map.

    Args:
        fitted: Fitted map.
        effect: Its shape.
        position: Of the port along the recordings [rad].
        speed: [rad/s].

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
    terms = candidates(q, w)
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
    """The best set of one term, of two, of three and so on, the strongest term first.

    One and two are tried out in full, since two terms may explain together what neither does alone; larger
    sets grow by one and exchange members as long as that helps.
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
    """Twice the log-likelihood that terms explain; one that the others already span adds nothing."""
    if not chosen:
        return 0.0
    own = G[np.ix_(chosen, chosen)]
    size = np.sqrt(np.maximum(np.diag(own), 1e-300))
    if len(chosen) > 1 and np.linalg.eigvalsh(own / np.outer(size, size))[0] < 1e-4:
        return 0.0
    return float(r[chosen] @ np.linalg.solve(own, r[chosen]))
