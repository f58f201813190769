"""Figures of the torques that are missing: those of a smoother, and a learned one."""

from matplotlib.figure import Figure

from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.learned_torque_figure import learned_figure
from rotflex_jax.discover.result import SearchResult
from rotflex_jax.latent.figure import latent_maps, latent_time
from rotflex_jax.report.figures.registry import figure


def _over_motion(discovery: SearchResult, explanation: Explanation) -> str:
    better = explanation.latent is not None and explanation.latent.after is not None
    return (
        "The torque that would have to be added at each port for the model to follow what was "
        "measured (Kalman smoother). Shaded: 95 % band of the mean; grey: spread of single samples. "
        "Damper and spring of a fitted model take over the slope of what is missing; the panels "
        "marked + give back "
        + (
            "what they have more than in the final model, whose own torque (dashed) should be flat."
            if better
            else "the whole torque of the damper."
        )
    )


@figure(
    "latent",
    section="torque",
    caption=_over_motion,
    description="Mean of the unknown torque at each port over its speed and position, with bands.",
)
def latent_over_motion(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The missing torque at each port over speed and position; None where it was not computed."""
    latent = explanation.latent
    return latent_maps(latent.before, latent.after) if latent else None


@figure(
    "latent_time",
    section="torque",
    caption="The same torques in time, on held-out data, and by frequency. Fast changes drown in the "
    "noise of the sensor, so a jump looks rounded.",
    description="The unknown torque at each port over time with its band, and its spectrum.",
)
def latent_over_time(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The missing torque at each port in time and by frequency; None where it was not computed."""
    latent = explanation.latent
    return latent_time(latent.before, latent.after) if latent else None


@figure(
    "learned",
    section="learned_torque",
    caption="Left: the learned torque at each position and speed, grey where the recordings have hardly "
    "been. Right of it: a cut along each axis with its 95 % band. What damper, spring or an "
    "offset of the model could give is left out of map and formula alike.",
    description="Map of the learned torque over position and speed, with cuts and the formula.",
)
def learned_torque(discovery: SearchResult, explanation: Explanation) -> Figure | None:
    """The learned torque; None where there is none or it was not kept."""
    learned = explanation.learned
    return learned_figure(learned) if learned and learned.kept else None
