"""2.2: error of five delays, and the memory that a finite impulse response needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.linalg import matmul_toeplitz
from scipy.optimize import brentq

from rotflex_jax.basis import Delays, Volterra, ar1, memory_for, minimum_nmse
from rotflex_jax.fit import least_squares
from rotflex_jax.recording import Recording
from seed_paper.blocks import Block, mean_and_spread
from seed_paper.records import impulse_response, nmse, record

TITLE = "What five delays can reach, and the memory that is needed"
INTERVALS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
FIVE = Delays(5, first=0)
CUTOFFS = {"white": None, "10 Hz": 10.0, "5 Hz": 5.0, "2 Hz": 2.0}


def blocks(quick: bool, say: Callable[[str], None]) -> Iterator[Block]:
    """The parts of the table."""
    label = {Ts: f"{1e3 * Ts:g} ms" for Ts in INTERVALS}
    responses = {Ts: impulse_response(Ts) for Ts in INTERVALS}
    say("exact Wiener solutions")
    yield Block(
        "NMSE of five delays",
        "Exact Wiener solution for the linear joint, delays 0 to 4, first-order noise of the given corner.",
        tuple(CUTOFFS),
        {label[Ts]: tuple(wiener(h, Ts, fc) for fc in CUTOFFS.values()) for Ts, h in responses.items()},
        absolute=1e-4,
    )
    yield Block(
        "Memory for a given NMSE, white input",
        "Least number of delays, the one of lag 0 included, which cannot act yet.",
        ("10 %", "1 %", "0.1 %"),
        {
            label[Ts]: tuple(float(memory_for(share, h)) for share in (0.1, 0.01, 0.001))
            for Ts, h in responses.items()
        },
    )
    yield Block(
        "Deflection, standard deviation [rad]",
        "Of the linear joint under an input of 1 V rms.",
        ("white", "5 Hz"),
        {label[Ts]: tuple(deviation(h, Ts, fc) for fc in (None, 5.0)) for Ts, h in responses.items()},
        absolute=1.01e-4,
    )
    yield Block(
        "Shortest sampling interval for five delays [ms]",
        "White input, exact Wiener solution for the linear joint. The reference has whole milliseconds, "
        "rounded up or down.",
        ("white",),
        {name: (shortest(share),) for name, share in (("10 %", 0.1), ("5 %", 0.05), ("1 %", 0.01))},
        absolute=1.0,
    )
    say("with friction")
    yield with_friction(quick)


def autocovariance(N: int, Ts: float, cutoff: float | None) -> np.ndarray:
    """Autocovariance of the input at lags from 0."""
    return ar1(np.exp(-2 * np.pi * cutoff * Ts) if cutoff else 0.0, N)


def wiener(h: np.ndarray, Ts: float, cutoff: float | None) -> float:
    """NMSE of five delays with the Wiener solution for an impulse response."""
    return minimum_nmse(FIVE, h, autocovariance(len(h), Ts, cutoff))


def deviation(h: np.ndarray, Ts: float, cutoff: float | None) -> float:
    """Standard deviation of the deflection [rad]."""
    return float(np.sqrt(h @ matmul_toeplitz(autocovariance(len(h), Ts, cutoff), h)))


def shortest(share: float) -> float:
    """Sampling interval at which the NMSE of five delays equals a share [ms]."""

    def excess(Ts: float) -> float:
        return minimum_nmse(FIVE, impulse_response(Ts, 50 * Ts)) - share

    return 1e3 * brentq(excess, 0.04, 0.1, xtol=1e-6)


def with_friction(quick: bool) -> Block:
    """Held-out errors of least squares on simulated recordings with friction."""
    N, records = (3000, 3) if quick else (15000, 8)
    basis = Volterra(FIVE, order=1)
    rows, spread = {}, {}
    for Ts in (0.02, 0.05, 0.1):
        values = []
        for seed in range(records):
            (u, y), (v, z) = (record("S1", Ts, N, 5.0, 2 * seed + k) for k in (0, 1))
            fit = least_squares(basis, Recording(u=u, y=y, Ts=Ts, channels="alpha"), "alpha")
            held_out = Recording(u=v, y=z, Ts=Ts, channels="alpha")
            values.append([nmse(z, fit.model.simulate(held_out)[:, 0])])
        name = f"{1e3 * Ts:g} ms"
        rows[name], spread[name] = mean_and_spread(values)
    return Block(
        "NMSE of five delays with friction (S1, 5 Hz)",
        f"Least squares on {N} samples, evaluated on as many others; mean of {records} pairs of records.",
        ("least squares",),
        rows,
        spread,
        relative=0.03,
    )
