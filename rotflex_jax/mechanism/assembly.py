"""From effects to the constants of one step: equations of motion, matrix exponential, port mobilities.

Everything here is formed once per set of parameters, outside the scan, and is differentiable.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real
from numpy.typing import DTypeLike

from rotflex_jax.effects.base import (
    Actuation,
    Effect,
    Linear,
    Memory,
    Period,
    Scalar,
    Sensing,
    Stamp,
    StatePart,
)
from rotflex_jax.mechanism.mechanism import Mechanism


def matrix_expm1(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """`exp(M) - 1` by scaling, a Taylor polynomial of degree 8, and squaring `X -> 2 X + X X`.

    Squaring the difference from one keeps the digits of a small step that squaring `exp` would round
    away. A fixed number of halvings (2^-14, accurate up to a norm of a few thousand) needs no branch, and
    loops keep one product each in the program, so it compiles fast and can be differentiated.
    """
    halvings, degree = 14, 8
    small = M / 2.0**halvings
    divisors = jnp.arange(degree - 1, 0, -1, dtype=M.dtype)
    X = jax.lax.scan(lambda X, k: ((small + small @ X) / k, None), small / degree, divisors)[0]
    return jax.lax.fori_loop(0, halvings, lambda _, X: 2 * X + X @ X, X)


def phi_functions(
    A: Float[Array, "n n"], V: Float[Array, "n m"], h: Float[Array, ""], orders: int
) -> list[Float[Array, "n _"]]:
    """`exp(A h)` and `h phi_k(A h) V`, k = 1..orders, from one augmented matrix exponential."""
    size, m = V.shape
    total = size + orders * m
    moving = jnp.pad(jnp.concatenate([A, V], axis=1) * h, ((0, 0), (0, (orders - 1) * m)))
    shift = jnp.eye(total - size, total, size + m, dtype=A.dtype)
    expo = matrix_expm1(jnp.concatenate([moving, shift]))[:size]
    return [expo[:, :size] + jnp.eye(size, dtype=A.dtype)] + [
        expo[:, size + k * m : size + (k + 1) * m] for k in range(orders)
    ]


EffectKind = TypeVar("EffectKind", bound=Effect)
STATE_PARTS: tuple[StatePart, ...] = get_args(StatePart)
"""Parts of the state that hold states of effects, in their order there."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Order of states, torque ports and outputs; it follows from the structure alone.

    The state is `x = [q, dq, linear states, rotor's angle and speed, memory states]`.

    Attributes:
        n: Number of coordinates.
        linear: Number of states that take part in the matrix exponential, the first ones.
        size: Number of states.
        rotor: Index of the rotor's angle, if a gear has play.
        torque_ports: Ports at which nonlinear torques act, those with dry friction first.
        port_matrix: Vectors of the torque ports.
        rotor_side: One for torque ports on the motor's side of a gear with play, zero for the others.
        contacts: How many torque ports have dry friction.
        output_rows: Each output as a combination of positions and speeds.
        output_states: Index of the state that an output reads directly; None for the other outputs.
    """

    n: int
    linear: int
    size: int
    rotor: int
    torque_ports: tuple[str, ...]
    port_matrix: tuple[tuple[float, ...], ...]
    rotor_side: tuple[float, ...]
    contacts: int
    output_rows: tuple[tuple[float, ...], ...]
    output_states: tuple[int | None, ...]

    @classmethod
    @functools.cache
    def of(cls, structure: Mechanism) -> "Layout":
        """Layout of a structure."""
        n = len(structure.coordinates)
        own = {part: sum(e.order for e in structure.effects if e.state_part == part) for part in STATE_PARTS}
        rotor = 2 * n + own["linear"]
        linear = rotor + own["rotor"]
        used = {e.port for e in structure.effects if e.torque_at_port}
        dry = {e.at for e in structure.effects if e.dry_contact}
        names = tuple(p for p in structure.port_vectors if p in dry)
        names += tuple(p for p in structure.port_vectors if p in used - dry)
        measured = zip(structure.quantities, (port for _, (port, _) in structure.outputs), strict=True)
        return cls(
            n=n,
            linear=linear,
            size=linear + own["memory"],
            rotor=rotor,
            torque_ports=names,
            port_matrix=tuple(structure.port_vectors[p] for p in names),
            rotor_side=tuple(1.0 if structure.on_rotor(p) else 0.0 for p in names),
            contacts=len(dry),
            output_rows=tuple(quantity.row(structure.port_vectors[port]) for quantity, port in measured),
            output_states=tuple(_shown_state(structure, port, what) for _, (port, what) in structure.outputs),
        )


def _shown_state(structure: Mechanism, port: str, what: str) -> int | None:
    """Index of the state that is the reading of a quantity at a port; None if no state is."""
    rows = own_states(structure)
    shown = (rows[i][0] for i, e in effects_of(structure, Memory) if e.at == port and e.shows == what)
    return next(shown, None)


def effects_of(mechanism: Mechanism, kind: type[EffectKind]) -> list[tuple[int, EffectKind]]:
    """Effects of one kind with their indices in `mechanism.effects`."""
    return [(i, e) for i, e in enumerate(mechanism.effects) if isinstance(e, kind)]


def stamped(mechanism: Mechanism) -> list[tuple[int, Linear | Sensing]]:
    """Linear effects and sensors with states of their own, with their indices, in order of their states."""
    kinds = (Linear, Sensing)
    return [(i, e) for i, e in enumerate(mechanism.effects) if isinstance(e, kinds) and e.state_part]


def own_states(mechanism: Mechanism) -> dict[int, tuple[int, ...]]:
    """Index of each effect with states of its own -> indices of these in the state."""
    rows, start = {}, 2 * len(mechanism.coordinates)
    for part in STATE_PARTS:
        for i, e in enumerate(mechanism.effects):
            if e.state_part == part and e.order:
                rows[i] = tuple(range(start, start + e.order))
                start += e.order
    return rows


class EquationsOfMotion(NamedTuple):
    """Linear part `x' = A x + B v + sum_p b_p tau_p`.

    Attributes:
        A: State matrix.
        B: Column of the voltage.
        ports: Columns `b_p` of the port torques.
        inverse_mass: Inverse of the mass matrix of the coordinates.
    """

    A: Float[Array, "m m"]
    B: Float[Array, " m"]
    ports: Float[Array, "m p"]
    inverse_mass: Float[Array, "n n"]


class PlacedStamp(NamedTuple):
    """The stamp of a linear effect, the vector of its port, and its gate."""

    stamp: Stamp
    port: Real[np.ndarray, " n"]
    gate: Scalar


def equations(mechanism: Mechanism, gates: Float[Array, " E"]) -> EquationsOfMotion:
    """Equations of motion of the linear effects, each times its gate; the states of a rotor stay at rest.

    Args:
        mechanism: Parameter values may be traced.
        gates: One factor per effect: one if the effect is on, zero if it is off.
    """
    layout, each = Layout.of(mechanism.structure), jnp.unstack(gates)
    stamps = [PlacedStamp(e.stamp(), np.array(mechanism.vector(e)), each[i]) for i, e in stamped(mechanism)]
    P = np.array(layout.port_matrix).reshape(len(layout.torque_ports), layout.n)
    return equations_from_stamps(stamps, P, layout.linear, gates.dtype)


def second_order_matrices(
    stamps: Iterable[tuple[Stamp, Sequence[Any]]], n: int, zero: Any = 0.0
) -> tuple[list[list[Any]], list[list[Any]], list[list[Any]], list[Any]]:
    """`M`, `D`, `K` and the column of the voltage in the equations of motion, computed without JAX.

    The effects' own states are left out.

    Args:
        stamps: Stamps of linear effects, each with the vector of its port; in any number type.
        n: Number of coordinates.
        zero: The zero of that number type.
    """
    M, D, K = ([[zero] * n for _ in range(n)] for _ in range(3))
    drive = [zero] * n
    for s, p in stamps:
        for i in range(n):
            drive[i] = drive[i] + s.drive * p[i]
            for j in range(n):
                if both := p[i] * p[j]:
                    M[i][j] = M[i][j] + s.inertia * both
                    D[i][j] = D[i][j] + s.damping * both
                    K[i][j] = K[i][j] + s.stiffness * both
    return M, D, K, drive


def equations_from_stamps(
    stamps: list[PlacedStamp], P: Real[np.ndarray, "p n"], size: int, dtype: jnp.dtype
) -> EquationsOfMotion:
    """Equations of motion of `size` states for torques at the ports with the vectors P."""
    n, own = P.shape[1], [s for s in stamps if s.stamp.own]
    # M, D, K and the column of the voltage, side by side, from all numbers at once.
    numbers, places = [], []
    for stamp, p, gate in stamps:
        at = (n * k + np.arange(n) for k in range(3))
        for number, columns in zip((stamp.inertia, stamp.damping, stamp.stiffness), at, strict=True):
            places.append(np.zeros((n, 3 * n + 1)))
            places[-1][:, columns] = np.outer(p, p)
            numbers.append((number, gate))
        places.append(np.zeros((n, 3 * n + 1)))
        places[-1][:, 3 * n] = p
        numbers.append((stamp.drive, gate))
    used = [k for k, (number, _) in enumerate(numbers) if not (isinstance(number, float) and number == 0)]
    sizes, gates = (jnp.stack([_scalar(numbers[k][i], dtype) for k in used]) for i in range(2))
    placed = jnp.asarray(np.array([places[k] for k in used]), dtype)
    found = jnp.sum((sizes * gates)[:, None, None] * placed, axis=0)
    Minv = _inverse(found[:, :n])
    vectors = np.column_stack([P.T, *(s.port for s in own)])
    right = jnp.concatenate([found[:, n:], jnp.asarray(vectors, dtype)], axis=1)
    solved = jnp.sum(Minv[:, :, None] * right[None], axis=1)
    D, K, B, answers = jnp.split(solved, (n, 2 * n, 2 * n + 1), axis=1)
    # Torques of the effects' own states on the motion, and the equations of these states.
    forces, below, inputs = [], [], []
    for k, (stamp, p, gate) in enumerate(own):
        m, vector = len(stamp.own), jnp.asarray(p, dtype)
        listed = [*stamp.own, stamp.from_speed, stamp.from_voltage, stamp.torque]
        table = jnp.stack([_scalar(c, dtype) for row in listed for c in row]).reshape(m + 3, m)
        forces.append(gate * answers[:, len(P) + k, None] * table[None, m + 2])
        before, rows = sum(block.shape[1] for block in forces[:-1]), [jnp.zeros((m, n), dtype)]
        rows += [table[m][:, None] * vector[None], jnp.zeros((m, before), dtype), table[:m]]
        below.append(jnp.concatenate(rows, axis=1))
        inputs.append(table[m + 1])
    wide = lambda block: jnp.pad(block, ((0, 0), (0, size - block.shape[1])))  # noqa: E731
    moving = [jnp.eye(n, size, n, dtype=dtype), wide(jnp.concatenate([-K, -D, *forces], axis=1))]
    A = jnp.concatenate([*moving, *map(wide, below)])
    B = jnp.concatenate([jnp.zeros(n, dtype), B[:, 0], *inputs])
    ports = jnp.pad(answers[:, : len(P)], ((n, size - 2 * n), (0, 0)))
    still = size - len(A)  # the rotor's states
    return EquationsOfMotion(jnp.pad(A, ((0, still), (0, 0))), jnp.pad(B, (0, still)), ports, Minv)


def _inverse(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a mass matrix; written out for small matrices, which compiles many times faster."""
    n = len(M)
    if n == 1:
        return 1 / M
    if n == 2:
        (a, b), (c, d) = (jnp.unstack(row) for row in jnp.unstack(M))
        return jnp.stack([d, -b, -c, a]).reshape(2, 2) / (a * d - b * c)
    return jnp.linalg.inv(M)


