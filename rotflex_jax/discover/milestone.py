"""Lines of progress that carry the numbers they tell, for whoever draws them while a search runs."""

from collections.abc import Mapping, Sequence

import numpy as np

from rotflex_jax.discover.looks import as_read


class Milestone(str):
    """A line that tells the held-out error of a model that was reached.

    Attributes:
        label: What the model is.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> what its own unit is in that one.
    """

    label: str
    errors: dict[str, float]
    floor: dict[str, float]
    units: dict[str, str]
    factors: dict[str, float]


def milestone(
    label: str,
    channels: Sequence[str],
    units: Mapping[str, str],
    errors: np.ndarray,
    floor: np.ndarray,
) -> Milestone:
    """A line with its numbers.

    Args:
        label: What the model is.
        channels: Outputs of the model, in order.
        units: Channel -> its own unit.
        errors: Held-out error of short free runs, by channel (C,). While a search runs, their first states
            are fitted; its result has the errors from states that only the first samples tell.
        floor: Noise of the sensor, by channel (C,).

    >>> line = milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.array([0.01]), np.array([5e-4]))
    >>> line, line.errors
    ('+ coulomb at hub: held-out error theta 0.573 deg', {'theta': 0.01})
    """
    read = {c: as_read(1.0, units[c]) for c in channels}
    by_name = dict(zip(channels, (float(e) for e in errors), strict=True))
    told = ", ".join(f"{c} {read[c][0] * e:.3g} {read[c][1]}" for c, e in by_name.items())
    line = Milestone(f"{label}: held-out error {told}")
    line.label, line.errors = label, by_name
    line.floor = dict(zip(channels, (float(f) for f in floor), strict=True))
    line.units = {c: unit for c, (_, unit) in read.items()}
    line.factors = {c: factor for c, (factor, _) in read.items()}
    return line
