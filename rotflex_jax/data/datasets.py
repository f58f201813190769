"""Public recordings, each with its address and hash, downloaded on request.

None comes with the package: most have no licence that would allow it. A local folder, in the argument
`folder` or the environment variable ROTFLEX_DATA, replaces the network.
"""

import hashlib
import os
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from rotflex_jax.data.files import load
from rotflex_jax.data.readers import unpacked
from rotflex_jax.data.registry import BY_HAND, DATASETS, PublicDataset, PublicFile
from rotflex_jax.errors import InputError, optional
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

    The hash of every file is checked, wherever it comes from. A file of the folder may be packed by gzip,
    as `NAME.gz`; its hash is that of what is in it.

    Args:
        name: of the data set.
        folder: local folder with one subfolder per data set; the environment variable
            ROTFLEX_DATA, if set, is the default.

    Returns:
        Paths of the files, in the order of the data set.

    Raises:
        InputError: no such data set, one that is fetched by hand, a file missing in the folder, no
            network, or another hash.
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
        name: of the data set.
        folder: see `fetch`.

    Returns:
        Its recordings, in the order of its files.

    Raises:
        InputError: as `fetch`, and as `Recording`.
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
    """A synthetic recording that comes with the package: a joint with two effects that the model lacks."""
    with as_file(files("rotflex_jax.data") / "demo.csv") as path:
        return load(path)


def find(file: PublicFile, folder: Path) -> Path | None:
    """Where a folder of recordings has the file, plain or packed by gzip; None where it has not."""
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
    except ValueError as error:  # what arrived has another hash, and was thrown away
        raise InputError(
            f"What is at {file.address} is no longer the public file {file.name} (another "
            "SHA-256); get it from a colleague and name its folder."
        ) from error
    except OSError as error:
        raise InputError(
            f"{file.address} could not be downloaded ({type(error).__name__}); check the network, "
            f"or name a folder that has {file.name}, by argument or in {FOLDER_VARIABLE}."
        ) from error
