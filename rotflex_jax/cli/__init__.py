"""The command line, `rotflex`."""

import os
from collections.abc import Sequence
from typing import NoReturn

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit status.

    Args:
        arguments: Arguments, or None for those of the process. If another program gives them, it keeps its
            own handling of signals.
    """
    if arguments is None:
        from rotflex_jax.cli.stopping import STOP

        STOP.listen()  # before anything else is loaded
        # XLA logs compiler passes that did not converge as errors, although the program is right. A real
        # failure raises an exception. The variable is read when JAX is imported.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    from rotflex_jax.cli.app import main as run

    run(arguments)
