"""Base classes of effects: the kinds, the entries of linear effects, and the catalogue.

A new effect is a frozen dataclass that derives from one kind. The class attributes of a kind, declared in
`Effect`, state where its effects act, which states they have and how an integration step treats them. The
other packages read these attributes. So a new kind needs a class in this file, its step in `mechanism/` and
its drawing in `docs/generate/effect_figures.py`.

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

from rotflex_jax.checks import known_arguments, shown
from rotflex_jax.errors import InputError
from rotflex_jax.parameters import Specification, specifications
from rotflex_jax.recording.samples import name_and_unit

Scalar = Real[Array, "..."] | Real[np.ndarray, "..."] | float | int
"""A number for one state, or an array of numbers for several states at once."""
Period = float | Float[Array, ""]
"""Sampling period [s]."""
Probe = Mapping[str, float]
"""Parameter name -> value at which a score test tries an effect."""
Drive = Literal["voltage", "motor", "current", "duty"]
Domain = Literal["port", "input", "channel", "signal"]
Beside = Literal["nothing", "other", "states"]
StatePart = Literal["linear", "rotor", "memory"]
EffectType = TypeVar("EffectType", bound="Effect")
# Values that are no number, though some could be turned into one. Other types may be traced or symbolic.
_NO_NUMBERS = (str, bytes, bool, np.bool_, complex, list, tuple, dict, np.ndarray, type(None))
# Separator of a port and the signal that drives an effect there.
_SIGNAL_MARK = ": "


def within(x: Scalar, low: Scalar, high: Scalar) -> Real[Array, "..."]:
    """`x` limited to an interval; outside of it the derivative is the derivative of the limit alone.

    `clip` is no substitute: exactly at a limit it splits the derivative between the branches. For a band of
    zero width it would halve the derivative with respect to the width.
    """
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def driven_place(port: str, signal: str) -> str:
    """Place (`Effect.at`) of an effect that a signal drives at a port.

    >>> port_and_signal(driven_place("arm", "base [m/s^2]"))
    ('arm', 'base [m/s^2]')
    """
    return f"{port}{_SIGNAL_MARK}{signal}"


def port_and_signal(place: str) -> tuple[str, str]:
    """Port and signal of a place; the signal is empty if the place has none."""
    port, _, signal = place.partition(_SIGNAL_MARK)
    return port, signal


def name_prefix(port: str, effect: str) -> str:
    """Beginning of the full names of an effect's parameters."""
    return f"{port}.{effect}."


def full_name(port: str, effect: str, parameter: str) -> str:
    """Name of an effect's parameter in a mechanism.

    >>> full_name("hub", "coulomb", "level")
    'hub.coulomb.level'
    """
    return name_prefix(port, effect) + parameter


