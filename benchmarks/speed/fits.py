"""Times of fits of eight parameters, compared with scipy, numba and optimistix.

Measured are fits from one start, from many starts, and of several recordings together.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from rotflex_jax import Recording, fit, many_starts
from speed import c_reference
from speed.machine import MOVED, TRUE, Ts, smooth, voltage
from speed.rounds import Case

BRIEF, SHOTS = 0.1, 3
"""Length of the recording for the fit with solve_ivp [s], and its largest number of steps."""
SHORT, KEPT = 1.5, 8
"""Staged fit: length of the part to which all starts are fitted [s], and number of starts that are kept."""


@functools.cache
def recording(seconds: float, seed: int = 0) -> Recording:
    """Recording simulated by the C code with eight steps per sample, and with 1 % of noise."""
    u = voltage(round(seconds / Ts), seed)
    y = c_reference.joint(u, TRUE, Ts, substeps=8)
    y = y + 0.01 * np.std(y, axis=0) * np.random.default_rng(seed).standard_normal(y.shape)
    return Recording(u=u, y=y, Ts=Ts)


def start(spread: float, seed: int) -> np.ndarray:
    """Parameters of the machine, with the fitted ones changed at random by up to the share `spread`."""
    p = TRUE.copy()
    p[list(MOVED)] *= 1 + np.random.default_rng(seed).uniform(-spread, spread, len(MOVED))
    return p


@functools.cache
def _numba_joint() -> Any:
    import numba

    @numba.njit(fastmath=True, error_model="numpy")
    def flow(a: float, b: float, c: float, d: float, v: float, p: np.ndarray) -> tuple:
        spring = p[2] * b + p[7] * b * b * b + p[6] * d
        faster = (p[3] * v - (p[4] + p[5]) * c - p[8] * np.tanh(c / p[9]) + spring) / p[0]
        return c, d, faster, -spring / p[1] - faster

    @numba.njit(fastmath=True, error_model="numpy")
    def run(u: np.ndarray, p: np.ndarray, h: float) -> np.ndarray:
        out = np.empty((len(u), 2))
        a = b = c = d = 0.0
        for n in range(len(u)):
            out[n, 0], out[n, 1] = a, b
            v = u[n]
            k0, k1, k2, k3 = flow(a, b, c, d, v, p)
            l0, l1, l2, l3 = flow(a + h / 2 * k0, b + h / 2 * k1, c + h / 2 * k2, d + h / 2 * k3, v, p)
            m0, m1, m2, m3 = flow(a + h / 2 * l0, b + h / 2 * l1, c + h / 2 * l2, d + h / 2 * l3, v, p)
            n0, n1, n2, n3 = flow(a + h * m0, b + h * m1, c + h * m2, d + h * m3, v, p)
            a += h / 6 * (k0 + 2 * l0 + 2 * m0 + n0)
            b += h / 6 * (k1 + 2 * l1 + 2 * m1 + n1)
            c += h / 6 * (k2 + 2 * l2 + 2 * m2 + n2)
            d += h / 6 * (k3 + 2 * l3 + 2 * m3 + n3)
        return out

    return run


def scipy_fit(recordings: list[Recording], p0: np.ndarray) -> Any:
    """Fit of logarithms by scipy's Levenberg-Marquardt (MINPACK): finite differences, runs by numba."""
    scale = [0.01 * np.std(r.y, axis=0) for r in recordings]
    run = _numba_joint()

    def errors(x: np.ndarray) -> np.ndarray:
        p = p0.copy()
        p[list(MOVED)] = np.exp(x)
        with np.errstate(all="ignore"):
            e = [((run(r.u, p, Ts) - r.y) / s).ravel() for r, s in zip(recordings, scale, strict=True)]
        return np.nan_to_num(np.concatenate(e), nan=1e6, posinf=1e6, neginf=-1e6)

    return least_squares(errors, np.log(p0[list(MOVED)]), method="lm")


def solve_ivp_fit(r: Recording, p0: np.ndarray) -> Any:
    """Fit by scipy's least squares, with each run by solve_ivp and steps no longer than a sample."""
    from speed.motion import solve_ivp_run

    scale = 0.01 * np.std(r.y, axis=0)

    def errors(x: np.ndarray) -> np.ndarray:
        p = p0.copy()
        p[list(MOVED)] = np.exp(x)
        return ((solve_ivp_run(r.u, p, max_step=Ts) - r.y) / scale).ravel()

    return least_squares(errors, np.log(p0[list(MOVED)]), method="trf", max_nfev=SHOTS)


def scipy_staged(r: Recording, starts: int, spread: float) -> np.ndarray:
    """Costs of the kept starts: all starts are fitted to the first part, as `many_starts` does it."""
    short = r.slice(0, round(SHORT / Ts))
    firsts = [scipy_fit([short], start(spread, k)) for k in range(starts)]
    best = sorted(firsts, key=lambda f: f.cost)[:KEPT]
    return np.array([scipy_fit([r], _with(np.exp(f.x))).cost for f in best])


