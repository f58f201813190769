"""Registry of the report's figures; `@figure` adds one, with its caption and its section of the page."""

from rotflex_jax.text.plotting import FigureRegistry

FIGURES = FigureRegistry()
figure = FIGURES.figure
