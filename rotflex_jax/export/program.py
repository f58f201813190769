"""A model's step as scalar expressions, and its actuation as a recursion from sample to sample.

An actuation effect maps the sequence `u` (N,) to the sequence `v` (N,). Its jaxpr is evaluated on a symbolic
sequence, of which only the indices are known. Entry k of a delayed sequence is entry max(k - d, 0) of the
original, entry 0 is the first command, and a scan becomes a state. The result is a recursion over samples.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, Real

from rotflex_jax.errors import InputError
from rotflex_jax.export.expression import Expression, Operand, make, node
from rotflex_jax.export.unfold import CALLS, MOVES, CannotUnfold, each, moved, run, unfold, unknown
from rotflex_jax.mechanism.assembly import Layout, motor_voltage
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.shortcut import without_shortcuts
from rotflex_jax.mechanism.simulate import Solver, read_outputs
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

SEQUENCE_LENGTH = 16384
"""Length of the symbolic sequence [samples], which must exceed any delay."""


@dataclasses.dataclass(frozen=True)
class Stream:
    """A symbolic sequence, or some entries of it.

    Attributes:
        base: Expression of the sequence at the present sample.
        index: Indices of the samples, in any shape; -1 for `before`.
        before: Value before the first sample.
    """

    base: Operand
    index: Integer[np.ndarray, "..."] | np.integer
    before: float | None = None

    # Symbolic, see `unfold.unknown`.
    dtype = np.dtype(object)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the entries."""
        return self.index.shape


@dataclasses.dataclass
class SequenceState:
    """A state of the actuation: its value before the first sample, and its value after a sample."""

    start: Operand
    next: Operand = 0.0


class SequenceRules:
    """Rules for the equations of a jaxpr on symbolic sequences; collects the states that they need."""

    def __init__(self) -> None:
        self.states: list[SequenceState] = []

    def __call__(self, eqn: Any, given: list[Any]) -> list[Any] | None:
        """Results of an equation, or None if this class does not apply to it."""
        if not any(isinstance(g, Stream) for g in given):
            return None
        name, params = eqn.primitive.name, eqn.params
        if name == "scan":
            return self._scan(given, params)
        if name in MOVES:
            return self._move(eqn, given)
        if name in CALLS:
            return None  # the equations inside are passed to this method one by one
        present = [self._present(g) for g in given]
        inner = _without_streams(eqn, present)
        shape = next(g.shape for g in given if isinstance(g, Stream))
        if eqn.outvars[0].aval.shape != shape:
            raise CannotUnfold("a sum or product over the whole sequence of voltages")
        if np.prod(shape) == 1:
            return [inner.reshape(shape)]
        return [Stream(_only(inner), np.arange(SEQUENCE_LENGTH).reshape(shape))]

    def _present(self, value: Any) -> Any:
        """An operand at the present sample: an array of shape ()."""
        if isinstance(value, Stream):
            return np.asarray(self.sample(value), object)
        value = np.asarray(value)
        first = value.flat[0]
        same = all(e is first for e in value.flat) if unknown(value) else np.all(value == first)
        return np.asarray(first if same else _ramp(value), value.dtype if same else object)

    def sample(self, stream: Stream) -> Operand:
        """The entry for the present sample."""
        k = stream.index.ravel()
        if len(k) == 1:
            if k[0] != 0:
                raise CannotUnfold(f"the command of sample {k[0]}, which is later than the first")
            return node("first", stream.base) if isinstance(stream.base, Expression) else stream.base
        late = SEQUENCE_LENGTH - 1 - int(k[-1])
        shifted = np.arange(SEQUENCE_LENGTH) - late
        early = 0 if stream.before is None else -1
        if len(k) != SEQUENCE_LENGTH or late < 0 or np.any(k != np.where(shifted < 0, early, shifted)):
            raise CannotUnfold("a sequence of voltages that is not an earlier one shifted as a whole")
        if not late or not isinstance(stream.base, Expression):
            return stream.base
        return node("past", stream.base, late, *([] if stream.before is None else [stream.before]))

    def _move(self, eqn: Any, given: list[Any]) -> list[Any]:
        count = 1 if eqn.primitive.name in ("gather", "dynamic_slice") else len(given)
        pieces, where = given[:count], given[count:]
        streams = [p for p in pieces if isinstance(p, Stream)]
        fills = {float(e) for p in pieces if not isinstance(p, Stream) for e in np.asarray(p).flat}
        fills |= {p.before for p in streams if p.before is not None}
        if any(unknown(w) for w in where) or len(fills) > 1 or len({id(p.base) for p in streams}) > 1:
            raise CannotUnfold("a sequence of voltages that is composed of different sequences")
        indices = [np.asarray(p.index) if isinstance(p, Stream) else np.full(np.shape(p), -1) for p in pieces]
        places = moved(eqn, indices, where)
        flat = np.concatenate([i.ravel() for i in indices])
        if any(np.any((p < 0) | (p >= len(flat))) for p in places):
            raise CannotUnfold("a place outside of the sequence of voltages")
        before = fills.pop() if fills else None
        return [Stream(streams[0].base, flat[p], before) for p in places]

    def _scan(self, given: list[Any], params: Any) -> list[Any]:
        """A scan along the sequence: its carry becomes a state."""
        a, b = params["num_consts"], params["num_consts"] + params["num_carry"]
        closed = params["jaxpr"]
        if params["reverse"] or params["length"] != SEQUENCE_LENGTH:
            raise CannotUnfold("a loop that does not run along the sequence of voltages")
        carry, names = [], []
        for start in given[a:b]:
            first = np.asarray(self._present(start) if isinstance(start, Stream) else start)
            places = np.empty(first.shape, object)
            for place in np.ndindex(first.shape):
                value = first[place]
                self.states.append(SequenceState(value if isinstance(value, Expression) else float(value)))
                places[place] = node("carry", len(self.states) - 1)
                names.append(len(self.states) - 1)
            carry.append(places)
        xs = [self._present(x) for x in given[b:]]
        consts = [self._present(c) if isinstance(c, Stream) else c for c in given[:a]]
        found = run(closed.jaxpr, closed.consts, [*consts, *carry, *xs])
        updates = [e for f in found[: b - a] for e in np.asarray(f, object).flat]
        for name, update in zip(names, updates, strict=True):
            self.states[name].next = update
        ends = [np.array(None, object)] * (b - a)  # the end of the sequence is not available
        return [*ends, *(Stream(_only(y), np.arange(SEQUENCE_LENGTH)) for y in found[b - a :])]


