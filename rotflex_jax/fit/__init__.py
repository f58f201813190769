"""Fits: parameters of a mechanism, or weights of a basis, from recordings, with honest intervals."""

from rotflex_jax.fit.forward_regression import forward_regression
from rotflex_jax.fit.greybox import fit
from rotflex_jax.fit.least_squares import least_squares
from rotflex_jax.fit.many_starts import ManyStarts, many_starts
from rotflex_jax.fit.series_fit import SeriesFit

__all__ = ["ManyStarts", "SeriesFit", "fit", "forward_regression", "least_squares", "many_starts"]
