"""Conversion of a traced function to scalar expressions, so that an effect is written once, in Python.

The jaxpr of a function is evaluated with expressions as inputs. Equations of constants alone are computed.
Equations that only rearrange entries are evaluated on the indices of the entries.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Int, Shaped

from rotflex_jax.errors import InputError
from rotflex_jax.export.expression import OPERATIONS, Expression, Operand, integer_power, make

# Primitives that rearrange the entries of their operands, by indices that are constants.
MOVES = {
    "broadcast_in_dim",
    "concatenate",
    "copy",
    "dynamic_slice",
    "dynamic_update_slice",
    "expand_dims",
    "gather",
    "pad",
    "reshape",
    "rev",
    "scatter",
    "slice",
    "split",
    "squeeze",
    "stack",
    "tile",
    "transpose",
    "unstack",
}
# Number of operands that contain entries; the other operands are indices.
_MOVED = {"dynamic_slice": 1, "dynamic_update_slice": 2, "gather": 1}


class CannotUnfold(InputError):
    """An equation of a jaxpr that has no counterpart in scalar code."""


def unknown(value: Any) -> bool:
    """Whether a value contains expressions."""
    return getattr(value, "dtype", np.dtype(object)).kind == "O"


def each(operation: Callable[..., Operand], *arrays: Any) -> Shaped[np.ndarray, "..."]:
    """A scalar operation for each entry."""
    spread = np.broadcast_arrays(*[np.asarray(a) for a in arrays])
    out = np.empty(spread[0].shape, object)
    for index in np.ndindex(out.shape):
        out[index] = operation(*(_plain(a[index]) for a in spread))
    return known_if_all_are(out)


def _plain(entry: Any) -> Operand:
    if isinstance(entry, Expression):
        return entry
    return bool(entry) if isinstance(entry, (bool, np.bool_)) else float(entry)


def known_if_all_are(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """The array as numbers where it contains no expression."""
    if any(isinstance(e, Expression) for e in array.flat):
        return array
    truth = array.size and all(isinstance(e, bool) for e in array.flat)
    return array.astype(bool if truth else float)


def moved(
    eqn: Any, pieces: list[Shaped[np.ndarray, "..."]], where: list[Any]
) -> list[Int[np.ndarray, "..."]]:
    """Indices of the entries of the results in the concatenated operands of a rearrangement."""
    starts = np.cumsum([0, *(p.size for p in pieces)])
    indices = [
        np.arange(a, a + p.size, dtype=np.int64).reshape(p.shape)
        for a, p in zip(starts, pieces, strict=False)
    ]
    operands = [*indices, *where]
    if eqn.primitive.name == "scatter":
        operands = [indices[0], where[0], indices[1]]
    params = dict(eqn.params)
    if params.get("fill_value", 0) is not None and eqn.primitive.name == "gather":
        params["fill_value"] = None
    with jax.enable_x64(True):
        out = eqn.primitive.bind(*operands, **params)
    return [np.asarray(o) for o in (out if eqn.primitive.multiple_results else [out])]


def move(eqn: Any, given: list[Any]) -> list[Any]:
    """The results of an equation that rearranges entries."""
    name = eqn.primitive.name
    if name == "scatter":
        pieces, where = [given[0], given[2]], [given[1]]
    else:
        count = _MOVED.get(name, len(given))
        pieces, where = given[:count], given[count:]
    if any(unknown(w) for w in where):
        raise CannotUnfold("a table index that depends on the state, which this C code does not support")
    pieces = [np.asarray(p) for p in pieces]
    flat = np.concatenate([p.astype(object).ravel() for p in pieces])
    results = []
    for index in moved(eqn, pieces, where):
        if np.any((index < 0) | (index >= len(flat))):
            raise CannotUnfold("an index outside of its table")
        out = np.empty(index.shape, object)
        out[...] = flat[index]
        results.append(known_if_all_are(out))
    return results


def _fold(operation: str) -> Callable[..., list[Any]]:
    def reduce(given: list[Any], params: Any) -> list[Any]:
        array = np.asarray(given[0])
        axes = tuple(params["axes"])
        kept = [a for a in range(array.ndim) if a not in axes]
        lines = array.transpose([*kept, *axes]).reshape(*(array.shape[a] for a in kept), -1)
        total = lines[..., 0]
        for k in range(1, lines.shape[-1]):
            total = each(lambda a, b: make(operation, a, b), total, lines[..., k])
        return [np.asarray(total)]

    return reduce


def _product_of(given: list[Any], params: Any) -> list[Any]:
    """`dot_general`."""
    (a_sum, b_sum), (a_batch, b_batch) = params["dimension_numbers"]
    a, b = (np.asarray(g).astype(object) for g in given)
    rest_a = [i for i in range(a.ndim) if i not in (*a_sum, *a_batch)]
    rest_b = [i for i in range(b.ndim) if i not in (*b_sum, *b_batch)]
    batch, inner = [a.shape[i] for i in a_batch], int(np.prod([a.shape[i] for i in a_sum]))
    left = a.transpose([*a_batch, *rest_a, *a_sum]).reshape(int(np.prod(batch)), -1, inner)
    right = b.transpose([*b_batch, *b_sum, *rest_b]).reshape(int(np.prod(batch)), inner, -1)
    out = np.array([[[_dot(r, c) for c in m.T] for r in n] for n, m in zip(left, right, strict=True)], object)
    shape = [*batch, *(a.shape[i] for i in rest_a), *(b.shape[i] for i in rest_b)]
    return [known_if_all_are(out.reshape(shape))]


def _dot(a: np.ndarray, b: np.ndarray) -> Operand:
    total: Operand = 0.0
    for x, y in zip(a, b, strict=True):
        total = make("add", total, make("mul", _plain(x), _plain(y)))
    return total


def _added(given: list[Any], params: Any) -> list[Any]:
    """`scatter-add` at known places."""
    operand, where, updates = (np.asarray(g) for g in given)
    if unknown(where):
        raise CannotUnfold("a table index that depends on the state, which this C code does not support")
    empty = np.full(operand.shape, -1, np.int64)
    with jax.enable_x64(True):
        number = np.arange(updates.size).reshape(updates.shape)
        numbers = params["dimension_numbers"], params["mode"]
        source = np.asarray(jax.lax.scatter(empty, where, number, numbers[0], mode=numbers[1]))
    flat = np.append(updates.astype(object).ravel(), 0.0)
    return [each(lambda a, b: make("add", a, b), operand, flat[source])]


def _selected(given: list[Any], params: Any) -> list[Any]:
    """`select_n`: the first case where false, the second where true."""
    which, *cases = given
    if len(cases) != 2:
        raise CannotUnfold("a choice among more than two cases")
    return [each(lambda c, a, b: make("choose", c, b, a), which, *cases)]


def _converted(given: list[Any], params: Any) -> list[Any]:
    kind = np.dtype(params["new_dtype"]).kind

    def one(a: Operand) -> Operand:
        is_truth = a.truth if isinstance(a, Expression) else isinstance(a, bool)
        if kind == "b":
            return a if is_truth else make("ne", a, 0.0)
        number = make("real", a)
        return number if kind == "f" or is_truth else make("trunc", number)

    return [each(one, given[0])]


RULES: dict[str, Callable[[list[Any], Any], list[Any]]] = {
    "reduce_sum": _fold("add"),
    "reduce_max": _fold("max"),
    "reduce_min": _fold("min"),
    "reduce_prod": _fold("mul"),
    "reduce_and": _fold("and"),
    "reduce_or": _fold("or"),
    "dot_general": _product_of,
    "scatter-add": _added,
    "scatter_add": _added,
    "select_n": _selected,
    "convert_element_type": _converted,
    "integer_pow": lambda given, params: [each(lambda x: integer_power(x, params["y"]), given[0])],
    "square": lambda given, params: [each(lambda x: make("mul", x, x), given[0])],
    "clamp": lambda given, params: [
        each(lambda low, x, high: make("min", make("max", x, low), high), *given)
    ],
    "round": lambda given, params: [
        each(lambda x: make("rint" if int(params["rounding_method"]) == 1 else "round", x), given[0])
    ],
    "iota": lambda given, params: [],
}


_SAME = {"copy_p", "stop_gradient", "optimization_barrier", "device_put", "computed_once"}
CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat"}
_LONGEST_UNROLLED_LOOP = 256


def unfold(function: Callable[..., Any], *inputs: Shaped[np.ndarray, "..."]) -> Any:
    """The value of a function for inputs that contain expressions.

    Args:
        function: Pure JAX; its result is one array.
        inputs: Arrays of numbers or (dtype object) of expressions.

    Returns:
        Array of numbers or expressions.

    Raises:
        CannotUnfold: The number of iterations depends on the input, or an operation is not supported.
    """
    like = [jax.ShapeDtypeStruct(np.shape(i), np.float64) for i in inputs]
    closed = jax.make_jaxpr(function)(*like)
    return run(closed.jaxpr, closed.consts, inputs)[0]


def run(jaxpr: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any], rules: Any = None) -> list[Any]:
    """The results of a jaxpr for its constants and inputs.

    Args:
        jaxpr: The jaxpr.
        consts: Constants of the jaxpr.
        inputs: Inputs of the jaxpr.
        rules: Function that is tried first on every equation, `rules(eqn, values)`; it returns results, or
            None if it does not apply.
    """
    values: dict[Any, Any] = {}
    read = lambda a: np.asarray(a.val) if isinstance(a, Literal) else values[a]  # noqa: E731
    for variable, value in zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True):
        values[variable] = value if unknown(value) else np.asarray(value)
    for eqn in jaxpr.eqns:
        given = [read(a) for a in eqn.invars]
        found = rules(eqn, given) if rules is not None else None
        if found is None:
            found = _results(eqn, given, rules)
        values.update(zip(eqn.outvars, found, strict=True))
    return [read(a) for a in jaxpr.outvars]


def _results(eqn: Any, given: list[Any], rules: Any) -> list[Any]:
    name, params = eqn.primitive.name, eqn.params
    if name in CALLS:
        inner = params.get("jaxpr", params.get("call_jaxpr", params.get("fun_jaxpr")))
        plain = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return run(plain.jaxpr, plain.consts, given, rules)
    if not any(unknown(g) for g in given):
        with jax.enable_x64(True):
            out = eqn.primitive.bind(*given, **params)
        return [np.asarray(o) for o in (out if eqn.primitive.multiple_results else [out])]
    if name in _SAME:
        return list(given)
    if name in MOVES:
        return move(eqn, given)
    if name in _LOOPS:
        return _LOOPS[name](given, params)
    if name in RULES:
        return RULES[name](given, params)
    if name in OPERATIONS:
        return [each(lambda *a: make(name, *a), *given)]
    raise CannotUnfold(f"the operation {name!r}, which has no counterpart in C")


def _looped(given: list[Any], params: Any) -> list[Any]:
    """`scan`, unrolled."""
    length, closed = params["length"], params["jaxpr"]
    if length > _LONGEST_UNROLLED_LOOP:
        raise CannotUnfold(f"a loop of {length} iterations, which is too long to unroll")
    a, b = params["num_consts"], params["num_consts"] + params["num_carry"]
    consts, carry, xs = given[:a], list(given[a:b]), given[b:]
    rows: list[list[Any]] = []
    for k in range(length):
        i = length - 1 - k if params["reverse"] else k
        found = run(closed.jaxpr, closed.consts, [*consts, *carry, *(np.asarray(x)[i] for x in xs)])
        carry, row = found[: b - a], found[b - a :]
        rows.append(row)
    rows = rows[::-1] if params["reverse"] else rows
    return [*carry, *(np.stack([np.asarray(r[i], object) for r in rows]) for i in range(len(rows[0])))]


def _branched(given: list[Any], params: Any) -> list[Any]:
    """`cond` with two branches: both are computed, one is selected."""
    which, *operands = given
    if len(params["branches"]) != 2:
        raise CannotUnfold("a choice among more than two branches")
    no, yes = (run(b.jaxpr, b.consts, operands) for b in params["branches"])
    true = each(lambda c: c if getattr(c, "truth", False) else make("ne", c, 0.0), which)
    return [each(lambda c, a, b: make("choose", c, a, b), true, y, n) for y, n in zip(yes, no, strict=True)]


_LOOPS: dict[str, Callable[[list[Any], Any], list[Any]]] = {"scan": _looped, "cond": _branched}
