"""The model of another kind: the joint's equations with friction, fitted to the same data."""

from collections.abc import Callable

from rotflex_jax.effects import Coulomb, DeadZone, VoltageOffset
from rotflex_jax.fit import fit
from rotflex_jax.mechanism import Exponential, Mechanism, simulate
from rotflex_jax.model import Model
from rotflex_jax.reproduce.models import Judged, judged
from rotflex_jax.reproduce.records import Records, thinned_like

SECONDS = 40.0
"""Of each training record that the fit takes; equations need no more."""
LONGEST_STEP = 5e-3


def grey_box(records: Records, say: Callable[[str], None]) -> Judged | None:
    """The linear joint with dry friction at hub and joint, dead zone and offset, fitted in free run.

    It starts from the listed constants and a little friction, and takes about half a minute. None where
    the recordings lack an output of the joint.

    Args:
        records: Both outputs are learnt from, one is judged.
        say: Told of every step.
    """
    train, test = records.whole
    if any(set(records.joint.channels) - set(r.channels) for r in (*train, *test)):
        return None
    start = with_friction(records.joint, dead_zone=not records.measured)
    substeps = max(1, round(train[0].Ts / LONGEST_STEP))
    part = [r.slice(0, min(r.N, round(SECONDS / r.Ts))) for r in train]
    say("grey box: fitting, which takes a while")
    found = fit(Model(start, Exponential(substeps=substeps)), part).model
    column = records.joint.channels.index(records.channel)
    held_out = thinned_like(records.test, [found.simulate(r)[:, column] for r in test])
    pulses = [
        simulate(found.mechanism, p.recording.u, p.recording.Ts, solver=found.solver)[:, column]
        for p in records.pulses
    ]
    about = (
        "equations with friction, dead zone and offset, fitted"
        if not records.measured
        else ("equations with friction and offset, fitted")
    )
    return judged(records, "grey box", about, len(start.free_names), outputs=(held_out, pulses))


def with_friction(joint: Mechanism, *, dead_zone: bool) -> Mechanism:
    """A linear joint with a little dry friction and an offset, where a fit can start.

    Args:
        joint: Linear.
        dead_zone: Whether there is a dead zone too.
    """
    for effect in (Coulomb("hub", level=0.01), Coulomb("joint", level=0.001), VoltageOffset(offset=0.0)):
        joint = joint + effect
    if not dead_zone:
        return joint
    # An offset shifts the dead zone: with both of its ends free, one of three numbers is superfluous.
    return (joint + DeadZone(positive=0.05, negative=0.05)).trust("input.dead_zone.negative")
