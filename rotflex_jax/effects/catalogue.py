"""The list of known effects. An effect enters it by the decorator `register`, and nowhere else."""

from typing import TypeVar

from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError

EffectClass = TypeVar("EffectClass", bound=type[Effect])

CATALOG: dict[str, type[Effect]] = {}


def register(effect: EffectClass) -> EffectClass:
    """Enters an effect class under its `name`; use it as the outermost decorator.

    Args:
        effect: A frozen dataclass that derives from one of the kinds.

    Returns:
        The class, unchanged.

    Raises:
        InputError: Another class has the name already.
    """
    known = CATALOG.setdefault(effect.name, effect)
    # A module that is run again (a notebook cell, a reload) replaces its own earlier class.
    if (known.__module__, known.__qualname__) != (effect.__module__, effect.__qualname__):
        raise InputError(
            f"The effect name '{effect.name}' is taken by {known.__qualname__}; an effect needs a "
            f"name of its own, so give {effect.__qualname__} another one."
        )
    CATALOG[effect.name] = effect
    return effect
