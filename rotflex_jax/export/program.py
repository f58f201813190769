"""A model's step as scalar expressions, unfolded from the functions that the simulator runs."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from rotflex_jax.effects.kinds import Linear
from rotflex_jax.errors import InputError
from rotflex_jax.export.expression import Scalar, node
from rotflex_jax.export.streams import Memory, per_sample
from rotflex_jax.export.unfold import CannotUnfold, unfold
from rotflex_jax.mechanism.assembly import Layout, driven_voltage
from rotflex_jax.mechanism.sensors import read_outputs
from rotflex_jax.model import Model
from rotflex_jax.precision import double_precision


@dataclasses.dataclass(frozen=True)
class Program:
    """A model as scalar expressions.

    Attributes:
        outputs: Readings at the start of a sample, from the state.
        voltage: What reaches the motor, from the command `u`.
        memories: States of the actuation.
        state: After a step, from the state and the voltage `v`.
    """

    outputs: list[Scalar]
    voltage: Scalar
    memories: tuple[Memory, ...]
    state: list[Scalar]


def program(model: Model, Ts: float) -> Program:
    """The program of a model.

    Raises:
        InputError: An effect that straight code cannot express, named.
    """
    if getattr(model.solver, "between", "held") != "held":
        raise InputError(
            "The model's voltage is smooth between samples, which takes samples that a controller has not "
            'got yet; export it with between="held".'
        )
    try:
        return _program(model, Ts)
    except CannotUnfold as error:
        raise InputError(
            f"{_guilty(model, Ts)} cannot be written as C code: it needs {error}; leave it out of the "
            f"model, or write its law with the operations of jax.numpy on single numbers."
        ) from None


def _program(model: Model, Ts: float) -> Program:
    mechanism, solver = model.mechanism, model.solver
    structure = mechanism.structure
    layout = Layout.of(structure)
    x = np.array([node("x", i) for i in range(layout.size)], object)
    v = np.array(node("v"), object)
    with double_precision():
        values, gates = model.numbers()
        one_step: Any = dataclasses.replace(solver, substeps=1)  # of which the code takes `substeps`
        constants = solver.prepare(structure, values, gates, jnp.asarray(Ts))
        outputs = unfold(lambda s: read_outputs(mechanism, gates, s), x)
        advanced = unfold(lambda s, w: one_step.advance(structure, s, w, constants), x, v)
        voltage, memories = per_sample(
            lambda u: driven_voltage(mechanism, gates, u, jnp.asarray(Ts)), node("u")
        )
    return Program(list(outputs), voltage, tuple(memories), list(advanced))


def _guilty(model: Model, Ts: float) -> str:
    """The effect that stands in the way."""
    gates = model.gates or (1.0,) * len(model.mechanism.effects)
    kept = [(e, g) for e, g in zip(model.mechanism.effects, gates, strict=True) if isinstance(e, Linear)]
    for effect, gate in zip(model.mechanism.effects, gates, strict=True):
        if isinstance(effect, Linear):
            continue
        alone = [*kept, (effect, gate)]
        effects, switches = zip(*alone, strict=True)
        mechanism = dataclasses.replace(model.mechanism, effects=effects, trusted=())
        try:
            _program(dataclasses.replace(model, mechanism=mechanism, gates=switches), Ts)
        except CannotUnfold:
            return f"{effect.title} at {effect.at} ({type(effect).__name__})"
    return "The model"
