"""From physics to kernels: what the simulated machine's own equations say the kernels should be."""

import dataclasses

from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.fit import least_squares
from rotflex_jax.kernels import (
    EffectKernels,
    Kernels,
    average_kernels,
    effect_kernels,
    identified_kernels,
)
from rotflex_jax.mechanism import Exponential
from rotflex_jax.model import Model
from rotflex_jax.reproduce.records import Records
from rotflex_jax.reproduce.settings import Settings

USED = 4000
"""Samples of the training record over which the equations are averaged."""


@dataclasses.dataclass(frozen=True)
class Bridge:
    """Kernels of the machine and kernels from its data.

    Attributes:
        physics: By differentiating the simulator, averaged over the input.
        data: By least squares of the quadratic model.
        effects: What each effect of the machine does to the kernels; None where the machine cannot run
            without one of them.
    """

    physics: Kernels
    data: Kernels
    effects: EffectKernels | None

    def __str__(self) -> str:
        agreement = str(self.physics.against(self.data))
        return agreement if self.effects is None else f"{agreement}\n\n{self.effects}"


def bridge(s: Settings, records: Records) -> Bridge | None:
    """The bridge of a simulated machine; None where no equations are known.

    Args:
        s: Settings.
        records: To learn from.
    """
    if records.machine is None:
        return None
    first = records.train[0]
    part = first.slice(0, min(USED, first.N))
    # Coarser than the record itself, but kernels need no more than a per mille.
    model = Model(records.machine, Exponential(substeps=max(1, round(s.Ts / 5e-3))))
    fit = least_squares(Volterra(Delays(s.memory)), first, records.channel)
    physics = average_kernels(model, part, records.channel, s.memory)
    try:
        effects = effect_kernels(model, part, records.channel, s.memory)
    except InputError:  # a softening spring without what hardens it runs off
        effects = None
    return Bridge(physics, identified_kernels(fit, s.memory, first), effects)
