"""Poles of orthonormal filters, from data by variable projection, and the least error that a bank can reach.

The least error is exact for a linear plant and a known autocovariance of the input, without a recording.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from rotflex_jax.basis.bank import Bank
from rotflex_jax.basis.orthonormal import Orthonormal, SectionKinds, coordinates, parameters_of, poles_of
from rotflex_jax.basis.volterra import Volterra
from rotflex_jax.checks import seed as checked_seed, signal, whole
from rotflex_jax.errors import InputError
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision


def ar1(a: float, length: int) -> Float[np.ndarray, " L"]:
    """Autocovariance of first-order noise of unit variance, `r[k] = a^k`.

    Args:
        a: exp(-2 pi bandwidth Ts); 0 for white noise.
        length: Number of lags, from 0.

    >>> ar1(0.5, 3)
    array([1.  , 0.5 , 0.25])
    """
    if not abs(a) < 1:
        raise InputError(
            f"Argument `a` must lie between -1 and 1, but is {a:g}; give exp(-2 pi bandwidth Ts)."
        )
    return np.power(float(a), np.arange(whole(length, "length", 1)))


def bank_covariance(bank: Bank, autocovariance: Any = (1.0,)) -> Float[np.ndarray, "M M"]:
    """Covariance R1 of the outputs of a bank under a stationary input.

        R1 = B' R B,  B = impulse responses,  R = Toeplitz matrix of the autocovariance

    Args:
        bank: The filters.
        autocovariance: Autocovariance of the input at lags from 0, zero beyond the last; white by default.

    >>> from rotflex_jax.basis import Delays
    >>> bank_covariance(Delays(2), ar1(0.5, 2))
    array([[1. , 0.5],
           [0.5, 1. ]])
    """
    B = bank.impulse_responses(bank.reach)
    return B.T @ scipy.linalg.matmul_toeplitz(_lags(autocovariance, len(B)), B)


def minimum_nmse(bank: Bank, impulse_response: Any, autocovariance: Any = (1.0,)) -> float:
    """Least squared error, over the variance of the output, that any weights on the bank reach.

        min over c of (h - B c)' R (h - B c) / (h' R h)

    Args:
        bank: The filters.
        impulse_response: Impulse response h of the plant (L,), until it has decayed.
        autocovariance: Autocovariance of the input at lags from 0, zero beyond the last; white by default.

    Raises:
        InputError: There are too few lags, or the impulse response is zero.

    Source: Wiener 1949; Haykin 2014, Adaptive Filter Theory, section 2.4.

    >>> from rotflex_jax.basis import Delays
    >>> round(minimum_nmse(Delays(1), 0.5 ** np.arange(40)), 12)
    0.25
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    length = max(len(h), bank.reach)
    h = np.concatenate([h, np.zeros(length - len(h))])
    r = _lags(autocovariance, length)
    B = bank.impulse_responses(length)
    RB = scipy.linalg.matmul_toeplitz(r, B)
    left = h - B @ np.linalg.solve(B.T @ RB, RB.T @ h)
    power = _power(h, r)
    return float(left @ scipy.linalg.matmul_toeplitz(r, left)) / power


