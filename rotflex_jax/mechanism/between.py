"""What the voltage does between two samples, where it is not held.

A converter holds each value until the next; a signal that was measured behind a filter runs on smoothly
and is known between its samples from them alone (Shannon). A step in substeps takes the mean of that
curve over each of them. Held over a substep, a mean loses amplitude at high frequencies; the weights
give it back.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

Between = Literal["held", "smooth"]
# Samples on either side that count; their weights are those of the ideal low-pass under a Kaiser window.
REACH, SHAPE = 24, 8.0


@functools.cache
def weights(substeps: int) -> np.ndarray:
    """Weights (substeps, 2 REACH) of the samples -REACH + 1 ... REACH around a sample's beginning.

    >>> bool(np.all(np.abs(weights(4).sum(axis=1) - 1) < 1e-4))
    True
    """
    # The ideal weight at a distance is the mean over all frequencies up to half the sampling rate.
    w = np.pi * (np.arange(4096) + 0.5) / 4096
    middle = (np.arange(substeps) + 0.5) / substeps
    away = middle[:, None] - np.arange(-REACH + 1, REACH + 1)[None, :]
    held = np.sinc(w / (2 * np.pi * substeps))
    ideal = np.mean(np.cos(away[..., None] * w) / held, axis=-1)
    window = np.i0(SHAPE * np.sqrt(np.maximum(1 - (away / REACH) ** 2, 0.0))) / np.i0(SHAPE)
    return ideal * window


def smoothed(v: jax.Array, substeps: int) -> jax.Array:
    """Voltage (N, substeps) of a smooth signal given at its samples (N,); constant beyond its ends."""
    N = v.shape[0]
    ends = jnp.concatenate([jnp.full(REACH - 1, v[0]), v, jnp.full(REACH, v[-1])])
    kernel = jnp.asarray(weights(substeps), v.dtype)
    return sum(
        (ends[k : k + N, None] * kernel[None, :, k] for k in range(2 * REACH)),
        start=jnp.zeros((N, substeps), v.dtype),
    )
