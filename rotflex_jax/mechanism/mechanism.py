"""A mechanism: coordinates, named ports, effects at the ports and outputs; checked when it is created."""

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax import checks
from rotflex_jax.checks import number, shown
from rotflex_jax.effects.base import DryFriction, Effect, Linear, Memory, Sensing, driven_place, name_prefix
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.quantity import TURNING, Quantity, Units
from rotflex_jax.parameters import Specification, specifications
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import equation, unit_text


def checked_ports(given: Any) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """The ports as pairs of name and vector, checked."""
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


def checked_outputs(given: Any) -> tuple[tuple[str, tuple[str, str]], ...]:
    """The outputs as pairs of channel and (port, measured quantity), checked."""
    if not isinstance(given, (Mapping, tuple)) or (given and isinstance(given, tuple) and len(given[0]) != 2):
        raise InputError(
            f"The outputs were given as {given!r}, but they are channels with the port that each measures; "
            'write for instance {"encoder": "motor", "tacho": ("drum", "speed")}.'
        )
    each = {
        k: (v, Quantity.POSITION.value) if isinstance(v, str) else checks.entries(v)
        for k, v in dict(given).items()
    }
    for channel, pair in each.items():
        if pair is None or len(pair) != 2:
            raise InputError(
                f"Output {channel!r} was given as {shown(pair)}, but needs a port, or a port and 'speed'; "
                f'write for instance {{"{channel}": ("drum", "speed")}}.'
            )
    return tuple((k, (v[0], v[1])) for k, v in each.items() if v is not None)


def checked_effects(given: Any) -> tuple[Effect, ...]:
    """The effects as a tuple, in their order, checked."""
    sequence = checks.entries(given)
    if sequence is None and not isinstance(given, Effect | type):
        raise InputError(f"The effects were given as {shown(given)}, but a list is needed; give one.")
    listed: tuple[Any, ...] = (given,) if sequence is None else sequence
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


def checked_units(given: Any) -> Units:
    """The units of the ports, checked; a pair such as `("m", "N")` is taken too."""
    entries = checks.entries(given)
    if entries is not None and 2 <= len(entries) <= len(TURNING):
        units = Units(*entries)
        words, sizes = (units.motion, units.effort, units.input), (units.motion_size, units.effort_size)
        if all(isinstance(w, str) and w for w in words) and all(checks.real(size) > 0 for size in sizes):
            return units
    raise InputError(
        f"The units were given as {given!r}, but are those of a position and of a force or torque; write for "
        'instance ("m", "N"), or Units("m", "N", input="A") for a machine that is driven by a current.'
    )


