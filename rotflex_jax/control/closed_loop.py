"""A controller in closed loop: with a simulated model and all its effects, or with a real machine."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from rotflex_jax.checks import instance, number, seed as checked_seed, shown
from rotflex_jax.control.design import Controller, PlannedMotion
from rotflex_jax.effects.base import Actuation
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.assembly import Layout, effects_of, motor_voltage, rest_state
from rotflex_jax.mechanism.mechanism import check_input_alone
from rotflex_jax.mechanism.simulate import read_outputs
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision
from rotflex_jax.text.numbers import readable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMMANDS_KEPT = 128
"""Number of latest commands, the present one included, on which the voltage at the motor may depend."""

SETTLING_SHARE = 1 / 3
"""Share of the time at a constant reference that is left for settling before a limit cycle is looked for."""

SHORTEST_REST = 1.0
"""Least time at a constant reference for which a limit cycle is looked for [s]."""

NOT_LOOKED_FOR = f"limit cycle not looked for, since the reference rests for less than {SHORTEST_REST:g} s"
"""What a sentence says of a run whose reference moves until its end, or almost."""

SUSTAINED = 0.9
"""An oscillation dies out if its size in the second half is below this share of its size in the first."""

COUNTS_OF_CYCLE = 2.5
"""Least peak-to-peak size of a limit cycle, in steps of the finest sensor; the steps cause smaller ones."""


class LimitCycle(NamedTuple):
    """A sustained oscillation at a constant reference.

    Attributes:
        amplitude: Half of the peak-to-peak size [rad].
        frequency: Frequency of the oscillation [Hz].
    """

    amplitude: float
    frequency: float


@runtime_checkable
class Plant(Protocol):
    """A machine, or a simulator of one, that a controller may drive."""

    def read(self) -> Any:
        """Present readings of the sensors, in the order of the model's channels."""
        ...

    def advance(self, voltage: float) -> Any:
        """Applies the voltage [V] and holds it over one sample."""
        ...


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ClosedLoop:
    """A run in closed loop.

    Attributes:
        controller: The controller.
        motion: The planned motion.
        outputs: Readings of the sensors.
        position: Position of the controlled port [rad]; for a machine, computed from its readings.
        voltage: Applied voltage [V].
        states: Observed states of the linear part.
        load: Observed load torque [N m].
    """

    controller: Controller
    motion: PlannedMotion
    outputs: Float[np.ndarray, "N C"]
    position: Float[np.ndarray, " N"]
    voltage: Float[np.ndarray, " N"]
    states: Float[np.ndarray, "N n"]
    load: Float[np.ndarray, " N"]

    @property
    def t(self) -> Float[np.ndarray, " N"]:
        """Time [s]."""
        return self.controller.Ts * np.arange(len(self.position))

    @property
    def unit(self) -> str:
        """Unit of position and error."""
        return self.controller.model.mechanism.units.motion

    @property
    def error(self) -> Float[np.ndarray, " N"]:
        """Reference less position [rad]."""
        return self.motion.reference - self.position

    @property
    def rms(self) -> float:
        """Root mean square tracking error [rad]; infinite if the run diverged."""
        return float(np.sqrt(np.mean(self.error**2))) if self.bounded else np.inf

    @property
    def largest(self) -> float:
        """Largest magnitude of the tracking error [rad]; infinite if the run diverged."""
        return float(np.max(np.abs(self.error))) if self.bounded else np.inf

    @property
    def saturated(self) -> float:
        """Share of the samples in which the voltage was at its limit."""
        return float(np.mean(np.abs(self.voltage) >= self.controller.limit * (1 - 1e-9)))

    @property
    def bounded(self) -> bool:
        """Whether all positions are finite and below 1000 (1 + largest reference) in magnitude."""
        most = 1e3 * (1 + np.max(np.abs(self.motion.reference)))
        return bool(np.all(np.isfinite(self.position)) and np.max(np.abs(self.position)) < most)

    @property
    def _still(self) -> int:
        """Number of samples at the end in which the reference is constant."""
        r = self.motion.reference
        moving = np.flatnonzero(r != r[-1])
        return len(r) - (int(moving[-1]) + 1 if len(moving) else 0)

    @property
    def rests(self) -> bool:
        """Whether the reference is constant at its end for long enough to look for a limit cycle."""
        return self._still * self.controller.Ts >= SHORTEST_REST

    @functools.cached_property
    def limit_cycle(self) -> LimitCycle | None:
        """Sustained oscillation at the end of the run, while the reference is constant; None without one.

        The reference must be constant for its last second or longer. The first third of this time is left for
        settling, the rest is halved. In each half, the position must cross the middle of its range at least
        twice. In the second half, the oscillation must be larger than the steps of the finest sensor and not
        clearly smaller than in the first half.
        """
        Ts, r, still = self.controller.Ts, self.motion.reference, self._still
        if not self.rests or not self.bounded:
            return None
        tail = self.position[len(r) - round(still * (1 - SETTLING_SHARE)) :]
        halves = np.array_split(tail, 2)
        sizes, crossings = [], []
        for part in halves:
            middle = (part.max() + part.min()) / 2
            above = part > middle
            sizes.append(float(np.ptp(part)))
            crossings.append(int(np.sum(above[1:] != above[:-1])))
        small = COUNTS_OF_CYCLE * float(self.controller.resolution.min())
        if min(crossings) < 2 or sizes[1] < small or sizes[1] < SUSTAINED * sizes[0]:
            return None
        return LimitCycle(sizes[1] / 2, sum(crossings) / (2 * Ts * len(tail)))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        cycle = self.limit_cycle
        return {
            "rms": self.rms if self.bounded else None,
            "largest": self.largest if self.bounded else None,
            "bounded": self.bounded,
            "saturated": self.saturated,
            "limit_cycle": None if cycle is None else cycle._asdict(),
        }

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        if not self.bounded:
            return "The run diverged."
        unit, cycle = self.unit, self.limit_cycle
        rms, shown_in = readable(self.rms, unit)
        worst, worst_in = readable(self.largest, unit)
        ends = "no limit cycle" if self.rests else NOT_LOOKED_FOR
        if cycle is not None:
            size, size_in = readable(cycle.amplitude, unit)
            ends = f"limit cycle of {size:.3g} {size_in} at {cycle.frequency:.3g} Hz"
        return (
            f"Tracking error {rms:.3g} {shown_in} rms, at most {worst:.3g} {worst_in}; {ends}; "
            f"{self.controller.input_name} at its limit in {100 * self.saturated:.3g} % of the samples."
        )

    def plot(self, *others: "ClosedLoop") -> "Figure":
        """Figure of position, error, voltage and observed load over time, with other runs beside them."""
        from rotflex_jax.control.figure import loop_figure  # loads matplotlib, so only on request

        runs = (self, *others)
        return loop_figure(runs, [f"compensation: {each.controller.compensate}" for each in runs])


