"""What another method is and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import rotflex_jax as rf
from rotflex_jax.arena.simulator.laws import Place

Rival = Callable[[rf.Recording, rf.Recording], "NamedEffects"]
"""From the training and the validation recording to an answer."""


class NamedEffects(NamedTuple):
    """Effects in the order in which they were found, and a phrase on how."""

    rounds: list[Place]
    note: str = ""