def _ramp(value: np.ndarray) -> Operand:
    """Expression of numbers that grow linearly with the sample.

    Raises:
        CannotUnfold: The numbers vary in another way.
    """
    numbers = np.zeros(0) if unknown(value) else value.astype(float).ravel()
    if len(numbers) == SEQUENCE_LENGTH:
        step = (numbers[-1] - numbers[0]) / (SEQUENCE_LENGTH - 1)
        even = numbers[0] + step * np.arange(SEQUENCE_LENGTH)
        if np.max(np.abs(numbers - even)) <= 1e-12 * np.max(np.abs(numbers)):
            return make("add", make("mul", float(step), node("count")), float(numbers[0]))
    raise CannotUnfold("a voltage that depends on the time since the start of the recording")


def _without_streams(eqn: Any, present: list[Any]) -> np.ndarray:
    """An equation for one sample: traced again with scalars."""

    def alone(*numbers: Any) -> Any:
        return eqn.primitive.bind(*numbers, **_for_scalars(eqn.params))

    like = [jax.ShapeDtypeStruct((), np.bool_ if _truth(p) else _number(p)) for p in present]
    closed = jax.make_jaxpr(alone)(*like)
    return run(closed.jaxpr, closed.consts, present)[0]


def _number(value: np.ndarray) -> Any:
    return np.float64 if unknown(value) else value.dtype


def _truth(value: np.ndarray) -> bool:
    entry = np.asarray(value).flat[0]
    return entry.truth if isinstance(entry, Expression) else isinstance(entry, (bool, np.bool_))


def _for_scalars(params: dict[str, Any]) -> dict[str, Any]:
    return {k: () if k in ("shape", "sharding_shape") else v for k, v in params.items()}


