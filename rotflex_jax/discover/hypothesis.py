"""A hypothesis: which effects are on, with which parameters, and the whitener of its innovations."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import Directions, ParameterSet
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import DRY_FRICTION
from rotflex_jax.effects.labels import law_of
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.parameters import Transform


@dataclasses.dataclass(frozen=True)
class Whitener:
    """`w = L e`: innovations that are white in time, with a covariance of their channels.

    An autoregression fitted to the innovations of an incomplete model would also remove the slow error that
    the missing effect causes, and with it the power to identify the effect.

    Attributes:
        L: Inverse Cholesky factor of the covariance.
    """

    L: Float[np.ndarray, "C C"]

    @classmethod
    def of_noise(cls, noise: Float[np.ndarray, " C"]) -> "Whitener":
        """The whitener of uncorrelated channels with these standard deviations."""
        return cls(np.diag(1 / noise))

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return float(-2 * np.sum(np.log(np.diag(self.L))))

    def __call__(
        self, e: Float[np.ndarray, "*batch R N C"], seen: Float[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "*batch R N C"]:
        """Whitened signals; zero where a sample does not count."""
        # Channel by channel, since a product with such a small matrix takes several times as long.
        w = np.empty(e.shape)
        for i, row in enumerate(self.L):
            first, *others = [j for j in range(len(row)) if row[j] != 0]
            np.multiply(e[..., first], row[first], out=w[..., i])
            for j in others:
                w[..., i] += row[j] * e[..., j]
        if (left_out := seen == 0).any():
            w[..., left_out, :] = 0.0
        return w

    def log_densities(
        self, e: Float[np.ndarray, "R N C"], seen: Float[np.ndarray, "R N"]
    ) -> Float[np.ndarray, "R N"]:
        """Log-likelihood of each sample [nat]; zero where it does not count."""
        w, C = self(e, seen), e.shape[-1]
        constant = (C * np.log(2 * np.pi) + self.log_det) * seen
        return -0.5 * (np.sum(w**2, axis=-1) + constant)


def fit_whitener(
    e: Float[np.ndarray, "R N C"],
    seen: Float[np.ndarray, "R N"],
    floor: Float[np.ndarray, " C"],
    channels_apart: bool = False,
) -> Whitener:
    """Whitener fitted to innovations.

    Args:
        e: Innovations.
        seen: One where a sample counts.
        floor: Standard deviation of the sensor noise; 5 % of it is added, for data without noise.
        channels_apart: Whether the innovations of different channels count as uncorrelated.
    """
    C = e.shape[-1]
    counted = Whitener(np.eye(C))(e, seen).reshape(-1, C)
    count = max(float(np.sum(seen)), 1.0)
    covariance = counted.T @ counted / count + np.diag((0.05 * floor) ** 2)
    covariance = np.diag(np.diag(covariance)) if channels_apart else covariance
    return Whitener(np.linalg.inv(np.linalg.cholesky(covariance)))


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """One model on one set of recordings, with everything a comparison needs.

    Attributes:
        locations: Candidates and calibrations that are switched on, in the order they were added.
        free: Indices of fitted parameters that are common to all recordings.
        local: Indices of fitted parameters that have a value for each recording: calibrations, and sizes of
            friction that differ between runs.
        sizes: Those of `local` that are sizes of friction. Other recordings of a run have the size of the
            run, while calibrations are fitted to every recording. For a validation recording of a run that
            was not trained, sizes are fitted too.
        z: Unconstrained values of all parameters.
        local_z: Unconstrained values of the local parameters of each recording.
        x0: First states of the windows: positions, speeds, and further states of the reduced model.
        K: Gains of the predictor; zero for free runs.
        process_noise: Port -> intensity of the process noise that gave `K` [(N m)^2 s].
        whitener: Whitener of the innovations, fixed while parameters move.
        densities: Log-likelihood of each sample [nat]; minus infinity before it is evaluated.
        blocks: Evidence of each half second, for the comparison with another hypothesis on the same
            recordings: log-likelihood [nat], or for free runs minus the logarithm of the error.
    """

    locations: tuple[EffectLocation, ...]
    free: tuple[int, ...]
    local: tuple[int, ...]
    z: Float[np.ndarray, " P"]
    local_z: Float[np.ndarray, "R L"]
    x0: Float[np.ndarray, "R W m"]
    K: Float[np.ndarray, "R n C"]
    process_noise: dict[str, float]
    whitener: Whitener
    densities: Float[np.ndarray, "R N"] | Float[np.ndarray, ""] = dataclasses.field(
        default_factory=lambda: np.array(-np.inf)
    )
    blocks: Float[np.ndarray, " B"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    sizes: tuple[int, ...] = ()

    def initial_state_for(
        self, s: SuperModel, locations: tuple[EffectLocation, ...]
    ) -> Float[np.ndarray, "R W m"]:
        """First states with other effects on; states that the hypothesis does not have start at rest."""
        return embed_initial_state(s, locations, self.x0, self.locations)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the recordings [nat]."""
        total = float(np.sum(self.densities))
        return total if np.isfinite(total) else -np.inf

    def values(self, s: SuperModel) -> Float[np.ndarray, "R P"]:
        """Physical values of all parameters in each recording."""
        return self.physical(s)[0]

    def mean_values(self, s: SuperModel) -> Float[np.ndarray, " P"]:
        """Physical values; local parameters have their mean over recordings, phased ones the first value."""
        values, phased = self.values(s), [i for i in self.local if i in s.phased]
        mean = values.mean(axis=0)
        mean[phased] = values[0, phased]
        return mean

    def mean_local_z(self, s: SuperModel) -> Float[np.ndarray, " L"]:
        """Local parameters for a run of which nothing is known; sizes have the mean of physical values."""
        mean = self.local_z.mean(axis=0)
        if self.sizes:
            specs = [s.mechanism.parameter_specifications[i] for i in self.sizes]
            sizes = self.values(s)[:, list(self.sizes)].mean(axis=0)
            mean[[self.local.index(i) for i in self.sizes]] = Transform.of(specs).unconstrain(sizes)
        return mean

    def physical(self, s: SuperModel) -> tuple[Float[np.ndarray, "R P"], Float[np.ndarray, "R P"]]:
        """Physical values and their derivative by the unconstrained ones."""
        z = np.tile(self.z, (len(self.x0), 1))
        if self.local:
            z[:, list(self.local)] = self.local_z
        return s.transform.physical(z)

    def parameter_set(self, s: SuperModel) -> ParameterSet:
        """The parameter set with which it runs."""
        return ParameterSet(self.values(s), self.x0, s.gates(self.locations), self.K)

    @property
    def moved(self) -> int:
        """Number of coordinates that a fit moves: common parameters, local parameters, first states."""
        return len(self.free) + len(self.local) + self.x0.shape[-1]

    def directions(self, s: SuperModel, count: int) -> Directions:
        """Directions of all unconstrained coordinates that a fit moves, filled up with zeros to `count`."""
        (R, _, m), P, E = self.x0.shape, len(self.z), len(s.mechanism.effects)
        derivative = self.physical(s)[1]
        d = Directions(np.zeros((count, R, P)), np.zeros((count, m)), np.zeros((count, E)))
        for k, i in enumerate((*self.free, *self.local)):
            d.values[k, :, i] = derivative[:, i]
        start = len(self.free) + len(self.local)
        d.x0[start : start + m] = np.eye(m)
        return d


