"""The same integration in shorter steps, for models whose steps are not exact.

Search and fit use it to find how far estimates depend on the step.
"""

import dataclasses
from collections.abc import Iterable

from rotflex_jax.effects.base import Effect
from rotflex_jax.mechanism.simulate import Solver
from rotflex_jax.mechanism.step import Exponential

# Number of substeps in place of one. With sixteen no estimate moved further by a third of its standard
# deviation.
SUBSTEP_FACTOR = 4


def with_finer_steps(solver: Solver, effects: Iterable[Effect]) -> Exponential | None:
    """The solver with steps shorter by `SUBSTEP_FACTOR`; None if that is not possible or has no effect.

    Linear motion is integrated exactly, and effects on voltages and readings need no integration.
    `SmoothRK4` has another error, its smoothed friction. A voltage that is switched within a sample needs one
    step per sample.

    Args:
        solver: Solver of the model.
        effects: Effects of its mechanism.
    """
    if not isinstance(solver, Exponential) or solver.between == "switched":
        return None
    if all(effect.exact_step for effect in effects):
        return None
    return dataclasses.replace(solver, substeps=SUBSTEP_FACTOR * solver.substeps)
