"""Torques of the effects that are neither linear nor dry friction, and the states these remember."""

import jax
import jax.numpy as jnp

from rotflex_jax.effects.kinds import Force, Linear, Memory
from rotflex_jax.mechanism.assembly import Layout, effects_of
from rotflex_jax.mechanism.combine import beside, combined, in_each
from rotflex_jax.mechanism.mechanism import Mechanism


def port_motion(layout: Layout, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Positions and speeds of the torque ports."""
    P, n = layout.port_matrix, layout.n
    return combined(P, x[:n]), combined(P, x[n : 2 * n])


def motor_torque(mechanism: Mechanism, at: str, x: jax.Array, v: jax.Array, gates: jax.Array) -> jax.Array:
    """Torque [N m] that the linear motors at a port give at the linear state `x` and voltage `v`.

    A current counts as settled: it jumps within the step with every new voltage, so its values at the
    ends of a step tell nothing of its mean.
    """
    layout = Layout.of(mechanism.structure)
    speed = combined((mechanism.port_vectors[at],), x[layout.n : 2 * layout.n])[0]
    total = jnp.zeros_like(speed)
    for i, e in effects_of(mechanism, Linear):
        if not (e.motor and e.at == at):
            continue
        stamp = e.stamp()
        total = total + gates[i] * (stamp.drive * v - stamp.damping * speed)
        if e.order:
            own = jnp.stack([jnp.stack([jnp.asarray(c, x.dtype) for c in row]) for row in stamp.own])
            columns = (stamp.from_speed, stamp.from_voltage)
            ways = jnp.stack([jnp.stack([jnp.asarray(c, x.dtype) for c in way]) for way in columns])
            per_speed, per_volt = -jnp.linalg.solve(own, ways.T).T @ jnp.stack(
                [jnp.asarray(c, x.dtype) for c in stamp.torque]
            )
            total = total + gates[i] * (per_speed * speed + per_volt * v)
    return total


def _drive(mechanism: Mechanism, e: Memory, x: jax.Array, v: jax.Array, gates: jax.Array) -> jax.Array:
    """The last argument of a memory law."""
    return v if e.driven_by == "voltage" else motor_torque(mechanism, e.at, x, v, gates)


def torques(mechanism: Mechanism, x: jax.Array, z: jax.Array, v: jax.Array, gates: jax.Array) -> jax.Array:
    """Torques (ports, ...) of forces and memories at the torque ports.

    Args:
        mechanism: With (traced) numbers.
        x: Linear part of the state (n, ...).
        z: Memories (m, ...).
        v: Voltage (...) [V].
        gates: One factor per effect.
    """
    layout = Layout.of(mechanism.structure)
    position, speed = port_motion(layout, x)
    total = [jnp.zeros(x.shape[1:], x.dtype)] * len(layout.torque_ports)
    law = lambda e, *motion: e.force(*motion)  # noqa: E731
    for i, e in effects_of(mechanism, Force):
        k = layout.torque_ports.index(e.at)
        total[k] = total[k] + gates[i] * in_each(e, law, position[k], speed[k], v)
    for m, (i, e) in enumerate(effects_of(mechanism, Memory)):
        k = layout.torque_ports.index(e.at)
        drive = _drive(mechanism, e, x, v, gates)
        total[k] = total[k] + gates[i] * in_each(e, law, z[m], position[k], speed[k], drive)
    return jnp.stack(total)


def flows(mechanism: Mechanism, x: jax.Array, z: jax.Array, v: jax.Array, gates: jax.Array) -> jax.Array:
    """Time derivatives (m, ...) of the memories; arguments as for `torques`."""
    layout = Layout.of(mechanism.structure)
    position, speed = port_motion(layout, x)
    rates, law = [], lambda e, *motion: e.flow(*motion)
    for m, (_, e) in enumerate(effects_of(mechanism, Memory)):
        k = layout.torque_ports.index(e.at)
        drive = _drive(mechanism, e, x, v, gates)
        rates.append(jnp.asarray(in_each(e, law, z[m], position[k], speed[k], drive)))
    return jnp.stack(rates)


def remember(
    mechanism: Mechanism, z: jax.Array, x: jax.Array, v: jax.Array, gates: jax.Array, h: jax.Array
) -> jax.Array:
    """Memories after `h` [s], motion held at `x`: exponential Rosenbrock-Euler, stable when stiff."""
    if not z.shape[0]:
        return z
    law = lambda s: flows(mechanism, x, s, v, gates)  # noqa: E731
    # Each flow depends on its own state only, so one direction tells all slopes.
    rate, slope = jax.jvp(law, (z,), (jnp.ones_like(z),))
    h = beside(h[None], z)
    a = slope * h
    small = jnp.abs(a) < 1e-6
    phi = jnp.where(small, 1 + a / 2, jnp.expm1(a) / jnp.where(small, 1.0, a))
    return z + h * phi * rate
