"""A fitted model for use elsewhere: JSON, state space, equations, C code."""

from rotflex_jax.export.c_code import to_c
from rotflex_jax.export.files import Saved, read, save
from rotflex_jax.export.state_space import LinearModel, state_space
from rotflex_jax.export.written import latex, text

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
