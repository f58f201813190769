"""The command line, `rotflex`."""

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
    from rotflex_jax.cli.app import main as run

    run(arguments)
