"""What must hold of a mechanism before it can move: ports, outputs and effects that fit together."""

from typing import TYPE_CHECKING

from rotflex_jax.effects.kinds import Actuation, Effect, Gear, Memory, Sensing
from rotflex_jax.errors import InputError

if TYPE_CHECKING:
    from rotflex_jax.mechanism.mechanism import Mechanism


def check(mechanism: "Mechanism") -> None:
    """Raise `InputError` where ports, outputs and effects do not fit together."""
    ports, channels = mechanism.port_vectors, mechanism.channels
    for name, vector in ports.items():
        if len(vector) != len(mechanism.coordinates):
            raise InputError(
                f"Port {name!r} was given {len(vector)} entries, but the mechanism has the "
                f"{len(mechanism.coordinates)} coordinates {mechanism.coordinates}; give one entry for each."
            )
    for channel, (port, what) in mechanism.outputs:
        if port not in ports or what not in ("position", "speed"):
            raise InputError(
                f"Output {channel!r} was given as {(port, what)}, but it needs one of the ports "
                f"{tuple(ports)} with 'position' or 'speed'; correct the output."
            )
    seen: set[tuple[str, str]] = set()
    for effect in mechanism.effects:
        places = ("input",) if isinstance(effect, Actuation) else tuple(ports)
        places = channels if isinstance(effect, Sensing) else places
        if effect.at not in places:
            raise InputError(
                f"{type(effect).__name__} was put at {effect.at!r}, but this mechanism has "
                f"{', '.join(map(repr, places))} for it; choose one of them."
            )
        if (effect.at, effect.name) in seen:
            raise InputError(
                f"Two effects named {effect.name!r} were put at {effect.at!r}, but one is needed; "
                f"add up their parameters."
            )
        seen.add((effect.at, effect.name))
        _check_motor(mechanism, effect)


def _check_motor(mechanism: "Mechanism", effect: Effect) -> None:
    """Effects of motor and gear need a motor at their port, a gear the inertia of the rotor too."""
    if isinstance(effect, Memory) and effect.driven_by == "motor" and not mechanism.has_motor(effect.at):
        raise InputError(
            f"{type(effect).__name__} was put at {effect.at!r}, but no motor drives that port; put "
            f"it at the port of a motor, or add a Motor there first."
        )
    if not isinstance(effect, Gear):
        return
    if not (mechanism.has_motor(effect.at) and mechanism.has_inertia(effect.at)):
        raise InputError(
            f"{type(effect).__name__} was put at {effect.at!r}, but it needs a port with a motor and "
            f"an inertia, of which it splits off the rotor; put it there, or add both first."
        )
    if sum(isinstance(e, Gear) for e in mechanism.effects) > 1:
        raise InputError(
            "Two gears with play were put into one mechanism, but only one is possible; leave one."
        )