def fir_nmse(impulse_response: Any, autocovariance: Any = (1.0,), first: int = 0) -> Float[np.ndarray, " L"]:
    """`minimum_nmse` of `Delays(1, first)`, `Delays(2, first)`, ..., all from one factorisation.

    Args:
        impulse_response: Impulse response h of the plant (L,), until it has decayed.
        autocovariance: Autocovariance of the input at lags from 0, zero beyond the last; white by default.
        first: Delay of the first tap [samples].

    Returns:
        NMSE, in which entry M - 1 belongs to a memory of M; accurate to about 1e-13.
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    first = whole(first, "first", 0)
    r = _lags(autocovariance, len(h))
    power = _power(h, r)
    if first >= len(h):
        raise InputError(
            f"The first delay is {first}, but the impulse response has {len(h)} samples, so that no delay is "
            "left; give a smaller `first`."
        )
    p = scipy.linalg.matmul_toeplitz(r, h)[first:]
    root = scipy.linalg.cholesky(scipy.linalg.toeplitz(r[: len(p)]), lower=True)
    # The first M entries of the triangular solution are the solution for the first M taps.
    gains = scipy.linalg.solve_triangular(root, p, lower=True) ** 2
    return np.maximum(1 - np.cumsum(gains) / power, 0.0)


def memory_for(nmse: float, impulse_response: Any, autocovariance: Any = (1.0,), first: int = 0) -> int:
    """Smallest number of delays with which an error can be reached.

    Args:
        nmse: Squared error over the variance of the output, for instance 0.01.
        impulse_response: Impulse response h of the plant (L,), until it has decayed.
        autocovariance: Autocovariance of the input at lags from 0, zero beyond the last; white by default.
        first: Delay of the first tap [samples].

    Raises:
        InputError: No number of delays reaches this error.

    >>> memory_for(0.07, 0.5 ** np.arange(40))
    2
    """
    if not 0 < nmse < 1:
        raise InputError(
            f"Argument `nmse` must lie between 0 and 1, but is {nmse:g}; give for instance 0.01."
        )
    errors = fir_nmse(impulse_response, autocovariance, first)
    if not np.any(errors <= nmse):
        raise InputError(
            f"An error of {nmse:g} was asked for, but all {len(errors)} delays from lag {first} on leave "
            f"{errors[-1]:.3g}; begin with an earlier delay, or allow more."
        )
    return 1 + int(np.argmax(errors <= nmse))


def best_laguerre(
    impulse_response: Any, count: int, first: int = 1, grid: int = 60
) -> tuple[Orthonormal, float]:
    """The Laguerre bank of a given size that is closest to an impulse response, and its error.

    The error as a function of the pole has several minima, about one per function. So the search starts with
    a grid over all decays, from the whole response down to one sample.

    Args:
        impulse_response: Impulse response h of the plant (L,), until it has decayed.
        count: Number of functions.
        first: Delay of the bank [samples].
        grid: Number of poles on the grid, of which the best one is refined.

    Returns:
        The bank, and |h - B c|^2 / |h|^2.

    Source: Clowes 1965, IEEE Trans. Autom. Control 10 (where the minima lie).

    >>> bank, nmse = best_laguerre(0.9 ** np.arange(200), 1, first=0)
    >>> round(bank.poles[0].real, 6), nmse < 1e-12
    (0.9, True)
    """
    h = signal(impulse_response, "impulse_response").astype(float)
    power = _power(h, _lags((1.0,), len(h)))

    def error(z: float) -> float:
        B = Orthonormal.laguerre(float(np.exp(-np.exp(z))), count, first).impulse_responses(len(h))
        return float(np.sum((h - B @ (B.T @ h)) ** 2)) / power

    decays = np.linspace(np.log(3.0 / len(h)), np.log(3.0), whole(grid, "grid", 3))
    errors = [error(z) for z in decays]
    k = int(np.clip(np.argmin(errors), 1, len(decays) - 2))
    found = scipy.optimize.minimize_scalar(
        error, bounds=(decays[k - 1], decays[k + 1]), method="bounded", options={"xatol": 1e-10}
    )
    return Orthonormal.laguerre(float(np.exp(-np.exp(found.x))), count, first), error(found.x)


def _lags(autocovariance: Any, length: int) -> Float[np.ndarray, " {length}"]:
    """Autocovariance at the lags 0 ... length - 1."""
    r = signal(autocovariance, "autocovariance").astype(float)
    if r[0] <= 0:
        raise InputError(
            f"Argument `autocovariance` begins with the variance, but that is {r[0]:g}; correct it."
        )
    if 1 < len(r) < length and abs(r[-1]) > 1e-3 * r[0]:
        raise InputError(
            f"Argument `autocovariance` ends at lag {len(r) - 1} with {r[-1] / r[0]:.2g} of the variance, "
            f"but {length} lags are needed; give more of them."
        )
    return np.concatenate([r, np.zeros(max(length - len(r), 0))])[:length]


def _power(h: Float[np.ndarray, " L"], r: Float[np.ndarray, " L"]) -> float:
    power = float(h @ scipy.linalg.matmul_toeplitz(r, h))
    if not power > 0:
        raise InputError(
            "Argument `impulse_response` is zero throughout; give the answer of a plant that moves."
        )
    return power


# Modulus of a pole that decays over a million samples; beyond it a search has ended at the unit circle.
LARGEST_MODULUS = 1 - 1e-6


@dataclasses.dataclass(frozen=True)
class PoleStart:
    """Result of one start of a search: final poles, error, reason of the end, and evaluations."""

    poles: tuple[complex, ...]
    nmse: float
    status: str
    steps: int


@dataclasses.dataclass(frozen=True)
class PoleSearch:
    """Result of a search for poles.

    Attributes:
        status: Status of the best start: "converged", or the reason why it stopped, in words.
        nmse: Squared error over the squared deviation from the mean (over the squared output without a
            constant).
        starts: Results of all starts, the best first. Equal errors with different poles mean that the data do
            not distinguish these poles.
    """

    status: str
    nmse: float
    starts: tuple[PoleStart, ...]

    @property
    def poles(self) -> tuple[complex, ...]:
        """Poles of the best start, without repetitions."""
        return self.starts[0].poles

    def __str__(self) -> str:
        lines = [f"Poles: {self.status}, NMSE {self.nmse:.4g}"]
        for start in self.starts:
            # One pole of each pair is printed.
            listed = ", ".join(
                f"{p.real:.4f}" + (f" ± {p.imag:.4f}j" if p.imag else "") for p in start.poles if p.imag >= 0
            )
            lines.append(f"  NMSE {start.nmse:.4g} at {listed} ({start.status}, {start.steps} evaluations)")
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Residual:
    """Residual of least squares as a function of the poles; hashable, compiled once."""

    kinds: SectionKinds
    signs: tuple[float, ...]
    degrees: tuple[int, ...]
    constant: bool
    repeat: int

    def __call__(self, z: Float[Array, " M"], args: Any) -> Float[Array, " RN"]:
        bank, u, y, counted = args
        parameters = jnp.tile(parameters_of(self.kinds, self.signs, z), self.repeat)
        basis = Volterra(bank.with_parameters(parameters), degrees=self.degrees, constant=self.constant)
        phi = jax.vmap(basis.respond)(u) * counted[:, :, None]
        Q, _ = jnp.linalg.qr(phi.reshape(-1, phi.shape[2]))
        y = (y * counted).ravel()
        return y - Q @ (Q.T @ y)


@persistent_jit(static=1)
def _left(residual: _Residual, z: Float[Array, " M"], args: Any) -> Float[Array, " RN"]:
    return residual(z, args)


@persistent_jit(static=1)
def _slopes(residual: _Residual, z: Float[Array, " M"], args: Any) -> Float[Array, "RN M"]:
    return jax.jacfwd(residual)(z, args)


def _descend(residual: _Residual, z: Float[np.ndarray, " M"], args: Any, most: int) -> PoleStart:
    """Runs the search from one start."""
    with double_precision():
        args = (args[0], *map(jnp.asarray, args[1:]))
        try:
            end = scipy.optimize.least_squares(
                lambda z: np.asarray(_left(residual, jnp.asarray(z), args)),
                z,
                lambda z: np.asarray(_slopes(residual, jnp.asarray(z), args)),
                method="lm",
                ftol=1e-12,
                xtol=1e-9,
                gtol=1e-12,
                max_nfev=most,
            )
            z, nmse, steps = end.x, 2 * float(end.cost), int(end.nfev)
            status = "converged" if end.status > 0 else f"stopped after {most} evaluations"
        except ValueError:  # scipy raises it if a number is not finite
            nmse, steps, status = float("nan"), 0, "failed: the error is not finite"
        parameters = parameters_of(residual.kinds, residual.signs, jnp.asarray(z))
    poles = poles_of(residual.kinds, np.asarray(parameters))
    if any(abs(p) > LARGEST_MODULUS for p in poles):
        status += ", a pole at the edge of the unit circle"
    return PoleStart(poles, nmse, status, steps)


def optimise_poles(
    u: Any,
    y: Any,
    poles0: Sequence[complex],
    *,
    degrees: Sequence[int] = (1,),
    constant: bool = True,
    repeat: int = 1,
    first: int = 1,
    skip: int = 0,
    starts: int = 4,
    spread: float = 0.3,
    max_steps: int = 100,
    seed: int = 0,
) -> tuple[Orthonormal, PoleSearch]:
    """Finds the poles for which a Volterra series fits a recording best.

        minimise over the poles  |y - phi(poles) w|^2,  w = least squares for these poles

    By variable projection only the poles are searched, with the Levenberg-Marquardt method and exact
    derivatives. The coordinates are the logarithms of decay and angle, so that no pole can leave the unit
    circle. Several starts show whether the result depends on the start. For a linear plant the result is the
    poles of the plant.

    Not for many free poles: beyond about six the error is flat, and the poles are interchangeable.

    Args:
        u: Input (N,), or a list of the inputs of several recordings.
        y: Output (N,), or a list of outputs.
        poles0: First poles in the z domain, each complex pole with its conjugate. The number of real and of
            complex poles does not change.
        degrees: Degrees of the Volterra series whose weights are fitted.
        constant: Whether the series has a constant.
        repeat: Number of repetitions of the poles: one real pole four times is a Laguerre bank of four.
        first: Delay of the bank [samples].
        skip: Number of samples at the start of each recording that do not count.
        starts: Number of starts: the first is `poles0`, the others are drawn around it.
        spread: Standard deviation of the other starts, in the logarithms.
        max_steps: Most evaluations for each start.
        seed: Seed of the starts.

    Returns:
        The bank with the best poles, and the result of every start.

    Raises:
        InputError: Shapes do not fit, or a pole is not inside the unit circle.

    Source: Golub and Pereyra 1973, SIAM J. Numer. Anal. 10; for Laguerre-Volterra series Kibangou,
    Favier and Hassani 2005, EURASIP J. Appl. Signal Process.

    >>> import scipy.signal
    >>> u = np.random.default_rng(0).standard_normal(300)
    >>> y = scipy.signal.lfilter([0.0, 1.0], [1.0, -0.8], u)
    >>> bank, search = optimise_poles(u, y, [0.5], starts=2)
    >>> round(bank.poles[0].real, 6), search.status
    (0.8, 'converged')
    """
    skip = whole(skip, "skip", 0)
    U, Y, counted = _stack(u, y, skip, constant)
    bank = Orthonormal(poles0, first)
    chosen = Volterra(bank, degrees=degrees, constant=constant)
    repeat = whole(repeat, "repeat", 1)
    z, signs = coordinates(bank.kinds, np.asarray(bank.parameters))
    rng = np.random.default_rng(checked_seed(seed))
    shifts = spread * rng.standard_normal((whole(starts, "starts", 1), len(z)))
    shifts[0] = 0.0
    residual = _Residual(bank.kinds, signs, chosen.chosen, constant, repeat)
    repeated = Orthonormal(bank.poles * repeat, first, _label(bank, repeat))
    most = whole(max_steps, "max_steps", 1)
    ends = [_descend(residual, z + shift, (repeated, U, Y, counted), most) for shift in shifts]
    ends.sort(key=lambda end: end.nmse if np.isfinite(end.nmse) else np.inf)
    best = ends[0]
    search = PoleSearch(best.status, best.nmse, tuple(ends))
    if not np.isfinite(best.nmse) or any(abs(p) >= 1 for p in best.poles):
        return repeated, search  # without a valid result, the poles that were given
    return Orthonormal(best.poles * repeat, first, repeated.label), search


def _label(bank: Orthonormal, repeat: int) -> str:
    if repeat == 1 or len(bank.kinds) > 1:
        return bank.label
    return "Laguerre" if bank.kinds == ("real",) else "Kautz"


Stacked = Float[np.ndarray, "R N"]
"""Recordings of different lengths, padded with zeros."""


def _stack(u: Any, y: Any, skip: int, constant: bool) -> tuple[Stacked, Stacked, Stacked]:
    """Inputs, scaled outputs, and a mask that is one for samples that count."""
    many = isinstance(u, (list, tuple)) and len(u) > 0 and np.ndim(u[0]) == 1
    us = [signal(x).astype(float) for x in (u if many else [u])]
    ys = [signal(x, "y").astype(float) for x in (y if many else [y])]
    if [len(x) for x in us] != [len(x) for x in ys] or min(map(len, us)) <= skip:
        raise InputError(
            f"Inputs of {[len(x) for x in us]} and outputs of {[len(x) for x in ys]} samples were given, the "
            f"first {skip} left out; give as many outputs as inputs, and more than are left out."
        )
    N = max(map(len, us))
    U, Y, counted = np.zeros((3, len(us), N))
    for k, (a, b) in enumerate(zip(us, ys, strict=True)):
        U[k, : len(a)], Y[k, : len(b)], counted[k, skip : len(a)] = a, b, 1.0
    used = Y[counted > 0]
    spread = np.linalg.norm(used - used.mean() if constant else used)
    if not spread > 0:
        raise InputError("Argument `y` does not change, so no pole can be found; give a moving output.")
    return U, Y / spread, counted
