"""What tuning found: the settings, what they are worth, and whether they are safe."""

import dataclasses

import numpy as np
from jaxtyping import Float

from rotflex_jax.adaptive.bounds import Stability
from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.basis import Basis


@dataclasses.dataclass(frozen=True, eq=False)
class Path:
    """One descent.

    Attributes:
        points: settings by name, each (K,), the start first.
        values: objective (K,), penalty included.
        evaluations: filters run, each with its derivatives.
        status: "minimum", "no further progress", "evaluations used up" or "no finite value".
    """

    points: dict[str, Float[np.ndarray, " K"]]
    values: Float[np.ndarray, " K"]
    evaluations: int
    status: str


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """Settings of a filter, chosen by gradient or on a grid.

    Attributes:
        settings: by name.
        value: objective on the recordings that were tuned on.
        test: the same on the others; NaN if there were none.
        objective: "final", "mean_error" or "last_half".
        unit: of `value` and `test`, in words.
        filter: with the settings in it.
        basis: with the settings in it.
        evaluations: settings tried in all.
        stability: of the step sizes, where the theory of LMS applies and the weights are not too many.
        paths: one descent per start; none for a grid.
        axes: settings tried on a grid, by name; empty for a descent.
        values: objective on the grid, one axis per setting; NaN or infinite where the filter diverged.
    """

    settings: dict[str, float]
    value: float
    test: float
    objective: str
    unit: str
    filter: AdaptiveFilter
    basis: Basis
    evaluations: int
    stability: Stability | None
    paths: tuple[Path, ...] = ()
    axes: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    values: np.ndarray | None = None

    def __str__(self) -> str:
        how = f"{len(self.paths)} starts" if self.paths else f"a grid of {self.evaluations}"
        lines = [f'tuned for "{self.objective}" with {self.evaluations} evaluations from {how}']
        lines += [f"  {name} = {value:.4g}" for name, value in self.settings.items()]
        lines += [f"  {self.value:.4g} {self.unit}"]
        if np.isfinite(self.test):
            lines += [f"  {self.test:.4g} on the recordings kept for the test"]
        for path in self.paths:
            begin = ", ".join(
                f"{name} {points[0]:.3g}" for name, points in path.points.items() if len(points)
            )
            last = f"{path.values[-1]:.4g}" if len(path.values) else "-"
            lines += [
                f"  from {begin or 'a start that diverges'}: {last}, {path.evaluations} evaluations, "
                f"{path.status}"
            ]
        lines += [f"  {self.stability.sentence}" if self.stability else "  stability: no theory applied"]
        return "\n".join(lines)
