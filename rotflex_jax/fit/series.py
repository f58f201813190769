"""Weights of a basis by least squares: all at once, or one by one as long as validation blocks gain."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from rotflex_jax.basis import Basis
from rotflex_jax.checks import real, shown, whole
from rotflex_jax.errors import InputError
from rotflex_jax.fit.inference import Combination, by_recording, curvature, estimates, sandwich
from rotflex_jax.fit.linear import (
    RegressionRows,
    Solution,
    checked_recordings,
    cross_validated_ridge,
    factor,
    solve,
    squared_error,
)
from rotflex_jax.models.series import Series
from rotflex_jax.parameters import Estimate, Specification
from rotflex_jax.recording import Recording


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
    rows: RegressionRows,
    status: str,
    ridge: float = 0.0,
    err: Mapping[str, float] | None = None,
    columns: Int[np.ndarray, " K"] | None = None,
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
    units = series.basis.units(series.input_unit, series.output_unit)
    chosen = set(columns.tolist())
    parameters = estimates(
        series.basis.names,
        series.weights,
        [Specification(unit, 1.0) for unit in units],
        [Combination([k], np.ones(1)) if k in chosen else None for k in range(P)],
        covariance,
        ["" if k in chosen else "not chosen" for k in range(P)],
    )
    residual = float(np.sqrt(np.mean(e**2)))
    spread = float(np.sum((rows.y - rows.y.mean()) ** 2))
    return SeriesFit(
        model=series,
        cost=float(len(e) * (np.log(max(residual, 1e-300)) + 0.5 * np.log(2 * np.pi) + 0.5)),
        status=status,
        parameters=parameters,
        noise={series.channel: residual},
        covariance=covariance,
        nmse=float(np.sum(e**2)) / spread if spread > 0 else float("nan"),
        rank=solution.rank,
        condition=solution.condition,
        ridge=ridge,
        err=dict(err or {}),
    )


def least_squares(
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str | None = None,
    ridge: float | Literal["cv"] = 0.0,
    *,
    skip: int | None = None,
    blocks: int = 10,
) -> SeriesFit:
    """Fit the weights of a basis to recordings.

        minimise  sum_t (y[t] - w' phi[t])^2 + ridge |w|^2

    By orthogonal triangularisation of the rows, never by their squares. Where columns depend on each
    other, as in the full layout of a Volterra series, the weights of least norm are given, which are
    symmetric. Not for a recording that does not begin at rest, unless the first samples, as many as
    the basis reaches back, are skipped: the basis knows no earlier input.

    Args:
        basis: Regressors.
        recordings: One or several, of one sampling period.
        channel: Output to model; may be left out where there is one.
        ridge: Penalty on the squared weights, as they are; "cv" takes the one with the least error on
            contiguous blocks left out in turn. An interval does not contain the bias of a ridge.
        skip: Samples at the start of each recording to leave out; its `n_init` if None.
        blocks: How many, for "cv".

    Raises:
        InputError: Nothing to fit, different sampling periods, no such channel, a negative ridge.

    Source: Golub and Van Loan 2013, Matrix Computations, sections 5.3 and 5.5.

    >>> import numpy as np
    >>> from rotflex_jax.basis import Delays, Volterra
    >>> u = np.random.default_rng(0).standard_normal(400)
    >>> y = 0.5 + 2.0 * u + 0.3 * u**2
    >>> recording = Recording(u=u, y=y, Ts=0.01, channels="alpha")
    >>> fit = least_squares(Volterra(Delays(1)), recording)
    >>> fit.weights.round(9)
    array([0.5, 2. , 0.3])
    >>> fit["u[t]^2"].unit
    'rad/V^2'
    """
    listed, channel = checked_recordings(recordings, channel)
    tuned = isinstance(ridge, str) and ridge == "cv"
    if not tuned and not 0 <= real(ridge) < np.inf:
        raise InputError(f"Argument `ridge` must be 0 or more, or 'cv', but is {shown(ridge)}; correct it.")
    rows = RegressionRows.of(basis, listed, channel, skip)
    joined = np.concatenate([rows.phi, rows.y[:, None]], axis=1)
    if tuned:
        block = rows.blocks(whole(blocks, "blocks", 2))
        if block[-1] < 1:
            raise InputError(
                f"A ridge by cross-validation needs at least 2 blocks, but {blocks} were asked for; give for "
                "instance blocks=10, or the ridge as a number."
            )
        parts = [factor(joined[block == k]) for k in range(block[-1] + 1)]
        penalty, ridges = cross_validated_ridge(parts)
        R = factor(np.concatenate(parts))
        end = "at the least that was tried" if penalty == ridges[0] else "by cross-validation"
        status = f"converged, ridge {end}"
    else:
        R, penalty, status = factor(joined), float(ridge), "converged"
    solution = solve(R, penalty)
    if solution.rank < basis.size:
        status += f", minimum norm (rank {solution.rank} of {basis.size})"
    first = listed[0]
    series = Series(basis, solution.w, channel, first.Ts, first.input_unit, first.unit(channel))
    return series_fit(series, solution, rows, status, penalty)


# A regressor of which less than this share is left depends on those chosen before.
DEPENDENT_REGRESSOR_SHARE = 1e-9


def forward_regression(
    basis: Basis,
    recordings: Recording | Sequence[Recording],
    channel: str | None = None,
    *,
    terms: int | None = None,
    most: int = 30,
    skip: int | None = None,
    blocks: int = 10,
) -> SeriesFit:
    """Choose regressors by orthogonal forward regression, and fit their weights.

        ERR_i = (q_i' y)^2 / (q_i' q_i  y' y),  q_i = what is left of regressor i after those chosen

    The regressor with the largest error-reduction ratio comes next. How many is decided on contiguous
    blocks: each is left out in turn, the choice is made again without it, and the smallest number is
    taken whose error there is within one standard error of the least. The ratios add up to the share of
    `y' y` that is explained.

    The intervals take the choice for given, so they are too narrow. Not where regressors are strongly
    correlated and the structure matters: which of two similar ones is chosen is a matter of chance.

    Args:
        basis: Candidates.
        recordings: One or several, of one sampling period.
        channel: Output to model; may be left out where there is one.
        terms: How many to choose; decided on validation blocks if None.
        most: Most that are tried.
        skip: Samples at the start of each recording to leave out; its `n_init` if None.
        blocks: How many, to decide.

    Returns:
        Fit whose model has weight 0 where a regressor was not chosen; `err` holds the ratios.

    Raises:
        InputError: As `least_squares`; too few blocks.

    Source: Billings, Chen and Korenberg 1989, Int. J. Control 49; Chen, Billings and Luo 1989, Int. J.
    Control 50, section 3.2.

    >>> from rotflex_jax.basis import Delays, Volterra
    >>> rng = np.random.default_rng(0)
    >>> u = rng.standard_normal(2000)
    >>> y = 2.0 * u + 0.3 * u**2 + 0.1 * rng.standard_normal(2000)
    >>> recording = Recording(u=u, y=y, Ts=0.01, channels="alpha")
    >>> forward_regression(Volterra(Delays(4)), recording).selected
    ('u[t]', 'u[t]^2')
    """
    listed, channel = checked_recordings(recordings, channel)
    rows = RegressionRows.of(basis, listed, channel, skip)
    joined = np.concatenate([rows.phi, rows.y[:, None]], axis=1)
    block = rows.blocks(whole(blocks, "blocks", 1))
    parts = [factor(joined[block == k]) for k in range(block[-1] + 1)]
    R = factor(np.concatenate(parts))
    if terms is None:
        if len(parts) < 2:
            raise InputError(
                "The number of terms is decided on blocks left out in turn, which needs at least 2, but "
                f"{len(parts)} was given; give for instance blocks=10, or `terms`."
            )
        terms = _how_many(parts, min(whole(most, "most", 1), basis.size))
        status = f"converged, {terms} terms by held-out blocks"
    else:
        terms = min(whole(terms, "terms", 1), basis.size)
        status = "converged"
    order, ratios = forward_path(R, terms)
    if len(order) < terms:
        status = f"converged, only {len(order)} terms are independent"
    solution = solve(R[:, [*order, -1]])
    w = np.zeros(basis.size)
    w[order] = solution.w
    first = listed[0]
    series = Series(basis, w, channel, first.Ts, first.input_unit, first.unit(channel))
    err = {basis.names[k]: ratio for k, ratio in zip(order, ratios, strict=True)}
    return series_fit(series, solution, rows, status, err=err, columns=np.array(order, int))


def forward_path(R: Float[np.ndarray, "K K"], most: int) -> tuple[list[int], list[float]]:
    """Columns in the order of choice and their error-reduction ratios.

    Args:
        R: Triangular factor of `[phi, y]`: angles between columns are those between the regressors.
        most: How many to choose; fewer where nothing independent is left.
    """
    left, z = R[:, :-1].copy(), R[:, -1]
    whole_y = max(float(z @ z), 1e-300)
    first = np.maximum(np.linalg.norm(left, axis=0), 1e-300)
    order, ratios = [], []
    for _ in range(most):
        size = np.linalg.norm(left, axis=0)
        usable = size > DEPENDENT_REGRESSOR_SHARE * first
        usable[order] = False
        if not usable.any():
            break
        gains = np.where(usable, (left.T @ z) ** 2 / np.where(usable, size**2, 1.0), -1.0)
        k = int(np.argmax(gains))
        q = left[:, k] / size[k]
        order.append(k)
        ratios.append(float(gains[k]) / whole_y)
        # Twice is enough: the second pass removes what rounding left of the first.
        for _ in range(2):
            left -= np.outer(q, q @ left)
    return order, ratios


def _how_many(parts: list[Float[np.ndarray, "K K"]], most: int) -> int:
    """Fewest terms whose held-out error is within one standard error of the least."""
    errors = np.empty((len(parts), most + 1))
    for k, held in enumerate(parts):
        R = factor(np.concatenate([p for j, p in enumerate(parts) if j != k]))
        order, _ = forward_path(R, most)
        errors[k, 0] = squared_error(held[:, -1:], np.zeros(0))
        for count in range(1, most + 1):
            chosen = [*order[:count], -1]
            errors[k, count] = squared_error(held[:, chosen], solve(R[:, chosen]).w)
    best = 1 + int(np.argmin(errors[:, 1:].sum(axis=0)))
    excess = errors - errors[:, best : best + 1]
    doubt = np.sqrt(len(parts)) * excess.std(axis=0, ddof=1)
    return 1 + int(np.argmax(excess.sum(axis=0)[1:] <= doubt[1:] + 1e-300))
