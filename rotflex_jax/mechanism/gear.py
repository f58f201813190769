"""One step with play in the gear: rotor and port in contact, or the rotor in flight between the stops.

In contact the equations are the same as without play, and their exact step is used. In flight the equations
have one more coordinate, and the torque of the teeth keeps the rotor within its stops. A step in which the
teeth make contact or separate represents that torque by its first three moments over the step: an impulse at
the instant of impact and a constant torque after it, or a torque that falls linearly to zero.

Source: F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, chapter 6, for the
states of a contact and the conditions that end them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from rotflex_jax.effects.base import Gear, Linear, Stamp
from rotflex_jax.mechanism.assembly import (
    Constants,
    EquationsOfMotion,
    Layout,
    PlacedStamp,
    effects_of,
    equations_from_stamps,
    from_equations,
    phi_functions,
    stamped,
)
from rotflex_jax.mechanism.friction import divided
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.shortcut import shortcut
from rotflex_jax.mechanism.small_matrices import matvec, with_rows

# From moments of order 0, 1, 2 on [0, 1] to the polynomial of degree two that has them: inverse of the
# Hilbert matrix.
MOMENTS_TO_POLYNOMIAL = np.array([[9.0, -36.0, 30.0], [-36.0, 192.0, -180.0], [30.0, -180.0, 180.0]])


class GearConstants(NamedTuple):
    """Constants of a step with play, formed once per parameter set.

    Attributes:
        gap: Angle from the middle to each stop, zero where the gear is switched off [rad].
        flight: Constants of the step while the rotor is in flight.
        line: Response of the m linear states to the teeth's torque on the port: one column for a constant
            torque, one for a torque that grows from 0 to 1 over the step.
        moments: The same for a torque with the first, second or third moment alone.
        correction: Constant and growing tooth torque that cancel an error of the rotor's angle and speed.
        mass: Effective inertia of an impact of the teeth [kg m^2].
        teeth: Stiffness and damping of elastic teeth, None where they are rigid.
    """

    gap: Float[Array, ""]
    flight: Constants
    line: Float[Array, "m 2"]
    moments: Float[Array, "m 3"]
    correction: Float[Array, "2 2"]
    mass: Float[Array, ""]
    teeth: tuple[Float[Array, ""], Float[Array, ""]] | None


def gear_steps(structure: Mechanism) -> int:
    """Number of shorter steps into which a gear divides each step; one without a gear."""
    return max((gear.steps for _, gear in effects_of(structure, Gear)), default=1)


def gear_constants(
    mechanism: Mechanism, values: Real[Array, " P"], gates: Float[Array, " E"], tight: Constants
) -> GearConstants | None:
    """Constants of `geared_step` or of `elastic_step`, or None where no gear has play.

    Args:
        mechanism: Structure.
        values: Parameter values.
        gates: One factor per effect.
        tight: Constants of the step without play.
    """
    known = mechanism.with_values(values)
    gears = effects_of(known, Gear)
    if not gears:
        return None
    ((i, gear),) = gears
    layout, h = Layout.of(mechanism.structure), tight.h
    eq, push = _equations(known, gear, gates, layout)
    _, one, two, three = phi_functions(eq.A, push[:, None], h, 3)
    ends = jnp.concatenate([one, two, 2 * three], axis=1)
    angle, speed = layout.rotor, layout.rotor + 1
    line = ends[:, :2]
    (a, b), (p, q) = line[angle], line[speed]
    # In flight the gear transmits no torque.
    load = jax.tree.map(jnp.zeros_like, tight.load)
    flight = from_equations(eq, layout, values, gates, h, tight.half_E is not None)._replace(load=load)
    teeth = gear.teeth()
    if teeth is not None:
        # The rotor of a gear that is switched off stays at rest, and its teeth never touch.
        flight = jax.tree.map(lambda apart, one: jnp.where(gates[i] > 0, apart, one), flight, tight)
        teeth = (jnp.asarray(teeth[0], h.dtype), jnp.asarray(teeth[1], h.dtype))
    # Responses of the whole state; zero for memories, which do not respond at once.
    padded = lambda m: jnp.pad(m, ((0, layout.size - len(m)), (0, 0)))  # noqa: E731
    return GearConstants(
        gap=gates[i] * gear.stops(),
        flight=flight,
        line=padded(line),
        moments=padded(ends @ jnp.asarray(MOMENTS_TO_POLYNOMIAL, ends.dtype)),
        correction=-jnp.array([[q, -b], [-p, a]]) / (a * q - b * p),
        mass=-1 / push[speed],
        teeth=teeth,
    )


def _equations(known: Mechanism, gear: Gear, gates: Array, layout: Layout) -> tuple[EquationsOfMotion, Array]:
    """Equations of motion with the rotor in flight, and the column of the teeth's torque on the port.

    The rotor's angle relative to the port is an additional coordinate. The motor, and every effect at the
    port `rotor`, acts at the sum of port and rotor.
    """
    n, share = layout.n, gear.rotor()
    acting = []
    for i, e in stamped(known):
        stamp, here = e.stamp(), isinstance(e, Linear) and e.at == gear.at
        motor = isinstance(e, Linear) and (known.on_rotor(e.at) or (here and e.motor))
        p = np.array([*known.vector(e), 1.0 if motor else 0.0])
        if here and not motor:
            rotor = Stamp(inertia=share * stamp.inertia)
            acting.append(PlacedStamp(rotor, np.array([*known.vector(e), 1.0]), gates[i]))
            stamp = stamp._replace(inertia=(1 - share) * stamp.inertia)
        acting.append(PlacedStamp(stamp, p, gates[i]))
    P = np.array(layout.port_matrix).reshape(len(layout.torque_ports), n)
    P = np.vstack([np.column_stack([P, np.array(layout.rotor_side)]), np.eye(n + 1)[n]])
    eq = equations_from_stamps(acting, P, layout.linear, gates.dtype)
    # From (q, r, dq, dr, linear states) to the order of the layout.
    order = np.array([*range(n), *range(n + 1, 2 * n + 1), *range(2 * n + 2, layout.linear), n, 2 * n + 1])
    ports = eq.ports[order]
    ordered = EquationsOfMotion(eq.A[order][:, order], eq.B[order], ports[:, :-1], eq.inverse_mass)
    return ordered, -ports[:, -1]


Advance = Callable[[Float[Array, "n *S"], Constants, Float[Array, "n *S"] | None], Float[Array, "n *S"]]


def geared_step(
    mechanism: Mechanism, x: Float[Array, "n *S"], c: Constants, advance: Advance
) -> Float[Array, "n *S"]:
    """State at the end of a step with rigid teeth.

    Args:
        mechanism: Mechanism with (traced) parameter values.
        x: State, or several states side by side.
        c: Constants with `gear`.
        advance: Function of state and constants that returns the state after the step. Its last argument,
            zero for memories, is added to the linear states at the end of the step.
    """
    layout, a = Layout.of(mechanism.structure), c.gear
    k, gap = layout.rotor, a.gap
    r = jnp.where(x[k] > gap, gap, jnp.where(x[k] < -gap, -gap, x[k]))
    s = x[k + 1]
    x = with_rows(x, {k: r})
    in_flight = advance(x, a.flight, None)
    touching = (jnp.abs(r) >= gap * (1 - 1e-9)) & (s == 0)
    stays, separation = _separation(r, in_flight[k], in_flight[k + 1], touching, a)
    beyond = jnp.abs(in_flight[k]) > gap
    stop = jnp.where(in_flight[k] > 0, gap, -gap)
    # Separated and driven back to the same stop within the step: treated as if it had stayed in contact.
    stays = stays | (touching & ~separation.separates & beyond & (stop * r > 0)) | (gap <= 0)
    impacts = beyond & ~separation.separates

    def in_contact() -> Array:
        return with_rows(advance(x, c, None), {k + 1: jnp.zeros_like(r)})

    def with_change_of_contact() -> Array:
        impact = _impact(r, s, in_flight[k], in_flight[k + 1], stop, impacts, c)
        moments = jnp.where(impacts[None], impact.moments, 0.0)
        moments = jnp.where(separation.separates[None], separation.moments, moments)
        push = matvec(a.moments, moments)
        response = advance(x, a.flight, push) - in_flight - push
        end = in_flight + push + jnp.where(impacts[None], delayed(impact.t, response, layout), response)
        rests = impacts & impact.rests
        # The response of friction and other torques to the teeth leaves an error of angle and speed.
        error = jnp.stack([end[k] - stop, end[k + 1]])
        end = end + matvec(a.line, jnp.where(rests[None], matvec(a.correction, error), 0.0))
        angle = jnp.where(rests, stop, jnp.where(end[k] > gap, gap, jnp.where(end[k] < -gap, -gap, end[k])))
        return with_rows(end, {k: angle, k + 1: jnp.where(rests, 0.0, end[k + 1])})

    # In most steps all states are in contact, or all are in flight. Each result is selected where it holds. A
    # branch is computed if any of the states side by side needs it, and is in the program once.
    changes = ~stays & (impacts | separation.separates)
    apart = shortcut(lambda: (~changes, lambda: in_flight), with_change_of_contact)
    return jnp.where(stays[None], shortcut(lambda: (~stays, lambda: apart), in_contact), apart)


class Separation(NamedTuple):
    """Teeth in contact at the start that separate within the step.

    Attributes:
        separates: Whether the teeth separate.
        moments: Moments of the tooth torque over the step.
    """

    separates: Bool[Array, "*S"]
    moments: Float[Array, "3 *S"]


def _separation(
    r: Array, angle: Array, speed: Array, touching: Array, a: GearConstants
) -> tuple[Array, Separation]:
    """Whether teeth stay in contact; if not, how they separate.

    Args:
        r: Angle of the rotor at the start, at a stop where the teeth are in contact.
        angle: Angle of the rotor at the end of the step if the teeth separate at once.
        speed: Speed of the rotor relative to the port at that end.
        touching: Whether the teeth are in contact at the start.
        a: Constants.
    """
    side = jnp.where(r > 0, 1.0, -1.0)
    # The torque that would keep them in contact, linear over the step.
    first, growth = side[None] * matvec(a.correction, jnp.stack([angle - r, speed]))
    last = first + growth
    stays = touching & (first >= 0) & (last >= 0)
    separates = touching & (first > 0) & (last < 0)
    t = jnp.where(separates, first, 0.0) / jnp.where(separates, first - last, 1.0)
    moments = side[None] * jnp.stack([first * t ** (m + 1) / ((m + 1) * (m + 2)) for m in range(3)])
    return stays, Separation(separates, moments)


def delayed(t: Float[Array, "*S"], response: Float[Array, "n *S"], layout: Layout) -> Float[Array, "n *S"]:
    """Response of friction and other torques to an impact at fraction `t` of a step, from `response` at 0."""
    positions = {*range(layout.n), layout.rotor}
    return response * jnp.stack([(1 - t) ** 2 if i in positions else 1 - t for i in range(len(response))])


class Cubic(NamedTuple):
    """`a + b t + d t^2 + e t^3` with the time in units of the step."""

    a: Float[Array, "*S"]
    b: Float[Array, "*S"]
    d: Float[Array, "*S"]
    e: Float[Array, "*S"]

    @classmethod
    def through(
        cls,
        first: Float[Array, "*S"],
        rise: Float[Array, "*S"],
        slope: Float[Array, "*S"],
        last: Float[Array, "*S"],
    ) -> "Cubic":
        """The cubic over a step with a first value, a rise, and slopes at the beginning and the end."""
        return cls(first, slope, 3 * rise - 2 * slope - last, slope + last - 2 * rise)

    def at(self, t: Float[Array, "*S"]) -> Float[Array, "*S"]:
        """Value at `t`."""
        return self.a + t * (self.b + t * (self.d + t * self.e))

    def slope(self, t: Float[Array, "*S"]) -> Float[Array, "*S"]:
        """Derivative at `t`."""
        return self.b + t * (2 * self.d + 3 * t * self.e)

    def integral(self, t: Float[Array, "*S"]) -> Float[Array, "*S"]:
        """Integral from 0 to `t`."""
        return t * (self.a + t * (self.b / 2 + t * (self.d / 3 + t * self.e / 4)))


class Impact(NamedTuple):
    """Teeth that come into contact within the step.

    Attributes:
        t: Fraction of the step until the impact.
        rests: Whether the teeth stay in contact.
        moments: Moments of the tooth torque over the step.
    """

    t: Float[Array, "*S"]
    rests: Bool[Array, "*S"]
    moments: Float[Array, "3 *S"]


def _impact(
    r: Array,
    s: Array,
    angle: Array,
    speed: Array,
    stop: Array,
    impacts: Array,
    c: Constants,
) -> Impact:
    """Impact at a stop that a rotor in flight has passed by the end of the step.

    Args:
        r: Angle of the rotor at the start.
        s: Speed of the rotor relative to the port at the start.
        angle: Angle of the rotor at the end of the step without the stop.
        speed: Speed of the rotor relative to the port at that end.
        stop: The stop that the rotor passes.
        impacts: Where the rotor passes it; elsewhere the result is any finite number.
        c: Constants.
    """
    # The cubic through both ends, in units of the step.
    travel, b, last = angle - r, c.h * s, c.h * speed
    flight = Cubic.through(r, travel, b, last)
    t = jnp.where(impacts, crossing_time(stop - r, b, travel - b), 0.0)
    for _ in range(2):
        slope = flight.slope(t)
        safe = impacts & (slope * stop > 0)
        miss = flight.at(t) - stop
        t = t - jnp.where(safe, miss, 0.0) / jnp.where(safe, slope, 1.0)
        t = jnp.where(t < 0, 0.0, jnp.where(t > 1, 1.0, t))
    slope = flight.slope(t)
    mass = c.gear.mass / c.h**2
    impulse, after = mass * slope, mass * (last - slope)
    rests = after * stop >= 0
    held = jnp.where(rests, after, 0.0)
    after_impact = (1.0, (1 + t) / 2, (1 + t + t * t) / 3)  # moments of a unit torque after the impact
    return Impact(t, rests, jnp.stack([impulse * t**m + held * after_impact[m] for m in range(3)]))


def crossing_time(
    distance: Float[Array, "*S"], b: Float[Array, "*S"], d: Float[Array, "*S"]
) -> Float[Array, "*S"]:
    """The root of `b t + d t^2 = distance` at which the motion crosses outwards."""
    side = jnp.where(distance + 0.0 == 0, jnp.sign(b + d), jnp.sign(distance))
    square = b * b + 4 * d * distance
    positive = square > 0
    root = side * jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
    straight = side * b >= 0
    below = jnp.where(straight, b + root, 2 * d)
    above = jnp.where(straight, 2 * distance, root - b)
    return divided(above, below)
