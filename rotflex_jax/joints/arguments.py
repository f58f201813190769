"""Checks of arguments of presets, which may also be traced by JAX."""

from typing import Any

import numpy as np
from jax.core import Tracer

from rotflex_jax.checks import number


def known_number(value: Any, name: str, **limits: Any) -> Any:
    """A number within limits, as `checks.number`; a value that JAX traces is returned as it is."""
    return value if isinstance(value, Tracer) else number(value, name, **limits)


def plain(setting: Any) -> Any:
    """A setting of a kit as Python has it, where NumPy gives it."""
    return setting.item() if isinstance(setting, np.generic) else setting
