"""A mechanism: coordinates, named ports, effects at the ports, and what the sensors see."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax import checks
from rotflex_jax.checks import shown
from rotflex_jax.effects.base import Effect, Linear
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import validation
from rotflex_jax.mechanism.quantity import Quantity
from rotflex_jax.mechanism.units import TURNING, Units
from rotflex_jax.mechanism.validation import check
from rotflex_jax.parameters import Specification, specifications
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import equation, unit_text

ROTOR = "rotor"
"""Port on the motor's side of a gear with play, which a mechanism with such a gear has besides its own."""


class _Slot:
    """Placeholder of a parameter value in a structure."""

    def __repr__(self) -> str:
        return "·"

    def __reduce__(self) -> str:
        return "_SLOT"  # the one and only, also in another process


_SLOT = _Slot()


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True)
class Mechanism:
    """Coordinates `q`, ports `p` (position p.q, speed p.dq, torque tau acts as p tau), effects, outputs.

        M ddq + D dq + K q = sum over ports of p tau,   y = outputs of (q, dq)

    Args:
        coordinates: Names of the coordinates.
        ports: Name -> vector, one entry per coordinate.
        effects: Physical effects; inertias, springs, dampers and the motor among them.
        outputs: Channel -> port (its position) or (port, "speed").
        trusted: Full names `port.effect.parameter` of constants that fits hold.
        units: Units of its ports; rotary by default.

    Raises:
        InputError: A port, output or trusted name that does not exist, or two equal effects at a port.

    A mechanism is a pytree whose leaves are the parameter values, so it passes through `jax.jit` and
    `jax.grad`; `mechanism + effect` is a new mechanism.
    """

    coordinates: tuple[str, ...]
    ports: Any
    effects: tuple[Effect, ...] = ()
    outputs: Any = ()
    trusted: Any = frozenset()
    units: Units = TURNING

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - frozen class
        put("coordinates", checks.names(self.coordinates, "coordinates"))
        put("ports", validation.ports(self.ports))
        put("effects", validation.effects(self.effects))
        put("outputs", validation.outputs(self.outputs))
        put("trusted", frozenset(checks.names(self.trusted, "trusted")))
        check(self)
        put("trusted", self.trusted | set(self.followers))  # a fit moves what they follow
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
        """Port name -> vector over the coordinates; with a gear also its `rotor`, while the teeth touch."""
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
            return NotImplemented
        return dataclasses.replace(self, effects=(*self.effects, effect))

    def without(self, name: str, at: str) -> "Mechanism":
        """The mechanism without the effect `name` at port `at`."""
        others = tuple(e for e in self.effects if (e.name, e.at) != (name, at))
        if len(others) == len(self.effects):
            present = ", ".join(f"{e.name} at {e.at}" for e in self.effects)
            raise InputError(
                f"{name!r} at {at!r} was to be removed, but the mechanism has {present}; name one."
            )
        prefix = f"{at}.{name}."
        trusted = frozenset(t for t in self.trusted if not t.startswith(prefix))
        return dataclasses.replace(self, effects=others, trusted=trusted)

    def effect(self, name: str, at: str) -> Effect:
        """The effect `name` at port `at`."""
        for e in self.effects:
            if (e.name, e.at) == (name, at):
                return e
        raise InputError(f"{name!r} at {at!r} was asked for, but the mechanism lacks it; add it first.")

    def locations(self, effect: Effect | type[Effect]) -> tuple[str, ...]:
        """Where an effect can act here: the ports, the voltage (`input`), or the outputs."""
        if effect.acts_on == "input":
            return ("input",)
        return self.channels if effect.acts_on == "channel" else tuple(self.port_vectors)

    def vector(self, effect: Effect) -> tuple[float, ...]:
        """Vector of the port at which an effect acts, of a sensor of the port that it measures."""
        port = dict(self.outputs)[effect.at][0] if effect.acts_on == "channel" else effect.at
        return self.port_vectors[port]

    def quantity(self, channel: str) -> Quantity:
        """What a channel measures."""
        return self.quantities[self.channels.index(channel)]

    def linear_effects(self, port: str) -> list[Linear]:
        """Linear effects at a port."""
        return [e for e in self.effects if isinstance(e, Linear) and e.at == port]

    def lacking(self, effect: Effect | type[Effect], port: str) -> list[str]:
        """What an effect needs at a port or an output that is not there: `motor`, `inertia`, ..."""
        has: dict[str, Callable[[str], bool]] = {
            "motor": self.has_motor,
            "inertia": self.has_inertia,
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
        """Whether an inertia is entered at the port."""
        return any((e.name, e.at) == ("inertia", port) for e in self.effects)

    # -- parameters --------------------------------------------------------------------------------

    @functools.cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Full names `port.effect.parameter`, in the order of `values`."""
        return tuple(f"{e.at}.{e.name}.{p}" for e in self.effects for p in e.values)

    @functools.cached_property
    def followers(self) -> dict[str, str]:
        """Full name of each parameter that always equals another one -> full name of the other."""
        heads = ((f"{e.at}.{e.name}.", e.follows) for e in self.effects)
        return {head + name: head + other for head, follows in heads for name, other in follows.items()}

    @functools.cached_property
    def parameter_specifications(self) -> tuple[Specification, ...]:
        """Unit, bounds and size of each parameter, in the order of `values`."""
        u = self.units
        return tuple(
            dataclasses.replace(s, unit=u.unit(s.unit, e.volts_of_input), typical=s.typical * u.size(s.unit))
            for e in self.effects
            for s in specifications(e).values()
        )

    def sentence(self, effect: Effect) -> str:
        """An effect in words, in the units of this mechanism."""
        return self.units.sentence(effect.sentence(), effect.volts_of_input)

    @property
    def values(self) -> Float[np.ndarray, " P"]:
        """Parameter values [declared units], one vector."""
        return np.array([v for e in self.effects for v in e.values.values()], dtype=float)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Parameters that a fit estimates, all but the trusted ones."""
        return tuple(n for n in self.parameter_names if n not in self.trusted)

    def with_values(
        self, values: Mapping[str, float] | Sequence[Any] | Real[np.ndarray, " P"] | Real[Array, "P ..."]
    ) -> "Mechanism":
        """The same mechanism with other parameter values, by full name or as the whole vector."""
        if isinstance(values, Mapping):
            for name in values:
                self._must_exist(name)
            old = dict(zip(self.parameter_names, self.values, strict=True))
            for name in self.followers:
                # Beside a value of what it follows it may stand as it was: the whole vector by name.
                if self.followers[name] not in values and values.get(name, old[name]) != old[name]:
                    self._refuse_follower(name)
            values = list((old | dict(values)).values())
        if not hasattr(values, "__len__") or len(values) != len(self.parameter_names):
            raise InputError(
                f"Argument `values` must have one number for each of the {len(self.parameter_names)} "
                f"parameters, but is {shown(values)}; give them by name, {{'port.effect.parameter': value}}."
            )
        listed: Any = values.tolist() if isinstance(values, np.ndarray) else values
        if isinstance(values, jax.Array):  # all at once, which traces many times faster than one by one
            listed = jnp.unstack(values)
        effects, start = [], 0
        for e in self.effects:
            names = tuple(e.values)
            part = {n: listed[start + i] for i, n in enumerate(names)}
            effects.append(e.replace(**part))
            start += len(names)
        return dataclasses.replace(self, effects=tuple(effects))

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
        """Leaves are the parameter values."""
        return [v for e in self.effects for v in e.values.values()], (self.structure, self.trusted)

    @classmethod
    def tree_unflatten(cls, aux: Any, leaves: Sequence[Any]) -> "Mechanism":
        """The mechanism with these leaves (numbers or tracers)."""
        structure, trusted = aux
        effects, start = [], 0
        for e in structure.effects:
            part = {n: leaves[start + i] for i, n in enumerate(e.values)}
            effects.append(e.replace(**part))
            start += len(part)
        rebuilt = object.__new__(cls)
        for field, value in (
            ("coordinates", structure.coordinates),
            ("ports", structure.ports),
            ("effects", tuple(effects)),
            ("outputs", structure.outputs),
            ("trusted", trusted),
            ("units", structure.units),
        ):
            object.__setattr__(rebuilt, field, value)
        return rebuilt

    def _status(self, name: str) -> str:
        if name in self.followers:
            return f"tied to {self.followers[name]}"
        return "held" if name in self.trusted else ""

    def _repr_html_(self) -> str:
        """Ports and effects with their equations, and every parameter with unit and value."""
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
                full = f"{e.at}.{e.name}.{name}"
                held = {"held": "  (trusted)", "": ""}.get(state := self._status(full), f"  ({state})")
                number = value if not isinstance(value, (int, float)) else f"{value:.6g}"
                unit = self.units.unit(specifications(e)[name].unit, e.volts_of_input)
                lines.append(f"  {full} = {number} {unit}{held}")
        return "\n".join(lines)


def check_mechanism(given: Any) -> None:
    """Raise `InputError` where something else was given as a mechanism."""
    if not isinstance(given, Mechanism):
        raise InputError(
            f"A mechanism or a model is needed, but {shown(given)} was given; give for instance "
            "rotflex_jax.joints.paper()."
        )
