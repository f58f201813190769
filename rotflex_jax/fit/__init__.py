"""Fits: parameters of a mechanism from recordings, with honest intervals."""

from rotflex_jax.fit.greybox import fit

__all__ = ["fit"]
