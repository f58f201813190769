"""A super-model of a few candidates on two short recordings, for tests of scores and refits."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover.hypothesis import Hypothesis, Whitener
from rotflex_jax.discover.likelihood import LikelihoodProblem, levenberg_marquardt
from rotflex_jax.discover.supermodel import EffectLocation, SuperModel, build, scales
from rotflex_jax.effects.base import Effect
from rotflex_jax.fit.dataset import Dataset, prepare
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, Mechanism
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording

HUB = EffectLocation("coulomb", "hub")
WANTED = ((fx.Coulomb, "hub"), (fx.Viscous, "hub"), (fx.CubicSpring, "joint"), (fx.Coulomb, "joint"))
SOLVER = Exponential(substeps=2)
NOISE = np.array([5.4e-4, 5.4e-4])


@functools.cache
def records(level: float = 0.0, seeds: tuple[int, ...] = (21, 22)) -> tuple[dict, ...]:
    """Recordings of one machine with Coulomb friction of `level` at the hub, offsets of +20 and -20 mV."""
    return tuple(
        make_record(
            {HUB: {"level": level}, ("voltage_offset", "input"): {"offset": 0.02 * (-1) ** k}},
            seed=seed,
            seconds=1.6,
            fs=400.0,
            perturb=0.0,
            rms=1.5,
        )
        for k, seed in enumerate(seeds)
    )


def recordings(made: tuple[dict, ...]) -> tuple[Recording, ...]:
    return tuple(Recording(u=r["u"], y=r["y"], Ts=r["Ts"], accept=("units",)) for r in made)


def baseline() -> Mechanism:
    """The true joint without viscous damping at the hub, which the free back-EMF has to replace."""
    joint = paper(joint_damping=0.003, hub_damping=0.004).without("viscous", "hub")
    return joint.release("hub.motor.back_emf")


@functools.cache
def supermodel() -> SuperModel:
    """One super-model for all tests, so that it is compiled once."""
    return supermodel_of(WANTED, recordings(records()))


def supermodel_of(wanted: Sequence[tuple[type[Effect], str]], found: tuple[Recording, ...]) -> SuperModel:
    """A super-model of other candidates, with the sizes of given recordings."""
    return build(baseline(), wanted, scales(Model(baseline()), found, dataset(found).torque_scale))


def dataset(found: tuple[Recording, ...]) -> Dataset:
    return dataclasses.replace(prepare(Model(baseline()), found), noise=NOISE)


def problem(found: tuple[Recording, ...], s: SuperModel | None = None) -> LikelihoodProblem:
    return LikelihoodProblem.of(s or supermodel(), SOLVER, dataset(found), ("hub", "joint"))


def unfitted(s: SuperModel, count: int = 2) -> Hypothesis:
    """The baseline of a super-model at rest, without free parameters; needs no compilation."""
    return Hypothesis(
        locations=s.calibrations,
        free=(),
        local=(),
        z=Transform.of(s.mechanism.parameter_specifications).unconstrain(s.mechanism.values),
        local_z=np.zeros((count, 0)),
        x0=np.zeros((count, 1, 4)),
        K=np.zeros((count, Layout.of(s.mechanism.structure).size, 2)),
        process_noise={},
        whitener=Whitener(np.eye(2)),
    )


def start(at: LikelihoodProblem, wrong: float = 0.0, locations=None) -> Hypothesis:
    """The baseline in a free run from rest, its free parameters wrong by the relative error `wrong`."""
    s = supermodel()
    locations = s.calibrations if locations is None else locations
    R = len(at.seen)
    z = Transform.of(s.mechanism.parameter_specifications).unconstrain(s.mechanism.values)
    z[s.local] = 0.0
    # The back-EMF that replaces the viscous damping at the hub, which the baseline lacks.
    z[s.mechanism.parameter_names.index("hub.motor.back_emf")] = np.log(0.00767 * 1.04)
    z[s.baseline_free] += np.log1p(wrong)
    h = Hypothesis(
        locations=locations,
        free=tuple(s.baseline_free),
        local=tuple(s.local),
        z=z,
        local_z=np.zeros((R, len(s.local))),
        x0=np.zeros((R, 1, 4)),
        K=np.zeros((R, Layout.of(s.mechanism.structure).size, 2)),
        process_noise={},
        whitener=Whitener(np.diag(1 / NOISE)),
    )
    return at.with_process_noise(h, {"hub": 0.0, "joint": 0.0})


def fitted(at: LikelihoodProblem) -> Hypothesis:
    """The baseline at its optimum, with a fitted whitener."""
    h = levenberg_marquardt(at, [start(at)])[0]
    return levenberg_marquardt(at, [h])[0]
