"""A learned torque: a smooth function of position and speed, without a physical law."""

import dataclasses
import math
from typing import Any, ClassVar, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax.effects.base import Force, Scalar
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import Specification
from rotflex_jax.runtime.xla import double_precision

SPLINE_SUPPORT = 4
"""Intervals over which a cubic B-spline is not zero."""
LearnedType = TypeVar("LearnedType", bound="LearnedTorque")


@dataclasses.dataclass(frozen=True)
class LearnedTorque(Force):
    """A smooth map of position and speed of a port, in cubic B-splines.

        tau = sum_ij w_ij b_i(position) b_j(asinh(speed / bend))

    The speed is transformed so that the splines are dense near zero speed, where friction changes its sign,
    and wide elsewhere. Beyond an end of a range the map keeps its value at this end. The splines of one axis
    add up to one.

    An effect with a formula has fewer parameters: use this one if no effect of the catalogue explains the
    recording, and interpret it (`rf.learn_torque`). Not for a torque that depends on time or on the past, and
    not for friction that holds a port at rest: the map is smooth, so the port creeps.

    Args:
        at: Port.
        position: Range of positions [rad].
        speed: Range of speeds [rad/s].
        bend: Speed below which the transformation is nearly linear [rad/s].
        count: Number of splines along position and along speed; 1 for no dependence, otherwise 4 or more.
        scale: Typical size of the weights [N m], by which a fit scales its steps.
        weights: Torques [N m], for each position all speeds; zero if none are given.

    Raises:
        InputError: If a range is empty or not finite, a number of splines is below 4 and not 1, `bend` or
            `scale` is not positive, or there is not one weight for each spline.

    Source: C. de Boor, A Practical Guide to Splines, 1978, chapter 9; P. Eilers and B. Marx, Statist. Sci.
    11, 1996.

    >>> LearnedTorque(at="hub", count=(1, 6)).values
    {'w0': 0.0, 'w1': 0.0, 'w2': 0.0, 'w3': 0.0, 'w4': 0.0, 'w5': 0.0}
    """

    name: ClassVar[str] = "learned_torque"
    title: ClassVar[str] = "learned torque"
    equation: ClassVar[str] = "tau = smooth map of position and speed"

    position: tuple[float, float] = (-1.0, 1.0)
    speed: tuple[float, float] = (-5.0, 5.0)
    bend: float = 0.1
    count: tuple[int, int] = (6, 10)
    scale: float = 0.02
    weights: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for axis, (low, high) in (("position", self.position), ("speed", self.speed)):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(
                    f"LearnedTorque was given {axis}={(low, high)}, but it needs a range; give the lower "
                    "end first."
                )
        if not all(c == 1 or c >= SPLINE_SUPPORT for c in self.count) or not (self.bend > 0 < self.scale):
            raise InputError(
                f"LearnedTorque was given count={self.count}, bend={self.bend} and scale={self.scale}, but "
                f"it needs 1 or at least {SPLINE_SUPPORT} splines along each axis and positive sizes; "
                "correct them."
            )
        size = self.count[0] * self.count[1]
        if not self.weights:
            object.__setattr__(self, "weights", (0.0,) * size)
        if len(self.weights) != size:
            raise InputError(
                f"LearnedTorque was given {len(self.weights)} weights, but {self.count[0]} x {self.count[1]} "
                "splines need one each; give as many."
            )

    @property
    def values(self) -> dict[str, Any]:
        """Weights by name [N m]."""
        return {f"w{i}": w for i, w in enumerate(self.weights)}

    def own_specifications(self) -> dict[str, Specification]:
        """One specification for each weight."""
        weight = Specification(unit="N m", typical=self.scale, meaning="torque at a spline")
        return dict.fromkeys(self.values, weight)

    def replace(self: LearnedType, **values: Any) -> LearnedType:
        """The same map with other weights, by name or as a whole."""
        weights = list(values.pop("weights", self.weights))
        for name in [n for n in values if n[:1] == "w" and n[1:].isdigit()]:
            weights[int(name[1:])] = values.pop(name)
        return dataclasses.replace(self, weights=tuple(weights), **values)

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        along, across = self.splines(position, speed)
        weights = jnp.stack([jnp.asarray(w) for w in self.weights]).reshape(self.count)
        wide = weights.reshape(self.count + (1,) * jnp.ndim(across[0]))
        return jnp.sum(along * jnp.sum(wide * across[None], axis=1), axis=0)

    def splines(self, position: Scalar, speed: Scalar) -> tuple[Float[Array, "I ..."], Float[Array, "J ..."]]:
        """Values of the splines along position and along speed."""
        low, high = (math.asinh(s / self.bend) for s in self.speed)
        return (
            _splines(position, *self.position, self.count[0]),
            _splines(jnp.arcsinh(speed / self.bend), low, high, self.count[1]),
        )

    def design(
        self, position: Real[np.ndarray, " N"], speed: Real[np.ndarray, " N"]
    ) -> Float[np.ndarray, "N W"]:
        """Regressors of the weights."""
        with double_precision():
            along, across = self.splines(jnp.asarray(position, float), jnp.asarray(speed, float))
            return np.asarray(jnp.einsum("ik,jk->kij", along, across)).reshape(len(position), -1)


def _splines(x: Any, low: float, high: float, count: int) -> Array:
    """Cubic B-splines (count, ...) on equal intervals, constant beyond the ends."""
    x = jnp.asarray(x)
    if count == 1:
        return jnp.ones((1, *x.shape), x.dtype)
    s = jnp.clip((x - low) / (high - low), 0.0, 1.0) * (count - SPLINE_SUPPORT + 1)
    middles = jnp.arange(-1, count - 1, dtype=x.dtype)
    a = jnp.abs(s[None] - middles.reshape((-1,) + (1,) * x.ndim))
    near, far = jnp.maximum(1 - a, 0.0), jnp.maximum(2 - a, 0.0)
    return (far**3 - 4 * near**3) / 6
