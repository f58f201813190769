"""What a rival is and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import rotflex_jax as rf
from arena.laws import Place

Rival = Callable[[rf.Recording], "Answer"]
"""From the training recording to an answer."""


class Answer(NamedTuple):
    """Effects in the order in which they were found, and a phrase on how."""

    rounds: list[Place]
    note: str = ""
