"""The motion that a reference asks for: states, voltage, and what the found effects take of it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from rotflex_jax.effects.base import DryFriction, Memory
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout, effects_of, rest_state
from rotflex_jax.mechanism.step import (
    advance_memories,
    friction_level,
    load_rows,
    port_motion,
    torques,
    transmitted_torques,
)
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

PASSES = 4
"""Times that torques and motion are computed from each other."""


@dataclasses.dataclass(frozen=True)
class PlannedMotion:
    """Where the linear part is to be at each sample, and the voltage that brings it there.

    Attributes:
        reference: Of the controlled position.
        states: Of the linear part.
        outputs: What the sensors should show.
        voltage: Feed-forward [V].
        torques: Of the compensated effects, in the order of the torque ports [N m].
    """

    reference: Float[np.ndarray, " N"]
    states: Float[np.ndarray, "N n"]
    outputs: Float[np.ndarray, "N C"]
    voltage: Float[np.ndarray, " N"]
    torques: Float[np.ndarray, "N p"]


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Quadratic optimal tracking of a reference that is known beforehand, by the linear part.

        x+ = A x + B u + d,   minimise  sum (c x - r)^2 + effort u^2

    Attributes:
        A: From sample to sample.
        B: Of the voltage.
        c: Row of the controlled position.
        effort: What a square volt costs [rad^2/V^2].

    Source: B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990, chapter 4.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, " n"]
    c: Float[np.ndarray, " n"]
    effort: float

    def solve(
        self, reference: Float[np.ndarray, " N"], pushes: Float[np.ndarray, "N n"]
    ) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, " N"]]:
        """States and voltages; what pushes the state in each sample (`d`) is known.

        Args:
            reference: Held at its last value after the end.
            pushes: Of the state, sample by sample.
        """
        A, B, c = self.A, self.B, self.c
        P = scipy.linalg.solve_discrete_are(A, B[:, None], np.outer(c, c), [[self.effort]])
        gain = 1 / (self.effort + B @ P @ B)
        K = gain * (B @ P @ A)
        closed = (A - np.outer(B, K)).T
        N = len(reference)
        # What is still to come, summed up backwards; the recursion is linear in c r and d.
        given = reference[:, None] * c - pushes @ P @ closed.T
        ahead = np.empty((N + 1, len(c)))
        ahead[N] = np.linalg.solve(np.eye(len(c)) - closed, given[-1])
        for k in range(N - 1, -1, -1):
            ahead[k] = given[k] + closed @ ahead[k + 1]
        forward = gain * (ahead[1:] - pushes @ P) @ B
        X, u = np.empty((N, len(c))), np.empty(N)
        x = at_rest(A, B, c, float(reference[0]))
        for k in range(N):
            X[k], u[k] = x, forward[k] - K @ x
            x = A @ x + B * u[k] + pushes[k]
        return X, u


def at_rest(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, " n"], c: Float[np.ndarray, " n"], position: float
) -> Float[np.ndarray, " n"]:
    """The state in which the linear part stands at a position: `x = A x + B u`, `c x = position`."""
    n = len(c)
    rows = np.block([[A - np.eye(n), B[:, None]], [c[None], np.zeros((1, 1))]])
    return np.linalg.lstsq(rows, np.append(np.zeros(n), position), rcond=None)[0][:n]


@persistent_jit(static=1)
def _torques_along(
    structure: Mechanism,
    values: Array,
    gates: Array,
    x: Array,
    z0: Array,
    v: Array,
    rest: Array,
    Ts: Array,
) -> Array:
    """Torques (p, N) of all effects but the linear ones along a motion (m, N)."""
    mechanism, layout = structure.with_values(values), Layout.of(structure)
    z = jnp.zeros((0, x.shape[1]), x.dtype)
    if effects_of(mechanism, Memory):

        def body(z: Array, w: Any) -> tuple[Array, Array]:
            at, voltage = w
            return advance_memories(mechanism, z, at, voltage, gates, Ts), z

        z = jax.lax.scan(body, z0, (x.T, v))[1].T
    total = torques(mechanism, x, z, v, gates)
    position, speed = port_motion(layout, x)
    loads = transmitted_torques(mechanism, load_rows(mechanism, gates), x, z, v, gates)
    for i, e in effects_of(mechanism, DryFriction):
        k = layout.torque_ports.index(e.at)
        load = None if loads is None else loads[k]
        size = jnp.abs(speed[k])
        up, down = (friction_level(e, position[k], size, way, load) for way in (1.0, -1.0))
        share = jnp.clip(speed[k] / rest, -1.0, 1.0)
        total = total.at[k].add(-gates[i] * share * jnp.where(share > 0, up, down))
    return total


def torques_along(
    model: Model, X: Float[np.ndarray, "N n"], v: Float[np.ndarray, " N"], rest: float, Ts: float
) -> Float[np.ndarray, "N p"]:
    """Torques of friction, forces and memories at the torque ports, where a motion is given [N m].

    Dry friction acts against the motion; below the speed `rest` it falls to zero linearly, for where nothing
    is to move it holds by itself and needs no voltage.

    Args:
        model: Its effects are evaluated.
        X: States of the linear part, without those of a gear's rotor.
        v: Voltage [V].
        rest: Speed below which a port counts as being at rest [rad/s].
        Ts: Sampling period [s].
    """
    structure = model.mechanism.structure
    layout = Layout.of(structure)
    if not layout.torque_ports:
        return np.zeros((len(X), 0))
    x = np.zeros((layout.linear, len(X)))
    x[: X.shape[1]] = X.T
    z0 = rest_state(structure, np.float64)[layout.linear :]
    with double_precision():
        values, gates = model.parameters_and_gates()
        found = _torques_along(structure, values, gates, x, z0, v, np.asarray(rest), np.asarray(Ts))
        return np.asarray(found).T
