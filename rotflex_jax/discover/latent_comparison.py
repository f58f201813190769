"""What the models of a search lack, as torques along its recordings."""

import dataclasses
from collections.abc import Sequence

from rotflex_jax.discover.result import Stage
from rotflex_jax.effects import CATALOG
from rotflex_jax.latent import LatentTorque, latent_torque
from rotflex_jax.latent.torque import Progress
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

# Of a long recording only so much is smoothed [s].
SHOWN_SECONDS = 30.0


@dataclasses.dataclass(frozen=True)
class LatentTorqueComparison:
    """Latent torques of the same recordings.

    Attributes:
        before: What the baseline lacks.
        after: What the final model lacks; None where nothing was added, or where it has play in a gear.
    """

    before: LatentTorque
    after: LatentTorque | None


def compare_latent_torques(
    baseline: Stage, final: Stage | None, recordings: Sequence[Recording], progress: Progress | None = None
) -> LatentTorqueComparison:
    """Latent torques under a baseline and under the final model.

    Args:
        baseline: Before.
        final: After; None where nothing was added.
        recordings: Of each the first 30 s are used.
        progress: Called with a line of text now and then.
    """
    shown = [r.slice(0, min(r.N, round(SHOWN_SECONDS / r.Ts))) for r in recordings]
    if final is None or not all(e.slope_at_zero for e in final.model.mechanism.effects):
        # Impacts of teeth have no slopes: a smoother would take an impact for a torque.
        return LatentTorqueComparison(latent_torque(calibrated(baseline), shown, progress=progress), None)
    last = calibrated(final)
    first = with_effects_of(calibrated(baseline), last)
    return LatentTorqueComparison(*(latent_torque(m, shown, progress=progress) for m in (first, last)))


def calibrated(stage: Stage) -> Model:
    """The model of a stage with the offsets that belong to its recordings."""
    m = stage.model.mechanism
    for e in stage.estimates:
        port, effect, parameter = e.name.split(".")
        if e.name not in m.parameter_names and effect in CATALOG:
            m = m + CATALOG[effect](at=port, **{parameter: e.value})
    return dataclasses.replace(stage.model, mechanism=m)


def with_effects_of(small: Model, large: Model) -> Model:
    """A model as a larger one with effects switched off, so that both share compiled code."""
    own = small.mechanism
    present = {(e.name, e.at) for e in own.effects}
    m = large.mechanism
    missing = [e for e in own.effects if (e.name, e.at) not in {(f.name, f.at) for f in m.effects}]
    for e in missing:
        m = m + e
    values = dict(zip(own.parameter_names, own.values.tolist(), strict=True))
    gates = tuple(1.0 if (e.name, e.at) in present else 0.0 for e in m.effects)
    return Model(m.with_values(values), large.solver, gates)