class _Gains(NamedTuple):
    """Matrices, gains and limit of a controller, as arrays of NumPy or JAX."""

    A: Any
    B: Any
    C: Any
    K: Any
    L: Any
    limit: Any


def _feedback(g: _Gains, e: Any, y: Any, y_plan: Any, u_plan: Any) -> tuple[Any, Any, Any]:
    """Voltage, corrected deviation from the plan and predicted next one, for arrays of NumPy or JAX."""
    e = e + g.L @ (y - y_plan - g.C @ e)
    u = (u_plan - g.K @ e).clip(-g.limit, g.limit)
    return u, e, g.A @ e + g.B * (u - u_plan)


@persistent_jit(static=2)
def _run(
    structure: Mechanism,
    solver: Solver,
    values: Array,
    gates: Array,
    x0: Array,
    gains: _Gains,
    y_plan: Array,
    u_plan: Array,
    noise: Array,
    step: Array,
    Ts: Array,
) -> tuple[Array, ...]:
    """States (N, n), readings, voltages and observed deviations of a run in closed loop.

    The last result is the largest error of the motor's voltage in the loop, which is computed there from the
    latest `COMMANDS_KEPT` commands.
    """
    mechanism = structure.with_values(values)
    c: Any = solver.prepare(structure, values, gates, Ts)  # the type depends on the solver
    acted = bool(effects_of(structure, Actuation))

    def body(carry: Any, w: Any) -> tuple[Any, Any]:
        x, e, commands = carry
        planned, voltage, random = w
        y = read_outputs(mechanism, gates, x) + random
        y = step * jnp.round(y / step)
        u, e, following = _feedback(gains, e, y, planned, voltage)
        if acted:
            commands = jnp.append(commands[1:], u)
            v = motor_voltage(mechanism, gates, commands, Ts)[-1]
        else:
            v = u
        return (solver.advance(structure, x, v, c), following, commands), (x, y, u, e, v)

    kept = jnp.full(COMMANDS_KEPT if acted else 0, u_plan[0])
    start = (x0, jnp.zeros(len(gains.B)), kept)
    X, Y, u, E, v = jax.lax.scan(body, start, (y_plan, u_plan, noise))[1]
    # Voltage at the motor from the whole sequence of commands, for comparison with the loop.
    before = jnp.full(COMMANDS_KEPT if acted else 0, u_plan[0])
    whole = motor_voltage(mechanism, gates, jnp.concatenate([before, u]), Ts)[len(before) :]
    return X, Y, u, E, jnp.max(jnp.abs(whole - v))


