"""The command line, `rotflex`."""

from rotflex_jax.cli.app import main

__all__ = ["main"]
