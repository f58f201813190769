"""What a person may give for the parts of a mechanism, in the one form in which it keeps them."""

from collections.abc import Mapping
from typing import Any

from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError


def names(given: Any, what: str) -> tuple[str, ...]:
    """A list of names."""
    if isinstance(given, str):
        raise InputError(f"The {what} were given as {given!r}, but a list is needed; write [{given!r}].")
    return tuple(given)


def ports(given: Any) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """Name and vector of each port."""
    try:
        return tuple((str(name), tuple(float(c) for c in vector)) for name, vector in dict(given).items())
    except (TypeError, ValueError):
        raise InputError(
            f"The ports were given as {given!r}, but they are names with one number per coordinate; write "
            'for instance {"motor": (1, 0), "belt": (-1, 1)}.'
        ) from None


def outputs(given: Any) -> tuple[tuple[str, tuple[str, str]], ...]:
    """Channel, and port with what is seen of it."""
    if not isinstance(given, (Mapping, tuple)) or (given and isinstance(given, tuple) and len(given[0]) != 2):
        raise InputError(
            f"The outputs were given as {given!r}, but they are channels with the port that each shows; "
            'write for instance {"encoder": "motor", "tacho": ("drum", "speed")}.'
        )
    each = {k: (v, "position") if isinstance(v, str) else tuple(v) for k, v in dict(given).items()}
    for channel, shown in each.items():
        if len(shown) != 2:
            raise InputError(
                f"Output {channel!r} was given as {shown}, but it needs a port, or a port and 'speed'; write "
                f'for instance {{"{channel}": ("drum", "speed")}}.'
            )
    return tuple((k, (v[0], v[1])) for k, v in each.items())


def effects(given: Any) -> tuple[Effect, ...]:
    """Effects in order."""
    listed: tuple[Any, ...] = (given,) if isinstance(given, (Effect, type)) else tuple(given)
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
