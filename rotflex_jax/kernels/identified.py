"""Kernels of a series that was identified from data, with their standard errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Real

from rotflex_jax.errors import InputError
from rotflex_jax.kernels.result import Kernels
from rotflex_jax.kernels.sensitivities import lags_of
from rotflex_jax.recording import Recording


def identified_kernels(
    identified: Any,  # a SeriesFit or a Series, of the layers above
    memory: int,
    data: Recording | Sequence[Recording] | Real[np.ndarray, " N"] | None = None,
    *,
    about: float = 0.0,
) -> Kernels:
    """The kernels that the weights of a fitted Volterra series stand for.

    Under a Gaussian input the best linear approximation of a cubic kernel is
    `3 sum_jl h3[k, j, l] R[j, l]`; it is added to `h1`, so that kernels of bases with and without a cubic
    degree are comparable.

    Args:
        identified: A fit of a Volterra basis (`least_squares`), whose covariance gives standard errors,
            or the frozen series alone (an adaptive filter's), which has none.
        memory: Number of lags; the kernels of an orthonormal basis have infinite length.
        data: What the series was fitted to, or its input (N,) [V]: sizes are measured with the covariance
            of this input. Needed for a cubic degree.
        about: Level that was subtracted from the input before the fit [V].

    Raises:
        InputError: The basis has a degree above three, or a cubic one and there is no input.

    >>> from types import SimpleNamespace
    >>> from rotflex_jax.basis import Delays, Volterra
    >>> series = SimpleNamespace(basis=Volterra(Delays(2)), weights=np.array([0.5, 1.0, 2.0, 0.0, 3.0, 0.0]),
    ...     channel="alpha", Ts=0.05, input_unit="V", output_unit="rad")
    >>> kernels = identified_kernels(series, 2)
    >>> kernels.h1.tolist(), kernels.h2.tolist()
    ([1.0, 2.0], [[0.0, 1.5], [1.5, 0.0]])
    """
    memory, series = lags_of(memory), getattr(identified, "model", identified)
    covariance = getattr(identified, "covariance", None)
    spread, words = _input(data, memory, about, series.input_unit)

    def orders(w: np.ndarray) -> list[np.ndarray]:
        """Kernels of degree 0 to 2 of weights, or of a direction of them."""
        found = {d: np.asarray(h, float) for d, h in series.basis.kernels(w, memory).items()}
        highest = max(found)
        if highest > 3 or (highest == 3 and spread is None):
            raise InputError(
                f"A basis of degree {highest} was given{' without data' if highest == 3 else ''}, but "
                "kernels are compared up to degree 2, a cube by its linear part under the input; fit degrees "
                "up to 3 and give the recordings of the fit."
            )
        h = [found.get(d, np.zeros((memory,) * d)) for d in range(3)]
        if highest == 3 and spread is not None:
            h[1] = h[1] + 3 * np.einsum("kjl,jl->k", found[3], spread)
        return h

    h0, h1, h2 = orders(np.asarray(series.weights, float))
    std: list[Any] = [0.0, None, None]
    if covariance is not None:
        # Regressors that a selection left out have no covariance: their weights are zero exactly.
        sizes, directions = np.linalg.eigh(np.nan_to_num(np.asarray(covariance, float)))
        columns = [orders(d) for d in (directions * np.sqrt(np.maximum(sizes, 0.0))).T]
        std = [np.sqrt(sum(c[d] ** 2 for c in columns)) for d in range(3)]
    return Kernels(
        channel=series.channel,
        Ts=series.Ts,
        h0=float(h0),
        h1=h1,
        h2=h2,
        about=about,
        kind="identified",
        input=words,
        covariance=spread,
        h0_std=float(std[0]),
        h1_std=std[1],
        h2_std=std[2],
        input_unit=series.input_unit,
        output_unit=series.output_unit,
    )


def _input(
    data: Recording | Sequence[Recording] | np.ndarray | None, memory: int, about: float, unit: str
) -> tuple[np.ndarray | None, str]:
    """Covariance of the input over the lags, and the input in words."""
    if data is None:
        return None, ""
    listed = [data] if isinstance(data, (Recording, np.ndarray)) else list(data)
    runs = [np.asarray(d.u if isinstance(d, Recording) else d, float) - about for d in listed]
    phi = np.concatenate([np.lib.stride_tricks.sliding_window_view(v, memory)[:, ::-1] for v in runs])
    v = np.concatenate(runs)
    return phi.T @ phi / len(phi), f"{len(v)} samples, {np.sqrt(np.mean(v**2)):.3g} {unit} rms"
