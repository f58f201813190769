"""Precision by call, never by import: float64 work runs inside a context, float32 input stays float32."""

import contextlib

import jax
import numpy as np


def working_precision(*arrays: np.ndarray) -> contextlib.AbstractContextManager:
    """Context in which JAX keeps float64 if any of `arrays` is float64.

    Outside it the user's own JAX configuration is untouched.
    """
    if any(np.asarray(a).dtype == np.float64 for a in arrays):
        return jax.enable_x64(True)
    return contextlib.nullcontext()


def double_precision() -> contextlib.AbstractContextManager:
    """Context in which JAX computes in float64, as fits and discovery need."""
    return jax.enable_x64(True)
