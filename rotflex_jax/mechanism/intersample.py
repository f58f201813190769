"""Intersample behaviour of the voltage: held by a converter, band-limited, or switched within the samples.

A converter holds each value until the next. Behind a delay the voltage switches within the sample, which
matters where delays are resolved to hundredths of a sample (`assembly.voltage_within_samples`). A signal that
was measured behind a low-pass filter is determined between its samples by the samples (Shannon); a step in
substeps uses the mean of that curve over each substep. Holding a mean loses amplitude at high frequencies,
which the weights restore.
"""

import functools
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Intersample = Literal["held", "smooth", "switched"]
KERNEL_HALF_WIDTH = 24
"""Samples on either side that have a weight: the weight of an ideal low-pass filter with a Kaiser window."""
KAISER_SHAPE = 8.0


@functools.cache
def interpolation_weights(substeps: int) -> Float[np.ndarray, "substeps W"]:
    """Weights of the W samples -KERNEL_HALF_WIDTH + 1 ... KERNEL_HALF_WIDTH around the start of a sample.

    >>> bool(np.all(np.abs(interpolation_weights(4).sum(axis=1) - 1) < 1e-4))
    True
    """
    # The ideal weight at a distance is the mean over all frequencies up to half the sampling rate.
    w = np.pi * (np.arange(4096) + 0.5) / 4096
    middle = (np.arange(substeps) + 0.5) / substeps
    distance = middle[:, None] - np.arange(-KERNEL_HALF_WIDTH + 1, KERNEL_HALF_WIDTH + 1)[None, :]
    held = np.sinc(w / (2 * np.pi * substeps))
    ideal = np.mean(np.cos(distance[..., None] * w) / held, axis=-1)
    radius = np.sqrt(np.maximum(1 - (distance / KERNEL_HALF_WIDTH) ** 2, 0.0))
    window = np.i0(KAISER_SHAPE * radius) / np.i0(KAISER_SHAPE)
    return ideal * window


def substep_voltages(v: Float[Array, " N"], substeps: int) -> Float[Array, "N substeps"]:
    """Voltage of a band-limited signal over each substep; before and after the signal it is constant."""
    N = v.shape[0]
    ends = jnp.concatenate([jnp.full(KERNEL_HALF_WIDTH - 1, v[0]), v, jnp.full(KERNEL_HALF_WIDTH, v[-1])])
    kernel = jnp.asarray(interpolation_weights(substeps), v.dtype)
    return sum(
        (ends[k : k + N, None] * kernel[None, :, k] for k in range(2 * KERNEL_HALF_WIDTH)),
        start=jnp.zeros((N, substeps), v.dtype),
    )
