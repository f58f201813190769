"""Damped least squares (Levenberg-Marquardt): the step, its damping and the stopping rules of every fit.

    f(x) = e'e / 2,   g = J'e,   H = J'J
    (H + damping diag H) s = -g,   |s_i| <= limit_i

A step that lowers the cost is accepted, and the damping is divided by a factor. Any other step is refused,
and the damping is multiplied. The formulas hold for numpy arrays and, inside compiled code, for JAX arrays.
They act along leading axes: on one problem, or on a batch of problems, each with its own damping.

Three functions share these formulas:

- `minimise`: one problem, evaluated by a Python function;
- `minimise_together`: several problems, with one evaluation for all that still run;
- `minimise_compiled`: the loop inside a compiled program, also under `jax.vmap` and `jax.lax.map`.

Equations of another form (a block structure, a triangular factor) can replace `NormalEquations` if they have
`cost`, `step` and `predicted_decrease`.

Source: K. Levenberg 1944, Quart. Appl. Math. 2; D. Marquardt 1963, SIAM J. Appl. Math. 11; J. Nocedal and
S. Wright, Numerical Optimization, 2nd ed., 2006, sections 4.1 and 10.3.
"""

import dataclasses
import enum
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Real, Shaped

SHORT = 1e-3
"""Damping above which a step is so short that it does not show how much the cost can still decrease."""
RIDGE = 1e-14
"""Damping that is always added, against rounding errors, as a share of the diagonal."""
LARGEST_STEP = 1.0
"""Largest move of the unconstrained coordinate of a bounded parameter in one step: a factor of e for a
logarithm."""
LEAST_CURVATURE = 1e-12
"""Least entry of the diagonal by which the damping is scaled, as a share of the largest entry."""

Scalar = float | Shaped[Any, "..."]
"""One number, or one number for each problem of a batch."""


class Status(enum.IntEnum):
    """Status of a minimisation."""

    RUNNING = 0
    CONVERGED = 1
    DIVERGED = 2
    """The cost at the start is not finite."""
    UNSOLVED = 3
    """The step is not finite."""


class Rules(NamedTuple):
    """When a minimisation stops, and how the damping changes.

    A minimisation has converged in one of three cases. The predicted or the actual decrease of a step is no
    more than `enough + enough_share |f|`, and neither the damping nor a limit makes the step short. Or
    `window` evaluations lower the cost by less than `least_progress`. Or the damping exceeds `largest`, so
    that no step lowers the cost.

    Attributes:
        enough: Decrease of the cost that is not worth a step.
        enough_share: The same decrease as a share of the cost.
        window: Number of evaluations over which progress is measured.
        least_progress: Least decrease over these evaluations; 0 for no such rule.
        damping: Damping at the start.
        decrease: Factor by which an accepted step divides the damping.
        increase: Factor by which a refused step multiplies the damping.
        least: Least damping.
        largest: Damping above which the minimisation ends.
    """

    enough: Scalar = 0.0
    enough_share: Scalar = 0.0
    window: int = 8
    least_progress: Scalar = 0.0
    damping: Scalar = 1e-3
    decrease: float = 10.0
    increase: float = 8.0
    least: float = 1e-12
    largest: float = 1e10


def step_limits(bounded: Bool[Any, " n"], z: Float[Any, "*batch n"]) -> Float[Any, "*batch n"]:
    """Largest step of unconstrained parameters from a start: `LARGEST_STEP` for parameters with a bound.

    The unit of other coordinates is a typical size of the parameter. From a value many times as large, steps
    of one unit would not reach the minimum before a fit stops, so their limit is their size at the start, and
    at least `LARGEST_STEP`.

    Args:
        bounded: Whether each parameter has a bound, see `rotflex_jax.parameters.Transform`.
        z: The start.
    """
    xp = _numpy(z)
    return LARGEST_STEP * xp.where(xp.asarray(bounded), xp.ones_like(z), xp.maximum(xp.abs(z), 1.0))


def damped(H: Real[Any, "*batch n n"], damping: Scalar) -> Real[Any, "*damped n n"]:
    """The matrix of the damped step, `H + damping diag H`.

    Args:
        H: Product of the Jacobian with itself.
        damping: One number for each matrix, or several numbers for one matrix.
    """
    xp = _numpy(H)
    D = xp.diagonal(H, axis1=-2, axis2=-1)
    largest = xp.max(D, axis=-1, keepdims=True)
    size = xp.maximum(D, xp.where(largest > 0, LEAST_CURVATURE * largest, 1.0))
    share = xp.asarray(damping) + RIDGE
    added = (share[..., None] if share.ndim else share) * size
    return H + added[..., None] * _identity(added)


