"""The same tasks by other libraries, each by the fastest way that it offers."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np


@functools.cache
def _numba_lms(memory: int) -> Any:
    import numba

    P = 1 + memory + memory * (memory + 1) // 2

    @numba.njit(fastmath=True)
    def loop(u: np.ndarray, y: np.ndarray, step: np.ndarray) -> np.ndarray:
        x, phi, w, e = np.zeros(memory), np.ones(P), np.zeros(P), np.empty(len(u))
        for n in range(len(u)):
            for i in range(memory - 1, 0, -1):
                x[i] = x[i - 1]
            x[0] = u[n]
            k = 1
            for i in range(memory):
                phi[k] = x[i]
                k += 1
            for i in range(memory):
                for j in range(i, memory):
                    phi[k] = x[i] * x[j]
                    k += 1
            total = 0.0
            for i in range(P):
                total += w[i] * phi[i]
            e[n] = y[n] - total
            for i in range(P):
                w[i] += step[i] * e[n] * phi[i]
        return e

    return loop


def numba_lms(u: np.ndarray, y: np.ndarray, mu: tuple[float, float, float], memory: int) -> np.ndarray:
    """A-priori errors of second-order Volterra LMS by numba, with `fastmath`."""
    step = np.concatenate([[mu[0]], np.full(memory, mu[1]), np.full(memory * (memory + 1) // 2, mu[2])])
    return _numba_lms(memory)(u, y, step)


def padasip_lms(phi: np.ndarray, y: np.ndarray, mu: float) -> np.ndarray:
    """A-priori errors of padasip's LMS on given regressors."""
    import padasip

    return padasip.filters.FilterLMS(n=phi.shape[1], mu=mu, w="zeros").run(y, phi)[1]


def padasip_rls(phi: np.ndarray, y: np.ndarray, lam: float) -> np.ndarray:
    """A-priori errors of padasip's RLS on given regressors."""
    import padasip

    return padasip.filters.FilterRLS(n=phi.shape[1], mu=lam, eps=0.01, w="zeros").run(y, phi)[1]


def diffrax_joint(u: np.ndarray, p: np.ndarray, Ts: float) -> Callable[[], np.ndarray]:
    """Function that simulates the joint without current by diffrax, with one step of Tsit5 per sample."""
    import diffrax
    import jax
    import jax.numpy as jnp

    from rotflex_jax.runtime.xla import double_precision

    def flow(t: Any, x: Any, given: Any) -> Any:
        u, p = given
        v = u[jnp.clip((t / Ts + 1e-6).astype(int), 0, len(u) - 1)]
        spring = p[2] * x[1] + p[7] * x[1] ** 3 + p[6] * x[3]
        faster = (p[3] * v - (p[4] + p[5]) * x[2] - p[8] * jnp.tanh(x[2] / p[9]) + spring) / p[0]
        return jnp.stack([x[2], x[3], faster, -spring / p[1] - faster])

    @jax.jit
    def run(u: Any, p: Any) -> Any:
        t = jnp.arange(len(u)) * Ts
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(flow),  # pyright: ignore[reportArgumentType]
            diffrax.Tsit5(),
            0.0,
            t[-1],
            Ts,
            jnp.zeros(4),
            (u, p),
            saveat=diffrax.SaveAt(ts=t),
            max_steps=len(u) + 8,
        )
        assert found.ys is not None
        return found.ys[:, :2]

    def call() -> np.ndarray:
        with double_precision():
            return np.asarray(run(jnp.asarray(u), jnp.asarray(p)))

    return call


def casadi_joint(u: np.ndarray, p: np.ndarray, Ts: float) -> Callable[[], np.ndarray]:
    """Function that simulates the joint without current by CasADi: classical Runge-Kutta in `mapaccum`."""
    import casadi as ca

    x, v = ca.SX.sym("x", 4), ca.SX.sym("v")  # pyright: ignore[reportArgumentType]

    def flow(x: Any) -> Any:
        spring = p[2] * x[1] + p[7] * x[1] ** 3 + p[6] * x[3]
        faster = (p[3] * v - (p[4] + p[5]) * x[2] - p[8] * ca.tanh(x[2] / p[9]) + spring) / p[0]
        return ca.vertcat(x[2], x[3], faster, -spring / p[1] - faster)

    a = flow(x)
    b = flow(x + Ts / 2 * a)
    c = flow(x + Ts / 2 * b)
    d = flow(x + Ts * c)
    step = ca.Function("step", [x, v], [x + Ts / 6 * (a + 2 * b + 2 * c + d)])
    run = step.mapaccum(len(u))
    # `mapaccum` returns the state after each sample, so the outputs are shifted by one.
    return lambda: np.vstack([np.zeros(2), np.array(run(np.zeros(4), u[None])).T[:-1, :2]])
