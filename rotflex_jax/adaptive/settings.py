"""Settings of a filter by name: what a user gives, and the free numbers that a search moves."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError

Build = Callable[[dict[str, Any]], AdaptiveFilter | tuple[AdaptiveFilter, Basis]]
"""Makes a filter, or a filter and a basis, of settings by name."""


def built(build: Build, settings: dict[str, Any]) -> tuple[AdaptiveFilter, Basis | None]:
    """Filter, and the basis where it has settings too."""
    made = build(settings)
    return made if isinstance(made, tuple) else (made, None)


def named(starts: Mapping[str, float] | Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
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
class Curve:
    """Settings within their ranges as numbers that may be anything.

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

    def settings(self, x: Float[Array, " n"]) -> dict[str, Array]:
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
