"""The super-model: the baseline with all candidates built in and switched off; sizes of signals at its ports.

All hypotheses share the numbering of its parameters, effects and states. A run contains only the candidates
that are switched on: with all candidates a run would take twenty times as long as the baseline, and a
structure with few effects compiles quickly.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from rotflex_jax.checks import entries, shown
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import Effect, Scale, driven_place, full_name, name_prefix
from rotflex_jax.effects.labels import law_of
from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import motion
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import own_states
from rotflex_jax.mechanism.linear import inverse_mass
from rotflex_jax.mechanism.roles import calibrations as usual_calibrations
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording


def _known_motion(model: Model, recording: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Position and speed of every port: as measured, or as simulated where no sensor determines them."""
    measured = motion(model.mechanism, model.measured(recording).astype(float), recording.Ts)
    unmeasured = {port: v for port, v in model.mechanism.port_vectors.items() if port not in measured}
    if not unmeasured:
        return measured
    n = len(model.mechanism.coordinates)
    states = model.simulate_states(recording)
    if not np.all(np.isfinite(states)):
        return measured
    q, dq = states[:, :n], states[:, n : 2 * n]
    return measured | {port: (q @ np.array(v), dq @ np.array(v)) for port, v in unmeasured.items()}


def stiffness_and_inertia(mechanism: Mechanism, port: str) -> tuple[float, float]:
    """Stiffness of the linear springs at a port [N m/rad], and the effective inertia there [kg m^2]."""
    stiffness = sum(float(e.stamp().stiffness) for e in mechanism.linear_effects(port))
    p = np.array(mechanism.port_vectors[port])
    return stiffness, float(1 / (p @ inverse_mass(mechanism) @ p))


def scales(model: Model, recordings: Sequence[Recording], torque: float) -> dict[str, Scale]:
    """Sizes of the signals at each place of an effect.

    Args:
        model: Gives ports and outputs.
        recordings: Measured data.
        torque: Torque that moves the machine [N m].

    Returns:
        Place (port, port with a measured signal, `input` or channel) -> sizes of the signals there.
    """
    voltage = max(float(np.max(np.abs(r.u))) for r in recordings)
    mechanism = model.mechanism
    out = {}
    found = [_known_motion(model, r) for r in recordings]
    for port in mechanism.port_vectors:
        known = [m[port] for m in found if port in m]
        speed = max((float(np.sqrt(np.mean(s**2))) for _, s in known), default=1.0)
        position = max((float(np.max(np.abs(q - q.mean()))) for q, _ in known), default=0.1)
        stiffness, inertia = stiffness_and_inertia(mechanism, port)
        out[port] = Scale(voltage, max(speed, 1e-6), max(position, 1e-6), torque, stiffness, inertia)
        for name in mechanism.signals:
            size = float(np.sqrt(np.mean(np.concatenate([r.signals[name] for r in recordings]) ** 2)))
            out[driven_place(port, name)] = dataclasses.replace(out[port], signal=max(size, 1e-12))
    whole = Scale(voltage, 1.0, 1.0, torque)
    for channel in mechanism.channels:
        y = np.concatenate([model.measured(r)[:, mechanism.channels.index(channel)] for r in recordings])
        out[channel] = Scale(voltage, 1.0, max(float(np.std(y)), 1e-9), torque)
    return out | {"input": whole}


class EffectLocation(NamedTuple):
    """An effect and the port (or `input`, or channel) at which it acts; equal to the plain tuple."""

    effect: str
    port: str

    def __str__(self) -> str:
        return f"{self.effect} at {self.port}"

    @property
    def name_prefix(self) -> str:
        """The beginning of the full names of its parameters."""
        return name_prefix(self.port, self.effect)

    def full_name(self, parameter: str) -> str:
        """Full name of one of its parameters in a mechanism."""
        return full_name(self.port, self.effect, parameter)

    def contains(self, other: "EffectLocation") -> bool:
        """Whether another effect is a special case of this one."""
        return self.port == other.port and other.effect in CATALOG[self.effect].contains

    def is_related_to(self, other: "EffectLocation") -> bool:
        """Whether one of the two is a special case of the other."""
        return self.contains(other) or other.contains(self)


