"""From effects to the constants of one step: equations of motion, matrix exponential, port mobilities.

Everything here is formed once per set of parameters, outside the scan, and is differentiable.
"""

import dataclasses
import functools
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from rotflex_jax.effects.kinds import (
    Actuation,
    DryFriction,
    Effect,
    Force,
    Gear,
    Linear,
    Memory,
    Scalar,
    Stamp,
)
from rotflex_jax.mechanism.exponential import integrals
from rotflex_jax.mechanism.mechanism import Mechanism

Kind = TypeVar("Kind", bound=Effect)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where things sit, known from the structure alone.

    The state is `x = [q, dq, linear states, rotor's angle and speed, memory states]`; the first `linear`
    entries take part in the matrix exponential. `rotor` is where the two of the rotor stand, if a gear has
    play. Of the ports that carry torques, the first `contacts` have dry friction.
    """

    n: int
    linear: int
    size: int
    rotor: int
    torque_ports: tuple[str, ...]
    port_matrix: tuple[tuple[float, ...], ...]
    contacts: int
    output_rows: tuple[tuple[float, ...], ...]

    @classmethod
    @functools.cache
    def of(cls, structure: Mechanism) -> "Layout":
        """Layout of a structure."""
        n = len(structure.coordinates)
        rotor = 2 * n + sum(e.order for e in structure.effects if isinstance(e, Linear))
        linear = rotor + sum(e.order for e in structure.effects if isinstance(e, Gear))
        memory = sum(isinstance(e, Memory) for e in structure.effects)
        rough = [e for e in structure.effects if isinstance(e, (Force, Memory, DryFriction))]
        used = {e.at for e in rough}
        dry = {e.at for e in rough if isinstance(e, DryFriction)}
        names = tuple(p for p in structure.port_vectors if p in dry)
        names += tuple(p for p in structure.port_vectors if p in used - dry)
        rows = []
        for _, (port, what) in structure.outputs:
            vector = structure.port_vectors[port]
            zeros = (0.0,) * n
            rows.append(vector + zeros if what == "position" else zeros + vector)
        return cls(
            n=n,
            linear=linear,
            size=linear + memory,
            rotor=rotor,
            torque_ports=names,
            port_matrix=tuple(structure.port_vectors[p] for p in names),
            contacts=len(dry),
            output_rows=tuple(rows),
        )


def effects_of(mechanism: Mechanism, kind: type[Kind]) -> list[tuple[int, Kind]]:
    """Effects of one kind with their places in `mechanism.effects`."""
    return [(i, e) for i, e in enumerate(mechanism.effects) if isinstance(e, kind)]


class Equations(NamedTuple):
    """Linear part `x' = A x + B v + sum_ports b_p tau_p` and the inverse mass matrix."""

    A: jax.Array
    B: jax.Array
    ports: jax.Array
    inverse_mass: jax.Array


class Acting(NamedTuple):
    """What a linear effect writes, the direction of its port, and its gate."""

    stamp: Stamp
    port: np.ndarray
    gate: Scalar


def equations(mechanism: Mechanism, gates: jax.Array) -> Equations:
    """Equations of motion of the linear effects, each multiplied by its gate; a rotor's states rest.

    Args:
        mechanism: Numbers may be traced.
        gates: One factor per effect; one where it is on, zero where it is off.
    """
    layout = Layout.of(mechanism.structure)
    acting = [
        Acting(e.stamp(), np.array(mechanism.port_vectors[e.at]), gates[i])
        for i, e in effects_of(mechanism, Linear)
    ]
    P = np.array(layout.port_matrix).reshape(len(layout.torque_ports), layout.n)
    return assembled(acting, P, layout.linear, gates.dtype)


def assembled(acting: list[Acting], P: np.ndarray, size: int, dtype: jnp.dtype) -> Equations:
    """Equations of motion of `size` states; torques act at the ports P (ports, n)."""
    n = P.shape[1]
    M, D, K = (jnp.zeros((n, n), dtype) for _ in range(3))
    drive = jnp.zeros(n, dtype)
    extra: list[Acting] = []
    for stamp, p, gate in acting:
        outer = jnp.asarray(np.outer(p, p), dtype)
        M = M + gate * stamp.inertia * outer
        D = D + gate * stamp.damping * outer
        K = K + gate * stamp.stiffness * outer
        drive = drive + gate * stamp.drive * jnp.asarray(p, dtype)
        if stamp.own:
            extra.append(Acting(stamp, p, gate))
    Minv = jnp.linalg.inv(M)
    A = jnp.zeros((size, size), dtype).at[:n, n : 2 * n].set(jnp.eye(n, dtype=dtype))
    A = A.at[n : 2 * n, :n].set(-Minv @ K).at[n : 2 * n, n : 2 * n].set(-Minv @ D)
    B = jnp.zeros(size, dtype).at[n : 2 * n].set(Minv @ drive)
    at = 2 * n
    for stamp, p, gate in extra:
        m, vector = len(stamp.own), jnp.asarray(p, dtype)
        own = jnp.stack([jnp.stack([_scalar(c, dtype) for c in row]) for row in stamp.own])
        speed = jnp.stack([_scalar(c, dtype) for c in stamp.from_speed])
        torque = jnp.stack([_scalar(c, dtype) for c in stamp.torque])
        A = A.at[at : at + m, at : at + m].set(own)
        A = A.at[at : at + m, n : 2 * n].set(speed[:, None] * vector[None, :])
        A = A.at[n : 2 * n, at : at + m].set(gate * (Minv @ vector)[:, None] * torque[None, :])
        B = B.at[at : at + m].set(jnp.stack([_scalar(c, dtype) for c in stamp.from_voltage]))
        at += m
    ports = jnp.zeros((size, len(P)), dtype).at[n : 2 * n].set(Minv @ jnp.asarray(P.T, dtype))
    return Equations(A, B, ports, Minv)


def _scalar(value: Scalar, dtype: jnp.dtype) -> jax.Array:
    return jnp.asarray(value, dtype)


class Constants(NamedTuple):
    """What the exponential step needs, formed once per parameter set.

    With `phi_k` the exponential-integrator functions of `A h`: `E = exp(A h)`, `input = h phi_1 B`,
    `hold = h phi_1 b_p` (answer to a constant port torque), `ramp = h phi_2 b_p`, `rise = h phi_3 b_p`;
    `half_*` the same for `h / 2`. `stop[i, j]` is the speed that a unit torque at port j, held for one
    step, gives port i; `mobility` the same for a unit impulse; `push` what that does to the coordinates,
    one row per linear state. `apart` is what a gear with play needs besides (`gear`).
    """

    values: jax.Array
    gates: jax.Array
    h: jax.Array
    E: jax.Array
    input: jax.Array
    hold: jax.Array
    ramp: jax.Array
    rise: jax.Array
    half_E: jax.Array
    half_input: jax.Array
    half_hold: jax.Array
    stop: jax.Array
    mobility: jax.Array
    push: jax.Array
    apart: Any = None


def constants(mechanism: Mechanism, values: jax.Array, gates: jax.Array, h: jax.Array) -> Constants:
    """Constants of a step of length `h` [s] for traced parameter values."""
    layout = Layout.of(mechanism.structure)
    return from_equations(equations(mechanism.with_values(values), gates), layout, values, gates, h)


def from_equations(
    eq: Equations, layout: Layout, values: jax.Array, gates: jax.Array, h: jax.Array
) -> Constants:
    """Constants of a step of length `h` [s] for equations whose states are in the order of the layout."""
    n = layout.n
    V = jnp.concatenate([eq.B[:, None], eq.ports], axis=1)
    E, one, two, three = integrals(eq.A, V, h, 3)
    half_E, half = integrals(eq.A, V, h / 2, 1)
    P = jnp.asarray(np.array(layout.port_matrix).reshape(len(layout.torque_ports), n), E.dtype)
    # An impulse at a port moves the coordinates as the torque accelerates them.
    push = jnp.zeros_like(eq.ports).at[:n].set(eq.ports[n : 2 * n])
    if layout.linear > layout.rotor:
        push = push.at[layout.rotor].set(eq.ports[layout.rotor + 1])
    return Constants(
        values=values,
        gates=gates,
        h=h,
        E=E,
        input=one[:, 0],
        hold=one[:, 1:],
        ramp=two[:, 1:],
        rise=three[:, 1:],
        half_E=half_E,
        half_input=half[:, 0],
        half_hold=half[:, 1:],
        stop=P @ one[n : 2 * n, 1:],
        mobility=P @ push[:n],
        push=push,
    )


def driven_voltage(mechanism: Mechanism, gates: jax.Array, u: jax.Array, Ts: Scalar) -> jax.Array:
    """Voltage (N,) that reaches the motor after all actuation effects, nearest to the command first."""
    v = u
    for i, effect in sorted(effects_of(mechanism, Actuation), key=lambda pair: pair[1].stage):
        v = v + gates[i] * (effect.drive(v, Ts) - v)
    return v


def rest_state(structure: Mechanism, dtype: DTypeLike) -> np.ndarray:
    """State at rest: zero motion, memories at their initial value."""
    layout = Layout.of(structure)
    memory = [e.initial() for _, e in effects_of(structure, Memory)]
    return np.array([0.0] * layout.linear + memory, dtype=dtype)


def whole_state(structure: Mechanism, x0: jax.Array) -> jax.Array:
    """States (..., n) from their first entries (..., m), such as positions and speeds; the rest at rest."""
    rest = jnp.asarray(rest_state(structure, np.float64), x0.dtype)[x0.shape[-1] :]
    return jnp.concatenate([x0, jnp.broadcast_to(rest, (*x0.shape[:-1], len(rest)))], axis=-1)