def close_loop(
    controller: Controller,
    plant: Any,
    reference: Float[ArrayLike, " N"] | Sequence[float],
    *,
    noise: float = 0.0,
    seed: int | np.random.Generator = 0,
) -> ClosedLoop:
    """Runs a model or a machine in closed loop along a reference.

    A model is simulated with all its effects, from rest at the first value of the reference. Noise is added
    to its outputs, which are then rounded to the steps of the sensors. A machine is read and driven sample by
    sample.

    Args:
        controller: From `controller`.
        plant: Model or mechanism, or an object with `read()` and `advance(voltage)`.
        reference: Reference of the port's position, one value for each sample.
        noise: Standard deviation of the noise that is added to outputs of a model before rounding [rad].
        seed: Seed of the noise.

    Returns:
        ClosedLoop.

    Raises:
        InputError: `plant` is neither a model nor a machine, its channels are not the controller's, a reading
            is no finite number, the readings of a machine do not show the position of the port, or
            `reference` is no signal.
    """
    noise = number(noise, "noise", least=0.0, unit="rad", example="0.001")
    instance(controller, Controller, "controller", "make one with rotflex_jax.controller")
    return run_loop(controller, plant, controller.plan(reference), noise, seed)


def run_loop(
    controller: Controller,
    plant: Any,
    motion: PlannedMotion,
    noise: float = 0.0,
    seed: int | np.random.Generator = 0,
) -> ClosedLoop:
    """`close_loop` along a motion that has been planned before."""
    if isinstance(plant, Model | Mechanism):
        model = Model.of(plant)
        check_input_alone(model.mechanism, "a closed loop")
        return _with_model(controller, model, motion, noise, checked_seed(seed))
    if not isinstance(plant, Plant):
        raise InputError(
            f"Argument `plant` must be a model, or an object with read() and advance(voltage), but is "
            f"{shown(plant)}; give for instance the fitted model."
        )
    gains, weights = _gains(controller), _position_of(controller)
    N, n = len(motion.voltage), len(controller.row)
    Y, u = np.empty(motion.outputs.shape), np.empty(N)
    E = np.empty((N, n + 1))
    e = np.zeros(n + 1)
    for k in range(N):
        y = Y[k] = _readings(plant.read(), controller.model.mechanism.channels, k)
        u[k], E[k], e = _feedback(gains, e, y, motion.outputs[k], motion.voltage[k])
        plant.advance(float(u[k]))
    return _result(controller, motion, Y, Y @ weights, u, E)


