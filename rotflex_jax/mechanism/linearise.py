"""The linear part of a mechanism as state space, and the Kalman gain that goes with it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.mechanism.assembly import Equations, Layout, equations
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.precision import double_precision


class StateSpace(NamedTuple):
    """`x' = A x + B u, y = C x`; the state is positions, speeds, then linear states of effects."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray

    def discretise(self, Ts: float) -> tuple[np.ndarray, np.ndarray]:
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
    big = scipy.linalg.expm(np.block([[A, B], [np.zeros((k, n + k))]]) * Ts)
    return big[:n, :n], big[:n, n:]


@kept(static=1)
def _equations(structure: Mechanism, values: jax.Array, gates: jax.Array) -> tuple[jax.Array, ...]:
    return tuple(equations(structure.with_values(values), gates))


def _linear_part(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`A`, `B` and the inverse mass matrix."""
    with double_precision():
        gates = jnp.ones(len(mechanism.effects))
        eq = Equations(*_equations(mechanism.structure, jnp.asarray(mechanism.values), gates))
        return np.asarray(eq.A), np.asarray(eq.B), np.asarray(eq.inverse_mass)


def inverse_mass(mechanism: Mechanism) -> np.ndarray:
    """Inverse of the mass matrix (n, n) of the coordinates."""
    return _linear_part(mechanism)[2]


def linearise(mechanism: Mechanism) -> StateSpace:
    """State space of the linear effects (inertias, springs, dampers, motor); the others are left out.

    A friction or a dead zone has no slope at rest, so the linear model of a joint is the one without.
    """
    layout = Layout.of(mechanism.structure)
    A, B, _ = _linear_part(mechanism)
    C = np.zeros((len(mechanism.channels), layout.linear))
    C[:, : 2 * layout.n] = layout.output_rows
    return StateSpace(A, B, C)


def kalman_gains(
    mechanism: Mechanism,
    intensities: Sequence[Mapping[str, float]],
    noise: np.ndarray,
    Ts: float,
) -> np.ndarray:
    """Steady gains K (Q, n, C) of the linear part under white process torques at some ports.

        x+ = Ad (x + K e) + Bd u,   K = P C' (C P C' + R)^-1,   P from the discrete Riccati equation

    The Riccati equations of all intensities are solved together by doubling (Chu, Fan, Lin and Wang,
    Int. J. Control 77, 2004), each step of which doubles the horizon, until `P C'` rests. That is all that
    the gain has of `P`: a position of which there are sensors of speed only integrates the noise, and its
    variance grows for ever, while its covariance with what the sensors show, and so its gain, has a limit.

    Args:
        mechanism: Its linear part is used.
        intensities: Port -> intensity of the white torque [(N m)^2 s]; all zero gives a zero gain.
        noise: Standard deviation of the sensor noise per channel.
        Ts: Sampling period [s].

    Returns:
        Gains with zero rows for memories.
    """
    layout, ss = Layout.of(mechanism.structure), linearise(mechanism)
    n, size = layout.n, layout.linear
    Minv = inverse_mass(mechanism)
    covariance = {port: _built_up(ss.A, Minv @ np.array(vector), n, Ts) for port, vector in mechanism.ports}
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
        shown = grown @ ss.C.T
        done = np.max(np.abs(shown - P @ ss.C.T)) <= 1e-12 * np.max(np.abs(shown))
        P = grown
        if done:
            break
    gains = np.zeros((len(Q), layout.size, len(ss.C)))
    S = ss.C @ P @ ss.C.T + R
    gains[:, :size] = np.swapaxes(np.linalg.solve(S, ss.C @ P), 1, 2)
    return gains


def _built_up(A: np.ndarray, push: np.ndarray, n: int, Ts: float, doublings: int = 14) -> np.ndarray:
    """Covariance that a white torque of unit intensity builds up over one sample.

    `Q(2 h) = Q(h) + E Q(h) E'` from a Simpson rule over the smallest step: unlike the usual block
    exponential it has no growing mode, so a fast electrical pole does not cost digits.
    """
    g = np.zeros(len(A))
    g[n : 2 * n] = push
    h = Ts / 2**doublings
    half = scipy.linalg.expm(A * (h / 2))
    middle, end = half @ g, half @ half @ g
    Q = h / 6 * (np.outer(g, g) + 4 * np.outer(middle, middle) + np.outer(end, end))
    E = half @ half
    for _ in range(doublings):
        Q, E = Q + E @ Q @ E.T, E @ E
    return Q
