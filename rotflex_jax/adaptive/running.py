"""A filter run over arrays: errors, final weights, their path, and whether it stayed stable."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from rotflex_jax.adaptive.filter import AdaptiveFilter, in_dtype, regressor_size, scan
from rotflex_jax.errors import InputError
from rotflex_jax.precision import working_precision

# An a-priori error beyond this multiple of the largest output means that the filter runs away.
RUNAWAY = 1e4


@dataclass(frozen=True)
class Run:
    """What a filter did over the samples it was given.

    Attributes:
        errors: a-priori errors (N,), each made with the weights from before its sample [output]. The
            weights follow the record meanwhile, so this is the error of no one model, and often far
            below that of the last weights on other data. NaN after a divergence.
        weights: last weights (P,); of no use after a divergence.
        path: weights (K, P) after `path_times` samples; none unless asked for.
        path_times: samples seen (K,): 0, keep_every, 2 keep_every, ...
        state: to go on from.
        status: "ok", or "diverged at sample k".
    """

    errors: Inexact[np.ndarray, " N"]
    weights: Inexact[np.ndarray, " P"]
    path: Inexact[np.ndarray, "K P"]
    path_times: np.ndarray
    state: Any
    status: str

    @property
    def diverged(self) -> bool:
        """Whether the filter ran away."""
        return self.status != "ok"


def run(filter: AdaptiveFilter, phi: Any, y: Any, *, state: Any = None, keep_every: int = 0) -> Run:
    """Runs a filter over a record, one sample after the other.

    One compiled loop; another call with the same shapes and other values compiles nothing. A filter
    has diverged where an error is not finite, or ten thousand times larger than any output.

    Args:
        filter: with its settings.
        phi: regressors (N, P), or the input (N,) for a filter that makes its own.
        y: measured output (N,).
        state: `Run.state` of an earlier run, to go on from; the filter's start if None. Two runs in a
            row give what one run over all samples gives.
        keep_every: keep the weights after every so many samples; 0 keeps only the last.

    Returns:
        The run, in the precision of the data (float64 where they are whole numbers).

    Raises:
        InputError: shapes that do not fit, or numbers that are not finite. A divergence is no error.

    >>> from rotflex_jax.adaptive import LMS
    >>> run(LMS(mu=3.0), np.ones((100, 1)), np.ones(100)).status
    'diverged at sample 14'
    """
    phi, y = _samples(filter, phi, y)
    if isinstance(keep_every, bool) or not isinstance(keep_every, int | np.integer) or keep_every < 0:
        raise InputError(
            f"Argument `keep_every` must be a whole number of samples, but is {keep_every!r}; "
            "give 0 to keep only the last weights."
        )
    with working_precision(phi.real):
        # Settings of one kind whatever they were given as, so that only shapes decide what is compiled.
        filter = in_dtype(filter, phi.dtype)
        start = None if state is None else _resumed(filter, phi, state)
        result = _run(filter, jnp.asarray(phi), jnp.asarray(y), start, int(keep_every))
        end, errors, path, weights = jax.device_get(result)
    errors, status = _judged(errors, y)
    return Run(errors, weights, path, np.arange(len(path)) * keep_every, end, status)


@functools.partial(jax.jit, static_argnums=4)
def _run(
    filter: AdaptiveFilter, phi: Array, y: Array, state: Any, every: int
) -> tuple[Any, Array, Array, Array]:
    if state is None:
        state = filter.init(regressor_size(phi), phi.dtype)
    if not every:
        state, errors = scan(filter, phi, y, state)
        weights = filter.weights(state)
        return state, errors, jnp.zeros((0, *weights.shape), weights.dtype), weights
    first = filter.weights(state)
    # An outer loop over chunks keeps the weights at their ends; what does not fill one follows.
    whole = len(y) // every * every
    chunks = jax.tree.map(lambda x: x[:whole].reshape(-1, every, *x.shape[1:]), (phi, y))

    def chunk(state: Any, samples: tuple[Array, Array]) -> tuple[Any, tuple[Array, Array]]:
        state, errors = scan(filter, *samples, state)
        return state, (errors, filter.weights(state))

    state, (errors, path) = jax.lax.scan(chunk, state, chunks)
    state, rest = scan(filter, phi[whole:], y[whole:], state)
    path = jnp.concatenate([first[None], path])
    return state, jnp.concatenate([errors.reshape(-1), rest]), path, filter.weights(state)


def _samples(filter: AdaptiveFilter, phi: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Both as finite arrays of one floating dtype."""
    phi, y = np.asarray(phi), np.asarray(y)
    named = (("phi", phi), ("y", y))
    for name, x in named:
        if x.dtype.kind not in "iufc":
            raise InputError(
                f"Argument `{name}` must hold numbers, but holds {x.dtype.name}; convert it first."
            )
    dimensions, wanted, advice = (
        (1, "(N,)", "the input itself") if filter.from_input else (2, "(N, P)", "a row of regressors")
    )
    if phi.ndim != dimensions or y.shape != phi.shape[:1] or not phi.size:
        raise InputError(
            f"Arguments `phi` and `y` of {type(filter).__name__} must have the shapes {wanted} and (N,), "
            f"but have {phi.shape} and {y.shape}; give {advice} for every output sample."
        )
    for name, x in named:
        good = np.isfinite(x)
        if not good.all():
            k = int(np.argmin(good.reshape(len(x), -1).all(axis=1)))
            raise InputError(
                f"Argument `{name}` must be finite, but is not at sample {k}; cut or repair the data."
            )
    floats = [x.dtype for _, x in named if x.dtype.kind in "fc"]
    dtype = np.result_type(*floats, np.float32) if floats else np.dtype(np.float64)
    return phi.astype(dtype, copy=False), y.astype(dtype, copy=False)


def _resumed(filter: AdaptiveFilter, phi: np.ndarray, state: Any) -> Any:
    """A state to go on from, in the precision of the data."""
    wanted = jax.eval_shape(lambda: filter.init(regressor_size(phi), phi.dtype))
    shapes = lambda tree: (jax.tree.structure(tree), [np.shape(x) for x in jax.tree.leaves(tree)])  # noqa: E731
    if shapes(state) != shapes(wanted):
        raise InputError(
            f"Argument `state` must come from a run of the same kind of filter over as many regressors, "
            f"but is {type(state).__name__} where {type(wanted).__name__} for {regressor_size(phi)} is "
            "needed; give the state of such a run, or None."
        )
    return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), state, wanted)


def _judged(errors: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, str]:
    """The errors, NaN after a divergence, and the status."""
    size = np.abs(errors)
    # A state to go on from may belong to larger outputs, which its first error then shows.
    scale = max(float(np.max(np.abs(y))), float(np.nan_to_num(size[0], posinf=0.0)))
    bad = ~np.isfinite(size) | (size > RUNAWAY * scale) & (scale > 0)
    if not bad.any():
        return errors, "ok"
    k = int(np.argmax(bad))
    errors = errors.copy()
    errors[k + 1 :] = np.nan
    return errors, f"diverged at sample {k}"
