"""One sample of motion under a held voltage.

The linear part is exact (matrix exponential), smooth torques go through an exponential Runge-Kutta rule
of order 2 (ETD2RK) or 4 (ETDRK4; Cox and Matthews, J. Comput. Phys. 176, 2002), dry friction is a torque
held over the step and limited by its level (`friction`). Stable at any friction level, true sticking,
no smoothing width.
"""

import dataclasses

import jax
import jax.numpy as jnp

from rotflex_jax.effects.kinds import DryFriction, Force, Memory
from rotflex_jax.mechanism.assembly import Constants, Layout, constants, effects_of
from rotflex_jax.mechanism.between import Between, smoothed
from rotflex_jax.mechanism.combine import along, apply, beside, in_each
from rotflex_jax.mechanism.friction import contacts, solve_masked, within
from rotflex_jax.mechanism.gear import apart, geared_step
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.torques import port_motion, remember, torques


@dataclasses.dataclass(frozen=True)
class Exponential:
    """The step of this toolkit.

    Attributes:
        order: 2 or 4, the order of the rule for smooth torques.
        substeps: Steps per sample; compare with a larger number to see the error.
        passes: Passes over coupled friction contacts, as in `friction.contacts`; None settles any case.
        between: What the voltage does between its samples: "held", or "smooth" as behind a low-pass filter,
            which wants four substeps or so.
    """

    order: int = 2
    substeps: int = 1
    passes: int | None = None
    between: Between = "held"

    def inputs(self, v: jax.Array) -> jax.Array:
        """What `advance` takes at each sample, for a sequence of voltages (N,)."""
        return v if self.between == "held" else smoothed(v, self.substeps)

    def prepare(self, structure: Mechanism, values: jax.Array, gates: jax.Array, Ts: jax.Array) -> Constants:
        """Constants for `advance`, formed once per parameter set."""
        h = Ts / self.substeps
        c = constants(structure, values, gates, h)
        return c._replace(apart=apart(structure, values, gates, h))

    def advance(self, structure: Mechanism, x: jax.Array, v: jax.Array, c: Constants) -> jax.Array:
        """State one sample later, for one state or for many side by side.

        Args:
            structure: The mechanism without numbers.
            x: State (n, ...).
            v: Voltage held over the sample (...) [V], or over each substep (substeps, ...); from `inputs`.
            c: From `prepare`.
        """
        mechanism = structure.with_values(c.values)
        if self.substeps == 1:
            return _step(mechanism, x, v if self.between == "held" else v[0], c, self)
        at = lambda k: v if self.between == "held" else v[k]  # noqa: E731
        body = lambda k, state: _step(mechanism, state, at(k), c, self)  # noqa: E731
        return jax.lax.fori_loop(0, self.substeps, body, x)


def _step(mechanism: Mechanism, x: jax.Array, v: jax.Array, c: Constants, solver: Exponential) -> jax.Array:
    if c.apart is None:
        return _advance(mechanism, x, v, c, solver)
    moved = lambda x, c, extra: _advance(mechanism, x, v, c, solver, extra)  # noqa: E731
    return geared_step(mechanism, x, c, moved)


def _advance(
    mechanism: Mechanism,
    x: jax.Array,
    v: jax.Array,
    c: Constants,
    solver: Exponential,
    extra: jax.Array | None = None,
) -> jax.Array:
    """The step under one set of equations; `extra` comes to the linear states from elsewhere."""
    layout = Layout.of(mechanism.structure)
    L, z = x[: layout.linear], x[layout.linear :]
    start = apply(c.E, L) + along(c.input, v)
    start = start if extra is None else start + extra
    if not layout.torque_ports:
        return start
    smooth = bool(effects_of(mechanism, Force) or effects_of(mechanism, Memory))
    if not smooth:
        return _brake(mechanism, L, start, c, solver.passes)
    f0 = torques(mechanism, L, z, v, c.gates)
    guess = start + apply(c.hold, f0)
    brake = _brake_guess(mechanism, L, guess, c) if layout.contacts else None
    end = guess if brake is None else guess + apply(c.hold, brake)
    z1 = remember(mechanism, z, (L + end) / 2, v, c.gates, c.h)
    if solver.order == 2:
        final = guess + apply(c.ramp, torques(mechanism, end, z1, v, c.gates) - f0)
    else:
        own = end if extra is None else end - extra
        final = guess + _fourth_order(mechanism, L, z, z1, v, f0, brake, own, c)
    final = _brake(mechanism, L, final, c, solver.passes)
    return jnp.concatenate([final, z1]) if z.shape[0] else final


