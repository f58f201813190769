"""Compiled functions that are cached between runs until any file of the simulator changes.

Numba checks only the file of a function to decide whether its cached code is out of date, but functions of
this simulator call functions in other files.
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
except ImportError as error:  # with a readable message
    raise ImportError(
        'The simulator of the arena needs numba; run pip install "rotflex_jax[arena]".'
    ) from error

F = TypeVar("F", bound=Callable)

_HERE = Path(__file__).parent
# Files with compiled functions, and the file with the numbers of columns that these functions use.
_FILES = [file.read_bytes() for file in sorted(_HERE.glob("*.py"))]
_SOURCES = b"".join(text for text in _FILES if b"@compiled" in text or b"class Tables" in text)
_DIGEST = hashlib.sha256(_SOURCES).hexdigest()[:12]
# The user may not be allowed to write into the folder of an installed package.
_OWN, _HOME = _HERE / "__pycache__", Path.home() / ".cache" / "rotflex_jax" / "arena"
_FOLDER = (_OWN if os.access(_OWN if _OWN.is_dir() else _HERE, os.W_OK) else _HOME) / _DIGEST
_SETTING = "CACHE_DIR"


def compiled(function: F) -> F:
    """The function, compiled at its first call or loaded from an earlier run.

    A wrapper that checks types, which tests can add, is removed first: it cannot be compiled.
    """
    previous = getattr(config, _SETTING)
    setattr(config, _SETTING, str(_FOLDER))
    try:
        return cast(F, numba.njit(cache=True)(inspect.unwrap(function)))
    finally:
        setattr(config, _SETTING, previous)
