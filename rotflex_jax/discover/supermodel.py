"""The baseline with every candidate built in and switched off.

All hypotheses share its numbering of parameters, effects and states. A run has only those of its candidates
that are switched on: the others would cost most of the time (twenty times the baseline's with all of them),
and a structure of few effects compiles quickly.
"""

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np

from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.kinds import Actuation, DryFriction, Effect, Gear, Linear, Memory, Scale, Sensing
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import effects_of
from rotflex_jax.mechanism.roles import calibrations as places_of_calibrations
from rotflex_jax.parameters import Transform

Place = tuple[str, str]  # (effect name, port)


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One effect that may be missing.

    Attributes:
        place: Effect name and port.
        effect: Index in the super-model's effects.
        parameters: Indices of its parameters in the super-model's values.
        probes: Alternatives (shapes), each a list of parameter vectors tried together.
        amplitudes: For each parameter, whether it is an amplitude.
        one_sided: Whether a negative amplitude would not be physical.
        sudden: Whether a small amplitude does nothing yet: what it does is learnt from runs at its sizes.
    """

    place: Place
    effect: int
    parameters: tuple[int, ...]
    probes: tuple[tuple[tuple[float, ...], ...], ...]
    amplitudes: tuple[bool, ...]
    one_sided: bool
    sudden: bool = False


@dataclasses.dataclass(frozen=True)
class Part:
    """The super-model less some effects that are off.

    Attributes:
        mechanism: What is left.
        effects: Places of its effects in the super-model's.
        parameters: Places of its parameters in the super-model's values.
        states: Places of its states in the super-model's state.
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
        mechanism: With calibrations and candidates.
        calibrations: Places of the calibrations that were added.
        candidates: By place.
        parts: Parts formed so far, by the effects left out.
    """

    baseline: Mechanism
    mechanism: Mechanism
    calibrations: tuple[Place, ...]
    candidates: dict[Place, Candidate]
    parts: dict[frozenset[int], Part] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def transform(self) -> Transform:
        """Between the parameter values and what a fit moves."""
        return Transform.of(self.mechanism.parameter_specifications)

    @functools.cached_property
    def baseline_states(self) -> list[int]:
        """Places of the baseline's states in the state."""
        own, count = state_rows(self.mechanism), len(self.baseline.effects)
        moving = range(2 * len(self.baseline.coordinates))
        return sorted([*moving, *(row for i, rows in own.items() if i < count for row in rows)])

    def part(self, gates: np.ndarray) -> Part:
        """The super-model without the candidates whose gate (..., E) is zero."""
        return self.probed(np.any(gates.reshape(-1, gates.shape[-1]) != 0, axis=0), ())

    def probed(self, gates: np.ndarray, family: Iterable[Candidate]) -> Part:
        """The super-model with no other candidates than a family and those whose gate (E,) is not zero."""
        kept = {c.effect for c in family}
        others = (c.effect for c in self.candidates.values() if c.effect not in kept)
        left_out = frozenset(i for i in others if gates[i] == 0)
        if left_out not in self.parts:
            self.parts[left_out] = self._part(left_out)
        return self.parts[left_out]

    def families(self, candidates: Iterable[Candidate]) -> list[list[Candidate]]:
        """Candidates by what it takes to probe them: states of their own, a contact, a torque, a signal."""
        own = state_rows(self.mechanism)
        found: dict[str, list[Candidate]] = {}
        for c in candidates:
            effect = self.mechanism.effects[c.effect]
            if c.effect in own:
                kind = "states"
            elif isinstance(effect, Actuation | Sensing):
                kind = "signal"
            else:
                kind = "contact" if isinstance(effect, DryFriction) else "torque"
            found.setdefault(kind, []).append(c)
        return list(found.values())

    def _part(self, left_out: frozenset[int]) -> Part:
        kept = [i for i in range(len(self.mechanism.effects)) if i not in left_out]
        effects = tuple(self.mechanism.effects[i] for i in kept)
        mechanism = dataclasses.replace(self.mechanism, effects=effects)
        names = {n: k for k, n in enumerate(self.mechanism.parameter_names)}
        rows = state_rows(self.mechanism)
        moving = range(2 * len(self.mechanism.coordinates))
        return Part(
            mechanism,
            tuple(kept),
            tuple(names[n] for n in mechanism.parameter_names),
            tuple(sorted([*moving, *(row for i in kept for row in rows.get(i, ()))])),
        )

    def effect_index(self, place: Place) -> int:
        """Index of an effect."""
        return [(e.name, e.at) for e in self.mechanism.effects].index(place)

    def parameter_indices(self, place: Place) -> list[int]:
        """Indices of an effect's parameters in the values."""
        head = f"{place[1]}.{place[0]}."
        return [i for i, n in enumerate(self.mechanism.parameter_names) if n.startswith(head)]

    @functools.cached_property
    def local(self) -> list[int]:
        """Parameters that each recording has for itself."""
        return [i for place in self.calibrations for i in self.parameter_indices(place)]

    @functools.cached_property
    def baseline_free(self) -> list[int]:
        """Free parameters of the baseline."""
        names = self.mechanism.parameter_names
        return [names.index(n) for n in self.baseline.free_names]

    def gates(self, switched_on: Iterable[Place]) -> np.ndarray:
        """Gates (E,): baseline and the named effects on."""
        on = set(switched_on)
        base = len(self.baseline.effects)
        effects = self.mechanism.effects
        return np.array([1.0 if i < base or (e.name, e.at) in on else 0.0 for i, e in enumerate(effects)])

    def clean(self, values: np.ndarray, places: Iterable[Place]) -> Mechanism:
        """The user's mechanism with fitted numbers and the named effects, nothing else."""
        numbers = dict(zip(self.mechanism.parameter_names, values.tolist(), strict=True))
        mechanism = self.baseline
        for place in places:
            mechanism = mechanism + self.mechanism.effects[self.effect_index(place)]
        return mechanism.with_values({n: numbers[n] for n in mechanism.parameter_names})


