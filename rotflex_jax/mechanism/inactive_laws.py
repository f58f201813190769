"""Sensitivities to the laws of inactive effects: what a law would add to a step, and how the run responds.

A torque, a friction level, a voltage or a reading that an inactive effect would add changes a step by

    b[k] = sum over j of G[k, j] s[k, j],

where `s[k, j]` is the value of the law at the j-th evaluation of laws within the step, and `G` is the
derivative of the state after the step with respect to a value added there. `G` belongs to the active model
and is formed once for all laws. Each law is evaluated along the run for its own directions alone, without a
step around it. One recursion carries all directions side by side,

    dx[k+1] = A[k] dx[k] + b[k],   dy[k] = H[k] dx[k].

Effects that enter the matrices of the step or have linear states are not of this form; `sensitivities` treats
them.
"""

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from rotflex_jax.effects.base import (
    Actuation,
    DryFriction,
    Effect,
    Force,
    Gear,
    Linear,
    Memory,
    Scalar,
    Sensing,
)
from rotflex_jax.mechanism.assembly import effects_of, motor_inputs, split_input
from rotflex_jax.mechanism.gear import gear_steps
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.scan import join_chunks, split_into_chunks, states
from rotflex_jax.mechanism.sensitivities import LinearisedRun, RecordingSamples, RunParameters
from rotflex_jax.mechanism.shortcut import without_shortcuts
from rotflex_jax.mechanism.simulate import (
    PredictorStep,
    Solver,
    prepared_run,
    read_outputs,
    sensor_readings,
    true_outputs,
)
from rotflex_jax.mechanism.step import Exponential, exponential_euler, within


class _Evaluations:
    """The evaluations of laws while one step is traced, in order, and the value added at each of them."""

    def __init__(self, added: Float[Array, "L *S"] | None = None) -> None:
        self.added, self.motion = added, []

    def __call__(self, *signals: Any) -> Array:
        self.motion.append(jnp.stack(signals))
        return jnp.zeros_like(signals[0]) if self.added is None else self.added[len(self.motion) - 1]


class _Traced(threading.local):
    evaluations = _Evaluations()


_traced = _Traced()


@contextlib.contextmanager
def _recorded(evaluations: _Evaluations) -> Iterator[None]:
    _traced.evaluations = evaluations
    try:
        with without_shortcuts():
            yield
    finally:
        _traced.evaluations = _Evaluations()


