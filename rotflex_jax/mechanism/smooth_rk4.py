"""Independent check of the step: classical Runge-Kutta on all equations, friction smoothed by tanh.

Use it to check `Exponential`, not to identify friction: the smoothing width biases the friction level
and looks like a Stribeck effect.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Real

from rotflex_jax.checks import positive, whole
from rotflex_jax.effects.base import DryFriction, Gear
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import EquationsOfMotion, Layout, effects_of, equations
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.small_matrices import matvec, scaled_vector
from rotflex_jax.mechanism.step import (
    LoadRows,
    friction_level,
    load_rows,
    memory_rates,
    port_motion,
    torques,
    transmitted_torques,
    voltage_of,
)


class SmoothConstants(NamedTuple):
    """Constants of the Runge-Kutta step.

    Attributes:
        values: Parameter values.
        gates: One factor per effect.
        h: Length of a step [s].
        equations: Equations of motion of the linear part.
        load: Rows of the transmitted torques; None if no friction depends on them.
    """

    values: Real[Array, " P"]
    gates: Float[Array, " E"]
    h: Float[Array, ""]
    equations: EquationsOfMotion
    load: LoadRows | None


@dataclasses.dataclass(frozen=True)
class SmoothRK4:
    """Classical Runge-Kutta of order 4 with friction `level * tanh(speed / width)`.

    Stable while `h < 2.5 J width / level` and while h is short compared with the fastest linear mode.

    Attributes:
        width: Speed over which friction changes sign [rad/s].
        substeps: Steps per sample.
    """

    width: float = 0.02
    substeps: int = 20

    def __post_init__(self) -> None:
        # As Python's numbers, which a model file and the key of a program can hold.
        object.__setattr__(self, "width", positive(self.width, "width", "rad/s", "0.02"))
        object.__setattr__(self, "substeps", whole(self.substeps, "substeps", 1))

    def inputs(self, v: Float[Array, " N"]) -> Float[Array, " N"]:
        """Input of `advance` at each sample, for a sequence of voltages."""
        return v

    def prepare(
        self,
        structure: Mechanism,
        values: Real[Array, " P"],
        gates: Float[Array, " E"],
        Ts: Float[Array, ""],
    ) -> SmoothConstants:
        """Constants for `advance`."""
        if effects_of(structure, Gear):
            raise InputError(
                "SmoothRK4 cannot integrate a gear with play, but one was given; use Exponential."
            )
        mechanism = structure.with_values(values)
        eq = equations(mechanism, gates)
        return SmoothConstants(values, gates, Ts / self.substeps, eq, load_rows(mechanism, gates))

    def advance(
        self, structure: Mechanism, x: Float[Array, "n *S"], v: Float[Array, "*cS"], c: SmoothConstants
    ) -> Float[Array, "n *S"]:
        """State one sample later under the held voltage `v` [V]; signals follow it as in `Exponential`."""
        mechanism = structure.with_values(c.values)

        def step(_: Any, s: Array) -> Array:
            k1 = self._flow(mechanism, s, v, c)
            k2 = self._flow(mechanism, s + c.h / 2 * k1, v, c)
            k3 = self._flow(mechanism, s + c.h / 2 * k2, v, c)
            k4 = self._flow(mechanism, s + c.h * k3, v, c)
            return s + c.h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

        return jax.lax.fori_loop(0, self.substeps, step, x)

    def _flow(self, mechanism: Mechanism, x: Array, v: Array, c: SmoothConstants) -> Array:
        layout, eq = Layout.of(mechanism.structure), c.equations
        L, z, voltage = x[: layout.linear], x[layout.linear :], voltage_of(mechanism, v)
        dL = matvec(eq.A, L) + scaled_vector(eq.B, voltage)
        if not layout.torque_ports:
            return dL
        total = torques(mechanism, L, z, v, c.gates)
        position, speed = port_motion(layout, L)
        load = transmitted_torques(mechanism, c.load, L, z, v, c.gates)
        for i, e in effects_of(mechanism, DryFriction):
            k = layout.torque_ports.index(e.at)
            size = jnp.abs(speed[k])
            through = None if load is None else load[k]
            up, down = (friction_level(e, position[k], size, way, through) for way in (1.0, -1.0))
            smooth = jnp.tanh(speed[k] / self.width)
            total = total.at[k].add(-c.gates[i] * jnp.where(smooth > 0, up, down) * smooth)
        dL = dL + matvec(eq.ports, total)
        return jnp.concatenate([dL, memory_rates(mechanism, L, z, voltage, c.gates)]) if z.shape[0] else dL
