"""What a filter is given, as finite arrays that fit together."""

from typing import Any

import numpy as np

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.basis.bank import all_finite
from rotflex_jax.errors import InputError


def as_samples(filter: AdaptiveFilter, phi: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Both as finite arrays of one floating dtype."""
    phi, y = np.asarray(phi), np.asarray(y)
    dimensions, wanted, advice = (
        (1, "(N,)", "the input itself") if filter.from_input else (2, "(N, P)", "a row of regressors")
    )
    if phi.ndim != dimensions or y.shape != phi.shape[:1] or not phi.size:
        raise InputError(
            f"Arguments `phi` and `y` of {type(filter).__name__} must have the shapes {wanted} and (N,), "
            f"but have {phi.shape} and {y.shape}; give {advice} for every output sample."
        )
    return finite(phi, y)


def finite(phi: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both in the finer of their precisions."""
    named = (("phi", phi), ("y", y))
    for name, x in named:
        if x.dtype.kind not in "iufc":
            raise InputError(
                f"Argument `{name}` must hold numbers, but holds {x.dtype.name}; convert it first."
            )
        if not all_finite(x):
            k = int(np.argmin(np.isfinite(x).reshape(len(x), -1).all(axis=1)))
            raise InputError(
                f"Argument `{name}` must be finite, but is not at sample {k}; cut or repair the data."
            )
    floats = [x.dtype for _, x in named if x.dtype.kind in "fc"]
    dtype = np.result_type(*floats, np.float32) if floats else np.dtype(np.float64)
    return phi.astype(dtype, copy=False), y.astype(dtype, copy=False)


def stretch(u: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Part of an input, zero before its first sample; no copy where it lies inside."""
    part = u[max(0, start) : max(0, stop)]
    missing = stop - start - len(part)
    return np.concatenate([np.zeros(missing, u.dtype), part]) if missing else part
