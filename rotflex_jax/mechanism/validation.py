"""Checks of a mechanism, and the forms in which its parts can be given."""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from rotflex_jax.checks import number, shown as describe
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.quantity import Quantity

if TYPE_CHECKING:
    from rotflex_jax.mechanism.mechanism import Mechanism


def ports(given: Any) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """Name and vector of each port."""
    try:
        found = tuple((str(name), tuple(float(c) for c in vector)) for name, vector in dict(given).items())
        if not all(math.isfinite(c) for _, vector in found for c in vector):
            raise ValueError("a direction has finite entries")
        return found
    except (TypeError, ValueError):
        raise InputError(
            f"The ports were given as {given!r}, but they are names with one number per coordinate; write "
            'for instance {"motor": (1, 0), "belt": (-1, 1)}.'
        ) from None


def outputs(given: Any) -> tuple[tuple[str, tuple[str, str]], ...]:
    """Channel, and port with the quantity measured there."""
    if not isinstance(given, (Mapping, tuple)) or (given and isinstance(given, tuple) and len(given[0]) != 2):
        raise InputError(
            f"The outputs were given as {given!r}, but they are channels with the port that each measures; "
            'write for instance {"encoder": "motor", "tacho": ("drum", "speed")}.'
        )
    each = {
        k: (v, Quantity.POSITION.value) if isinstance(v, str) else tuple(v) for k, v in dict(given).items()
    }
    for channel, shown in each.items():
        if len(shown) != 2:
            raise InputError(
                f"Output {channel!r} was given as {shown}, but it needs a port, or a port and 'speed'; write "
                f'for instance {{"{channel}": ("drum", "speed")}}.'
            )
    return tuple((k, (v[0], v[1])) for k, v in each.items())


def effects(given: Any) -> tuple[Effect, ...]:
    """Effects in order."""
    if not isinstance(given, Iterable | Effect | type):
        raise InputError(f"The effects were given as {describe(given)}, but a list is needed; give one.")
    listed: tuple[Any, ...] = (given,) if isinstance(given, Effect | type) else tuple(given)
    for e in listed:
        if not isinstance(e, Effect):
            name = e.__name__ if isinstance(e, type) else repr(e)
            raise InputError(
                f"{name} was given as an effect, but an effect stands at a port; write "
                f'{name if isinstance(e, type) else "for instance Coulomb"}(at="...").'
            )
    if isinstance(given, Effect):
        kind = type(given).__name__
        raise InputError(f"The effects were given as one {kind}, but a list is needed; write [{kind}(...)].")
    return listed


def process_noise_of(mechanism: "Mechanism", given: Any) -> dict[str, float]:
    """Port -> intensity of a process torque, nothing for None; checked."""
    if not (given is None or isinstance(given, Mapping)):
        raise InputError(
            f"Argument `process_noise` must give an intensity for each port, but is {describe(given)}; write "
            "for instance {'hub': 1e-6}."
        )
    found = {}
    for port, intensity in (given or {}).items():
        if port not in dict(mechanism.ports):
            raise InputError(
                f"Process noise was given at {port!r}, but the mechanism has the ports "
                f"{', '.join(dict(mechanism.ports))}; name one of these."
            )
        found[port] = number(intensity, f"process_noise[{port!r}]", least=0, example="1e-6")
    return found


def check(mechanism: "Mechanism") -> None:
    """Raise `InputError` where ports, outputs and effects do not fit together."""
    if not mechanism.coordinates:
        raise InputError(
            "A mechanism was given no coordinates, but it needs one; name for instance ('angle',)."
        )
    ports = dict(mechanism.ports)
    for name, vector in ports.items():
        if len(vector) != len(mechanism.coordinates):
            raise InputError(
                f"Port {name!r} was given {len(vector)} entries, but the mechanism has the "
                f"{len(mechanism.coordinates)} coordinates {mechanism.coordinates}; give one entry for each."
            )
    for channel, (port, what) in mechanism.outputs:
        if port not in ports or what not in Quantity.names():
            raise InputError(
                f"Output {channel!r} was given as {(port, what)}, but it needs one of the ports "
                f"{tuple(ports)} with {' or '.join(map(repr, Quantity.names()))}; correct the output."
            )
    seen: set[tuple[str, str]] = set()
    for effect in mechanism.effects:
        places = mechanism.locations(effect)
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
        _check_surroundings(mechanism, effect)


def _check_surroundings(mechanism: "Mechanism", effect: Effect) -> None:
    """What an effect needs at its port must be there, and of some kinds a mechanism has one at most."""
    name = type(effect).__name__
    if missing := mechanism.lacking(effect, effect.at):
        needed, added = (" and ".join(map(_with_article, names)) for names in (effect.needs(), missing))
        if effect.acts_on == "channel":
            raise InputError(
                f"{name} was put at the output {effect.at!r}, but it needs {needed} there; leave it out, or "
                "put it where there is one."
            )
        raise InputError(
            f"{name} was put at {effect.at!r}, but it needs a port with {needed}; put it at such a port, or "
            f"add {added} there first."
        )
    if effect.single and sum(e.kind_label == effect.kind_label for e in mechanism.effects) > 1:
        raise InputError(
            f"Two effects of the kind {effect.kind_label!r} were put into one mechanism, but only one is "
            "possible; leave one."
        )


def _with_article(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeiou" else f"a {noun}"
