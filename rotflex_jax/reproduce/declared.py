"""How a setting is declared: default, source, reason, range; and how a given value is checked."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from rotflex_jax.errors import InputError

PAPER, ASSUMPTION, NUMERICS = "paper", "assumption", "numerics"
TINY = 1e-12  # least value of what must be more than nothing


def setting(
    default: Any,
    source: str,
    why: str,
    *,
    unit: str = "",
    choices: tuple[Any, ...] = (),
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """A field of the settings.

    Args:
        default: Value where none is given; its type is the type of the setting.
        source: `PAPER`, `ASSUMPTION` or `NUMERICS`.
        why: Reason for the default, in words.
        unit: Of a number.
        choices: All that may be given; empty for a number.
        least: Smallest number; `TINY` for anything above zero.
        most: Largest number.
    """
    about = {"source": source, "why": why, "unit": unit, "choices": choices, "least": least, "most": most}
    return dataclasses.field(default=default, metadata=about)


def checked(field: dataclasses.Field, value: Any) -> Any:
    """The value in the type of the setting, or a refusal that says what is needed."""
    about, unit = field.metadata, field.metadata["unit"]
    default: Any = field.default
    if about["choices"]:
        if value not in about["choices"]:
            choices = ", ".join(map(str, about["choices"]))
            raise InputError(
                f"Setting {field.name} was given {value!r}, but is one of {choices}; choose one."
            )
        return value
    if isinstance(default, tuple):
        return value  # what a list must hold, only all settings together tell
    try:
        number = type(default)(value)
        right = math.isfinite(number) and number == value
    except (TypeError, ValueError, OverflowError):
        right, number = False, 0
    if not right or not about["least"] <= number <= about["most"]:
        kind = "a whole number" if isinstance(default, int) else "a number"
        raise InputError(
            f"Setting {field.name} was given {value!r}, but it needs {kind}{_bounds(about)}"
            f"{f' in {unit}' if unit else ''}; give for instance {default:g}."
        )
    return number


def _bounds(about: Mapping[str, Any]) -> str:
    least, most = about["least"], about["most"]
    low = "" if least == -math.inf else " above 0" if least == TINY else f" of at least {least:g}"
    return low + ("" if most == math.inf else f" and at most {most:g}")


def read(field: dataclasses.Field, value: Any) -> Any:
    """Text as the value that a setting needs; what cannot be read is left for the check to refuse."""
    if not isinstance(value, str):
        return value
    try:
        if field.name == "coefficient":
            return tuple(int(part) for part in value.replace("(", "").replace(")", "").split(","))
        if isinstance(field.default, bool):
            return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[
                value.lower()
            ]
        if isinstance(field.default, int | float):
            number = float(value)
            return int(number) if isinstance(field.default, int) and number == int(number) else number
    except (KeyError, ValueError, OverflowError):
        return value
    return value
