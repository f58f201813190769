"""The command line, `rotflex`."""

import os
from collections.abc import Sequence
from typing import NoReturn

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit status.

    Args:
        arguments: Those of the process if None. Where another program gives them, its signals are its own.
    """
    if arguments is None:
        from rotflex_jax.cli.stopping import STOP

        STOP.listen()  # before anything else is loaded
        # XLA reports steps of its compiler that did not converge as errors, though the program is right. What
        # fails raises; the variable is read when JAX is imported.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    from rotflex_jax.cli.app import main as run

    run(arguments)
