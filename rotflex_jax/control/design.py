"""Design of a controller: state feedback, observer of states and load, compensation of other effects."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Complex, Float
from numpy.typing import ArrayLike

from rotflex_jax.checks import one_of, positive, shown, signal
from rotflex_jax.effects.base import Actuation, DryFriction, Memory
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout, effects_of, rest_state
from rotflex_jax.mechanism.linear import (
    check_movable,
    linear_equations,
    process_covariance,
    state_names,
    zero_order_hold,
)
from rotflex_jax.mechanism.mechanism import check_input_alone
from rotflex_jax.mechanism.quantity import input_word
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
"""Number of iterations in which torques and planned motion are computed from each other in turn."""


@dataclasses.dataclass(frozen=True, eq=False)
class PlannedMotion:
    """Planned states of the linear part at each sample, and the voltage that leads it along them.

    Attributes:
        reference: Reference of the controlled position.
        states: Planned states of the linear part.
        outputs: Planned outputs.
        voltage: Feed-forward voltage [V].
        torques: Torques of the compensated effects, in the order of the torque ports [N m].
    """

    reference: Float[np.ndarray, " N"]
    states: Float[np.ndarray, "N n"]
    outputs: Float[np.ndarray, "N C"]
    voltage: Float[np.ndarray, " N"]
    torques: Float[np.ndarray, "N p"]


@dataclasses.dataclass(frozen=True, eq=False)
class Tracking:
    """Linear quadratic tracking of a reference that is known beforehand, by the linear part.

        x+ = A x + B u + d,   minimise  sum (c x - r)^2 + effort u^2

    Attributes:
        A: State matrix in discrete time.
        B: Input matrix of the voltage in discrete time.
        c: Output row of the controlled position.
        effort: Weight of the squared voltage [rad^2/V^2].

    Source: B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990, chapter 4.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, " n"]
    c: Float[np.ndarray, " n"]
    effort: float

    def solve(
        self, reference: Float[np.ndarray, " N"], pushes: Float[np.ndarray, "N n"]
    ) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, " N"]]:
        """Optimal states and voltages, with known disturbances.

        Args:
            reference: Reference r; its last value is held after the end.
            pushes: Disturbance d of the state in each sample.
        """
        A, B, c = self.A, self.B, self.c
        P = scipy.linalg.solve_discrete_are(A, B[:, None], np.outer(c, c), [[self.effort]])
        gain = 1 / (self.effort + B @ P @ B)
        K = gain * (B @ P @ A)
        closed = (A - np.outer(B, K)).T
        N = len(reference)
        # Backward recursion for the effect of future references and disturbances, linear in c r and d.
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
    """State of the linear part at rest at a position: `x = A x + B u`, `c x = position`."""
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
    """Torques (p, N) of all effects except the linear ones along a motion (m, N)."""
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
    """Torques of friction, forces and memories at the torque ports, along a given motion [N m].

    Dry friction acts against the motion. Below the speed `rest` it decreases linearly to zero, since at rest
    friction holds the port without any voltage.

    Args:
        model: Model whose effects are evaluated.
        X: States of the linear part, without the states of a gear's rotor.
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


Compensation = Literal["nothing", "feedforward", "observer", "both"]

PLANNED_EFFORT = 1e-4
"""Weight of the voltage in a planned motion, relative to the feedback: a plan amplifies no sensor noise."""

LOAD_PER_SECOND = 0.1
"""Standard deviation of the change of the load over a second, as a share of the motor's largest torque."""

WHITE_SHARE = 0.01
"""Standard deviation of the torque noise of a sample at each port, which represents what the model lacks, as
a share of the motor's largest torque."""

AT_REST = 20.0
"""Speed below which a port is planned to be at rest, in steps of the finest sensor per second [1/s]."""

