"""Several effects in one machine: pairs and triples, from a fixed random draw."""

from __future__ import annotations

import random

from rotflex_jax.arena.simulator.hidden import ABSORBED, DEFAULTS, EQUIVALENT
from rotflex_jax.arena.simulator.laws import Place

_FRICTION = {"coulomb", "coulomb_asymmetric", "stribeck", "dahl", "lugre", "bouc_wen"}


def apart(a: Place, b: Place) -> bool:
    """Whether two effects may act together: not equivalent, not two frictions at a port, not of one name."""
    alike = b in EQUIVALENT.get(a, set()) or a in EQUIVALENT.get(b, set())
    same_friction = a[1] == b[1] and a[0] in _FRICTION and b[0] in _FRICTION
    return a[0] != b[0] and not alike and not same_friction


def drawn(count: int, together: int) -> list[tuple[Place, ...]]:
    """Different groups of effects that may act together.

    The order of the draw is fixed, so that a longer list begins with the shorter one.

    Args:
        count: number of groups.
        together: number of effects in each group.

    >>> drawn(2, 2) == drawn(3, 2)[:2]
    True
    """
    places = [p for p in DEFAULTS if p not in ABSORBED]
    rng, found = random.Random(together), list[tuple[Place, ...]]()
    while len(found) < count:
        group = tuple(sorted(rng.sample(places, together)))
        if group not in found and all(apart(a, b) for a in group for b in group if a != b):
            found.append(group)
    return found
