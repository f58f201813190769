"""Names and units of a mechanism's states and outputs, for people and for what is written from it."""

from rotflex_jax.effects.kinds import Gear, Linear, Memory
from rotflex_jax.mechanism.mechanism import Mechanism


def state_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Positions, speeds, states of linear effects and gears, memories: as they stand in the state.

    >>> from rotflex_jax.effects import LuGre, Motor
    >>> state_names(Mechanism(("a",), {"shaft": (1,)}, [Motor("shaft", inductance=1e-3), LuGre("shaft")]))
    ('a', 'd(a)/dt', 'shaft.motor[0]', 'shaft.lugre[0]')
    """
    moving = [*mechanism.coordinates, *(f"d({q})/dt" for q in mechanism.coordinates)]
    for kind in (Linear, Gear, Memory):
        for e in mechanism.effects:
            if isinstance(e, kind):
                count = 1 if isinstance(e, Memory) else e.order
                moving += [f"{e.at}.{e.name}[{k}]" for k in range(count)]
    return tuple(moving)


def output_units(mechanism: Mechanism) -> dict[str, str]:
    """Channel -> unit of its reading.

    >>> output_units(Mechanism(("a",), {"p": (1,)}, outputs={"angle": "p", "tacho": ("p", "speed")}))
    {'angle': 'rad', 'tacho': 'rad/s'}
    """
    motion = mechanism.units.motion
    return {name: motion if what == "position" else f"{motion}/s" for name, (_, what) in mechanism.outputs}
