"""The linear part of a mechanism as a state-space model, names of its states, and its steady Kalman gain."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy
from jax.core import Tracer
from jaxtyping import Float

from rotflex_jax.effects.base import Linear
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.assembly import EquationsOfMotion, Layout, effects_of, equations, own_states
from rotflex_jax.mechanism.mechanism import Mechanism, check_mechanism
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision


def check_movable(mechanism: Mechanism) -> None:
    """Raise `InputError` if a coordinate of a complete mechanism has no inertia, or if JAX traces a value."""
    if any(isinstance(value, Tracer) for e in mechanism.effects for value in e.values.values()):
        raise InputError(
            "The mechanism has parameter values that JAX traces, but numbers are needed here; inside of "
            "jax.jit or jax.grad use rotflex_jax.mechanism.free_run, or give numbers."
        )
    n = len(mechanism.coordinates)
    linear = [(e.stamp(), e.at) for _, e in effects_of(mechanism, Linear)]
    rows = [np.sqrt(abs(float(s.inertia))) * np.array(mechanism.port_vectors[at]) for s, at in linear]
    free = np.abs(scipy.linalg.null_space(np.array(rows).reshape(-1, n), rcond=1e-9)).sum(axis=1) > 1e-6
    if not free.any():
        return
    still = " and ".join(q for q, f in zip(mechanism.coordinates, free, strict=True) if f)
    ports = ", ".join(name for name, vector in mechanism.ports if np.any(np.array(vector)[free] != 0))
    raise InputError(
        f"Nothing gives {still} an inertia, so any torque would move it at once; put an Inertia at a port "
        f"that moves it ({ports or 'add one first'})."
    )


def state_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Names of the states in order: positions, speeds, states of linear effects and gears, memories.

    >>> from rotflex_jax.effects import LuGre, Motor
    >>> state_names(Mechanism(("a",), {"shaft": (1,)}, [Motor("shaft", inductance=1e-3), LuGre("shaft")]))
    ('a', 'd(a)/dt', 'shaft.motor[0]', 'shaft.lugre[0]')
    """
    moving = [*mechanism.coordinates, *(f"d({q})/dt" for q in mechanism.coordinates)]
    for i, rows in own_states(mechanism).items():
        e = mechanism.effects[i]
        moving += [f"{e.at}.{e.name}[{k}]" for k in range(len(rows))]
    return tuple(moving)


def output_units(mechanism: Mechanism) -> dict[str, str]:
    """Channel -> unit of its reading.

    >>> output_units(Mechanism(("a",), {"p": (1,)}, outputs={"angle": "p", "tacho": ("p", "speed")}))
    {'angle': 'rad', 'tacho': 'rad/s'}
    """
    units = (quantity.unit(mechanism.units) for quantity in mechanism.quantities)
    return dict(zip(mechanism.channels, units, strict=True))


class StateSpace(NamedTuple):
    """`x' = A x + B u, y = C x`; the state is positions, speeds, then linear states of effects."""

    A: Float[np.ndarray, "m m"]
    B: Float[np.ndarray, " m"]
    C: Float[np.ndarray, "C m"]

    def discretise(self, Ts: float) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """`(Ad, Bd)` for an input held over `Ts` [s]; exact."""
        Ad, Bd = zero_order_hold(self.A, self.B[:, None], Ts)
        return Ad, Bd[:, 0]


def zero_order_hold(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, "n k"], Ts: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n k"]]:
    """`x' = A x + B u` from sample to sample, exact for inputs held over `Ts` [s]: `x+ = Ad x + Bd u`.

    Source: C. F. Van Loan, IEEE Trans. Autom. Control 23, 1978 (exponential of a block matrix).

    >>> Ad, Bd = zero_order_hold(np.array([[-1.0]]), np.array([[1.0]]), np.log(2.0))
    >>> print(f"{Ad[0, 0]:.3f} {Bd[0, 0]:.3f}")
    0.500 0.500
    """
    n, k = B.shape
    big = _exponential(np.block([[A, B], [np.zeros((k, n + k))]]) * Ts)
    return big[:n, :n], big[:n, n:]


