"""Structures that the final fit tries: effects, local parameters, and starts of the fits.

They are fitted to free runs over windows, which start from measured first states or from fitted ones.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.special
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis, friction_sizes, replacing, usual_start, without
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.fit.greybox import FirstState, fit
from rotflex_jax.fit.plausibility import BEYOND_RECORDINGS
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Solver
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, Transform
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import mesh_of, on_threads


@dataclasses.dataclass(frozen=True)
class FinalStructure:
    """A structure that is fitted to free runs.

    Attributes:
        starts: Models from which fits start, with the calibrations of the recordings. The first one has the
            parameters of the search or of an earlier fit. If there are several, the last one has usual
            values.
        local: Names of parameters that have a value for each recording.
        own: Calibrations that are not carried over to other recordings.
        on: Effects and calibrations that are on in the model that a user gets.
        hypothesis: The structure as a hypothesis of the search.
        supermodel: The super-model of this hypothesis.
        window_seconds: Length of free runs [s].
        friction: Names of the sizes of friction among `local`.
        first: Whether free runs start from measured or from fitted first states.
    """

    starts: tuple[Model, ...]
    local: tuple[str, ...]
    own: tuple[EffectLocation, ...]
    on: tuple[EffectLocation, ...]
    hypothesis: Hypothesis
    supermodel: SuperModel
    window_seconds: float
    friction: tuple[str, ...] = ()
    first: FirstState = "measured"

    @classmethod
    def of(
        cls,
        s: SuperModel,
        solver: Solver,
        h: Hypothesis,
        on: Sequence[EffectLocation],
        window_seconds: float,
        usual_shapes: bool = True,
    ) -> "FinalStructure":
        """The structure of a hypothesis.

        Fits start from its parameters and from usual ones.

        Args:
            s: The super-model.
            solver: Integration rule.
            h: The hypothesis.
            on: Effects and calibrations that are on in the model that a user gets.
            window_seconds: Length of free runs [s].
            usual_shapes: Whether one more fit starts from the amplitudes of the hypothesis with usual shapes.
        """
        given = [h.mean_values(s), _values_as_given(s, h)]
        if usual_shapes:
            given.insert(1, _values_with_usual_shapes(s, h))
        values = {tuple(v.tolist()): v for v in given}
        starts = tuple(Model(s.clean(v, h.locations), solver) for v in values.values())
        free = starts[0].mechanism.free_names
        local = [s.mechanism.parameter_names[i] for i in h.local]
        own = tuple(p for p in h.locations if p in s.calibrations and p not in on)
        local = tuple(n for n in local if n in free)
        friction = tuple(n for n in local if s.mechanism.parameter_names.index(n) in h.sizes)
        return cls(starts, local, own, tuple(on), h, s, window_seconds, friction)

    @property
    def solver(self) -> Solver:
        """Integration rule."""
        return self.starts[0].solver

    def also_from(self, start: Model) -> "FinalStructure":
        """The same structure with a further start."""
        return dataclasses.replace(self, starts=(*self.starts, start))

    def as_searched(self) -> "FinalStructure":
        """The same structure with fitted first states; fits start only from the parameters of the search."""
        return dataclasses.replace(self, starts=self.starts[:1], first="fitted")

    def carrying(self, *locations: EffectLocation) -> "FinalStructure":
        """The same structure with these calibrations carried over to the model that a user gets."""
        own = tuple(p for p in self.own if p not in locations)
        return dataclasses.replace(self, own=own, on=(*self.on, *locations))


@dataclasses.dataclass(frozen=True)
class FittedStructure:
    """A structure, and a fit of it to recordings."""

    structure: FinalStructure
    fit: Fit

    def with_law(self, law: EffectLocation) -> FinalStructure:
        """The structure with a law that replaces all other laws of the same thing at its port.

        The first start has the values of the fit; the new law takes over parameters of the same name. The
        second start has the user's values, and usual values of the effects that were found.

        Args:
            law: The new law, a candidate at the port.
        """
        this, s = self.structure, self.structure.supermodel
        replaced = [p for p in this.on if p in s.other_laws(law)]
        h = replacing(s, self.as_hypothesis(), replaced, usual_start(s, law), 1.0)
        on = list(dict.fromkeys(law if p in replaced else p for p in this.on))
        return FinalStructure.of(s, this.solver, h, on, this.window_seconds, usual_shapes=False)

    def without(self, left_out: Sequence[EffectLocation]) -> FinalStructure:
        """The structure without some effects; starts are this fit, which has them, and usual values."""
        this, h = self.structure, self.as_hypothesis()
        for location in left_out:
            h = without(this.supermodel, h, location)
        on = [p for p in this.on if p not in left_out]
        return FinalStructure.of(this.supermodel, this.solver, h, on, this.window_seconds, usual_shapes=False)

    def with_own_friction(self) -> FinalStructure:
        """The structure with sizes of dry friction for each recording; starts: this fit, usual values."""
        this = self.structure
        sizes = [n for n in friction_sizes(self.fit.model.mechanism) if n not in this.local]
        starts, friction = (self.fit.model, this.starts[-1]), (*this.friction, *sizes)
        return dataclasses.replace(this, starts=starts, local=(*this.local, *sizes), friction=friction)

    def as_hypothesis(self, run: int | None = None) -> Hypothesis:
        """The fit as a hypothesis of the search, with the mean of local parameters.

        Args:
            run: Index of the fitted recording whose friction is used, if each has its own; None for the mean.
        """
        s, h, m = self.structure.supermodel, self.structure.hypothesis, self.fit.model.mechanism
        if run is not None:
            m = m.with_values({n: self.fit.local[n][run].value for n in self.structure.friction})
        rows = [s.mechanism.parameter_names.index(n) for n in m.parameter_names]
        z = h.z.copy()
        z[rows] = Transform.of(m.parameter_specifications).unconstrain(m.values)
        return dataclasses.replace(h, z=z, local_z=np.tile(z[list(h.local)], (len(h.x0), 1)))

    def as_hypotheses(self, runs: Sequence[int | None]) -> list[Hypothesis]:
        """The fit as hypotheses for some recordings: one for each if friction differs between runs, else one.

        Args:
            runs: For each recording, the index of the fitted recording of the same run; None if there is
                none.
        """
        if not self.structure.friction:
            return [self.as_hypothesis()]
        return [self.as_hypothesis(run) for run in runs]

    @property
    def own_offsets(self) -> Float[np.ndarray, "R K"]:
        """Calibrations of each fitted recording, in typical sizes."""
        s, local = self.structure.supermodel, self.fit.local
        names, specs = s.mechanism.parameter_names, s.mechanism.parameter_specifications
        found = [[e.value / specs[i].typical for e in local[names[i]]] for i in s.local if names[i] in local]
        return np.array(found).T if found else np.zeros((0, 0))

    def own_values(self, count: int) -> Float[np.ndarray, "K L"]:
        """Unconstrained values of the local parameters of the search in each fitted recording."""
        s, m = self.structure.supermodel, self.fit.model.mechanism
        transform = Transform.of(m.parameter_specifications)
        z = np.array([transform.unconstrain(self.fit.model_of(k).mechanism.values) for k in range(count)])
        names = (s.mechanism.parameter_names[i] for i in self.structure.hypothesis.local)
        return z[:, [m.parameter_names.index(n) for n in names]]

    def with_common_offsets(self) -> "FittedStructure":
        """The fit with the common part of the offsets of the runs carried over to other recordings.

        The offset of a run is the offset of the machine plus a deviation of the run. From the values of K
        runs, with mean m and variance s^2 (K - 1 degrees of freedom), the offset of the machine is estimated
        as

            m max(0, 1 - s^2 / (K m^2)):

        the mean where the runs agree, and zero where the mean is no larger than its standard deviation.

        This is an empirical Bayes estimate with a prior of mean zero. It is better than the mean if the
        common part is small compared with the scatter of the runs.

        Source: after B. Efron and C. Morris, "Stein's estimation rule and its competitors - an empirical
        Bayes approach", Journal of the American Statistical Association 68 (1973) 117-130.
        """
        s, common, carried = self.structure.supermodel, dict[str, Estimate](), list[EffectLocation]()
        for location in self.structure.own:
            names = [s.mechanism.parameter_names[i] for i in s.parameter_indices(location)]
            shared = {n: _common(self.fit.local[n]) for n in names if n in self.fit.local}
            if any(e.value for e in shared.values()):
                common |= shared
                carried.append(location)
        found = dataclasses.replace(
            self.fit.with_values({n: e.value for n, e in common.items()}),
            parameters=tuple(common.get(e.name, e) for e in self.fit.parameters),
        )
        return FittedStructure(self.structure.carrying(*carried), found)

    @property
    def model(self) -> Model:
        """The model of the fit without calibrations that belong to the fitted recordings."""
        m = self.fit.model.mechanism
        for location in self.structure.own:
            m = m.without(*location)
        return dataclasses.replace(self.fit.model, mechanism=m)


def fit_structures(
    asked: Sequence[tuple[FinalStructure, Sequence[Recording]]],
) -> list[FittedStructure]:
    """Structures fitted to free runs over recordings; for each, the likeliest of the fits from its starts.

    A fit with parameters that the recordings do not reach is taken only if there is no other. Different
    starts may end in different local minima. From parameters fitted to predictions, a friction may get stiff,
    damped bristles; from usual parameters, soft ones. The same may happen from the search's fit to free runs.

    Args:
        asked: Structures, each with the recordings to which it is fitted.
    """

    def end(job: tuple[int, Model]) -> Fit:
        k, start = job
        structure, recordings = asked[k]
        # These starts replace the restarts of a fit.
        how = {"first": structure.first, "window_seconds": structure.window_seconds, "restarts": 0}
        return fit(start, list(recordings), local=structure.local, **how)

    # Fits of one structure share a program, which the first of them compiles, so fits of other structures
    # come between them.
    most = max((len(structure.starts) for structure, _ in asked), default=0)
    jobs = [(k, x.starts[i]) for i in range(most) for k, (x, _) in enumerate(asked) if i < len(x.starts)]
    # If there are several devices, each fit uses all of them.
    fits = on_threads(end, jobs) if mesh_of() is None else [end(job) for job in jobs]
    ends: list[list[Fit]] = [[] for _ in asked]
    for (k, _), found in zip(jobs, fits, strict=True):
        ends[k].append(found)

    def order(found: Fit) -> tuple[bool, bool, float]:
        beyond = any(remark.kind == BEYOND_RECORDINGS for remark in found.remarks)
        return not np.isfinite(found.cost), beyond, float(found.cost)

    best = [min(each, key=order) for each in ends]
    return [FittedStructure(structure, found) for (structure, _), found in zip(asked, best, strict=True)]


def _common(of_runs: Sequence[Estimate]) -> Estimate:
    """The common part of the estimates of several runs; see `FittedStructure.with_common_offsets`.

    Its interval has the width of the interval of the mean, which follows from the scatter of the runs.
    """
    values = [e.value for e in of_runs]
    count, mean = len(values), float(np.mean(values))
    std = float(np.std(values, ddof=1)) / np.sqrt(count)
    value = mean * max(0.0, 1.0 - (std / mean) ** 2) if mean else 0.0
    half = float(scipy.special.stdtrit(count - 1, 0.975)) * std
    note = "common to runs with " + ", ".join(f"{v:.3g}" for v in values)
    return dataclasses.replace(of_runs[0], value=value, std=std, ci95=(value - half, value + half), note=note)


def _values_with_usual_shapes(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, " P"]:
    """Parameter values with fitted sizes and usual shapes of the effects that were found.

    The sizes of an effect are its amplitudes that have the unit of its first parameter. An effect without
    such an amplitude keeps all of its fitted values.
    """
    values, specs = h.mean_values(s), s.mechanism.parameter_specifications
    for location in s.without_calibrations(h.locations):
        candidate, indices = s.candidates[location], s.parameter_indices(location)
        sizes = np.array([specs[i].unit for i in indices]) == specs[indices[0]].unit
        kept = np.asarray(candidate.amplitudes) & sizes
        if kept.any():
            values[indices] = np.where(kept, values[indices], np.array(candidate.probes[0][0]))
    return values


def _values_as_given(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, " P"]:
    """Parameter values: the user's values, usual values of the effects found, and fitted calibrations."""
    values, given = h.mean_values(s), list(s.baseline_free)
    values[given] = s.mechanism.values[given]
    for location in s.without_calibrations(h.locations):
        values[s.parameter_indices(location)] = np.array(s.candidates[location].probes[0][0])
    return values