@dataclasses.dataclass(frozen=True)
class AddedForce(Force):
    """A given torque at a port, which records where a step evaluates it."""

    name: ClassVar[str] = "added_force"

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m]."""
        return _traced.evaluations(position, speed)


@dataclasses.dataclass(frozen=True)
class AddedFriction(DryFriction):
    """A given friction level at a port, which records where a step evaluates it."""

    name: ClassVar[str] = "added_friction"

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar, *load: Scalar) -> Scalar:
        """Level [N m]."""
        return _traced.evaluations(position, speed)


# Evaluations of friction levels in a step with torques: both directions, at its stages and twice at its end.
FRICTION_EVALUATIONS = 6

Extended = tuple[Mechanism, Solver, tuple[Effect, ...]]
"""The active structure, the integration rule, and the added effects that record evaluations."""


class PortResponses(NamedTuple):
    """Motion at which a step evaluates laws at some ports, and its response to values that are added there.

    Attributes:
        motion: Position [rad] and speed [rad/s] of the port at each of the J evaluations.
        response: Change of the state after the step per unit that is added at an evaluation.
    """

    motion: Float[Array, "*batch N p J 2"]
    response: Float[Array, "*batch N p J n"]


class RunResponses(NamedTuple):
    """A predictor run, and how its steps and readings respond to small changes.

    Attributes:
        run: States and the Jacobians of the steps.
        ideal: Readings of ideal sensors.
        voltage: Input of each step: the voltage [V], as in `Exponential.advance`, then the signals that drive
            effects of the model.
        to_voltage: Change of the state after a step per unit of each of these inputs.
        to_reading: Change of the state after a step per unit that is added to the reading of a sensor.
        readings: Change of the readings per unit of each state.
        torques: Evaluations of torques at the ports; None if no port is given.
    """

    run: LinearisedRun
    ideal: Float[Array, "*batch N C"]
    voltage: Float[Array, "*batch N h"]
    to_voltage: Float[Array, "*batch N h n"]
    to_reading: Float[Array, "*batch N C n"]
    readings: Float[Array, "*batch N C n"]
    torques: PortResponses | None


def adds_to_step(effect: Effect, structure: Mechanism, solver: Solver) -> bool:
    """Whether the law of an inactive effect changes a step of this model as `sum over j of G[k, j] s[k, j]`.

    Args:
        effect: The inactive effect.
        structure: The active model.
        solver: Integration rule.
    """
    if isinstance(effect, Actuation):
        return True
    if isinstance(effect, Sensing):
        return not effect.order
    steps = gear_steps(structure) * solver.substeps
    if isinstance(effect, Linear | Gear) or not isinstance(solver, Exponential) or steps > 1:
        return False
    if isinstance(effect, Memory):  # its state is advanced once, between both evaluations of the step
        rigid = not effects_of(structure, Gear)
        return rigid and solver.order == 2 and effect.driven_by == "voltage" and not _has_load(structure)
    if isinstance(effect, Force):
        return not effect.signal and effect.driven_by == "voltage"
    return isinstance(effect, DryFriction) and not effect.loaded


def _has_load(structure: Mechanism) -> bool:
    """Whether friction depends on a transmitted torque, for which a step evaluates torques once more."""
    return any(e.loaded for _, e in effects_of(structure, DryFriction))


def run_responses(
    structure: Mechanism,
    solver: Solver,
    ports: tuple[str, ...],
    parameters: RunParameters,
    samples: RecordingSamples,
) -> RunResponses:
    """A predictor run, with the responses that the laws of inactive effects need.

    Args:
        structure: The active model; static.
        solver: Integration rule; static.
        ports: Ports where torques may be added; static.
        parameters: Parameters of this structure.
        samples: The recording.
    """
    mechanism, v, c = prepared_run(
        structure, solver, parameters.values, parameters.gates, samples.u, samples.Ts
    )
    x0, measured = samples.started_at(parameters.x0)
    X = states(PredictorStep(structure, solver), x0, (v, *measured), (c, parameters.K))
    n, C = X.shape[1], samples.y.shape[1]
    extended = structure, solver, tuple(AddedForce(p) for p in ports)
    motion, responses = _responses(extended, parameters, samples, X, laws_alone=False)
    h = responses.shape[1] - n - C - motion.shape[1]
    A, to_voltage, to_measured, to_torque = jnp.split(responses, (n, n + h, n + h + C), axis=1)
    at_ports = _by_port(motion, to_torque, 1, len(ports)) if ports else None
    read = lambda x: read_outputs(mechanism, parameters.gates, x)  # noqa: E731
    units = jnp.broadcast_to(jnp.eye(n, dtype=X.dtype)[:, :, None], (n, n, len(X)))
    H = jax.vmap(lambda tangent: jax.jvp(read, (X.T,), (tangent,))[1])(units)
    return RunResponses(
        LinearisedRun(X, A),
        true_outputs(structure, X.T).T,
        v.reshape(len(X), -1),
        to_voltage,
        -to_measured,
        jnp.transpose(H, (2, 1, 0)),
        at_ports,
    )


def friction_responses(
    structure: Mechanism,
    solver: Solver,
    ports: tuple[str, ...],
    parameters: RunParameters,
    samples: RecordingSamples,
    X: Float[Array, "N n"],
) -> PortResponses:
    """How a run through states X responds to friction levels at some ports; arguments as in `run_responses`.

    Levels against positive and against negative motion alternate in the evaluations.
    """
    # One contact is added at a time: further ones without a level would only add to the cost.
    at_ports: list[PortResponses] = []
    for p in ports:
        extended = structure, solver, (AddedFriction(p),)
        count = at_ports[0].motion.shape[2] if at_ports else None
        found = _responses(extended, parameters, samples, X, laws_alone=True, count=count)
        at_ports.append(_by_port(*found, 2, 1))
    motion, response = jax.tree.map(lambda *each: jnp.concatenate(each, axis=1), *at_ports)
    # A step without torques has fewer evaluations; filled up, all structures share one compiled program.
    more = max(FRICTION_EVALUATIONS - motion.shape[2], 0)
    motion = jnp.concatenate([motion, *[motion[:, :, :2]] * (more // 2)], axis=2)
    return PortResponses(motion, jnp.pad(response, ((0, 0), (0, 0), (0, more), (0, 0))))


def _by_port(
    motion: Float[Array, "N L 2"], responses: Float[Array, "N L n"], kinds: int, ports: int
) -> PortResponses:
    """Evaluations sorted by port; a step makes the evaluations of one kind in the order of the ports."""

    def sorted_(a: Array) -> Array:
        N, L, width = a.shape
        rounds = a.reshape(N, L // (ports * kinds), ports, kinds, width)
        return jnp.swapaxes(rounds, 1, 2).reshape(N, ports, L // ports, width)

    return PortResponses(sorted_(motion), sorted_(responses))


def _responses(
    extended: Extended,
    parameters: RunParameters,
    samples: RecordingSamples,
    X: Float[Array, "N n"],
    laws_alone: bool,
    count: int | None = None,
) -> tuple[Float[Array, "N L 2"], Float[Array, "N _ n"]]:
    """Motion at the L evaluations of added effects, and how the state after a step responds to changes.

    These are changes of the state before the step, of the voltage, of the measured outputs and of the values
    of the added effects, in this order, or of the values of the added effects alone.

    Args:
        extended: Structure, integration rule and added effects of the step.
        parameters: Parameters of the structure without the added effects.
        samples: The recording.
        X: States.
        laws_alone: Whether only changes of the values of added effects are wanted.
        count: Number of evaluations L, if it is known.
    """
    structure, solver, added_effects = extended
    structure = dataclasses.replace(structure, effects=(*structure.effects, *added_effects)).structure
    gates = jnp.concatenate([parameters.gates, jnp.ones(len(added_effects), parameters.gates.dtype)])
    _, v, c = prepared_run(structure, solver, parameters.values, gates, samples.u, samples.Ts)
    _, measured = samples.started_at(parameters.x0)
    step, constants = PredictorStep(structure, solver), (c, parameters.K)

    def evaluated(x: Array, v: Array, y: Array, rest: Any, added: Array | None) -> tuple[Array, list[Array]]:
        record = _Evaluations(added)
        with _recorded(record):
            return step(x, (v, y, *rest), constants), record.motion

    def here(piece: Any) -> tuple[Array, Array]:
        x, v, y, rest = piece
        S = x.shape[-1]
        evaluations = count or len(jax.eval_shape(lambda: evaluated(x, v, y, rest, None))[1])
        none = jnp.zeros((evaluations, S), x.dtype)
        moved = [none] if laws_alone else [x, v, y, none]
        sizes = [a.size // S for a in moved]
        units = jnp.split(jnp.eye(sum(sizes), dtype=x.dtype), np.cumsum(sizes)[:-1], axis=1)
        tangents = [
            jnp.broadcast_to(unit.reshape(sum(sizes), *a.shape[:-1], 1), (sum(sizes), *a.shape))
            for unit, a in zip(units, moved, strict=True)
        ]

        def f(*moved: Array) -> tuple[Array, Array]:
            at = (x, v, y) if laws_alone else moved[:3]
            end, motion = evaluated(at[0], at[1], at[2], rest, moved[-1])
            return end, jnp.stack(motion) if motion else jnp.zeros((0, 2, S), x.dtype)

        def along(*tangent: Array) -> tuple[Array, Array]:
            (_, motion), (end, _) = jax.jvp(f, tuple(moved), tangent)
            return motion, end

        return jax.vmap(along, out_axes=(None, 0))(*tangents)

    y, *rest = measured
    motion, responses = jax.lax.map(here, split_into_chunks((X, v, y, rest)))
    return join_chunks(motion, len(X)), join_chunks(responses, len(X))


class InactiveLaws(NamedTuple):
    """Parameter values of some inactive effects, each of which is tried with S shapes of its law.

    Attributes:
        values: Parameter values (S, P) of each effect.
        along: D directions (S, D, P) in these values; not used for an effect that is switched on as a whole.
    """

    values: tuple[Float[Array, "_ _"], ...]
    along: tuple[Float[Array, "_ _ _"], ...]


def law_sensitivities(
    effects: tuple[Effect, ...],
    ports: tuple[str, ...],
    laws: InactiveLaws,
    samples: RecordingSamples,
    responses: RunResponses,
    at_ports: PortResponses,
) -> Float[Array, "D N C"]:
    """Derivatives of the predicted outputs along laws at ports: torques, memories or friction levels.

    Args:
        effects: Effects of one kind, without values; static.
        ports: Ports of the evaluations; static.
        laws: Parameter values of the effects.
        samples: The recording.
        responses: From `run_responses`.
        at_ports: Its `torques`; for dry friction the result of `friction_responses`.
    """
    v = responses.voltage[:, 0]
    places = [ports.index(e.at) for e in effects]
    memories = _memories(effects, places, laws, samples, v, at_ports)
    forced = []
    for p in range(len(ports)):
        here = [i for i, place in enumerate(places) if place == p]
        added = [
            _law_changes(effects[i], at_ports.motion[:, p], v, laws.values[i], memories[i]) for i in here
        ]
        forced.append((at_ports.response[:, p], jnp.concatenate(added, axis=2)) if here else None)
    dy = _recursion(responses, [f for f in forced if f is not None])
    found: list[Any] = [None] * len(effects)
    for p, changes in zip(sorted(set(places)), dy, strict=True):
        here = [i for i, place in enumerate(places) if place == p]
        widths = [_basis(effects[i]) * len(laws.values[i]) for i in here]
        for i, part in zip(here, jnp.split(changes, np.cumsum(widths)[:-1], axis=2), strict=True):
            found[i] = _members(effects[i], laws.along[i], part)
    return jnp.concatenate(found)


def _basis(e: Effect) -> int:
    """Number of directions that span those of one shape: one per amplitude, or one if it is switched on."""
    return max(len(e.amplitudes), 1)


def _members(e: Effect, along: Float[Array, "S D P"], dy: Float[Array, "N C KS"]) -> Float[Array, "SD N C"]:
    """Changes of the readings along the directions of each shape, from those along its amplitudes."""
    parts = dy.reshape(*dy.shape[:2], _basis(e), -1)
    if e.amplitudes:
        share = along[:, :, np.array([list(e.values).index(name) for name in e.amplitudes])]
    else:
        share = jnp.ones((*along.shape[:2], 1), dy.dtype)
    each = jnp.einsum("nckS,SDk->SDnc", parts, share)
    return each.reshape(-1, *dy.shape[:2])


def _law_changes(
    e: Effect,
    motion: Float[Array, "N J 2"],
    v: Float[Array, " N"],
    values: Float[Array, "S P"],
    z: Float[Array, "J N S"] | None,
) -> Float[Array, "N J KS"]:
    """Change by a law at each evaluation: along its amplitudes, or its whole value if it is switched on."""

    def at(j: int, values: list[Array], z: Array | None) -> Array:
        law = _with(e, values)
        position, speed = motion[:, j, 0], motion[:, j, 1]
        if isinstance(e, DryFriction):
            value = law.limit(position, speed, 1.0 - 2.0 * (j % 2))
        elif isinstance(e, Memory):
            value = law.force(z, position, speed, v)
        else:
            value = law.force(position, speed, v)
        return jnp.broadcast_to(value, v.shape)

    def slope(j: int, name: str | None, values: Array, z: Array | None) -> Array:
        each = list(jnp.unstack(values))
        if name is None:
            return at(j, each, z)
        k = list(e.values).index(name)
        along = lambda a: at(j, [*each[:k], a, *each[k + 1 :]], z)  # noqa: E731
        return jax.jvp(along, (each[k],), (jnp.ones_like(each[k]),))[1]

    def shapes(j: int, name: str | None) -> Array:
        own = None if z is None else z[j]
        one = functools.partial(slope, j, name)
        return jax.vmap(one, in_axes=(0, None if own is None else 1), out_axes=1)(values, own)

    evaluations = range(motion.shape[1])
    columns = [jnp.stack([shapes(j, name) for j in evaluations], axis=1) for name in e.amplitudes or (None,)]
    return jnp.concatenate(columns, axis=2)


def _with(e: Effect, values: Sequence[Array]) -> Any:
    return e.replace(**dict(zip(e.values, values, strict=True)))


def _memories(
    effects: tuple[Any, ...],
    places: list[int],
    laws: InactiveLaws,
    samples: RecordingSamples,
    v: Float[Array, " N"],
    at_ports: PortResponses,
) -> list[Float[Array, "2 N S"] | None]:
    """States of memories at both evaluations of each step, for each shape; None for other effects."""
    if not all(isinstance(e, Memory) for e in effects):
        return [None] * len(effects)
    # The motion is held at the middle of the step: at the mean of both evaluations, as it is linear in them.
    middle = jnp.mean(at_ports.motion, axis=2)
    rest = [
        jnp.full(len(values), e.initial(), v.dtype) for e, values in zip(effects, laws.values, strict=True)
    ]
    ends = jnp.zeros_like(v) if samples.window is None else _window_ends(samples.window, v)

    def advance(z: list[Array], sample: Any) -> tuple[list[Array], tuple[list[Array], list[Array]]]:
        motion, v, ends = sample
        later = []
        for e, p, values, own in zip(effects, places, laws.values, z, strict=True):
            law = lambda values, e=e: _with(e, jnp.unstack(values))  # noqa: E731
            flow = lambda values, s, law=law, p=p: law(values).flow(s, motion[p, 0], motion[p, 1], v)  # noqa: E731
            each = jax.vmap(flow)
            after = exponential_euler(lambda s, each=each, values=values: each(values, s), own, samples.Ts)
            later.append(within(after, *e.limits))
        return [jnp.where(ends > 0, r, s) for r, s in zip(rest, later, strict=True)], (z, later)

    before, after = jax.lax.scan(advance, rest, (middle, v, ends))[1]
    return [jnp.stack(pair) for pair in zip(before, after, strict=True)]


def _window_ends(window: Integer[Array, " N"], v: Array) -> Array:
    return (jnp.concatenate([window[1:], window[-1:]]) != window).astype(v.dtype)


def signal_sensitivities(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, "D P"],
    gates: Float[Array, "D E"],
    dvalues: Float[Array, "D P"],
    dgates: Float[Array, "D E"],
    samples: RecordingSamples,
    responses: RunResponses,
) -> Float[Array, "D N C"]:
    """Derivatives of the predicted outputs along effects on the voltage and on readings.

    The rest of the model enters through the responses alone, so that one program serves all models.

    Args:
        structure: All effects on the voltage and on readings; static. Effects that the directions
            move have no states.
        solver: Integration rule; static.
        values: Parameter values at which each direction is tried.
        gates: Gates at which each direction is tried.
        dvalues: Directions in the values.
        dgates: Directions in the gates.
        samples: The recording.
        responses: From `run_responses`; the states of its run are those of this structure.
    """
    N, x, ideal = len(responses.ideal), responses.run.X.T, responses.ideal.T

    def voltage(values: Array, gates: Array) -> Array:
        u, _ = split_input(samples.u)
        return motor_inputs(solver, structure.with_values(values), gates, u, samples.Ts).reshape(N, -1)

    def reading(values: Array, gates: Array) -> Array:
        return sensor_readings(structure.with_values(values), gates, ideal, x).T

    def slopes(f: Callable[[Array, Array], Array]) -> Array:
        one = lambda *at: jax.jvp(f, at[:2], at[2:])[1]  # noqa: E731
        return jax.vmap(one, out_axes=-1)(values, gates, dvalues, dgates)

    dv, dy = slopes(voltage), slopes(reading)
    to_voltage = responses.to_voltage[:, : dv.shape[1]]  # signals come after the voltage
    response = jnp.concatenate([to_voltage, responses.to_reading], axis=1)
    (later,) = _recursion(responses, [(response, jnp.concatenate([dv, dy], axis=1))])
    return jnp.moveaxis(later + dy, -1, 0)


def _recursion(
    responses: RunResponses, forced: list[tuple[Float[Array, "N _ n"], Float[Array, "N _ _"]]]
) -> list[Float[Array, "N C _"]]:
    """Changes of the readings under forcings of the run, with the directions last for the vector units.

    Args:
        responses: Responses of the run.
        forced: For each forcing: response of the state to some quantities, and the change of these
            quantities along some directions.
    """

    def body(states: list[Array], here: Any) -> tuple[list[Array], list[Array]]:
        a, h, sources = here
        later = [
            jnp.sum(a[:, :, None] * dx[:, None], axis=0) + jnp.sum(g[:, :, None] * s[:, None], axis=0)
            for dx, (g, s) in zip(states, sources, strict=True)
        ]
        return later, [jnp.sum(h[:, :, None] * dx[None], axis=1) for dx in states]

    still = [jnp.zeros((responses.run.A.shape[1], s.shape[2]), s.dtype) for _, s in forced]
    return jax.lax.scan(body, still, (responses.run.A, responses.readings, forced))[1]
