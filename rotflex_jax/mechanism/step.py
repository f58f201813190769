"""One sample of motion under a held voltage.

The linear part is exact (matrix exponential), smooth torques go through an exponential Runge-Kutta rule
of order 2 (ETD2RK) or 4 (ETDRK4; Cox and Matthews, J. Comput. Phys. 176, 2002), dry friction is a torque
held over the step and limited by its level (`friction`). Stable at any friction level, true sticking,
no smoothing width.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax.checks import one_of, real, shown, whole
from rotflex_jax.effects.base import DryFriction, Force, Linear, Memory, Scalar, within
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import Constants, Layout, constants, effects_of, equations, own_states
from rotflex_jax.mechanism.elastic_teeth import elastic_step
from rotflex_jax.mechanism.friction import (
    Contact,
    all_slide,
    coupled_contacts,
    limited,
    sliding_torques,
    solve_masked,
)
from rotflex_jax.mechanism.gear import gear_constants, gear_steps, geared_step
from rotflex_jax.mechanism.intersample import Intersample, substep_voltages
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.shortcut import shortcut
from rotflex_jax.mechanism.small_matrices import (
    computed_once,
    evaluate_effect,
    expand_axes,
    matvec,
    rows_once,
    scaled_vector,
    sparse_matvec,
    with_rows,
)

# Largest growth of an unstable memory within one step, in e-folds; it keeps the state finite.
MOST_GROWTH = 30.0


def port_motion(layout: Layout, x: Float[Array, "m *S"]) -> tuple[Float[Array, "p *S"], Float[Array, "p *S"]]:
    """Positions and speeds of the torque ports for given linear states."""
    P, n = layout.port_matrix, layout.n
    speeds = tuple((0.0,) * n + row for row in P)
    position, speed = jnp.split(sparse_matvec(P + speeds, x), 2)
    if any(layout.rotor_side):
        side = expand_axes(jnp.asarray(layout.rotor_side, x.dtype), position)
        position, speed = position + side * x[layout.rotor][None], speed + side * x[layout.rotor + 1][None]
    return position, speed


def voltage_of(mechanism: Mechanism, v: Float[Array, "*cS"]) -> Float[Array, "*S"]:
    """The voltage among the inputs of a step; the signals follow it if the mechanism takes signals."""
    return v[0] if mechanism.takes_signals else v


def motor_torque(
    mechanism: Mechanism,
    at: str,
    x: Float[Array, "m *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "*S"]:
    """Torque [N m] of the linear motors at a port for the linear state `x` and the voltage `v`.

    The current takes its steady value: it follows every new voltage within a fraction of the step, so its
    values at the ends of a step do not determine its mean.
    """
    layout = Layout.of(mechanism.structure)
    port = (mechanism.port_vectors[at],)
    position = sparse_matvec(port, x[: layout.n])[0]
    speed = sparse_matvec(port, x[layout.n : 2 * layout.n])[0]
    total = jnp.zeros_like(speed)
    for i, e in effects_of(mechanism, Linear):
        if not (e.motor and e.at == at):
            continue
        stamp = e.stamp()
        total = total + gates[i] * (stamp.drive * v - stamp.damping * speed - stamp.stiffness * position)
        if stamp.own:
            own = jnp.stack([jnp.stack([jnp.asarray(c, x.dtype) for c in row]) for row in stamp.own])
            columns = (stamp.from_speed, stamp.from_voltage)
            inputs = jnp.stack([jnp.stack([jnp.asarray(c, x.dtype) for c in column]) for column in columns])
            per_speed, per_volt = -jnp.linalg.solve(own, inputs.T).T @ jnp.stack(
                [jnp.asarray(c, x.dtype) for c in stamp.torque]
            )
            total = total + gates[i] * (per_speed * speed + per_volt * v)
    return total


class LoadRows(NamedTuple):
    """The torque that each friction port transmits, as a linear combination of its sources.

    Attributes:
        state: Coefficients of the linear states.
        voltage: Coefficients of the voltage.
        torques: Coefficients of the torques of forces and memories at the torque ports.
        motors: Coefficient of the motors' torque beyond its linear part: one, or zero at a port where no
            friction depends on the transmitted torque.
    """

    state: Float[Array, "k m *D"]
    voltage: Float[Array, "k *D"]
    torques: Float[Array, "k p *D"]
    motors: Float[Array, "k *D"]


def load_rows(mechanism: Mechanism, gates: Float[Array, " E"]) -> LoadRows | None:
    """Rows of the transmitted torques, or None where no friction depends on them.

        load = (1 - s) motor - s rest,   rest = inertia p.ddq - motor

    Here `motor` is the torque of the motors at the port and `rest` the torque of the rest of the machine. The
    inertia at the port lies between the two. Its acceleration includes all torques except dry friction,
    because the load determines the dry friction. With `motor = a + f` and `inertia p.ddq = b + g`, where a
    and b are linear in state and voltage and f and g come from forces and memories, the load is
    `a - s b + f - s g`. The share s is `rest_share` of the friction, by default a half.

    Args:
        mechanism: Mechanism with (traced) parameter values.
        gates: One factor per effect.
    """
    layout = Layout.of(mechanism.structure)
    ports = {e.at: e.rest_share for _, e in effects_of(mechanism, DryFriction) if e.loaded}
    if not ports:
        return None
    eq = equations(mechanism, gates)
    m, n, p = layout.linear, layout.n, len(layout.torque_ports)
    # Columns: each state alone, then the voltage alone.
    x, v = jnp.eye(m, m + 1, dtype=gates.dtype), jnp.eye(1, m + 1, m, dtype=gates.dtype)[0]
    slope = jnp.concatenate([eq.A, eq.B[:, None], eq.ports], axis=1)
    rows = []
    for port in layout.torque_ports[: layout.contacts]:
        if port not in ports:
            rows.append(jnp.zeros(m + 2 + p, gates.dtype))
            continue
        vector = (mechanism.port_vectors[port],)
        acceleration = sparse_matvec(vector, slope[n : 2 * n])[0]
        position, speed = sparse_matvec(vector, x[:n])[0], sparse_matvec(vector, x[n : 2 * n])[0]
        here = [(i, e.stamp(), e) for i, e in effects_of(mechanism, Linear) if e.at == port]
        inertia = sum(gates[i] * stamp.inertia for i, stamp, _ in here)
        # The present current accelerates the inertia; over a step the current has its steady value.
        own = own_states(mechanism)
        now = jnp.zeros(m + 1, gates.dtype)
        for i, stamp, e in here:
            if e.motor:
                given = stamp.drive * v - stamp.damping * speed - stamp.stiffness * position
                now = now + gates[i] * given
                for row, torque in zip(own[i] if stamp.own else (), stamp.torque, strict=True):
                    now = now + gates[i] * torque * x[row]
        motor = motor_torque(mechanism, port, x, v, gates)
        share = ports[port]
        linear = (1 - share) * motor - share * (inertia * acceleration[: m + 1] - now)
        one = jnp.ones(1, gates.dtype)
        rows.append(jnp.concatenate([linear, -share * inertia * acceleration[m + 1 :], one]))
    found = jnp.stack(rows)
    return LoadRows(found[:, :m], found[:, m], found[:, m + 1 : -1], found[:, -1])


def transmitted_torques(
    mechanism: Mechanism,
    rows: LoadRows | None,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*cS"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "k *S"] | None:
    """Torques [N m] that the friction ports transmit; None if no friction depends on them.

    Args:
        mechanism: Mechanism with (traced) parameter values.
        rows: From `load_rows`.
        x: State, of which only the linear part is read.
        z: States of the memories.
        v: Voltage [V], and signals.
        gates: One factor per effect.
    """
    if rows is None:
        return None
    voltage = voltage_of(mechanism, v)
    load = matvec(rows.state, x[: rows.state.shape[1]]) + scaled_vector(rows.voltage, voltage)
    if not has_smooth_torques(mechanism):
        return load
    layout = Layout.of(mechanism.structure)
    motors = [
        motor_correction(mechanism, port, x, z, voltage, gates)
        for port in layout.torque_ports[: layout.contacts]
    ]
    load = load + matvec(rows.torques, torques(mechanism, x, z, v, gates))
    return load + expand_axes(rows.motors, load) * jnp.stack(motors)


def friction_level(
    e: DryFriction,
    position: Float[Array, "*S"],
    speed: Float[Array, "*S"],
    direction: float,
    load: Float[Array, "*S"] | None,
) -> Scalar:
    """Level [N m] of a dry friction against motion in a direction; a single number if it is constant.

    Args:
        e: The effect.
        position: Position of its port.
        speed: Absolute value of the speed of its port.
        direction: +1 or -1.
        load: Torque that the port transmits [N m].
    """
    signals = (position, speed) if load is None or not e.loaded else (position, speed, load)
    limit = lambda e, q, s, *load: e.limit(q, s, direction, *load)  # noqa: E731
    return evaluate_effect(e, limit, *signals)


def motor_beyond_linear(
    mechanism: Mechanism,
    at: str,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "*S"]:
    """Torque [N m] of motors at a port beyond `motor_torque`: limits, dead bands, a weak supply, I gains."""
    return _of_laws(mechanism, _loops(mechanism, at), at, x, z, v, gates)


def _loops(mechanism: Mechanism, at: str) -> list[tuple[int, Force | Memory]]:
    """Motors at a port whose torque is not linear, with their indices among the effects."""
    motors = ((i, e) for i, e in effects_of(mechanism, Linear) if isinstance(e, Force | Memory) and e.motor)
    return [(i, e) for i, e in motors if e.at == at]


def _driven_by_motor(
    mechanism: Mechanism, at: str, kind: type[Force] | type[Memory]
) -> list[tuple[int, Force | Memory]]:
    """Effects of a kind at a port that are driven by the torque of its motors, with their indices."""
    return [(i, e) for i, e in effects_of(mechanism, kind) if e.driven_by == "motor" and e.at == at]


def _of_laws(
    mechanism: Mechanism,
    laws: Iterable[tuple[int, Force | Memory]],
    at: str,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "*S"]:
    """Sum of the torques [N m] of some effects at a port; `laws` has each with its index."""
    layout = Layout.of(mechanism.structure)
    position, speed = port_motion(layout, x)
    total = jnp.zeros(x.shape[1:], x.dtype)
    memories = _states_of_memories(mechanism, z)
    for i, e in laws:
        k, drive = layout.torque_ports.index(at), drive_of(mechanism, e, x, z, v, gates)
        total = total + gates[i] * _force(e, *memories.get(i, ()), position[k], speed[k], drive)
    return total


def _states_of_memories(mechanism: Mechanism, z: Float[Array, "z *S"]) -> dict[int, tuple[Array]]:
    """Index of each memory among the effects -> its state."""
    return {i: (z[m],) for m, (i, _) in enumerate(effects_of(mechanism, Memory))}


def motor_duty(
    mechanism: Mechanism,
    at: str,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
) -> Float[Array, "*S"]:
    """Duty of the servo at a port."""
    layout = Layout.of(mechanism.structure)
    position, speed = (motion[layout.torque_ports.index(at)] for motion in port_motion(layout, x))
    given: Callable[..., Any] = lambda e, *signals: e.duty(*signals)  # noqa: E731
    memories = _states_of_memories(mechanism, z)
    for i, e in effects_of(mechanism, Linear):
        if e.at == at and e.has_duty:
            return evaluate_effect(e, given, position, speed, v, *memories.get(i, ()))
    return jnp.zeros_like(v)


def _force(e: Force | Memory, *signals: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Torque of a force or a memory; `signals` are the arguments of its method `force`."""
    return evaluate_effect(e, lambda e, *given: e.force(*given), *signals)


