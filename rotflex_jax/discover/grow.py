"""A hypothesis with one effect more, or one less."""

import dataclasses

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.score import Score
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.kinds import Memory
from rotflex_jax.parameters import Transform


def grown(judge: Judge, h: Hypothesis, score: Score, share: float) -> Hypothesis:
    """The hypothesis with one more effect, or with it in the place of simpler ones that it contains."""
    name, port = score.place
    simpler = [(c, port) for c in CATALOG[name].contains if (c, port) in h.places]
    if not simpler or not issubclass(CATALOG[name], Memory):
        return with_effect(judge, h, score, share)
    return in_place_of(judge, h, simpler, score, share)


def in_place_of(judge: Judge, h: Hypothesis, simpler: list[Place], score: Score, share: float) -> Hypothesis:
    """The hypothesis with a richer law in the place of simpler ones, which begins with their numbers."""
    s = judge.bench.supermodel
    values, known = h.values(judge.bench).mean(axis=0), {}
    for place in simpler:
        names = [s.mechanism.parameter_names[i].rpartition(".")[2] for i in s.parameter_indices(place)]
        known |= dict(zip(names, values[s.parameter_indices(place)], strict=True))
        h = without(judge, h, place)
    start = score.start.copy()
    for k, i in enumerate(s.candidates[score.place].parameters):
        parameter = s.mechanism.parameter_names[i].rpartition(".")[2]
        if parameter in known:
            # What the simpler law has already keeps its size; the share is for the rest.
            amplitude = s.candidates[score.place].amplitudes[k]
            start[k] = known[parameter] / (share if amplitude else 1.0)
    return with_effect(judge, h, dataclasses.replace(score, start=start), share)


def with_effect(judge: Judge, h: Hypothesis, score: Score, share: float) -> Hypothesis:
    """The hypothesis with one more effect, at a share of the amplitude that the score test points to."""
    s = judge.bench.supermodel
    c = s.candidates[score.place]
    specs = [s.mechanism.parameter_specifications[i] for i in c.parameters]
    size = np.abs(np.array(c.probes[0])).max(axis=0)
    start = np.where(c.amplitudes, share * score.start, score.start)
    for k, spec in enumerate(specs):
        # A bound at zero is the end of a logarithm: begin a little inside.
        if np.isfinite(spec.lower):
            start[k] = max(start[k], spec.lower + 0.05 * share * max(size[k], 1e-12))
    z = h.z.copy()
    z[list(c.parameters)] = Transform.of(specs).unconstrain(start)
    places = (*h.places, score.place)
    return dataclasses.replace(
        h, places=places, free=(*h.free, *c.parameters), z=z, x0=h.seated(judge.bench, places)
    )


def is_physical(judge: Judge, h: Hypothesis, place: Place) -> bool:
    """Whether the effect's numbers lie in their physical range."""
    s = judge.bench.supermodel
    values = h.values(judge.bench).mean(axis=0)
    specs = s.mechanism.parameter_specifications
    return all(specs[i].physical[0] <= values[i] <= specs[i].physical[1] for i in s.parameter_indices(place))


def without(judge: Judge, h: Hypothesis, place: Place) -> Hypothesis:
    """The hypothesis less one effect, its other numbers as they are."""
    s = judge.bench.supermodel
    gone = set(s.parameter_indices(place))
    kept = [k for k, i in enumerate(h.local) if i not in gone]
    places = tuple(p for p in h.places if p != place)
    return dataclasses.replace(
        h,
        places=places,
        x0=h.seated(judge.bench, places),
        free=tuple(i for i in h.free if i not in gone),
        local=tuple(h.local[k] for k in kept),
        own=h.own[:, kept],
    )


def richer(judge: Judge, h: Hypothesis) -> list[Score]:
    """Laws with memory that contain another one that is on, as starts.

    The search adds effects, but such a law is not the simpler one and something more, and its slope at
    shapes that are far from the one found says little.
    """
    out = []
    for (name, port), c in judge.bench.supermodel.candidates.items():
        simpler = [s for s in CATALOG[name].contains if issubclass(CATALOG[s], Memory)]
        if (name, port) not in h.places and any((s, port) in h.places for s in simpler):
            starts = [np.array(group[0], float) for group in c.probes]
            out.append(Score((name, port), 0.0, 0.0, starts[0], True, 1.0, 1.0, tuple(starts[1:])))
    return out
