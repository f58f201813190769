"""Every method on the same recording: same split, same first samples, free runs only."""

from rotflex_jax.compare.arx import ARX
from rotflex_jax.compare.method import METHODS, Fitted, Method, register
from rotflex_jax.compare.physics import (
    Discovered,
    GreyBox,
    GreyBoxPredictor,
    LinearPart,
    Textbook,
)
from rotflex_jax.compare.side_by_side import compare
from rotflex_jax.compare.table import Comparison, Row

# The order in which they run; one more method is one more line.
register(Textbook())
register(LinearPart())
register(GreyBox())
register(GreyBoxPredictor())
register(Discovered())
register(ARX())

__all__ = [
    "ARX",
    "Comparison",
    "Discovered",
    "Fitted",
    "GreyBox",
    "GreyBoxPredictor",
    "LinearPart",
    "METHODS",
    "Method",
    "Row",
    "Textbook",
    "compare",
    "register",
]
