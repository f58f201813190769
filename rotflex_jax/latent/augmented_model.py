"""The augmented model: a mechanism with unknown torques as states, and its linear model along a motion."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rotflex_jax.effects.base import Force, Scalar
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.latent.smoother import LinearTimeVaryingModel
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import motor_voltage
from rotflex_jax.mechanism.scan import state_jacobians
from rotflex_jax.mechanism.simulate import read_outputs
from rotflex_jax.parameters import parameter
from rotflex_jax.runtime.persistent_jit import persistent_jit


@dataclasses.dataclass(frozen=True)
class UnknownTorque(Force):
    """A torque from outside, held over a sample."""

    name: ClassVar[str] = "unknown_torque"
    title: ClassVar[str] = "unknown torque"
    equation: ClassVar[str] = "tau = torque"

    # A placeholder where a mechanism is taken without its parameter values.
    torque: Any = parameter(0.0, unit="N m", meaning="torque held over a sample")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Any:
        """Torque [N m] on the port."""
        return self.torque


@dataclasses.dataclass(frozen=True)
class AugmentedStep:
    """The augmented state `[x, d]` one sample later: `d` are unknown torques, which decay.

    Attributes:
        structure: The mechanism without parameter values, its last effects the unknown torques.
        solver: Integration rule.
        torques: Number of unknown torques.
    """

    structure: Mechanism
    solver: Solver
    torques: int

    def __call__(
        self, s: Float[Array, "m *batch"], v: Float[Array, "*samples"], constants: Any
    ) -> Float[Array, "m *batch"]:
        """State one sample later under the voltage `v`; one state, or many side by side."""
        c, decay = constants
        x, d = s[: -self.torques], s[-self.torques :]
        known = c.values.shape[0] - self.torques
        values = [*(c.values[i] for i in range(known)), *d]
        x = self.solver.advance(self.structure, x, v, c._replace(values=values))
        return jnp.concatenate([x, decay * d])


@persistent_jit(static=2)
def predicted_states(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, "R n"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
) -> Float[Array, "R N n"]:
    """States of a predictor with the gains `K`, which stays near the measured outputs."""

    def one(x0: Any, K: Any, u: Any, y: Any, seen: Any, Ts: Any) -> jax.Array:
        return predictor_run(structure, solver, values, gates, x0, u, y, seen, K, Ts)[0]

    return jax.vmap(one)(x0, K, *data)


@persistent_jit(static=1)
def linearise_along(
    step: AugmentedStep,
    values: Float[Array, " P"],
    gates: Float[Array, " E"],
    S: Float[Array, "R N m"],
    data: StackedRecordings,
    decay: Float[Array, " R"],
) -> LinearTimeVaryingModel:
    """Linear models (R, ...), tangent to the augmented model along its states `S`."""
    mechanism = step.structure.with_values(values)

    def one(S: Any, u: Any, y: Any, seen: Any, Ts: Any, decay: Any) -> LinearTimeVaryingModel:
        constants = (step.solver.prepare(step.structure, values, gates, Ts), decay)
        v = step.solver.inputs(motor_voltage(mechanism, gates, u, Ts))
        A = jnp.swapaxes(state_jacobians(step, S, v, constants), 1, 2)
        s_next = step(S.T, jnp.moveaxis(v, 0, -1), constants).T
        outputs = lambda s: read_outputs(mechanism, gates, s[: -step.torques])  # noqa: E731
        H = jax.vmap(jax.jacfwd(outputs))(S)
        times_state = lambda M: jnp.sum(M * S[:, None, :], axis=2)  # noqa: E731
        c, y = s_next - times_state(A), y - outputs(S.T).T + times_state(H)
        return LinearTimeVaryingModel(A, c, H, y, seen)

    return jax.vmap(one)(S, *data, decay)