ENCODER = 2 * np.pi / 4096
"""Default step of the sensors [rad]."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Controller:
    """Feedback in discrete time about a planned motion; made by `controller`.

        e  = e_hat + L (y - y_plan - C e_hat)                state and load, corrected by the sensors
        u  = clip(u_plan - K e)
        e_hat+ = A e + B (u - u_plan)                        prediction with the limited voltage

    Attributes:
        model: Model for which the controller was designed.
        Ts: Sampling period [s].
        port: Port whose position follows the reference.
        limit: Largest voltage [V].
        compensate: Compensation of the effects outside the linear part.
        A: Matrix of states and load torque in discrete time.
        B: Input matrix of the voltage in discrete time.
        C: Output matrix of the sensors.
        K: Feedback gains of states and load.
        L: Gain of the observer.
        row: The controlled position as a combination of the states.
        push: Change of the states in one sample by torques at the torque ports.
        states: Names of the states; the last one is the load torque.
        resolution: Step of each sensor.
        effort: Weight of the squared voltage relative to the squared error [rad^2/V^2].
        left_out: Effects that are not compensated, one sentence each.
    """

    model: Model
    Ts: float
    port: str
    limit: float
    compensate: Compensation
    A: Float[np.ndarray, "m m"]
    B: Float[np.ndarray, " m"]
    C: Float[np.ndarray, "C m"]
    K: Float[np.ndarray, " m"]
    L: Float[np.ndarray, "m C"]
    row: Float[np.ndarray, " n"]
    push: Float[np.ndarray, "n p"]
    states: tuple[str, ...]
    resolution: Float[np.ndarray, " C"]
    effort: float
    left_out: tuple[str, ...]

    @property
    def input_name(self) -> str:
        """`voltage` if the controller gives a voltage; otherwise `input`, such as a goal or a current."""
        return input_word(self.model.mechanism.units.input)

    @functools.cached_property
    def poles(self) -> Complex[np.ndarray, " n"]:
        """Closed-loop poles of the linear part with state feedback, in continuous time [1/s]."""
        n = len(self.row)
        inside = self.A[:n, :n] - np.outer(self.B[:n], self.K[:n])
        return np.log(np.linalg.eigvals(inside).astype(complex)) / self.Ts

    def plan(self, reference: Float[ArrayLike, " N"] | Sequence[float]) -> PlannedMotion:
        """Planned motion for a reference that is known beforehand.

        The linear part follows the reference as closely as a moderate voltage allows. With the compensation
        "feedforward" or "both", the plan takes account of friction and of the other effects along the motion.

        Args:
            reference: Reference of the port's position, one value for each sample.

        Raises:
            InputError: `reference` is no signal of finite numbers.
        """
        r = signal(reference, "reference").astype(float)
        n, N = len(self.row), len(r)
        tracking = Tracking(self.A[:n, :n], self.B[:n], self.row, PLANNED_EFFORT * self.effort)
        tau = np.zeros((N, self.push.shape[1]))
        X, u = tracking.solve(r, tau @ self.push.T)
        if self.compensate in ("feedforward", "both") and tau.size:
            # The finest sensor determines below which speed a port counts as being at rest.
            rest = AT_REST * float(self.resolution.min())
            for _ in range(PASSES):
                tau = torques_along(self.model, X, u, rest, self.Ts)
                X, u = tracking.solve(r, tau @ self.push.T)
        return PlannedMotion(r, X, X @ self.C[:, :n].T, u, tau)

    def first_state(self, position: float) -> Float[np.ndarray, " n"]:
        """States of the linear part when the port is at rest at a position."""
        n = len(self.row)
        return at_rest(self.A[:n, :n], self.B[:n], self.row, position)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        slowest = np.min(np.abs(np.real(self.poles)))
        lines = [
            f"Controller of {self.port} every {1000 * self.Ts:g} ms, {len(self.row)} states and the load, "
            f"{self.input_name} up to {self.limit:g} {self.model.mechanism.units.input}, "
            f"compensation: {self.compensate}",
            f"  slowest pole {slowest:.3g} 1/s, gains {np.array2string(self.K, precision=3)}",
        ]
        return "\n".join(lines + [f"  {sentence}" for sentence in self.left_out])


def controller(
    model: Mechanism | Model | Any,
    Ts: float,
    *,
    port: str = "hub",
    accuracy: float = 0.1,
    limit: float = 10.0,
    poles: Sequence[complex] | None = None,
    compensate: Compensation = "feedforward",
    load: str | None = None,
    resolution: float | Mapping[str, float] = ENCODER,
) -> Controller:
    """A controller for the position of a port, designed from a fitted model.

    Feedback and observer are designed for the linear part of the model. The feedback is a linear quadratic
    regulator whose weights give an error of `accuracy` in the position or in any coordinate the same cost as
    the largest voltage (Bryson's rule); with `poles`, it places these poles instead. The observer is a steady
    Kalman filter for the states and for a load torque, which is modelled as a random walk. Effects outside
    the linear part are compensated along the planned motion ("feedforward"), by the observed load
    ("observer"), or by both. The observed load also counters torques that the model lacks, but may cause an
    oscillation where a joint sticks.

    Not for exact tracking of a position with unstable zeros, such as the tip of a long arm: it follows the
    reference only as closely as the voltage allows.

    Args:
        model: Fitted model, mechanism, or a `Fit`.
        Ts: Sampling period of the controller [s].
        port: Port whose position follows the reference.
        accuracy: Error with the same cost as the largest voltage [rad].
        limit: Largest voltage [V], or largest input in the unit of the model's input.
        poles: Closed-loop poles in continuous time [1/s], one for each state; None for the regulator's.
        compensate: "nothing", "feedforward", "observer" or "both".
        load: Port where the load torque acts; `port` unless given.
        resolution: Step of all sensors [rad], or channel -> step.

    Returns:
        Controller.

    Raises:
        InputError: An argument is out of range or of the wrong kind, or the motor cannot move the port.

    Source: B. D. O. Anderson and J. B. Moore, Optimal Control: Linear Quadratic Methods, 1990; G. F.
    Franklin, J. D. Powell and M. Workman, Digital Control of Dynamic Systems, 3rd ed., 1998, chapter 8.

    >>> from rotflex_jax.joints import paper
    >>> found = controller(paper(), 0.002)
    >>> bool(np.all(found.poles.real < 0)), found.states[-1]
    (True, 'load at hub')
    """
    model = Model.of(getattr(model, "model", model) if not isinstance(model, Model) else model)
    Ts = positive(Ts, "Ts", example="0.002")
    accuracy = positive(accuracy, "accuracy", unit="rad", example="0.1")
    limit = positive(limit, "limit", unit=model.mechanism.units.input, example="10.0")
    one_of(compensate, "compensate", get_args(Compensation))
    mechanism = model.mechanism
    check_input_alone(mechanism, "a controller")
    for name, given in (("port", port), ("load", port if load is None else load)):
        one_of(given, name, mechanism.port_vectors)
    load = load or port
    step = _steps(resolution, mechanism)
    check_movable(mechanism)
    layout = Layout.of(mechanism.structure)
    n, size = layout.n, layout.rotor  # the rotor of a gear with play is taken to move with its port
    with double_precision():
        eq = linear_equations(mechanism, np.asarray(model.parameters_and_gates()[1]))
    A, B, ports, inverse = map(np.asarray, eq)
    A, B, ports = A[:size, :size], B[:size], ports[:size]
    row = np.zeros(size)
    row[:n] = mechanism.port_vectors[port]
    torque_at = {p: np.zeros(size) for p in mechanism.port_vectors}
    for p, column in torque_at.items():
        column[n : 2 * n] = inverse @ np.array(mechanism.port_vectors[p], float)
    balance = _balance(A, B, row, torque_at[load])
    if not np.any(B) or balance is None:
        raise InputError(
            f"The motor cannot move the port {port!r} against a torque at {load!r}; name a port that the "
            "voltage moves, or add a motor to the model."
        )
    held = zero_order_hold(A, np.column_stack([B, torque_at[load], ports]), Ts)
    Ad, Bd, pushed, push = held[0], held[1][:, 0], held[1][:, 1], held[1][:, 2:]
    effort = (accuracy / limit) ** 2
    shown_by = np.vstack([row, np.eye(n, size)])  # the controlled position, then every coordinate
    K = _placed(Ad, Bd, poles, Ts) if poles is not None else _regulator(Ad, Bd, shown_by, effort)
    C = np.zeros((len(mechanism.channels), size + 1))
    C[:, : 2 * n] = layout.output_rows
    full = np.block([[Ad, pushed[:, None]], [np.zeros((1, size)), np.ones((1, 1))]])
    stall = limit / abs(balance)
    Q = np.zeros((size + 1, size + 1))
    for column in torque_at.values():
        Q[:size, :size] += (WHITE_SHARE * stall) ** 2 * Ts * process_covariance(A, column[n : 2 * n], n, Ts)
    Q[size, size] = (LOAD_PER_SECOND * stall) ** 2 * Ts
    gain_of_load = -balance if compensate in ("observer", "both") else 0.0
    return Controller(
        model=model,
        Ts=Ts,
        port=port,
        limit=limit,
        compensate=compensate,
        A=full,
        B=np.append(Bd, 0.0),
        C=C,
        K=np.append(K, gain_of_load),
        L=_observer(full, C, Q, np.diag(step**2 / 12)),
        row=row,
        push=push,
        states=(*state_names(mechanism)[:size], f"load at {load}"),
        resolution=step,
        effort=effort,
        left_out=_left_out(model),
    )


def _steps(resolution: Any, mechanism: Mechanism) -> np.ndarray:
    """Step of each sensor."""
    named = isinstance(resolution, Mapping)
    given = dict(resolution) if named else dict.fromkeys(mechanism.channels, resolution)
    for channel in given:
        one_of(channel, "resolution", mechanism.channels)
    return np.array(
        [
            positive(given.get(c, ENCODER), "resolution", unit="rad", example="0.0015")
            for c in mechanism.channels
        ]
    )


def _balance(A: np.ndarray, B: np.ndarray, row: np.ndarray, torque: np.ndarray) -> float | None:
    """Steady voltage that balances a unit torque at an unchanged position; None if there is none."""
    n = len(row)
    rows = np.block([[A, B[:, None]], [row[None], np.zeros((1, 1))]])
    found = np.linalg.lstsq(rows, np.append(-torque, 0.0), rcond=None)[0]
    wrong = np.linalg.norm(rows @ found + np.append(torque, 0.0))
    return None if wrong > 1e-6 * np.linalg.norm(torque) or found[n] == 0 else float(found[n])


def _regulator(A: np.ndarray, B: np.ndarray, rows: np.ndarray, effort: float) -> np.ndarray:
    try:
        P = scipy.linalg.solve_discrete_are(A, B[:, None], rows.T @ rows, [[effort]])
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            "No regulator holds this model, since the voltage does not reach all that moves by itself; give "
            "a model whose motor acts on it."
        ) from error
    return (B @ P @ A) / (effort + B @ P @ B)


def _placed(A: np.ndarray, B: np.ndarray, poles: Any, Ts: float) -> np.ndarray:
    """Feedback gains that place given poles, which are in continuous time."""
    try:
        wanted = np.asarray(poles, complex)
    except (TypeError, ValueError, OverflowError):
        wanted = np.zeros(0, complex)
    pairs = np.sort_complex(wanted.ravel())
    if wanted.shape != (len(A),) or not np.all(np.isfinite(wanted)) or np.any(np.real(wanted) >= 0):
        raise InputError(
            f"Argument `poles` must be {len(A)} poles with negative real parts [1/s], one for each state, "
            f"but is {shown(poles)}; give for instance {[-20.0 - 5 * k for k in range(len(A))]}."
        )
    if len(np.unique(pairs)) < len(A) or not np.allclose(pairs, np.sort_complex(wanted.conj())):
        raise InputError(
            "Argument `poles` must be different ones, complex ones in pairs, but one stands twice or without "
            "its conjugate; move it a little, or add the other."
        )
    return scipy.signal.place_poles(A, B[:, None], np.exp(wanted * Ts)).gain_matrix[0]


def _observer(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Gain of the steady Kalman filter in filter form: the present sample corrects the present state."""
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            "The sensors do not show all states and the load, so no observer follows them; give a model with "
            "a sensor of each position."
        ) from error
    return np.linalg.solve(C @ P @ C.T + R, C @ P).T


def _left_out(model: Model) -> tuple[str, ...]:
    gates = model.gates or (1.0,) * len(model.mechanism.effects)
    inputs = [i for i, _ in effects_of(model.mechanism, Actuation)]
    return tuple(
        f"{e.title} at {e.at} is not compensated."
        for i, e in enumerate(model.mechanism.effects)
        if gates[i] and (i in inputs or e.state_part == "rotor")
    )
