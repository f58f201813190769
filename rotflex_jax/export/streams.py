"""From a rule on a whole sequence of voltages to what a controller does with one sample after another.

An actuation effect maps the sequence `u` (N,) to the sequence `v` (N,). Its record is run on a sequence
that is not known, only how its entries move: entry k of a delayed one is entry max(k - d, 0) of the
other, a scan is a state, entry 0 is the first command. What remains is a rule from one sample to the next.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from rotflex_jax.export.expression import Expression, Scalar, make, node
from rotflex_jax.export.steps import MOVES, CannotUnfold, each, moved, unknown
from rotflex_jax.export.unfold import CALLS, run

# Samples of the sequence that is not known: more than any delay.
LENGTH = 16384


@dataclasses.dataclass(frozen=True)
class Stream:
    """A sequence, or entries of it: entry k of `base` is its expression at sample k.

    Attributes:
        base: Expression of the present sample.
        index: Which samples, in any shape; -1 for `before`.
        before: A number that stands where no sample has come yet.
    """

    base: Scalar
    index: np.ndarray
    before: float | None = None

    # Unknown, as `unfold` asks.
    dtype = np.dtype(object)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the entries."""
        return self.index.shape


@dataclasses.dataclass
class Memory:
    """A state of the sequence rule: its name, its value before the first sample, and the next one."""

    start: Scalar
    next: Scalar = 0.0


class SequenceRules:
    """Rules for the steps of a record in which streams take part; collects the states they need."""

    def __init__(self) -> None:
        self.memories: list[Memory] = []

    def __call__(self, eqn: Any, given: list[Any]) -> list[Any] | None:
        """Results of a step, or None where no stream takes part."""
        if not any(isinstance(g, Stream) for g in given):
            return None
        name, params = eqn.primitive.name, eqn.params
        if name == "scan":
            return self._scan(given, params)
        if name in MOVES:
            return self._move(eqn, given)
        if name in CALLS:
            return None  # its inside comes here step by step
        present = [self._present(g) for g in given]
        inner = _without_streams(eqn, present)
        shape = next(g.shape for g in given if isinstance(g, Stream))
        if eqn.outvars[0].aval.shape != shape:
            raise CannotUnfold("a sum or product over the whole sequence of voltages")
        if np.prod(shape) == 1:
            return [inner.reshape(shape)]
        return [Stream(_only(inner), np.arange(LENGTH).reshape(shape))]

    def _present(self, value: Any) -> Any:
        """An operand at the present sample: an array of shape ()."""
        if isinstance(value, Stream):
            return np.asarray(self.sample(value), object)
        value = np.asarray(value)
        first = value.flat[0]
        same = all(e is first for e in value.flat) if unknown(value) else np.all(value == first)
        return np.asarray(first if same else _ramp(value), value.dtype if same else object)

    def sample(self, stream: Stream) -> Scalar:
        """The entry for the present sample."""
        k = stream.index.ravel()
        if len(k) == 1:
            if k[0] != 0:
                raise CannotUnfold(f"the command of sample {k[0]}, which has not come yet at the first")
            return node("first", stream.base) if isinstance(stream.base, Expression) else stream.base
        late = LENGTH - 1 - int(k[-1])
        shifted = np.arange(LENGTH) - late
        early = 0 if stream.before is None else -1
        if len(k) != LENGTH or late < 0 or np.any(k != np.where(shifted < 0, early, shifted)):
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
            raise CannotUnfold("a sequence of voltages put together from unlike parts")
        indices = [p.index if isinstance(p, Stream) else np.full(np.shape(p), -1) for p in pieces]
        places = moved(eqn, indices, where)
        flat = np.concatenate([i.ravel() for i in indices])
        if any(np.any((p < 0) | (p >= len(flat))) for p in places):
            raise CannotUnfold("a place outside of the sequence of voltages")
        before = fills.pop() if fills else None
        return [Stream(streams[0].base, flat[p], before) for p in places]

    def _scan(self, given: list[Any], params: Any) -> list[Any]:
        """A scan along the sequence: its carry is a state."""
        a, b = params["num_consts"], params["num_consts"] + params["num_carry"]
        closed = params["jaxpr"]
        if params["reverse"] or params["length"] != LENGTH:
            raise CannotUnfold("a loop that does not run along the sequence of voltages")
        carry, names = [], []
        for start in given[a:b]:
            first = np.asarray(self._present(start) if isinstance(start, Stream) else start)
            places = np.empty(first.shape, object)
            for place in np.ndindex(first.shape):
                value = first[place]
                self.memories.append(Memory(value if isinstance(value, Expression) else float(value)))
                places[place] = node("carry", len(self.memories) - 1)
                names.append(len(self.memories) - 1)
            carry.append(places)
        xs = [self._present(x) for x in given[b:]]
        consts = [self._present(c) if isinstance(c, Stream) else c for c in given[:a]]
        found = run(closed.jaxpr, closed.consts, [*consts, *carry, *xs])
        updates = [e for f in found[: b - a] for e in np.asarray(f, object).flat]
        for name, update in zip(names, updates, strict=True):
            self.memories[name].next = update
        ends = [np.array(None, object)] * (b - a)  # the end of the sequence: nobody may ask for it
        return [*ends, *(Stream(_only(y), np.arange(LENGTH)) for y in found[b - a :])]


def _ramp(value: np.ndarray) -> Scalar:
    """A number that grows from sample to sample by the same amount."""
    numbers = np.zeros(0) if unknown(value) else value.astype(float).ravel()
    if len(numbers) == LENGTH:
        step = (numbers[-1] - numbers[0]) / (LENGTH - 1)
        even = numbers[0] + step * np.arange(LENGTH)
        if np.max(np.abs(numbers - even)) <= 1e-12 * np.max(np.abs(numbers)):
            return make("add", make("mul", float(step), node("count")), float(numbers[0]))
    raise CannotUnfold("a voltage that depends on the time since the recording began")


def _without_streams(eqn: Any, present: list[Any]) -> np.ndarray:
    """A step on single numbers: traced anew with scalars."""

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


def _only(value: Any) -> Scalar:
    """The one entry of an array of size one."""
    entry = np.asarray(value, object).flat[0]
    return entry if isinstance(entry, Expression) else float(entry)


def per_sample(function: Callable[[Any], Any], u: Scalar) -> tuple[Scalar, Sequence[Memory]]:
    """What a rule on sequences (N,) makes of the present sample `u`, and the states it needs for that.

    Raises:
        CannotUnfold: The rule looks ahead, or depends on time.
    """
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((LENGTH,), np.float64))
    rules = SequenceRules()
    out = run(closed.jaxpr, closed.consts, [Stream(u, np.arange(LENGTH))], rules)[0]
    if isinstance(out, Stream):
        return rules.sample(out), rules.memories
    return _only(each(lambda x: x, out).ravel()[-1:]), rules.memories