class Stamp(NamedTuple):
    """Entries of a linear effect in the equations of motion, at its port `p`.

    `M += inertia p p'`, `D += damping p p'`, `K += stiffness p p'`, torque `drive voltage` at `p`.
    A linear effect with states `z` of its own adds `z' = own z + from_speed p.dq + from_voltage v`
    (tuples of length m, `own` m by m) and the torque `torque . z` at `p`.
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
        """The entries as floats, with own states replaced by their values at constant speed and voltage.

        For a motor with inductance, `damping` then contains the braking by the back-EMF.
        """
        damping, drive = float(self.damping), float(self.drive)
        if len(self.own):
            # The pseudoinverse, because a pure integrator has no steady value; it then adds nothing.
            through = np.array(self.torque, float) @ np.linalg.pinv(np.array(self.own, float))
            damping += float(through @ np.array(self.from_speed, float))
            drive -= float(through @ np.array(self.from_voltage, float))
        return Stamp(float(self.inertia), damping, float(self.stiffness), drive)


# Phase of a torque that repeats with the angle, from the middle to the ends of the travel of a port [rad].
# Below this value the torque cannot be distinguished from a spring or a constant torque.
HALF_A_PERIOD = 1.5


@dataclasses.dataclass(frozen=True)
class Scale:
    """Sizes of the signals of a recording at one place, from which an effect chooses its probes.

    Attributes:
        voltage: Largest |u| [V].
        speed: Root mean square speed of the port [rad/s].
        position: Largest |position| of the port about its mean [rad]; for a channel the standard deviation
            of the output.
        torque: Torque that the motor gives at the root mean square voltage [N m].
        stiffness: Stiffness of the linear springs at the port [N m/rad].
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
        at: Port at which it acts; `input` for actuation; the name of a channel for sensing; port and signal
            for an effect that a measured signal drives, as `"arm: acceleration of link 1 [rad/s^2]"`.

    Raises:
        InputError: If a class with a `name` is defined without a method or declaration that its kind
            requires; or if an instance is given an `at` that is no text, or a parameter that is no finite
            number or is outside of its bounds.
    """

    # -- declared by each effect
    name: ClassVar[str]
    title: ClassVar[str]
    equation: ClassVar[str]
    ports: ClassVar[tuple[str, ...]] = ("hub", "arm", "joint")
    # Parameters that are amplitudes: the effect is inactive if all of them are zero.
    amplitudes: ClassVar[tuple[str, ...]] = ()
    # Further parameters with which the effect vanishes, such as the time of a delay, which is scored at a few
    # sizes and not by a derivative at zero. Fits of a search also start from small values of them.
    vanishes_with: ClassVar[tuple[str, ...]] = ()
    # Simpler effects that this one contains at special values of its parameters.
    contains: ClassVar[tuple[str, ...]] = ()
    # Phenomenon that several laws describe, such as dry friction. Only a model with errors near the noise can
    # distinguish these laws.
    law_of: ClassVar[str] = ""
    # Places at which a search tries it by default, by their roles (`mechanism.roles`). Empty for an effect
    # that is searched only on request, or that a model has from the start.
    searched: ClassVar[tuple[str, ...]] = ()
    # True if volts in its parameters stand for the unit of the input, which may be a current or a goal too.
    volts_of_input: ClassVar[bool] = False
    turning: ClassVar[bool] = False  # a function of an angle: no meaning where a port moves along a line
    repeats: ClassVar[str] = ""  # name of its parameter for the number of repetitions per turn of the port
    per_recording: ClassVar[bool] = False  # its parameters belong to a recording, not to the machine
    # Name of its frequency [Hz], for an effect that is tried only at spectral lines which the errors of a
    # model have and the input lacks. All recordings share the frequency. The amplitudes contain a phase, so
    # that each recording has its own.
    line: ClassVar[str] = ""

    # -- declared by each kind
    kind_label: ClassVar[str]
    kind_meaning: ClassVar[str]  # one sentence for the catalogue
    # What `at` names: a port, the voltage, an output, or a port with a signal that acts there.
    acts_on: ClassVar[Domain] = "port"
    # Part of the state that contains the `order` states of the effect; None if it has no states.
    state_part: ClassVar[StatePart | None] = None
    is_linear: ClassVar[bool] = False  # enters the matrices of the equations of motion, by a `stamp`
    # True if one step per sample is exact for it, or if it takes no part in the step.
    exact_step: ClassVar[bool] = False
    torque_at_port: ClassVar[bool] = False  # a torque that the step adds to the linear part
    dry_contact: ClassVar[bool] = False  # a torque that the step limits to a level
    # False if a small amplitude changes nothing: the derivatives at zero amplitude do not show the effect.
    slope_at_zero: ClassVar[bool] = True
    single: ClassVar[bool] = False  # a mechanism has at most one effect of this kind
    # Reason why a linear model of a mechanism omits it, as part of a message; empty if its slope enters.
    not_linearised: ClassVar[str] = ""

    # While JAX traces a mechanism, its parameters are arrays or placeholders, which a run-time checker of
    # annotations would not accept. `__post_init__` checks the values.
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
                continue  # an optional part that the instance does not have
            if isinstance(value, np.ndarray) and value.ndim == 0:
                value = value[()]  # an array has no hash, a number has one
                object.__setattr__(self, name, value)
            # Arrays of JAX may be derivatives, which have any size and shape.
            vector = getattr(value, "ndim", 0) > 0 and not isinstance(value, jax.Array)
            if vector or isinstance(value, _NO_NUMBERS):
                raise InputError(
                    f"{kind} was given {name}={shown(value)}, but it needs a number"
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
        """Number of states of the effect."""
        return 0

    @property
    def follows(self) -> dict[str, str]:
        """Tied parameter -> parameter of this effect that it always equals; a fit moves only the latter."""
        return {}

    @property
    def location(self) -> str:
        """Where the effect acts, in words."""
        at = f"at {self.at}"
        words = {"port": at, "signal": at, "input": "on the voltage", "channel": f"at the sensor {self.at}"}
        return words[self.acts_on]

    @property
    def port(self) -> str:
        """The place where the effect acts, without the signal that drives it."""
        return port_and_signal(self.at)[0] if self.acts_on == "signal" else self.at

    @property
    def acts_at_port(self) -> bool:
        """Whether the effect acts on the motion of a port, driven by a signal or not."""
        return self.acts_on in ("port", "signal")

    @property
    def signal_name(self) -> str:
        """Name of the signal without its unit; empty for an effect without a signal."""
        return name_and_unit(self.signal)[0]

    @property
    def signal_unit(self) -> str:
        """Unit of the signal, to which the parameters refer; empty for an effect without a signal."""
        return name_and_unit(self.signal)[1]

    @property
    def signal(self) -> str:
        """Measured signal that drives it in place of the voltage; empty for an effect without a signal."""
        return port_and_signal(self.at)[1] if self.acts_on == "signal" else ""

    @property
    def name_prefix(self) -> str:
        """Beginning of the full names of its parameters."""
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
            one direction of the test per set. Empty for an effect that a model has from the start.
        """
        return []

    @classmethod
    def probe_values(cls, scale: Scale) -> tuple[tuple[tuple[float, ...], ...], ...]:
        """The checked result of `probes`, as values in the order of `declared`.

        Raises:
            InputError: If `probes` does not return a list of lists of mappings, or a mapping does not give a
                finite number for exactly the declared parameters.
        """
        given, names = cls.probes(scale), tuple(cls.declared())
        strange = [n for n in (*cls.amplitudes, *cls.vanishes_with) if n not in names]
        if strange:
            raise InputError(
                f"{cls.__name__} has {', '.join(map(repr, strange))} in `amplitudes` or `vanishes_with`, but "
                f'its parameters are {", ".join(names)}; write a tuple of names as ("{names[0]}",).'
            )
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
        """What it needs where it acts, such as `motor` or `inertia`; a sensor may need a `second output`."""
        return ()

    def sentence(self) -> str:
        """The effect with its values, in one sentence."""
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
    """An effect in the linear part of the equations, which the step integrates exactly."""

    kind_label: ClassVar[str] = "linear"
    kind_meaning: ClassVar[str] = (
        "Enters the linear part of the equations, which the step integrates exactly."
    )
    state_part: ClassVar[StatePart | None] = "linear"
    is_linear: ClassVar[bool] = True
    exact_step: ClassVar[bool] = True
    # True for an inertia that turns with its port.
    inertial: ClassVar[bool] = False
    # True for a spring, whose torque returns its port to zero.
    elastic: ClassVar[bool] = False
    # True for a motor, which converts the input to a torque at its port.
    motor: ClassVar[bool] = False
    # True for a motor that has a `torque_per_current`, so that its current follows from its torque.
    has_current: ClassVar[bool] = False
    # True for a servo that has a `duty`.
    has_duty: ClassVar[bool] = False

    @abc.abstractmethod
    def stamp(self) -> Stamp:
        """Entries of the equations of motion."""

    @property
    def torque_per_current(self) -> Scalar:
        """Torque at the port per armature current [N m/A], for a motor with `has_current`."""
        raise NotImplementedError


