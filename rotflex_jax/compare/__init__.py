"""Every method on the same recording: same split, same first samples, free runs only."""

from rotflex_jax.compare import arx, physics  # noqa: F401 - they enter their methods
from rotflex_jax.compare.arx import ARX
from rotflex_jax.compare.method import METHODS, Fitted, Method, register
from rotflex_jax.compare.side_by_side import compare
from rotflex_jax.compare.table import Comparison, Row

__all__ = ["ARX", "Comparison", "Fitted", "METHODS", "Method", "Row", "compare", "register"]
