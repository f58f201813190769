"""Reproduction of the seed paper: its experiment with all settings, its figures, and an HTML page."""

from rotflex_jax.reproduce.experiment import Reproduction, reproduce
from rotflex_jax.reproduce.settings import Settings

__all__ = ["Reproduction", "Settings", "reproduce"]
