"""Instant replacements of a search, for tests of batches; worker processes import this file."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording


def quick(model: Model, train: Recording, test: Recording, hold: str = "") -> Any:
    """A result computed from means over the recordings, in the format of a discovery."""
    channels = model.mechanism.channels
    rms = np.sqrt(np.mean(test.y**2, axis=0)).tolist()
    errors = {
        "held_out_rmse": dict(zip(channels, rms, strict=True)),
        "held_out_rmse_windows": {"seconds": 2.0, **dict(zip(channels, rms, strict=True))},
    }
    level = float(np.mean(np.abs(train.u)))
    turn = {"effect": "coulomb", "port": "hub", "equivalent": [], "level": level, **errors}
    found = {"schema": 1, "baseline": errors, "noise_floor": dict.fromkeys(channels, 5e-4)}
    rounds = [turn] if level > 1 else []
    return SimpleNamespace(
        to_dict=lambda: {**found, "verdict": "found" if rounds else "nothing_missing", "rounds": rounds}
    )


def dying_once(model: Model, train: Recording, test: Recording, folder: str = "") -> Any:
    """Kills its process at the first attempt at a mean absolute voltage above 1 V, and always above 3 V."""
    level = float(np.mean(np.abs(train.u)))
    mark = Path(folder) / f"{level:.9g}"
    if level > 1 and (level > 3 or not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return quick(model, train, test)


def waiting(model: Model, train: Recording, test: Recording, folder: str = "") -> Any:
    """Adds the id of its process to the file `running`, then waits for the file `go`."""
    import time

    with (Path(folder) / "running").open("a") as file:
        file.write(f"{os.getpid()}\n")
    while not (Path(folder) / "go").exists():
        time.sleep(0.02)
    return quick(model, train, test)


def faulty(model: Model, train: Recording, test: Recording) -> Any:
    """Raises an InputError if the mean absolute voltage exceeds 1 V, and a ZeroDivisionError above 3 V."""
    level = float(np.mean(np.abs(train.u)))
    if level > 3:
        raise ZeroDivisionError("a fault\nof the program")
    if level > 1:
        raise InputError("A level above 1 V was given, but the search wants less; turn it down.")
    return quick(model, train, test)
