"""2.6, second part: settling times of the weights of LMS, by theory and by simulation."""

from __future__ import annotations

import numpy as np

from rotflex_jax.adaptive import LMS
from rotflex_jax.adaptive.learning_curve import settling_factor, settling_step_size
from rotflex_jax.adaptive.moments import Moments, ar1_covariance
from rotflex_jax.adaptive.step_sizes import mean_square_bound
from rotflex_jax.basis import Delays, Volterra
from seed_paper.blocks import Block
from seed_paper.learning import EVERY, paths
from seed_paper.records import record

MEMORY = 5
ITERATIONS = 7000
MU1 = 0.01
"""Step size of constant and linear weights."""


def moments(a: float, *degrees: int) -> Moments:
    """Moments of the regressors of these degrees, for five delays of first-order noise."""
    return Moments.gaussian(ar1_covariance(a, MEMORY), degrees)


def power_of_ten(x: float) -> str:
    """A number in a form such as 4.3e-4."""
    return f"{x:.1e}".replace(".0", "").replace("e-0", "e-")


def theory() -> Block:
    """Step sizes by the theory of the mean: ln 20 / (eigenvalue times samples)."""
    rows = {
        "mu = 1, products of unlike lags": (settling_step_size(1, ITERATIONS),),
        "mu = 2, differences of squares": (settling_step_size(2, ITERATIONS),),
        "mu = 7, sum of squares": (settling_step_size(7, ITERATIONS),),
    }
    return Block(
        "Step sizes that settle to 5 % at 7000 samples, white input",
        "By the eigenvalue of the covariance of the regressors.",
        ("step size",),
        rows,
        absolute=5.1e-7,
    )


def unlike_products(basis: Volterra) -> np.ndarray:
    """Mask of the weights of products of two different delays."""
    return np.array([len(i) == 2 and i[0] != i[1] for i in basis.indices])


def measured(quick: bool) -> Block:
    """Settling time of the largest coefficient of a product of different lags, from its mean over runs."""
    runs = 4 if quick else 32
    basis = Volterra(Delays(MEMORY, first=0), order=2)
    cases = {2.1e-4: 25_000, 4.3e-4: 12_000, 1e-3: 6_000, 3e-3: 2_000}
    if quick:
        cases = {mu2: N // 5 for mu2, N in cases.items()}
    seen = [record("S5s", 0.1, max(cases.values()) + 10, None, seed) for seed in range(runs)]
    phi, y = np.array([basis.regressors(u)[10:] for u, _ in seen]), np.array([y[10:] for _, y in seen])
    best = np.linalg.lstsq(phi.reshape(-1, basis.size), y.ravel(), rcond=None)[0]
    k = int(np.argmax(np.abs(np.where(unlike_products(basis), best, 0))))
    shares = (1 - np.exp(-1), 0.95)
    rows, spread = {}, {}
    for mu2, N in cases.items():
        mu = np.asarray(basis.step_sizes({0: MU1, 1: MU1, 2: mu2}))
        path = paths(LMS(mu=mu), phi[:, :N], y[:, :N])[:, :, k] / best[k]
        name = power_of_ten(mu2)
        rows[name] = (
            *(crossing(path.mean(axis=0), share) for share in shares),
            *(-np.log(1 - s) / mu2 for s in shares),
        )
        singles = [[crossing(one, share) for one in path] for share in shares]
        spread[name] = (
            *(float(np.std([x for x in s if x])) if any(s) else None for s in singles),
            None,
            None,
        )
    return Block(
        "Samples to settle, S5s, 100 ms, white input",
        f"Rows: step size of the quadratic weights, {MU1:g} of the others. The largest coefficient of a "
        f"product of unlike lags: its mean over {runs} runs, and mean theory for the eigenvalue 1.",
        ("63 %", "95 %", "63 %, theory", "95 %, theory"),
        rows,
        spread,
        relative=0.1,
    )


def crossing(path: np.ndarray, share: float) -> float | None:
    """Samples until a weight, as a share of its best value, first reaches `share`; None if it never does."""
    there = path >= share
    return float(EVERY * (np.argmax(there) + 1)) if there.any() else None


def of_s6(N: int, records: int) -> Block:
    """Step size with which the largest quadratic coefficient of S6 settles, by the theory of the mean."""
    basis = Volterra(Delays(MEMORY, first=0), order=2)
    quadratic = basis.degrees == 2
    direction = np.where(quadratic, 1e-4, MU1)
    rows, spread = {}, {}
    for fc, Ts in [(fc, Ts) for fc in (None, 10.0, 5.0, 2.0) for Ts in (0.1, 0.05, 0.02, 0.01, 0.005)]:
        a = np.exp(-2 * np.pi * fc * Ts) if fc else 0.0
        exact, bound = moments(a, 0, 1, 2), mean_square_bound(moments(a, 2))
        first, found = round(1 / Ts), []
        for seed in range(3 * records if fc and Ts == 0.02 else records):
            u, y = record("S6", Ts, N, fc, seed)
            best = np.linalg.lstsq(basis.regressors(u)[first:], y[first:], rcond=None)[0]
            k = int(np.argmax(np.abs(np.where(quadratic, best, 0))))
            factor = settling_factor(exact, direction, best, k, ITERATIONS, scaled=quadratic)
            found.append(1e-4 * factor)
        name = f"{f'{fc:g} Hz' if fc else 'white'}, {1e3 * Ts:g} ms"
        middle = float(np.median(found))
        rows[name] = (middle, float(np.min(found)), float(np.max(found)), bound, middle / bound)
        spread[name] = (float(np.std([x for x in found if np.isfinite(x)] or [0.0])), *(None,) * 4)
    lost = (
        "five delays leave half of the deflection unexplained: each record has another largest coefficient."
    )
    return Block(
        "Step size at which the largest quadratic coefficient of S6 settles at 7000",
        f"Mean theory, {MU1:g} for constant and linear weights, best weights by least squares from {N} "
        f"samples; median, least and largest of {records} records (coloured input at 20 ms: {3 * records}). "
        f"Above a third of the bound no delay line is stable. At 20 ms and below, {lost}",
        ("step size", "least", "largest", "mean-square bound", "share of the bound"),
        rows,
        spread,
        relative=0.1,
        notes={name: lost for name in rows if name.split(", ")[1] in ("20 ms", "10 ms", "5 ms")},
    )