def _with(moved: np.ndarray) -> np.ndarray:
    p = TRUE.copy()
    p[list(MOVED)] = moved
    return p


@functools.cache
def _optimistix_step() -> Any:
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    def flow(x: jax.Array, v: jax.Array, p: jax.Array) -> jax.Array:
        spring = p[2] * x[1] + p[7] * x[1] ** 3 + p[6] * x[3]
        faster = (p[3] * v - (p[4] + p[5]) * x[2] - p[8] * jnp.tanh(x[2] / p[9]) + spring) / p[0]
        return jnp.stack([x[2], x[3], faster, -spring / p[1] - faster])

    def errors(x: jax.Array, given: Any) -> jax.Array:
        u, y, scale = given
        p = jnp.asarray(TRUE).at[jnp.asarray(MOVED)].set(jnp.exp(x))

        def turn(s: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
            k = flow(s, v, p)
            a = flow(s + Ts / 2 * k, v, p)
            b = flow(s + Ts / 2 * a, v, p)
            c = flow(s + Ts * b, v, p)
            return s + Ts / 6 * (k + 2 * a + 2 * b + c), s[:2]

        return (jax.lax.scan(turn, jnp.zeros(4), u)[1] - y) / scale

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    return jax.jit(
        lambda x, given: optx.least_squares(errors, solver, x, given, max_steps=100, throw=False).value
    )


def optimistix_fit(r: Recording, p0: np.ndarray) -> np.ndarray:
    """Fit by optimistix's Levenberg-Marquardt, with classical Runge-Kutta from rest."""
    import jax
    import jax.numpy as jnp

    from rotflex_jax.runtime.xla import double_precision

    with double_precision():
        given = tuple(jnp.asarray(a) for a in (r.u, r.y, 0.01 * np.std(r.y, axis=0)))
        return np.asarray(
            jax.block_until_ready(_optimistix_step()(jnp.log(jnp.asarray(p0[list(MOVED)])), given))
        )


def one_start(seconds: float) -> list[Case]:
    """Cases with one fit from start values up to 30 % wrong."""
    r, p0 = recording(seconds), start(0.3, 1)
    joint = smooth(p=p0)
    return [
        Case(
            "one fit: rotflex_jax",
            lambda: many_starts(joint, r, starts=1, short_seconds=None),
            1e-3,
            note="and four first states",
        ),
        Case("one fit: scipy + numba", lambda: scipy_fit([r], p0), 1e-3),
        Case("one fit: rotflex_jax fit, with intervals", lambda: fit(joint, r), 1e-3),
        Case("one fit: optimistix", lambda: optimistix_fit(r, p0), 1e-3),
        Case(
            "one fit: scipy + solve_ivp",
            lambda: solve_ivp_fit(r.slice(0, round(BRIEF / Ts)), p0),
            1e-3 * BRIEF / seconds,
            once=True,
            note=f"measured on {BRIEF:g} s, time in proportion; {SHOTS} steps of which it needs more",
        ),
    ]


def joint_fit(count: int, seconds: float) -> list[Case]:
    """Cases with a fit of common parameters to several recordings."""
    several = [recording(seconds, seed) for seed in range(count)]
    p0 = start(0.3, 1)
    joint = smooth(p=p0)
    return [
        Case(
            f"{count} recordings: rotflex_jax",
            lambda: many_starts(joint, several, starts=1, short_seconds=None),
            1e-3,
            note="and their first states",
        ),
        Case(f"{count} recordings: scipy + numba", lambda: scipy_fit(several, p0), 1e-3),
    ]


def many(starts: int, seconds: float) -> tuple[list[Case], dict[str, Any]]:
    """Cases with staged fits from starts up to 70 % wrong.

    When the cases have run, the returned dictionary has the shares of kept starts that reach the least cost.
    """
    r, reached = recording(seconds), {}

    def ours() -> None:
        found = many_starts(smooth(), r, starts=starts, spread=0.7, short_seconds=SHORT, keep=KEPT)
        reached["rotflex_jax, share of kept starts at the least cost"] = found.share

    def scipys() -> None:
        costs = scipy_staged(r, starts, 0.7)
        reached["scipy + numba, share of kept starts at the least cost"] = float(
            np.mean(costs <= costs.min() * 1.001)
        )

    return [
        Case(f"{starts} starts, staged: rotflex_jax", ours),
        Case(f"{starts} starts, staged: scipy + numba", scipys, once=True),
    ], reached


def quality(seconds: float, starts: int = 8) -> dict[str, float]:
    """Largest excess of the cost over the least cost, for fits from several starts."""
    r = recording(seconds)
    costs = [
        many_starts(smooth(p=start(0.3, k)), r, starts=1, short_seconds=None).cost for k in range(starts)
    ]
    return {"largest excess over the least cost": float(max(costs) / min(costs) - 1)}
