"""The error for bad input, and the import of optional packages."""

import importlib
import importlib.metadata
import re
from types import ModuleType


class InputError(ValueError):
    """Bad input, described in one sentence: what was given, what is needed, what to do.

    >>> raise InputError("Argument `Ts` must be positive [s], but is 0.")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `Ts` must be positive [s], but is 0.
    """


def optional(module: str, purpose: str) -> ModuleType:
    """Imports an optional package only when it is needed.

    Args:
        module: name of the module.
        purpose: what the user wanted to do; the first words of the message.

    Returns:
        The imported module.

    Raises:
        InputError: the package is not installed.

    >>> optional("no_such_package", "Reading a spreadsheet")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Reading a spreadsheet needs the package no_such_package, \
which is not installed; install it with `pip install "rotflex_jax[all]"`.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise InputError(
            f"{purpose} needs the package {package}, which is not installed; "
            f'install it with `pip install "rotflex_jax[{_extra_with(package)}]"`.'
        ) from error


def _extra_with(package: str) -> str:
    """The first extra, other than "dev", that installs the optional package; "all" if there is none."""
    try:
        lines = importlib.metadata.requires("rotflex_jax") or []
    except importlib.metadata.PackageNotFoundError:  # run from a folder
        lines = []
    for line in lines:
        match = re.match(r"([\w.-]+).*extra == ['\"](?!all|dev)(\w+)['\"]", line)
        if match and f"{match[1].replace('-', '_')}_".startswith(f"{package}_"):
            return match[2]
    return "all"
