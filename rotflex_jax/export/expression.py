"""Scalar expressions: a computation in which all constants have been evaluated.

Equal expressions are the same object, so common subexpressions are shared. An operation on numbers gives a
number, and neutral elements are removed. A product with zero is zero, since effects are finite.
"""

import weakref
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy

Operand = Any  # an Expression, a float, or a bool


class Operation(NamedTuple):
    """One operation on scalars.

    Attributes:
        text: C code, with placeholders for the arguments.
        value: The operation on numbers.
        truth: Whether the result is a truth value.
    """

    text: str
    value: Callable[..., Any]
    truth: bool = False


# By the names of JAX's primitives. Functions of scipy, which is imported lazily, stand in lambdas.
OPERATIONS: dict[str, Operation] = {
    "add": Operation("({} + {})", np.add),
    "sub": Operation("({} - {})", np.subtract),
    "mul": Operation("({} * {})", np.multiply),
    "div": Operation("({} / {})", np.divide),
    "neg": Operation("(-{})", np.negative),
    "abs": Operation("fabs({})", np.abs),
    "sign": Operation("(double)(({0} > 0) - ({0} < 0))", np.sign),
    "max": Operation("fmax({}, {})", np.maximum),
    "min": Operation("fmin({}, {})", np.minimum),
    "exp": Operation("exp({})", np.exp),
    "exp2": Operation("exp2({})", np.exp2),
    "expm1": Operation("expm1({})", np.expm1),
    "log": Operation("log({})", np.log),
    "log1p": Operation("log1p({})", np.log1p),
    "sqrt": Operation("sqrt({})", np.sqrt),
    "rsqrt": Operation("(1.0 / sqrt({}))", lambda x: 1 / np.sqrt(x)),
    "cbrt": Operation("cbrt({})", np.cbrt),
    "pow": Operation("pow({}, {})", np.power),
    "rem": Operation("fmod({}, {})", np.fmod),
    "sin": Operation("sin({})", np.sin),
    "cos": Operation("cos({})", np.cos),
    "tan": Operation("tan({})", np.tan),
    "asin": Operation("asin({})", np.arcsin),
    "acos": Operation("acos({})", np.arccos),
    "atan": Operation("atan({})", np.arctan),
    "atan2": Operation("atan2({}, {})", np.arctan2),
    "sinh": Operation("sinh({})", np.sinh),
    "cosh": Operation("cosh({})", np.cosh),
    "tanh": Operation("tanh({})", np.tanh),
    "asinh": Operation("asinh({})", np.arcsinh),
    "acosh": Operation("acosh({})", np.arccosh),
    "atanh": Operation("atanh({})", np.arctanh),
    "erf": Operation("erf({})", lambda x: scipy.special.erf(x)),
    "erfc": Operation("erfc({})", lambda x: scipy.special.erfc(x)),
    "logistic": Operation("(1.0 / (1.0 + exp(-{})))", lambda x: scipy.special.expit(x)),
    "floor": Operation("floor({})", np.floor),
    "ceil": Operation("ceil({})", np.ceil),
    "round": Operation("round({})", lambda x: np.trunc(x + np.copysign(0.5, x))),
    "rint": Operation("rint({})", np.rint),
    "trunc": Operation("trunc({})", np.trunc),
    "lt": Operation("({} < {})", np.less, True),
    "le": Operation("({} <= {})", np.less_equal, True),
    "gt": Operation("({} > {})", np.greater, True),
    "ge": Operation("({} >= {})", np.greater_equal, True),
    "eq": Operation("({} == {})", np.equal, True),
    "ne": Operation("({} != {})", np.not_equal, True),
    "and": Operation("({} && {})", np.logical_and, True),
    "or": Operation("({} || {})", np.logical_or, True),
    "xor": Operation("({} != {})", np.logical_xor, True),
    "not": Operation("(!{})", np.logical_not, True),
    "is_finite": Operation("isfinite({})", np.isfinite, True),
    "choose": Operation("({} ? {} : {})", lambda c, a, b: a if c else b),
    "real": Operation("(double){}", float),
}


