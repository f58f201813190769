"""What kernels are taken of: a mechanism, or a model of one with its rule of integration and gates."""

from typing import NamedTuple, Protocol

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.simulate import Solver
from rotflex_jax.mechanism.step import Exponential


class Modelled(Protocol):
    """A model: mechanism, integration rule, one gate per effect or None for all on."""

    @property
    def mechanism(self) -> Mechanism:
        """The physics."""
        ...

    @property
    def solver(self) -> Solver:
        """Integration rule."""
        ...

    @property
    def gates(self) -> tuple[float, ...] | None:
        """Factor of each effect."""
        ...


class Subject(NamedTuple):
    """A mechanism, how it is integrated, which effects are on, and the output that is asked for."""

    mechanism: Mechanism
    solver: Solver
    gates: np.ndarray
    output: int

    @property
    def unit(self) -> str:
        """Unit of the output."""
        return "rad/s" if self.mechanism.outputs[self.output][1][1] == "speed" else "rad"


def subject(model: Mechanism | Modelled, channel: str) -> Subject:
    """The parts of a model; a bare mechanism is integrated by one exponential step per sample.

    Raises:
        InputError: The mechanism has no such output.
    """
    if isinstance(model, Mechanism):
        mechanism, solver, given = model, Exponential(), None
    else:
        mechanism, solver, given = model.mechanism, model.solver, model.gates
    if channel not in mechanism.channels:
        raise InputError(
            f"Kernels of {channel!r} were asked for, but the mechanism has the outputs "
            f"{', '.join(mechanism.channels)}; choose one of these."
        )
    if getattr(solver, "between", "held") != "held":
        raise InputError(
            "Kernels were asked of a model whose voltage is smooth between its samples, but each sample then "
            'acts before its time; take a solver with between="held".'
        )
    gates = np.ones(len(mechanism.effects)) if given is None else np.array(given, float)
    return Subject(mechanism, solver, gates, mechanism.channels.index(channel))


def lags_of(memory: int) -> int:
    """A memory, checked.

    Raises:
        InputError: Not a whole number of at least one lag.
    """
    if memory != int(memory) or memory < 1:
        raise InputError(
            f"Argument `memory` was given {memory!r}, but it needs a whole number of lags; give 1 or more."
        )
    return int(memory)