def state_rows(mechanism: Mechanism) -> dict[int, tuple[int, ...]]:
    """Effects with states of their own -> places of these in the state."""
    rows, at = {}, 2 * len(mechanism.coordinates)
    # The state holds those of linear effects first, then those of a gear, then memories.
    for kind in (Linear, Gear, Memory):
        for i, e in effects_of(mechanism, kind):
            count = 1 if isinstance(e, Memory) else e.order
            if count:
                rows[i] = tuple(range(at, at + count))
                at += count
    return rows


def build(
    baseline: Mechanism, wanted: Iterable[tuple[type[Effect], str]], scales: dict[str, Scale]
) -> SuperModel:
    """A super-model of a baseline.

    Args:
        baseline: The user's mechanism.
        wanted: Candidates (class, port); those the baseline has, or has no port for, are left out.
        scales: Port (or `input`, or channel) -> size of its signals.
    """
    present = {(e.name, e.at) for e in baseline.effects}
    mechanism = baseline
    calibrations, candidates = [], {}
    # Fitted from the start, each recording has its own, and reported as found where it matters.
    for place in places_of_calibrations(baseline):
        cls = CATALOG[place[0]]
        if place not in present and _has(baseline, cls, place[1]):
            mechanism = mechanism + cls(at=place[1])
            calibrations.append(place)
    for cls, port in wanted:
        place = (cls.name, port)
        if cls.name not in CATALOG:
            raise InputError(
                f"{cls.__name__} is to be tried, but is not in the catalogue of effects; put @register above "
                "it."
            )
        if place in present or place in calibrations or not _has(baseline, cls, port):
            continue
        names = tuple(cls.declared())
        probes = tuple(
            tuple(tuple(float(p[n]) for n in names) for p in group) for group in cls.probes(scales[port])
        )
        if not probes:
            continue
        mechanism = mechanism + cls(at=port, **dict(zip(names, probes[0][0], strict=True)))
        last = len(mechanism.parameter_names)
        candidates[place] = Candidate(
            place,
            len(mechanism.effects) - 1,
            tuple(range(last - len(names), last)),
            probes,
            tuple(n in cls.amplitudes for n in names),
            all(max(s.lower, s.physical[0]) >= 0 for n, s in cls.declared().items() if n in cls.amplitudes),
            sudden=issubclass(cls, Gear),
        )
    return SuperModel(baseline, mechanism, tuple(calibrations), candidates)


def _has(mechanism: Mechanism, cls: type[Effect], port: str) -> bool:
    if issubclass(cls, Actuation):
        return port == "input"
    if issubclass(cls, Memory) and cls.driven_by == "motor" and not mechanism.has_motor(port):
        return False
    if issubclass(cls, Gear):
        known = not any(isinstance(e, Gear) for e in mechanism.effects)
        return known and mechanism.has_motor(port) and mechanism.has_inertia(port)
    return port in (mechanism.channels if issubclass(cls, Sensing) else mechanism.port_vectors)