def _fourth_order(mechanism, L, z, z1, v, f0, brake, end, c):  # noqa: ANN001, ANN202 - as in `_advance`
    """What comes to the state as the torques do not stay `f0`, ETDRK4; `end` is where that would lead."""
    held = (lambda f: f) if brake is None else lambda f: f + brake
    half = apply(c.half_E, L) + along(c.half_input, v)
    a = half + apply(c.half_hold, held(f0))
    zh = remember(mechanism, z, (L + a) / 2, v, c.gates, c.h / 2)
    fa = torques(mechanism, a, zh, v, c.gates)
    b = half + apply(c.half_hold, held(fa))
    fb = torques(mechanism, b, zh, v, c.gates)
    # Two half steps make a whole one: half_E half_hold + half_hold = hold, and so for the rest.
    e = end + apply(c.half_hold, 2 * (fb - f0))
    fe = torques(mechanism, e, z1, v, c.gates)
    middle = fa + fb
    slope, bend = 2 * middle - 3 * f0 - fe, 4 * (f0 - middle + fe)
    return apply(c.ramp, slope) + apply(c.rise, bend)


def _levels(
    mechanism: Mechanism, x: jax.Array, end: jax.Array, gates: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Friction levels against positive and negative motion of each friction port."""
    layout = Layout.of(mechanism.structure)
    position, before = port_motion(layout, x)
    speed = jnp.abs(before + port_motion(layout, end)[1]) / 2
    up = [jnp.zeros(x.shape[1:], x.dtype)] * layout.contacts
    down = list(up)
    for i, e in effects_of(mechanism, DryFriction):
        k = layout.torque_ports.index(e.at)
        for levels, way in ((up, 1.0), (down, -1.0)):
            level = in_each(e, lambda e, q, s, way=way: e.limit(q, s, way), position[k], speed[k])
            levels[k] = levels[k] + gates[i] * level
    return jnp.stack(up), jnp.stack(down)


def _brake_guess(mechanism: Mechanism, x: jax.Array, end: jax.Array, c: Constants) -> jax.Array:
    """Friction torques good enough for the stages: exact where a port slides, contacts uncoupled."""
    layout = Layout.of(mechanism.structure)
    k = layout.contacts
    up, down = _levels(mechanism, x, end, c.gates)
    own = jnp.stack([1 / c.stop[i, i] for i in range(k)])
    needed = -port_motion(layout, end)[1][:k]
    needed = needed * beside(own, needed)
    none = jnp.zeros((len(layout.torque_ports) - k, *x.shape[1:]), x.dtype)
    return jnp.concatenate([within(needed, up, down), none])


def _brake(mechanism: Mechanism, x: jax.Array, end: jax.Array, c: Constants, passes: int | None) -> jax.Array:
    """The state at the end of the step with dry friction, positions matched to the stop inside it."""
    layout = Layout.of(mechanism.structure)
    k = layout.contacts
    if not k:
        return end
    q0, v0 = (m[:k] for m in port_motion(layout, x))
    free, stop = port_motion(layout, end)[1][:k], c.stop[:k, :k]
    levels = _levels(mechanism, x, end, c.gates)
    if not all(e.steady for _, e in effects_of(mechanism, DryFriction)):
        # The level belongs to the speed that friction leaves, not to the one without it.
        rough = contacts(v0, free, stop, *levels, passes=1)
        levels = _levels(mechanism, x, end + apply(c.hold[:, :k], rough.torque), c.gates)
    found = contacts(v0, free, stop, *levels, passes=passes)
    end = end + apply(c.hold[:, :k], found.torque)
    q1, v1 = (m[:k] for m in port_motion(layout, end))
    # A held torque takes the speed from v0 to v1 on a line; in truth it reaches zero after t h. A port
    # that holds moves by nothing at all, not even by the curvature of that line.
    half = beside(c.h[None], v0) / 2
    late = half * (found.t * v0 + (1 - found.t) * v1 - v0 - v1)
    curved = half * (v0 + v1) - (q1 - q0)
    shift = late + (1 - found.t) * found.holds * curved
    # A contact that is off has nothing to correct; what it would do if it came in, it would do alone.
    own = beside(jnp.stack([c.mobility[i, i] for i in range(k)]), shift)
    alone = jnp.where(found.crossed, shift / own, 0.0)
    works = found.crossed & (levels[0] + levels[1] > 0)
    impulse = solve_masked(c.mobility[:k, :k], works, shift, alone)
    return end + apply(c.push[:, :k], impulse)
