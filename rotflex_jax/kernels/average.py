"""Kernels that least squares finds under a Gaussian input, and the contribution of each effect to them."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float, Real

from rotflex_jax.checks import positive, signal, vector, whole
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.kernels.result import Kernels, linear_size, quadratic_size, root_mean_square
from rotflex_jax.kernels.sensitivities import Modelled, OutputModel, lags_of, output_derivatives, output_model
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.initial_state import initial_states
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import of_one_period
from rotflex_jax.runtime.xla import double_precision
from rotflex_jax.text.numbers import json_number


class AveragingRun(NamedTuple):
    """The input over which kernels are averaged, and its division into blocks.

    Attributes:
        u: Voltage [V].
        Ts: Sampling period [s].
        x0: First state.
        memory: Lags M of the kernels.
        reach: Lags L of the output derivatives.
        blocks: Number of blocks.
        width: Samples per block; the last block ends with the recording.
        mirrored: Whether the average includes the voltage with opposite sign.
        unit: Units of input and output.
    """

    u: Float[np.ndarray, " N"]
    Ts: float
    x0: Float[np.ndarray, " n"]
    memory: int
    reach: int
    blocks: int
    width: int
    mirrored: bool
    unit: tuple[str, str]

    @property
    def about(self) -> float:
        """Input level about which the kernels are defined [V]."""
        return 0.0 if self.mirrored else float(np.mean(self.u))

    @classmethod
    def of(
        cls,
        s: OutputModel,
        data: Recording | Real[np.ndarray, " N"],
        Ts: float | None,
        memory: int,
        reach: int | None,
        blocks: int,
        mirrored: bool,
    ) -> "AveragingRun":
        """A run from arguments, which are checked; the first state is estimated if `data` is a recording."""
        reach, blocks = 2 * memory if reach is None else whole(reach, "reach", 1), whole(blocks, "blocks", 2)
        x0 = rest_state(s.mechanism.structure, np.float64)
        unit, skip = (s.mechanism.units.input, s.unit), reach
        if isinstance(data, Recording):
            if Ts is not None and not of_one_period([positive(Ts, "Ts", "s", "0.002"), data.Ts]):
                raise InputError(
                    f"Argument `Ts` was given as {Ts:g}, but the recording has a sampling period of "
                    f"{data.Ts:g} s; leave Ts out."
                )
            m, Ts, u = data.n_init, data.Ts, data.u.astype(float)
            unit = (data.input_unit, s.unit)
            skip = max(reach, m)
            if set(s.mechanism.channels) <= set(data.channels):
                y = Model(s.mechanism, s.solver).measured(data).astype(float)
                start = initial_states(s.mechanism, s.solver, s.gates, u[None, :m], y[None, :m], Ts)[0]
                x0[: len(start)] = start
        else:
            u = signal(data, "data").astype(float)
        Ts = positive(Ts, "Ts", "s", "0.002, or a recording as data")
        width = (len(u) - skip) // max(blocks, 1)
        if reach < memory or blocks < 2 or width < memory:
            raise InputError(
                f"{len(u)} samples in {blocks} blocks with a memory of {memory} and a reach of {reach} lags "
                "were given, but the reach must not be below the memory and each of at least two blocks "
                "needs as many samples as the memory has lags; give a longer recording or fewer blocks."
            )
        return cls(u, float(Ts), x0, memory, reach, blocks, width, mirrored, unit)


GAUSSIAN_EXCESS_KURTOSIS = 0.5
"""Magnitude up to which an input counts as Gaussian; uniform noise has -1.2, a sine -1.5."""
NOT_GAUSSIAN_NOTE = (
    "The input is far from Gaussian: these are mean slopes over its motion, not what least squares finds; "
    "fit the series to the model's simulated output for that."
)


def average_kernels(
    model: Mechanism | Modelled,
    data: Recording | Real[np.ndarray, " N"],
    channel: str,
    memory: int,
    *,
    Ts: float | None = None,
    reach: int | None = None,
    blocks: int = 20,
    mirrored: bool = False,
    autocovariance: Real[np.ndarray, " _"] | None = None,
) -> Kernels:
    """The second-order series that fits the model best under a Gaussian input.

        h1 = P E[s],   h2 = 1/2 P cov(s, phi) R^-1,   s[k] = dy[t] / du[t-k]
        phi = (u[t], ..., u[t-M+1]),   R = cov(phi),   P = R^-1 cov(phi, u[t], ..., u[t-L+1])

    By Stein's lemma these are the coefficients of least squares, and first derivatives are sufficient:
    the quadratic kernel is the covariance of the linear slope with the input (white input:
    `h1[k] = E s[k]`, and `h2[k, j]` is `E[s[k] u[t-j]] / 2 sigma^2`). It therefore exists for effects that
    are not differentiable, such as dry friction, whose Taylor kernels at rest are zero.

    Not for an input far from Gaussian (steps, a controller's voltage): the slopes are still averages over
    that motion, but least squares weights the motions differently. In that case fit the series to the
    simulated output of the model, and compare it with the series that is fitted to the measurement.

    Args:
        model: Mechanism, or a model with its own integration rule and gates.
        data: Recording, which gives voltage, first state and its constants, or a voltage [V] that starts
            from rest.
        channel: Output.
        memory: Number of lags M, from 0 to M - 1.
        Ts: Sampling period [s], if `data` is a voltage.
        reach: Number of lags L >= M of the output derivatives, which should decay within them unless the
            input is white. Twice the memory if None.
        blocks: Number of blocks of the recording, whose scatter gives the standard errors.
        mirrored: Whether to average over the voltage and the voltage with opposite sign, from the opposite
            first state, which are equally likely if the mean is zero. The quadratic kernel of an odd
            mechanism is then exactly zero.
        autocovariance: Autocovariance of the input at lags 0 to L - 1 [V^2], if it is known; None for the
            sample autocovariance, as in a least-squares fit of the same recording.

    Returns:
        Kernels about the mean voltage (zero if mirrored), with standard errors.

    Raises:
        InputError: The channel is unknown, there are too few samples, or the covariance of the input is
            ill-conditioned.

    Source: Stein, Ann. Stat. 9, 1981, lemma 2; Price, IRE Trans. Inf. Theory 4, 1958; Schetzen, The
    Volterra and Wiener Theories of Nonlinear Systems, 1980.
    """
    s, memory = _of_recording(output_model(model, channel), data), lags_of(memory)
    run = AveragingRun.of(s, data, Ts, memory, reach, blocks, mirrored)
    return kernels_of(run, block_kernels(s, run, autocovariance), channel)


def _of_recording(s: OutputModel, data: Any) -> OutputModel:
    """The model with the constants of a recording, if that is what was given."""
    if not isinstance(data, Recording):
        return s
    return s._replace(mechanism=Model(s.mechanism, s.solver).at(data).mechanism)


class BlockKernels(NamedTuple):
    """Kernels of each block, whose means over the blocks are the kernels, and covariance R of the input."""

    h0: Float[np.ndarray, " B"]
    h1: Float[np.ndarray, "B M"]
    h2: Float[np.ndarray, "B M M"]
    R: Float[np.ndarray, "M M"]


def block_kernels(
    s: OutputModel, run: AveragingRun, autocovariance: Real[np.ndarray, " _"] | None
) -> BlockKernels:
    """Kernels of every block under the covariance of the whole input."""
    M, L, N = run.memory, run.reach, run.blocks * run.width
    lagged = np.lib.stride_tricks.sliding_window_view(run.u - run.about, L)[:, ::-1][-N:]  # (N, L)
    if autocovariance is None:
        whole = lagged.T @ lagged / N
    else:
        known = vector(autocovariance, "autocovariance", L, example=f"lags 0 to {L - 1}")
        whole = scipy.linalg.toeplitz(known)
    R = whole[:M, :M]
    if not np.linalg.cond(R) < 1e12:
        raise InputError(
            f"The voltage hardly changes over {M} lags of {run.Ts:g} s (condition {np.linalg.cond(R):.1g}), "
            "but kernels need an input that distinguishes the lags; sample more slowly or excite more widely."
        )
    P = np.linalg.solve(R, whole[:M])
    found = [_blocks(s, run, run.u, lagged, P, R)]
    if run.mirrored:
        start, moving = run.x0.copy(), 2 * len(s.mechanism.coordinates)
        start[:moving] *= -1
        found.append(_blocks(s, run._replace(x0=start), -run.u, -lagged, P, R))
    h0, h1, h2 = (np.mean([f[k] for f in found], axis=0) for k in range(3))
    return BlockKernels(h0, h1, h2, R)


def _blocks(
    s: OutputModel, run: AveragingRun, u: np.ndarray, lagged: np.ndarray, P: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    B, M, N = run.blocks, run.memory, run.blocks * run.width
    with double_precision():
        y, slope = output_derivatives(
            s.mechanism.structure,
            s.solver,
            s.output,
            run.reach,
            jnp.asarray(s.mechanism.values),
            jnp.asarray(s.gates),
            jnp.asarray(run.x0),
            jnp.asarray(u),
            jnp.asarray(run.Ts),
        )
        y, slope = np.asarray(y)[-N:], np.asarray(slope)[:, -N:]
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(slope))):
        raise InputError(
            f"The model was driven by a voltage of up to {np.max(np.abs(u)):.3g} {run.unit[0]}, but its "
            "simulated motion does not stay finite; use a smaller voltage, more substeps, or another model."
        )
    cut = slope.reshape(run.reach, B, run.width)
    g = np.mean(cut, axis=2).T  # (B, L)
    # The mean slope is subtracted: it would only multiply the mean of the input, which is zero.
    varying = cut - np.mean(slope, axis=1)[:, None, None]
    phi = (lagged[:, :M] - np.mean(lagged[:, :M], axis=0)).reshape(B, run.width, M)
    C = np.einsum("lbt,btm->blm", varying, phi, optimize=True) / run.width
    h1 = g @ P.T
    h2 = np.linalg.solve(R, np.swapaxes(P @ C, 1, 2)) / 2
    h2 = (h2 + np.swapaxes(h2, 1, 2)) / 2
    return np.mean(y.reshape(B, run.width), axis=1) - np.sum(h2 * R, axis=(1, 2)), h1, h2


def kernels_of(run: AveragingRun, found: BlockKernels, channel: str) -> Kernels:
    """Kernels as means over the blocks, with standard errors from the scatter of the blocks."""
    mean, root = lambda a: np.mean(a, axis=0), np.sqrt(run.blocks)
    std = lambda a: np.std(a, axis=0, ddof=1) / root  # noqa: E731
    u = run.u - run.about
    rms = float(np.sqrt(np.mean(u**2)))
    excess = float(np.mean(u**4)) / rms**4 - 3
    return Kernels(
        channel=channel,
        Ts=run.Ts,
        h0=float(mean(found.h0)),
        h1=mean(found.h1),
        h2=mean(found.h2),
        about=run.about,
        kind="average",
        input=f"{len(u)} samples, {rms:.3g} {run.unit[0]} rms, excess kurtosis {excess:.2g}"
        + (", and mirrored" if run.mirrored else ""),
        note="" if abs(excess) < GAUSSIAN_EXCESS_KURTOSIS else NOT_GAUSSIAN_NOTE,
        covariance=found.R,
        h0_std=float(std(found.h0)),
        h1_std=std(found.h1),
        h2_std=std(found.h2),
        input_unit=run.unit[0],
        output_unit=run.unit[1],
    )


DETECTED_STANDARD_ERRORS = 2.0
"""Least change (rms over the kernel, in standard errors) that is reported; chance gives about one."""
ROUNDING_SHARE = 1e-9
"""Changes and errors below this share of the linear kernel count as rounding errors."""


@dataclasses.dataclass(frozen=True, eq=False)
class EffectShare:
    """Contribution of one effect to the kernels.

    Attributes:
        effect: The effect, with its parameter values.
        change: Kernels with it less kernels without it; standard errors of the difference.
        linear: Size of the change of `h1` as a share of the linear response, less its expected noise.
        quadratic: Size of the change of `h2` as a share of the linear response, less its expected noise.
        z: Root mean square of both changes in standard errors; chance alone gives about one. Zero if a kernel
            does not change, infinite if its change is the same for all inputs, as for a linear effect.
    """

    effect: Effect
    change: Kernels
    linear: float
    quadratic: float
    z: tuple[float, float]

    @property
    def name(self) -> str:
        """Name and port of the effect, for instance "coulomb at hub"."""
        return f"{self.effect.name} at {self.effect.at}"

    def __str__(self) -> str:
        unit = " standard errors"
        first = _words(self.linear, self.z[0], unit)
        second = _words(self.quadratic, self.z[1], unit)
        return f"{self.effect.title} ({self.name}): changes h1 by {first}, h2 by {second}"


@dataclasses.dataclass(frozen=True, eq=False)
class EffectKernels:
    """Kernels of a model, and the contribution of each effect to them.

    Attributes:
        whole: Kernels with all effects.
        shares: Contribution of each effect that was switched off, in the order of the mechanism.
    """

    whole: Kernels
    shares: tuple[EffectShare, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON."""
        rows = [
            {
                "effect": s.effect.name,
                "port": s.effect.at,
                "parameters": {k: float(v) for k, v in s.effect.values.items()},
                "linear": s.linear,
                "quadratic": s.quadratic,
                "standard_errors": [json_number(z) for z in s.z],
                "statement": str(s),
            }
            for s in self.shares
        ]
        return {"whole": self.whole.to_dict(), "effects": rows}

    def __str__(self) -> str:
        width = max((len(s.name) for s in self.shares), default=6)
        head = f"{'effect':{width}}  {'h1 changes by':>16}  {'h2 changes by':>16}"
        rows = [
            f"{s.name:{width}}  {_words(s.linear, s.z[0]):>16}  {_words(s.quadratic, s.z[1]):>16}"
            for s in self.shares
        ]
        note = "As shares of the linear response; in brackets in standard errors (rms; chance gives 1)."
        return "\n".join([str(self.whole), head, *rows, note])


def effect_kernels(
    model: Mechanism | Modelled,
    data: Recording | Real[np.ndarray, " N"],
    channel: str,
    memory: int,
    *,
    Ts: float | None = None,
    reach: int | None = None,
    blocks: int = 20,
    mirrored: bool = False,
    autocovariance: Real[np.ndarray, " _"] | None = None,
) -> EffectKernels:
    """Average kernels of a model, and their change when one effect at a time is switched off.

    Effects that every joint has (inertia, spring, motor) are not switched off, and neither are effects that
    are inactive already. Changes need not add up: a dead zone changes the kernels more if friction acts too.

    Args:
        model: This and all other arguments are as in `average_kernels`.
        data: Recording or voltage [V]; the same input is used with and without an effect, so that most of the
            noise cancels in the differences.
        channel: Output.
        memory: Number of lags.
        Ts: Sampling period [s], if `data` is a voltage.
        reach: Number of lags of the output derivatives.
        blocks: Number of blocks for the standard errors.
        mirrored: Whether to average over the voltage and the voltage with opposite sign.
        autocovariance: Autocovariance of the input, if it is known [V^2].

    Returns:
        Kernels of the whole model, and the contribution of each effect.

    Raises:
        InputError: As `average_kernels`.
    """
    s, memory = _of_recording(output_model(model, channel), data), lags_of(memory)
    run = AveragingRun.of(s, data, Ts, memory, reach, blocks, mirrored)
    all_on = block_kernels(s, run, autocovariance)
    whole = kernels_of(run, all_on, channel)
    shares = []
    for i, effect in enumerate(s.mechanism.effects):
        if not _switchable(effect) or s.gates[i] == 0:
            continue
        gates = s.gates.copy()
        gates[i] = 0.0
        without = block_kernels(s._replace(gates=gates), run, autocovariance)
        change = (a - b for a, b in zip(all_on[:3], without[:3], strict=True))
        shares.append(_share(effect, run, BlockKernels(*change, R=all_on.R), whole))
    return EffectKernels(whole, tuple(shares))


def _switchable(effect: Effect) -> bool:
    if effect.is_linear and not effect.searched:
        return False
    sizes = [float(effect.values[name]) for name in effect.amplitudes]
    return not sizes or any(sizes)


def _share(effect: Effect, run: AveragingRun, difference: BlockKernels, whole: Kernels) -> EffectShare:
    change = kernels_of(run, difference, whole.channel)
    R, reference = whole.spread, whole.sizes[0] or 1.0
    first, second = change.errors
    linear = _size_without_noise(difference.h1, lambda h: linear_size(h, R)) / reference
    quadratic = _size_without_noise(difference.h2, lambda h: quadratic_size(h, R)) / reference
    z = (_standardised_change(change.h1, first, whole.h1), _standardised_change(change.h2, second, whole.h1))
    return EffectShare(
        effect=effect,
        change=change,
        linear=linear if z[0] else 0.0,
        quadratic=quadratic if z[1] else 0.0,
        z=z,
    )


def _standardised_change(change: np.ndarray, std: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of a change in standard errors; zero without a change, infinite without scatter."""
    rounding = ROUNDING_SHARE * (np.max(np.abs(reference)) or 1.0)
    if np.max(np.abs(change)) < rounding:
        return 0.0
    seen = std > 1e-6 * np.max(std)
    return root_mean_square(change[seen] / std[seen]) if np.max(std) > rounding else np.inf


def _size_without_noise(blocks: np.ndarray, size: Any) -> float:
    """Size of the mean of the blocks, corrected for the contribution of their scatter to its square."""
    mean = np.mean(blocks, axis=0)
    scatter = np.mean([size(block - mean) ** 2 for block in blocks]) / (len(blocks) - 1)
    return float(np.sqrt(max(size(mean) ** 2 - scatter, 0.0)))


def _words(share: float, z: float, unit: str = "") -> str:
    """A share with its change in standard errors, in words; a change that may be chance reads "nothing"."""
    if z == 0:
        return "exactly nothing"
    if z < DETECTED_STANDARD_ERRORS:
        return f"nothing ({z:.1f}{unit})"
    if np.isinf(z):
        return f"{100 * share:.2g} % (exact)"
    return f"{100 * share:.2g} % ({z:.0f}{unit})"
