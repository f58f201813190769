"""What an effect is: its kinds, what it writes into a linear model, and the catalogue.

A new effect is a frozen dataclass that derives from one kind. A kind says by the attributes of `Effect` where
it acts, which states it has and how a step treats it; the other packages ask these attributes, so that a new
kind is this file, its step in `mechanism/` and its drawing in `docs/generate/effect_figures.py`.

Sign: an effect returns the torque that acts *on* the port in its positive direction, except the `limit` of a
dry friction, which is the (non-negative) level of the torque that opposes sliding.
"""

import abc
import dataclasses
import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import Specification, specifications
from rotflex_jax.recording.samples import name_and_unit

Scalar = Real[Array, "..."] | Real[np.ndarray, "..."] | float | int
"""A number of one state, or an array of them for states side by side."""
Period = float | Float[Array, ""]
"""Sampling period [s]."""
Probe = Mapping[str, float]
"""Parameter name -> value at which a score test tries an effect."""
Drive = Literal["voltage", "motor", "current", "duty"]
Domain = Literal["port", "input", "channel", "signal"]
Beside = Literal["nothing", "other", "states"]
StatePart = Literal["linear", "rotor", "memory"]
EffectType = TypeVar("EffectType", bound="Effect")
# Between a port and the signal that drives an effect there.
_SIGNAL_MARK = ": "


def within(x: Scalar, low: Scalar, high: Scalar) -> Real[Array, "..."]:
    """`x` held within limits; beyond them its derivative is that of the limit, however large its own.

    Not `clip`, which splits the derivative between the branches on a limit itself: of a band without a width
    it would halve the derivative by the width.
    """
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def driven_place(port: str, signal: str) -> str:
    """The place of an effect that a signal drives at a port.

    >>> port_and_signal(driven_place("arm", "base [m/s^2]"))
    ('arm', 'base [m/s^2]')
    """
    return f"{port}{_SIGNAL_MARK}{signal}"


def port_and_signal(place: str) -> tuple[str, str]:
    """Port and signal of such a place; the signal of another one is empty."""
    port, _, signal = place.partition(_SIGNAL_MARK)
    return port, signal


def name_prefix(port: str, effect: str) -> str:
    """What the full names of an effect's parameters begin with."""
    return f"{port}.{effect}."


def full_name(port: str, effect: str, parameter: str) -> str:
    """Name of an effect's parameter in a mechanism.

    >>> full_name("hub", "coulomb", "level")
    'hub.coulomb.level'
    """
    return name_prefix(port, effect) + parameter


class Stamp(NamedTuple):
    """What a linear effect writes into the equations of motion at its port `p`.

    `M += inertia p p'`, `D += damping p p'`, `K += stiffness p p'`, torque `drive voltage` at `p`.
    A linear effect with states `z` of its own adds `z' = own z + from_speed p.dq + from_voltage v`
    (lists of length m, `own` m by m) and the torque `torque . z` at `p`.
    """

    inertia: Scalar = 0.0
    damping: Scalar = 0.0
    stiffness: Scalar = 0.0
    drive: Scalar = 0.0
    own: tuple[tuple[Scalar, ...], ...] = ()
    from_speed: tuple[Scalar, ...] = ()
    from_voltage: tuple[Scalar, ...] = ()
    torque: tuple[Scalar, ...] = ()

    def static(self) -> "Stamp":
        """The same with states of its own at the values that they have at constant speed, as numbers.

        A motor damps its port through its current then.
        """
        damping, drive = float(self.damping), float(self.drive)
        if len(self.own):
            # Not the inverse: a state that nothing brings back has no such value, and adds nothing.
            through = np.array(self.torque, float) @ np.linalg.pinv(np.array(self.own, float))
            damping += float(through @ np.array(self.from_speed, float))
            drive -= float(through @ np.array(self.from_voltage, float))
        return Stamp(float(self.inertia), damping, float(self.stiffness), drive)


# Phase at the ends of the travel of a port, about its middle [rad], below which a law that repeats with the
# angle is a spring or a constant torque there.
HALF_A_PERIOD = 1.5


@dataclasses.dataclass(frozen=True)
class Scale:
    """How large the signals of a recording are, so that an effect can propose shapes worth trying.

    Attributes:
        voltage: Largest |u| [V].
        speed: Root mean square speed of the port [rad/s].
        position: Largest |position| of the port about its mean [rad].
        torque: Root mean square torque the motor can be seen to give [N m].
        stiffness: Of the linear springs at the port [N m/rad].
        inertia: Inertia that a torque at the port accelerates [kg m^2].
        signal: Root mean square of the signal that acts at the port, in its unit.
    """

    voltage: float
    speed: float
    position: float
    torque: float
    stiffness: float = 0.0
    inertia: float = 0.0
    signal: float = 1.0


