"""What a fit of weights gives: the model, its weights with intervals, and a table of them."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.fit.covariance import by_recording, curvature, sandwich
from rotflex_jax.fit.linear import Solution
from rotflex_jax.fit.rows import Rows
from rotflex_jax.parameters import Estimate, Specification
from rotflex_jax.series import Series


@dataclasses.dataclass(frozen=True)
class SeriesFit:
    """Fitted weights on a basis; what has the same name in `Fit` means the same.

    Attributes:
        model: The series.
        cost: Negative log-likelihood of the samples, constants included [nat].
        status: "converged", or in words what a reader must know.
        parameters: The weights as estimates, named after their regressors; intervals are robust to
            residuals that are correlated in time, as those of a wrong model are.
        noise: Root mean square of the residual of the channel [its unit].
        covariance: Of the weights (P, P).
        nmse: Squared error over the squared deviation from the mean, on the samples of the fit.
        rank: Directions of the weights that the data determine.
        condition: Largest over smallest eigenvalue of `phi' phi` within these.
        ridge: Penalty on the squared weights.
        err: Chosen regressor -> its error-reduction ratio, in the order of choice; empty where all
            regressors were fitted.
    """

    model: Series
    cost: float
    status: str
    parameters: tuple[Estimate, ...]
    noise: dict[str, float]
    covariance: Float[np.ndarray, "P P"]
    nmse: float
    rank: int
    condition: float
    ridge: float = 0.0
    err: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def weights(self) -> Float[np.ndarray, " P"]:
        """(P,)."""
        return self.model.weights

    @property
    def std(self) -> Float[np.ndarray, " P"]:
        """Standard deviations (P,); nan where the data say nothing."""
        return np.array([e.std for e in self.parameters])

    @property
    def t(self) -> Float[np.ndarray, " P"]:
        """Weights over their standard deviations (P,); beyond about 3 they are not nothing."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.weights / self.std

    @property
    def selected(self) -> tuple[str, ...]:
        """Regressors that were chosen, the best first; all where none was left out."""
        return tuple(self.err) or tuple(e.name for e in self.parameters)

    def __getitem__(self, name: str) -> Estimate:
        """The weight of a regressor."""
        for estimate in self.parameters:
            if estimate.name == name:
                return estimate
        raise InputError(
            f"Regressor {name!r} was asked for, but the fit has "
            f"{', '.join(e.name for e in self.parameters)}; use one of these names."
        )

    def __str__(self) -> str:
        channel, residual = next(iter(self.noise.items()))
        unit = self.model.output_unit
        lines = [
            f"Series of {channel}: {self.status}, residual {residual:.3g} {unit} rms, NMSE {self.nmse:.3g}",
            f"rank {self.rank} of {len(self.parameters)}, condition {self.condition:.3g}"
            + (f", ridge {self.ridge:.3g}" if self.ridge else ""),
        ]
        rows = [("term", "weight", "std", "t", "unit", "ERR %" if self.err else "")]
        estimates = {e.name: (e, t) for e, t in zip(self.parameters, self.t, strict=True)}
        for name in self.selected:
            e, t = estimates[name]
            share = f"{100 * self.err[name]:.3g}" if self.err else ""
            std, ratio = ("-" if math.isnan(x) else f"{x:.3g}" for x in (e.std, t))
            rows.append((name, f"{e.value:.5g}", std, ratio, e.unit, share))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            cells = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]
            lines.append("  " + "  ".join(cells).rstrip())
        return "\n".join(lines)


def series_fit(
    series: Series,
    solution: Solution,
    rows: Rows,
    status: str,
    ridge: float = 0.0,
    err: Mapping[str, float] | None = None,
    columns: np.ndarray | None = None,
) -> SeriesFit:
    """The result from the solution of a linear least-squares problem.

    Args:
        series: Model with the fitted weights.
        solution: In terms of the columns that were fitted.
        rows: Regressors and targets of all columns.
        status: In words.
        ridge: Penalty of the fit.
        err: Error-reduction ratios.
        columns: Those that were fitted (P'); all if None.
    """
    P = series.basis.size
    columns = np.arange(P) if columns is None else columns
    phi = rows.phi if len(columns) == P else rows.phi[:, columns]
    e = rows.y - phi @ solution.w
    # In the directions that the data determine, so that columns that depend on each other do no harm.
    along = phi @ solution.basis
    way = solution.basis * solution.shrink
    parts = by_recording(along[:, None, :], e[:, None], rows.segments)
    own = way @ sandwich(parts, curvature(parts, along.shape[1])) @ way.T
    blind = np.linalg.norm(way * np.linalg.norm(along, axis=0), axis=1) == 0
    own[blind, :] = own[:, blind] = np.nan
    covariance = np.full((P, P), np.nan)
    covariance[np.ix_(columns, columns)] = own
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    units = series.basis.units(series.input_unit, series.output_unit)
    terms = zip(series.basis.names, series.weights.tolist(), std.tolist(), units, strict=True)
    chosen = set(columns.tolist())
    parameters = []
    for k, (name, value, deviation, unit) in enumerate(terms):
        if k in chosen:
            parameters.append(Estimate.of(name, value, deviation, Specification(unit, 1.0)))
        else:
            nan = float("nan")
            parameters.append(Estimate(name, value, nan, (nan, nan), unit, free=False, note="not chosen"))
    residual = float(np.sqrt(np.mean(e**2)))
    spread = float(np.sum((rows.y - rows.y.mean()) ** 2))
    return SeriesFit(
        model=series,
        cost=float(len(e) * (np.log(max(residual, 1e-300)) + 0.5 * np.log(2 * np.pi) + 0.5)),
        status=status,
        parameters=tuple(parameters),
        noise={series.channel: residual},
        covariance=covariance,
        nmse=float(np.sum(e**2)) / spread if spread > 0 else float("nan"),
        rank=solution.rank,
        condition=solution.condition,
        ridge=ridge,
        err=dict(err or {}),
    )
