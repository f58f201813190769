"""Parameters: numbers with a unit, bounds and a typical size, and the coordinates in which they are fitted.

An effect declares its parameters with `parameter(...)`. A fit varies unconstrained coordinates `z`, and
`Transform` maps them to physical values, so that no bound is ever violated.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Real

# Largest number of trusted constants that are named with an interval; others are only counted.
_NAMED_CONSTANTS = 3
HALF_WIDTH_95 = 1.96
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class Specification:
    """Declares one parameter of an effect.

    Attributes:
        unit: SI unit as it is usually written; "" for a number without a unit.
        typical: Typical size [unit]; sets the scale of a fit.
        lower: Lower bound; values below are impossible [unit].
        upper: Upper bound; values above are impossible [unit].
        physical: Range of healthy machines [unit]; an estimate outside is flagged, not forbidden.
        meaning: Phrase for tables.
    """

    unit: str
    typical: float
    lower: float = -math.inf
    upper: float = math.inf
    physical: tuple[float, float] = (-math.inf, math.inf)
    meaning: str = ""


def parameter(default: float | None, **declared: Any) -> Any:
    """A dataclass field that declares a parameter; keywords as in `Specification`."""
    declared.setdefault("typical", abs(default) if default else 1.0)
    return dataclasses.field(default=default, metadata={"parameter": Specification(**declared)})


def specifications(owner: Any) -> dict[str, Specification]:
    """Name -> `Specification` of every parameter of a dataclass (class or instance), in order.

    A parameter whose value is None belongs to a part that the instance does not have; it is left out. An
    instance whose number of parameters depends on its shape has a method `own_specifications`.
    """
    own = getattr(owner, "own_specifications", None)
    if own and not isinstance(owner, type):
        return own()
    if isinstance(owner, type):
        return dict(_declared(owner))
    return {name: spec for name, spec in _declared(type(owner)).items() if getattr(owner, name) is not None}


@functools.cache
def _declared(owner: type) -> dict[str, Specification]:
    return {f.name: f.metadata["parameter"] for f in dataclasses.fields(owner) if "parameter" in f.metadata}


@dataclasses.dataclass(frozen=True, eq=False)
class Transform:
    """Transform between unconstrained `z` and physical `p`, elementwise, by the bounds of each parameter.

    With a lower bound `p = lower + exp(z)`, with an upper bound `p = upper - exp(z)`, with both a logistic
    curve, without bounds `p = typical z`. A step of one in `z` is a substantial step in `p`, unless a value
    without bounds is many times its typical size.
    """

    lower: Float[np.ndarray, " P"]
    upper: Float[np.ndarray, " P"]
    typical: Float[np.ndarray, " P"]

    @classmethod
    def of(cls, specs: Sequence[Specification]) -> "Transform":
        """The transform for a list of declared parameters."""
        columns = ("lower", "upper", "typical")
        return cls(*(np.array([getattr(s, c) for s in specs], dtype=float) for c in columns))

    @property
    def bounded(self) -> Bool[np.ndarray, " P"]:
        """Which parameters have a bound; for those, a step of one in `z` is substantial at any value."""
        return np.isfinite(self.lower) | np.isfinite(self.upper)

    def _kinds(
        self,
    ) -> tuple[
        Bool[np.ndarray, " P"], Bool[np.ndarray, " P"], Float[np.ndarray, " P"], Float[np.ndarray, " P"]
    ]:
        """Which parameters have one bound, which have two, the bound (the lower of two), the sign inwards."""
        low, high = np.isfinite(self.lower), np.isfinite(self.upper)
        edge = np.where(low, self.lower, np.where(high, self.upper, 0.0))
        return low != high, low & high, edge, np.where(low, 1.0, -1.0)

    def constrain(self, z: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
        """Physical values [declared units] of the unconstrained coordinates."""
        single, boxed, edge, inwards = self._kinds()
        low, sign = jnp.asarray(edge, z.dtype), jnp.asarray(inwards, z.dtype)
        span = jnp.asarray(np.where(boxed, self.upper - self.lower, 1.0), z.dtype)
        # The exponent is capped against overflow: a trial step that is refused may have any size.
        grown = jnp.exp(jnp.minimum(jnp.where(jnp.asarray(single), z, 0.0), 60.0))
        p = jnp.where(jnp.asarray(single), low + sign * grown, z * jnp.asarray(self.typical, z.dtype))
        return jnp.where(jnp.asarray(boxed), low + span * jax.nn.sigmoid(z), p)

    def physical(
        self, z: Float[np.ndarray, "*batch P"]
    ) -> tuple[Float[np.ndarray, "*batch P"], Float[np.ndarray, "*batch P"]]:
        """`constrain(z)` and its derivative, outside of traced code."""
        single, boxed, edge, inwards = self._kinds()
        span = np.where(boxed, self.upper - self.lower, 1.0)
        grown = inwards * np.exp(np.minimum(np.where(single, z, 0.0), 60.0))
        share = scipy.special.expit(np.where(boxed, z, 0.0))
        p = np.where(single, edge + grown, z * self.typical)
        slope = np.where(single, grown, self.typical)
        return np.where(boxed, edge + span * share, p), np.where(boxed, span * share * (1 - share), slope)

    def unconstrain(self, p: Real[np.ndarray, "*batch P"]) -> Float[np.ndarray, "*batch P"]:
        """Unconstrained coordinates of physical values; a value on its bound starts just inside."""
        p = np.asarray(p, dtype=float)
        single, boxed, edge, inwards = self._kinds()
        z = p / self.typical
        inside = np.maximum(inwards * (p - edge), 1e-3 * self.typical)
        z = np.where(single, np.log(inside), z)
        share = (p - np.where(boxed, edge, 0.0)) / np.where(boxed, self.upper - self.lower, 1)
        share = np.clip(share, 1e-3, 1 - 1e-3)
        return np.where(boxed, np.log(share / (1 - share)), z)


def bound_reached(value: float, spec: Specification, std: float = math.nan) -> str:
    """The bound that a value has reached, in words: at the bound, or the interval includes the bound."""
    for distance, which in ((value - spec.lower, "lower"), (spec.upper - value, "upper")):
        near = distance < 1e-2 * spec.typical and (math.isnan(std) or distance <= HALF_WIDTH_95 * std)
        if math.isfinite(distance) and (distance < 1e-6 * spec.typical or near):
            return f"at its {which} bound"
    return ""


class HeldConstant(NamedTuple):
    """A trusted constant on which an estimate depends.

    Attributes:
        name: Full name of the constant.
        value: Value at which it was held [unit].
        unit: SI unit.
        change: Change of the estimate if the constant is one per cent larger [unit of the estimate].
    """

    name: str
    value: float
    unit: str
    change: float


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One fitted or trusted parameter.

    Attributes:
        name: Full name, `port.effect.parameter`.
        value: Estimate [unit].
        std: Standard deviation [unit], robust to correlated residuals; NaN for a held constant.
        ci95: 95 % interval [unit].
        unit: SI unit.
        free: False if the value was trusted and held.
        note: Information for the reader, for instance that the estimate is outside its physical range.
        given: Trusted constants whose usual tolerance moves the estimate out of its interval, the strongest
            first: the interval holds only if these are right.
    """

    name: str
    value: float
    std: float
    ci95: tuple[float, float]
    unit: str
    free: bool = True
    note: str = ""
    given: tuple[HeldConstant, ...] = ()

    @property
    def remark(self) -> str:
        """The note, and the trusted constants on which the interval depends, in words."""
        return "; ".join(filter(None, (self.note, self.given_words)))

    @property
    def given_words(self) -> str:
        """The trusted constants on which the interval depends, in words; empty if there are none."""
        if not self.given:
            return ""
        named = [f"{c.name} {c.value:.4g} {c.unit}".rstrip() for c in self.given[:_NAMED_CONSTANTS]]
        more = len(self.given) - len(named)
        listed = ", ".join(named) + (f" and {more} more" if more else "")
        which = "it" if len(self.given) == 1 else "the first"
        return f"given {listed} (1 % more of {which}: {self.given[0].change:+.2g} {self.unit}".rstrip() + ")"

    @classmethod
    def of(cls, name: str, value: float, std: float, spec: Specification, note: str = "") -> "Estimate":
        """A fitted parameter with its 95 % interval and remarks on its value."""
        low, high = spec.physical
        remarks = [note] if note else []
        if not low <= value <= high:
            remarks.append("outside its physical range")
        bound = "" if "bound" in note else bound_reached(value, spec, std)
        if bound:
            remarks.append(bound)
        elif math.isnan(std) and "bound" not in note:
            remarks.append("not determined by these data")
        half = HALF_WIDTH_95 * std
        return cls(name, value, std, (value - half, value + half), spec.unit, note="; ".join(remarks))

    @property
    def decimals(self) -> tuple[int, int] | None:
        """Number of decimals that show two digits of the half width of the interval, and the power of ten.

        None if there is no interval.

        >>> Estimate("a", 1.20012, 2e-5, (1.20008, 1.20016), "N m").decimals
        (6, 0)
        """
        low, high = self.ci95
        if not (math.isfinite(low) and math.isfinite(high) and high > low):
            return None
        largest = max(abs(low), abs(high), abs(self.value))
        power = 0 if 1e-4 <= largest < 1e5 else math.floor(math.log10(largest))
        return min(12, max(0, 1 - math.floor(math.log10((high - low) / 2 / 10.0**power)))), power

    @property
    def texts(self) -> tuple[str, str, str]:
        """Value and ends of the interval as plain text, with as many digits as the interval justifies.

        >>> Estimate("a", 0.0300069, 1e-5, (0.029987, 0.030027), "N m").texts
        ('0.030007', '0.029987', '0.030027')
        >>> Estimate("a", 2.5e-6, 1e-8, (2.48e-6, 2.52e-6), "N m").texts
        ('2.500e-06', '2.480e-06', '2.520e-06')
        """
        numbers = (self.value, *self.ci95)
        if self.decimals is None:
            a, b, c = (f"{x:.6g}" for x in numbers)
        else:
            count, power = self.decimals
            kind = "e" if power else "f"
            a, b, c = (f"{x:.{count}{kind}}" for x in numbers)
        return a, b, c

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; with `given` only if the interval depends on trusted constants."""
        return {
            "value": self.value,
            "std": None if math.isnan(self.std) else self.std,
            "ci95": None if math.isnan(self.ci95[0]) else list(self.ci95),
            "unit": self.unit,
        } | ({"given": [c._asdict() for c in self.given]} if self.given else {})

    def __str__(self) -> str:
        if not self.free:
            return f"{self.name} = {self.value:.6g} {self.unit} ({self.note or 'held'})"
        low, high = self.ci95
        if math.isnan(low) or math.isnan(high):
            return (
                f"{self.name} = {self.value:.6g} {self.unit}  (no interval: {self.note or 'not determined'})"
            )
        given = f"  {self.given_words}" if self.given else ""
        value, first, last = self.texts
        return f"{self.name} = {value} {self.unit}  [{first}, {last}]{given}"