def embed_initial_state(
    s: SuperModel,
    locations: tuple[EffectLocation, ...],
    x0: Float[np.ndarray, "*batch k"],
    of: tuple[EffectLocation, ...] = (),
) -> Float[np.ndarray, "*batch m"]:
    """First states of a model with some effects on, from known states of a model with other effects on.

    States that are not known start at rest.

    Args:
        s: The super-model.
        locations: Effects that are on in the new model.
        x0: Known states; positions and speeds are enough.
        of: Effects that are on in the model of the known states.
    """
    before, after = (list(s.active(s.gates(on)).states) for on in (of, locations))
    full = np.tile(rest_state(s.mechanism.structure, np.float64), (*x0.shape[:-1], 1))
    full[..., before[: x0.shape[-1]]] = x0
    return full[..., after]


@dataclasses.dataclass(frozen=True)
class CandidateStart:
    """Where a refit of a candidate starts.

    Attributes:
        location: Effect and port.
        values: Parameter values of the candidate.
        others: Parameter values at the next best shapes.
        expected_gain: Gain in log-likelihood that the score test expects [nat]; 0 without a score test.
    """

    location: EffectLocation
    values: Float[np.ndarray, " K"]
    others: tuple[Float[np.ndarray, " K"], ...] = ()
    expected_gain: float = 0.0

    @property
    def shapes(self) -> list["CandidateStart"]:
        """The start at each of its shapes, the best one first."""
        return [dataclasses.replace(self, values=x) for x in (self.values, *self.others)]


def usual_start(s: SuperModel, location: EffectLocation) -> CandidateStart:
    """A start of a candidate at its usual sizes, for each of its shapes."""
    first, *others = (np.array(shape).max(axis=0) for shape in s.candidates[location].probes)
    return CandidateStart(location, first, tuple(others))


