"""All weights of a basis at once, by least squares over whole recordings."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from rotflex_jax.basis import Basis
from rotflex_jax.errors import InputError
from rotflex_jax.fit.linear import cross_validated_ridge, factor, solve
from rotflex_jax.fit.rows import Rows, checked
from rotflex_jax.fit.series_fit import SeriesFit, series_fit
from rotflex_jax.recording import Recording
from rotflex_jax.series import Series


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
        InputError: Nothing to fit, unlike sampling periods, no such channel, a negative ridge.

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
    listed, channel = checked(recordings, channel)
    if ridge != "cv" and not (isinstance(ridge, (int, float, np.floating)) and 0 <= ridge < np.inf):
        raise InputError(f"Argument `ridge` must be 0 or more, or 'cv', but is {ridge!r}; correct it.")
    rows = Rows.of(basis, listed, channel, skip)
    joined = np.concatenate([rows.phi, rows.y[:, None]], axis=1)
    if ridge == "cv":
        block = rows.blocks(blocks)
        if block[-1] < 1:
            raise InputError(
                f"A ridge by cross-validation needs at least 2 blocks, but {blocks} were asked for; give for "
                "instance blocks=10, or the ridge as a number."
            )
        parts = [factor(joined[block == k]) for k in range(block[-1] + 1)]
        penalty, ridges, _ = cross_validated_ridge(parts)
        R = factor(np.concatenate(parts))
        end = "at the least that was tried" if penalty == ridges[0] else "by cross-validation"
        status = f"converged, ridge {end}"
    else:
        R, penalty, status = factor(joined), float(ridge), "converged"
    solution = solve(R, penalty)
    if solution.rank < basis.size:
        status += f", minimum norm (rank {solution.rank} of {basis.size})"
    first = listed[0]
    unit = first.units[first.channels.index(channel)]
    series = Series(basis, solution.w, channel, first.Ts, first.input_unit, unit)
    return series_fit(series, solution, rows, status, penalty)