def _scalar(value: Scalar, dtype: jnp.dtype) -> Array:
    return jnp.asarray(value, dtype)


class Constants(NamedTuple):
    """Constants of the exponential step, formed once per parameter set.

    Here `phi_k` are the functions of an exponential integrator at `A h`, for m linear states and p torque
    ports. Where a run carries sensitivities along, each array has a last axis for the directions. In the
    constants of a step, each response of the states has one more row of zeros for each memory
    (`Exponential.prepare`).

    Attributes:
        values: Parameter values.
        gates: One factor per effect.
        h: Length of the step [s].
        E: `exp(A h)`.
        input: `h phi_1 B`.
        hold: `h phi_1 b_p`, the response to a constant port torque.
        ramp: `h phi_2 b_p`.
        rise: `h phi_3 b_p`.
        half_E: `E` of a step of length `h / 2`; None, as the next two, if the rule has no half steps.
        half_input: `input` of a step of length `h / 2`.
        half_hold: `hold` of a step of length `h / 2`.
        stop: Speed that a unit torque at port j, held for one step, gives port i [rad/s per N m].
        mobility: Displacement that a unit impulse on the positions at port j gives port i.
        push: Response of the linear states to a unit impulse on the positions.
        gear: Constants of a gear with play (`gear.GearConstants`); None without one.
        load: Rows of the transmitted torques (`step.LoadRows`); None if no friction depends on them.
        tilt: `12 h (phi_2 - phi_1 / 2) B`, the response to a voltage with zero mean and unit first moment
            over the step; None if no step uses it.
    """

    values: Real[Array, "P *D"]
    gates: Float[Array, "E *D"]
    h: Float[Array, "*D"]
    E: Float[Array, "m m *D"]
    input: Float[Array, "m *D"]
    hold: Float[Array, "m p *D"]
    ramp: Float[Array, "m p *D"]
    rise: Float[Array, "m p *D"]
    half_E: Float[Array, "m m *D"] | None
    half_input: Float[Array, "m *D"] | None
    half_hold: Float[Array, "m p *D"] | None
    stop: Float[Array, "p p *D"]
    mobility: Float[Array, "p p *D"]
    push: Float[Array, "m p *D"]
    gear: Any = None
    load: Any = None
    tilt: Float[Array, "m *D"] | None = None


