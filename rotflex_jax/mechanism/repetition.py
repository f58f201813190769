"""Arithmetic on arrays that are repeated along their last axis, done once.

A run that carries its derivatives has the state repeated along the directions, so that one expression serves
state and tangents. A value that is the same along that axis is computed once here, and repeated only where it
meets a value that is not. XLA would do this by itself, but move the repetition by only one operation in each
of its passes.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Array

from rotflex_jax.mechanism.small_matrices import computed_once

# Elementwise operations: the result at an index depends on the operands at that index alone.
# fmt: off
_BY_PLACE = {
    "abs", "add", "add_any", "and", "atan2", "clamp", "computed_once", "convert_element_type", "copy",
    "cos", "cosh", "div", "eq", "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite",
    "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "not", "or", "pow",
    "reduce_precision", "rsqrt", "select_n", "sign", "sin", "sinh", "sqrt", "square", "sub", "tan",
    "tanh", "xor",
}
# fmt: on
# Operations that take long, but that the compiler would compute again for each direction.
_THOUGHT_CHEAP = {"sin", "cos"}
# Reductions that give the same result for one copy as for several.
_SAME_OF_COPIES = {"reduce_and", "reduce_max", "reduce_min", "reduce_or"}


class _Once:
    """An array that is repeated along its last axis, stored once with a last axis of length one."""

    def __init__(self, once: Array) -> None:
        self.once = once


def without_repetition(function: Callable[..., Any], length: int, repeated: Any, other: Any) -> Any:
    """`function(repeated, other)` with the arithmetic on repeated arrays done once.

    Args:
        function: Function of two pytrees of arrays.
        length: Length of the last axis of all arrays that the function receives.
        repeated: Arrays (..., 1) that the function receives repeated along their last axis (..., length).
        other: Arrays (..., length).
    """
    shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct((*a.shape[:-1], length), a.dtype), repeated)
    traced, out = jax.make_jaxpr(function, return_shape=True)(shapes, other)
    given = [*map(_Once, jax.tree.leaves(repeated)), *jax.tree.leaves(other)]
    found = _evaluated(traced.jaxpr, traced.consts, given, length)
    return jax.tree.unflatten(jax.tree.structure(out), [_whole(x, length) for x in found])


def _whole(x: Any, length: int) -> Any:
    return jnp.broadcast_to(x.once, (*x.once.shape[:-1], length)) if isinstance(x, _Once) else x


def _evaluated(jaxpr: Jaxpr, consts: Sequence[Any], given: Sequence[Any], length: int) -> list[Any]:
    known: dict[Any, Any] = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *given), strict=True))
    value = lambda v: v.val if isinstance(v, Literal) else known[v]  # noqa: E731
    for equation in jaxpr.eqns:
        operands = [value(v) for v in equation.invars]
        if equation.primitive.name in ("jit", "pjit"):
            inner: ClosedJaxpr = equation.params["jaxpr"]
            found = _evaluated(inner.jaxpr, inner.consts, operands, length)
        elif equation.primitive.name == "cond":
            found = _branched(equation.params["branches"], operands, length)
        else:
            found = _applied(equation, operands, length)
        known.update(zip(equation.outvars, found, strict=True))
    return [value(v) for v in jaxpr.outvars]


def _branched(branches: Sequence[ClosedJaxpr], operands: Sequence[Any], length: int) -> list[Any]:
    """Results of the branch that the first operand chooses; `_Once` where all branches repeat them."""
    index, *given = operands
    repeated = [isinstance(x, _Once) for x in given]
    arrays = [x.once if once else x for x, once in zip(given, repeated, strict=True)]

    def results(branch: ClosedJaxpr, arrays: Sequence[Any]) -> list[Any]:
        known = [_Once(a) if once else a for a, once in zip(arrays, repeated, strict=True)]
        return _evaluated(branch.jaxpr, branch.consts, known, length)

    repeats: list[list[bool]] = []
    for branch in branches:

        def noted(*arrays: Array, branch: ClosedJaxpr = branch) -> None:
            repeats.append([isinstance(x, _Once) for x in results(branch, arrays)])

        jax.eval_shape(noted, *arrays)
    common = [all(flags) for flags in zip(*repeats, strict=True)]

    def run(branch: ClosedJaxpr) -> Callable[..., list[Any]]:
        return lambda *arrays: [
            x.once if once else _whole(x, length)
            for x, once in zip(results(branch, arrays), common, strict=True)
        ]

    found = jax.lax.switch(_whole(index, length), [run(b) for b in branches], *arrays)
    return [_Once(x) if once else x for x, once in zip(found, common, strict=True)]


def _applied(equation: Any, operands: list[Any], length: int) -> list[Any]:
    """Results of one operation; `_Once` where they are known to be repeated."""
    primitive, params = equation.primitive, equation.params
    if primitive.name in _SAME_OF_COPIES and isinstance(operands[0], _Once):
        array = operands[0].once
        if array.ndim - 1 in params["axes"]:
            return [primitive.bind(array, **params)]
    changed = _changed(primitive.name, params, operands, length)
    if changed is None:
        bound = primitive.get_bind_params(params)
        # Older versions of JAX return functions as well.
        functions, bound = bound if isinstance(bound, tuple) else ((), bound)
        result = primitive.bind(*functions, *(_whole(x, length) for x in operands), **bound)
        return list(result) if primitive.multiple_results else [result]
    once = primitive.bind(*(x.once if isinstance(x, _Once) else x for x in operands), **(params | changed))
    if primitive.name in _THOUGHT_CHEAP:
        once = computed_once(once)
    return [_Once(x) for x in (once if primitive.multiple_results else [once])]


def _changed(name: str, params: dict[str, Any], operands: list[Any], length: int) -> dict[str, Any] | None:
    """Changes of the parameters of an operation when the last axis has length one.

    None if the result is not known to be repeated.
    """
    if name == "broadcast_in_dim":
        shape, axes, x = params["shape"], params["broadcast_dimensions"], operands[0]
        last = len(shape) - 1
        if not shape or shape[-1] != length or (isinstance(x, _Once) and last not in axes):
            return None
        stretched = last not in axes or isinstance(x, _Once) or x.shape[-1] == 1
        return {"shape": (*shape[:-1], 1)} if stretched else None
    arrays = [x for x in operands if jnp.ndim(x.once if isinstance(x, _Once) else x)]
    if not arrays or not all(isinstance(x, _Once) for x in arrays):
        return None
    last = arrays[0].once.ndim - 1
    if name in _BY_PLACE:
        return {}
    if name == "slice":
        kept = params["start_indices"][-1] == 0 and params["limit_indices"][-1] == length
        strides = params["strides"]
        if not kept or (strides is not None and strides[-1] != 1):
            return None
        return {"limit_indices": (*params["limit_indices"][:-1], 1)}
    if name == "squeeze":
        return {} if last not in params["dimensions"] else None
    if name == "reshape":
        sizes = params["new_sizes"]
        return {"new_sizes": (*sizes[:-1], 1)} if sizes and sizes[-1] == length else None
    if name in ("concatenate", "split", "stack", "unstack"):
        axis = params["dimension" if name == "concatenate" else "axis"]
        return {} if axis < last + (name == "stack") else None
    if name in ("reduce_sum", "reduce_max", "reduce_min"):
        return {} if last not in params["axes"] else None
    return None
