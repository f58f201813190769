"""Every figure of a report, with a title and a caption that says what to see."""

import dataclasses

from matplotlib.figure import Figure

from rotflex_jax.discover.result import Discovery
from rotflex_jax.report.evidence import parameters, ranking, staircase
from rotflex_jax.report.failure import profiles, residual_map, worst_channel
from rotflex_jax.report.runs import LONGEST, overlay, shown, spectra
from rotflex_jax.report.wording import AT_NOISE, noise_ratios

__all__ = [
    "Picture",
    "overlay",
    "parameters",
    "pictures",
    "profiles",
    "ranking",
    "residual_map",
    "spectra",
    "staircase",
]


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure with its words.

    Attributes:
        figure: What is drawn.
        caption: One or two sentences: what to see.
        description: For those who cannot see it.
    """

    figure: Figure
    caption: str
    description: str


def pictures(discovery: Discovery) -> dict[str, Picture]:
    """Figures by name; those that have nothing to show are left out."""
    drawn = {
        "overlay": overlay(discovery),
        "staircase": staircase(discovery),
        "spectra": spectra(discovery),
        "map": residual_map(discovery),
        "profiles": profiles(discovery),
        "ranking": ranking(discovery),
        "parameters": parameters(discovery),
    }
    captions = _captions(discovery)
    return {name: Picture(figure, *captions[name]) for name, figure in drawn.items() if figure is not None}


def _captions(discovery: Discovery) -> dict[str, tuple[str, str]]:
    reached = [c for c, r in noise_ratios(discovery).items() if r < AT_NOISE]
    both = bool(discovery.rounds)
    s = shown(discovery)
    part = f" {LONGEST:g} s of it are shown." if s.recording.duration > LONGEST else ""
    channel = worst_channel(discovery)
    return {
        "overlay": (
            "Top rows: where a coloured line covers the grey one, the model is right. Bottom rows: "
            f"measured minus simulated; the grey band is what the sensor alone makes.{part}",
            "Measured and simulated outputs over time on held-out data, with their differences.",
        ),
        "staircase": (
            "Each step is one effect added. "
            + (
                f"The error of {' and '.join(reached)} ends at the noise of the sensor."
                if reached
                else "What is left above the dashed line is not the sensor's noise."
            ),
            "Held-out error of each model on a logarithmic scale, with the noise of the sensor.",
        ),
        "spectra": (
            "Where a line lies on the dashed one, nothing is left to explain at these frequencies.",
            "Spectral density of the held-out error, with the level of white sensor noise.",
        ),
        "map": (
            f"Left: error of {channel} at each speed and position; blank where the machine hardly "
            "ever was. Right of it: the mean acceleration that the model lacks there. A pattern is "
            "the picture of a missing force, less what other parameters took over; speckles are "
            "noise" + ("; after the last round none should be left." if both else "."),
            "Maps of the held-out error and of the missing acceleration over speed and position.",
        ),
        "profiles": (
            "Bars above the black line mark where the baseline makes more than its share of error; "
            "the outermost take what lies beyond.",
            "Share of the error by bins, against the share that an even spread would have.",
        ),
        "ranking": (
            "How strongly the recordings ask for each effect before any is added. An effect low "
            "in this list may be found in a later round, and a high one may only imitate another.",
            "Bars of the score of each candidate effect.",
        ),
        "parameters": (
            "Missing physics bends the parameters that are there; they settle once it is added. "
            "Bars are 95 % intervals; parameters near zero are only in the table.",
            "Parameters of each model relative to their final values, with intervals.",
        ),
    }
