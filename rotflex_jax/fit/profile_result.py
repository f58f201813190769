"""Result of a profile: the likelihood along one quantity, its interval and its shape."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import as_read, digits, json_number, plain_number, readable, unit_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Quantity = str | Callable[[Mapping[str, float]], float]
"""Full name of a parameter, or a function from the values of all parameters by full name to a number."""

# A Wald interval is poor if the root of the likelihood ratio at one of its ends differs from 1.96 by more
# than this share. With 0.15, this end belongs to a level of 90 or 97.6 % instead of 95 %.
POOR = 0.15
# Every profile reaches this level, since its shape and its sentence are about the interval of this level.
LEAST_LEVEL = 0.95


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood along one quantity, with everything else fitted again at each value.

        drop = 2 (cost(value) - least cost) / factor,   interval: drop <= quantile of chi2 with 1 degree

    `factor` is the factor by which the correlation of errors in time increases the variance of the quantity
    (the ratio of sandwich and inverse curvature). So profile and Wald interval agree if the cost is a
    parabola.

    Attributes:
        name: Name of the quantity.
        unit: Unit of the quantity; empty for a function of parameters.
        value: Value of the quantity at the least cost.
        values: Values of the quantity, ascending.
        drop: Twice the loss of log-likelihood over `factor`; zero at `value`.
        factor: Number of nats of the cost that count as one.
        std: Wald's standard deviation; nan if the curvature gives none.
        limits: Least and largest value that the quantity may have.
        nuisances: Values of all parameters at each value.
        parameter_names: Full names of these parameters.
        gained: Cost of the fit less the least cost [nat]; zero if the fit has the least cost.
        level: Confidence level up to which points were placed.
    """

    name: str
    unit: str
    value: float
    values: Float[np.ndarray, " K"]
    drop: Float[np.ndarray, " K"]
    factor: float
    std: float
    limits: tuple[float, float]
    nuisances: Float[np.ndarray, "K P"]
    parameter_names: tuple[str, ...]
    gained: float = 0.0
    level: float = LEAST_LEVEL

    @property
    def wald(self) -> tuple[float, float]:
        """The symmetric 95 % interval from the curvature."""
        return self.wald_interval(0.95)

    def wald_interval(self, level: float) -> tuple[float, float]:
        """The symmetric interval from the curvature, of any level."""
        half = float(scipy.stats.norm.ppf((1 + level) / 2)) * self.std
        return self.value - half, self.value + half

    @property
    def root(self) -> Float[np.ndarray, " K"]:
        """Signed root of the drop, negative below `value`; a straight line if the cost is a parabola."""
        return np.sign(self.values - self.value) * np.sqrt(np.maximum(self.drop, 0.0))

    def root_at(self, values: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
        """The signed root, interpolated between the points of the profile; nan outside of them."""
        if len(self.values) < 2:
            return np.where(values == self.value, 0.0, np.nan)
        return scipy.interpolate.PchipInterpolator(self.values, self.root, extrapolate=False)(values)

    def regions(self, level: float = 0.95) -> list[tuple[float, float]]:
        """All values that are not excluded, as intervals; an open end is an end of `limits`.

        Args:
            level: Confidence level, at most the level of the profile.

        Raises:
            InputError: If the level is not between 0 and 1, or above the level of the profile.
        """
        level = checks.number(level, "level", above=0, below=1, example="0.95")
        if level > self.level:
            raise InputError(
                f"An interval of level {level:g} was asked for, but the profile reaches {self.level:g}; make "
                f"it with level={level:g}."
            )
        most = math.sqrt(scipy.stats.chi2.ppf(level, 1))
        excess = np.abs(self.root) - most
        inside = excess <= 0
        edges = [self.limits[0]] if inside[0] else []
        for k in np.flatnonzero(inside[1:] != inside[:-1]):
            low, high = self.values[k], self.values[k + 1]
            edges.append(
                scipy.optimize.brentq(lambda v: abs(float(self.root_at(np.array([v]))[0])) - most, low, high)
            )
        edges += [self.limits[1]] if inside[-1] else []
        return list(zip(edges[::2], edges[1::2], strict=True))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The interval from the least to the largest value that is not excluded; `regions` shows gaps.

        Args:
            level: Confidence level, at most the level of the profile.

        Raises:
            InputError: If the level is not between 0 and 1, or above the level of the profile.
        """
        found = self.regions(level)
        return found[0][0], found[-1][1]

    @property
    def shape(self) -> str:
        """`closed`, `open below`, `open above`, `open` (to both sides) or `two minima`, at 95 %."""
        found, most = self.regions(), scipy.stats.chi2.ppf(0.95, 1)
        if len(found) > 1:
            return "two minima"
        low, high = self.drop[0] <= most, self.drop[-1] <= most
        return {(0, 0): "closed", (1, 0): "open below", (0, 1): "open above", (1, 1): "open"}[low, high]

    @property
    def wald_is_poor(self) -> bool:
        """Whether Wald's interval misleads, because the profile is not closed or an end has another level."""
        if not math.isfinite(self.std) or self.shape != "closed":
            return True
        at = self.root_at(np.array(self.wald))
        return not bool(np.all(np.abs(np.abs(at) / HALF_WIDTH_95 - 1) <= POOR))

    @property
    def sentence(self) -> str:
        """What the recordings show of the quantity, in words."""
        (low, high), (factor, unit) = self.interval(), as_read(1.0, self.unit)
        # As many digits as are significant by the interval.
        width = min((b - a for a, b in self.regions() if math.isfinite(b - a)), default=math.inf)
        worth = math.log10(max(abs(self.value) / width, 1.0)) if width > 0 else 3.0
        shown = lambda v: digits(factor * v, 3 + math.floor(worth))  # noqa: E731
        says = {
            "closed": f"lies between {shown(low)} and {shown(high)}",
            "open above": f"is at least {shown(low)}; the recordings set no upper end",
            "open below": f"is at most {shown(high)}; the recordings set no lower end",
            "open": "is not determined by these recordings",
            "two minima": "lies in one of several ranges: "
            + " or ".join(f"{shown(a)} to {shown(b)}" for a, b in self.regions()),
        }[self.shape]
        return f"{self.name} = {shown(self.value)} {unit}".rstrip() + f" {says} (95 %)"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; an end that is infinite or unknown is None."""
        finite = lambda pair: [json_number(v) for v in pair]  # noqa: E731
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "interval95": finite(self.interval()),
            "regions95": [finite(r) for r in self.regions()],
            "wald95": finite(self.wald),
            "shape": self.shape,
            "wald_is_poor": self.wald_is_poor,
            "factor": self.factor,
            "values": self.values.tolist(),
            "drop": self.drop.tolist(),
        }

    def plot(self) -> "Figure":
        """Figure of the drop over the quantity, with the parabola of Wald and both 95 % intervals."""
        from rotflex_jax.fit.profile_figure import profile_figure  # takes long to import

        return profile_figure([self])

    def _repr_html_(self) -> str:
        """A card with both intervals and the sentence of the profile."""
        rows = []
        for what, (low, high) in (("profile", self.interval()), ("Wald", self.wald)):
            (a, unit), (b, _) = readable(low, self.unit), readable(high, self.unit)
            rows.append((what, unit, plain_number(a), plain_number(b)))
        warning = "The Wald interval is poor here: use that of the profile." if self.wald_is_poor else ""
        return card(
            f"Profile of {self.name}: {self.shape}",
            paragraph(self.sentence + "."),
            table(("95 % interval", "unit", "from", "to"), rows, words=2),
            paragraph(warning) if warning else "",
        )

    def __str__(self) -> str:
        (low, high), (factor, unit) = self.wald, as_read(1.0, self.unit)
        worth = math.log10(max(abs(self.value) / self.std, 1.0)) if self.std > 0 else 0.0
        ends = (digits(factor * v, 3 + math.floor(worth)) for v in (low, high))
        return f"{self.sentence}; Wald: {' to '.join(ends)} {unit_text(unit)}".rstrip()