class Force(Effect):
    """A smooth (or at least continuous) torque at a port.

    Raises:
        InputError: If a class is defined with a `driven_by` that a force cannot have.
    """

    kind_label: ClassVar[str] = "force"
    kind_meaning: ClassVar[str] = "A torque that depends on position, speed or voltage at this moment."
    torque_at_port: ClassVar[bool] = True
    # Last argument of `force`: for "voltage" the voltage of the motor [V], for "motor" the torque [N m] that
    # the current of the motor gives at the port.
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
        """Torque [N m] on the port.

        Args:
            position: Position of the port [rad].
            speed: Speed of the port [rad/s].
            voltage: Voltage of the motor [V]; the value of the signal for an effect with a signal, and the
                torque of the motor [N m] for an effect that is `driven_by` it.
        """

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor, if the effect depends on the torque of the motor."""
        return ("motor",) if cls.driven_by == "motor" else ()


class DryFriction(Effect):
    """Set-valued friction: the level opposes sliding, and any torque within it holds a port at rest."""

    kind_label: ClassVar[str] = "dry friction"
    kind_meaning: ClassVar[str] = (
        "A level that opposes motion; a port at rest is held by any torque within it."
    )
    torque_at_port: ClassVar[bool] = True
    dry_contact: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "has no slope at rest"
    # True if the level does not depend on speed and position, so that a step need not iterate on it.
    steady: ClassVar[bool] = False
    # True if the level depends on the torque that the port transmits from the motor to the machine. `limit`
    # receives this torque [N m] as a fourth argument, positive where the motor pushes forwards. It is a
    # weighted mean of the torque of the motors and the torque that the rest of the machine takes, without dry
    # friction; the latter has the weight `rest_share`.
    loaded: ClassVar[bool] = False

    @property
    def rest_share(self) -> float:
        """Weight of the rest of the machine in the transmitted torque; 0 for the motors alone."""
        return 0.5

    @abc.abstractmethod
    def limit(self, position: Scalar, speed: Scalar, direction: Scalar, *load: Scalar) -> Scalar:
        """Level [N m] >= 0 that opposes motion in `direction` (+1 or -1) at |speed| [rad/s]."""

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor, and an inertia between motor and machine, if the level depends on the torque between."""
        return ("motor", "inertia") if cls.loaded else ()


