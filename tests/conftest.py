"""A strict JAX session, and the measured recordings where they are at hand."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import pytest

from rotflex_jax.data.datasets import DATASETS, FOLDER_VARIABLE, load_dataset
from rotflex_jax.discover.room import make_room
from rotflex_jax.fastloops import enable_compilation_cache
from rotflex_jax.recording import Recording

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# What one test has compiled serves the others, those of a process beside it, and the next run.
enable_compilation_cache(Path(__file__).resolve().parents[1] / ".pytest_cache" / "compiled")

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
if BESIDE.is_dir():
    os.environ.setdefault(FOLDER_VARIABLE, str(BESIDE))


@pytest.fixture(autouse=True, scope="module")
def room() -> Iterator[None]:
    """A process that runs all tests would hold more compiled code than the system has room for."""
    make_room()
    yield


@pytest.fixture
def measured() -> Callable[[str], list[Recording]]:
    """`measured("rotflex")` gives the recordings of that data set, or skips the test."""

    def load(name: str) -> list[Recording]:
        folder = Path(os.environ.get(FOLDER_VARIABLE) or os.devnull)
        missing = [file.name for file in DATASETS[name].files if not (folder / file.name).is_file()]
        if missing:
            pytest.skip(f"{FOLDER_VARIABLE} names no folder with {missing[0]}")
        return load_dataset(name)

    return load
