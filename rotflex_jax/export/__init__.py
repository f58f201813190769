"""A fitted model for use elsewhere: JSON, state space, equations, C code."""

from rotflex_jax.export.c_code import to_c
from rotflex_jax.export.equations import latex, text
from rotflex_jax.export.state_space import LinearModel, state_space
from rotflex_jax.models.model_json import Saved, read, save

__all__ = [
    "LinearModel",
    "Saved",
    "latex",
    "read",
    "save",
    "state_space",
    "text",
    "to_c",
]
