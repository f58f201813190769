"""Few weights instead of many: regressors are chosen one by one, as long as validation blocks gain."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Basis
from rotflex_jax.checks import whole
from rotflex_jax.errors import InputError
from rotflex_jax.fit.linear import RegressionRows, checked_recordings, factor, solve, squared_error
from rotflex_jax.fit.series import SeriesFit, series_fit
from rotflex_jax.models.series import Series
from rotflex_jax.recording import Recording

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
        skip: RecordingSamples at the start of each recording to leave out; its `n_init` if None.
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
    unit = first.units[first.channels.index(channel)]
    series = Series(basis, w, channel, first.Ts, first.input_unit, unit)
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