class ErrorLine(NamedTuple):
    """A line in the spectrum of a model's errors that the spectrum of the input does not have.

    Attributes:
        frequency: Frequency of the line [Hz].
        recording: Index of the recording with these errors.
    """

    frequency: float
    recording: int


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One effect that may be missing.

    Attributes:
        location: Effect and port.
        effect: Index in the super-model's effects.
        parameters: Indices of its parameters in the super-model's values.
        probes: Alternatives (shapes), each a list of parameter vectors that are tried together, one direction
            of the score test per vector.
        amplitudes: For each parameter, whether it is an amplitude.
        scaled: For each parameter, whether it is reduced where a fit starts at a share of the usual size. It
            is for amplitudes and for what the effect `vanishes_with`.
        one_sided: Whether negative amplitudes are not physical.
        threshold: Whether a small amplitude does nothing at all, so that only runs at full size show what the
            effect does.
        line: Index of the parameter that is the frequency of a periodic disturbance; it is tried only at
            lines in the spectrum of a model's errors. None for other effects.
        recordings: For each shape of a periodic disturbance, the index of the recording whose errors have
            the line.
    """

    location: EffectLocation
    effect: int
    parameters: tuple[int, ...]
    probes: tuple[tuple[tuple[float, ...], ...], ...]
    amplitudes: tuple[bool, ...]
    scaled: tuple[bool, ...]
    one_sided: bool
    threshold: bool = False
    line: int | None = None
    recordings: tuple[int, ...] = ()

    def at_lines(self, lines: "Sequence[ErrorLine]") -> "Candidate | None":
        """The candidate with one shape for each line, if it is a periodic disturbance; None without lines.

        Any other candidate is returned unchanged.
        """
        k = self.line
        if k is None:
            return self
        shapes = tuple(
            tuple((*member[:k], line.frequency, *member[k + 1 :]) for member in self.probes[0])
            for line in lines
        )
        found = dataclasses.replace(self, probes=shapes, recordings=tuple(line.recording for line in lines))
        return found if shapes else None


@dataclasses.dataclass(frozen=True)
class ReducedModel:
    """The super-model without some of the effects that are switched off.

    Attributes:
        mechanism: The mechanism that is left.
        effects: Indices of its effects in the super-model.
        parameters: Indices of its parameters in the super-model's values.
        states: Indices of its states in the super-model's state.
    """

    mechanism: Mechanism
    effects: tuple[int, ...]
    parameters: tuple[int, ...]
    states: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class SuperModel:
    """Baseline, calibrations and candidates in one mechanism.

    Attributes:
        baseline: The user's mechanism.
        mechanism: The mechanism with calibrations and candidates.
        calibrations: Calibrations that were added to the baseline.
        candidates: Location -> candidate.
        reduced: Cache of reduced models, by the effects that are left out.
        switched: Cache of `active`, by the effects that are on.
        known_gates: Cache of `gates`, by the effects that are on.
    """

    baseline: Mechanism
    mechanism: Mechanism
    calibrations: tuple[EffectLocation, ...]
    candidates: dict[EffectLocation, Candidate]
    reduced: dict[frozenset[int], ReducedModel] = dataclasses.field(default_factory=dict)
    switched: dict[bytes, ReducedModel] = dataclasses.field(default_factory=dict)
    known_gates: dict[frozenset[EffectLocation], np.ndarray] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def transform(self) -> Transform:
        """Transform between parameter values and the unconstrained coordinates of a fit."""
        return Transform.of(self.mechanism.parameter_specifications)

    @functools.cached_property
    def baseline_states(self) -> list[int]:
        """Indices of the baseline's states in the state of the super-model."""
        own, count = own_states(self.mechanism), len(self.baseline.effects)
        moving = range(2 * len(self.baseline.coordinates))
        return sorted([*moving, *(row for i, rows in own.items() if i < count for row in rows)])

    def active(self, gates: Shaped[np.ndarray, "*batch E"]) -> ReducedModel:
        """The super-model without the candidates whose gates are all zero."""
        on = np.any(gates.reshape(-1, gates.shape[-1]) != 0, axis=0)
        key = on.tobytes()  # cached, since every run needs it
        if key not in self.switched:
            self.switched[key] = self.with_family(on, ())
        return self.switched[key]

    def with_family(self, gates: Shaped[np.ndarray, " E"], family: Iterable[Candidate]) -> ReducedModel:
        """The super-model with only the candidates of a family and candidates whose gate is not zero."""
        kept = {c.effect for c in family}
        others = (c.effect for c in self.candidates.values() if c.effect not in kept)
        left_out = frozenset(i for i in others if gates[i] == 0)
        if left_out not in self.reduced:
            self.reduced[left_out] = self._reduce(left_out)
        return self.reduced[left_out]

    def families(self, candidates: Iterable[Candidate]) -> list[list[Candidate]]:
        """Candidates grouped by what they add to the equations: memory, dry contact, torque, changed signal.

        Candidates with linear states of their own (a lag of a sensor, for example) are among changed signals.
        """
        own = own_states(self.mechanism)
        found: dict[str, list[Candidate]] = {}
        for c in candidates:
            effect = self.mechanism.effects[c.effect]
            if c.effect in own or not effect.acts_at_port:
                kind = "memory" if effect.state_part == "memory" else "signal"
            else:
                kind = "contact" if effect.dry_contact else "torque"
            found.setdefault(kind, []).append(c)
        return list(found.values())

    def _reduce(self, left_out: frozenset[int]) -> ReducedModel:
        return self.only(i for i in range(len(self.mechanism.effects)) if i not in left_out)

    def only(self, kept: Iterable[int]) -> ReducedModel:
        """The super-model with only some effects, given by their indices in increasing order."""
        kept = tuple(kept)
        effects = tuple(self.mechanism.effects[i] for i in kept)
        trusted = frozenset(
            n for n in self.mechanism.trusted if n.rpartition(".")[0] in {f"{e.at}.{e.name}" for e in effects}
        )
        mechanism = dataclasses.replace(self.mechanism, effects=effects, trusted=trusted)
        names = {n: k for k, n in enumerate(self.mechanism.parameter_names)}
        rows = own_states(self.mechanism)
        moving = range(2 * len(self.mechanism.coordinates))
        return ReducedModel(
            mechanism,
            kept,
            tuple(names[n] for n in mechanism.parameter_names),
            tuple(sorted([*moving, *(row for i in kept for row in rows.get(i, ()))])),
        )

    def effect_index(self, location: EffectLocation) -> int:
        """Index of an effect."""
        return [(e.name, e.at) for e in self.mechanism.effects].index(location)

    def effect(self, values: Float[np.ndarray, " P"], location: EffectLocation) -> Effect:
        """An effect with its parameters among the parameter values."""
        effect = self.mechanism.effects[self.effect_index(location)]
        own = values[self.parameter_indices(location)].tolist()
        return effect.replace(**dict(zip(effect.values, own, strict=True)))

    def parameter_indices(self, location: EffectLocation) -> list[int]:
        """Indices of an effect's parameters in the parameter values."""
        head = location.name_prefix
        return [i for i, n in enumerate(self.mechanism.parameter_names) if n.startswith(head)]

    @functools.cached_property
    def local(self) -> list[int]:
        """Indices of the parameters of the calibrations, which have a value for each recording."""
        return [i for location in self.calibrations for i in self.parameter_indices(location)]

    @functools.cached_property
    def phased(self) -> frozenset[int]:
        """Indices of amplitudes of periodic disturbances, whose phase differs between recordings."""
        disturbances = [c for c in self.candidates.values() if c.line is not None]
        return frozenset(i for c in disturbances for k, i in enumerate(c.parameters) if k != c.line)

    @functools.cached_property
    def baseline_free(self) -> list[int]:
        """Indices of the free parameters of the baseline."""
        names = self.mechanism.parameter_names
        return [names.index(n) for n in self.baseline.free_names]

    def without_calibrations(self, locations: Iterable[EffectLocation]) -> frozenset[EffectLocation]:
        """The given locations without calibrations: effects that a search may find."""
        return frozenset(locations) - set(self.calibrations)

    def other_laws(self, location: EffectLocation) -> list[EffectLocation]:
        """Candidates at the same port that are other laws of the same thing as an effect."""
        law = law_of(location.effect)
        at_port = (p for p in self.candidates if p.port == location.port and p != location)
        return [p for p in at_port if law and law_of(p.effect) == law]

    def gates(self, switched_on: Iterable[EffectLocation]) -> Float[np.ndarray, " E"]:
        """Gates of all effects: one for effects of the baseline and given ones, else zero; read-only."""
        on = frozenset(switched_on)
        if on not in self.known_gates:  # cached, since every run needs it
            base, effects = len(self.baseline.effects), self.mechanism.effects
            found = np.array([float(i < base or (e.name, e.at) in on) for i, e in enumerate(effects)])
            found.flags.writeable = False
            self.known_gates[on] = found
        return self.known_gates[on]

    def clean(self, values: Float[np.ndarray, " P"], locations: Iterable[EffectLocation]) -> Mechanism:
        """The user's mechanism with given parameter values, and with only the named effects added.

        It has the signals that its effects use, and no others.
        """
        named = dict(zip(self.mechanism.parameter_names, values.tolist(), strict=True))
        mechanism = self.baseline.with_signals(())
        for location in locations:
            mechanism = mechanism + self.mechanism.effects[self.effect_index(location)]
        return mechanism.with_values({n: named[n] for n in mechanism.parameter_names})


