"""A fitted model for use elsewhere: JSON, state space, equations, C code, simulators."""

from rotflex_jax.export.bam import to_bam
from rotflex_jax.export.c_code import to_c
from rotflex_jax.export.certificate import Certificate, Exported
from rotflex_jax.export.equations import latex, text
from rotflex_jax.export.fmu import to_fmu
from rotflex_jax.export.mjcf import to_mjcf
from rotflex_jax.export.state_space import LinearModel, state_space
from rotflex_jax.export.urdf import to_urdf
from rotflex_jax.models.model_json import Saved, read, save

__all__ = [
    "Certificate",
    "Exported",
    "LinearModel",
    "Saved",
    "latex",
    "read",
    "save",
    "state_space",
    "text",
    "to_bam",
    "to_c",
    "to_fmu",
    "to_mjcf",
    "to_urdf",
]
