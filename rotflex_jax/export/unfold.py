"""From a traced function to scalar expressions, so that a law is written once, in Python.

JAX records what a function does (its jaxpr). Here that record is run again with expressions in the
places of the unknown inputs. What depends on known numbers alone is computed on the way; what moves
numbers about without changing them is learnt by moving their indices.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from rotflex_jax.export.expression import OPERATIONS, make
from rotflex_jax.export.steps import MOVES, STEPS, CannotUnfold, each, move, unknown

_SAME = {"copy_p", "stop_gradient", "optimization_barrier", "device_put"}
CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat"}
_LONGEST_LOOP = 256


def unfold(function: Callable[..., Any], *inputs: np.ndarray) -> Any:
    """What a function makes of inputs that hold expressions.

    Args:
        function: Pure JAX; its result is one array.
        inputs: Arrays of numbers or (dtype object) of expressions.

    Returns:
        Array of numbers or expressions.

    Raises:
        CannotUnfold: The function loops as often as its input says, or uses an operation unknown here.
    """
    like = [jax.ShapeDtypeStruct(np.shape(i), np.float64) for i in inputs]
    closed = jax.make_jaxpr(function)(*like)
    return run(closed.jaxpr, closed.consts, inputs)[0]


def run(jaxpr: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any], rules: Any = None) -> list[Any]:
    """The results of a record for its constants and inputs.

    Args:
        jaxpr: The record.
        consts: Its constants.
        inputs: Its inputs.
        rules: Tried first on every step, `rules(eqn, values)`: results, or None where they do not apply.
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
    if name in STEPS:
        return STEPS[name](given, params)
    if name in OPERATIONS:
        return [each(lambda *a: make(name, *a), *given)]
    raise CannotUnfold(f"the operation {name!r}, which has no counterpart in C")


def _looped(given: list[Any], params: Any) -> list[Any]:
    """`scan`, written out."""
    length, closed = params["length"], params["jaxpr"]
    if length > _LONGEST_LOOP:
        raise CannotUnfold(f"a loop of {length} turns, which is too long to write out")
    a, b = params["num_consts"], params["num_consts"] + params["num_carry"]
    consts, carry, xs = given[:a], list(given[a:b]), given[b:]
    rows: list[list[Any]] = []
    for k in range(length):
        turn = length - 1 - k if params["reverse"] else k
        found = run(closed.jaxpr, closed.consts, [*consts, *carry, *(np.asarray(x)[turn] for x in xs)])
        carry, row = found[: b - a], found[b - a :]
        rows.append(row)
    rows = rows[::-1] if params["reverse"] else rows
    return [*carry, *(np.stack([np.asarray(r[i], object) for r in rows]) for i in range(len(rows[0])))]


def _branched(given: list[Any], params: Any) -> list[Any]:
    """`cond` with two branches: both are computed, one is taken."""
    which, *operands = given
    if len(params["branches"]) != 2:
        raise CannotUnfold("a choice among more than two branches")
    no, yes = (run(b.jaxpr, b.consts, operands) for b in params["branches"])
    true = each(lambda c: c if getattr(c, "truth", False) else make("ne", c, 0.0), which)
    return [each(lambda c, a, b: make("choose", c, a, b), true, y, n) for y, n in zip(yes, no, strict=True)]


_LOOPS: dict[str, Callable[[list[Any], Any], list[Any]]] = {"scan": _looped, "cond": _branched}
