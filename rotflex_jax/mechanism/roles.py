"""What the ports and sensors of any machine are to the search: the words of the flexible joint.

An effect says where it is worth looking for in the words of that joint: at the driven `hub`, at the
elastic `joint`, at the `arm` that is carried along; at the sensor `theta` from which angles count, at
the sensor `alpha` of something else. A machine with ports and channels of other names is read by what
acts there, so that an effect needs no list of machines and a machine none of effects.
"""

from rotflex_jax.effects.catalogue import CATALOG
from rotflex_jax.effects.kinds import Actuation, Effect, Linear, Sensing
from rotflex_jax.mechanism.mechanism import Mechanism

PORTS, SENSORS = ("hub", "arm", "joint"), ("theta", "alpha")
Place = tuple[str, str]


def port_roles(mechanism: Mechanism, port: str) -> set[str]:
    """What a port is: its own name if the joint has one of that name, otherwise by what acts there.

    A motor makes it a `hub`, a spring a `joint`, and neither an `arm`; one that moves in metres is an
    `axis` as well.
    """
    if port in PORTS:
        return {port}
    springs = (e for e in mechanism.effects if isinstance(e, Linear) and e.at == port)
    roles = {"hub"} if mechanism.has_motor(port) else set()
    roles |= {"joint"} if any(float(e.stamp().stiffness) != 0 for e in springs) else set()
    along = {"axis"} if mechanism.units.motion == "m" else set()
    return (roles or {"arm"}) | along


def sensor_role(mechanism: Mechanism, channel: str) -> str:
    """What a sensor is: `theta` for the first that shows a position which no spring holds, else `alpha`.

    The angle that nothing holds has no zero of its own, and all gains are relative to its sensor's.
    """
    if channel in SENSORS:
        return channel
    free = [
        name
        for name, (port, what) in mechanism.outputs
        if what == "position" and "joint" not in port_roles(mechanism, port)
    ]
    return "theta" if channel in free[:1] else "alpha"


def search_places(mechanism: Mechanism) -> list[tuple[type[Effect], str]]:
    """Every (class, place) of the catalogue that a search of this machine tries when not told otherwise.

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
    if issubclass(cls, Actuation):
        return list(cls.searched)
    if issubclass(cls, Sensing):
        if cls.relative and len(mechanism.outputs) == 1:
            return []
        roles = {c: {sensor_role(mechanism, c)} for c in mechanism.channels}
    else:
        if cls.turning and mechanism.units.motion != "rad":
            return []
        roles = {p: port_roles(mechanism, p) for p in mechanism.port_vectors}
    wanted = set(cls.searched)
    # A place that the effect itself names comes in its order, others in the machine's.
    named = [place for place in cls.searched if place in roles]
    return named + [
        place for place, role in roles.items() if place not in named and (role | {place}) & wanted
    ]


def calibrations(mechanism: Mechanism) -> list[Place]:
    """What every recording may need to be read rightly, whatever the physics.

    An offset of the voltage, and a bias of every sensor that has a zero of its own; not of one that is
    alone and shows a speed, for there it is the same as the offset.
    """
    alone = len(mechanism.outputs) == 1
    biased = [
        name
        for name, (_, what) in mechanism.outputs
        if sensor_role(mechanism, name) == "alpha" and not (alone and what == "speed")
    ]
    return [("voltage_offset", "input"), *(("sensor_bias", name) for name in biased)]