def motor_correction(
    mechanism: Mechanism,
    at: str,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "*S"]:
    """Torque [N m] of the motors at a port beyond their linear part: limits, heat and saturation."""
    laws = (*_of_current(mechanism, at), *_driven_by_motor(mechanism, at, Force))
    return _of_laws(mechanism, laws, at, x, z, v, gates)


def _of_current(mechanism: Mechanism, at: str) -> tuple[tuple[int, Force | Memory], ...]:
    """Effects on the motors at a port that change their current: limits and heat, but not saturation."""
    return (*_loops(mechanism, at), *_driven_by_motor(mechanism, at, Memory))


def drive_of(
    mechanism: Mechanism,
    e: Force | Memory,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "*S"]:
    """Last argument of `flow` and `force` of an effect: the quantity that its `driven_by` names."""
    if e.driven_by == "voltage":
        return v
    if e.driven_by == "duty":
        return motor_duty(mechanism, e.at, x, z, v)
    linear = motor_torque(mechanism, e.at, x, v, gates)
    if e.driven_by == "motor" and isinstance(e, Memory):
        return linear + motor_beyond_linear(mechanism, e.at, x, z, v, gates)
    given = linear + _of_laws(mechanism, _of_current(mechanism, e.at), e.at, x, z, v, gates)
    if e.driven_by == "motor":
        return given
    motor = next(m for m in mechanism.linear_effects(e.at) if m.has_current)
    return evaluate_effect(motor, lambda motor, given: given / motor.torque_per_current, given)


