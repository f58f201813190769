"""The same integration in shorter steps, for models whose steps are not exact.

Search and fit ask by it how far estimates depend on the step.
"""

import dataclasses
from collections.abc import Iterable

from rotflex_jax.effects.base import Effect
from rotflex_jax.mechanism.simulate import Solver
from rotflex_jax.mechanism.step import Exponential

# Substeps in the place of one. Sixteen moved no estimate further by a third of its standard deviation.
SUBSTEP_FACTOR = 4


def with_finer_steps(solver: Solver, effects: Iterable[Effect]) -> Exponential | None:
    """The solver with steps `SUBSTEP_FACTOR` times as short; None where that has no use or is not possible.

    A linear motion is integrated exactly, and effects on voltages and readings need no integration.
    `SmoothRK4` has an error of its own, its smoothed friction. A voltage that is switched within a sample
    needs one step per sample.

    Args:
        solver: Of the model.
        effects: Of its mechanism.
    """
    if not isinstance(solver, Exponential) or solver.between == "switched":
        return None
    if all(effect.exact_step for effect in effects):
        return None
    return dataclasses.replace(solver, substeps=SUBSTEP_FACTOR * solver.substeps)
