"""Every figure of a report, each with a caption that says what to see.

To add one, write a function of a `SearchResult` (and of an `Explanation`, if it needs one) in one of these
modules and decorate it with `@figure`; the page shows it in its section.
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
    """Figures by name; those that have nothing to show are left out.

    Args:
        discovery: What was found.
        explanation: With the missing torques; these are not drawn where None.
    """
    return FIGURES.pictures(discovery, explanation or Explanation())
