"""How strong an unknown torque is: the intensity under which the recordings are likeliest."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.latent.smoother import Linear, Start, log_likelihood, smoothed

# The search ends when a change of the intensities by this factor gains nothing.
FINE = 1.2

_likelihoods = jax.jit(jax.vmap(jax.vmap(log_likelihood, (0, 0, None, 0)), (None, None, None, 0)))
_smoothed = jax.jit(jax.vmap(smoothed, (0, 0, None, 0)))


@dataclasses.dataclass(frozen=True)
class Intensities:
    """What the search for intensities needs to know. Call it in double precision.

    Attributes:
        noise: Deviation of the sensor noise per channel (C,).
        grows: Variance that one sample adds to a torque of unit intensity, by recording (R,) [s].
        memory: Time after which a torque is forgotten [s].
        least: Smallest intensity [(N m)^2/s].
        most: Largest.
        states: States of the mechanism, ahead of the torques.
        ports: How many torques.
    """

    noise: np.ndarray
    grows: np.ndarray
    memory: float
    least: float
    most: float
    states: int
    ports: int

    def _added(self, level: np.ndarray) -> np.ndarray:
        """Variance per sample of every state (..., R, m) under intensities (..., ports)."""
        own = level[..., None, :] * self.grows[:, None]
        return np.concatenate([np.zeros((*own.shape[:-1], self.states)), own], axis=-1)

    def _start(self, start: Start, level: np.ndarray) -> Start:
        variance = np.array(start.variance)
        variance[:, self.states :] = level * self.memory / 2
        return Start(jnp.asarray(start.mean), jnp.asarray(variance))

    def likelihoods(self, model: Linear, start: Start, levels: np.ndarray) -> np.ndarray:
        """Log-likelihoods (L,) of intensities (L, ports) [nat]."""
        # The torque of the first sample is as uncertain as that of any other; a wide guess serves all.
        begin = self._start(start, levels.max(axis=0))
        Q = jnp.asarray(self._added(levels))
        return np.asarray(_likelihoods(model, begin, jnp.asarray(self.noise), Q)).sum(axis=1)

    def smooth(self, model: Linear, start: Start, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (R, N, m) and their deviations, given all samples."""
        Q = jnp.asarray(self._added(level))
        mean, variance = _smoothed(model, self._start(start, level), jnp.asarray(self.noise), Q)
        return np.asarray(mean), np.sqrt(np.asarray(variance))

    def likeliest(self, model: Linear, start: Start, level: np.ndarray, factor: float) -> np.ndarray:
        """Intensities (ports,) of largest likelihood, by a search on a lattice that grows finer.

        Args:
            model: Along the recordings.
            start: First states.
            level: Where to begin.
            factor: First step of the lattice.
        """
        while factor > FINE:
            trials = np.clip(level * factor ** self._lattice(), self.least, self.most)
            found = trials[int(np.argmax(self.likelihoods(model, start, trials)))]
            if np.allclose(found, level):
                factor = np.sqrt(factor)
            level = found
        return level

    def gains(self, model: Linear, start: Start, level: np.ndarray) -> np.ndarray:
        """Log-likelihood (ports,) that each torque gains over none, the others as they are [nat]."""
        without = np.where(np.eye(self.ports, dtype=bool), self.least, level)
        rows = np.vstack([level, without])
        # As many as on the lattice, so that nothing is compiled anew.
        fill = np.tile(level, (len(self._lattice()) - len(rows), 1))
        most, *rest = self.likelihoods(model, start, np.vstack([rows, fill]))
        return most - np.array(rest[: self.ports])

    def _lattice(self) -> np.ndarray:
        """Neighbours (L, ports) in all directions; of many torques, one at a time."""
        if self.ports > 2:
            return np.vstack([np.zeros(self.ports), np.eye(self.ports), -np.eye(self.ports)])
        return np.array(list(itertools.product((-1, 0, 1), repeat=self.ports)))
