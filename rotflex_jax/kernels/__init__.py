"""Volterra kernels of a physical model, by differentiating its simulator.

A kernel identified from data is a table of numbers; the same kernel of a physical model says where they
come from. `local_kernels` are the Taylor kernels about a constant voltage, for laws that are smooth
there. `average_kernels` are what a least-squares fit finds under a Gaussian input, for any law.
`effect_kernels` says which effect changes which kernel. `identified_kernels` are those of a fit.
"""

from rotflex_jax.kernels.average import average_kernels
from rotflex_jax.kernels.effects import EffectKernels, EffectShare, effect_kernels
from rotflex_jax.kernels.identified import identified_kernels
from rotflex_jax.kernels.local import local_kernels
from rotflex_jax.kernels.result import Agreement, Kernels
from rotflex_jax.kernels.subject import Modelled

__all__ = [
    "Agreement",
    "EffectKernels",
    "EffectShare",
    "Kernels",
    "Modelled",
    "average_kernels",
    "effect_kernels",
    "identified_kernels",
    "local_kernels",
]