def constants(
    mechanism: Mechanism,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    h: Float[Array, ""],
    halves: bool = True,
    tilts: bool = False,
) -> Constants:
    """Constants of a step of length `h` [s] for traced values; with `halves` also those of half a step."""
    layout, eq = Layout.of(mechanism.structure), equations(mechanism.with_values(values), gates)
    return from_equations(eq, layout, values, gates, h, halves, tilts)


def from_equations(
    eq: EquationsOfMotion,
    layout: Layout,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    h: Float[Array, ""],
    halves: bool = True,
    tilts: bool = False,
) -> Constants:
    """Constants of a step of length `h` [s] for equations whose states are in the order of the layout."""
    n = layout.n
    V = jnp.concatenate([eq.B[:, None], eq.ports], axis=1)
    E, one, two, three = phi_functions(eq.A, V, h, 3)
    half_E, half = phi_functions(eq.A, V, h / 2, 1) if halves else (None, None)
    P = jnp.asarray(np.array(layout.port_matrix).reshape(len(layout.torque_ports), n), E.dtype)
    # An impulse at a port moves the coordinates as the torque accelerates them.
    push = jnp.pad(eq.ports[n : 2 * n], ((0, layout.linear - n), (0, 0)))
    if layout.linear > layout.rotor:
        push = push.at[layout.rotor].set(eq.ports[layout.rotor + 1])

    def moved(coordinates: Array, states: Array, rotor: int) -> Array:
        """Motion of the ports with the coordinates; ports on the rotor's side also move with the rotor."""
        own, side = P @ coordinates, np.array(layout.rotor_side)
        return own + jnp.asarray(side, E.dtype)[:, None] * states[rotor][None] if side.any() else own

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
        half_input=None if half is None else half[:, 0],
        half_hold=None if half is None else half[:, 1:],
        stop=moved(one[n : 2 * n, 1:], one[:, 1:], layout.rotor + 1),
        mobility=moved(push[:n], push, layout.rotor),
        push=push,
        tilt=12 * (two[:, 0] - one[:, 0] / 2) if tilts else None,
    )


