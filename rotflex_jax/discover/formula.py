"""Reads a learned map as a formula: a few physical terms that say the same of the recordings."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.discover.smooth_map import Mapped
from rotflex_jax.effects.learned import LearnedTorque

# Most terms of a formula, the share that the last of them must explain, and what its number costs [nat].
MOST, SHARE, NATS = 4, 0.02, 10.0
# A term of whose trace less than this is left beside the physics says nothing of its own.
OWN = 1e-3
# Samples at which terms are compared with splines.
ENOUGH = 5000

Law = Callable[[np.ndarray, np.ndarray, float], np.ndarray]

# In `q`, position [rad], and `w`, speed [rad/s], with a number `n` of their own where they need one.
LAWS: dict[str, tuple[str, Law]] = {
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
        law: Key of `LAWS`.
        n: Its own number: a speed [rad/s], or waves per turn.
        coefficient: [N m and `unit`].
        std: Its deviation.
        share: Of what the map explains, added by this term.
    """

    law: str
    n: float
    coefficient: float = 1.0
    std: float = 0.0
    share: float = 0.0

    @property
    def name(self) -> str:
        """As written in a formula."""
        return self.law.format(n=self.n)

    @property
    def unit(self) -> str:
        """Of the coefficient."""
        return "N m" + LAWS[self.law][0]

    def __call__(self, position: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Torque [N m]."""
        return self.coefficient * LAWS[self.law][1](position, speed, self.n)

    def __str__(self) -> str:
        return f"{self.coefficient:.3g} {self.name}" if self.law != "1" else f"{self.coefficient:.3g}"


@dataclasses.dataclass(frozen=True)
class Formula:
    """A sum of terms that stands for a learned map.

    Attributes:
        terms: In the order they were chosen; none where no term is worth it.
    """

    terms: tuple[Term, ...]

    @property
    def share(self) -> float:
        """What the terms explain together of what the map explains."""
        return sum(t.share for t in self.terms)

    def __call__(self, position: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Torque [N m] by the formula."""
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        return sum((t(q, w) for t in self.terms), np.zeros(q.shape))

    def __str__(self) -> str:
        return " + ".join(map(str, self.terms)).replace("+ -", "- ") or "0"


def candidates(position: np.ndarray, speed: np.ndarray) -> list[Term]:
    """Terms worth trying on samples of this size; waves only where the port travels far enough."""
    turning, span = float(np.sqrt(np.mean(speed**2))), float(np.ptp(position))
    waves = [float(n) for n in range(1, 13) if n * span > 2.0]
    out = []
    for law in LAWS:
        own = [0.1 * turning, 0.2 * turning, 0.4 * turning, 0.8 * turning] if "exp" in law else waves
        out += [Term(law, n) for n in own] if "{n" in law else [Term(law, 0.0)]
    return out


def read(mapped: Mapped, effect: LearnedTorque, position: np.ndarray, speed: np.ndarray) -> Formula:
    """The formula of a map, by a search for few terms in the metric of the recordings.

        minimise  (c - D a)' H (c - D a),   H: what the recordings know of the weights c, physics apart

    A column of `D` has the weights that come nearest to a term. In this metric a term that the physics
    of the model can imitate (`w` beside a damper) weighs nothing, and a rounded step is as good as a sharp
    one where no sample tells them apart. The coefficients are those of the data, not of the smoothed map.

    Args:
        mapped: Fitted map.
        effect: Its shape.
        position: Of the port along the recordings [rad].
        speed: [rad/s].

    Source: S. Chen, S. Billings and W. Luo, Int. J. Control 50, 1989 (error reduction); S. Brunton,
    J. Proctor and N. Kutz, PNAS 113, 2016 (formulas from a dictionary).
    """
    pick = np.linspace(0, len(position) - 1, min(ENOUGH, len(position))).astype(int)
    q, w = position[pick], speed[pick]
    Phi = effect.design(q, w) * effect.scale
    H, slope = mapped.information.projected()
    z = mapped.hypothesis.z[[mapped.hypothesis.free[i] for i in mapped.information.weights]]
    b = H @ z - slope
    whole = mapped.information.H[np.ix_(mapped.information.weights, mapped.information.weights)]
    ridge = 1e-6 * np.trace(Phi.T @ Phi) / Phi.shape[1] * np.eye(Phi.shape[1])
    terms = candidates(q, w)
    F = np.stack([t(q, w) for t in terms], axis=1)
    D = np.linalg.solve(Phi.T @ Phi + ridge, Phi.T @ F)
    G, r = D.T @ H @ D, D.T @ b
    own = np.diag(G) / np.maximum(np.einsum("ij,ik,kj->j", D, whole, D), 1e-300)
    able = [i for i in range(len(terms)) if own[i] > OWN]
    total = float(b @ mapped.covariance @ b) / mapped.information.excess
    chosen: list[int] = []
    explained = [0.0]
    for more in _sets(G, r, able):
        value = _explained(G, r, more)
        if value - explained[-1] < max(2 * NATS * mapped.information.excess, SHARE * total):
            break
        chosen = more
        explained.append(value)
    if not chosen:
        return Formula(())
    inverse = np.linalg.inv(G[np.ix_(chosen, chosen)])
    a, std = inverse @ r[chosen], np.sqrt(mapped.information.excess * np.diag(inverse))
    shares = np.diff([_explained(G, r, chosen[:k]) for k in range(len(chosen) + 1)]) / total
    return Formula(
        tuple(
            dataclasses.replace(terms[i], coefficient=float(x), std=float(s), share=float(p))
            for i, x, s, p in zip(chosen, a, std, shares, strict=True)
        )
    )


def _sets(G: np.ndarray, r: np.ndarray, able: list[int]) -> Iterator[list[int]]:
    """The best set of one term, of two, of three and so on, the strongest term first.

    One and two are tried out in full, since two terms may say together what neither does nearly; larger
    sets grow by one and exchange members as long as that helps.
    """
    value = functools.partial(_explained, G, r)
    best: list[int] = []
    for size in range(1, min(MOST, len(able)) + 1):
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
