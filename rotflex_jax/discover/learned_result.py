"""What a learned torque is to a user: its worth, its map with deviations, and how it reads."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rotflex_jax.discover.formula import Formula, Term
from rotflex_jax.discover.result import Stage
from rotflex_jax.effects import LearnedTorque
from rotflex_jax.model import Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Cells of the map along each axis; a cell counts as visited with so many samples.
CELLS, FEWEST = 30, 3


@dataclasses.dataclass(frozen=True)
class LearnedTorqueResult:
    """A learned torque, what it is worth, and how it reads.

    Attributes:
        at: Port.
        kept: Whether data that no fit saw are the better explained with it.
        effect: The learned map; zero everywhere where it was not kept.
        before: The model without it, refitted and scored.
        after: With it; the same as `before` where it was not kept.
        held_out_gain_nats: What it gains in held-out log-likelihood [nat].
        formula: What it reads like; empty where it was not kept.
        physics: Terms that the model's own damper, spring or offset give at the port; none is in the map.
        covariance: Of the weights [(N m)^2] (W, W).
        position: Of the port along the training recordings [rad].
        speed: [rad/s].
        noise_floor: Channel -> deviation of the sensor noise.
    """

    at: str
    kept: bool
    effect: LearnedTorque
    before: Stage
    after: Stage
    held_out_gain_nats: float
    formula: Formula
    physics: tuple[str, ...]
    covariance: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    noise_floor: dict[str, float]

    @property
    def model(self) -> Model:
        """The model with the learned torque, or without where it was not kept."""
        return self.after.model

    @property
    def reading(self) -> str:
        """The formula with its unit, in position `q` and speed `w`."""
        return f"{self.formula} {self.model.mechanism.units.effort}"

    def torque(self, position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Learned torque and its deviation [N m] at positions [rad] and speeds [rad/s] of the port.

        What the physics of the model can imitate is not in it: beside a damper it has no slope.
        """
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        Phi = self.effect.design(q.ravel(), w.ravel())
        std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", Phi, self.covariance, Phi), 0.0))
        return (Phi @ np.array(self.effect.weights)).reshape(q.shape), std.reshape(q.shape)

    def read_torque(self, position: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Torque of the formula [N m], less what the model's own terms can imitate, as in the map."""
        own = columns(self.physics, self.position, self.speed)
        held = np.linalg.lstsq(own, self.formula(self.position, self.speed), rcond=None)[0]
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        return self.formula(q, w) - (columns(self.physics, q.ravel(), w.ravel()) @ held).reshape(q.shape)

    def visited(self, edges: Sequence[np.ndarray]) -> np.ndarray:
        """Which cells of a grid over position and speed the recordings have been in."""
        return np.histogram2d(self.position, self.speed, [*edges])[0] >= FEWEST

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; the map on a grid, None where the recordings have not been."""
        edges = tuple(np.linspace(*ends, CELLS + 1) for ends in (self.effect.position, self.effect.speed))
        q, w = ((e[1:] + e[:-1]) / 2 for e in edges)
        seen, (torque, std) = self.visited(edges), self.torque(q[:, None], w[None, :])
        unit = self.model.mechanism.units.unit
        grid = lambda values: [  # noqa: E731
            [float(v) if s else None for v, s in zip(*row, strict=True)]
            for row in zip(values, seen, strict=True)
        ]
        return {
            "port": self.at,
            "kept": self.kept,
            "held_out_gain_nats": self.held_out_gain_nats,
            "before": self.before.errors(),
            "after": self.after.errors(),
            "noise_floor": self.noise_floor,
            "formula": self.reading,
            "terms": [
                {
                    "term": t.name,
                    "coefficient": t.coefficient,
                    "std": t.std,
                    "unit": unit(t.unit),
                    "share": t.share,
                }
                for t in self.formula.terms
            ],
            "map": {"position": q.tolist(), "speed": w.tolist(), "torque": grid(torque), "std": grid(std)},
        }

    def plot(self) -> "Figure":
        """The map, greyed where the recordings have not been, its profiles with bands, and the formula."""
        from rotflex_jax.report.learned import learned_figure  # the layer above, on request

        return learned_figure(self)

    def __str__(self) -> str:
        if not self.kept:
            return f"No map of position and speed at the {self.at} makes unseen data likelier."
        errors = ", ".join(
            f"{c} {self.before.held_out_rmse_windows[c]:.3g} -> {e:.3g}"
            for c, e in self.after.held_out_rmse_windows.items()
        )
        share = f"{100 * self.formula.share:.0f} % of what the map explains"
        return f"Learned torque at the {self.at}: held-out error {errors}; reads {self.reading} ({share})"


def columns(terms: Sequence[str], position: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Terms of a formula at samples (N, T)."""
    return np.stack([Term(t, 0.0)(position, speed) for t in terms], axis=1)
