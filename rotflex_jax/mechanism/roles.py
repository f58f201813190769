"""Roles of the ports and sensors of any machine, in the names of the flexible joint.

An effect names the places where a search tries it by the ports and sensors of that joint: the driven `hub`,
the elastic `joint`, the `arm` that is carried along; the sensor `theta` of the absolute angle, and the sensor
`alpha` of anything else. Ports and channels with other names get these roles from the effects at them, so
that no effect needs a list of machines, and no machine a list of effects.
"""

from collections.abc import Callable

from rotflex_jax.effects.angle import Gravity
from rotflex_jax.effects.base import CATALOG, DryFriction, Effect, Gear, driven_place, port_and_signal
from rotflex_jax.mechanism.mechanism import Mechanism

PORTS, SENSORS = ("hub", "arm", "joint"), ("theta", "alpha")


def port_roles(mechanism: Mechanism, port: str) -> set[str]:
    """Roles of a port: its own name if the joint has one of that name, otherwise by the effects at it.

    A port with a motor is a `hub`, a port with a spring a `joint`, and a port with neither an `arm`. A port
    that moves in metres is an `axis` as well. A port where a motor turns a weight is `loaded`, unless the
    model already has a friction that depends on the load, or play, there. If the machine has ports named
    `hub`, `joint` and `arm`, its other ports have no role except `loaded`. The same holds for the motor's
    side of a gear with play.
    """
    here = [e for e in mechanism.effects if e.at == port]
    weight = any(isinstance(e, Gravity) for e in here)
    known = any(isinstance(e, Gear) or (isinstance(e, DryFriction) and e.loaded) for e in here)
    loaded = {"loaded"} if weight and mechanism.has_motor(port) and not known else set()
    if port in PORTS:
        return {port} | loaded
    if mechanism.on_rotor(port) or all(name in mechanism.port_vectors for name in PORTS):
        return loaded
    stiff = any(float(e.stamp().stiffness) != 0 for e in mechanism.linear_effects(port) if not e.motor)
    roles = {"hub"} if mechanism.has_motor(port) else set()
    roles |= {"joint"} if stiff else set()
    along = {"axis"} if mechanism.units.motion == "m" else set()
    return (roles or {"arm"}) | along | loaded


def sensor_role(mechanism: Mechanism, channel: str) -> str:
    """Role of a sensor: `theta` for the first that measures a position without a spring, else `alpha`.

    A position that no spring holds has no zero of its own. The gains of the other sensors are relative to the
    gain of its sensor.
    """
    if channel in SENSORS:
        return channel
    free = [
        name
        for (name, (port, _)), quantity in zip(mechanism.outputs, mechanism.quantities, strict=True)
        if quantity.is_position and "joint" not in port_roles(mechanism, port)
    ]
    return "theta" if channel in free[:1] else "alpha"


def search_places(mechanism: Mechanism) -> list[tuple[type[Effect], str]]:
    """Every (class, place) of the catalogue that a search of this machine tries by default.

    >>> from rotflex_jax.effects import Motor, Spring
    >>> drive = Mechanism(("a", "b"), {"shaft": (1, 0), "belt": (-1, 1), "drum": (0, 1)},
    ...     [Motor(at="shaft"), Spring(at="belt")], outputs={"angle": "shaft", "tacho": ("drum", "speed")})
    >>> [port for effect, port in search_places(drive) if effect.name in ("cubic_spring", "sensor_gain")]
    ['belt', 'tacho']
    """
    found = []
    for name in sorted(CATALOG):
        cls = CATALOG[name]
        found += [(cls, place) for place in _places(mechanism, cls)]
    return found


def _places(mechanism: Mechanism, cls: type[Effect]) -> list[str]:
    if getattr(cls, "relative", False) and len(mechanism.outputs) == 1:
        return []
    if cls.turning and mechanism.units.motion != "rad":
        return []
    read: dict[str, Callable[[str], set[str]]] = {
        "port": lambda port: port_roles(mechanism, port),
        "input": lambda voltage: {voltage},
        "channel": lambda channel: {sensor_role(mechanism, channel)},
        "signal": lambda place: {
            driven_place(role, "signal") for role in port_roles(mechanism, port_and_signal(place)[0])
        },
    }
    roles = {place: read[cls.acts_on](place) for place in mechanism.locations(cls)}
    wanted = set(cls.searched)
    # Places that the effect names come in the order of the effect, others in the order of the machine.
    named = [place for place in cls.searched if place in roles]
    others = [place for place, role in roles.items() if place not in named and (role | {place}) & wanted]
    # A speed sensor, for instance, has no error that depends on an angle.
    fits = lambda place: cls.acts_on != "channel" or not mechanism.lacking(cls, place)  # noqa: E731
    return [place for place in named + others if fits(place)]


OFFSET, BIAS = "voltage_offset", "sensor_bias"
"""Names of the effects that are calibrations."""


def calibrations(mechanism: Mechanism) -> list[tuple[str, str]]:
    """Calibrations (effect, location) that each recording has, independent of the physics.

    These are an offset of the voltage, and a bias of every sensor with the role `alpha`. A single speed
    sensor has no bias, because its bias is equivalent to the offset.
    """
    alone = len(mechanism.outputs) == 1
    biased = [
        name
        for name, quantity in zip(mechanism.channels, mechanism.quantities, strict=True)
        if sensor_role(mechanism, name) == "alpha" and not (alone and not quantity.is_position)
    ]
    return [(OFFSET, "input"), *((BIAS, name) for name in biased)]