def has_smooth_torques(mechanism: Mechanism) -> bool:
    """Whether `torques` of a mechanism may differ from zero."""
    return any(e.torque_at_port and not e.dry_contact for e in mechanism.effects)


def torques(
    mechanism: Mechanism,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*cS"],
    gates: Float[Array, "E *D"],
) -> Float[Array, "p *S"]:
    """Torques of forces and memories at the torque ports.

    Args:
        mechanism: Mechanism with (traced) parameter values.
        x: State, of which only the linear part is read.
        z: States of the memories.
        v: Voltage [V]; with the signals (1 + S, *S) if effects of the mechanism take signals.
        gates: One factor per effect.
    """
    layout = Layout.of(mechanism.structure)
    position, speed = map(jnp.unstack, port_motion(layout, x))
    gate, memory, total = (
        jnp.unstack(gates),
        jnp.unstack(z),
        [jnp.zeros(x.shape[1:], x.dtype)] * len(position),
    )
    voltage = voltage_of(mechanism, v)
    for i, e in effects_of(mechanism, Force):
        k = layout.torque_ports.index(e.port)
        if e.signal:
            drive = v[1 + mechanism.signals.index(e.signal)]
        else:
            drive = drive_of(mechanism, e, x, z, voltage, gates)
        total[k] = total[k] + gate[i] * _force(e, position[k], speed[k], drive)
    for m, (i, e) in enumerate(effects_of(mechanism, Memory)):
        k = layout.torque_ports.index(e.at)
        drive = drive_of(mechanism, e, x, z, voltage, gates)
        total[k] = total[k] + gate[i] * _force(e, memory[m], position[k], speed[k], drive)
    return rows_once(total)