def motor_voltage(
    mechanism: Mechanism, gates: Float[Array, " E"], u: Float[Array, " N"], Ts: Period
) -> Float[Array, " N"]:
    """Voltage that reaches the motor after all actuation effects, in the order of their stages."""
    v = u
    for i, effect in sorted(effects_of(mechanism, Actuation), key=lambda pair: pair[1].stage):
        v = v + gates[i] * (effect.drive(v, Ts) - v)
    return v


def voltage_within_samples(
    mechanism: Mechanism, gates: Float[Array, " E"], u: Float[Array, " N"], Ts: Period
) -> Float[Array, "N 2"]:
    """Mean of the motor's voltage over each sample, and its first moment about the middle [V].

    The first moments of a delay and a lag in series add up.
    """
    v, moment = u, jnp.zeros_like(u)
    for i, effect in sorted(effects_of(mechanism, Actuation), key=lambda pair: pair[1].stage):
        mean, own = effect.within_samples(v, Ts)
        v, moment = v + gates[i] * (mean - v), moment + gates[i] * own
    return jnp.stack([v, moment], axis=1)


def motor_inputs(
    solver: Any, mechanism: Mechanism, gates: Float[Array, " E"], u: Float[Array, "N *c"], Ts: Period
) -> Float[Array, "N *h"]:
    """Input of a solver's steps at each sample: the voltage of the motor, held, smooth or switched.

    If effects of the mechanism take signals, these follow as further columns.
    """
    voltage, signals = split_input(u)
    if getattr(solver, "between", "held") == "switched":
        v = voltage_within_samples(mechanism, gates, voltage, Ts)
    else:
        v = solver.inputs(motor_voltage(mechanism, gates, voltage, Ts))
    if signals is None or not mechanism.takes_signals:
        return v
    return jnp.concatenate([v.reshape(len(v), -1), signals], axis=1)


def split_input(u: Float[Array, "N *c"]) -> tuple[Float[Array, " N"], Float[Array, "N S"] | None]:
    """The voltage, and the signals beside it; None if the input has no signals."""
    return (u, None) if u.ndim == 1 else (u[:, 0], u[:, 1:])


def rest_state(structure: Mechanism, dtype: DTypeLike) -> Float[np.ndarray, " n"]:
    """State at rest: zero motion, memories at their initial value."""
    layout = Layout.of(structure)
    memory = [e.initial() for _, e in effects_of(structure, Memory)]
    return np.array([0.0] * layout.linear + memory, dtype=dtype)


def whole_state(structure: Mechanism, x0: Float[Array, "*batch m"]) -> Float[Array, "*batch n"]:
    """States from their first entries, such as positions and speeds; the remaining ones at rest."""
    rest = jnp.asarray(rest_state(structure, np.float64), x0.dtype)[x0.shape[-1] :]
    return jnp.concatenate([x0, jnp.broadcast_to(rest, (*x0.shape[:-1], len(rest)))], axis=-1)
