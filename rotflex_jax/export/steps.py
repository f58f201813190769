"""What single steps of a record do to arrays that hold expressions."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.export.expression import Expression, Scalar, make, whole_power

# Moves entries of its operands, at places that do not depend on unknown numbers.
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
# Operands of a move that are numbers to move; the rest say where to.
_MOVED = {"dynamic_slice": 1, "dynamic_update_slice": 2, "gather": 1}


class CannotUnfold(InputError):
    """A step of the record that no line of straight code can stand for."""


def unknown(value: Any) -> bool:
    """Whether a value is more than numbers."""
    return getattr(value, "dtype", np.dtype(object)).kind == "O"


def each(operation: Callable[..., Scalar], *arrays: Any) -> np.ndarray:
    """An operation on scalars, entry by entry."""
    spread = np.broadcast_arrays(*[np.asarray(a) for a in arrays])
    out = np.empty(spread[0].shape, object)
    for index in np.ndindex(out.shape):
        out[index] = operation(*(_plain(a[index]) for a in spread))
    return known_if_all_are(out)


def _plain(entry: Any) -> Scalar:
    if isinstance(entry, Expression):
        return entry
    return bool(entry) if isinstance(entry, (bool, np.bool_)) else float(entry)


def known_if_all_are(array: np.ndarray) -> np.ndarray:
    """The array as numbers where no expression is in it."""
    if any(isinstance(e, Expression) for e in array.flat):
        return array
    truth = array.size and all(isinstance(e, bool) for e in array.flat)
    return array.astype(bool if truth else float)


def moved(eqn: Any, pieces: list[np.ndarray], where: list[Any]) -> list[np.ndarray]:
    """Where the entries of a move's results come from: indices into its operands laid end to end."""
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
    """The results of a step that moves entries."""
    name = eqn.primitive.name
    if name == "scatter":
        pieces, where = [given[0], given[2]], [given[1]]
    else:
        count = _MOVED.get(name, len(given))
        pieces, where = given[:count], given[count:]
    if any(unknown(w) for w in where):
        raise CannotUnfold("a place in a table that depends on the state, which C code here has not")
    pieces = [np.asarray(p) for p in pieces]
    flat = np.concatenate([p.astype(object).ravel() for p in pieces])
    results = []
    for index in moved(eqn, pieces, where):
        if np.any((index < 0) | (index >= len(flat))):
            raise CannotUnfold("a place outside of its table")
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


def _dot(a: np.ndarray, b: np.ndarray) -> Scalar:
    total: Scalar = 0.0
    for x, y in zip(a, b, strict=True):
        total = make("add", total, make("mul", _plain(x), _plain(y)))
    return total


def _added(given: list[Any], params: Any) -> list[Any]:
    """`scatter-add` at known places."""
    operand, where, updates = (np.asarray(g) for g in given)
    if unknown(where):
        raise CannotUnfold("a place in a table that depends on the state, which C code here has not")
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

    def one(a: Scalar) -> Scalar:
        is_truth = a.truth if isinstance(a, Expression) else isinstance(a, bool)
        if kind == "b":
            return a if is_truth else make("ne", a, 0.0)
        number = make("real", a)
        return number if kind == "f" or is_truth else make("trunc", number)

    return [each(one, given[0])]


STEPS: dict[str, Callable[[list[Any], Any], list[Any]]] = {
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
    "integer_pow": lambda given, params: [each(lambda x: whole_power(x, params["y"]), given[0])],
    "square": lambda given, params: [each(lambda x: make("mul", x, x), given[0])],
    "clamp": lambda given, params: [
        each(lambda low, x, high: make("min", make("max", x, low), high), *given)
    ],
    "round": lambda given, params: [
        each(lambda x: make("rint" if int(params["rounding_method"]) == 1 else "round", x), given[0])
    ],
    "iota": lambda given, params: [],
}
