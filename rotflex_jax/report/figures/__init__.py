"""All figures of a report, with captions.

To add a figure, write a function of a `SearchResult` (and of an `Explanation` if needed) in one of these
modules and decorate it with `@figure`. The page then shows the figure in its section.
"""

from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.result import SearchResult
from rotflex_jax.report.figures.evidence import parameters, probabilities, ranking, staircase
from rotflex_jax.report.figures.failure import profiles, residual_map
from rotflex_jax.report.figures.registry import FIGURES
from rotflex_jax.report.figures.residuals import residuals, responses
from rotflex_jax.report.figures.runs import (
    latent_over_motion,
    latent_over_time,
    learned_torque,
    overlay,
    spectra,
)
from rotflex_jax.text.plotting import Picture

__all__ = [
    "latent_over_motion",
    "latent_over_time",
    "learned_torque",
    "overlay",
    "parameters",
    "pictures",
    "probabilities",
    "profiles",
    "ranking",
    "residual_map",
    "residuals",
    "responses",
    "spectra",
    "staircase",
]


def pictures(discovery: SearchResult, explanation: Explanation | None = None) -> dict[str, Picture]:
    """Name -> figure, without figures that have nothing to show.

    Args:
        discovery: Result of a search.
        explanation: Further results, such as latent and learned torques; None for figures without them.
    """
    return FIGURES.pictures(discovery, explanation or Explanation())