@dataclasses.dataclass(frozen=True)
class Effect(abc.ABC):
    """One physical mechanism at one port.

    Attributes:
        at: Port it acts at; `input` for actuation, a channel's name for sensing; for what a measured signal
            drives the port and the signal, `"arm: acceleration of link 1 [rad/s^2]"`.

    Raises:
        InputError: At the definition of a class with a `name` that lacks a method or declaration which its
            kind requires; at an instance with a value outside of its bounds.
    """

    # -- declared by each effect
    name: ClassVar[str]
    title: ClassVar[str]
    equation: ClassVar[str]
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    # Parameters that are amplitudes: at zero (all of them) the effect is inactive.
    amplitudes: ClassVar[tuple[str, ...]] = ()
    # Simpler effects that this one contains at special values of its parameters.
    contains: ClassVar[tuple[str, ...]] = ()
    # What several laws describe, such as dry friction; only a model near the noise can tell these laws apart.
    law_of: ClassVar[str] = ""
    # Ports a search tries it at by default, by their roles (`mechanism.roles`); none for what a model has
    # from the start.
    searched: ClassVar[tuple[str, ...]] = ()
    # Its volts are the unit of the input, also where that is no voltage but a current or a goal.
    volts_of_input: ClassVar[bool] = False
    turning: ClassVar[bool] = False  # a function of an angle: no meaning where a port moves along a line
    repeats: ClassVar[str] = ""  # its parameter that counts repetitions per turn of the port
    per_recording: ClassVar[bool] = False  # its parameters belong to a recording, not to the machine
    # Its frequency [Hz], if it is tried only at lines that the errors of a model have and the input has not.
    # All recordings share it; its amplitudes have a phase, so no recording tells those of another.
    line: ClassVar[str] = ""

    # -- declared by each kind
    kind_label: ClassVar[str]
    kind_meaning: ClassVar[str]  # one sentence for the catalogue
    # What `at` names: a port, the voltage, an output, or a port with a signal that acts there.
    acts_on: ClassVar[Domain] = "port"
    # Which part of the state holds its own states, `order` of them; None where it has none.
    state_part: ClassVar[StatePart | None] = None
    is_linear: ClassVar[bool] = False  # enters the matrices of the equations of motion, by a `stamp`
    # One step per sample is exact for it, or it takes no part in the step.
    exact_step: ClassVar[bool] = False
    torque_at_port: ClassVar[bool] = False  # a torque that the step adds to the linear part
    dry_contact: ClassVar[bool] = False  # a torque that the step limits to a level
    # False where a small amplitude changes nothing: no slope at zero shows the effect.
    slope_at_zero: ClassVar[bool] = True
    single: ClassVar[bool] = False  # a mechanism has one of this kind at most
    # Why a linear model of a mechanism leaves it out; empty where it enters by its slope.
    not_linearised: ClassVar[str] = ""

    # While a mechanism is traced its numbers are arrays or placeholders: `__post_init__` checks the values,
    # a checker of annotations at run time would not accept them.
    __no_type_check__: ClassVar[bool] = True

    at: str

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        if not hasattr(cls, "name"):  # a kind, or a base class of several effects
            return
        missing = [] if hasattr(cls, "kind_label") else ["a kind that it derives from"]
        missing += [n for n in dir(cls) if getattr(getattr(cls, n, None), "__isabstractmethod__", False)]
        if cls.searched and cls.probes.__func__ is Effect.probes.__func__:
            missing.append("probes")
        if missing:
            raise InputError(
                f"The effect {cls.__name__} was defined without {', '.join(missing)}, but an effect derives "
                "from a kind and has the methods of this kind; add what is missing."
            )

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
            try:
                number = float(value)
            except OverflowError:  # an integer that no float can hold
                number = math.inf
            if not math.isfinite(number) or not spec.lower <= number <= spec.upper:
                raise InputError(
                    f"{kind} was given {name}={shown(value)} {spec.unit}, but it needs a "
                    f"finite value between {spec.lower:g} and {spec.upper:g}; correct the value."
                )

    @classmethod
    def declared(cls) -> dict[str, Specification]:
        """Parameters of this class, by name."""
        return specifications(cls)

    @property
    def order(self) -> int:
        """Number of states of its own."""
        return 0

    @property
    def follows(self) -> dict[str, str]:
        """Parameter -> the other one of this effect that it always equals; a fit moves the other one."""
        return {}

    @property
    def location(self) -> str:
        """Where it acts, in words."""
        at = f"at {self.at}"
        words = {"port": at, "signal": at, "input": "on the voltage", "channel": f"at the sensor {self.at}"}
        return words[self.acts_on]

    @property
    def port(self) -> str:
        """The place where it acts, without the signal that drives it."""
        return port_and_signal(self.at)[0] if self.acts_on == "signal" else self.at

    @property
    def acts_at_port(self) -> bool:
        """Whether it acts on the motion of a port, driven by a signal or not."""
        return self.acts_on in ("port", "signal")

    @property
    def signal_name(self) -> str:
        """The signal without its unit; empty for most."""
        return name_and_unit(self.signal)[0]

    @property
    def signal_unit(self) -> str:
        """Unit of the signal, per which its parameters are; empty for most."""
        return name_and_unit(self.signal)[1]

    @property
    def signal(self) -> str:
        """The measured signal that drives it in the place of the voltage; empty for most."""
        return port_and_signal(self.at)[1] if self.acts_on == "signal" else ""

    @property
    def name_prefix(self) -> str:
        """What the full names of its parameters begin with."""
        return name_prefix(self.at, self.name)

    def full_name(self, parameter: str) -> str:
        """Name of one of its parameters in a mechanism."""
        return full_name(self.at, self.name, parameter)

    @property
    def values(self) -> dict[str, Any]:
        """Parameter values [declared units], by name."""
        return {name: getattr(self, name) for name in specifications(self)}

    def replace(self: EffectType, **values: Any) -> EffectType:
        """The same effect with other parameter values."""
        return dataclasses.replace(self, **values)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """Parameter sets at which a score test tries the effect.

        Returns:
            Alternatives (different shapes); each a list of parameter sets that are tried together,
            one direction of the test per set. None for what a model has from the start.
        """
        return []

    @classmethod
    def probe_values(cls, scale: Scale) -> tuple[tuple[tuple[float, ...], ...], ...]:
        """What `probes` gives, checked, as values in the order of `declared`.

        Raises:
            InputError: It is no list of lists of mappings, or a mapping has not just the declared parameters,
                each with a finite number.
        """
        given, names = cls.probes(scale), tuple(cls.declared())
        right = "[[{" + ", ".join(f"{n!r}: 0.1" for n in names) + "}]], a list of shapes, each a list of sets"
        if not isinstance(given, Sequence) or not all(isinstance(group, Sequence) for group in given):
            raise InputError(
                f"The probes of {cls.__name__} must be a list of shapes, each a list of parameter sets, but "
                f"are {given!r:.80}; write for instance {right}."
            )
        for probe in (p for group in given for p in group):
            if not isinstance(probe, Mapping):
                raise InputError(
                    f"A probe of {cls.__name__} is {probe!r:.80}, but must name its parameters; write for "
                    f"instance {right}."
                )
            missing = [n for n in names if n not in probe]
            unknown = [str(n) for n in probe if n not in names]
            if missing or unknown:
                what = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(unknown)} too"
                raise InputError(
                    f"A probe of {cls.__name__} {what}, but needs a value for each of its parameters "
                    f"{', '.join(names)} and for nothing else; correct its method `probes`."
                )
            for name, value in probe.items():
                if not isinstance(value, numbers.Real) or not math.isfinite(float(value)):
                    raise InputError(
                        f"A probe of {cls.__name__} has {name}={value!r}, but needs a finite number; correct "
                        "its method `probes`."
                    )
        return tuple(tuple(tuple(float(p[n]) for n in names) for p in group) for group in given)

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """What must be where it acts: `motor`, `inertia`; of a sensor `second output`, `position`."""
        return ()

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
            "kind": cls.kind_label,
            "title": cls.title,
            "equation": cls.equation,
            "ports": list(cls.ports),
            "parameters": {
                n: {"unit": s.unit, "typical": s.typical, "meaning": s.meaning}
                for n, s in cls.declared().items()
            },
        }