def with_candidate(s: SuperModel, h: Hypothesis, start: CandidateStart, share: float) -> Hypothesis:
    """The hypothesis with one more effect; an effect with memory replaces simpler ones that it contains."""
    name, port = start.location
    simpler = [EffectLocation(c, port) for c in CATALOG[name].contains if (c, port) in h.locations]
    if not simpler or CATALOG[name].state_part != "memory":
        return with_effect(s, h, start, share)
    return replacing(s, h, simpler, start, share)


def replacing(
    s: SuperModel, h: Hypothesis, simpler: Sequence[EffectLocation], start: CandidateStart, share: float
) -> Hypothesis:
    """The hypothesis with a richer effect that replaces simpler ones and takes over their parameters."""
    values, known, of_runs = h.mean_values(s), {}, {}
    name = [full.rpartition(".")[2] for full in s.mechanism.parameter_names]  # without port and effect
    for location in simpler:
        known |= {name[i]: values[i] for i in s.parameter_indices(location)}
        of_runs |= {name[i]: h.values(s)[:, i] for i in s.parameter_indices(location) if i in h.sizes}
        h = without(s, h, location)
    c, own = s.candidates[start.location], start.values.copy()
    for k, i in enumerate(c.parameters):
        if name[i] in known:
            # Parameters of the simpler effect keep their size; only other parameters get the share.
            own[k] = known[name[i]] / (share if c.scaled[k] else 1.0)
    richer = with_effect(s, h, dataclasses.replace(start, values=own), share)
    own = {i: of_runs[name[i]] for i in c.parameters if name[i] in of_runs}
    return with_own_friction(s, with_sizes_of_runs(s, richer, own), start.location) if own else richer


def with_effect(s: SuperModel, h: Hypothesis, start: CandidateStart, share: float) -> Hypothesis:
    """The hypothesis with one more effect, at a share of the size of its start."""
    c = s.candidates[start.location]
    specs = [s.mechanism.parameter_specifications[i] for i in c.parameters]
    size = np.abs(np.array(c.probes[0])).max(axis=0)
    values = np.where(c.scaled, share * start.values, start.values)
    for k, spec in enumerate(specs):
        # A lower bound is at minus infinity of the unconstrained coordinate: the start is a little above it.
        if np.isfinite(spec.lower) and k != c.line:
            values[k] = max(values[k], spec.lower + 0.05 * share * max(size[k], 1e-12))
    z = h.z.copy()
    z[list(c.parameters)] = Transform.of(specs).unconstrain(values)
    locations = (*h.locations, start.location)
    x0 = h.initial_state_for(s, locations)
    if CATALOG[start.location.effect].per_recording:
        shared = () if c.line is None else (c.parameters[c.line],)
        own = tuple(i for i in c.parameters if i not in shared)
        return dataclasses.replace(
            h,
            locations=locations,
            free=(*h.free, *shared),
            local=(*h.local, *own),
            local_z=np.hstack([h.local_z, np.tile(z[list(own)], (len(x0), 1))]),
            z=z,
            x0=x0,
        )
    return dataclasses.replace(h, locations=locations, free=(*h.free, *c.parameters), z=z, x0=x0)


def without(s: SuperModel, h: Hypothesis, location: EffectLocation) -> Hypothesis:
    """The hypothesis without one effect, with all other parameters unchanged."""
    removed = set(s.parameter_indices(location))
    kept = [k for k, i in enumerate(h.local) if i not in removed]
    locations = tuple(p for p in h.locations if p != location)
    return dataclasses.replace(
        h,
        locations=locations,
        x0=h.initial_state_for(s, locations),
        free=tuple(i for i in h.free if i not in removed),
        local=tuple(h.local[k] for k in kept),
        local_z=h.local_z[:, kept],
        sizes=tuple(i for i in h.sizes if i not in removed),
    )


def friction_sizes(m: Mechanism) -> list[str]:
    """Names of free sizes of dry friction: amplitudes of each law that have the unit of its first one."""
    units = {n: spec.unit for n, spec in zip(m.parameter_names, m.parameter_specifications, strict=True)}
    found = []
    for effect in [e for e in m.effects if e.law_of == DRY_FRICTION]:
        names = [effect.full_name(amplitude) for amplitude in effect.amplitudes]
        found += [n for n in names if n in m.free_names and units[n] == units[names[0]]]
    return found


def with_own_friction(s: SuperModel, h: Hypothesis, location: EffectLocation) -> Hypothesis:
    """The hypothesis with sizes of an effect for each recording; itself unless the effect is dry friction."""
    names = set(friction_sizes(s.mechanism))
    indices = [i for i in s.parameter_indices(location) if s.mechanism.parameter_names[i] in names]
    values = h.values(s)
    return with_sizes_of_runs(s, h, {i: values[:, i] for i in indices if i in h.free})


