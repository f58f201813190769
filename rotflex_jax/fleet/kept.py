"""Results on disk: one file a recording, and a digest of all that went into it."""

import functools
import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax import __version__
from rotflex_jax.errors import InputError
from rotflex_jax.fleet.task import Record, Search
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

RESULTS, MODELS = "recordings", "models"
SCHEMA = 1


def digest_of_search(
    model: Model, search: Search, share: float, reading: Mapping[str, Any], places: Iterable[str]
) -> str:
    """Digest of all that the recordings have in common; the same in another process."""
    m = model.mechanism
    physics = (m.coordinates, m.ports, m.effects, m.outputs, sorted(m.trusted), m.units)
    said = repr(
        (__version__, physics, model.solver, model.gates, _named(search), share, sorted(reading.items()))
    )
    files = [Path(place).read_bytes() for place in places if place.endswith(".py")]
    return _digest(said.encode(), *files)


def digest_of_recording(source: Path | Recording, common: str) -> str:
    """Digest of a recording and of what is done with it.

    Raises:
        OSError: The file cannot be read.
    """
    if isinstance(source, Recording):
        labels = (source.Ts, source.channels, source.units, source.input_name, source.input_unit)
        labels = (*labels, source.n_init, source.start, source.accept, sorted(source.resolution.items()))
        arrays = (np.ascontiguousarray(a).tobytes() for a in (source.u, source.y))
        return _digest(common.encode(), repr(labels).encode(), *arrays)
    return _digest(common.encode(), source.read_bytes())


def _digest(*parts: bytes) -> str:
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big") + part)
    return found.hexdigest()


def _named(search: Any) -> str:
    """A function by its name, with the arguments that it carries."""
    if isinstance(search, functools.partial):
        return f"{_named(search.func)}{search.args!r}{sorted(search.keywords.items())!r}"
    return f"{search.__module__}.{search.__qualname__}"


def names_of(sources: Sequence[Path | Recording]) -> list[str]:
    """A name for each recording, fit for a file: that of its own file where no other has it.

    >>> names_of([Path("a/run.csv"), Path("b/run.csv"), Path("b/step.csv")])[2]
    'step'
    """
    plain = [s.stem if isinstance(s, Path) else Path(s.source).stem or "recording" for s in sources]
    plain = ["".join(c if c.isalnum() or c in "-_.+" else "_" for c in name) for name in plain]
    count = Counter(plain)
    return [
        name if count[name] == 1 else f"{name}-{_short(source, number)}"
        for number, (name, source) in enumerate(zip(plain, sources, strict=True), 1)
    ]


def _short(source: Path | Recording, number: int) -> str:
    if isinstance(source, Recording):
        return str(number)
    return _digest(str(source.resolve()).encode())[:8]


def write(folder: Path, record: Record) -> None:
    """Write a result, and before it its model; each whole or not at all, whatever ends this process."""
    record = {"schema": SCHEMA, **record}
    model, name = record.pop("model"), f"{record['name']}.json"
    if model is not None:
        _write(folder / MODELS / name, model)
    _write(folder / RESULTS / name, json.dumps(record, indent=1) + "\n")


def _write(file: Path, text: str) -> None:
    part = file.with_name(f".{file.name}.{os.getpid()}")
    part.write_text(text, encoding="utf-8")
    part.replace(file)


def read(folder: Path, name: str, digest: str) -> Record | None:
    """The result of the same search of the same recording; None where there is none to rely on."""
    try:
        known = json.loads((folder / RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = isinstance(known, dict) and known.get("schema") == SCHEMA and known.get("digest") == digest
    return known if same and known.get("state") in ("done", "refused") else None


def made(folder: str | os.PathLike[str]) -> Path:
    """The folder of the results, created.

    Raises:
        InputError: It cannot be.
    """
    try:
        for part in (RESULTS, MODELS):
            (Path(folder) / part).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot hold the results ({error.strerror or error}), but they need a folder of "
            "their own; name another."
        ) from None
    return Path(folder)