class Memory(Effect):
    """A torque with one state of its own, `dz/dt = flow`.

    Normalise the state so that its flow does not depend on the amplitudes where these are zero. A search
    takes the derivative of the torque with respect to the amplitudes there, with `z` unchanged.
    """

    kind_label: ClassVar[str] = "with memory"
    kind_meaning: ClassVar[str] = "A torque with a state of its own: it depends on what came before."
    state_part: ClassVar[StatePart | None] = "memory"
    torque_at_port: ClassVar[bool] = True
    # Last argument of `flow` and `force`: the voltage [V], the torque [N m] or the current [A] of the motors
    # at its port, or the duty of the servo there.
    driven_by: ClassVar[Drive] = "voltage"
    # Quantity of its port of which the state is the reading; empty if no output shows the state.
    shows: ClassVar[str] = ""
    # Bounds within which the law keeps the state. A step that would exceed a bound ends at it.
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
        """A motor, if the effect depends on the torque of the motor."""
        return ("motor",) if cls.driven_by == "motor" else ()


class Gear(Effect):
    """A gear with play: the motor's rotor turns freely between two stops, and drives the port at a stop."""

    kind_label: ClassVar[str] = "gear"
    kind_meaning: ClassVar[str] = "Motor and machine touch only where the teeth do."
    state_part: ClassVar[StatePart | None] = "rotor"
    slope_at_zero: ClassVar[bool] = False
    single: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "has no slope within the play; the gear is taken as tight"
    # Number of parts into which a step is divided, so that contact and separation of elastic teeth fall into
    # different parts; more than one only for a gear with `teeth`.
    steps: ClassVar[int] = 1

    @property
    def order(self) -> int:
        """Two states, angle and speed of the rotor relative to the port."""
        return 2

    @abc.abstractmethod
    def stops(self) -> Scalar:
        """Angle [rad] >= 0 from the middle of the play to each stop; zero for a gear without play."""

    @abc.abstractmethod
    def rotor(self) -> Scalar:
        """Share of the rotor in the inertia that is declared at the port, above 0 and below 1."""

    def teeth(self) -> tuple[Scalar, Scalar] | None:
        """Stiffness [N m/rad] and damping [N m s/rad] of teeth in contact; None for rigid teeth."""
        return None

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A motor, and an inertia from which the inertia of the rotor is split off."""
        return ("motor", "inertia")


@dataclasses.dataclass(frozen=True)
class Actuation(Effect):
    """An effect on the voltage, between the recorded command and the motor."""

    kind_label: ClassVar[str] = "actuation"
    kind_meaning: ClassVar[str] = "What lies between the recorded command and the motor."
    acts_on: ClassVar[Domain] = "input"
    volts_of_input: ClassVar[bool] = True
    exact_step: ClassVar[bool] = True
    not_linearised: ClassVar[str] = "acts on the voltage before the motor, which is the input here"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    # Order in which several of these effects are applied, from the command to the motor.
    stage: ClassVar[int] = 0
    # Whether the voltage changes within a sample, so that `within_samples` contains more than `drive`.
    changes_within_samples: ClassVar[bool] = False

    at: str = "input"

    @abc.abstractmethod
    def drive(self, voltage: Float[Array, " N"], Ts: Period) -> Float[Array, " N"]:
        """Voltage at the motor for a whole sequence of commands (N,) [V]."""

    def within_samples(
        self, voltage: Float[Array, " N"], Ts: Period
    ) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
        """Mean of the voltage over each sample, and its first moment about the middle, both [V].

        The moment is the mean of `(s - 1/2) v(s)`, with `s` from 0 to 1 over the sample.
        """
        held = self.drive(voltage, Ts)
        return held, jnp.zeros_like(held)


class Sensing(Effect):
    """An effect on one output: the reading of the sensor of a channel for a true value.

    A sensor with dynamics has an `order` and a `stamp`, like a linear effect at the port of its channel, but
    the stamp gives the port no torque. `measure` receives the states.
    """

    kind_label: ClassVar[str] = "sensing"
    kind_meaning: ClassVar[str] = "What a sensor makes of the true value."
    acts_on: ClassVar[Domain] = "channel"
    exact_step: ClassVar[bool] = True
    # True for an error that shows only in comparison with another sensor.
    relative: ClassVar[bool] = False
    # Further arguments of `measure` after the true value: none; the true value of another channel (the first
    # of the others); or the tuple of the sensor's states and the order of the derivative that the channel
    # shows.
    beside: ClassVar[Beside] = "nothing"

    @abc.abstractmethod
    def measure(self, value: Scalar, *beside: Any) -> Scalar:
        """Reading [unit of the channel] for a true value."""

    def largest_reading(self) -> float:
        """Largest absolute reading up to which the characteristic has an inverse [unit of the channel]."""
        return math.inf

    def stamp(self) -> Stamp:
        """Equations of the sensor's own states; empty for a sensor without states."""
        return Stamp()

    @classmethod
    def needs(cls) -> tuple[str, ...]:
        """A second output, if `measure` takes the true value of another channel."""
        return ("second output",) if cls.beside == "other" else ()


