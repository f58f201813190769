"""Settings of a filter by name, their ranges, and the result of a search over them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.step_sizes import Stability
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError

FilterBuilder = Callable[[dict[str, Any]], AdaptiveFilter | tuple[AdaptiveFilter, Basis]]
"""Makes a filter, or a filter and a basis, from settings by name."""


def build_filter(build: FilterBuilder, settings: dict[str, Any]) -> tuple[AdaptiveFilter, Basis | None]:
    """Filter, and the basis where it has settings too."""
    made = build(settings)
    return made if isinstance(made, tuple) else (made, None)


def starting_sets(starts: Mapping[str, float] | Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """One or several sets of settings as a list.

    Raises:
        InputError: none, or sets of different settings.
    """
    sets = [dict(starts)] if isinstance(starts, Mapping) else [dict(s) for s in starts]
    if not sets or not sets[0] or any(set(s) != set(sets[0]) for s in sets):
        raise InputError(
            "Argument `start` must name the same settings in every set, at least one; "
            "give for instance {'mu': 0.01}."
        )
    return sets


@dataclasses.dataclass(frozen=True)
class RangeTransform:
    """Settings within their ranges as unconstrained coordinates.

        setting = low + exp(x)  without an upper end,    low + (high - low) / (1 + exp(-x))  with one

    Attributes:
        names: of the settings.
        ranges: lower and upper end of each; the upper may be infinite.

    Raises:
        InputError: a range that does not rise from a finite number.
    """

    names: tuple[str, ...]
    ranges: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        for name, (low, high) in zip(self.names, self.ranges, strict=True):
            if not -np.inf < low < high:
                raise InputError(
                    f"The range of `{name}` must rise from a finite number, but is {low:g} to {high:g}; "
                    "correct it."
                )

    def settings(self, x: Float[Array, " n"]) -> dict[str, Float[Array, ""]]:
        """The settings at a point, traced."""
        return {
            name: low + (jnp.exp(x[i]) if np.isinf(high) else (high - low) * jax.nn.sigmoid(x[i]))
            for i, (name, (low, high)) in enumerate(zip(self.names, self.ranges, strict=True))
        }

    def free(self, settings: Mapping[str, float]) -> Float[np.ndarray, " n"]:
        """The point of given settings.

        Raises:
            InputError: a setting on or beyond an end of its range.
        """
        x = []
        for name, (low, high) in zip(self.names, self.ranges, strict=True):
            value = float(settings[name])
            if not low < value < high:
                raise InputError(
                    f"Setting `{name}` must start between {low:g} and {high:g}, but is {value:g}; "
                    "move it, or give another range."
                )
            x.append(np.log(value - low) if np.isinf(high) else np.log((value - low) / (high - value)))
        return np.array(x)


@dataclasses.dataclass(frozen=True, eq=False)
class TuningPath:
    """One descent, from its start to its end.

    Attributes:
        points: settings by name, the start first.
        values: objective, penalty included.
        evaluations: filters run, each with its derivatives.
        status: "minimum", "no further progress", "evaluations used up" or "no finite value".
    """

    points: dict[str, Float[np.ndarray, " K"]]
    values: Float[np.ndarray, " K"]
    evaluations: int
    status: str


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """Settings of a filter, chosen by gradient or on a grid.

    Attributes:
        settings: by name.
        value: objective on the recordings that were tuned on.
        test: the same on the others; NaN if there were none.
        objective: "final", "mean_error" or "last_half".
        unit: of `value` and `test`, in words.
        filter: with the settings in it.
        basis: with the settings in it.
        evaluations: settings tried in all.
        stability: of the step sizes, where the theory of LMS applies and the weights are not too many.
        paths: one descent per start; none for a grid.
        axes: settings tried on a grid, by name; empty for a descent.
        values: objective on the grid, one axis per setting; NaN or infinite where the filter diverged.
    """

    settings: dict[str, float]
    value: float
    test: float
    objective: str
    unit: str
    filter: AdaptiveFilter
    basis: Basis
    evaluations: int
    stability: Stability | None
    paths: tuple[TuningPath, ...] = ()
    axes: dict[str, Float[np.ndarray, " _"]] = dataclasses.field(default_factory=dict)
    values: Float[np.ndarray, "..."] | None = None

    def __str__(self) -> str:
        how = f"{len(self.paths)} starts" if self.paths else f"a grid of {self.evaluations}"
        lines = [f'tuned for "{self.objective}" with {self.evaluations} evaluations from {how}']
        lines += [f"  {name} = {value:.4g}" for name, value in self.settings.items()]
        lines += [f"  {self.value:.4g} {self.unit}"]
        if np.isfinite(self.test):
            lines += [f"  {self.test:.4g} on the recordings kept for the test"]
        for path in self.paths:
            start = ", ".join(
                f"{name} {points[0]:.3g}" for name, points in path.points.items() if len(points)
            )
            last = f"{path.values[-1]:.4g}" if len(path.values) else "-"
            lines += [
                f"  from {start or 'a start that diverges'}: {last}, {path.evaluations} evaluations, "
                f"{path.status}"
            ]
        lines += [f"  {self.stability.sentence}" if self.stability else "  stability: no theory applied"]
        return "\n".join(lines)
