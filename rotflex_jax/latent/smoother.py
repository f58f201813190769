"""Kalman filter and fixed-interval smoother of a mechanism with unknown torques as states.

    s[k+1] = A[k] s[k] + c[k] + w,   y[k] = H[k] s[k] + g[k] + v

The channels of a sample are processed one after the other, so that no matrix is inverted. Covariances are
updated in Joseph's form. The backward pass is the smoother of Bryson and Frazier. It equals the smoother of
Rauch, Tung and Striebel where that exists, and also holds if the process noise is singular, as it is here.

Source: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapters 2 and 10.
"""

import dataclasses
import itertools
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.effects.base import Force, Scalar
from rotflex_jax.fit.dataset import StackedRecordings
from rotflex_jax.mechanism import Mechanism, Solver, predictor_run
from rotflex_jax.mechanism.assembly import motor_inputs
from rotflex_jax.mechanism.scan import state_jacobians
from rotflex_jax.mechanism.simulate import read_outputs
from rotflex_jax.mechanism.small_matrices import expand_axes
from rotflex_jax.parameters import parameter
from rotflex_jax.runtime.persistent_jit import persistent_jit


class LinearTimeVaryingModel(NamedTuple):
    """A linear model along one recording, along several, or at one sample.

    Attributes:
        A: Transition matrices.
        c: Constant parts of the transitions.
        H: Output matrices.
        y: Measured outputs less their constant parts.
        seen: One where a sample counts.
    """

    A: Float[Array, "*batch m m"]
    c: Float[Array, "*batch m"]
    H: Float[Array, "*batch C m"]
    y: Float[Array, "*batch C"]
    seen: Float[Array, "*batch"]


class InitialDistribution(NamedTuple):
    """Mean and variances of the first state, of one recording or of several."""

    mean: Float[Array | np.ndarray, "*batch m"]
    variance: Float[Array | np.ndarray, "*batch m"]


class _ChannelUpdate(NamedTuple):
    """Gain, innovation and its variance of one channel, for the backward pass."""

    gain: jax.Array
    e: jax.Array
    S: jax.Array


def _product(A: jax.Array, B: jax.Array) -> jax.Array:
    """`A @ B` as a sum of products, which the compiler fuses into the loop. `B` may have more axes behind."""
    return jnp.sum(expand_axes(A[:, :, None], B[None]) * B[None], axis=1)