def process_noise_of(mechanism: "Mechanism", given: Any) -> dict[str, float]:
    """Port -> intensity of the process noise, checked; empty for None."""
    if not (given is None or isinstance(given, Mapping)):
        raise InputError(
            f"Argument `process_noise` must give an intensity for each port, but is {shown(given)}; write "
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


def check_parts(mechanism: "Mechanism") -> None:
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
    instruments = {(e.at, e.shows) for e in mechanism.effects if isinstance(e, Memory)}
    for channel, (port, what) in mechanism.outputs:
        if port not in ports or what not in Quantity.names():
            raise InputError(
                f"Output {channel!r} was given as {(port, what)}, but it needs one of the ports "
                f"{tuple(ports)} with {' or '.join(map(repr, Quantity.names()))}; correct the output."
            )
        if not Quantity(what).of_motion and (port, what) not in instruments:
            raise InputError(
                f"Output {channel!r} was given as the {what} at {port!r}, but it needs an effect there that "
                f"shows it; put a {what.capitalize()}Meter({port!r}) among the effects."
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
    shares: dict[str, float] = {}
    for effect in (e for e in mechanism.effects if isinstance(e, DryFriction) and e.loaded):
        if shares.setdefault(effect.at, effect.rest_share) != effect.rest_share:
            raise InputError(
                f"Two frictions at {effect.at!r} were put there that depend on different torques through the "
                "gear, of the motor alone and of both sides, but only one of them is possible; leave one."
            )


def _check_surroundings(mechanism: "Mechanism", effect: Effect) -> None:
    """Check that the port has what the effect needs, and that a `single` effect is alone of its kind."""
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


ROTOR = "rotor"
"""Name of the port on the motor's side of a gear with play.

A mechanism with such a gear has this port in addition to its own ports.
"""


class _Slot:
    """Placeholder of a parameter value in a structure."""

    def __repr__(self) -> str:
        return "·"

    def __reduce__(self) -> str:
        return "_SLOT"  # the same single object, also in another process


_SLOT = _Slot()


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True)
class Mechanism:
    """A machine as coordinates `q`, ports `p`, effects at the ports, and outputs.

    A port is a vector: its position is p.q, its speed is p.dq, and a torque tau at the port acts on the
    coordinates as p tau.

        M ddq + D dq + K q = sum over ports of p tau,   y = outputs of (q, dq)

    Args:
        coordinates: Names of the coordinates.
        ports: Name -> vector, one entry per coordinate.
        effects: Physical effects; inertias, springs, dampers and the motor among them.
        outputs: Channel -> port (its position) or (port, "speed").
        trusted: Full names `port.effect.parameter` of the parameters that a fit holds at their values.
        units: Units of the ports, such as ("m", "N"), see `Units`; ("rad", "N m") by default.
        signals: Names of the measured signals that may drive effects in addition to the input. The signals
            that the effects name are added.

    Raises:
        InputError: A port, an output or a trusted name does not exist, two equal effects are at one port, or
            a port lacks what an effect needs.

    A mechanism is a pytree whose leaves are the parameter values, so it passes through `jax.jit` and
    `jax.grad`; `mechanism + effect` is a new mechanism.
    """

    coordinates: tuple[str, ...]
    ports: Any
    effects: tuple[Effect, ...] = ()
    outputs: Any = ()
    trusted: Any = frozenset()
    units: Units = TURNING
    signals: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - frozen class
        put("coordinates", checks.names(self.coordinates, "coordinates"))
        put("ports", checked_ports(self.ports))
        put("effects", checked_effects(self.effects))
        put("outputs", checked_outputs(self.outputs))
        put("trusted", frozenset(checks.names(self.trusted, "trusted")))
        put("units", checked_units(self.units))
        known = (*checks.names(self.signals, "signals"), *(e.signal for e in self.effects if e.signal))
        put("signals", tuple(dict.fromkeys(known)))
        check_parts(self)
        put("trusted", self.trusted | set(self.followers))  # a fit moves the parameters that these follow
        for name in sorted(self.trusted):
            self._must_exist(name)

    def _must_exist(self, name: str) -> None:
        if name not in self.parameter_names:
            raise InputError(
                f"Parameter {name!r} was named, but this mechanism has {', '.join(self.parameter_names)}; "
                f"use one of these names."
            )

    # -- structure ---------------------------------------------------------------------------------

    @property
    def port_vectors(self) -> dict[str, tuple[float, ...]]:
        """Port name -> vector over the coordinates; with play in a gear also `rotor`.

        The vector of `rotor` holds while the teeth touch.
        """
        vectors = dict(self.ports)
        for e in self.effects:
            if e.state_part == "rotor" and e.at in vectors:
                vectors.setdefault(ROTOR, vectors[e.at])
        return vectors

    def on_rotor(self, port: str) -> bool:
        """Whether a port is on the motor's side of a gear with play."""
        return port == ROTOR and ROTOR not in dict(self.ports) and ROTOR in self.port_vectors

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return tuple(channel for channel, _ in self.outputs)

    @property
    def takes_signals(self) -> bool:
        """Whether a measured signal drives an effect, in addition to the input."""
        return any(e.signal for e in self.effects)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What each output measures, in order."""
        return tuple(Quantity(what) for _, (_, what) in self.outputs)

    @functools.cached_property
    def structure(self) -> "Mechanism":
        """The mechanism without parameter values; hashable, and equal for equal structure."""
        empty = tuple(e.replace(**dict.fromkeys(e.values, _SLOT)) for e in self.effects)
        return dataclasses.replace(self, effects=empty, trusted=frozenset())

    def __add__(self, effect: Effect) -> "Mechanism":
        """The mechanism with one more effect."""
        if not isinstance(effect, Effect):
            kind = effect if isinstance(effect, type) and issubclass(effect, Effect) else DryFriction
            name = "Coulomb" if kind is DryFriction else kind.__name__
            raise InputError(
                f"Only an effect can be added to a mechanism, but {shown(effect)} was given; give an effect "
                f"with the place where it acts, such as rotflex_jax.effects.{name}"
                f"(at={next(iter(self.locations(kind)), 'hub')!r})."
            )
        return dataclasses.replace(self, effects=(*self.effects, effect))

    def without(self, name: str, at: str) -> "Mechanism":
        """The mechanism without the effect `name` at port `at`."""
        others = tuple(e for e in self.effects if (e.name, e.at) != (name, at))
        if len(others) == len(self.effects):
            present = ", ".join(f"{e.name} at {e.at}" for e in self.effects)
            raise InputError(
                f"{name!r} at {at!r} was to be removed, but the mechanism has {present}; name one."
            )
        prefix = name_prefix(at, name)
        trusted = frozenset(t for t in self.trusted if not t.startswith(prefix))
        taken, removed = {e.signal for e in others}, self.effect(name, at).signal
        signals = tuple(s for s in self.signals if s != removed or s in taken)
        return dataclasses.replace(self, effects=others, trusted=trusted, signals=signals)

    def effect(self, name: str, at: str) -> Effect:
        """The effect `name` at port `at`."""
        for e in self.effects:
            if (e.name, e.at) == (name, at):
                return e
        raise InputError(f"{name!r} at {at!r} was asked for, but the mechanism lacks it; add it first.")

    def locations(self, effect: Effect | type[Effect]) -> tuple[str, ...]:
        """Where an effect can act: the ports, ports with a signal, the voltage (`input`), or the outputs."""
        if effect.acts_on == "input":
            return ("input",)
        if effect.acts_on == "signal":
            return tuple(driven_place(port, s) for s in self.signals for port in self.port_vectors)
        return self.channels if effect.acts_on == "channel" else tuple(self.port_vectors)

    def vector(self, effect: Effect) -> tuple[float, ...]:
        """Vector of the port at which an effect acts; for a sensor, of the port that it measures."""
        port = dict(self.outputs)[effect.at][0] if effect.acts_on == "channel" else effect.port
        return self.port_vectors[port]

    def quantity(self, channel: str) -> Quantity:
        """What a channel measures."""
        return self.quantities[self.channels.index(channel)]

    def linear_effects(self, port: str) -> list[Linear]:
        """Linear effects at a port."""
        return [e for e in self.effects if isinstance(e, Linear) and e.at == port]

    def lacking(self, effect: Effect | type[Effect], port: str) -> list[str]:
        """What an effect needs at a port or an output but does not find there: `motor`, `inertia`, ..."""
        has: dict[str, Callable[[str], bool]] = {
            "motor": self.has_motor,
            "inertia": self.has_inertia,
            "motor whose current is known": lambda port: any(
                e.has_current for e in self.linear_effects(port)
            ),
            "servo": lambda port: any(e.has_duty for e in self.linear_effects(port)),
            "second output": lambda channel: len(self.outputs) > 1,
            "position": lambda channel: self.quantity(channel).is_position,
            "position or speed": lambda channel: self.quantity(channel).derivative <= 1,
        }
        return [name for name in effect.needs() if not has[name](port)]

    def accepts(self, effect: type[Effect], at: str) -> bool:
        """Whether an effect of this class can be added at a port, at the voltage or at an output."""
        taken = effect.single and any(e.kind_label == effect.kind_label for e in self.effects)
        return at in self.locations(effect) and not self.lacking(effect, at) and not taken

    def has_motor(self, port: str) -> bool:
        """Whether a linear motor drives the port."""
        return any(e.motor for e in self.linear_effects(port))

    def has_inertia(self, port: str) -> bool:
        """Whether an effect at the port has an inertia."""
        return any(e.inertial for e in self.linear_effects(port))

    def with_signals(self, names: Sequence[str]) -> "Mechanism":
        """The mechanism with these signals to drive effects; signals that its effects name are kept."""
        return dataclasses.replace(self, signals=tuple(names))

    # -- parameters --------------------------------------------------------------------------------

    @functools.cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Full names `port.effect.parameter`, in the order of `values`."""
        return tuple(e.full_name(p) for e in self.effects for p in e.values)

    @functools.cached_property
    def followers(self) -> dict[str, str]:
        """Full name of each tied parameter -> full name of the parameter that it always equals."""
        heads = ((e.name_prefix, e.follows) for e in self.effects)
        return {head + name: head + other for head, follows in heads for name, other in follows.items()}

    @functools.cached_property
    def parameter_specifications(self) -> tuple[Specification, ...]:
        """Unit, bounds and typical size of each parameter, in the order of `values`."""
        return tuple(
            dataclasses.replace(s, unit=self.unit_of(e, s.unit), typical=s.typical * self.units.size(s.unit))
            for e in self.effects
            for s in specifications(e).values()
        )

    def unit_of(self, effect: Effect, declared: str) -> str:
        """The unit of this machine for the declared unit of a parameter of an effect."""
        return self._units_of(effect).of(effect, declared)

    def _units_of(self, effect: Effect) -> Units:
        """Units of the parameters of an effect: a sensor has that of its channel in the place of `rad`."""
        if not isinstance(effect, Sensing) or effect.at not in self.channels:
            return self.units
        return self.units._replace(motion=self.quantities[self.channels.index(effect.at)].unit(self.units))

    def sentence(self, effect: Effect) -> str:
        """An effect in words, in the units of this mechanism; a signal keeps its own name and unit."""
        per = f" per {effect.signal_unit}" if effect.signal_unit else ""
        own = [re.escape(part) for part in (effect.signal_name, per) if part]
        parts = re.split(f"({'|'.join(own)})", effect.sentence()) if own else [effect.sentence()]
        units = self._units_of(effect)
        parts[::2] = [units.sentence(part, effect.volts_of_input) for part in parts[::2]]
        return "".join(parts)

    @property
    def values(self) -> Float[np.ndarray, " P"]:
        """Parameter values [declared units], one vector."""
        return np.array([v for e in self.effects for v in e.values.values()], dtype=float)

    @property
    def named_values(self) -> dict[str, float]:
        """Parameter values by full name [declared units]."""
        return dict(zip(self.parameter_names, self.values.tolist(), strict=True))

    @property
    def free_names(self) -> tuple[str, ...]:
        """Parameters that a fit estimates, which are all except the trusted ones."""
        return tuple(n for n in self.parameter_names if n not in self.trusted)

    def with_values(
        self, values: Mapping[str, float] | Sequence[Any] | Real[np.ndarray, " P"] | Real[Array, "P ..."]
    ) -> "Mechanism":
        """The same mechanism with other parameter values, by full name or as the whole vector."""
        if isinstance(values, Mapping):
            for name in values:
                self._must_exist(name)
            old = self.named_values
            for name in self.followers:
                # `values` may name all parameters: a tied one may keep its old value, or take the same new
                # value as the parameter that it follows.
                own = values.get(name, old[name])
                if own != old[name] and own != values.get(self.followers[name]):
                    self._refuse_follower(name)
            values = list((old | dict(values)).values())
        # Of a table with names, such as a Series of pandas, the order might be another one.
        sized = isinstance(values, Sequence | np.ndarray | jax.Array) and getattr(values, "ndim", 1) > 0
        sized = sized and not (isinstance(values, np.ndarray) and values.ndim > 1)
        if not sized or len(values) != len(self.parameter_names):
            raise InputError(
                f"Argument `values` must have one number for each of the {len(self.parameter_names)} "
                f"parameters, but is {shown(values)}; give them by name, {{'port.effect.parameter': value}}."
            )
        listed: Any = values.tolist() if isinstance(values, np.ndarray) else values
        if isinstance(values, jax.Array):  # all at once, which traces many times faster than one by one
            listed = jnp.unstack(values)
        return self._with_parameters(listed, self.trusted)

    def _with_parameters(self, parameters: Sequence[Any], trusted: frozenset[str]) -> "Mechanism":
        """The same mechanism with other parameters in its effects, without the checks of a new mechanism."""
        effects, start = [], 0
        for e in self.effects:
            part = {n: parameters[start + i] for i, n in enumerate(e.values)}
            effects.append(e.replace(**part))
            start += len(part)
        rebuilt = object.__new__(type(self))
        # Cached properties that depend on the structure alone are taken over.
        known = ("structure", "parameter_names", "followers", "parameter_specifications")
        rebuilt.__dict__.update({name: self.__dict__[name] for name in known if name in self.__dict__})
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        rebuilt.__dict__.update(fields | {"effects": tuple(effects), "trusted": trusted})
        return rebuilt

    def trust(self, *names: str) -> "Mechanism":
        """The mechanism with these parameters held constant in fits."""
        checks.names(names, "names")
        return dataclasses.replace(self, trusted=self.trusted | set(names))

    def release(self, *names: str) -> "Mechanism":
        """The mechanism with these parameters free in fits."""
        for name in names:
            self._must_exist(name)
            if name in self.followers:
                self._refuse_follower(name)
        return dataclasses.replace(self, trusted=self.trusted - set(names))

    def _refuse_follower(self, name: str) -> None:
        raise InputError(
            f"Parameter {name!r} was given a value of its own or released, but it is tied to "
            f"{self.followers[name]!r}; name that one, or make the effect with tied=False."
        )

    # -- pytree ------------------------------------------------------------------------------------

    def tree_flatten(self) -> tuple[list[Any], Any]:
        """The leaves are the parameter values."""
        return [v for e in self.effects for v in e.values.values()], (self.structure, self.trusted)

    @classmethod
    def tree_unflatten(cls, aux: Any, leaves: Sequence[Any]) -> "Mechanism":
        """The mechanism with these leaves (numbers or tracers)."""
        structure, trusted = aux
        return structure._with_parameters(leaves, trusted)

    def _status(self, name: str) -> str:
        if name in self.followers:
            return f"tied to {self.followers[name]}"
        return "held" if name in self.trusted else ""

    def _repr_html_(self) -> str:
        """Ports, effects with their equations, and every parameter with its unit and value."""
        vectors = ((name, ", ".join(f"{v:g}" for v in p)) for name, p in self.port_vectors.items())
        effects = [(effect_label(e.name, e.at), equation(e.equation)) for e in self.effects]
        described = zip(self.parameter_names, self.parameter_specifications, self.values, strict=True)
        rows = [
            (name, unit_text(spec.unit), spec.meaning, self._status(name), f"{value:.6g}")
            for name, spec, value in described
        ]
        return card(
            f"Mechanism of {', '.join(self.coordinates)}; outputs {', '.join(self.channels)}",
            paragraph(f"Ports, as shares of the coordinates: {', '.join(f'{n} ({p})' for n, p in vectors)}"),
            table(("effect", "equation"), effects, words=2),
            table(("parameter", "unit", "meaning", "", "value"), rows, words=4),
        )

    def __str__(self) -> str:
        lines = [f"Mechanism of {', '.join(self.coordinates)}; outputs {', '.join(self.channels)}"]
        for e in self.effects:
            for name, value in e.values.items():
                full = e.full_name(name)
                held = {"held": "  (trusted)", "": ""}.get(state := self._status(full), f"  ({state})")
                number = value if not isinstance(value, (int, float)) else f"{value:.6g}"
                unit = self.unit_of(e, specifications(e)[name].unit)
                lines.append(f"  {full} = {number} {unit}{held}")
        return "\n".join(lines)


def check_mechanism(given: Any) -> None:
    """Raise `InputError` if the argument is not a mechanism."""
    if isinstance(getattr(given, "mechanism", None), Mechanism):  # a model, or a result that has one
        raise InputError(
            f"A mechanism is needed, but a {type(given).__name__} was given; give its attribute `mechanism`."
        )
    if not isinstance(given, Mechanism):
        raise InputError(
            f"A mechanism or a model is needed, but {shown(given)} was given; give for instance "
            "rotflex_jax.joints.paper()."
        )


def check_input_alone(mechanism: Mechanism, what: str) -> None:
    """Raise `InputError` if a measured signal drives an effect, since `what` has the input alone."""
    driven = next((e for e in mechanism.effects if e.signal), None)
    if driven is not None:
        raise InputError(
            f"The model is driven by {driven.signal!r} beside its input, but {what} has the input alone; "
            f"leave that effect out, mechanism.without({driven.name!r}, {driven.at!r})."
        )
