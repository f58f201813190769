"""Simulation of the flexible joint beside C and scipy: time, slopes, and error."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from rotflex_jax.fit.normal_equations import normal_equations
from rotflex_jax.mechanism import Exponential, free_run, simulate
from rotflex_jax.precision import double_precision
from speed import c_reference
from speed.machine import MOTOR, TRUE, Ts, dry, linear, smooth, voltage
from speed.rounds import Case

NANO = 1e-9
FEW = 200
"""Samples for solve_ivp."""


def cases(N: int) -> list[Case]:
    """Values and slopes over N samples."""
    u = voltage(N)
    one = N * NANO
    models = {
        "linear": (linear(), Exponential()),
        "smooth friction with current, order 4": (smooth(True), Exponential(order=4)),
        "smooth friction with current, order 2": (smooth(True), Exponential()),
        "dry friction with current, order 2": (dry(True), Exponential()),
    }
    found = [Case("C -O3, RK4 without current", lambda: c_reference.joint(u, TRUE, Ts), one)]
    for name, (joint, solver) in models.items():
        found.append(Case(f"{name}: value", lambda j=joint, s=solver: simulate(j, u, Ts, solver=s), one))
    joint, solver = models["smooth friction with current, order 2"]
    run, jacobian, sums = _slopes(joint, solver, u)
    found += [
        Case("smooth, order 2: value inside JAX", run, one),
        Case("smooth, order 2: Jacobian by 8, stored", jacobian, one),
        Case("smooth, order 2: J'J and J'e by 8 and 4 first states", sums, one),
        Case(
            "solve_ivp RK45, default tolerance",
            lambda: solve_ivp_run(u[:FEW], TRUE),
            FEW * NANO,
            note="without current",
        ),
        *_control(u),
    ]
    return found


def _control(u: np.ndarray) -> list[Case]:
    try:
        import control
    except ImportError:
        return []
    p = TRUE
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2] = [0, p[2] / p[0], -(p[4] + p[5]) / p[0], p[6] / p[0]]
    A[3] = [0, -p[2] / p[1], 0, -p[6] / p[1]] - A[2]
    B = np.array([[0.0], [0.0], [p[3] / p[0]], [-p[3] / p[0]]])
    system = control.ss(A, B, np.eye(4)[:2], np.zeros((2, 1)))
    t = np.arange(len(u)) * Ts
    return [Case("python-control, linear", lambda: control.forced_response(system, t, u), len(u) * NANO)]


def _slopes(joint: Any, solver: Any, u: np.ndarray) -> tuple[Any, Any, Any]:
    """The run, its stored Jacobian and its normal equations, each compiled."""
    free = np.array([joint.parameter_names.index(n) for n in joint.free_names])
    with double_precision():
        values, U, T = jnp.asarray(joint.values), jnp.asarray(u), jnp.asarray(Ts)
        gates, x0 = jnp.ones(len(joint.effects)), jnp.zeros(5)
        ways = jnp.eye(len(values))[free]
        recording = (U, jnp.zeros((len(u), 2)), jnp.ones(len(u)), T)

        def out(z: jax.Array) -> jax.Array:
            return free_run(joint.structure, solver, values.at[free].set(z), gates, x0, U, T)[1]

        def sums(values: jax.Array) -> Any:
            return normal_equations(
                joint.structure, solver, values, ways, x0[:4], recording, jnp.asarray([0.1, 0.01])
            )

        calls = [
            (jax.jit(out), values[free]),
            (jax.jit(jax.jacfwd(out)), values[free]),
            (jax.jit(sums), values),
        ]

    def called(f: Any, x: jax.Array) -> Any:
        def call() -> None:
            with double_precision():
                jax.block_until_ready(f(x))

        return call

    first, second, third = (called(f, x) for f, x in calls)
    return first, second, third


def solve_ivp_run(u: np.ndarray, p: np.ndarray, **options: Any) -> np.ndarray:
    """Angles (N, 2) by scipy's solver, started anew at every step of the voltage."""

    def flow(_: float, x: np.ndarray, v: float) -> list[float]:
        spring = p[2] * x[1] + p[7] * x[1] ** 3 + p[6] * x[3]
        hub = p[3] * v - (p[4] + p[5]) * x[2] - p[8] * np.tanh(x[2] / p[9])
        faster = (hub + spring) / p[0]
        return [x[2], x[3], faster, -spring / p[1] - faster]

    out, x, at = np.zeros((len(u), 2)), np.zeros(4), 0
    while at < len(u):
        end = at + 1
        while end < len(u) and u[end] == u[at]:
            end += 1
        t = np.arange(end - at + 1) * Ts
        found = solve_ivp(flow, (0, t[-1]), x, t_eval=t, args=(u[at],), **options).y
        out[at:end], x, at = found[:2, :-1].T, found[:, -1], end
    return out


def errors() -> dict[str, float]:
    """Relative error of the deflection against many small steps, each with its own physics."""
    u = voltage(4000)
    fine = c_reference.joint_current(u, TRUE, MOTOR, Ts, 200)[:, 1]
    without = c_reference.joint(u, TRUE, Ts, 100)[:, 1]
    off = lambda got, ref: float(np.sqrt(np.mean((got - ref) ** 2) / np.mean(ref**2)))  # noqa: E731
    found = {}
    for order in (2, 4):
        for substeps in (1, 2):
            got = simulate(smooth(True), u, Ts, solver=Exponential(order=order, substeps=substeps))[:, 1]
            found[f"smooth friction with current, order {order}, {substeps} per sample"] = off(got, fine)
    found["C RK4 without current, 1 per sample, against its own limit"] = off(
        c_reference.joint(u, TRUE, Ts)[:, 1], without
    )
    found["leaving the current out"] = off(without, fine)
    found["solve_ivp, default tolerance, against its own limit"] = off(solve_ivp_run(u, TRUE)[:, 1], without)
    sticking = lambda n: simulate(dry(True), u, Ts, solver=Exponential(substeps=n))[:, 1]  # noqa: E731
    found["dry friction with current, order 2, 1 per sample, against 64"] = off(sticking(1), sticking(64))
    return found