def memory_rates(
    mechanism: Mechanism,
    x: Float[Array, "m *S"],
    z: Float[Array, "z *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
    others: Float[Array, "z *S"] | None = None,
) -> Float[Array, "z *S"]:
    """Time derivatives of the states of memories; arguments as for `torques`.

    `others` are the states from which the motor's torque or duty is computed, where these drive a memory;
    `z` if None.
    """
    others = z if others is None else others
    layout = Layout.of(mechanism.structure)
    position, speed = map(jnp.unstack, port_motion(layout, x))
    memory, rates, flow = jnp.unstack(z), [], lambda e, *signals: e.flow(*signals)
    for m, (_, e) in enumerate(effects_of(mechanism, Memory)):
        k = layout.torque_ports.index(e.at)
        drive = drive_of(mechanism, e, x, others, v, gates)
        rates.append(jnp.asarray(evaluate_effect(e, flow, memory[m], position[k], speed[k], drive)))
    return jnp.stack(rates)


def advance_memories(
    mechanism: Mechanism,
    z: Float[Array, "z *S"],
    x: Float[Array, "m *S"],
    v: Float[Array, "*S"],
    gates: Float[Array, "E *D"],
    h: Float[Array, "*D"],
) -> Float[Array, "z *S"]:
    """States of the memories after `h` [s], with the motion held at `x`: exponential Rosenbrock-Euler.

    The rule is stable for stiff memories.
    """
    if not z.shape[0]:
        return z
    # The drive of each flow is held, and with it the states of other memories.
    after = exponential_euler(lambda s: memory_rates(mechanism, x, s, v, gates, z), z, h)
    after = rows_once(jnp.unstack(after))
    limits = np.array([e.limits for _, e in effects_of(mechanism, Memory)])
    if not np.isfinite(limits).any():
        return after
    return within(after, *(expand_axes(jnp.asarray(each, z.dtype), z) for each in limits.T))


def exponential_euler(
    flow: Callable[[Float[Array, "z *S"]], Float[Array, "z *S"]],
    z: Float[Array, "z *S"],
    h: Float[Array, "*D"],
) -> Float[Array, "z *S"]:
    """States after `h` [s], where the flow of each state depends on no other state.

    The growth of an unstable state is limited to `MOST_GROWTH` e-folds in a step.
    """
    # The flows are independent, so one direction gives all derivatives.
    rate, slope = jax.jvp(flow, (z,), (jnp.ones_like(z),))
    h = expand_axes(h[None], z)
    a = jnp.minimum(slope * h, MOST_GROWTH)
    small = jnp.abs(a) < 1e-6
    phi = jnp.where(small, 1 + a / 2, jnp.expm1(a) / jnp.where(small, 1.0, a))
    return z + h * phi * rate


@dataclasses.dataclass(frozen=True)
class Exponential:
    """The exponential integrator: exact linear part, Runge-Kutta for smooth torques, set-valued dry friction.

    Attributes:
        order: 2 or 4, the order of the rule for smooth torques.
        substeps: Steps per sample; compare with a larger number to see the error.
        passes: Passes over coupled friction contacts, see `friction.coupled_contacts`; None solves any case.
        between: The voltage between its samples. "held": constant over each sample. "smooth": as behind a
            low-pass filter; this needs about four substeps. "switched": a delay or a lag changes the voltage
            within the sample; the motion is then correct at the end of the same sample, with "held" only at
            the end of the next. "switched" is for machines without dry friction and play, and takes one step
            per sample.
    """

    order: int = 2
    substeps: int = 1
    passes: int | None = None
    between: Intersample = "held"

    def __post_init__(self) -> None:
        if real(self.order) not in (2, 4):
            raise InputError(
                f"Argument `order` must be 2 or 4, but is {shown(self.order)}; give one of these."
            )
        # As Python's numbers, which a model file and the key of a program can hold.
        object.__setattr__(self, "order", int(self.order))
        object.__setattr__(self, "substeps", whole(self.substeps, "substeps", 1))
        if self.passes is not None:
            object.__setattr__(self, "passes", whole(self.passes, "passes", 1))
        one_of(self.between, "between", get_args(Intersample))
        if self.between == "switched" and self.substeps > 1:
            raise InputError('between="switched" needs one step per sample; leave out `substeps`.')

    def inputs(self, v: Float[Array, " N"]) -> Float[Array, "N *h"]:
        """Input of `advance` at each sample, for a sequence of voltages."""
        return v if self.between != "smooth" else substep_voltages(v, self.substeps)

    def prepare(
        self,
        structure: Mechanism,
        values: Real[Array, " P"],
        gates: Float[Array, " E"],
        Ts: Float[Array, ""],
    ) -> Constants:
        """Constants for `advance`, formed once per parameter set."""
        h = Ts / (self.substeps * gear_steps(structure))
        c = constants(structure, values, gates, h, halves=self.order == 4, tilts=self.between == "switched")
        c = c._replace(load=load_rows(structure.with_values(values), gates))
        gear, number = gear_constants(structure, values, gates, c), len(effects_of(structure, Memory))
        if gear is not None:
            gear = gear._replace(flight=_with_rows_of_memories(gear.flight, number))
        return _with_rows_of_memories(c, number)._replace(gear=gear)

    def advance(
        self, structure: Mechanism, x: Float[Array, "n *S"], v: Float[Array, "*hS"], c: Constants
    ) -> Float[Array, "n *S"]:
        """State one sample later, for one state or for several side by side.

        Args:
            structure: The mechanism without parameter values.
            x: State.
            v: From `assembly.motor_inputs`: voltage [V] held over the sample (*S), voltage over each substep
                (substeps, *S), or mean and first moment of the voltage (2, *S); then the signals, if the
                mechanism takes signals.
            c: From `prepare`.
        """
        mechanism = structure.with_values(c.values)
        cut = gear_steps(structure)
        if structure.takes_signals:
            rows = len(v) - len(structure.signals)
            signals = v[rows:]
            here = lambda k: jnp.concatenate([v[:rows][k][None], signals])  # noqa: E731
        else:
            here = lambda k: v if self.between == "held" else v[k]  # noqa: E731
        if c.tilt is not None:  # the voltage is switched
            body = lambda _, state: _step(mechanism, state, here(0), c, self)  # noqa: E731
            end = body(0, x) if cut == 1 else jax.lax.fori_loop(0, cut, body, x)
            return end + scaled_vector(c.tilt, v[1])
        if self.substeps * cut == 1:
            return _step(mechanism, x, here(0), c, self)
        at = lambda k: here(k // cut if self.between == "smooth" else 0)  # noqa: E731
        body = lambda k, state: _step(mechanism, state, at(k), c, self)  # noqa: E731
        return jax.lax.fori_loop(0, self.substeps * cut, body, x)


def _step(mechanism: Mechanism, x: Array, v: Array, c: Constants, solver: Exponential) -> Array:
    if c.gear is None:
        return _advance_smooth(mechanism, x, v, c, solver)
    advance = lambda x, c, extra: _advance_smooth(mechanism, x, v, c, solver, extra)  # noqa: E731
    if c.gear.teeth is not None:
        return elastic_step(mechanism, x, c, advance)
    return geared_step(mechanism, x, c, advance)


def _advance_smooth(
    mechanism: Mechanism,
    x: Array,
    v: Array,
    c: Constants,
    solver: Exponential,
    extra: Array | None = None,
) -> Array:
    """A step with one set of equations; `extra`, zero for memories, is added to the state at its end."""
    layout = Layout.of(mechanism.structure)
    z = x[layout.linear :]
    voltage = voltage_of(mechanism, v)
    start = matvec(c.E, x[: layout.linear]) + scaled_vector(c.input, voltage)
    start = start if extra is None else start + extra
    if not layout.torque_ports:
        return start
    if not has_smooth_torques(mechanism):
        return _with_dry_friction(mechanism, x, start, z, v, c, solver.passes)
    f0 = torques(mechanism, x, z, v, c.gates)
    guess = start + matvec(c.hold, f0)
    brake = _predicted_friction(mechanism, x, guess, z, v, c) if layout.contacts else None
    end = guess if brake is None else guess + matvec(c.hold, brake)
    z1 = advance_memories(mechanism, z, (x + end) / 2, voltage, c.gates, c.h)
    if solver.order == 2:
        f1 = torques(mechanism, end, z1, v, c.gates)
        # Row by row: the difference of two arrays of rows would be computed with branches.
        change = jnp.stack([b - a for a, b in zip(jnp.unstack(f0), jnp.unstack(f1), strict=True)])
        final = guess + matvec(c.ramp, change)
    else:
        own = end if extra is None else end - extra
        final = guess + _fourth_order(mechanism, x, z, z1, v, f0, brake, own, c)
    final = _with_dry_friction(mechanism, x, final, z1, v, c, solver.passes)
    return with_rows(final, dict(enumerate(jnp.unstack(z1), layout.linear)))


def _with_rows_of_memories(c: Constants, number: int) -> Constants:
    """Constants with responses of the whole state: zero for the states of memories."""
    if not number:
        return c
    names = ("E", "input", "hold", "ramp", "rise", "push", "half_E", "half_input", "half_hold", "tilt")
    arrays = {name: a for name in names if (a := getattr(c, name)) is not None}
    padded = {name: jnp.pad(a, ((0, number), *[(0, 0)] * (a.ndim - 1))) for name, a in arrays.items()}
    return c._replace(**padded)


def _fourth_order(mechanism, x, z, z1, v, f0, brake, end, c):  # noqa: ANN001, ANN202 - as in `_advance_smooth`
    """Correction of the state for torques that change from `f0` (ETDRK4); `end` is the state without it."""
    held = (lambda f: f) if brake is None else lambda f: f + brake
    voltage = voltage_of(mechanism, v)
    half = matvec(c.half_E, x[: c.half_E.shape[1]]) + scaled_vector(c.half_input, voltage)
    a = half + matvec(c.half_hold, held(f0))
    zh = advance_memories(mechanism, z, (x + a) / 2, voltage, c.gates, c.h / 2)
    fa = torques(mechanism, a, zh, v, c.gates)
    b = half + matvec(c.half_hold, held(fa))
    fb = torques(mechanism, b, zh, v, c.gates)
    # Two half steps are a whole one: half_E half_hold + half_hold = hold, and so for the other columns.
    e = end + matvec(c.half_hold, 2 * (fb - f0))
    fe = torques(mechanism, e, z1, v, c.gates)
    middle = fa + fb
    slope, bend = 2 * middle - 3 * f0 - fe, 4 * (f0 - middle + fe)
    return matvec(c.ramp, slope) + matvec(c.rise, bend)


def _friction_levels(
    mechanism: Mechanism, x: Array, end: Array, z: Array, v: Array, c: Constants
) -> tuple[Array, Array]:
    """Friction levels against positive and negative motion of each friction port."""
    layout = Layout.of(mechanism.structure)
    position, before = port_motion(layout, x)
    speed = jnp.unstack(jnp.abs(before + port_motion(layout, end)[1]) / 2)
    load = transmitted_torques(mechanism, c.load, (x + end) / 2, z, v, c.gates)
    position, gate = jnp.unstack(position), jnp.unstack(c.gates)
    up = [jnp.zeros(x.shape[1:], x.dtype)] * layout.contacts
    down = list(up)
    for i, e in effects_of(mechanism, DryFriction):
        k = layout.torque_ports.index(e.at)
        for levels, direction in ((up, 1.0), (down, -1.0)):
            level = friction_level(e, position[k], speed[k], direction, None if load is None else load[k])
            levels[k] = levels[k] + gate[i] * level
    return rows_once(up), rows_once(down)


def _predicted_friction(
    mechanism: Mechanism, x: Array, end: Array, z: Array, v: Array, c: Constants
) -> Array:
    """Friction torques for the stages of the rule: exact for sliding ports, contacts taken as uncoupled."""
    layout = Layout.of(mechanism.structure)
    k = layout.contacts
    up, down = _friction_levels(mechanism, x, end, z, v, c)
    own = jnp.stack([1 / c.stop[i, i] for i in range(k)])
    needed = -port_motion(layout, end)[1][:k]
    needed = needed * expand_axes(own, needed)
    none = jnp.zeros((len(layout.torque_ports) - k, *x.shape[1:]), x.dtype)
    return jnp.concatenate([limited(needed, up, down), none])


def _with_dry_friction(
    mechanism: Mechanism, x: Array, end: Array, z: Array, v: Array, c: Constants, passes: int | None
) -> Array:
    """The state at the end of the step with dry friction, with positions corrected for stops within it."""
    layout = Layout.of(mechanism.structure)
    k = layout.contacts
    if not k:
        return end
    steady = all(e.steady for _, e in effects_of(mechanism, DryFriction))
    q0, v0 = (m[:k] for m in port_motion(layout, x))
    free, stop = port_motion(layout, end)[1][:k], c.stop[:k, :k]
    levels = _friction_levels(mechanism, x, end, z, v, c)

    def levels_after(torque: Array) -> tuple[Array, Array]:
        """Levels at the speed with this friction torque, not at the speed without friction."""
        return _friction_levels(mechanism, x, end + matvec(c.hold[:, :k], torque), z, v, c)

    def any_case() -> Array:
        final = levels
        if not steady:
            final = levels_after(coupled_contacts(v0, free, stop, *levels, passes=1).torque)
        found = coupled_contacts(v0, free, stop, *final, passes=passes)
        found = found._replace(torque=rows_once(jnp.unstack(found.torque)))
        return _stopped(layout, c, end + matvec(c.hold[:, :k], found.torque), q0, v0, found, final)

    def sliding() -> tuple[Array, Callable[[], Array]]:
        """Most steps pass no stop, and the correction for a stop costs more than the rest of the step."""
        final, slides = levels, all_slide(v0, free, stop, *levels)
        if not steady:
            final = levels_after(sliding_torques(v0, *levels))
            slides = slides & all_slide(v0, free, stop, *final)
        torque = sliding_torques(v0, *final)
        return slides, lambda: end + matvec(c.hold[:, :k], torque)

    return shortcut(sliding, any_case)


def _stopped(
    layout: Layout,
    c: Constants,
    end: Array,
    q0: Array,
    v0: Array,
    found: Contact,
    levels: tuple[Array, Array],
) -> Array:
    """The state at the end of a step in which contacts may stop, with positions corrected for the stops."""
    k = layout.contacts
    q1, v1 = (m[:k] for m in port_motion(layout, end))
    # A constant torque changes the speed linearly from v0 to v1; in truth it reaches zero after t h. A port
    # that sticks does not move at all, not even by the curvature of that line.
    half = expand_axes(c.h, v0[0]) / 2
    shift, alone = [], []
    for i in range(k):
        late = half * (found.t[i] * v0[i] + (1 - found.t[i]) * v1[i] - v0[i] - v1[i])
        curved = half * (v0[i] + v1[i]) - (q1[i] - q0[i])
        shift.append(computed_once(late + (1 - found.t[i]) * found.holds[i] * curved))
        # A contact that is switched off needs no correction; its derivative is that of the contact alone.
        own = expand_axes(c.mobility[i, i], shift[i])
        alone.append(jnp.where(found.crossed[i], shift[i] / own, 0.0))
    works = found.crossed & (levels[0] + levels[1] > 0)
    impulse = solve_masked(c.mobility[:k, :k], works, jnp.stack(shift), jnp.stack(alone))
    return end + matvec(c.push[:, :k], rows_once(jnp.unstack(impulse)))