def _times(A: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.sum(expand_axes(A, x[None]) * x[None], axis=1)


def _measurement_update(
    m: jax.Array, P: jax.Array, H: jax.Array, y: jax.Array, seen: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, list[_ChannelUpdate]]:
    """Mean and covariance after the update with the channels of one sample."""
    updates = []
    for c in range(H.shape[0]):
        h, r = expand_axes(H[c], m), noise[c] ** 2
        Ph = _times(P, h)
        S = jnp.sum(h * Ph, axis=0) + r
        K = seen * Ph / S[None]
        e = y[c] - jnp.sum(h * m, axis=0)
        m = m + K * e[None]
        half = P - K[:, None] * Ph[None]
        P = half - _times(half, h)[:, None] * K[None] + r * K[:, None] * K[None]
        updates.append(_ChannelUpdate(K, e, S))
    return m, (P + jnp.swapaxes(P, 0, 1)) / 2, updates


def _time_update(
    m: jax.Array, P: jax.Array, A: jax.Array, c: jax.Array, Q: jax.Array
) -> tuple[jax.Array, jax.Array]:
    P = _product(A, jnp.swapaxes(_product(A, P), 0, 1))
    added = expand_axes(jnp.eye(len(Q), dtype=Q.dtype), Q[None]) * Q[None]
    return _times(A, m) + expand_axes(c, m), (P + jnp.swapaxes(P, 0, 1)) / 2 + added


def log_likelihood(
    model: LinearTimeVaryingModel,
    start: InitialDistribution,
    noise: Float[Array, " C"],
    Q: Float[Array, "m *sets"],
) -> Float[Array, "*sets"]:
    """Log-likelihood of one recording [nat], for one or several sets of intensities of the process noise.

    The sets are the last axes, which vector units process together.

    Args:
        model: Linear model along the recording.
        start: Distribution of the first state.
        noise: Standard deviation of the sensor noise of each channel.
        Q: Variance that the process noise adds to each state per sample.
    """

    def step(carry: Any, row: LinearTimeVaryingModel) -> Any:
        m, P, total = carry
        m, P, updates = _measurement_update(m, P, row.H, row.y, row.seen, noise)
        density = sum(jnp.log(2 * jnp.pi * u.S) + u.e**2 / u.S for u in updates)
        return (*_time_update(m, P, row.A, row.c, Q), total - 0.5 * row.seen * density), None

    P = expand_axes(jnp.diag(start.variance), Q[None])
    first = (
        jnp.broadcast_to(expand_axes(jnp.asarray(start.mean), Q), Q.shape),
        jnp.broadcast_to(P, (len(Q), *Q.shape)),
        jnp.zeros(Q.shape[1:], Q.dtype),
    )
    return jax.lax.scan(step, first, model)[0][2]


def fixed_interval_smoother(
    model: LinearTimeVaryingModel,
    start: InitialDistribution,
    noise: Float[Array, " C"],
    Q: Float[Array, " m"],
) -> tuple[Float[Array, "N m"], Float[Array, "N m"]]:
    """Mean and variance of the states given the whole recording; arguments as in `log_likelihood`."""

    def forward(carry: Any, row: LinearTimeVaryingModel) -> Any:
        m, P = carry
        m1, P1, updates = _measurement_update(m, P, row.H, row.y, row.seen, noise)
        return _time_update(m1, P1, row.A, row.c, Q), (m, P, updates)

    _, filtered = jax.lax.scan(forward, (start.mean, jnp.diag(start.variance)), model)

    def backward(carry: Any, row: Any) -> Any:
        # Gradient and curvature of the negative log-likelihood of all later samples, by the state.
        gradient, curvature = carry
        at, (m, P, updates) = row
        gradient, curvature = _times(at.A.T, gradient), _product(_product(at.A.T, curvature), at.A)
        for c in reversed(range(at.H.shape[0])):
            h, u = at.H[c], updates[c]
            gradient = gradient - h * jnp.sum(u.gain * gradient) - at.seen * h * u.e / u.S
            half = curvature - h[:, None] * _times(curvature.T, u.gain)[None]
            added = at.seen * h[:, None] * h[None] / u.S
            curvature = half - _times(half, u.gain)[:, None] * h[None] + added
        curvature = (curvature + curvature.T) / 2
        variance = jnp.diagonal(P) - jnp.sum(_product(P, curvature) * P, axis=1)
        return (gradient, curvature), (m - _times(P, gradient), jnp.maximum(variance, 0.0))

    m = model.A.shape[1]
    zero = (jnp.zeros(m, model.A.dtype), jnp.zeros((m, m), model.A.dtype))
    return jax.lax.scan(backward, zero, (model, filtered), reverse=True)[1]


# The search ends when changes of the intensities by this factor no longer increase the likelihood.
LATTICE_TOLERANCE = 1.2


@persistent_jit(static=0)
def _log_likelihoods(
    model: LinearTimeVaryingModel,
    start: InitialDistribution,
    noise: Float[Array, " C"],
    Q: Float[Array, "L R m"],
) -> Float[Array, "L R"]:
    """`log_likelihood` of each recording for each set of intensities."""
    one = lambda model, start, Q: log_likelihood(model, start, noise, Q.T)  # noqa: E731
    return jax.vmap(one, (0, 0, 1), 1)(model, start, Q)


@persistent_jit(static=0)
def _smooth_recordings(
    model: LinearTimeVaryingModel,
    start: InitialDistribution,
    noise: Float[Array, " C"],
    Q: Float[Array, "R m"],
) -> tuple[Float[Array, "R N m"], Float[Array, "R N m"]]:
    """`fixed_interval_smoother` of each recording."""
    return jax.vmap(fixed_interval_smoother, (0, 0, None, 0))(model, start, noise, Q)


@dataclasses.dataclass(frozen=True)
class IntensityEstimator:
    """Maximum-likelihood estimator of the intensities of unknown torques; to be called in double precision.

    Attributes:
        noise: Standard deviation of the sensor noise of each channel.
        variance_growth: Variance that one sample adds to a torque of unit intensity, for each recording [s].
        time_constant: Time constant with which a torque decays [s].
        smallest: Lower bound of the intensities [(N m)^2/s].
        largest: Upper bound of the intensities [(N m)^2/s].
        states: Number of states of the mechanism, which come before the torques.
        torques: Number of unknown torques.
    """

    noise: Float[np.ndarray, " C"]
    variance_growth: Float[np.ndarray, " R"]
    time_constant: float
    smallest: float
    largest: float
    states: int
    torques: int

    def log_likelihoods(
        self, model: LinearTimeVaryingModel, start: InitialDistribution, levels: Float[np.ndarray, "L D"]
    ) -> Float[np.ndarray, " L"]:
        """Log-likelihoods of several sets of intensities [nat]."""
        # The torque at the first sample is as uncertain as at any other. All sets use the largest variance.
        first = self._with_torque_variance(start, levels.max(axis=0))
        noise, Q = jax.device_put((self.noise, self._process_noise(levels)))
        return np.asarray(_log_likelihoods(model, first, noise, Q)).sum(axis=1)

    def smooth(
        self, model: LinearTimeVaryingModel, start: InitialDistribution, level: Float[np.ndarray, " D"]
    ) -> tuple[Float[np.ndarray, "R N m"], Float[np.ndarray, "R N m"]]:
        """Means and standard deviations of the states, given all samples."""
        noise, Q = jax.device_put((self.noise, self._process_noise(level)))
        mean, variance = _smooth_recordings(model, self._with_torque_variance(start, level), noise, Q)
        return np.asarray(mean), np.sqrt(np.asarray(variance))

    def maximise(
        self,
        model: LinearTimeVaryingModel,
        start: InitialDistribution,
        level: Float[np.ndarray, " D"],
        factor: float,
    ) -> Float[np.ndarray, " D"]:
        """Intensities of largest likelihood, by a search on a lattice of decreasing step.

        Args:
            model: Linear models along the recordings.
            start: Distributions of the first states.
            level: Intensities from which the search starts.
            factor: First step of the lattice.
        """
        while factor > LATTICE_TOLERANCE:
            trials = np.clip(level * factor ** self._lattice(), self.smallest, self.largest)
            best = trials[int(np.argmax(self.log_likelihoods(model, start, trials)))]
            if np.allclose(best, level):
                factor = np.sqrt(factor)
            level = best
        return level

    def gains(
        self, model: LinearTimeVaryingModel, start: InitialDistribution, level: Float[np.ndarray, " D"]
    ) -> Float[np.ndarray, " D"]:
        """Log-likelihood that each torque gains over the least intensity, with the others unchanged [nat]."""
        without = np.where(np.eye(self.torques, dtype=bool), self.smallest, level)
        rows = np.vstack([level, without])
        # Filled up to the number of rows of the lattice, so that nothing is compiled again.
        fill = np.tile(level, (len(self._lattice()) - len(rows), 1))
        all_torques, *others = self.log_likelihoods(model, start, np.vstack([rows, fill]))
        return all_torques - np.array(others[: self.torques])

    def _process_noise(self, level: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch R m"]:
        """Variance that the process noise adds to every state per sample."""
        torques = level[..., None, :] * self.variance_growth[:, None]
        return np.concatenate([np.zeros((*torques.shape[:-1], self.states)), torques], axis=-1)

    def _with_torque_variance(
        self, start: InitialDistribution, level: Float[np.ndarray, " D"]
    ) -> InitialDistribution:
        variance = np.array(start.variance)
        variance[:, self.states :] = level * self.time_constant / 2
        return jax.device_put(InitialDistribution(start.mean, variance))

    def _lattice(self) -> np.ndarray:
        """Exponents (L, D) of neighbours on the lattice; for more than two torques, one axis at a time."""
        if self.torques > 2:
            return np.vstack([np.zeros(self.torques), np.eye(self.torques), -np.eye(self.torques)])
        return np.array(list(itertools.product((-1, 0, 1), repeat=self.torques)))


@dataclasses.dataclass(frozen=True)
class UnknownTorque(Force):
    """An external torque, held over a sample."""

    name: ClassVar[str] = "unknown_torque"
    title: ClassVar[str] = "unknown torque"
    equation: ClassVar[str] = "tau = torque"

    # The type is Any, since a mechanism without parameter values has a placeholder here.
    torque: Any = parameter(0.0, unit="N m", meaning="torque held over a sample")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Any:
        """Torque [N m] on the port."""
        return self.torque


@dataclasses.dataclass(frozen=True)
class AugmentedStep:
    """Step of the augmented state `[x, d]` by one sample; `d` are unknown torques, which decay.

    Attributes:
        structure: The mechanism without parameter values; its last effects are the unknown torques.
        solver: Integration rule.
        torques: Number of unknown torques.
    """

    structure: Mechanism
    solver: Solver
    torques: int

    def __call__(
        self, s: Float[Array, "m *batch"], v: Float[Array, "*samples"], constants: Any
    ) -> Float[Array, "m *batch"]:
        """State one sample later under the voltage `v`; for one state, or for a batch of states."""
        c, decay = constants
        x, d = s[: -self.torques], s[-self.torques :]
        known = c.values.shape[0] - self.torques
        values = [*(c.values[i] for i in range(known)), *d]
        x = self.solver.advance(self.structure, x, v, c._replace(values=values))
        return jnp.concatenate([x, decay * d])


@persistent_jit(static=2)
def predicted_states(
    structure: Mechanism,
    solver: Solver,
    values: Float[Array, " P"],
    gates: Float[Array, " E"],
    x0: Float[Array, "R n"],
    data: StackedRecordings,
    K: Float[Array, "R n C"],
) -> Float[Array, "R N n"]:
    """States of a predictor with the gains `K`, which follows the measured outputs."""

    def one(x0: Any, K: Any, u: Any, y: Any, seen: Any, Ts: Any) -> jax.Array:
        return predictor_run(structure, solver, values, gates, x0, u, y, seen, K, Ts)[0]

    return jax.vmap(one)(x0, K, *data)


@persistent_jit(static=1)
def linearise_along(
    step: AugmentedStep,
    values: Float[Array, " P"],
    gates: Float[Array, " E"],
    S: Float[Array, "R N m"],
    data: StackedRecordings,
    decay: Float[Array, " R"],
) -> LinearTimeVaryingModel:
    """Linearisations (R, ...) of the augmented model along its states `S`."""
    mechanism = step.structure.with_values(values)

    def one(S: Any, u: Any, y: Any, seen: Any, Ts: Any, decay: Any) -> LinearTimeVaryingModel:
        constants = (step.solver.prepare(step.structure, values, gates, Ts), decay)
        v = motor_inputs(step.solver, mechanism, gates, u, Ts)
        A = jnp.swapaxes(state_jacobians(step, S, v, constants), 1, 2)
        s_next = step(S.T, jnp.moveaxis(v, 0, -1), constants).T
        outputs = lambda s: read_outputs(mechanism, gates, s[: -step.torques])  # noqa: E731
        H = jax.vmap(jax.jacfwd(outputs))(S)
        times_state = lambda M: jnp.sum(M * S[:, None, :], axis=2)  # noqa: E731
        c, y = s_next - times_state(A), y - outputs(S.T).T + times_state(H)
        return LinearTimeVaryingModel(A, c, H, y, seen)

    return jax.vmap(one)(S, *data, decay)