def with_sizes_of_runs(s: SuperModel, h: Hypothesis, sizes: dict[int, Float[np.ndarray, " R"]]) -> Hypothesis:
    """The hypothesis with a size of friction for each recording, in the place of one for all.

    Args:
        s: The super-model.
        h: The hypothesis.
        sizes: Index of a parameter -> its value in each recording.
    """
    if not sizes:
        return h
    specs = [s.mechanism.parameter_specifications[i] for i in sizes]
    own = Transform.of(specs).unconstrain(np.stack(list(sizes.values()), axis=1))
    return dataclasses.replace(
        h,
        free=tuple(i for i in h.free if i not in sizes),
        local=(*h.local, *sizes),
        local_z=np.hstack([h.local_z, own]),
        sizes=(*h.sizes, *sizes),
    )


def law_with_its_size(locations: Sequence[EffectLocation], location: EffectLocation) -> EffectLocation | None:
    """The law of dry friction, among some effects, that can take over the size of another one; None if none.

    The law contains the other one and has an amplitude of the same name. Coulomb friction beside Stribeck
    friction, for example, is Stribeck friction with the sum of the two levels.
    """
    if law_of(location.effect) != DRY_FRICTION:
        return None
    laws = (p for p in locations if p.contains(location))
    return next((p for p in laws if _common_sizes(p, location)), None)


def _common_sizes(a: EffectLocation, b: EffectLocation) -> list[str]:
    """Short names of amplitudes that two effects share."""
    return [n for n in CATALOG[a.effect].amplitudes if n in CATALOG[b.effect].amplitudes]


def handed_over(s: SuperModel, h: Hypothesis, location: EffectLocation) -> Hypothesis | None:
    """The hypothesis without one effect, whose size is added to `law_with_its_size`; None without a law."""
    law = law_with_its_size(h.locations, location)
    if law is None:
        return None
    less, values = without(s, h, location), h.values(s)
    z, local_z, index = less.z.copy(), less.local_z.copy(), s.mechanism.parameter_names.index
    for name in _common_sizes(law, location):
        i, given = index(law.full_name(name)), index(location.full_name(name))
        transform = Transform.of([s.mechanism.parameter_specifications[i]])
        total = (values[:, i] + values[:, given])[:, None]
        z[i] = transform.unconstrain(total.mean(axis=0))[0]
        if i not in less.local and given in h.sizes:
            less = with_sizes_of_runs(s, less, {i: total[:, 0]})
            local_z = less.local_z
        elif i in less.local:
            local_z[:, less.local.index(i)] = transform.unconstrain(total)[:, 0]
    return dataclasses.replace(less, z=z, local_z=local_z)


def with_all_calibrations(s: SuperModel, h: Hypothesis) -> Hypothesis:
    """The hypothesis with every calibration of the super-model; calibrations that it lacked start at zero."""
    missing = [p for p in s.calibrations if p not in h.locations]
    added = tuple(i for p in missing for i in s.parameter_indices(p))
    locations = (*h.locations, *missing)
    return dataclasses.replace(
        h,
        locations=locations,
        local=(*h.local, *added),
        local_z=np.hstack([h.local_z, np.zeros((len(h.x0), len(added)))]),
        x0=h.initial_state_for(s, locations),
    )


def parameter_count(s: SuperModel, h: Hypothesis, location: EffectLocation) -> int:
    """Number of values that an effect adds to a fit; a local parameter counts once for each recording."""
    return sum(len(h.x0) if i in h.local else 1 for i in s.parameter_indices(location))


def is_physical(s: SuperModel, h: Hypothesis, location: EffectLocation) -> bool:
    """Whether all parameters of an effect lie in their physical ranges."""
    values, specs = h.values(s), s.mechanism.parameter_specifications
    return all(
        specs[i].physical[0] <= value <= specs[i].physical[1]
        for i in s.parameter_indices(location)
        for value in values[:, i]
    )


def generalisations(s: SuperModel, h: Hypothesis) -> list[CandidateStart]:
    """Starts of candidates that contain an effect with memory that is on.

    The score test cannot rate such a candidate: it is no sum of the simpler effect and a further one, and its
    slope at shapes far from the shape that was found is not informative.
    """
    out = []
    for location, c in s.candidates.items():
        simpler = [n for n in CATALOG[location.effect].contains if CATALOG[n].state_part == "memory"]
        if location not in h.locations and any((n, location.port) in h.locations for n in simpler):
            first, *others = (np.array(group[0], float) for group in c.probes)
            out.append(CandidateStart(location, first, tuple(others)))
    return out
