"""Types of the other methods and of their answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import rotflex_jax as rf
from rotflex_jax.arena.simulator.laws import Place

Rival = Callable[[rf.Recording, rf.Recording], "NamedEffects"]
"""Function of the training and the validation recording that returns an answer."""


class NamedEffects(NamedTuple):
    """Effects in the order in which they were found, and a note on how they were found."""

    rounds: list[Place]
    note: str = ""
