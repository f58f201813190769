"""Settings of the test session: strict JAX, types checked at run time, measured recordings if available."""

import contextlib
import gc
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import array_types  # noqa: F401 - before the package, whose functions it checks
import jax
import jaxtyping
import pytest

from rotflex_jax.data.datasets import DATASETS, FOLDER_VARIABLE, find, load_dataset
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches
from rotflex_jax.runtime.xla import enable_compilation_cache

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compiled programs are shared by all tests, by parallel processes and by later runs.
enable_compilation_cache(Path(__file__).resolve().parents[1] / ".pytest_cache" / "compiled")

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
if BESIDE.is_dir():
    os.environ.setdefault(FOLDER_VARIABLE, str(BESIDE))


def pytest_collection_finish() -> None:
    """Exclude objects that exist before the first test from garbage collection, which saves time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def memory_maps() -> Iterator[None]:
    """Release compiled programs before a module if the process is near the system's limit of memory maps."""
    clear_compilation_caches()
    yield


@pytest.fixture
def measured() -> Callable[[str], list[Recording]]:
    """`measured("rotflex")` gives the recordings of that data set, or skips the test."""

    def load(name: str) -> list[Recording]:
        folder = Path(os.environ.get(FOLDER_VARIABLE) or os.devnull)
        missing = [file.name for file in DATASETS[name].files if not find(file, folder)]
        if missing:
            pytest.skip(f"{FOLDER_VARIABLE} names no folder with {missing[0]}")
        return load_dataset(name)

    return load


@pytest.fixture
def without_final_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches end without the fit to training and validation data, which takes up to half of their time.

    For tests that are not about it; `test_discover_final_fit.py` has those that are.
    """
    summary = importlib.import_module("rotflex_jax.discover.summary")
    monkeypatch.setattr(summary, "fit_to_all", lambda *_: None)


_raises = pytest.raises


@contextlib.contextmanager
def _raises_unchecked(*arguments: Any, **options: Any) -> Iterator[Any]:
    """`pytest.raises`, without the check of types where an InputError of the package is expected."""
    refused = arguments[:1] == (InputError,)
    try:
        jaxtyping.config.update("jaxtyping_disable", refused)
        with _raises(*arguments, **options) as caught:
            yield caught
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def _raises_or_call(*arguments: Any, **options: Any) -> Any:
    return _raises(*arguments, **options) if len(arguments) > 1 else _raises_unchecked(*arguments, **options)


pytest.raises = _raises_or_call