def _exponential(A: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """`e^A`; NaN where double precision leaves no correct digit of it.

    The relative error grows as `eps |A|` (Moler and Van Loan, SIAM Rev. 45, 2003). Parameters far outside
    their physical ranges give such an `A`. SciPy then returns arbitrary entries, or raises where a pivot
    happens to be zero, which depends on the processor. With NaN the model counts as one that diverges.
    """
    if not np.linalg.norm(A, 1) * np.finfo(float).eps < 1:
        return np.full_like(A, np.nan)
    return scipy.linalg.expm(A)


@persistent_jit(static=1)
def _equations(structure: Mechanism, values: jax.Array, gates: jax.Array) -> tuple[jax.Array, ...]:
    return tuple(equations(structure.with_values(values), gates))


def linear_equations(mechanism: Mechanism, gates: Float[np.ndarray, " E"] | None = None) -> EquationsOfMotion:
    """Equations of motion of the linear effects in double precision, by one program for each structure.

    Args:
        mechanism: Mechanism with its parameter values.
        gates: One factor per effect; all effects are on if None.
    """
    with double_precision():
        gates = np.ones(len(mechanism.effects)) if gates is None else gates
        return EquationsOfMotion(*_equations(mechanism.structure, mechanism.values, gates))


def inverse_mass(mechanism: Mechanism) -> Float[np.ndarray, "n n"]:
    """Inverse of the mass matrix of the coordinates."""
    return np.asarray(linear_equations(mechanism).inverse_mass)


def linearise(mechanism: Mechanism) -> StateSpace:
    """State-space model of the linear effects (inertias, springs, dampers, motor) alone.

    All other effects are left out: dry friction and a dead zone, for instance, have no slope at rest.
    """
    return _linearised(mechanism)[0]


def _linearised(
    mechanism: Mechanism, gates: Float[np.ndarray, " E"] | None = None
) -> tuple[StateSpace, np.ndarray]:
    """State-space model of the linear effects, and the inverse of the mass matrix."""
    check_mechanism(mechanism)
    check_movable(mechanism)
    layout = Layout.of(mechanism.structure)
    A, B, _, Minv = map(np.asarray, linear_equations(mechanism, gates))
    C = np.zeros((len(mechanism.channels), layout.linear))
    C[:, : 2 * layout.n] = layout.output_rows
    return StateSpace(A, B, C), Minv


def kalman_gains(
    mechanism: Mechanism,
    intensities: Sequence[Mapping[str, float]],
    noise: Float[np.ndarray, " C"] | Sequence[float],
    Ts: float,
    gates: Float[np.ndarray, " E"] | None = None,
) -> Float[np.ndarray, "Q n C"]:
    """Steady Kalman gains of the linear part under process noise (white torques) at some ports.

        x+ = Ad (x + K e) + Bd u,   K = P C' (C P C' + R)^-1,   P from the discrete Riccati equation

    The Riccati equations of all intensities are solved together by doubling (Chu, Fan, Lin and Wang,
    Int. J. Control 77, 2004), each step of which doubles the horizon, until `P C'` converges. The gain
    depends on `P` through this product only: a position that is measured by speed sensors alone integrates
    the noise, so its variance grows without bound, while its covariance with the outputs has a limit.

    Args:
        mechanism: Only its linear part is used.
        intensities: For each gain: port -> intensity of the white torque [(N m)^2 s]; all zero gives a zero
            gain.
        noise: Standard deviation of the sensor noise of each channel.
        Ts: Sampling period [s].
        gates: Factor of each effect, 0 where it is switched off; None for all on.

    Returns:
        One gain for each of the `intensities`, with zero rows for the states of memories.
    """
    layout, (ss, Minv) = Layout.of(mechanism.structure), _linearised(mechanism, gates)
    n, size = layout.n, layout.linear
    names, vectors = zip(*mechanism.ports, strict=True)
    covariances = process_covariance(ss.A, np.array(vectors) @ Minv.T, n, Ts)
    covariance = dict(zip(names, covariances, strict=True))
    Ad, _ = ss.discretise(Ts)
    Q = np.array(
        [sum((q * covariance[p] for p, q in i.items()), np.zeros((size, size))) for i in intensities]
    )
    R = np.diag(np.square(noise))
    A = np.broadcast_to(Ad.T, Q.shape)
    G = np.broadcast_to(ss.C.T @ np.linalg.inv(R) @ ss.C, Q.shape)
    P, eye = Q, np.eye(size)
    for _ in range(60):
        W = np.linalg.inv(eye + G @ P)
        At = np.swapaxes(A, 1, 2)
        grown = P + At @ P @ W @ A
        A, G = A @ W @ A, G + A @ W @ G @ At
        grown = (grown + np.swapaxes(grown, 1, 2)) / 2
        PC = grown @ ss.C.T
        done = np.max(np.abs(PC - P @ ss.C.T)) <= 1e-12 * np.max(np.abs(PC))
        P = grown
        if done:
            break
    gains = np.zeros((len(Q), layout.size, len(ss.C)))
    S = ss.C @ P @ ss.C.T + R
    gains[:, :size] = np.swapaxes(np.linalg.solve(S, ss.C @ P), 1, 2)
    return gains


NOISE_DOUBLINGS = 14
"""How often the sampling period is halved for the first step, and the step then doubled again."""


def process_covariance(
    A: Float[np.ndarray, "m m"], push: Float[np.ndarray, "*batch n"], n: int, Ts: float
) -> Float[np.ndarray, "*batch m m"]:
    """Covariance of the state after one sample of a white torque of unit intensity, for several torques.

    `Q(2 h) = Q(h) + E Q(h) E'` from a Simpson rule over the smallest step; this has, in contrast to the
    usual block exponential, no growing mode, so a fast electrical pole costs no accuracy.

    Args:
        A: State matrix.
        push: Acceleration of the coordinates by a unit torque, for each torque.
        n: Number of coordinates; their speeds are the states n to 2 n - 1.
        Ts: Sampling period [s].
    """
    g = np.zeros((*np.shape(push)[:-1], len(A)))
    g[..., n : 2 * n] = push
    h = Ts / 2**NOISE_DOUBLINGS
    half = _exponential(A * (h / 2))
    E = half @ half
    outer = lambda g: g[..., :, None] * g[..., None, :]  # noqa: E731
    Q = h / 6 * (outer(g) + 4 * outer(g @ half.T) + outer(g @ E.T))
    for _ in range(NOISE_DOUBLINGS):
        Q, E = Q + E @ Q @ E.T, E @ E
    return Q