# -- kinds ---------------------------------------------------------------------------------------------


class Linear(Effect):
    """Enters the linear part, which the step integrates exactly."""

    kind_label: ClassVar[str] = "linear"
    kind_meaning: ClassVar[str] = (
        "Enters the linear part of the equations, which the step integrates exactly."
    )
    state_part: ClassVar[StatePart | None] = "linear"
    is_linear: ClassVar[bool] = True
    exact_step: ClassVar[bool] = True
    # True for an inertia that turns with its port.
    inertial: ClassVar[bool] = False
    # True for what pulls its port back to zero.
    elastic: ClassVar[bool] = False
    # True for what turns voltage into torque at its port.
    motor: ClassVar[bool] = False
    # True for a motor that has a `torque_per_current`, so that its torque says its current.
    has_current: ClassVar[bool] = False
    # True for a servo that has a `duty`.
    has_duty: ClassVar[bool] = False

    @abc.abstractmethod
    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""

    @property
    def torque_per_current(self) -> Scalar:
        """Torque at the port per current of the armature [N m/A], of a motor that has a current."""
        raise NotImplementedError


class Force(Effect):
    """A smooth (or at least continuous) torque at a port."""

    kind_label: ClassVar[str] = "force"
    kind_meaning: ClassVar[str] = "A torque that depends on position, speed or voltage at this moment."
    torque_at_port: ClassVar[bool] = True
    # The last argument of `force`: the motor's "voltage" [V], or of the "motor" the torque [N m] that its
    # current gives at the port.
    driven_by: ClassVar[Drive] = "voltage"

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        if cls.driven_by not in ("voltage", "motor") or (cls.driven_by, cls.acts_on) == ("motor", "signal"):
            raise InputError(
                f"The force {cls.__name__} was defined as driven by {cls.driven_by!r}, but a force is driven "
                "by the 'voltage', by the torque of the 'motor' at its port or by a signal; choose one."
            )

    @abc.abstractmethod
    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m] on the port; of what a signal drives, its value stands in the place of the voltage."""

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor where its torque is asked for."""
        return ("motor",) if cls.driven_by == "motor" else ()


