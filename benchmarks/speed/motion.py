"""Simulation of the flexible joint, compared with C and other libraries: times, derivatives and errors."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from rotflex_jax.fit.problem import directions, normal_equations
from rotflex_jax.mechanism import Exponential, free_run, simulate
from rotflex_jax.mechanism.sensitivities import RecordingSamples, RunParameters, outputs_with_sensitivities
from rotflex_jax.runtime.xla import double_precision
from speed import c_reference, peers
from speed.machine import MOTOR, TRUE, Ts, dry, linear, multisine, smooth, voltage
from speed.rounds import Case

NANO = 1e-9
FEW = 200
"""Number of samples for solve_ivp."""
PYTHON_LOOP = 2000
"""Number of samples for CasADi, which evaluates expression by expression."""


def cases(N: int) -> list[Case]:
    """Cases with simulations and derivatives over N samples."""
    u = voltage(N)
    one = N * NANO
    models = {
        "smooth friction with current, order 4": (smooth(True), Exponential(order=4)),
        "smooth friction with current, order 2": (smooth(True), Exponential()),
        "dry friction with current, order 2": (dry(True), Exponential()),
    }
    found = [Case("C -O3, RK4 without current", lambda: c_reference.joint(u, TRUE, Ts), one)]
    for name, (joint, solver) in models.items():
        found.append(Case(f"{name}: value", lambda j=joint, s=solver: simulate(j, u, Ts, solver=s), one))
    long, straight = voltage(5 * N), linear()
    found.append(
        Case(
            "linear, blocks: value", lambda: simulate(straight, long, Ts), 5 * one, note=f"{5 * N:,} samples"
        )
    )
    names = {"smooth": "smooth friction with current, order 2", "dry": "dry friction with current, order 2"}
    for short, name in names.items():
        run, carried, stored, sums = _slopes(*models[name], u)
        found += [
            Case(f"{short}, order 2: value inside JAX", run, one),
            Case(f"{short}, order 2: value and Jacobian by 8, carried", carried, one),
            Case(f"{short}, order 2: J'J and J'e by 8 and 4 first states", sums, one),
        ]
        if short == "smooth":
            found.append(Case(f"{short}, order 2: Jacobian by 8, stored", stored, one))
    found += [
        Case(
            "diffrax, Tsit5, a step per sample", peers.diffrax_joint(u, TRUE, Ts), one, note="without current"
        ),
        Case(
            "CasADi, RK4 by mapaccum",
            peers.casadi_joint(u[:PYTHON_LOOP], TRUE, Ts),
            PYTHON_LOOP * NANO,
            note="without current",
        ),
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


def _slopes(joint: Any, solver: Any, u: np.ndarray) -> tuple[Any, Any, Any, Any]:
    """Functions, each compiled, for a run and its derivatives.

    In order: the run; its Jacobian by sensitivities that are carried along; its Jacobian by forward-mode
    differentiation; its normal equations.
    """
    names = joint.parameter_names
    eight = np.array([names.index(n) for n in names if n in joint.free_names][-8:])
    structure = joint.structure
    with double_precision():
        values, U, T = jnp.asarray(joint.values), jnp.asarray(u), jnp.asarray(Ts)
        gates, x0 = jnp.ones(len(joint.effects)), jnp.zeros(5)
        samples = RecordingSamples(U, jnp.zeros((len(u), 2)), jnp.ones(len(u)), T)
        one = jnp.ones(len(values))

        def out(z: jax.Array) -> jax.Array:
            return free_run(structure, solver, values.at[eight].set(z), gates, x0, U, T)[1]

        def carried(values: jax.Array) -> Any:
            ways = directions(structure, one, jnp.asarray(eight), 0)
            return outputs_with_sensitivities(
                structure, solver, RunParameters(values, gates, x0, None), ways, samples
            )

        def sums(values: jax.Array) -> Any:
            ways, scale = directions(structure, one, jnp.asarray(eight), 4), jnp.asarray([0.1, 0.01])
            numbers = RunParameters(values, gates, x0, None)
            return normal_equations(structure, solver, numbers, ways, samples, scale)

        calls = [
            (jax.jit(out), values[eight]),
            (jax.jit(carried), values),
            (jax.jit(jax.jacfwd(out)), values[eight]),
            (jax.jit(sums), values),
        ]

    def called(f: Any, x: jax.Array) -> Any:
        def call() -> None:
            with double_precision():
                jax.block_until_ready(f(x))

        return call

    first, second, third, fourth = (called(f, x) for f, x in calls)
    return first, second, third, fourth


def solve_ivp_run(u: np.ndarray, p: np.ndarray, **options: Any) -> np.ndarray:
    """Angles (N, 2) by scipy's solve_ivp, which is restarted at every step of the voltage."""

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
    """Relative errors of the deflection against simulations with many small steps.

    The references have the same physics, except that "leaving the current out" compares two models.
    """
    found: dict[str, float] = {}
    for name, u in {"steps of 6 V": voltage(4000), "multisine of 3 V": multisine(4000)}.items():
        found |= {f"{name}: {what}": error for what, error in _errors(u).items()}
    u = voltage(4000)
    found["solve_ivp, default tolerance, against its own limit"] = _off(
        solve_ivp_run(u, TRUE)[:, 1], c_reference.joint(u, TRUE, Ts, 100)[:, 1]
    )
    sticking = lambda n: simulate(dry(True), u, Ts, solver=Exponential(substeps=n))[:, 1]  # noqa: E731
    found["dry friction with current, order 2, 1 per sample, against 64"] = _off(sticking(1), sticking(64))
    return found


def _off(got: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((got - truth) ** 2) / np.mean(truth**2)))


def _errors(u: np.ndarray) -> dict[str, float]:
    fine = c_reference.joint_current(u, TRUE, MOTOR, Ts, 200)[:, 1]
    without = c_reference.joint(u, TRUE, Ts, 100)[:, 1]
    found = {}
    for order in (2, 4):
        for substeps in (1, 2):
            got = simulate(smooth(True), u, Ts, solver=Exponential(order=order, substeps=substeps))[:, 1]
            found[f"smooth friction with current, order {order}, {substeps} per sample"] = _off(got, fine)
    found["C RK4 without current, 1 per sample, against its own limit"] = _off(
        c_reference.joint(u, TRUE, Ts)[:, 1], without
    )
    found["leaving the current out"] = _off(without, fine)
    return found