def bounded_solution(
    A: Real[Any, "*batch n n"], b: Real[Any, "*batch n"], limit: Real[Any, "*#batch n"] | None = None
) -> tuple[Real[Any, "*batch n"], Shaped[Any, "*batch"]]:
    """The `x` with `A x = b`, and whether a limit is active.

    Entries beyond their limit are fixed at the limit, and the other entries are solved for again.

    Args:
        A: Positive definite matrix.
        b: Right-hand side.
        limit: Largest absolute value of each entry, infinite for no limit; None for no limits at all.
    """
    xp = _numpy(A)
    size = xp.sqrt(xp.diagonal(A, axis1=-2, axis2=-1))
    A, b = A / (size[..., :, None] * size[..., None, :]), b / size
    if limit is None:
        return xp.linalg.solve(A, b[..., None])[..., 0] / size, xp.zeros(b.shape[:-1], bool)
    most = limit * size
    unit = _identity(b)

    def solve_again(state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        x, held, _ = state
        fixed = xp.where(held, x, 0.0)
        right = xp.where(held, x, b - xp.einsum("...ij,...j->...i", A, fixed))
        within = xp.where(held[..., :, None] | held[..., None, :], unit, A)
        x = xp.linalg.solve(within, right[..., None])[..., 0]
        over = ~held & (xp.abs(x) > most)
        return xp.clip(x, -most, most), held | over, xp.any(over)

    state = xp.zeros_like(b), xp.zeros(b.shape, bool), xp.asarray(True)
    if xp is jnp:
        state = jax.lax.while_loop(lambda s: s[2], solve_again, state)
    else:
        while state[2]:
            state = solve_again(state)
    return state[0] / size, xp.any(state[1], axis=-1)


def solution_within(
    A: Real[np.ndarray, "n n"],
    b: Real[np.ndarray, " n"],
    low: Real[np.ndarray, " n"],
    high: Real[np.ndarray, " n"],
) -> tuple[Real[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The `x` with the least `x'A x / 2 - b'x` and `low <= x <= high`, and which entries are at a bound.

    Entries beyond a bound are fixed at the bound, and the other entries are solved for again. An entry whose
    gradient then points inwards is released, once.

    Args:
        A: Positive definite matrix.
        b: Right-hand side.
        low: Least value of each entry, zero or less.
        high: Largest value of each entry, zero or more.
    """
    held, x = np.zeros(len(b), bool), np.zeros(len(b))
    released = held.copy()
    for _ in range(2 * len(b) + 1):
        free = ~held
        x[free] = np.linalg.solve(A[np.ix_(free, free)], b[free] - A[np.ix_(free, held)] @ x[held])
        over = free & ((x < low) | (x > high))
        x = np.clip(x, low, high)
        back = held & ~released & np.where(x <= low, b - A @ x > 0, b - A @ x < 0)
        if not (over | back).any():
            break
        # Entries are released only when no other goes out, because the test needs all others solved.
        held, released = (held | over, released) if over.any() else (held & ~back, released | back)
    return x, held


@runtime_checkable
class Equations(Protocol):
    """A cost and its quadratic model at one point; in compiled code it must be a tuple of arrays."""

    @property
    def cost(self) -> Any:
        """Cost at the point."""
        ...

    def step(self, damping: Any, limit: Any) -> Any:
        """Damped step within the limits, and whether a limit is active."""
        ...

    def predicted_decrease(self, step: Any) -> Any:
        """Decrease of the quadratic model along a step."""
        ...


class NormalEquations(NamedTuple):
    """Half the squared residuals of G groups (such as channels), gradient `J'e`, and `H = J'J`.

    The cost may be another function with this gradient, such as the logarithm of a likelihood.
    """

    costs: Real[Any, "*batch G"]
    gradient: Real[Any, "*batch n"]
    H: Real[Any, "*batch n n"]

    @classmethod
    def of(cls, J: Real[Any, "*batch m n"], e: Real[Any, "*batch m"]) -> "NormalEquations":
        """The equations of residuals `e` and their Jacobian `J`."""
        xp = _numpy(J)
        return cls(
            xp.sum(e * e, axis=-1)[..., None] / 2,
            (xp.swapaxes(J, -1, -2) @ e[..., None])[..., 0],
            xp.swapaxes(J, -1, -2) @ J,
        )

    @property
    def cost(self) -> Real[Any, "*batch"]:
        """Half the sum of squared residuals."""
        return self.costs.sum(axis=-1)

    def step(
        self, damping: Scalar, limit: Real[Any, "*#batch n"] | None = None
    ) -> tuple[Real[Any, "*damped n"], Shaped[Any, "*damped"]]:
        """Damped Gauss-Newton step, and whether a limit is active; NaN if the equations are not finite."""
        A = damped(self.H, damping)
        xp = _numpy(A)
        right = xp.broadcast_to(-self.gradient, A.shape[:-1])
        if xp is np and not (np.isfinite(A).all() and np.isfinite(right).all()):
            return np.full(A.shape[:-1], np.nan), np.zeros(A.shape[:-2], bool)
        return bounded_solution(A, right, limit)

    def predicted_decrease(self, step: Real[Any, "*batch n"]) -> Real[Any, "*batch"]:
        """Decrease of the quadratic model along a step, `-(g's + s'H s / 2)`."""
        xp = _numpy(step)
        bent = xp.einsum("...i,...ij,...j->...", step, self.H, step)
        return -(xp.sum(self.gradient * step, axis=-1) + bent / 2)


class Progress(NamedTuple):
    """Progress of a minimisation; each entry is one number, or one number for each problem of a batch.

    Attributes:
        cost: Least cost so far.
        damping: Damping of the next step.
        evaluations: Number of steps that were tried.
        reference: Cost when progress was last measured.
        status: A `Status`.
    """

    cost: Any
    damping: Any
    evaluations: Any
    reference: Any
    status: Any


def begin(cost: Scalar, rules: Rules) -> Progress:
    """Progress at the start point, which has this cost."""
    xp = _numpy(cost)
    status = xp.where(xp.isfinite(cost), int(Status.RUNNING), int(Status.DIVERGED))
    none = xp.zeros_like(cost)
    return Progress(xp.asarray(cost), none + rules.damping, xp.zeros_like(status), none + np.inf, status)


def before_trial(progress: Progress, finite: Any, limited: Any, predicted: Scalar, rules: Rules) -> Progress:
    """Ends a minimisation whose next step is not worth a run.

    Args:
        progress: Progress so far.
        finite: Whether the step is finite.
        limited: Whether a limit makes the step short, so that it does not show how much can still be gained.
        predicted: Predicted decrease of the cost by the step.
        rules: When to stop.
    """
    xp = _numpy(progress.cost)
    worthless = (
        ~xp.asarray(limited) & (progress.damping <= SHORT) & (predicted <= _enough(progress.cost, rules))
    )
    status = xp.where(worthless, int(Status.CONVERGED), progress.status)
    status = xp.where(xp.asarray(finite), status, int(Status.UNSOLVED))
    return progress._replace(status=xp.where(progress.status == Status.RUNNING, status, progress.status))


def after_trial(progress: Progress, cost: Scalar, rules: Rules) -> tuple[Progress, Any]:
    """The progress after a step was tried, and whether the step is accepted.

    Args:
        progress: Progress before the step.
        cost: Cost after the step; may be infinite or NaN.
        rules: When to stop, and how the damping changes.
    """
    xp = _numpy(progress.cost)
    gain = progress.cost - cost
    accepted = gain > 0  # False for NaN
    lowered = xp.maximum(progress.damping / rules.decrease, rules.least)
    damping = xp.where(accepted, lowered, progress.damping * rules.increase)
    cost = xp.where(accepted, cost, progress.cost)
    evaluations = progress.evaluations + 1
    due = evaluations % rules.window == 0
    slow = due & (progress.reference - cost < rules.least_progress)
    little = accepted & (gain <= _enough(cost, rules)) & (damping <= SHORT)
    status = xp.where(slow | little | (damping > rules.largest), int(Status.CONVERGED), progress.status)
    return Progress(cost, damping, evaluations, xp.where(due, cost, progress.reference), status), accepted


def _enough(cost: Any, rules: Rules) -> Any:
    return rules.enough + rules.enough_share * abs(cost)


@dataclasses.dataclass(frozen=True)
class Minimum:
    """Where a minimisation ended.

    Attributes:
        x: The point.
        first: Equations at the start.
        equations: Equations at the point, or at the last point with equations if costs are evaluated alone.
        cost: Cost at the point.
        evaluations: Number of steps that were tried.
        status: RUNNING if the evaluations were used up.
    """

    x: Any
    first: Any
    equations: Any
    cost: float
    evaluations: int
    status: Status


def minimise_together(
    linearise: Callable[[list[Any]], Sequence[Equations]],
    starts: Sequence[Any],
    rules: Rules,
    *,
    limit: Callable[[int], Any] | None = None,
    costs: Callable[[list[Any]], Sequence[float]] | None = None,
    costs_after: int = 0,
    move: Callable[[Any, Any], Any] = np.add,
    unit: Callable[[Any], float] | None = None,
    max_steps: int = 60,
    report: Callable[[Sequence[Progress]], None] | None = None,
) -> list[Minimum]:
    """Minimises several independent costs, with one evaluation for all problems that still run.

    Args:
        linearise: Returns the equations at points, in their order.
        starts: First point of each problem, of any type that `move` takes.
        rules: When to stop, and how the damping changes.
        limit: Returns the largest step along each coordinate of problem i; None for no limits.
        costs: Returns the costs at points, if these are cheaper than equations; None to use the cost of the
            equations.
        costs_after: Number of steps refused in a row after which costs are evaluated alone; 0 for all steps.
            After a refused step the next one is often refused too, and its equations would not be used.
        move: Returns the point after a step.
        unit: Returns from equations the unit, 1 or more, of `enough` and `least_progress`. It is called after
            each window of evaluations, and again before a minimisation ends by these.
        max_steps: Largest number of steps that are tried for each problem.
        report: Called after each round.
    """
    points, first = list(starts), list(linearise(list(starts)))
    equations = list(first)
    progress = [begin(np.float64(e.cost), rules) for e in equations]
    units, refused = [1.0] * len(points), [0] * len(points)

    def runs(i: int) -> bool:
        return bool(progress[i].status == Status.RUNNING) and bool(progress[i].evaluations < max_steps)

    def counted(i: int) -> Rules:
        least, enough = rules.least_progress * units[i], rules.enough * units[i]
        return rules._replace(enough=enough, least_progress=least)

    def ends_too_early(i: int) -> bool:
        """Whether a minimisation ended although its unit has become much smaller; renews the unit."""
        if units[i] == 1.0 or progress[i].status != Status.CONVERGED or unit is None:
            return False
        before, units[i] = units[i], float(unit(equations[i]))
        return units[i] < 0.5 * before and bool(progress[i].damping <= rules.largest)

    while True:
        trials: dict[int, Any] = {}
        for i in filter(runs, range(len(points))):
            step, limited = equations[i].step(float(progress[i].damping), limit and limit(i))
            finite = bool(np.isfinite(step).all())
            predicted = equations[i].predicted_decrease(step) if finite else np.nan
            progress[i] = before_trial(progress[i], finite, limited, predicted, counted(i))
            if ends_too_early(i):
                again = progress[i]._replace(status=np.asarray(int(Status.RUNNING)))
                progress[i] = before_trial(again, finite, limited, predicted, counted(i))
            if runs(i):
                trials[i] = move(points[i], step)
        if not trials:
            break
        alone = [i for i in trials if costs and refused[i] >= costs_after]
        whole = [i for i in trials if i not in alone]
        made = dict(zip(whole, linearise([trials[i] for i in whole]) if whole else [], strict=True))
        found = {i: e.cost for i, e in made.items()}
        if costs and alone:
            found |= dict(zip(alone, costs([trials[i] for i in alone]), strict=True))
        accepted = []
        for i, trial in trials.items():
            progress[i], better = after_trial(progress[i], np.float64(found[i]), counted(i))
            refused[i] = 0 if better else refused[i] + 1
            if better:
                points[i] = trial
                accepted.append(i)
                if i in made:
                    equations[i] = made[i]
            if ends_too_early(i):
                progress[i] = progress[i]._replace(status=np.asarray(int(Status.RUNNING)))
            elif unit is not None and runs(i) and progress[i].evaluations % rules.window == 0:
                units[i] = float(unit(equations[i]))
        # If only the cost was evaluated, equations are computed where another step follows.
        follow = [i for i in accepted if i in alone and runs(i)]
        if follow:
            for i, e in zip(follow, linearise([points[i] for i in follow]), strict=True):
                equations[i] = e
        if report:
            report(progress)
    return [
        Minimum(x, start, here, float(p.cost), int(p.evaluations), Status(int(p.status)))
        for x, start, here, p in zip(points, first, equations, progress, strict=True)
    ]


def minimise(
    linearise: Callable[[Any], Equations],
    start: Any,
    rules: Rules,
    *,
    limit: Any = None,
    cost: Callable[[Any], float] | None = None,
    costs_after: int = 0,
    move: Callable[[Any, Any], Any] = np.add,
    unit: Callable[[Any], float] | None = None,
    max_steps: int = 60,
    report: Callable[[Progress], None] | None = None,
) -> Minimum:
    """Minimises one cost; arguments as in `minimise_together`, but for one problem.

    >>> A, b = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]), np.array([1.0, 3.0, 5.0])
    >>> found = minimise(lambda x: NormalEquations.of(A, A @ x - b), np.zeros(2), Rules(enough=1e-20))
    >>> found.x.round(6), found.status.name
    (array([1., 2.]), 'CONVERGED')
    """
    return minimise_together(
        lambda points: [linearise(x) for x in points],
        [start],
        rules,
        limit=None if limit is None else lambda _: limit,
        costs=None if cost is None else lambda points: [cost(x) for x in points],
        costs_after=costs_after,
        move=move,
        unit=unit,
        max_steps=max_steps,
        report=None if report is None else lambda progress: report(progress[0]),
    )[0]


def minimise_compiled(
    linearise: Callable[[Any], Any], start: Any, rules: Rules, *, limit: Any = None, max_steps: Any = 60
) -> tuple[Any, Any, Progress]:
    """Minimises one cost by a loop in compiled code, inside of `jax.jit`, `jax.vmap` or `jax.lax.map`.

    Args:
        linearise: Returns the equations at a point, a pytree of arrays.
        start: First point, an array or a pytree of arrays; a step has the same structure.
        rules: When to stop, and how the damping changes.
        limit: Limits for the method `step` of the equations.
        max_steps: Largest number of evaluations, including the one at the start.

    Returns:
        The point, the equations there, and the progress.
    """
    none = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(linearise, start))
    unknown = jnp.full_like(none.cost, jnp.inf)
    # The start is the first trial, compared with an infinite cost, so that a run is compiled only once.
    progress = begin(unknown, rules)._replace(
        damping=jnp.zeros_like(unknown) + rules.damping * rules.decrease,
        status=jnp.asarray(int(Status.RUNNING)),
    )

    def evaluate(state: Any) -> Any:
        x, step, equations, progress = state
        trial = jax.tree.map(jnp.add, x, step)
        made = linearise(trial)
        progress, accepted = after_trial(progress, made.cost, rules)
        keep = lambda new, old: jnp.where(accepted, new, old)  # noqa: E731
        x, equations = jax.tree.map(keep, (trial, made), (x, equations))
        lost = ~jnp.isfinite(progress.cost)
        progress = progress._replace(status=jnp.where(lost, int(Status.DIVERGED), progress.status))
        step, limited = equations.step(progress.damping, limit)
        finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(part)) for part in jax.tree.leaves(step)]))
        predicted = equations.predicted_decrease(step)
        return x, step, equations, before_trial(progress, finite, limited, predicted, rules)

    def runs(state: Any) -> Any:
        return (state[3].status == Status.RUNNING) & (state[3].evaluations < max_steps)

    state = (start, jax.tree.map(jnp.zeros_like, start), none, progress)
    x, _, equations, progress = jax.lax.while_loop(runs, evaluate, state)
    return x, equations, progress


def _identity(like: Any) -> Any:
    """The matrix (..., n, n) for vectors (..., n), with axes of length one in front."""
    n = like.shape[-1]
    return _numpy(like).eye(n, dtype=like.dtype).reshape((1,) * (like.ndim - 1) + (n, n))


def _numpy(array: Any) -> Any:
    """The array library of an array: `jax.numpy` for JAX arrays, else numpy."""
    return jnp if isinstance(array, jax.Array) else np