class DryFriction(Effect):
    """Set-valued friction: any torque within the level holds the port, sliding meets the level."""

    kind_label: ClassVar[str] = "dry friction"
    kind_meaning: ClassVar[str] = (
        "A level that opposes motion; a port at rest is held by any torque within it."
    )
    torque_at_port: ClassVar[bool] = True
    dry_contact: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "has no slope at rest"
    # True where the level is the same at every speed and position: a step need not iterate on it.
    steady: ClassVar[bool] = False
    # True where it depends on the torque that passes from the motor to the machine: `limit` receives it [N m]
    # as a fourth argument, positive where the motor pushes forwards. It is the mean of both sides of the
    # port: of what the motors give and, with its share, of what the rest of the machine takes, dry friction
    # apart.
    loaded: ClassVar[bool] = False

    @property
    def rest_share(self) -> float:
        """Share of the rest of the machine in the transmitted torque, 0 for that of the motors alone."""
        return 0.5

    @abc.abstractmethod
    def limit(self, position: Scalar, speed: Scalar, direction: Scalar, *load: Scalar) -> Scalar:
        """Level [N m] >= 0 that opposes motion in `direction` (+1 or -1) at |speed| [rad/s]."""

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor and an inertia between it and the rest, where the transmitted torque is asked for."""
        return ("motor", "inertia") if cls.loaded else ()


class Memory(Effect):
    """A torque with one state of its own, `dz/dt = flow`.

    Normalise the state so that its flow does not depend on the amplitudes where these are zero: a
    search sees the torque's slope along them there, `z` as it is.
    """

    kind_label: ClassVar[str] = "with memory"
    kind_meaning: ClassVar[str] = "A torque with a state of its own: it depends on what came before."
    state_part: ClassVar[StatePart | None] = "memory"
    torque_at_port: ClassVar[bool] = True
    # The last argument of `flow` and `force`: the motor's voltage [V]; of the motors at its port the torque
    # [N m] or the current [A]; or the duty of the servo there.
    driven_by: ClassVar[Drive] = "voltage"
    # The quantity of its port that its state is the reading of; empty where no output shows it.
    shows: ClassVar[str] = ""
    # What the law keeps the state within; a step that would take it beyond ends there.
    limits: ClassVar[tuple[float, float]] = (-math.inf, math.inf)

    @property
    def order(self) -> int:
        """One state."""
        return 1

    def initial(self) -> float:
        """State at rest."""
        return 0.0

    @abc.abstractmethod
    def flow(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Time derivative of the state [its unit per s]."""

    @abc.abstractmethod
    def force(self, z: Scalar, position: Scalar, speed: Scalar, drive: Scalar) -> Scalar:
        """Torque [N m] on the port."""

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor where its torque is asked for."""
        return ("motor",) if cls.driven_by == "motor" else ()


class Gear(Effect):
    """A gear that lets the motor's rotor turn on its own between two stops, where port and rotor are one."""

    kind_label: ClassVar[str] = "gear"
    kind_meaning: ClassVar[str] = "Motor and machine touch only where the teeth do."
    state_part: ClassVar[StatePart | None] = "rotor"
    slope_at_zero: ClassVar[bool] = False
    single: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "has no slope within the play; the gear is taken as tight"
    # Steps into which a step is cut, so that contact and separation of elastic teeth are apart; more than one
    # only for a gear with `teeth`.
    steps: ClassVar[int] = 1

    @property
    def order(self) -> int:
        """Two states, angle and speed of the rotor against the port."""
        return 2

    @abc.abstractmethod
    def stops(self) -> Scalar:
        """Angle [rad] >= 0 from the middle to each stop; none at zero."""

    @abc.abstractmethod
    def rotor(self) -> Scalar:
        """The rotor's part of the inertia that is entered at the port, above 0 and below 1."""

    def teeth(self) -> tuple[Scalar, Scalar] | None:
        """Stiffness [N m/rad] and damping [N m s/rad] of teeth in contact; None where they are rigid."""
        return None

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor, and an inertia of which the rotor is split off."""
        return ("motor", "inertia")


@dataclasses.dataclass(frozen=True)
class Actuation(Effect):
    """Voltage to voltage, between the recorded command and the motor."""

    kind_label: ClassVar[str] = "actuation"
    kind_meaning: ClassVar[str] = "What lies between the recorded command and the motor."
    acts_on: ClassVar[Domain] = "input"
    volts_of_input: ClassVar[bool] = True
    exact_step: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "acts on the voltage before the motor, which is the input here"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    # Several are applied in this order, from the command to the motor.
    stage: ClassVar[int] = 0
    # Whether the voltage changes within a sample, so that `within_samples` says more than `drive`.
    changes_within_samples: ClassVar[bool] = False

    at: str = "input"

    @abc.abstractmethod
    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """The whole sequence (N,) [V] that reaches the motor."""

    def within_samples(
        self, voltage: Float[Array, " N"], Ts: Period
    ) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        """Mean of the voltage over each sample, and its first moment about the middle, both [V].

        The moment is the mean of `(s - 1/2) v(s)`, with `s` from 0 to 1 over the sample.
        """
        held = self.drive(voltage, Ts)
        return held, jnp.zeros_like(held)


class Sensing(Effect):
    """Output to output: what the sensor of one channel makes of the true value.

    A sensor with dynamics has an `order` and a `stamp`, as a linear effect at the port of its channel; the
    stamp gives the port no torque. `measure` receives its states.
    """

    kind_label: ClassVar[str] = "sensing"
    kind_meaning: ClassVar[str] = "What a sensor makes of the true value."
    acts_on: ClassVar[Domain] = "channel"
    exact_step: ClassVar[bool] = True
    # True for an error that shows only against another sensor.
    relative: ClassVar[bool] = False
    # What `measure` receives after the true value: nothing, the true value of another channel (the first of
    # the others), or the tuple of its own states and the order of the derivative that the channel shows.
    beside: ClassVar[Beside] = "nothing"

    @abc.abstractmethod
    def measure(self, value: Scalar, *beside: Any) -> Scalar:
        """Reading [unit of the channel] for a true value."""

    def largest_reading(self) -> float:
        """The largest reading, either way, that belongs to one true value [unit of the channel]."""
        return math.inf

    def stamp(self) -> Stamp:
        """Equations of its own states; not for a sensor without any."""
        return Stamp()

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A second output where its true value is asked for."""
        return ("second output",) if cls.beside == "other" else ()


KINDS: tuple[type[Effect], ...] = (DryFriction, Force, Memory, Gear, Linear, Actuation, Sensing)
"""All kinds, in the order of the catalogue."""

# -- catalogue -----------------------------------------------------------------------------------------

EffectClass = TypeVar("EffectClass", bound=type[Effect])

CATALOG: dict[str, type[Effect]] = {}
# `law_of` dry friction, which every machine has.
DRY_FRICTION = "dry friction"


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
