"""The mechanism with a torque of which nothing is known but that it depends on position and speed."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.compare.physics import fitted_physics, predictor
from rotflex_jax.discover.learned import learn_torque
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class LearnedTorqueMethod:
    """The grey box with a learned torque at one port, a smooth map of position and speed there.

    Attributes:
        at: Port; the first one of the mechanism if None.
        share: Share of each training recording that the map is fitted to; the rest decides on it.
    """

    name: str = "learned_torque"
    title: str = "the mechanism with a learned torque at one port"
    family: str = "learned"
    at: str | None = None
    share: float = 0.7

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Fits the mechanism first, then the map beside it."""
        begun = fitted_physics(model, train, say).simulator
        assert isinstance(begun, Model)
        at = self.at or next(iter(model.mechanism.port_vectors))
        parts = [recording.split(self.share) for recording in train]
        found = learn_torque(begun, [a for a, _ in parts], [b for _, b in parts], at, progress=say)
        weights = np.asarray(found.effect.weights).size if found.kept else 0
        free = len(found.model.mechanism.free_names)
        note = f"at {at}, reads like {found.formula}" if found.kept else f"no torque at {at} was kept"
        return Fitted(found.model, max(free, weights), note, predictor(found.model, train))
