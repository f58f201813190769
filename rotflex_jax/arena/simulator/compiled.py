"""Compiled functions that are kept between runs until any file of the simulator changes.

Numba looks only at the file of a function to see whether its kept code is out of date, and this
simulator calls across files.
"""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

try:
    import numba
    from numba.core import config
except ImportError as error:  # whoever looks for mistakes in the input gets a sentence
    raise ImportError(
        'The simulator of the arena needs numba; run pip install "rotflex_jax[arena]".'
    ) from error

F = TypeVar("F", bound=Callable)

_HERE = Path(__file__).parent
# The files with compiled functions, and the columns that they have built in.
_FILES = [file.read_bytes() for file in sorted(_HERE.glob("*.py"))]
_SOURCES = b"".join(text for text in _FILES if b"@compiled" in text or b"class Tables" in text)
_DIGEST = hashlib.sha256(_SOURCES).hexdigest()[:12]
# An installed package may lie where its user cannot write.
_OWN, _HOME = _HERE / "__pycache__", Path.home() / ".cache" / "rotflex_jax" / "arena"
_FOLDER = (_OWN if os.access(_OWN if _OWN.is_dir() else _HERE, os.W_OK) else _HOME) / _DIGEST
_SETTING = "CACHE_DIR"


def compiled(function: F) -> F:
    """The function, compiled at its first call or taken from an earlier run.

    What checks types around it, where a test asks for that, is left out: it cannot be compiled.
    """
    previous = getattr(config, _SETTING)
    setattr(config, _SETTING, str(_FOLDER))
    try:
        return cast(F, numba.njit(cache=True)(inspect.unwrap(function)))
    finally:
        setattr(config, _SETTING, previous)