def checked_candidates(mechanism: Mechanism, candidates: Any) -> list[tuple[type[Effect], str]]:
    """Candidates, checked: pairs of an effect's class and a place that the mechanism has for it.

    Raises:
        InputError: If `candidates` holds anything else.
    """
    found = [candidates] if (given := entries(candidates)) is None else list(given)
    for pair in found:
        given = pair if isinstance(pair, tuple | list) and len(pair) == 2 else (pair, None)
        if not (isinstance(given[0], type) and issubclass(given[0], Effect) and isinstance(given[1], str)):
            raise InputError(
                f"Argument `candidates` must hold pairs of an effect's class and a port, but has "
                f"{shown(pair)}; write for instance [(rotflex_jax.effects.Coulomb, 'hub')]."
            )
        places = mechanism.locations(given[0])
        if not places:
            raise InputError(
                f"{given[0].__name__} is to be tried at {given[1]!r}, but the recordings have no signal in "
                "common; give all of them the signal."
            )
        if given[1] not in places:
            raise InputError(
                f"{given[0].__name__} is to be tried at {given[1]!r}, but this mechanism has "
                f"{', '.join(map(repr, places))} for it; name one of these."
            )
    return found


def build(
    baseline: Mechanism, wanted: Iterable[tuple[type[Effect], str]], scales: dict[str, Scale]
) -> SuperModel:
    """A super-model of a baseline.

    Args:
        baseline: The user's mechanism.
        wanted: Candidates (class, port). A candidate that the baseline already has, or has no place for, is
            left out.
        scales: Port (or `input`, or channel) -> sizes of its signals.
    """
    present = {(e.name, e.at) for e in baseline.effects}
    mechanism = baseline
    calibrations, candidates = [], {}
    # Calibrations are fitted from the start, with values for each recording, and reported where needed.
    for location in (EffectLocation(*c) for c in usual_calibrations(baseline)):
        cls = CATALOG[location.effect]
        if location not in present and baseline.accepts(cls, location.port):
            mechanism = mechanism + cls(at=location.port)
            calibrations.append(location)
    for cls, port in wanted:
        location = EffectLocation(cls.name, port)
        if cls.name not in CATALOG:
            raise InputError(
                f"{cls.__name__} is to be tried, but is not in the catalogue of effects; put @register above "
                "it."
            )
        if location in present or location in calibrations or not baseline.accepts(cls, port):
            continue
        names = tuple(cls.declared())
        probes = cls.probe_values(scales[port])
        if not probes:
            continue
        mechanism = mechanism + cls(at=port, **dict(zip(names, probes[0][0], strict=True)))
        last = len(mechanism.parameter_names)
        candidates[location] = Candidate(
            location,
            len(mechanism.effects) - 1,
            tuple(range(last - len(names), last)),
            probes,
            tuple(n in cls.amplitudes for n in names),
            tuple(n in (*cls.amplitudes, *cls.vanishes_with) for n in names),
            all(max(s.lower, s.physical[0]) >= 0 for n, s in cls.declared().items() if n in cls.amplitudes),
            threshold=not cls.slope_at_zero,
            line=names.index(cls.line) if cls.line else None,
        )
    return SuperModel(baseline, mechanism, tuple(calibrations), candidates)
