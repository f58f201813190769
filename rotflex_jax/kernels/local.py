"""Taylor kernels about a constant voltage, and kernels of a series that was identified from data."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Real

from rotflex_jax.checks import LARGEST_COUNT, number, positive, signal
from rotflex_jax.errors import InputError
from rotflex_jax.kernels.result import Kernels
from rotflex_jax.kernels.sensitivities import Modelled, lags_of, output_model
from rotflex_jax.mechanism.assembly import motor_voltage, rest_state
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.scan import states
from rotflex_jax.mechanism.simulate import FreeStep, Solver, free_run, read_outputs
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import require_period
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

DIRECTIONS_PER_BATCH = 64
"""Number of directions of simultaneous derivatives: enough for the vector units, few enough for the cache."""


def local_kernels(
    model: Mechanism | Modelled,
    Ts: float,
    channel: str,
    memory: int,
    *,
    voltage: float = 0.0,
    settle: float | None = None,
    cubic: bool = False,
) -> Kernels:
    """Volterra kernels by Taylor expansion of the simulated output in its last input samples.

        h1[k] = dy[t] / du[t-k],   h2[k, j] = 1/2 d2y[t] / du[t-k] du[t-j],   u near a constant

    The second-order series of a smooth mechanism has an error of third order in the input's deviation. Not
    for dry friction, dead zones and play at rest: a joint that sticks has zero slope there, and a joint that
    slides at a constant voltage has the slope of the joint without friction. With such effects,
    identification from data finds `average_kernels`.

    The kernels are those of the simulation. At a long sampling period its default, one step per sample, is
    accurate for linear effects only: give `Model(joint, Exponential(order=4, substeps=16))` then.

    Args:
        model: Mechanism, or a model with its own integration rule and gates.
        Ts: Sampling period [s]; the voltage is held between samples.
        channel: Output.
        memory: Number of lags M, from 0 to M - 1.
        voltage: Constant voltage about which the series is defined [V].
        settle: Time for which the voltage acts, from rest, before the kernels are computed [s]; five memories
            if None. A motion that continues after that (the angle of a turning hub) is part of `h0`.
        cubic: Whether to compute the diagonal of the cubic kernel too.

    Returns:
        Exact kernels of the simulated model, without standard errors.

    Raises:
        InputError: The channel is unknown, there are no lags, or a period or time is not positive.

    Source: Rugh, Nonlinear System Theory, 1981, section 3.2 (kernels as Fréchet derivatives).

    >>> from rotflex_jax.joints import paper
    >>> kernels = local_kernels(paper(), 0.05, "alpha", 4)
    >>> [round(float(h), 4) + 0.0 for h in kernels.h1]
    [0.0, -0.0491, -0.0188, 0.0297]
    """
    s, memory = output_model(model, channel), lags_of(memory)
    Ts, voltage = positive(Ts, "Ts", "s", "0.002"), number(voltage, "voltage", unit="V", example="1.0")
    settled = number(
        5 * memory * Ts if settle is None else settle, "settle", least=0, unit="s", example="1.0"
    )
    before_pulse = number(settled / Ts, "settle / Ts", below=LARGEST_COUNT, example="1000")
    with double_precision():
        before = jnp.full(max(1, round(before_pulse)), voltage)
        h0, h1, h2, h3 = _derivatives(
            s.mechanism.structure,
            s.solver,
            s.output,
            memory,
            cubic,
            jnp.asarray(s.mechanism.values),
            jnp.asarray(s.gates),
            jnp.asarray(rest_state(s.mechanism.structure, np.float64)),
            before,
            jnp.asarray(float(Ts)),
        )
    return Kernels(
        channel=channel,
        Ts=Ts,
        h0=float(h0),
        h1=np.asarray(h1),
        h2=np.asarray(h2),
        about=float(voltage),
        kind="local",
        input=f"small changes about {voltage:g} {s.mechanism.units.input}",
        h3_diagonal=np.asarray(h3) if cubic else None,
        input_unit=s.mechanism.units.input,
        output_unit=s.unit,
    )


@persistent_jit(static=5)
def _derivatives(
    structure: Mechanism,
    solver: Solver,
    output: int,
    memory: int,
    cubic: bool,
    values: jax.Array,
    gates: jax.Array,
    rest: jax.Array,
    before: jax.Array,
    Ts: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, Any]:
    mechanism = structure.with_values(values)
    held = jnp.concatenate([before, before[-1:]])
    x0 = free_run(structure, solver, values, gates, rest, held, Ts)[0][-1]
    c = solver.prepare(structure, values, gates, Ts)

    def last(recent: jax.Array) -> jax.Array:
        """The output at the end as a function of the input, latest sample first."""
        u = jnp.concatenate([before, recent[::-1]])
        # Actuation may have a memory, so it is evaluated on the earlier samples too.
        v = motor_voltage(mechanism, gates, u, Ts)[len(before) :]
        X = states(FreeStep(structure, solver), x0, v, c)
        return read_outputs(mechanism, gates, X[-1])[output]

    here, units = jnp.full(memory, before[-1]), jnp.eye(memory)
    batch = min(memory, DIRECTIONS_PER_BATCH)
    derivative = lambda f, e: lambda u: jax.jvp(f, (u,), (e,))[1]  # noqa: E731
    h1 = jax.lax.map(lambda e: derivative(last, e)(here), units, batch_size=batch)

    def row(e: jax.Array) -> jax.Array:
        return jax.vmap(lambda d: derivative(derivative(last, e), d)(here))(units)

    h2 = jax.lax.map(row, units, batch_size=max(1, DIRECTIONS_PER_BATCH // memory)) / 2
    h2 = (h2 + h2.T) / 2
    if not cubic:
        return last(here), h1, h2, None
    third = lambda e: derivative(derivative(derivative(last, e), e), e)(here) / 6  # noqa: E731
    return last(here), h1, h2, jax.lax.map(third, units, batch_size=batch)


def identified_kernels(
    identified: Any,  # a SeriesFit or a Series, of the layers above
    memory: int,
    data: Recording | Sequence[Any] | Real[ArrayLike, " N"] | None = None,
    *,
    about: float = 0.0,
) -> Kernels:
    """The kernels of a fitted Volterra series, from its weights.

    Under a Gaussian input the best linear approximation of a cubic kernel is
    `3 sum_jl h3[k, j, l] R[j, l]`. It is added to `h1`, so that kernels of bases with and without a cubic
    degree are comparable.

    Args:
        identified: A fit of a Volterra basis (`least_squares`), whose covariance gives standard errors, or a
            series alone, such as the frozen series of an adaptive filter, which gives none.
        memory: Number of lags; the kernels of an orthonormal basis have infinite length.
        data: Recordings to which the series was fitted, or its input (N,) [V]. The covariance of this input
            determines the sizes of the kernels. Needed for a cubic degree.
        about: Level that was subtracted from the input before the fit [V].

    Raises:
        InputError: The basis has a degree above three, or a cubic degree without `data`; `data` has another
            sampling period than the series, or fewer samples than there are lags.

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
    spread, words = _input(data, memory, about, series)

    def orders(w: np.ndarray) -> list[np.ndarray]:
        """Kernels of degree 0 to 2 from weights, or from a change of the weights."""
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
        # Regressors that a selection left out have no covariance (NaN): their weights are exactly zero.
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
    data: Any, memory: int, about: float, series: Any
) -> tuple[Float[np.ndarray, "memory memory"] | None, str]:
    """Covariance of the input at the lags, and a description of the input."""
    if data is None:
        return None, ""
    several = isinstance(data, list | tuple) and any(isinstance(d, Recording) or np.ndim(d) for d in data)
    runs = []
    for d in data if several else [data]:
        if isinstance(d, Recording):
            require_period(series.Ts, d.Ts, "The series holds")
        runs.append(signal(d.u if isinstance(d, Recording) else d, "data").astype(float) - about)
    if (shortest := min(map(len, runs))) < memory:
        raise InputError(
            f"An input of {shortest} samples was given for kernels of {memory} lags, but it needs one sample "
            "for each lag; give a longer one, or fewer lags."
        )
    phi = np.concatenate([np.lib.stride_tricks.sliding_window_view(v, memory)[:, ::-1] for v in runs])
    v = np.concatenate(runs)
    words = f"{len(v)} samples, {np.sqrt(np.mean(v**2)):.3g} {series.input_unit} rms"
    return phi.T @ phi / len(phi), words
