"""Public benchmarks with their official protocol: training and test recordings, and the error.

    benchmark = rf.data.benchmark("emps")
    result = rf.discover(rf.joints.emps(), *benchmark.train.split(0.7))
    benchmark.score(result.model)

The tests are free runs, the first state comes from the first `n_init` samples, and the error is the root
mean square of what follows. Published results are listed, each as its source has it: baselines, not the best
that there is. A result is left out where it is not sure that the test was unseen.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Real

from rotflex_jax.data.datasets import load_dataset
from rotflex_jax.errors import InputError
from rotflex_jax.metrics import rmse
from rotflex_jax.recording import Recording

BASELINES = "Champneys, Beintema, Tóth, Schoukens, Rogers 2024, arXiv 2405.10779, tables 3 and 4"


@runtime_checkable
class Simulates(Protocol):
    """A model that can be scored."""

    def simulate(self, recording: Recording) -> Real[np.ndarray, "N C"]:
        """Free run."""
        ...


@dataclass(frozen=True)
class Published:
    """A published result.

    Args:
        method: of identification.
        errors: name of the test to error, in the unit of the benchmark.
        source: where it is published.
    """

    method: str
    errors: Mapping[str, float]
    source: str


@dataclass(frozen=True)
class Constant:
    """A published parameter of the machine.

    Args:
        parameter: full name in the ready-made mechanism.
        value: in the unit of the parameter.
        about: what it is, with unit.
    """

    parameter: str
    value: float
    about: str


@dataclass(frozen=True)
class Benchmark:
    """A data set with its protocol.

    Args:
        name: of the data set.
        train: for training and validation; split it as you like.
        tests: name to test recording, `n_init` set.
        unit: of the errors.
        factor: errors in that unit per unit of the channel.
        published: results.
        constants: published parameters of the machine.
        source: who made the data.
    """

    name: str
    train: Recording
    tests: Mapping[str, Recording]
    unit: str
    factor: float
    published: tuple[Published, ...]
    constants: tuple[Constant, ...]
    source: str

    def score(self, model: Simulates) -> dict[str, float]:
        """Official errors of a model: test to root mean square error of its free run [`unit`].

        Args:
            model: fitted to `train` and to nothing else.
        """
        return {name: self.error(name, model.simulate(test)) for name, test in self.tests.items()}

    def error(self, test: str, y_hat: Any) -> float:
        """Official error of one free run [`unit`].

        Args:
            test: name of the test.
            y_hat: output of the model, (N,) or (N, 1).
        """
        if test not in self.tests:
            raise InputError(f"{self.name} has no test {test!r}; choose one of {', '.join(self.tests)}.")
        recording = self.tests[test]
        modelled = np.asarray(y_hat, dtype=float).reshape(len(y_hat), -1)
        return self.factor * rmse(recording, modelled)[recording.channels[0]]

    def best(self, test: str) -> float:
        """Least of the published errors that are listed here [`unit`]; others may have published less."""
        return min(p.errors[test] for p in self.published if test in p.errors)


def benchmark(name: str, folder: str | os.PathLike[str] | None = None) -> Benchmark:
    """A public benchmark, its recordings fetched or taken from a folder.

    Args:
        name: "emps" or "silverbox".
        folder: as in `fetch`.

    Raises:
        InputError: no such benchmark, or as `fetch`.
    """
    if name not in _MAKERS:
        raise InputError(f"There is no benchmark {name!r}; choose one of {', '.join(_MAKERS)}.")
    return _MAKERS[name](load_dataset(name, folder))


def _emps(recordings: list[Recording]) -> Benchmark:
    train, pulses = recordings
    found = lambda method, error: Published(method, {"pulses": error}, BASELINES)  # noqa: E731
    return Benchmark(
        name="emps",
        train=train,
        tests=MappingProxyType({"pulses": pulses}),
        unit="mm",
        factor=1e3,
        published=(
            found("polynomial NARX", 5.17),
            found("linear state space", 5.53),
            found("ARX", 12.6),
            found("LSTM", 74.0),
            found("RNN", 89.0),
        ),
        constants=(
            Constant("axis.inertia.inertia", 95.11, "mass [kg]"),
            Constant("axis.viscous.coefficient", 203.5, "viscous damping [N s/m]"),
            Constant("axis.coulomb.level", 20.39, "dry friction [N]"),
            Constant(
                "input.voltage_offset.offset", 3.16 / 35.15065, "offset, -3.16 N of friction, as input [V]"
            ),
        ),
        source="Janot, Gautier, Brunot 2019, Data set and reference models of EMPS",
    )


def _silverbox(recordings: list[Recording]) -> Benchmark:
    train, *tests = recordings
    names = ("multisine", "arrow", "arrow without extrapolation")

    def found(method: str, multisine: float, arrow: float) -> Published:
        return Published(method, {"multisine": multisine, "arrow": arrow}, BASELINES)

    return Benchmark(
        name="silverbox",
        train=train,
        tests=MappingProxyType(dict(zip(names, tests, strict=True))),
        unit="mV",
        factor=1e3,
        published=(
            found("Gaussian-process NARX", 0.301, 0.60),
            found("SUBNET", 0.36, 1.4),
            found("linear", 6.96, 14.4),
        ),
        constants=(),
        source="Wigren, Schoukens 2013, Three free data sets for development and benchmarking",
    )


_MAKERS = {"emps": _emps, "silverbox": _silverbox}
