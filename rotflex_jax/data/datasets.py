"""Public recordings, downloaded on request, and public benchmarks with their official protocol.

No public recording is part of the package: most have no licence that would allow it. A local folder, given by
the argument `folder` or the environment variable ROTFLEX_DATA, replaces the download.

    benchmark = rf.data.benchmark("emps")
    result = rf.discover(rf.joints.emps(), *benchmark.train.split(0.7))
    benchmark.score(result.model)

The tests are free runs: the first state comes from the first `n_init` samples, and the error is the root mean
square over the samples after these. Published results are listed as in their sources; they are baselines, not
the best known results. A result is left out if it is not certain that the test data were unseen.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Real

from rotflex_jax.data.files import load
from rotflex_jax.data.readers import unpacked
from rotflex_jax.data.registry import BY_HAND, DATASETS, PublicDataset, PublicFile
from rotflex_jax.errors import InputError, optional
from rotflex_jax.metrics import rmse
from rotflex_jax.recording import Recording

FOLDER_VARIABLE = "ROTFLEX_DATA"


def list_datasets() -> tuple[PublicDataset, ...]:
    """The public recordings that can be fetched.

    >>> [dataset.name for dataset in list_datasets()]
    ['rotflex', 'emps', 'silverbox', 'rotary_arm', 'two_dof_link', 'bam_xl330', 'so101']
    """
    return tuple(DATASETS.values())


def fetch(name: str, folder: str | os.PathLike[str] | None = None) -> list[Path]:
    """The files of a data set: from a folder if one is given, else downloaded once into a cache.

    The hash of every file is checked, wherever the file comes from. A file of the folder may be packed by
    gzip, as `NAME.gz`; the hash is then that of its content.

    Args:
        name: name of the data set.
        folder: local folder with one subfolder for each data set; the environment variable
            ROTFLEX_DATA, if set, is the default.

    Returns:
        Paths of the files, in the order of the data set.

    Raises:
        InputError: the data set does not exist or has to be fetched by hand, a file is missing in the folder,
            there is no network, or a file has another hash.
    """
    if name in BY_HAND:
        raise InputError(f"The data set {name!r} is not downloaded here; {BY_HAND[name].advice}.")
    if name not in DATASETS:
        raise InputError(f"There is no data set {name!r}; choose one of {', '.join(DATASETS)}.")
    local = folder if folder is not None else os.environ.get(FOLDER_VARIABLE)
    get = _download if not local else lambda file: _in_folder(file, Path(local))
    return [get(file) for file in DATASETS[name].files]


def load_dataset(name: str, folder: str | os.PathLike[str] | None = None) -> list[Recording]:
    """The recordings of a data set.

    Args:
        name: name of the data set.
        folder: see `fetch`.

    Returns:
        The recordings, in the order of the files.

    Raises:
        InputError: as in `fetch` and in `Recording`.
    """
    recordings: list[Recording] = []
    paths = fetch(name, folder)
    for file, path in zip(DATASETS[name].files, paths, strict=True):
        if file.companion:
            continue
        read = DATASETS[name].reader(path)
        recordings += read if isinstance(read, list) else [read]
    return recordings


def demo_recording() -> Recording:
    """A synthetic recording in the package, of a joint with two effects that the default model lacks."""
    with as_file(files("rotflex_jax.data") / "demo.csv") as path:
        return load(path)


def find(file: PublicFile, folder: Path) -> Path | None:
    """Path of a file in a folder of recordings, plain or packed by gzip; None if it is not there."""
    path = folder / file.name
    return next((p for p in (path, path.with_name(f"{path.name}.gz")) if p.is_file()), None)


def _in_folder(file: PublicFile, folder: Path) -> Path:
    path = find(file, folder)
    if path is None:
        raise InputError(
            f"{folder / file.name} does not exist, though the folder was given for public recordings; "
            "put the file there, or leave the folder out to download it."
        )
    found = hashlib.sha256(unpacked(path)).hexdigest()
    if found != file.sha256:
        raise InputError(
            f"{path} has the SHA-256 {found[:12]}..., but the public file has "
            f"{file.sha256[:12]}...; replace it with the original."
        )
    return path


def _download(file: PublicFile) -> Path:
    pooch: Any = optional("pooch", "Fetching public recordings")
    try:
        return Path(
            pooch.retrieve(
                url=file.address,
                known_hash=f"sha256:{file.sha256}",
                fname=file.name,
                path=pooch.os_cache("rotflex_jax"),
            )
        )
    except ValueError as error:  # the downloaded file has another hash, and was deleted
        raise InputError(
            f"What is at {file.address} is no longer the public file {file.name} (another "
            "SHA-256); get it from a colleague and name its folder."
        ) from error
    except OSError as error:
        raise InputError(
            f"{file.address} could not be downloaded ({type(error).__name__}); check the network, "
            f"or name a folder that has {file.name}, by argument or in {FOLDER_VARIABLE}."
        ) from error


BASELINES = "Champneys, Beintema, Tóth, Schoukens, Rogers 2024, arXiv 2405.10779, tables 3 and 4"


@runtime_checkable
class Simulates(Protocol):
    """A model that can be scored."""

    def simulate(self, recording: Recording) -> Real[np.ndarray, "N C"]:
        """Outputs of a free run over the recording."""
        ...


@dataclass(frozen=True)
class Published:
    """A published result.

    Args:
        method: method of identification.
        errors: name of the test -> error, in the unit of the benchmark.
        source: publication of the result.
    """

    method: str
    errors: Mapping[str, float]
    source: str


@dataclass(frozen=True)
class Constant:
    """A published parameter of the machine.

    Args:
        parameter: full name in the ready-made mechanism.
        value: value in the unit of the parameter.
        about: description, with unit.
    """

    parameter: str
    value: float
    about: str


@dataclass(frozen=True)
class Benchmark:
    """A data set with its protocol.

    Args:
        name: name of the data set.
        train: recording for training and validation; split it as you like.
        tests: name -> test recording, with the official `n_init`.
        unit: unit of the errors.
        factor: factor from the unit of the channel to the unit of the errors.
        published: published results.
        constants: published parameters of the machine.
        source: authors of the data.
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
        """Official errors of a model: test -> root mean square error of its free run [`unit`].

        Args:
            model: model that was fitted to `train` alone.
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
        """Least of the published errors that are listed here [`unit`]; there may be lower ones elsewhere."""
        return min(p.errors[test] for p in self.published if test in p.errors)


def benchmark(name: str, folder: str | os.PathLike[str] | None = None) -> Benchmark:
    """A public benchmark; its recordings are downloaded or taken from a folder.

    Args:
        name: "emps" or "silverbox".
        folder: as in `fetch`.

    Raises:
        InputError: the benchmark does not exist, or as in `fetch`.
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
