"""Quasi-Newton minimisation (BFGS) from several starts; points may have no value, if a filter diverges."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from rotflex_jax.optimise.damped_least_squares import LARGEST_STEP

Values = tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S n"]]

SMALLEST_STEP = 1e-5
"""A descent ends when its step is shorter than this."""
GRADIENT_TOLERANCE = 1e-4
"""Gradient below which a point counts as the minimum; for the logarithm of a cost, 0.01 % of the cost."""


@dataclasses.dataclass
class Descent:
    """A descent from one start.

    Attributes:
        points: accepted points (K, n), the start first.
        values: values of the function at these points.
        evaluations: number of points tried, including refused points.
        status: "minimum", "no further progress", "evaluations used up" or "no finite value".
    """

    points: list[Float[np.ndarray, " n"]]
    values: list[float]
    evaluations: int = 0
    status: str = "evaluations used up"


@dataclasses.dataclass
class _Search:
    """BFGS with backtracking from one start: it receives the value at `trial` and sets the next trial."""

    record: Descent
    trial: np.ndarray
    x: np.ndarray | None = None
    f: float = np.inf
    g: np.ndarray | None = None
    H: np.ndarray | None = None
    direction: np.ndarray | None = None
    share: float = 1.0
    done: bool = False

    def receive(self, f: float, g: np.ndarray) -> None:
        """Accept the trial or refuse it, and set the next one."""
        self.record.evaluations += 1
        finite = bool(np.isfinite(f) and np.all(np.isfinite(g)))
        if self.x is None or self.g is None or self.direction is None:
            if finite:
                self._accept(f, g)
                self._set_direction()
            return
        slope = self.share * float(self.g @ self.direction)
        if finite and f <= self.f + 1e-4 * slope:
            self._update_hessian(self.trial - self.x, g - self.g)
            self._accept(f, g)
            self._set_direction()
            return
        # Minimum of the parabola through both values and the slope; half the step if there is no value.
        curvature = 2 * (f - self.f - slope) if finite else np.inf
        self.share *= float(np.clip(-slope / curvature, 0.1, 0.5)) if finite else 0.5
        if self.share * np.max(np.abs(self.direction)) < SMALLEST_STEP:
            if self.H is not None:  # it may belong to another region: try again along the gradient
                self.H = None
                self._set_direction()
                return
            self.done, self.record.status = True, "no further progress"
        self.trial = self.x + self.share * self.direction

    def _accept(self, f: float, g: np.ndarray) -> None:
        self.x, self.f, self.g = self.trial, f, g
        self.record.points.append(self.trial)
        self.record.values.append(f)
        if np.max(np.abs(g)) < GRADIENT_TOLERANCE:
            self.done, self.record.status = True, "minimum"

    def _update_hessian(self, step: np.ndarray, change: np.ndarray) -> None:
        """BFGS update of the inverse Hessian, where the function curves upwards."""
        curved = float(step @ change)
        if curved <= 1e-8 * np.linalg.norm(step) * np.linalg.norm(change):
            return
        eye = np.eye(len(step))
        H = self.H if self.H is not None else eye * curved / float(change @ change)
        left = eye - np.outer(step, change) / curved
        self.H = left @ H @ left.T + np.outer(step, step) / curved

    def _set_direction(self) -> None:
        """Quasi-Newton direction of limited length; the negative gradient if that is no descent direction."""
        assert self.x is not None and self.g is not None
        direction = -self.g if self.H is None else -self.H @ self.g
        if float(direction @ self.g) >= 0:
            self.H, direction = None, -self.g
        self.direction = direction * min(1.0, LARGEST_STEP / max(float(np.max(np.abs(direction))), 1e-300))
        self.share = 1.0
        self.trial = self.x + self.direction


def descend(
    function: Callable[[Float[np.ndarray, "S n"]], Values], starts: Float[np.ndarray, "S n"], evaluations: int
) -> list[Descent]:
    """Minimises from several starts at once, with one batched evaluation per round.

    A value that is not finite only shortens a step and never enters a quasi-Newton matrix. A start
    without a finite value moves halfway towards the best start with a finite value.

    Args:
        function: returns values (S,) and gradients (S, n) at points (S, n).
        starts: first points (S, n).
        evaluations: largest number of points that are tried for each start.
    """
    searches = [_Search(Descent([], []), np.array(x)) for x in starts]
    for _ in range(evaluations):
        if all(p.done for p in searches):
            break
        f, g = function(np.stack([p.trial for p in searches]))
        for search, value, slope in zip(searches, f, g, strict=True):
            if not search.done:
                search.receive(float(value), np.asarray(slope))
        found = [p for p in searches if p.x is not None]
        if not found:  # the same points would be tried again
            break
        for search in searches:
            if search.x is None:
                target = min(found, key=lambda p: p.f).x
                assert target is not None
                search.trial = 0.5 * (search.trial + target)
    for search in searches:
        if search.x is None:
            search.record.status = "no finite value"
    return [p.record for p in searches]
