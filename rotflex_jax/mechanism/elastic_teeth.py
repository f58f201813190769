"""One step with play in a gear whose teeth are elastic: flight, contact and separation within the step.

In flight the equations are the same as in `gear`, with the rotor as one more coordinate. The teeth oscillate
above the sampling frequency, so a step cannot sample their torque. The motion of the rotor relative to the
port is an oscillator, driven by the relative motion without the teeth (a cubic over the step):

    depth'' + damping/mass depth' + stiffness/mass depth = r_flight''

Its solution is known in closed form. From it follow the end of the contact, where the torque falls to zero,
and the first three moments of the torque over the step, through which the torque acts on all states. The step
is stable at any stiffness.

Source: K. L. Johnson, Contact Mechanics, 1985, section 11.5 (impact as half a period of an oscillator);
F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, chapter 6.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rotflex_jax.mechanism.assembly import Constants, Layout
from rotflex_jax.mechanism.gear import Advance, Cubic, crossing_time, delayed
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.small_matrices import matvec

# Number of intervals in which the first sign change of the tooth torque is searched, and how often the first
# of these intervals is halved.
LOOKS, HALVINGS = 8, 3


class Swing(NamedTuple):
    """Free motion of a damped oscillator: decaying cosine and sine over its frequency, also where overdamped.

    Attributes:
        cosine: Motion from a unit deflection, less half the damping times `sine`.
        sine: Motion from a unit speed.
    """

    cosine: Float[Array, "*S"]
    sine: Float[Array, "*S"]


def swing(stiff: Float[Array, "*S"], loss: Float[Array, "*S"], t: Float[Array, "*S"]) -> Swing:
    """Free motion of `y'' + loss y' + stiff y = 0` after the time `t`."""
    square = stiff - loss * loss / 4
    near = jnp.abs(square) * t * t < 1e-4
    quick, over = ~near & (square > 0), ~near & (square < 0)
    w = jnp.sqrt(jnp.where(quick, square, 1.0))
    v = jnp.sqrt(jnp.where(over, -square, 1.0))
    # If overdamped, the slower of two exponents, without a difference of large numbers; else the only one.
    fade = jnp.exp(-jnp.where(over, stiff / (loss / 2 + v), loss / 2) * t)
    fast = jnp.exp(-jnp.where(over, loss / 2 + v, 0.0) * t)
    z = jnp.where(near, square * t * t, 0.0)
    cosine = jnp.where(quick, fade * jnp.cos(w * t), (fade + fast) / 2)
    sine = jnp.where(quick, fade * jnp.sin(w * t) / w, (fade - fast) / (2 * v))
    cosine = jnp.where(near, fade * (1 - z / 2 * (1 - z / 12)), cosine)
    return Swing(cosine, jnp.where(near, fade * t * (1 - z / 6 * (1 - z / 20)), sine))


class Oscillator(NamedTuple):
    """Depth of teeth in contact: an equilibrium depth that is linear in time, and a free motion about it.

    Attributes:
        stiff: Stiffness over mass, in units of the step.
        loss: Damping over mass, in units of the step.
        y: Free motion at the beginning.
        dy: Rate of the free motion at the beginning.
        rests: Equilibrium depth at the beginning.
        grows: Rate of the equilibrium depth.
    """

    stiff: Float[Array, "*S"]
    loss: Float[Array, "*S"]
    y: Float[Array, "*S"]
    dy: Float[Array, "*S"]
    rests: Float[Array, "*S"]
    grows: Float[Array, "*S"]

    def moved(
        self, s: Swing, y: Float[Array, "*S"], dy: Float[Array, "*S"]
    ) -> tuple[Float[Array, "*S"], Float[Array, "*S"]]:
        """Free motion and its rate after the time of the swing `s`."""
        return (
            y * s.cosine + (dy + self.loss / 2 * y) * s.sine,
            dy * s.cosine - (self.stiff * y + self.loss / 2 * dy) * s.sine,
        )

    def torque(
        self, t: Float[Array, "*S"], y: Float[Array, "*S"], dy: Float[Array, "*S"]
    ) -> tuple[Float[Array, "*S"], Float[Array, "*S"]]:
        """Torque over mass, and its rate, at time `t`, where the free motion is `y` with the rate `dy`."""
        bend = -self.stiff * y - self.loss * dy
        value = self.stiff * (self.rests + self.grows * t) + self.loss * self.grows - bend
        return value, self.stiff * (self.grows + dy) + self.loss * bend


class ToothContact(NamedTuple):
    """Teeth in contact for a part of a step.

    Attributes:
        impulse: Integral of the torque over the step, in units of the step.
        moments: First three moments of the torque over the step.
        lasts: Whether the teeth are in contact at the end of the step.
    """

    impulse: Float[Array, "*S"]
    moments: Float[Array, "3 *S"]
    lasts: Bool[Array, "*S"]


def contact(
    flight: Cubic,
    touching: Bool[Array, "*S"],
    start: Float[Array, "*S"],
    stiff: Float[Array, "*S"],
    loss: Float[Array, "*S"],
    mass: Float[Array, "*S"],
) -> ToothContact:
    """Contact from a fraction `start` of the step until the torque is zero or the step ends.

    Args:
        flight: Depth without the torque of the teeth.
        touching: Whether there is a contact; without one the moments are zero.
        start: Fraction of the step at which the contact begins; until then the depth is `flight`.
        stiff: Stiffness over mass, in units of the step.
        loss: Damping over mass, in units of the step.
        mass: Effective inertia over the square of the step [N m per unit of acceleration].
    """
    # Depth in equilibrium with the acceleration of the flight; linear in time.
    grows = 6 * flight.e / stiff
    rests = (2 * flight.d - loss * grows) / stiff
    y0 = flight.at(start) - rests - grows * start
    dy0 = flight.slope(start) - grows

    span = 1 - start
    oscillator = Oscillator(stiff, loss, y0, dy0, rests + grows * start, grows)
    length = jax.lax.stop_gradient(_until_zero(oscillator, span))
    ends = length < jax.lax.stop_gradient(span)
    # The torque is zero at the end of the contact: to first order the moments do not depend on that time.
    length = jnp.where(ends, length, span)
    t = start + length
    y, dy = oscillator.moved(swing(stiff, loss, length), y0, dy0)
    depth, rate = rests + grows * t + y, grows + dy
    behind, slower = depth - flight.at(t), rate - flight.slope(t)
    change = flight.slope(t) - flight.slope(start)
    way = (change - (rate - flight.slope(start)) - loss * (depth - flight.at(start))) / stiff
    area = way - (flight.integral(t) - flight.integral(start))
    moments = -jnp.stack([slower, t * slower - behind, t * t * slower - 2 * t * behind + 2 * area])
    moments = jnp.where(touching[None], mass[None] * moments, 0.0)
    return ToothContact(moments[0], moments, touching & ~ends)


def _until_zero(o: Oscillator, span: Array) -> Array:
    """Time until the torque first falls to zero, or `span`.

    If the torque is positive for a whole period, it stays positive, because the oscillation decays.
    Exponentials are evaluated only twice: a product advances the motion from one point to the next, and a
    cubic interpolates between them.
    """
    square = o.stiff - o.loss * o.loss / 4
    period = 2 * np.pi / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    each = jnp.where((square > 0) & (period < span), period, span) / LOOKS
    # Shorter intervals at the beginning, where a strongly damped torque changes fast.
    step = each / 2**HALVINGS
    move = swing(o.stiff, o.loss, step)
    here = o.torque(jnp.zeros_like(span), o.y, o.dy)
    t, y, dy = jnp.zeros_like(span), o.y, o.dy
    before, width, first, last = t, step, here, here
    found = jnp.zeros(jnp.shape(span), bool)
    for k in range(HALVINGS + LOOKS):
        t, (y, dy) = t + step, o.moved(move, y, dy)
        there = o.torque(t, y, dy)
        crosses = ~found & (there[0] < 0)
        before, width = jnp.where(crosses, t - step, before), jnp.where(crosses, step, width)
        first = (jnp.where(crosses, here[0], first[0]), jnp.where(crosses, here[1], first[1]))
        last = (jnp.where(crosses, there[0], last[0]), jnp.where(crosses, there[1], last[1]))
        found, here = found | crosses, there
        if 0 < k <= HALVINGS:
            move = Swing(
                move.cosine * move.cosine - square * move.sine * move.sine, 2 * move.cosine * move.sine
            )
            step = 2 * step
    # The cubic with the values and slopes at both ends, in units of the interval.
    (f0, d0), (f1, d1) = first, last
    d0, d1, rise = d0 * width, d1 * width, f1 - f0
    cubic = Cubic.through(f0, rise, d0, d1)
    drop = jnp.where(found, -rise, 1.0)
    share = jnp.where(found, f0, 0.0) / drop
    for _ in range(3):
        share = _downwards(share, cubic.at(share), cubic.slope(share), found)
    length = before + width * share
    value, slope = o.torque(length, *o.moved(swing(o.stiff, o.loss, length), o.y, o.dy))
    length = before + width * _downwards(share, value, slope * width, found)
    return jnp.where(found, length, span)


def _downwards(share: Array, value: Array, slope: Array, found: Array) -> Array:
    """One Newton step towards the zero of a falling function, limited to the range 0 to 1."""
    falls = found & (slope < 0)
    share = share - jnp.where(falls, value, 0.0) / jnp.where(falls, slope, 1.0)
    return jnp.where(share < 0, 0.0, jnp.where(share > 1, 1.0, share))


def elastic_step(
    mechanism: Mechanism, x: Float[Array, "n *S"], c: Constants, advance: Advance
) -> Float[Array, "n *S"]:
    """State at the end of a step with elastic teeth; arguments as in `gear.geared_step`."""
    layout, a = Layout.of(mechanism.structure), c.gear
    k, gap, (stiffness, damping) = layout.rotor, a.gap, a.teeth
    r, s = x[k], x[k + 1]
    in_flight = advance(x, a.flight, None)
    ends, speed = in_flight[k], in_flight[k + 1]
    depth0 = jnp.abs(r) - gap
    side0 = jnp.where(r > 0, 1.0, -1.0)
    held = (depth0 >= 0) & (stiffness * depth0 + damping * side0 * s > 0)
    side = jnp.where(held, side0, jnp.where(ends > 0, 1.0, -1.0))
    # The cubic through both ends of the flight, in units of the step.
    travel, b, last = side * (ends - r), c.h * side * s, c.h * side * speed
    flight = Cubic.through(side * r - gap, travel, b, last)
    impacts = ~held & (flight.a <= 0) & (flight.a + travel > 0)
    start = _impact_time(flight, travel, impacts)
    touching = held | impacts
    mass = a.mass / c.h**2
    stiff, loss = stiffness / mass, damping / (mass * c.h)
    solve = lambda share: contact(  # noqa: E731
        flight, touching, start, share * stiff, share * loss, jnp.broadcast_to(mass, r.shape) / share
    )
    first = solve(jnp.ones_like(r))
    push = lambda found: matvec(a.moments, side[None] * found.moments)  # noqa: E731
    end = in_flight + push(first)
    found = first
    if layout.contacts:
        # A port that friction holds does not yield: the teeth meet a larger effective inertia.
        linear = push(first)
        response = advance(x, a.flight, linear) - in_flight - linear
        pushed = linear[k + 1]
        moves = jnp.abs(pushed) > 0
        share = 1 + jnp.where(moves, response[k + 1], 0.0) / jnp.where(moves, pushed, 1.0)
        found = solve(jnp.where(share < 0.02, 0.02, jnp.where(share > 1, 1.0, share)))
        strong = jnp.abs(first.impulse) > 0
        scale = jnp.where(strong, found.impulse, 0.0) / jnp.where(strong, first.impulse, 1.0)
        end = in_flight + push(found) + scale[None] * delayed(start, response, layout)
    # A second contact within the step is put off to the beginning of the next step, at zero depth.
    angle, side1 = end[k], jnp.where(end[k] > 0, 1.0, -1.0)
    again = (jnp.abs(angle) > gap) & (side1 * end[k + 1] > 0) & ~(found.lasts & (side1 == side))
    return end.at[k].set(jnp.where(again, side1 * gap, angle))


def _impact_time(flight: Cubic, travel: Array, impacts: Array) -> Array:
    """Fraction of the step at which the depth becomes positive; zero where there is no impact."""
    t = jnp.where(impacts, crossing_time(-flight.a, flight.b, travel - flight.b), 0.0)
    for _ in range(3):
        slope = flight.slope(t)
        safe = impacts & (slope > 0)
        t = t - jnp.where(safe, flight.at(t), 0.0) / jnp.where(safe, slope, 1.0)
        t = jnp.where(t < 0, 0.0, jnp.where(t > 1, 1.0, t))
    return t
