"""Weights of a basis by least squares: all at once, or one by one as long as held-out blocks improve."""

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


@dataclasses.dataclass(frozen=True, eq=False)
class SeriesFit:
    """Fitted weights on a basis; attributes with the same name as in `Fit` have the same meaning.

    Attributes:
        model: The series.
        cost: Negative log-likelihood of the samples, constants included [nat].
        status: "converged", with a remark for the reader if there is one.
        parameters: The weights as estimates, named after their regressors. Intervals allow for residuals that
            are correlated in time, as they are if the model is incomplete.
        noise: Channel -> root mean square of its residual [unit of the channel].
        covariance: Covariance of the weights (P, P).
        nmse: Squared error over the squared deviation from the mean, on the samples of the fit.
        rank: Number of directions of the weights that the data determine.
        condition: Largest over smallest eigenvalue of `phi' phi` within these directions.
        ridge: Penalty on the squared weights.
        err: Chosen regressor -> its error-reduction ratio, in the order of choice; empty if all regressors
            were fitted.
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
        """Weights (P,)."""
        return self.model.weights

    @property
    def std(self) -> Float[np.ndarray, " P"]:
        """Standard deviations of the weights (P,); nan where the data do not determine a weight."""
        return np.array([e.std for e in self.parameters])

    @property
    def t(self) -> Float[np.ndarray, " P"]:
        """Weights over their standard deviations (P,); beyond about 3 a weight differs from zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.weights / self.std

    @property
    def selected(self) -> tuple[str, ...]:
        """Names of the chosen regressors, in the order of choice; all regressors if none was left out."""
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
    """The fit of a series, from the solution of a linear least-squares problem.

    Args:
        series: Model with the fitted weights.
        solution: Solution in the columns that were fitted.
        rows: Regressors and targets, with all columns.
        status: Status in words.
        ridge: Penalty of the fit.
        err: Error-reduction ratios.
        columns: Indices of the columns that were fitted (P'); all if None.
    """
    P = series.basis.size
    columns = np.arange(P) if columns is None else columns
    phi = rows.phi if len(columns) == P else rows.phi[:, columns]
    e = rows.y - phi @ solution.w
    # Computed in the directions that the data determine, so that dependent columns do no harm.
    along = phi @ solution.basis
    weighted = solution.basis * solution.shrink
    parts = by_recording(along[:, None, :], e[:, None], rows.segments)
    own = weighted @ sandwich(parts, curvature(parts, along.shape[1])) @ weighted.T
    blind = np.linalg.norm(weighted * np.linalg.norm(along, axis=0), axis=1) == 0
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

    The rows are triangularised orthogonally (QR), without normal equations. If columns depend on each other,
    as in the full layout of a Volterra series, the weights of least norm are given, which are symmetric. Do
    not use it for a recording that does not begin at rest, unless as many first samples are skipped as the
    basis reaches back: the basis has no input before the recording.

    Args:
        basis: Regressors.
        recordings: One or several recordings, with one sampling period.
        channel: Output to model; may be left out if there is only one.
        ridge: Penalty on the squared weights, which are not scaled. "cv" takes the ridge with the least error
            on contiguous blocks left out in turn. Intervals do not include the bias of a ridge.
        skip: Samples at the start of each recording to leave out; its `n_init` if None.
        blocks: Number of blocks for "cv".

    Raises:
        InputError: If there is nothing to fit, if sampling periods differ, if there is no such channel, or if
            the ridge is negative.

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


# A regressor of which no more than this share is left depends linearly on the regressors chosen before.
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

    The regressor with the largest error-reduction ratio is chosen next. Their number is decided on contiguous
    blocks: each block is left out in turn, and the choice is made again without it. The smallest number is
    taken whose error on the blocks left out is within one standard error of the least error. The ratios add
    up to the share of `y' y` that is explained.

    The intervals do not allow for the choice, so they are too narrow. Do not use it where regressors are
    strongly correlated and the structure matters: chance decides which of two similar regressors is chosen.

    Args:
        basis: Candidate regressors.
        recordings: One or several recordings, with one sampling period.
        channel: Output to model; may be left out if there is only one.
        terms: Number of regressors to choose; if None, it is decided on blocks left out in turn.
        most: Largest number that is tried.
        skip: Samples at the start of each recording to leave out; its `n_init` if None.
        blocks: Number of blocks.

    Returns:
        Fit whose model has weight 0 for regressors that were not chosen; `err` has the ratios.

    Raises:
        InputError: As `least_squares`, or if there are too few blocks.

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
    """Columns in the order of choice, and their error-reduction ratios.

    Args:
        R: Triangular factor of `[phi, y]`, whose columns have the same inner products as `[phi, y]`.
        most: Number of columns to choose; fewer are chosen if no independent one is left.
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
        # Two passes are enough: the second one removes what the first one leaves by rounding.
        for _ in range(2):
            left -= np.outer(q, q @ left)
    return order, ratios


def _how_many(parts: list[Float[np.ndarray, "K K"]], most: int) -> int:
    """Smallest number of terms whose error on held-out blocks is within one standard error of the least."""
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