def _readings(given: Any, channels: tuple[str, ...], k: int) -> Float[np.ndarray, " C"]:
    """The readings of a machine at sample `k`; the machine is not driven on without them."""
    try:
        y = np.asarray(given, float)
    except (TypeError, ValueError):
        y = np.asarray(np.nan)
    if y.shape != (len(channels),):
        what = f"{y.size} values" if y.ndim else shown(given)
        raise InputError(
            f"Argument `plant` reads {what}, but the model has the channels {', '.join(channels)}; return "
            "one reading of each."
        )
    if not np.all(np.isfinite(y)):
        c = int(np.argmin(np.isfinite(y)))
        raise InputError(
            f"Argument `plant` reads {y[c]} for {channels[c]} at sample {k}, but a machine is driven by "
            "readings that are numbers; check that sensor."
        )
    return y


def _with_model(
    controller: Controller, model: Model, motion: PlannedMotion, noise: float, seed: Any
) -> ClosedLoop:
    mechanism, structure = model.mechanism, model.mechanism.structure
    own = controller.model.mechanism
    if mechanism.channels != own.channels or controller.port not in mechanism.port_vectors:
        raise InputError(
            f"Argument `plant` has the channels {', '.join(mechanism.channels)}, but the controller is one "
            f"of {', '.join(own.channels)} at the port {controller.port!r}; give a model of the same machine."
        )
    layout, solver = Layout.of(structure), model.solver
    if getattr(solver, "between", "held") != "held":
        solver = dataclasses.replace(solver, between="held")  # pyright: ignore[reportCallIssue]
    x0 = rest_state(structure, np.float64)
    row = np.zeros(layout.size)
    row[: layout.n] = mechanism.port_vectors[controller.port]
    # Shortest vector of coordinates that puts the port at the first value of the reference.
    x0[: layout.n] = row[: layout.n] * motion.reference[0] / (row @ row)
    if len(own.coordinates) == layout.n:
        x0[: layout.n] = motion.states[0, : layout.n]
    if layout.linear > layout.rotor:
        x0[layout.rotor] = motion.reference[0]
    random = np.random.default_rng(seed).normal(size=motion.outputs.shape) * noise
    with double_precision():
        values, gates = model.parameters_and_gates()
        X, Y, u, E, wrong = (
            np.asarray(part)
            for part in _run(
                structure,
                solver,
                values,
                gates,
                x0,
                _gains(controller),
                motion.outputs,
                motion.voltage,
                random,
                controller.resolution,
                np.asarray(controller.Ts),
            )
        )
    if wrong > 1e-6 * controller.limit:
        names = ", ".join(e.title for _, e in effects_of(mechanism, Actuation))
        raise InputError(
            f"The {names} of this model remember more than {COMMANDS_KEPT} samples of the voltage, which a "
            "simulated loop does not; give a model without them, or a longer sampling period."
        )
    return _result(controller, motion, Y, X @ row, u, E)


def _gains(controller: Controller) -> _Gains:
    c = controller
    return _Gains(c.A, c.B, c.C, c.K, c.L, np.asarray(c.limit))


def _position_of(controller: Controller) -> np.ndarray:
    """The controlled position as a combination of the readings."""
    rows = controller.C[:, : len(controller.row)]
    weights, *_ = np.linalg.lstsq(rows.T, controller.row, rcond=None)
    if not np.allclose(weights @ rows, controller.row, atol=1e-9):
        raise InputError(
            f"The readings {', '.join(controller.model.mechanism.channels)} do not show the position of "
            f"{controller.port!r}, so the tracking of a machine cannot be assessed; control a port that is "
            "measured."
        )
    return weights


def _result(
    controller: Controller,
    motion: PlannedMotion,
    Y: np.ndarray,
    position: np.ndarray,
    u: np.ndarray,
    E: np.ndarray,
) -> ClosedLoop:
    return ClosedLoop(controller, motion, Y, position, u, motion.states + E[:, :-1], E[:, -1])
