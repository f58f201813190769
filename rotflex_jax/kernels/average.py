"""Kernels that a least-squares fit finds under a Gaussian input, from the slopes along a trajectory."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy

from rotflex_jax.errors import InputError
from rotflex_jax.kernels.result import Kernels
from rotflex_jax.kernels.sensitivities import slopes
from rotflex_jax.kernels.stretches import Stretches
from rotflex_jax.kernels.subject import Modelled, Subject, lags_of, subject
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

# Excess kurtosis up to which an input passes as Gaussian; that of uniform noise is -1.2, of a sine -1.5.
GAUSSIAN = 0.5
FAR = (
    "The input is far from Gaussian: these are mean slopes over its motion, not what least squares finds; "
    "fit the series to the model's simulated output for that."
)


def average_kernels(
    model: Mechanism | Modelled,
    data: Recording | np.ndarray,
    channel: str,
    memory: int,
    *,
    Ts: float | None = None,
    reach: int | None = None,
    blocks: int = 20,
    mirrored: bool = False,
    autocovariance: np.ndarray | None = None,
) -> Kernels:
    """The second-order series that fits the model best under a Gaussian input.

        h1 = P E[s],   h2 = 1/2 P cov(s, phi) R^-1,   s[k] = dy[t] / du[t-k]
        phi = (u[t], ..., u[t-M+1]),   R = cov(phi),   P = R^-1 cov(phi, u[t], ..., u[t-L+1])

    By Stein's lemma these are the coefficients of least squares, and first derivatives are enough:
    the quadratic kernel is the covariance of the linear slope with the input (white input:
    `h1[k] = E s[k]`, and `h2[k, j]` is `E[s[k] u[t-j]] / 2 sigma^2`). So it exists for laws with kinks
    too, such as dry friction, where the Taylor kernels at rest say nothing.

    Not for an input far from Gaussian (steps, a controller's voltage): the slopes are still averages over
    that motion, but least squares then weighs the motions in another way. Fit the series to the
    model's simulated output in that case, beside the one fitted to the measurement.

    Args:
        model: Mechanism, or a model with its own integration rule and gates.
        data: Recording, whose voltage and first state are taken, or the voltage (N,) [V] from rest.
        channel: Output.
        memory: Number of lags M, from 0 to M - 1.
        Ts: Sampling period [s], where `data` is a voltage.
        reach: Number of lags L >= M over which slopes are formed; they should die out before, unless the
            input is white. Twice the memory if None.
        blocks: Stretches of the recording that standard errors come from.
        mirrored: Average over the voltage and the same with opposite sign, which are equally likely where
            the mean is zero. An odd mechanism then has no quadratic kernel to the last digit.
        autocovariance: Of the input at lags 0 to L - 1 [V^2], where it is known; else the sample's, as
            in a least-squares fit of the same recording.

    Returns:
        Kernels about the mean voltage (zero where mirrored), with standard errors.

    Raises:
        InputError: An unknown channel, too few samples, or an input that does not tell its lags apart.

    Source: Stein, Ann. Stat. 9, 1981, lemma 2; Price, IRE Trans. Inf. Theory 4, 1958; Schetzen, The
    Volterra and Wiener Theories of Nonlinear Systems, 1980.
    """
    s, memory = subject(model, channel), lags_of(memory)
    run = Stretches.of(s, data, Ts, memory, reach, blocks, mirrored)
    return kernels_of(run, parts(s, run, autocovariance), channel)


class Parts(NamedTuple):
    """Per stretch: `h0` (B,), `h1` (B, M), `h2` (B, M, M); their means are the kernels. And `R` (M, M)."""

    h0: np.ndarray
    h1: np.ndarray
    h2: np.ndarray
    R: np.ndarray


def parts(s: Subject, run: Stretches, autocovariance: np.ndarray | None) -> Parts:
    """Kernels of every stretch under the input of the whole."""
    M, L, N = run.memory, run.reach, run.blocks * run.width
    lagged = np.lib.stride_tricks.sliding_window_view(run.u - run.about, L)[:, ::-1][-N:]  # (N, L)
    if autocovariance is None:
        whole = lagged.T @ lagged / N
    else:
        known = np.asarray(autocovariance, float)
        if known.shape != (L,):
            raise InputError(
                f"An autocovariance of shape {known.shape} was given, but it needs one value for each of the "
                f"{L} lags; give lags 0 to {L - 1}."
            )
        whole = scipy.linalg.toeplitz(known)
    R = whole[:M, :M]
    if not np.linalg.cond(R) < 1e12:
        raise InputError(
            f"The voltage hardly changes over {M} lags of {run.Ts:g} s (condition {np.linalg.cond(R):.1g}), "
            "but kernels need an input that tells the lags apart; sample more slowly or excite more widely."
        )
    P = np.linalg.solve(R, whole[:M])
    found = [_blocks(s, run, run.u, lagged, P, R)]
    if run.mirrored:
        found.append(_blocks(s, run, -run.u, -lagged, P, R))
    h0, h1, h2 = (np.mean([f[k] for f in found], axis=0) for k in range(3))
    return Parts(h0, h1, h2, R)


def _blocks(
    s: Subject, run: Stretches, u: np.ndarray, lagged: np.ndarray, P: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    B, M, N = run.blocks, run.memory, run.blocks * run.width
    with double_precision():
        y, slope = slopes(
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
    # The slope's mean is taken out: it would only multiply the mean of the input, which is zero.
    varying = cut - np.mean(slope, axis=1)[:, None, None]
    phi = (lagged[:, :M] - np.mean(lagged[:, :M], axis=0)).reshape(B, run.width, M)
    C = np.einsum("lbt,btm->blm", varying, phi, optimize=True) / run.width
    h1 = g @ P.T
    h2 = np.linalg.solve(R, np.swapaxes(P @ C, 1, 2)) / 2
    h2 = (h2 + np.swapaxes(h2, 1, 2)) / 2
    return np.mean(y.reshape(B, run.width), axis=1) - np.sum(h2 * R, axis=(1, 2)), h1, h2


def kernels_of(run: Stretches, found: Parts, channel: str) -> Kernels:
    """Means over the stretches, standard errors from their scatter."""
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
        note="" if abs(excess) < GAUSSIAN else FAR,
        covariance=found.R,
        h0_std=float(std(found.h0)),
        h1_std=std(found.h1),
        h2_std=std(found.h2),
        input_unit=run.unit[0],
        output_unit=run.unit[1],
    )
