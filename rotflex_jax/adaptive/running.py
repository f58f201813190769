"""Runs of a filter over arrays or over a recording: errors, weights, divergence, and the final model."""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, Int

from rotflex_jax.adaptive.fast_forms import RegressorsInLoop, fastest_form
from rotflex_jax.adaptive.filter import AdaptiveFilter, as_samples, finite, regressor_size, scan, stretch
from rotflex_jax.adaptive.lattice import VolterraLattice
from rotflex_jax.basis import Basis, Delays, Volterra
from rotflex_jax.basis.bank import require_basis
from rotflex_jax.checks import instance, signal
from rotflex_jax.errors import InputError
from rotflex_jax.models.series import Series
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import single
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import working_precision

# An a-priori error beyond this multiple of the largest output means divergence.
DIVERGENCE_RATIO = 1e4


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a filter over a number of samples.

    Attributes:
        errors: a-priori errors, each with the weights before its sample [output]. The weights follow the
            record, so these are not the errors of one model, and they are often far below the errors of the
            last weights on other data. NaN after a divergence.
        weights: last weights; of no use after a divergence.
        path: weights after `path_times` samples; empty if `keep_every` was 0.
        path_times: numbers of processed samples: 0, keep_every, 2 keep_every, ...
        state: state from which another run can continue.
        status: "ok", or "diverged at sample k".
    """

    errors: Inexact[np.ndarray, " N"]
    weights: Inexact[np.ndarray, " P"]
    path: Inexact[np.ndarray, "K P"]
    path_times: Int[np.ndarray, " K"]
    state: Any
    status: str

    @property
    def diverged(self) -> bool:
        """Whether the filter diverged."""
        return self.status != "ok"

    def __str__(self) -> str:
        count = len(self.weights)
        size = f"{len(self.errors)} samples, {count} weight{'s' * (count != 1)}"
        if self.diverged:
            return f"Run of {size}: {self.status}"
        e = np.abs(self.errors)
        last = e[-max(1, len(e) // 4) :]
        parts = [f"{np.sqrt(np.mean(part**2)):.3g}" for part in (e, last)]
        return f"Run of {size}: a-priori error {parts[0]} rms, {parts[1]} over the last quarter"


def run(
    filter: AdaptiveFilter,
    phi: Any,
    y: Any,
    *,
    basis: Basis | None = None,
    state: Any = None,
    keep_every: int = 0,
) -> Run:
    """Runs a filter over a record, one sample after the other.

    The loop is compiled; another call with the same shapes and other values needs no compilation. A filter
    has diverged if an error is not finite, or more than ten thousand times larger than any output.

    With a basis, the regressors of a Volterra series of delays are computed inside the loop. This is several
    times faster than `basis.regressors` beforehand, and no regressors are stored.

    Args:
        filter: filter with its settings.
        phi: regressors (N, P); with a basis, or for a filter that makes its own regressors, the input (N,).
        y: measured output (N,).
        basis: basis that gives the regressors of the input. The input may start before the output; the
            earlier samples only fill the memory of the basis.
        state: `Run.state` of an earlier run, from which this run continues; the filter's initial state if
            None. Two successive runs give the same result as one run over all samples.
        keep_every: number of samples after each of which the weights are stored; 0 stores the last weights
            only.

    Returns:
        The run, in the precision of the data (float64 for whole numbers).

    Raises:
        InputError: shapes do not fit, or numbers are not finite. A divergence raises no error.

    >>> from rotflex_jax.adaptive import LMS
    >>> run(LMS(mu=3.0), np.ones((100, 1)), np.ones(100)).status
    'diverged at sample 14'
    """
    if basis is not None:
        return _over_basis(filter, basis, phi, y, state, _chunk(keep_every))
    phi, y = as_samples(filter, phi, y)
    return _run_on(filter, None, phi, y, state, _chunk(keep_every))


def _over_basis(filter: AdaptiveFilter, basis: Basis, u: Any, y: Any, state: Any, every: int) -> Run:
    """A run with the regressors of a basis for an input."""
    if filter.from_input:
        raise InputError(
            f"{type(filter).__name__} makes its own regressors, but `basis` was given too; leave it out."
        )
    require_basis(basis)
    u, y = signal(u, "phi"), np.asarray(y)
    before = len(u) - len(y) if y.ndim == 1 else -1
    if before < 0:
        raise InputError(
            f"The output must have the shape (N,), no longer than its input, but has {y.shape} where the "
            f"input has {u.shape}; give an input for every output sample."
        )
    form = None if y.dtype.kind == "c" else fastest_form(filter, basis, not every)
    if form is None:
        phi, y = as_samples(filter, basis.regressors(u)[before:], y)
        return _run_on(filter, None, phi, y, state, every)
    assert isinstance(basis, Volterra)
    start = before - basis.bank.first  # newest input sample in the first regressors
    x, y = finite(stretch(u, start, start + len(y)), y)
    lags = stretch(u, start - form.memory, start).astype(x.dtype)
    return _run_on(filter, form, x, y, state, every, lags)


def _run_on(
    filter: AdaptiveFilter,
    form: RegressorsInLoop | None,
    phi: Inexact[np.ndarray, "N *P"],
    y: Inexact[np.ndarray, " N"],
    state: Any,
    every: int,
    lags: Inexact[np.ndarray, " M"] | None = None,
) -> Run:
    size = regressor_size(phi) if form is None else form.size
    with working_precision(np.real(phi)):
        # All settings get the same dtype, so that only new shapes need another compilation.
        real = jnp.finfo(phi.dtype).dtype
        filter = jax.tree.map(lambda leaf: np.asarray(leaf).astype(real), filter)
        start = None if state is None else _resumed(filter, size, phi.dtype, state)
        result = _run(form, every, filter, lags, phi, y, start)
        end, errors, path, weights = jax.device_get(result)
    errors, status = _divergence(errors, y)
    return Run(errors, weights, path, np.arange(len(path)) * every, end, status)


@persistent_jit(static=2)
def _run(
    form: RegressorsInLoop | None,
    every: int,
    filter: AdaptiveFilter,
    lags: Inexact[Array, " M"] | None,
    phi: Inexact[Array, "N *P"],
    y: Inexact[Array, " N"],
    state: Any,
) -> tuple[Any, Inexact[Array, " N"], Inexact[Array, "K p"], Inexact[Array, " p"]]:
    size = regressor_size(phi) if form is None else form.size
    state = filter.init(size, phi.dtype) if state is None else state
    step: Any = lambda state, phi, y: scan(filter, phi, y, state)  # noqa: E731
    close: Any = lambda state: state  # noqa: E731
    if form is not None:
        assert lags is not None
        state = form.begin(state, lags[::-1])
        step, close = functools.partial(form.scan, filter), form.end
    weights = lambda state: filter.weights(close(state))  # noqa: E731
    if not every:
        state, errors = step(state, phi, y)
        last = weights(state)
        return close(state), errors, jnp.zeros((0, *last.shape), last.dtype), last
    first = weights(state)
    # An outer loop stores the weights at the ends of chunks; the remaining samples follow.
    whole = len(y) // every * every
    chunks = jax.tree.map(lambda x: x[:whole].reshape(-1, every, *x.shape[1:]), (phi, y))

    def chunk(state: Any, samples: tuple[Array, Array]) -> tuple[Any, tuple[Array, Array]]:
        state, errors = step(state, *samples)
        return state, (errors, weights(state))

    state, (errors, path) = jax.lax.scan(chunk, state, chunks)
    state, rest = step(state, phi[whole:], y[whole:])
    path = jnp.concatenate([first[None], path])
    return close(state), jnp.concatenate([errors.reshape(-1), rest]), path, weights(state)


def _chunk(keep_every: Any) -> int:
    if isinstance(keep_every, bool) or not isinstance(keep_every, int | np.integer) or keep_every < 0:
        raise InputError(
            f"Argument `keep_every` must be a whole number of samples, but is {keep_every!r}; "
            "give 0 to keep only the last weights."
        )
    return int(keep_every)


def _resumed(filter: AdaptiveFilter, size: int, dtype: Any, state: Any) -> Any:
    """The state of an earlier run, checked, in the precision of the data."""
    wanted = jax.eval_shape(lambda: filter.init(size, dtype))
    shapes = lambda tree: (jax.tree.structure(tree), [np.shape(x) for x in jax.tree.leaves(tree)])  # noqa: E731
    if shapes(state) != shapes(wanted):
        raise InputError(
            f"Argument `state` must come from a run of the same kind of filter over as many regressors, "
            f"but is {type(state).__name__} where {type(wanted).__name__} for {size} is "
            "needed; give the state of such a run, or None."
        )
    return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), state, wanted)


def _divergence(errors: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, str]:
    """The errors, NaN after a divergence, and the status."""
    # The state of an earlier run may belong to larger outputs, so that the first error is large.
    scale = max(_largest(y), float(np.nan_to_num(np.abs(errors[0]), posinf=0.0)))
    if _largest(errors) <= DIVERGENCE_RATIO * scale:
        return errors, "ok"
    size = np.abs(errors)
    bad = ~np.isfinite(size) | (size > DIVERGENCE_RATIO * scale) & (scale > 0)
    if not bad.any():
        return errors, "ok"
    k = int(np.argmax(bad))
    errors = errors.copy()
    errors[k + 1 :] = np.nan
    return errors, f"diverged at sample {k}"


def _largest(x: np.ndarray) -> float:
    """Largest magnitude, without a copy of real numbers; NaN if an entry is NaN."""
    return float(np.max(np.abs(x))) if x.dtype.kind == "c" else float(max(np.max(x), -np.min(x)))


@dataclass(frozen=True)
class Identified:
    """Result of a filter over a recording: a run, and a model.

    The errors of the run are online errors: weights that follow the recording predict the next sample, which
    works well even for a wrong model with a large step size. The weights of the model are frozen, and its
    error on another recording shows what was identified. Only this error may be compared with other methods.

    Attributes:
        run: errors, weights and status of the filter, from sample `n_init` of the recording on.
        basis: basis that gives the regressors.
        recording: recording over which the filter ran.
        channel: name of the output.
    """

    run: Run
    basis: Basis
    recording: Recording
    channel: str

    @property
    def model(self) -> Series:
        """Model with the last weights, frozen.

        Raises:
            InputError: the filter diverged, so that its weights are of no use.
        """
        if self.run.diverged:
            raise InputError(
                f"The filter {self.run.status} of its run, so its weights make no model; "
                "give a smaller step size."
            )
        unit = self.recording.unit(self.channel)
        return Series(
            self.basis, self.run.weights, self.channel, self.recording.Ts, self.recording.input_unit, unit
        )

    def __str__(self) -> str:
        online = "" if self.run.diverged else f", online NMSE {self.online_nmse:.3g}"
        terms = f"{self.channel} over {self.basis.size} terms, every {self.recording.Ts:g} s"
        return f"Filter for {terms}{online}\n{self.run}"

    @property
    def online_nmse(self) -> float:
        """Squared a-priori errors of the moving weights relative to the output about its mean [-].

            sum e^2 / sum (y - mean y)^2

        Not a measure of the quality of the model: see `frozen_nmse`. NaN after a divergence.
        """
        return _relative(self.run.errors, _scored(self.recording, self.channel))

    def frozen_nmse(self, recording: Recording) -> float:
        """Squared errors of the frozen weights relative to the output about its mean [-].

            sum (y - y_hat)^2 / sum (y - mean y)^2

        Args:
            recording: recording that the filter did not use; its first `n_init` samples do not count.
        """
        recording = single(recording, "recording")
        y = _scored(recording, self.channel)
        return _relative(y - self.model.simulate(recording)[recording.n_init :, 0], y)


def identify(
    filter: AdaptiveFilter, basis: Basis, recording: Recording, channel: str, *, keep_every: int = 0
) -> Identified:
    """Runs an adaptive filter over a recording, with the regressors of a basis for its input.

    No means are subtracted from the data: the constant of the basis adapts to the mean of the output, and the
    mean of the input is kept, since powers of the input depend on it. The filter starts at sample `n_init`.
    Earlier samples only fill the memory of the basis, which assumes zero input before the recording. If the
    memory of a bank is longer than `n_init`, its transient affects the filter. `VolterraLattice` makes its
    own regressors and assumes zero input before sample `n_init`.

    Args:
        filter: filter with its settings.
        basis: basis, such as `Volterra(Delays(5))`.
        recording: recording whose input drives the basis and of which one channel is the output.
        channel: name of the output channel.
        keep_every: number of samples after each of which the weights are stored; 0 stores the last weights
            only.

    Raises:
        InputError: there is no such channel, or the basis does not fit the filter.
    """
    recording = single(recording, "recording")
    instance(filter, AdaptiveFilter, "filter", "give for instance rotflex_jax.adaptive.RLS()")
    y, n = recording.channel(channel), recording.n_init
    if filter.from_input:
        done = run(filter, _own_input(filter, basis, recording)[n:], y[n:], keep_every=keep_every)
    else:
        done = run(filter, recording.u, y[n:], basis=basis, keep_every=keep_every)
    return Identified(done, basis, recording, channel)


def _own_input(filter: AdaptiveFilter, basis: Basis, recording: Recording) -> Float[np.ndarray, " N"]:
    """The input for a filter that makes its own regressors, which must agree with the basis."""
    if not isinstance(filter, VolterraLattice):
        raise InputError(
            f"{type(filter).__name__} makes its own regressors, of which nothing is known here; "
            "use `run` on the input."
        )
    chosen = (0, 1, 2) if filter.constant else (1, 2)
    if not (
        isinstance(basis, Volterra)
        and isinstance(basis.bank, Delays)
        and basis.bank.memory == filter.memory
        and (basis.chosen, basis.layout) == (chosen, "triangular")
    ):
        raise InputError(
            f"{filter} needs the basis Volterra(Delays({filter.memory}), order=2, "
            f"constant={filter.constant}) in the triangular layout, but was given another; "
            "use RLS with that basis, or the lattice's own."
        )
    return basis.bank.outputs(recording.u)[:, 0]


def _scored(recording: Recording, channel: str) -> Float[np.ndarray, " N"]:
    """The output from `n_init` on."""
    return recording.channel(channel)[recording.n_init :].astype(float)


def _relative(e: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"]) -> float:
    """Sum of squares of e relative to the sum of squares of y about its mean."""
    with np.errstate(all="ignore"):
        return float(np.sum(e.astype(float) ** 2) / np.sum((y - np.mean(y)) ** 2))
