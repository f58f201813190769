"""What a last fit fits: effects, parameters of recordings of their own, the starts, and the fits themselves.

Fits are to free runs over windows that start from what their first samples show.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.special
from jaxtyping import Float

from rotflex_jax.discover.batched_predictor import on_threads
from rotflex_jax.discover.hypothesis import Hypothesis, replacing, usual_start, without
from rotflex_jax.discover.in_place import other_laws
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel
from rotflex_jax.effects.base import DRY_FRICTION
from rotflex_jax.fit.greybox import fit
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Solver
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, Transform
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import mesh_of


@dataclasses.dataclass(frozen=True)
class Structure:
    """What is fitted.

    Attributes:
        starts: Models from which fits start, with the calibrations of the recordings.
        local: Parameters that each recording has for itself.
        own: Calibrations that are not carried over to other recordings.
        on: What is on in the model that a user gets.
        hypothesis: The same as the search has it.
        supermodel: What it is a hypothesis of.
        window_seconds: Length of free runs [s].
        friction: Sizes of friction among `local`.
    """

    starts: tuple[Model, ...]
    local: tuple[str, ...]
    own: tuple[EffectLocation, ...]
    on: tuple[EffectLocation, ...]
    hypothesis: Hypothesis
    supermodel: SuperModel
    window_seconds: float
    friction: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        s: SuperModel,
        solver: Solver,
        h: Hypothesis,
        on: Sequence[EffectLocation],
        window_seconds: float,
        *more_starts: Float[np.ndarray, " P"],
    ) -> "Structure":
        """The structure of a hypothesis.

        Args:
            s: What it is a hypothesis of.
            solver: Integration rule.
            h: The hypothesis; fits start from its parameters.
            on: What is on in the model that a user gets.
            window_seconds: Length of free runs [s].
            more_starts: Values of all parameters to start from besides.
        """
        values = {tuple(v.tolist()): v for v in (h.mean_values(s), *more_starts)}
        starts = tuple(Model(s.clean(v, h.locations), solver) for v in values.values())
        free = starts[0].mechanism.free_names
        local = [s.mechanism.parameter_names[i] for i in h.local]
        own = tuple(p for p in h.locations if p in s.calibrations and p not in on)
        local = tuple(n for n in local if n in free)
        return cls(starts, local, own, tuple(on), h, s, window_seconds)

    def with_law(self, law: EffectLocation, found: Fit) -> "Structure":
        """The structure with a law in the place of all others of the same thing at its port.

        Args:
            law: It takes their place; a candidate at the port.
            found: A fit of this structure to training recordings. Its values are the first start, and the law
                keeps those of parameters of the same name; the second start is that of a user.
        """
        s = self.supermodel
        replaced = [p for p in self.on if p in other_laws(s, law)]
        h = replacing(s, self.as_hypothesis(found), replaced, usual_start(s, law), 1.0)
        on = list(dict.fromkeys(law if p in replaced else p for p in self.on))
        return Structure.of(s, self.starts[0].solver, h, on, self.window_seconds, as_given(s, h))

    def without(self, left_out: Sequence[EffectLocation], found: Fit) -> "Structure":
        """The structure without some effects; it starts from a fit with them."""
        h = self.as_hypothesis(found)
        for location in left_out:
            h = without(self.supermodel, h, location)
        on = [p for p in self.on if p not in left_out]
        more = as_given(self.supermodel, h)
        return Structure.of(self.supermodel, self.starts[0].solver, h, on, self.window_seconds, more)

    def with_own_friction(self, found: Fit) -> "Structure":
        """The structure with dry friction of its own size in each recording; it starts from a fit without."""
        m, sizes = found.model.mechanism, []
        units = {n: spec.unit for n, spec in zip(m.parameter_names, m.parameter_specifications, strict=True)}
        for effect in [e for e in m.effects if e.law_of == DRY_FRICTION]:
            names = [f"{effect.at}.{effect.name}.{amplitude}" for amplitude in effect.amplitudes]
            sizes += [n for n in names if n in m.free_names and units[n] == units[names[0]]]
        starts = (found.model, self.starts[-1])
        return dataclasses.replace(self, starts=starts, local=(*self.local, *sizes), friction=tuple(sizes))

    def as_hypothesis(self, found: Fit, run: int | None = None) -> Hypothesis:
        """A fit in the terms of the search, what recordings have for themselves at its mean.

        Args:
            found: The fit.
            run: Which of the fitted recordings the friction is of, where each has its own; None for the mean.
        """
        s, m = self.supermodel, found.model.mechanism
        if run is not None:
            m = m.with_values({n: found.local[n][run].value for n in self.friction})
        rows = [s.mechanism.parameter_names.index(n) for n in m.parameter_names]
        z = self.hypothesis.z.copy()
        z[rows] = Transform.of(m.parameter_specifications).unconstrain(m.values)
        local_z = np.tile(z[list(self.hypothesis.local)], (len(self.hypothesis.x0), 1))
        return dataclasses.replace(self.hypothesis, z=z, local_z=local_z)

    def own_values(self, found: Fit, count: int) -> Float[np.ndarray, "K L"]:
        """Unconstrained values of the local parameters of the search in each of the fitted recordings."""
        s, m = self.supermodel, found.model.mechanism
        transform = Transform.of(m.parameter_specifications)
        z = np.array([transform.unconstrain(found.model_of(k).mechanism.values) for k in range(count)])
        return z[:, [m.parameter_names.index(s.mechanism.parameter_names[i]) for i in self.hypothesis.local]]

    def with_common_offsets(self, found: Fit) -> tuple["Structure", Fit]:
        """The structure that carries over what runs have in common of their offsets, and the fit with that.

        The offset of a run is that of the machine plus a deviation of the run. By the values of K runs, with
        mean m and variance s^2 (of K - 1 degrees of freedom), that of the machine is estimated as

            m max(0, 1 - s^2 / (K m^2)):

        their mean where they agree, zero where it is no larger than its standard deviation.

        This is an empirical Bayes estimate with a prior of mean zero; it is better than the mean where what
        runs have in common is small against their scatter.

        Source: after B. Efron and C. Morris, "Stein's estimation rule and its competitors - an empirical
        Bayes approach", Journal of the American Statistical Association 68 (1973) 117-130.
        """
        s, common, carried = self.supermodel, dict[str, Estimate](), list[EffectLocation]()
        for location in self.own:
            names = [s.mechanism.parameter_names[i] for i in s.parameter_indices(location)]
            shared = {n: _common(found.local[n]) for n in names if n in found.local}
            if any(e.value for e in shared.values()):
                common |= shared
                carried.append(location)
        left = tuple(p for p in self.own if p not in carried)
        mechanism = found.model.mechanism.with_values({n: e.value for n, e in common.items()})
        found = dataclasses.replace(
            found,
            model=dataclasses.replace(found.model, mechanism=mechanism),
            parameters=tuple(common.get(e.name, e) for e in found.parameters),
        )
        return dataclasses.replace(self, own=left, on=(*self.on, *carried)), found

    def carried(self, found: Fit) -> Model:
        """The model of a fit without what belongs to the recordings that were fitted."""
        m = found.model.mechanism
        for location in self.own:
            m = m.without(*location)
        return dataclasses.replace(found.model, mechanism=m)


def _common(of_runs: Sequence[Estimate]) -> Estimate:
    """What runs have in common by the estimates of each; see `Structure.with_common_offsets`.

    Its interval has the width of that of their mean, by how they differ.
    """
    values = [e.value for e in of_runs]
    count, mean = len(values), float(np.mean(values))
    std = float(np.std(values, ddof=1)) / np.sqrt(count)
    value = mean * max(0.0, 1.0 - (std / mean) ** 2) if mean else 0.0
    half = float(scipy.special.stdtrit(count - 1, 0.975)) * std
    note = "common to runs with " + ", ".join(f"{v:.3g}" for v in values)
    return dataclasses.replace(of_runs[0], value=value, std=std, ci95=(value - half, value + half), note=note)


def with_usual_shapes(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, " P"]:
    """Parameter values with amplitudes in the unit of an effect's first parameter as fitted, others as usual.

    An effect without such an amplitude is left as it is.
    """
    values, specs = h.mean_values(s), s.mechanism.parameter_specifications
    for location in s.without_calibrations(h.locations):
        candidate, indices = s.candidates[location], s.parameter_indices(location)
        sizes = np.array([specs[i].unit for i in indices]) == specs[indices[0]].unit
        kept = np.asarray(candidate.amplitudes) & sizes
        if kept.any():
            values[indices] = np.where(kept, values[indices], np.array(candidate.probes[0][0]))
    return values


def as_given(s: SuperModel, h: Hypothesis) -> Float[np.ndarray, " P"]:
    """Values of the user's model as given and usual ones of what was found; calibrations as fitted."""
    values, given = h.mean_values(s), list(s.baseline_free)
    values[given] = s.mechanism.values[given]
    for location in s.without_calibrations(h.locations):
        values[s.parameter_indices(location)] = np.array(s.candidates[location].probes[0][0])
    return values


def fitted(asked: Sequence[tuple[Structure, Sequence[Recording]]]) -> list[Fit]:
    """Structures fitted to free runs of recordings, each the likelier of the ends from its starts.

    Parameters of predictions may lead to another local minimum of free runs than usual ones: to stiff,
    damped bristles of a friction instead of soft ones. Those of the search's free runs may, too.
    """

    def end(job: tuple[int, Model]) -> Fit:
        k, start = job
        structure, recordings = asked[k]
        how = {"first": "measured", "window_seconds": structure.window_seconds}
        return fit(start, list(recordings), local=structure.local, **how)

    # Those of one structure share a program, which one of them compiles: others first.
    most = max((len(structure.starts) for structure, _ in asked), default=0)
    jobs = [(k, x.starts[i]) for i in range(most) for k, (x, _) in enumerate(asked) if i < len(x.starts)]
    # A fit spreads over several devices, if there are some.
    fits = on_threads(end, jobs) if mesh_of() is None else [end(job) for job in jobs]
    ends: list[list[Fit]] = [[] for _ in asked]
    for (k, _), found in zip(jobs, fits, strict=True):
        ends[k].append(found)
    return [min(each, key=lambda found: float(np.nan_to_num(found.cost, nan=np.inf))) for each in ends]
