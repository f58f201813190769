"""Times of adaptive filters over a second-order Volterra series, compared with C, numba and padasip."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax import Recording
from rotflex_jax.adaptive import LMS, RLS, grid, run
from rotflex_jax.adaptive.objectives import RangeTransform, evaluate, tuning_data, values_at
from rotflex_jax.adaptive.tuning import loss_and_slopes
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.runtime.xla import double_precision, mesh_of
from speed import c_reference, peers
from speed.rounds import Case

NANO = 1e-9
PYTHON_LOOP = 7000
"""Number of samples for libraries that loop in Python."""


def record(N: int) -> tuple[np.ndarray, np.ndarray]:
    """A coloured input, and an output of a quadratic system with noise."""
    rng = np.random.default_rng(3)
    z = rng.standard_normal(N + 1)
    u = 0.8 * z[1:] + 0.6 * z[:-1]
    y = u + 0.5 * np.concatenate([[0.0], u[:-1]]) + 0.2 * u**2 + 0.1 * rng.standard_normal(N)
    return u, y


def step_sizes(memory: int) -> tuple[float, float, float]:
    """Step sizes for the degrees 0, 1 and 2, far below the limit of stability."""
    return 2e-3, 5e-3 / memory, 5e-3 / memory**2


def lms_cases(memory: int, N: int) -> list[Case]:
    """Cases with one run of LMS over N samples."""
    u, y = record(N)
    sizes, basis = step_sizes(memory), Volterra(Delays(memory))
    filter = LMS(basis.step_sizes(dict(enumerate(sizes))))
    name = f"LMS M={memory}"
    cases = [
        Case(f"{name}: rotflex_jax", lambda: run(filter, u, y, basis=basis), N * NANO),
        Case(f"{name}: C -O3", lambda: c_reference.lms(u, y, sizes, memory), N * NANO),
        Case(
            f"{name}: C -O3 -ffast-math",
            lambda: c_reference.lms(u, y, sizes, memory, c_reference.FAST_MATH),
            N * NANO,
        ),
    ]
    if memory == 5:
        short = basis.regressors(u[:PYTHON_LOOP])
        phi = basis.regressors(u[: min(N, 100_000)])
        cases += [
            Case(f"{name}: numba", lambda: peers.numba_lms(u, y, sizes, memory), N * NANO),
            Case(
                f"{name}: rotflex_jax, regressors given",
                lambda: run(filter, phi, y[: len(phi)]),
                len(phi) * NANO,
            ),
            Case(
                f"{name}: padasip",
                lambda: peers.padasip_lms(short, y[:PYTHON_LOOP], sizes[1]),
                PYTHON_LOOP * NANO,
                note="one step size, regressors given",
            ),
        ]
    return cases


def rls_cases(memory: int, N: int) -> list[Case]:
    """Cases with one run of RLS over N samples."""
    u, y = record(N)
    basis, filter = Volterra(Delays(memory)), RLS(0.9999, 100.0)
    name = f"RLS {basis.size} weights"
    cases = [
        Case(f"{name}: rotflex_jax", lambda: run(filter, u, y, basis=basis), N * NANO),
        Case(f"{name}: C -O3", lambda: c_reference.rls(u, y, 0.9999, 100.0, memory), N * NANO),
    ]
    if memory == 5:
        few = 2000
        phi = basis.regressors(u[:few])
        cases.append(Case(f"{name}: padasip", lambda: peers.padasip_rls(phi, y[:few], 0.9999), few * NANO))
    return cases


@jax.jit
def _value(filter: LMS, data: Any) -> Any:
    return evaluate(data, "mean_error", filter)


def _sized(basis: Volterra, s: dict[str, Any]) -> LMS:
    return LMS(basis.step_sizes({0: s["quadratic"], 1: s["linear"], 2: s["quadratic"]}))


@functools.cache
def _build(memory: int) -> Any:
    return functools.partial(_sized, Volterra(Delays(memory)))


def pairs_cases(N: int) -> list[Case]:
    """Cases with a grid of 100 pairs of step sizes, and with value and gradient for one pair."""
    u, y = record(N)
    recording = Recording(u=u, y=y, Ts=0.001, channels="alpha")
    basis = Volterra(Delays(5))
    axes = {"linear": np.geomspace(1e-4, 3e-3, 10), "quadratic": np.geomspace(1e-5, 5e-4, 10)}
    both = np.array([(a, b) for a in axes["linear"] for b in axes["quadratic"]]).T
    mu = np.stack([both[1], both[0], both[1]])
    lanes = c_reference.LANES * N * NANO
    searched = lambda axes: grid(_build(5), axes, basis, [recording], "alpha", objective="mean_error")  # noqa: E731
    with double_precision():
        data = tuning_data(basis, [recording], "alpha", "mean_error")
        curve = RangeTransform(("linear", "quadratic"), ((0.0, float("inf")),) * 2)
        point = jnp.asarray(np.log([[1e-3, 1e-4]]))

    def slopes() -> None:
        with double_precision():
            found = loss_and_slopes(point, data, curve=curve, build=_build(5), objective="mean_error")
            jax.block_until_ready(found)

    def value() -> None:
        with double_precision():
            filter = _build(5)({"linear": 1e-3, "quadratic": 1e-4})
            jax.block_until_ready(_value(filter, data))

    def swept() -> None:
        with double_precision():
            names = ("linear", "quadratic")
            points = jnp.asarray(both.T)
            found = values_at(points, data, names=names, build=_build(5), objective="mean_error")
            jax.block_until_ready(found)

    return [
        Case("100 pairs: rotflex_jax, the sweep alone", swept, lanes),
        Case(
            "100 pairs: rotflex_jax grid", lambda: searched(axes), lanes, note="with the theory of its bounds"
        ),
        Case("100 pairs: C -O3 over lanes", lambda: c_reference.lms_lanes(u, y, mu, 5), lanes),
        Case("1 pair: rotflex_jax value", value, N * NANO),
        Case("1 pair: rotflex_jax value and gradient", slopes, N * NANO),
    ]


def sweep(N: int) -> Callable[[], None]:
    """Function that runs LMS for 2000 pairs of step sizes, divided among all devices of the process."""
    u, y = record(N)
    basis = Volterra(Delays(5))
    axes = np.geomspace(1e-4, 3e-3, 40), np.geomspace(1e-5, 5e-4, 50)
    points = np.array(np.meshgrid(*axes)).reshape(2, -1).T
    names, mesh = ("linear", "quadratic"), mesh_of()
    with double_precision():
        data = tuning_data(basis, [Recording(u=u, y=y, Ts=0.001, channels="alpha")], "alpha", "mean_error")

    def run() -> None:
        with double_precision():
            here = {"names": names, "build": _build(5), "objective": "mean_error", "mesh": mesh}
            jax.block_until_ready(values_at(jnp.asarray(points), data, **here))

    return run
