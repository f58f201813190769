"""A hypothesis: which effects are on, with which numbers, on one set of recordings."""

import dataclasses

import numpy as np

from rotflex_jax.discover.lanes import Bench, Directions, Lane
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.discover.whiten import Whitener
from rotflex_jax.mechanism.assembly import rest_state


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """One model on one set of recordings, with everything a comparison needs.

    Attributes:
        places: Candidates and calibrations that are switched on, in the order they came.
        free: Parameters common to all recordings that are fitted.
        local: Parameters that each recording has for itself and that are fitted.
        z: Unconstrained values (P,).
        own: Unconstrained values of the local parameters (R, len(local)).
        x0: First states (R, m): positions, speeds, and what else the part of the super-model has.
        K: Gains (R, n, C).
        process_noise: Port -> intensity that gave `K`.
        whitener: Fixed while parameters move.
        densities: Log-likelihood of each training sample (R, N) [nat].
    """

    places: tuple[Place, ...]
    free: tuple[int, ...]
    local: tuple[int, ...]
    z: np.ndarray
    own: np.ndarray
    x0: np.ndarray
    K: np.ndarray
    process_noise: dict[str, float]
    whitener: Whitener
    densities: np.ndarray = dataclasses.field(default_factory=lambda: np.array(-np.inf))

    def seated(self, bench: Bench, places: tuple[Place, ...]) -> np.ndarray:
        """First states for other places: those that both have as they are, the others at rest."""
        return seat(bench, places, self.x0, self.places)

    @property
    def log_likelihood(self) -> float:
        """Of the training recordings [nat]."""
        total = float(np.sum(self.densities))
        return total if np.isfinite(total) else -np.inf

    def values(self, bench: Bench) -> np.ndarray:
        """Physical values (R, P)."""
        z = np.tile(self.z, (len(self.x0), 1))
        if self.local:
            z[:, list(self.local)] = self.own
        return constrain(bench, z)[0]

    def lane(self, bench: Bench) -> Lane:
        """The numbers to run."""
        return Lane(self.values(bench), self.x0, bench.supermodel.gates(self.places), self.K)

    @property
    def moved(self) -> int:
        """Number of directions a fit moves: common, then local, then first states."""
        return len(self.free) + len(self.local) + self.x0.shape[1]

    def directions(self, bench: Bench, count: int) -> Directions:
        """Tangents of all that a fit moves, in unconstrained coordinates, filled up with zeros."""
        R, P = len(self.x0), len(self.z)
        z = np.tile(self.z, (R, 1))
        if self.local:
            z[:, list(self.local)] = self.own
        stretch = constrain(bench, z)[1]
        E, m = len(bench.supermodel.mechanism.effects), self.x0.shape[1]
        d = Directions(np.zeros((count, R, P)), np.zeros((count, m)), np.zeros((count, E)))
        for k, i in enumerate((*self.free, *self.local)):
            d.values[k, :, i] = stretch[:, i]
        start = len(self.free) + len(self.local)
        d.x0[start : start + m] = np.eye(m)
        return d


def seat(bench: Bench, places: tuple[Place, ...], x0: np.ndarray, of: tuple[Place, ...] = ()) -> np.ndarray:
    """First states (R, m) for a hypothesis with `places` from those of one with other places.

    Args:
        bench: Where it runs.
        places: What is switched on.
        x0: States known; only positions and speeds will do.
        of: What is switched on where they come from.
    """
    s = bench.supermodel
    before, after = (list(s.part(s.gates(p)).states) for p in (of, places))
    full = np.tile(rest_state(s.mechanism.structure, np.float64), (len(x0), 1))
    full[:, before[: x0.shape[1]]] = x0
    return full[:, after]


def constrain(bench: Bench, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Physical values of unconstrained ones (..., P), and their derivative."""
    return bench.supermodel.transform.physical(z)
