"""Compiled functions that are kept between runs until any file of the simulator changes.

Numba looks only at the file of a function to see whether its kept code is out of date, and this
simulator calls across files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

import numba
from numba.core import config

F = TypeVar("F", bound=Callable)

_HERE = Path(__file__).parent
# The files with compiled functions, and the columns that they have built in.
_FILES = [file.read_bytes() for file in sorted(_HERE.glob("*.py"))]
_SOURCES = b"".join(text for text in _FILES if b"@compiled" in text or b"class Tables" in text)
_FOLDER = _HERE / "__pycache__" / hashlib.sha256(_SOURCES).hexdigest()[:12]
_SETTING = "CACHE_DIR"


def compiled(function: F) -> F:
    """The function, compiled at its first call or taken from an earlier run."""
    previous = getattr(config, _SETTING)
    setattr(config, _SETTING, str(_FOLDER))
    try:
        return cast(F, numba.njit(cache=True)(function))
    finally:
        setattr(config, _SETTING, previous)
