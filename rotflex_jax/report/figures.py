"""Every figure of a report, with a title and a caption that says what to see."""

import dataclasses

from matplotlib.figure import Figure

from rotflex_jax.discover.learned_result import LearnedTorqueResult
from rotflex_jax.discover.photographs import Photographs
from rotflex_jax.discover.result import Discovery
from rotflex_jax.report.evidence import parameters, ranking, staircase
from rotflex_jax.report.failure import profiles, residual_map, worst_channel
from rotflex_jax.report.latent import latent_maps, latent_time
from rotflex_jax.report.learned import learned_figure
from rotflex_jax.report.runs import LONGEST, overlay, shown, spectra
from rotflex_jax.report.wording import AT_NOISE, noise_ratios

__all__ = [
    "Picture",
    "latent_maps",
    "latent_time",
    "learned_figure",
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


def pictures(
    discovery: Discovery, lacking: Photographs | None = None, learned: LearnedTorqueResult | None = None
) -> dict[str, Picture]:
    """Figures by name; those that have nothing to show are left out.

    Args:
        discovery: What was found.
        lacking: Latent torques of the baseline and the final model; not drawn where None.
        learned: A learned torque; not drawn where None or not kept.
    """
    drawn = {
        "overlay": overlay(discovery),
        "staircase": staircase(discovery),
        "spectra": spectra(discovery),
        "map": residual_map(discovery),
        "profiles": profiles(discovery),
        "ranking": ranking(discovery),
        "parameters": parameters(discovery),
        "latent": lacking and latent_maps(lacking.before, lacking.after),
        "latent_time": lacking and latent_time(lacking.before, lacking.after),
        "learned": learned_figure(learned) if learned and learned.kept else None,
    }
    captions = _captions(discovery, lacking)
    return {name: Picture(figure, *captions[name]) for name, figure in drawn.items() if figure is not None}


def _captions(discovery: Discovery, lacking: Photographs | None) -> dict[str, tuple[str, str]]:
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
        "latent": (
            "The torque that would have to be added at each port for the model to follow what was "
            "measured (Kalman smoother). Shaded: 95 % band of the mean; grey: spread of single moments. "
            "Damper and spring of a fitted model take over the slope of what is missing; the panels "
            "marked + give back "
            + (
                "what they have more than in the final model, whose own torque (dashed) should be flat."
                if lacking and lacking.after
                else "the whole torque of the damper."
            ),
            "Mean of the unknown torque at each port over its speed and position, with bands.",
        ),
        "latent_time": (
            "The same torques in time, on held-out data, and by frequency. Fast changes drown in the "
            "noise of the sensor, so a jump looks rounded.",
            "The unknown torque at each port over time with its band, and its spectrum.",
        ),
        "learned": (
            "Left: the learned torque at each position and speed, grey where the recordings have hardly "
            "been. Right of it: a cut along each axis with its 95 % band. What damper, spring or an "
            "offset of the model could give is left out of map and formula alike.",
            "Map of the learned torque over position and speed, with cuts and the formula.",
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
