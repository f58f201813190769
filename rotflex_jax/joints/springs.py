"""The two springs that hold the arm, and the 27 stiffnesses they can be set to.

Each of two equal, preloaded springs runs from an anchor on the hub to the arm:

    length(alpha)^2 = (R cos(alpha) - d)^2 + (R sin(alpha) -+ r)^2

with the anchors at the distances `d` (hub) and `R` (arm) from the axis along the arm, and `r` to
the side.
"""

from typing import NamedTuple

from rotflex_jax.errors import InputError

INCH = 0.0254

# Sideways distance of the anchors on the hub [m].
SIDE = 1.25 * INCH


class SpringType(NamedTuple):
    """A spring of the kit.

    Attributes:
        length: Free length [m].
        preload: Force that opens the coils [N].
        rate: Force per length beyond that [N/m].
    """

    length: float
    preload: float
    rate: float


# Spring 1 is the softest, 2 the maker's default.
SPRINGS: dict[int, SpringType] = {
    1: SpringType(1.00 * INCH, 0.85, 187.0),
    2: SpringType(1.25 * INCH, 1.33, 312.8),
    3: SpringType(1.25 * INCH, 1.78, 565.25),
}

# Distance from the axis along the arm [m].
HUB_ANCHORS: dict[str, float] = {"A": 1.25 * INCH, "B": 1.00 * INCH, "C": 0.75 * INCH}
ARM_ANCHORS: dict[int, float] = {1: 4.0 * INCH, 2: 3.5 * INCH, 3: 3.0 * INCH}


def spring_stiffness(
    spring: int = 2, hub_anchor: str = "B", arm_anchor: int = 2, *, preload_only: bool = False
) -> float:
    """Stiffness of the joint at small deflections, by the geometry of the springs.

        K = 2 (rate R^2 r^2 / D + F (R d / sqrt(D) - R^2 r^2 / D^1.5))
        D = r^2 + (R - d)^2,   F = preload + rate (sqrt(D) - length)

    Not at deflections above about 0.1 rad, where the springs soften by a few per mille.

    Args:
        spring: 1, 2 or 3; see `SPRINGS`.
        hub_anchor: "A", "B" or "C".
        arm_anchor: 1, 2 or 3.
        preload_only: Take the preload for the whole force at the working length, as the maker did
            before 2010.

    Returns:
        Stiffness [N m/rad].

    Raises:
        InputError: No such setting.

    Source: Quanser, config_rotflex.m, 2010; with `preload_only` config_flexjoint.m, 2002.

    >>> round(spring_stiffness(2, "B", 2), 4)
    1.2485
    """
    for what, value, known in (
        ("spring", spring, SPRINGS),
        ("hub_anchor", hub_anchor, HUB_ANCHORS),
        ("arm_anchor", arm_anchor, ARM_ANCHORS),
    ):
        if value not in known:
            raise InputError(
                f"{what} was given {value!r}, but the kit has {', '.join(map(repr, known))}; "
                "choose one of these."
            )
    kit, d, R, r = SPRINGS[spring], HUB_ANCHORS[hub_anchor], ARM_ANCHORS[arm_anchor], SIDE
    D = r**2 + (R - d) ** 2
    stretch = 0.0 if preload_only else kit.rate * (D**0.5 - kit.length)
    force = kit.preload + stretch
    return 2 * (kit.rate * (R * r) ** 2 / D + force * (R * d / D**0.5 - (R * r) ** 2 / D**1.5))


def spring_settings() -> dict[tuple[int, str, int], float]:
    """Stiffness [N m/rad] of all 27 settings (spring, hub anchor, arm anchor)."""
    return {
        (spring, hub, arm): spring_stiffness(spring, hub, arm)
        for spring in SPRINGS
        for hub in HUB_ANCHORS
        for arm in ARM_ANCHORS
    }
