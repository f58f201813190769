"""Structural identifiability of a linear machine in exact arithmetic, and unknown directions in words.

    y(t) = C exp(A t) B,   h_k = C A^k B,   k = 0 .. 2 n - 1

The first 2 n Markov parameters h_k determine the transfer function of n states. So parameters are locally
identifiable from input and outputs if the derivatives of `h_k` by the parameters have full rank. All numbers
are fractions with exact derivatives, so that the rank does not depend on a tolerance.

Source: M. S. Grewal and K. Glover, IEEE Trans. Autom. Control 21, 1976; numbers drawn at random give the
rank that holds almost everywhere: A. Sedoglavic, J. Symb. Comput. 33, 2002.
"""

import dataclasses
import itertools
import random
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.base import Linear
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import second_order_matrices
from rotflex_jax.parameters import HALF_WIDTH_95

# Parameters with a smaller share than this of the largest are left out of a sentence.
LEAST_SHARE = 0.1
# Entries of a vector below the first are zero. Two vectors are the same if no entry differs by more than the
# second, since vectors from random runs have fewer correct digits than exact ones.
ZERO, SAME = 1e-6, 1e-4


@dataclasses.dataclass(frozen=True)
class Direction:
    """A direction in which parameters change together without, or nearly without, a change of the outputs.

    Attributes:
        shares: Parameter -> its relative change; the largest is 1.
        kind: `powers` if the relative changes are the same for all parameter values, so that products of
            powers are known; `sum` if the absolute changes are, so that a sum is known; `mixed` otherwise.
        std: Standard deviation along the direction as a share of the values; infinite if nothing is known.
    """

    shares: dict[str, float]
    kind: str
    std: float = np.inf

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters with a noticeable share; all of them if the direction is unknown."""
        least = 0.0 if np.isinf(self.std) else LEAST_SHARE
        return tuple(n for n, v in self.shares.items() if abs(v) >= least)

    @property
    def sentence(self) -> str:
        """What is known along the direction, in words."""
        names, v = self.parameters, self.shares
        half = f"{100 * HALF_WIDTH_95 * self.std:.2g}"
        wide = "" if np.isinf(self.std) else f" (together known to ± {half} % only)"
        if len(names) == 1:
            known = f"is known to ± {half} % only"
            return f"{names[0]} {'has no effect on what is measured' if np.isinf(self.std) else known}"
        both = f"{', '.join(names[:-1])} and {names[-1]}"
        sizes = np.array([v[n] for n in names])
        equal = np.ptp(np.abs(sizes)) < 0.2 * np.abs(sizes).max()
        if self.kind == "sum":
            return f"{both} together: only a sum of them is known{wide}"
        if equal and (sizes > 0).all():
            ratio = "ratio is" if len(names) == 2 else "ratios are"
            return f"{both} together: only their {ratio} known, one common factor is open{wide}"
        if equal and len(names) == 2:
            return f"{both} together: only their product is known{wide}"
        if self.kind == "powers":
            factors = ", ".join(f"{n} by k" + (f"^{v[n]:.3g}" if abs(v[n] - 1) > 0.01 else "") for n in names)
            return f"{both} together: nothing shows a change of {factors} for any k{wide}"
        if np.isinf(self.std):
            several = "one combination of them is" if len(names) == 2 else "combinations of them are"
            return f"{both} together: only {several} known"
        changes = ", ".join(f"{n} {'up' if v[n] > 0 else 'down'}" for n in names)
        return f"{both} together: hardly anything shows if they move at once ({changes}){wide}"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        std = None if np.isinf(self.std) else self.std
        return {"shares": self.shares, "kind": self.kind, "std": std, "sentence": self.sentence}


def kind_of(
    log: Float[np.ndarray, " P"],
    again: Float[np.ndarray, " P"],
    values: Float[np.ndarray, " P"],
    other: Float[np.ndarray, " P"],
) -> str:
    """Kind of a direction: whether its relative or its absolute changes agree at two sets of values.

    Args:
        log: Relative changes at the first set of values.
        again: Relative changes at the second set.
        values: Parameter values of the first set.
        other: Parameter values of the second set.
    """
    if _same(log, again):
        return "powers"
    return "sum" if _same(log * values, again * other) else "mixed"


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    a, b = (v / v[np.argmax(np.abs(a))] if v[np.argmax(np.abs(a))] else v for v in (a, b))
    return bool(np.all(np.abs(a - b) < SAME * max(1.0, float(np.abs(a).max()))))


def reduced(vectors: Float[np.ndarray, "K P"]) -> Float[np.ndarray, "K P"]:
    """Another basis of the span of some vectors, each with few entries and a column of its own."""
    left = np.array(vectors, float)
    for k in range(len(left)):
        rest = np.abs(left[k:])
        row, column = np.unravel_index(np.argmax(rest), rest.shape)
        left[[k, k + row]] = left[[k + row, k]]
        left[k] /= left[k, column]
        for i in range(len(left)):
            if i != k:
                left[i] -= left[i, column] * left[k]
    return np.where(np.abs(left) < ZERO, 0.0, left)


def direction(
    names: Sequence[str], vector: Float[np.ndarray, " P"], kind: str, std: float = np.inf
) -> Direction:
    """A direction, scaled so that its largest share is 1."""
    scaled = vector / vector[np.argmax(np.abs(vector))]
    return Direction(
        {n: float(v) for n, v in zip(names, scaled, strict=True) if abs(v) > ZERO}, kind, float(std)
    )


# Largest number of sets of parameters that `least_held` examines.
MOST_SETS = 400


def least_held(names: Sequence[str], vectors: Float[np.ndarray, "K P"]) -> tuple[tuple[str, ...], ...]:
    """The smallest sets of parameters that make all others identifiable if they are held.

    Args:
        names: Names of the parameters.
        vectors: Directions that are unknown.
    """
    K = len(vectors)
    if not K:
        return ()
    inside = [i for i in range(len(names)) if np.abs(vectors[:, i]).max() > ZERO]
    sets = itertools.islice(itertools.combinations(inside, K), MOST_SETS)
    return tuple(
        tuple(names[i] for i in chosen)
        for chosen in sets
        if np.linalg.matrix_rank(vectors[:, chosen], tol=ZERO) == K
    )


Matrix = list[list[Any]]


@dataclasses.dataclass(frozen=True)
class Dual:
    """A fraction with its exact derivatives along some directions.

    >>> x = Dual(Fraction(3), (Fraction(1),))
    >>> (2 / x + x * x).slopes[0] == Fraction(-2, 9) + 6
    True
    """

    value: Fraction
    slopes: tuple[Fraction, ...]

    def _other(self, x: Any) -> "Dual":
        return x if isinstance(x, Dual) else Dual(exact(x), (Fraction(0),) * len(self.slopes))

    def __add__(self, x: Any) -> "Dual":
        o = self._other(x)
        return Dual(self.value + o.value, tuple(a + b for a, b in zip(self.slopes, o.slopes, strict=True)))

    def __neg__(self) -> "Dual":
        return Dual(-self.value, tuple(-a for a in self.slopes))

    def __sub__(self, x: Any) -> "Dual":
        return self + (-self._other(x))

    def __rsub__(self, x: Any) -> "Dual":
        return self._other(x) - self

    def __mul__(self, x: Any) -> "Dual":
        o = self._other(x)
        pairs = zip(self.slopes, o.slopes, strict=True)
        return Dual(self.value * o.value, tuple(a * o.value + self.value * b for a, b in pairs))

    def __truediv__(self, x: Any) -> "Dual":
        o = self._other(x)
        quotient = self.value / o.value
        pairs = zip(self.slopes, o.slopes, strict=True)
        return Dual(quotient, tuple((a - quotient * b) / o.value for a, b in pairs))

    def __rtruediv__(self, x: Any) -> "Dual":
        return self._other(x) / self

    def __pow__(self, power: int) -> "Dual":
        result = self._other(1)
        for _ in range(abs(power)):
            result = result * self
        return result if power >= 0 else 1 / result

    __radd__, __rmul__ = __add__, __mul__


def exact(x: Any) -> Fraction:
    """A number as the fraction given by its decimals.

    >>> exact(0.0059)
    Fraction(59, 10000)
    """
    return x if isinstance(x, Fraction) else Fraction(repr(float(x)))


def is_linear(m: Mechanism) -> bool:
    """Whether the whole machine is linear in state and input, so that exact arithmetic can be used."""
    return all(type(e).is_linear and isinstance(e, Linear) and e.exact_step for e in m.effects)


def random_values(m: Mechanism, free: Sequence[str], seed: int) -> dict[str, Fraction]:
    """Values of all parameters: random positive values for free ones, the given values for others."""
    draw = random.Random(seed)
    return {
        name: Fraction(draw.randint(11, 99), draw.randint(11, 99)) if name in free else exact(value)
        for name, value in m.named_values.items()
    }


def impulse_slopes(
    m: Mechanism, values: Mapping[str, Fraction], free: Sequence[str], rows: Sequence[Sequence[float]]
) -> Matrix:
    """Derivatives of the Markov parameters `h_k` of some readings by the logarithms of parameters.

    Args:
        m: A linear machine.
        values: Values of all parameters.
        free: Parameters by which derivatives are taken.
        rows: Readings as coefficients of positions and speeds.

    Returns:
        One row for each reading and k, one column for each parameter.
    """
    zero = (Fraction(0),) * len(free)
    unit = {name: tuple(Fraction(int(i == k)) for k in range(len(free))) for i, name in enumerate(free)}
    effects = [
        e.replace(
            **{p: Dual(values[full], unit.get(full, zero)) for p in e.values for full in (e.full_name(p),)}
        )
        for e in m.effects
    ]
    none = Dual(Fraction(0), zero)
    A, B = _state_space(m, effects, none)
    x, found = B, []
    for _ in range(2 * len(A)):
        for row in rows:
            h = none
            for coefficient, entry in zip(row, x, strict=False):
                if coefficient:
                    h = h + entry * coefficient
            found.append([s * values[name] for s, name in zip(h.slopes, free, strict=True)])
        x = [_dot(row, x, none) for row in A]
    return found


def _state_space(m: Mechanism, effects: Sequence[Any], none: Dual) -> tuple[Matrix, list[Dual]]:
    """`A` and `B` for positions, speeds and the states of linear effects, as in `mechanism.assembly`."""
    n = len(m.coordinates)
    empty = lambda rows, columns: [[none] * columns for _ in range(rows)]  # noqa: E731
    stamps = [(e.stamp(), [exact(x) for x in m.vector(e)]) for e in effects]
    M, D, K, drive = second_order_matrices(stamps, n, none)
    inverse = _inverse(M, none)
    size = 2 * n + sum(len(s.own) for s, _ in stamps)
    A, B = empty(size, size), [none] * size
    for i in range(n):
        A[i][n + i] = none + 1
        B[n + i] = _dot(inverse[i], drive, none)
        for j in range(n):
            A[n + i][j] = -_dot(inverse[i], [row[j] for row in K], none)
            A[n + i][n + j] = -_dot(inverse[i], [row[j] for row in D], none)
    at = 2 * n
    for s, p in stamps:
        for a in range(len(s.own)):
            for b in range(len(s.own)):
                A[at + a][at + b] = none + s.own[a][b]
            B[at + a] = none + s.from_voltage[a]
            for j in range(n):
                A[at + a][n + j] = none + s.from_speed[a] * p[j]
            for i in range(n):
                A[n + i][at + a] = _dot(inverse[i], p, none) * s.torque[a]
        at += len(s.own)
    return A, B


def _dot(a: Sequence[Any], b: Sequence[Any], none: Dual) -> Dual:
    total = none
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def _inverse(M: Matrix, none: Dual) -> Matrix:
    """Inverse of a matrix of dual numbers, by elimination."""
    n = len(M)
    rows = [[*row, *(none + int(i == j) for j in range(n))] for i, row in enumerate(M)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k].value != 0)
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(n):
            if i != k:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]


def null_space(rows: Matrix, size: int) -> list[list[Fraction]]:
    """Basis of the null space of a matrix of fractions; each vector has a one in a column of its own.

    >>> null_space([[Fraction(1), Fraction(1), Fraction(0)]], 3)
    [[Fraction(-1, 1), Fraction(1, 1), Fraction(0, 1)], [Fraction(0, 1), Fraction(0, 1), Fraction(1, 1)]]
    """
    left, pivots = [list(row) for row in rows], list[int]()
    for column in range(size):
        k = len(pivots)
        pivot = next((i for i in range(k, len(left)) if left[i][column] != 0), None)
        if pivot is None:
            continue
        left[k], left[pivot] = left[pivot], left[k]
        left[k] = [x / left[k][column] for x in left[k]]
        for i in range(len(left)):
            if i != k and left[i][column] != 0:
                factor = left[i][column]
                left[i] = [a - factor * b for a, b in zip(left[i], left[k], strict=True)]
        pivots.append(column)
    found = []
    for column in (c for c in range(size) if c not in pivots):
        vector = [Fraction(int(i == column)) for i in range(size)]
        for k, pivot in enumerate(pivots):
            vector[pivot] = -left[k][column]
        found.append(vector)
    return found
