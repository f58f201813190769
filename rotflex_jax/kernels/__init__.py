"""Volterra kernels of a physical model, by differentiating its simulator.

Kernels of a physical model explain kernels that are identified from data. `local_kernels` are the Taylor
kernels about a constant voltage, for effects that are smooth there. `average_kernels` are the kernels that
least squares finds under a Gaussian input, for any effect. `effect_kernels` gives the contribution of each
effect to the kernels, `identified_kernels` the kernels of a fit.
"""

from rotflex_jax.kernels.average import EffectKernels, EffectShare, average_kernels, effect_kernels
from rotflex_jax.kernels.local import identified_kernels, local_kernels
from rotflex_jax.kernels.result import Agreement, Kernels
from rotflex_jax.kernels.sensitivities import Modelled

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