class Expression:
    """A variable, or an operation on scalars that contain variables.

    Attributes:
        op: Key of `OPERATIONS`, or name of a kind of variable that the C printer knows.
        args: Arguments.
        truth: Whether the value is a truth value.
    """

    __slots__ = ("__weakref__", "args", "op", "truth")
    # Arithmetic of numpy arrays that contain expressions is that of the expressions.
    __array_ufunc__ = None

    op: str
    args: tuple[Any, ...]
    truth: bool

    def __add__(self, other: Operand) -> Operand:
        return make("add", self, other)

    def __radd__(self, other: Operand) -> Operand:
        return make("add", other, self)

    def __mul__(self, other: Operand) -> Operand:
        return make("mul", self, other)

    def __rmul__(self, other: Operand) -> Operand:
        return make("mul", other, self)


_known: weakref.WeakValueDictionary[Any, Expression] = weakref.WeakValueDictionary()


def node(op: str, *args: Any, truth: bool = False) -> Expression:
    """The unique expression with this operation and these arguments, created if it does not exist."""
    key = (op, truth, *((type(a), a if isinstance(a, (Expression, str)) else repr(a)) for a in args))
    found = _known.get(key)
    if found is None:
        found = object.__new__(Expression)
        found.op, found.args, found.truth = op, args, truth
        _known[key] = found
    return found


def make(op: str, *args: Operand) -> Operand:
    """The result of an operation: a number if all arguments are numbers, an expression otherwise."""
    operation = OPERATIONS[op]
    if not any(isinstance(a, Expression) for a in args):
        with np.errstate(all="ignore"):
            value = operation.value(*args)
        return bool(value) if operation.truth or isinstance(value, (bool, np.bool_)) else float(value)
    if op in _SIMPLER and (simple := _SIMPLER[op](*args)) is not None:
        return simple
    truth = operation.truth
    if op == "choose":
        truth = all(a.truth if isinstance(a, Expression) else isinstance(a, bool) for a in args[1:])
    return node(op, *args, truth=truth)


def _is(a: Operand, number: float) -> bool:
    return not isinstance(a, (Expression, bool)) and a == number


def _sum(a: Operand, b: Operand) -> Operand | None:
    return b if _is(a, 0.0) else a if _is(b, 0.0) else None


def _difference(a: Operand, b: Operand) -> Operand | None:
    return a if _is(b, 0.0) else make("neg", b) if _is(a, 0.0) else None


def _product(a: Operand, b: Operand) -> Operand | None:
    if _is(a, 0.0) or _is(b, 0.0):
        return 0.0
    return b if _is(a, 1.0) else a if _is(b, 1.0) else None


def _quotient(a: Operand, b: Operand) -> Operand | None:
    return a if _is(b, 1.0) else 0.0 if _is(a, 0.0) else None


def _both(a: Operand, b: Operand) -> Operand | None:
    if a is False or b is False:
        return False
    return b if a is True else a if b is True else None


def _either(a: Operand, b: Operand) -> Operand | None:
    if a is True or b is True:
        return True
    return b if a is False else a if b is False else None


def _chosen(c: Operand, a: Operand, b: Operand) -> Operand | None:
    if not isinstance(c, Expression):
        return a if c else b
    # Numbers are compared by their text, since -0.0 and 0.0 are equal but not the same.
    return a if a is b or (type(a) is type(b) is float and repr(a) == repr(b)) else None


_SIMPLER: dict[str, Callable[..., Operand | None]] = {
    "add": _sum,
    "sub": _difference,
    "mul": _product,
    "div": _quotient,
    "and": _both,
    "or": _either,
    "choose": _chosen,
    "real": lambda a: None if a.truth else a,
}


def integer_power(x: Operand, n: int) -> Operand:
    """`x^n` by repeated squaring."""
    if n < 0:
        return make("div", 1.0, integer_power(x, -n))
    result: Operand = 1.0
    while n:
        result = make("mul", result, x) if n & 1 else result
        n >>= 1
        x = make("mul", x, x) if n else x
    return result


def ordered(roots: list[Operand]) -> Iterator[Expression]:
    """All expressions from which the roots are built, arguments before the expressions that use them."""
    seen: set[Expression] = set()
    stack = [(r, False) for r in reversed(roots) if isinstance(r, Expression)]
    while stack:
        e, ready = stack.pop()
        if e in seen:
            continue
        if ready:
            seen.add(e)
            yield e
            continue
        stack.append((e, True))
        stack += [(a, False) for a in reversed(e.args) if isinstance(a, Expression)]
