"""The seed paper, run again: its experiment with every setting in sight, its figures, its page."""

from rotflex_jax.reproduce.experiment import Reproduction, reproduce
from rotflex_jax.reproduce.settings import Settings

__all__ = ["Reproduction", "Settings", "reproduce"]
