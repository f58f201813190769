"""A mechanism with unknown torques at some ports, and its linear model along a motion."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rotflex_jax.effects.kinds import Force, Scalar
from rotflex_jax.fit.residuals import Data
from rotflex_jax.latent.smoother import Linear
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import driven_voltage
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.propagate import slopes
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.parameters import parameter


@dataclasses.dataclass(frozen=True)
class Push(Force):
    """A torque that comes from outside and is held over a sample."""

    name: ClassVar[str] = "unknown_torque"
    title: ClassVar[str] = "unknown torque"
    equation: ClassVar[str] = "tau = torque"

    torque: float = parameter(0.0, unit="N m", meaning="torque held over a sample")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        return self.torque


@dataclasses.dataclass(frozen=True)
class PushedStep:
    """`[x, d]` one sample later: the mechanism under the torques `d`, which fade by themselves.

    Attributes:
        structure: The mechanism without numbers, its last effects the pushes.
        solver: Integration rule.
        pushes: How many.
    """

    structure: Mechanism
    solver: Solver
    pushes: int

    def __call__(self, s: jax.Array, v: jax.Array, constants: Any) -> jax.Array:
        """State one sample later under the voltage `v`; one state, or many side by side (m, ...)."""
        c, decay = constants
        x, d = s[: -self.pushes], s[-self.pushes :]
        known = c.values.shape[0] - self.pushes
        values = [*(c.values[i] for i in range(known)), *d]
        moved = self.solver.advance(self.structure, x, v, c._replace(values=values))
        return jnp.concatenate([moved, decay * d])


@kept(static=2)
def followed(
    structure: Mechanism, solver: Solver, values: jax.Array, gates: jax.Array, x0: Any, data: Data, K: Any
) -> jax.Array:
    """States (R, N, n) of a predictor that stays near what was measured."""

    def one(x0: Any, K: Any, u: Any, y: Any, seen: Any, Ts: Any) -> jax.Array:
        return predictor_run(structure, solver, values, gates, x0, u, y, seen, K, Ts)[0]

    return jax.vmap(one)(x0, K, *data)


@kept(static=1)
def linear_model(
    step: PushedStep, values: jax.Array, gates: jax.Array, S: jax.Array, data: Data, decay: jax.Array
) -> Linear:
    """The linear models (R, ...) that touch the mechanism along the states S (R, N, m)."""
    mechanism = step.structure.with_values(values)

    def one(S: jax.Array, u: Any, y: Any, seen: Any, Ts: Any, decay: Any) -> Linear:
        constants = (step.solver.prepare(step.structure, values, gates, Ts), decay)
        v = step.solver.inputs(driven_voltage(mechanism, gates, u, Ts))
        A = jnp.swapaxes(slopes(step, S, v, constants), 1, 2)
        reached = step(S.T, jnp.moveaxis(v, 0, -1), constants).T
        read = lambda s: read_outputs(mechanism, gates, s[: -step.pushes])  # noqa: E731
        H = jax.vmap(jax.jacfwd(read))(S)
        wide = lambda M: jnp.sum(M * S[:, None, :], axis=2)  # noqa: E731
        return Linear(A, reached - wide(A), H, y - read(S.T).T + wide(H), seen)

    return jax.vmap(one)(S, *data, decay)