def _only(value: Any) -> Operand:
    """The one entry of an array of size one."""
    entry = np.asarray(value, object).flat[0]
    return entry if isinstance(entry, Expression) else float(entry)


def per_sample(function: Callable[[Any], Any], u: Operand) -> tuple[Operand, Sequence[SequenceState]]:
    """A function of sequences (N,) as an expression of the present sample `u`, and the states that it needs.

    Raises:
        CannotUnfold: The function uses later samples, or depends on time.
    """
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((SEQUENCE_LENGTH,), np.float64))
    rules = SequenceRules()
    out = run(closed.jaxpr, closed.consts, [Stream(u, np.arange(SEQUENCE_LENGTH))], rules)[0]
    if isinstance(out, Stream):
        return rules.sample(out), rules.states
    return _only(each(lambda x: x, out).ravel()[-1:]), rules.states


@dataclasses.dataclass(frozen=True)
class SampleProgram:
    """A model as scalar expressions.

    Attributes:
        outputs: Readings at the start of a sample, as functions of the state.
        voltage: Voltage at the motor, as a function of the command `u`.
        sequence_states: States of the actuation.
        state: State after a step, as a function of the state and the voltage `v`.
    """

    outputs: list[Operand]
    voltage: Operand
    sequence_states: tuple[SequenceState, ...]
    state: list[Operand]


def sample_program(model: Model, Ts: float) -> SampleProgram:
    """The step of a model as scalar expressions.

    Raises:
        InputError: C code cannot express an effect, which the message names, or the voltage is not held
            between samples.
    """
    if (between := getattr(model.solver, "between", "held")) != "held":
        raise InputError(
            f"The model's voltage is {between} between samples, but C code takes a voltage that is held; "
            'export it with between="held".'
        )
    try:
        return _program(model, Ts)
    except CannotUnfold as error:
        raise InputError(
            f"{_obstacle(model, Ts)} cannot be written as C code: it needs {error}; leave it out of the "
            f"model, or write its equation with operations of jax.numpy on scalars."
        ) from None


def _program(model: Model, Ts: float) -> SampleProgram:
    mechanism, solver = model.mechanism, model.solver
    structure = mechanism.structure
    layout = Layout.of(structure)
    x = np.array([node("x", i) for i in range(layout.size)], object)
    v = np.array(node("v"), object)
    with double_precision():
        values, gates = model.parameters_and_gates()
        one_step: Any = dataclasses.replace(solver, substeps=1)  # the C code repeats it `substeps` times
        constants = _constants(structure, solver, values, gates, jnp.asarray(Ts))
        outputs = unfold(lambda s: read_outputs(mechanism, gates, s), x)
        with without_shortcuts():
            advanced = unfold(lambda s, w: one_step.advance(structure, s, w, constants), x, v)
        voltage, memories = per_sample(
            lambda u: motor_voltage(mechanism, gates, u, jnp.asarray(Ts)), node("u")
        )
    return SampleProgram(list(outputs), voltage, tuple(memories), list(advanced))


@persistent_jit(static=2)
def _constants(
    structure: Mechanism,
    solver: Solver,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    Ts: Float[Array, ""],
) -> Any:
    """Constants of the step; as one program, since each operation by itself would be compiled."""
    return solver.prepare(structure, values, gates, Ts)


def _obstacle(model: Model, Ts: float) -> str:
    """Name of the effect that cannot be written as scalar expressions."""
    gates = model.gates or (1.0,) * len(model.mechanism.effects)
    linear = [(e, g) for e, g in zip(model.mechanism.effects, gates, strict=True) if e.is_linear]
    for effect, gate in zip(model.mechanism.effects, gates, strict=True):
        if effect.is_linear:
            continue
        alone = [*linear, (effect, gate)]
        effects, switches = zip(*alone, strict=True)
        mechanism = dataclasses.replace(model.mechanism, effects=effects, trusted=())
        try:
            _program(dataclasses.replace(model, mechanism=mechanism, gates=switches), Ts)
        except CannotUnfold:
            return f"{effect.title} at {effect.at} ({type(effect).__name__})"
    return "The model"
