"""The seven kinds of effect. A new effect is a frozen dataclass that derives from one of them.

Sign: a law returns the torque that acts *on* the port in its positive direction, except a friction
`limit`, which is the (non-negative) level of the torque that opposes sliding.
"""

import dataclasses
import math
import numbers
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import jax

from rotflex_jax.effects.stamp import Scalar, Stamp
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import Specification, specifications

Probe = Mapping[str, float]
Drive = Literal["voltage", "motor"]


@dataclasses.dataclass(frozen=True)
class Scale:
    """How large the signals of a recording are, so that an effect can propose shapes worth trying.

    Attributes:
        voltage: Largest |u| [V].
        speed: Root mean square speed of the port [rad/s].
        position: Largest |position| of the port about its mean [rad].
        torque: Root mean square torque the motor can be seen to give [N m].
        stiffness: Of the linear springs at the port [N m/rad].
        inertia: What an acceleration of the port meets, all else held [kg m^2].
    """

    voltage: float
    speed: float
    position: float
    torque: float
    stiffness: float = 0.0
    inertia: float = 0.0


@dataclasses.dataclass(frozen=True)
class Effect:
    """One physical mechanism at one port.

    Attributes:
        at: Port it acts at; `input` for actuation, a channel's name for sensing.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    equation: ClassVar[str]
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    # Parameters that are amplitudes: at zero (all of them) the effect is absent.
    amplitudes: ClassVar[tuple[str, ...]] = ()
    # Simpler effects that this one contains at special values of its parameters.
    contains: ClassVar[tuple[str, ...]] = ()
    # Ports a search tries it at when not told otherwise; none for what a model has from the start.
    searched: ClassVar[tuple[str, ...]] = ()
    turning: ClassVar[bool] = False  # a law of an angle: no meaning where a port moves along a line

    at: str

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not isinstance(self.at, str):
            raise InputError(
                f"{kind} was given at={self.at!r}, but it needs the name of a port as its first "
                "argument; give parameters by name."
            )
        for name, spec in specifications(type(self)).items():
            value = getattr(self, name)
            if value is None and getattr(type(self), name) is None:
                continue  # an optional part that the instance lacks
            if value is None or isinstance(value, str):
                raise InputError(
                    f"{kind} was given {name}={value!r}, but it needs a number"
                    f"{f' in {spec.unit}' if spec.unit else ''}; give one."
                )
            if isinstance(value, jax.Array) or not isinstance(value, numbers.Real):
                continue  # traced or symbolic: checked where the number was given
            number = float(value)
            if not math.isfinite(number) or not spec.lower <= number <= spec.upper:
                raise InputError(
                    f"{kind} was given {name}={value!r} {spec.unit}, but it needs a "
                    f"finite value between {spec.lower:g} and {spec.upper:g}; correct the value."
                )

    @classmethod
    def declared(cls) -> dict[str, Specification]:
        """Parameters of this class, by name."""
        return specifications(cls)

    @property
    def values(self) -> dict[str, float]:
        """Parameter values [declared units], by name."""
        return {name: getattr(self, name) for name in specifications(self)}

    def replace(self, **values: Any) -> Self:
        """The same effect with other parameter values."""
        return dataclasses.replace(self, **values)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Parameter sets at which a score test tries the effect.

        Returns:
            Alternatives (different shapes); each a list of parameter sets that are tried together,
            one direction of the test per set.
        """
        raise NotImplementedError

    def sentence(self) -> str:
        """What was found, in words with numbers, for a person."""
        numbers = ", ".join(
            f"{n} {v:.4g} {specifications(self)[n].unit}".rstrip() for n, v in self.values.items()
        )
        return f"{self.title} at the {self.at} ({numbers})"

    @classmethod
    def describe(cls) -> dict[str, Any]:
        """Plain description for tables: name, kind, ports, equation, parameters."""
        return {
            "name": cls.name,
            "class": cls.__name__,
            "kind": cls.kind(),
            "title": cls.title,
            "equation": cls.equation,
            "ports": list(cls.ports),
            "parameters": {
                n: {"unit": s.unit, "typical": s.typical, "meaning": s.meaning}
                for n, s in cls.declared().items()
            },
        }

    @classmethod
    def kind(cls) -> str:
        """Name of the kind, for instance 'dry friction'."""
        return next(label for base, label in KIND_LABELS.items() if issubclass(cls, base))


class Linear(Effect):
    """Enters the linear part, which the step integrates exactly."""

    # True for what turns voltage into torque at its port.
    motor: ClassVar[bool] = False

    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""
        raise NotImplementedError

    @property
    def order(self) -> int:
        """Number of states of its own."""
        return 0


class Force(Effect):
    """A smooth (or at least continuous) torque law at a port."""

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        raise NotImplementedError


class Gear(Effect):
    """A gear that lets the motor's rotor turn on its own between two stops, where port and rotor are one."""

    order: ClassVar[int] = 2  # angle and speed of the rotor against the port

    def stops(self) -> Scalar:
        """Angle [rad] >= 0 from the middle to each stop; none at zero."""
        raise NotImplementedError

    def rotor(self) -> Scalar:
        """The rotor's part of the inertia that is entered at the port, above 0 and below 1."""
        raise NotImplementedError


class DryFriction(Effect):
    """Set-valued friction: any torque within the level holds the port, sliding meets the level."""

    # True where the level is the same at every speed and position: a step need not iterate on it.
    steady: ClassVar[bool] = False

    def limit(self, position: Scalar, speed: Scalar, direction: float) -> Scalar:
        """Level [N m] >= 0 that opposes motion in `direction` (+1 or -1) at |speed| [rad/s]."""
        raise NotImplementedError


class Memory(Effect):
    """A torque law with one state of its own, `dz/dt = flow`.

    Normalise the state so that its flow does not depend on the amplitudes where these are zero: a
    search sees the torque's slope along them there, `z` as it is.
    """

    # The last argument of its laws: the motor's voltage [V], or the torque [N m] of the motors at its port.
    driven_by: ClassVar[Drive] = "voltage"

    def initial(self) -> float:
        """State at rest."""
        return 0.0

    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [its unit per s]."""
        raise NotImplementedError

    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Actuation(Effect):
    """Voltage to voltage, between the recorded command and the motor."""

    ports: ClassVar[tuple[str, ...]] = ("input",)
    # Several are applied in this order: what sits nearer to the command comes first.
    stage: ClassVar[int] = 0

    at: str = "input"

    def drive(self, voltage: jax.Array, Ts: Scalar) -> jax.Array:
        """The whole sequence (N,) [V] that reaches the motor."""
        raise NotImplementedError


class Sensing(Effect):
    """Output to output: what the sensor of one channel makes of the true value."""

    # True for an error that shows only against another sensor.
    relative: ClassVar[bool] = False

    def measure(self, value: Scalar) -> Scalar:
        """Reading [unit of the channel] for a true value."""
        raise NotImplementedError


KIND_LABELS: dict[type, str] = {
    Linear: "linear",
    Force: "force",
    DryFriction: "dry friction",
    Gear: "gear",
    Memory: "with memory",
    Actuation: "actuation",
    Sensing: "sensing",
}
