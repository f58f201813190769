"""One step with play in the gear: rotor and port turn as one, or the rotor flies, meets a stop, lets go.

As one they obey the equations without play, whose exact step serves. Apart they obey the equations of one
coordinate more, and the teeth push with a torque that is whatever keeps the rotor inside its stops. A step in
which the teeth meet or part counts that torque by its first three moments over the step: an impulse at the
instant at which the stop is reached and a constant torque after it, or a torque that falls to zero on a line.

Source: F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, chapter 6, for the two
states of a contact and what ends them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.effects.kinds import Gear, Linear
from rotflex_jax.effects.stamp import Stamp
from rotflex_jax.mechanism.assembly import (
    Acting,
    Constants,
    Equations,
    Layout,
    assembled,
    effects_of,
    from_equations,
)
from rotflex_jax.mechanism.combine import apply
from rotflex_jax.mechanism.exponential import integrals
from rotflex_jax.mechanism.mechanism import Mechanism

# Polynomial of degree two on [0, 1] with given moments of order 0, 1, 2: inverse of the Hilbert matrix.
POLYNOMIAL = np.array([[9.0, -36.0, 30.0], [-36.0, 192.0, -180.0], [30.0, -180.0, 180.0]])


class Apart(NamedTuple):
    """What a step with play needs, formed once per parameter set.

    Attributes:
        gap: Angle from the middle to each stop, zero where the gear is switched off.
        free: The step while the rotor turns alone.
        line: What the teeth's torque on the port does to the linear states: columns for a constant one and
            for one that grows from 0 to 1 over the step (m, 2).
        moments: The same for a torque with only the first, second, third moment (m, 3).
        settle: Constant and growing torque that take back an error of the rotor's angle and speed (2, 2).
        mass: Inertia that an impact of the teeth meets [kg m^2].
    """

    gap: jax.Array
    free: Constants
    line: jax.Array
    moments: jax.Array
    settle: jax.Array
    mass: jax.Array


def apart(mechanism: Mechanism, values: jax.Array, gates: jax.Array, h: jax.Array) -> Apart | None:
    """Constants for `geared_step`, or None where no gear has play."""
    known = mechanism.with_values(values)
    gears = effects_of(known, Gear)
    if not gears:
        return None
    ((i, gear),) = gears
    layout = Layout.of(mechanism.structure)
    eq, teeth = _equations(known, gear, gates, layout)
    _, one, two, three = integrals(eq.A, teeth[:, None], h, 3)
    ends = jnp.concatenate([one, two, 2 * three], axis=1)
    angle, speed = layout.rotor, layout.rotor + 1
    line = ends[:, :2]
    (a, b), (p, q) = line[angle], line[speed]
    return Apart(
        gap=gates[i] * gear.stops(),
        free=from_equations(eq, layout, values, gates, h),
        line=line,
        moments=ends @ jnp.asarray(POLYNOMIAL, ends.dtype),
        settle=-jnp.array([[q, -b], [-p, a]]) / (a * q - b * p),
        mass=-1 / teeth[speed],
    )


def _equations(known: Mechanism, gear: Gear, gates: jax.Array, layout: Layout) -> tuple[Equations, jax.Array]:
    """Equations of motion with the rotor on its own, and the column of the teeth's torque on the port.

    The rotor's angle against the port is one coordinate more, and the motor acts at port plus rotor.
    """
    n, share = layout.n, gear.rotor()
    acting = []
    for i, e in effects_of(known, Linear):
        stamp, here = e.stamp(), e.at == gear.at
        p = np.array([*known.port_vectors[e.at], 1.0 if here and e.motor else 0.0])
        if here and not e.motor:
            rotor = Stamp(inertia=share * stamp.inertia)
            acting.append(Acting(rotor, np.array([*known.port_vectors[e.at], 1.0]), gates[i]))
            stamp = stamp._replace(inertia=(1 - share) * stamp.inertia)
        acting.append(Acting(stamp, p, gates[i]))
    P = np.array(layout.port_matrix).reshape(len(layout.torque_ports), n)
    P = np.vstack([np.column_stack([P, np.zeros(len(P))]), np.eye(n + 1)[n]])
    eq = assembled(acting, P, layout.linear, gates.dtype)
    # From (q, r, dq, dr, linear states) to the order of the layout.
    order = np.array([*range(n), *range(n + 1, 2 * n + 1), *range(2 * n + 2, layout.linear), n, 2 * n + 1])
    ports = eq.ports[order]
    ordered = Equations(eq.A[order][:, order], eq.B[order], ports[:, :-1], eq.inverse_mass)
    return ordered, -ports[:, -1]


def geared_step(
    mechanism: Mechanism,
    x: jax.Array,
    c: Constants,
    advance: Callable[[jax.Array, Constants, jax.Array | None], jax.Array],
) -> jax.Array:
    """State at the end of a step.

    Args:
        mechanism: With (traced) numbers.
        x: State (n, ...).
        c: Constants with `apart`.
        advance: State and constants to the state after the step; its last argument is what else comes
            to the linear states by then.
    """
    layout, a = Layout.of(mechanism.structure), c.apart
    k, gap = layout.rotor, a.gap
    r = jnp.where(x[k] > gap, gap, jnp.where(x[k] < -gap, -gap, x[k]))
    s = x[k + 1]
    x = x.at[k].set(r)
    one, alone = advance(x, c, None), advance(x, a.free, None)
    touching = (jnp.abs(r) >= gap * (1 - 1e-9)) & (s == 0)
    kept, parting = _parting(r, alone[k], alone[k + 1], touching, a)
    beyond = jnp.abs(alone[k]) > gap
    stop = jnp.where(alone[k] > 0, gap, -gap)
    # Left for good and thrown back at once: as if it had stayed.
    kept = kept | (touching & ~parting.leaves & beyond & (stop * r > 0)) | (gap <= 0)
    hits = beyond & ~parting.leaves
    meeting = _meeting(r, s, alone[k], alone[k + 1], stop, hits, c)
    moments = jnp.where(parting.leaves[None], parting.moments, jnp.where(hits[None], meeting.moments, 0.0))
    push = apply(a.moments, moments)
    push = jnp.concatenate([push, jnp.zeros_like(x[len(push) :])])
    answer = advance(x, a.free, push[: len(a.line)]) - alone - push
    end = alone + push + jnp.where(hits[None], _late(meeting.t, answer, layout), answer)
    rests = hits & meeting.rests
    # Friction and other torques have answered to the teeth.
    error = jnp.stack([end[k] - stop, end[k + 1]])
    taken = apply(a.line, jnp.where(rests[None], apply(a.settle, error), 0.0))
    end = end.at[: len(taken)].add(taken)
    angle = jnp.where(rests, stop, jnp.where(end[k] > gap, gap, jnp.where(end[k] < -gap, -gap, end[k])))
    end = end.at[k].set(angle).at[k + 1].set(jnp.where(rests, 0.0, end[k + 1]))
    return jnp.where(kept[None], one.at[k + 1].set(0.0), end)


class Parting(NamedTuple):
    """Teeth that touch at the start and let go within the step, and the moments of their torque."""

    leaves: jax.Array
    moments: jax.Array


def _parting(
    r: jax.Array, angle: jax.Array, speed: jax.Array, touching: jax.Array, a: Apart
) -> tuple[jax.Array, Parting]:
    """Whether touching teeth keep touching; otherwise when they part.

    Args:
        r: Angle of the rotor at the start, at a stop where the teeth touch.
        angle: At the end of a step in which they let go at once.
        speed: The same.
        touching: Whether they touch.
        a: Constants.
    """
    side = jnp.where(r > 0, 1.0, -1.0)
    # The torque that would keep them together, on a line from the start of the step to its end.
    first, growth = side[None] * apply(a.settle, jnp.stack([angle - r, speed]))
    last = first + growth
    kept = touching & (first >= 0) & (last >= 0)
    leaves = touching & (first > 0) & (last < 0)
    t = jnp.where(leaves, first, 0.0) / jnp.where(leaves, first - last, 1.0)
    moments = side[None] * jnp.stack([first * t ** (m + 1) / ((m + 1) * (m + 2)) for m in range(3)])
    return kept, Parting(leaves, moments)


def _late(t: jax.Array, answer: jax.Array, layout: Layout) -> jax.Array:
    """What friction and other torques answer to an impact at the share `t` of a step, not at its start."""
    positions = {*range(layout.n), layout.rotor}
    return answer * jnp.stack([(1 - t) ** 2 if i in positions else 1 - t for i in range(len(answer))])


class Meeting(NamedTuple):
    """Teeth that meet within the step: when, whether they stay together, and the moments of their torque."""

    t: jax.Array
    rests: jax.Array
    moments: jax.Array


def _meeting(
    r: jax.Array,
    s: jax.Array,
    angle: jax.Array,
    speed: jax.Array,
    stop: jax.Array,
    hits: jax.Array,
    c: Constants,
) -> Meeting:
    """What happens at a stop that a rotor in flight has passed by the end of the step.

    Args:
        r: Angle of the rotor at the start.
        s: Its speed against the port.
        angle: At the end of the step without the stop.
        speed: The same.
        stop: The stop that it passes.
        hits: Where that is so; the rest is any finite number.
        c: Constants.
    """
    # The cubic through both ends, in units of the step: r + b t + d t^2 + e t^3.
    way, b, last = angle - r, c.h * s, c.h * speed
    d, e = 3 * way - 2 * b - last, b + last - 2 * way
    t = jnp.where(hits, _passage(stop - r, b, way - b), 0.0)
    for _ in range(2):
        slope = b + t * (2 * d + 3 * t * e)
        safe = hits & (slope * stop > 0)
        miss = r + t * (b + t * (d + t * e)) - stop
        t = t - jnp.where(safe, miss, 0.0) / jnp.where(safe, slope, 1.0)
        t = jnp.where(t < 0, 0.0, jnp.where(t > 1, 1.0, t))
    slope = b + t * (2 * d + 3 * t * e)
    mass = c.apart.mass / c.h**2
    impulse, after = mass * slope, mass * (last - slope)
    rests = after * stop >= 0
    held = jnp.where(rests, after, 0.0)
    spread = (1.0, (1 + t) / 2, (1 + t + t * t) / 3)  # moments of one over what is left of the step
    return Meeting(t, rests, jnp.stack([impulse * t**m + held * spread[m] for m in range(3)]))


def _passage(gone: jax.Array, b: jax.Array, d: jax.Array) -> jax.Array:
    """The later root of `b t + d t^2 = gone` where the motion is through there and not back."""
    way = jnp.where(gone + 0.0 == 0, jnp.sign(b + d), jnp.sign(gone))
    square = b * b + 4 * d * gone
    positive = square > 0
    root = way * jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
    straight = way * b >= 0
    below = jnp.where(straight, b + root, 2 * d)
    above = jnp.where(straight, 2 * gone, root - b)
    return above / jnp.where(below == 0, 1.0, below)
