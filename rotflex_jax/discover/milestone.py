"""A line of progress with the validation error of a model that a search has reached."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.labels import with_titles
from rotflex_jax.text.numbers import as_read


class Milestone(str):
    """A line with the validation error of a model that was reached.

    Attributes:
        label: What the model is.
        errors: Channel -> error of short free runs [unit of the channel].
        floor: Channel -> noise of the sensor [unit of the channel].
        units: Channel -> unit in which people read it.
        factors: Channel -> what its own unit is in that one.
        kept: What a search needs to go on from this model, in plain JSON types; see `checkpoint`.
    """

    kept: dict[str, Any]
    label: str
    errors: dict[str, float]
    floor: dict[str, float]
    units: dict[str, str]
    factors: dict[str, float]


def milestone(
    label: str,
    channels: Sequence[str],
    units: Mapping[str, str],
    errors: Float[np.ndarray, " C"],
    floor: Float[np.ndarray, " C"],
) -> Milestone:
    """A line with the errors that it names.

    Args:
        label: What the model is.
        channels: Outputs of the model, in order.
        units: Channel -> its own unit.
        errors: Validation error of short free runs, by channel. While a search runs, their first states
            are fitted; its result has the errors from states estimated from the first samples alone.
        floor: Noise of the sensor, by channel.

    >>> line = milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.array([0.01]), np.array([5e-4]))
    >>> line, line.errors
    ('+ Coulomb friction at hub: short runs from fitted first states leave theta 0.573 deg', {'theta': 0.01})
    """
    read = {c: as_read(1.0, units[c]) for c in channels}
    by_name = dict(zip(channels, (float(e) for e in errors), strict=True))
    label = with_titles(label)
    listed = ", ".join(f"{c} {read[c][0] * e:.3g} {read[c][1]}" for c, e in by_name.items())
    line = Milestone(f"{label}: short runs from fitted first states leave {listed}")
    line.label, line.errors, line.kept = label, by_name, {}
    line.floor = dict(zip(channels, (float(f) for f in floor), strict=True))
    line.units = {c: unit for c, (_, unit) in read.items()}
    line.factors = {c: factor for c, (factor, _) in read.items()}
    return line