KINDS: tuple[type[Effect], ...] = (DryFriction, Force, Memory, Gear, Linear, Actuation, Sensing)
"""All kinds, in the order of the catalogue."""

# -- catalogue -----------------------------------------------------------------------------------------

EffectClass = TypeVar("EffectClass", bound=type[Effect])

CATALOG: dict[str, type[Effect]] = {}
# Value of `law_of` for the laws of dry friction, which every machine has.
DRY_FRICTION = "dry friction"


def register(effect: EffectClass) -> EffectClass:
    """Enters an effect class under its `name`; use it as the outermost decorator.

    Args:
        effect: A frozen dataclass that derives from one of the kinds.

    Returns:
        The class, whose constructor refuses arguments that it does not have with one sentence.

    Raises:
        InputError: If another class already has the name.
    """
    known = CATALOG.setdefault(effect.name, effect)
    # If a module is run again (a notebook cell, a reload), its class replaces the earlier one.
    if (known.__module__, known.__qualname__) != (effect.__module__, effect.__qualname__):
        raise InputError(
            f"The effect name '{effect.name}' is taken by {known.__qualname__}; an effect needs a "
            f"name of its own, so give {effect.__qualname__} another one."
        )
    CATALOG[effect.name] = effect
    effect.__init__ = known_arguments(effect.__init__)
    return effect
