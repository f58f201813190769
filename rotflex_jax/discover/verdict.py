"""Assessment of a final model (what it explains, what remains in units of the noise), and the verdicts.

A new verdict is a member of `Verdict` and a case of the rule in `conclusion.py`.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, MUTED
from rotflex_jax.text.numbers import json_number, json_numbers, multiple, percent_explained, ratio

# An error below this multiple of the sensor noise counts as having reached the noise.
NEAR_FLOOR = 1.5
# An error from this multiple of the sensor noise on counts as far from the noise.
FAR_FLOOR = 5.0
# The model explains the recordings if process noise gains less than this per measured value of the training
# recordings [nat], and errors of short free runs over validation recordings are below `NEAR_FLOOR` times what
# noise alone causes.
TORQUE_NATS = 0.03


class Grade(StrEnum):
    """Distance of an error from the noise of its sensor."""

    NOISE = "noise"
    NEAR = "near"
    FAR = "far"


def grade(times: float) -> Grade | None:
    """The grade of an error; None if the noise is not known.

    Args:
        times: Error over the standard deviation of the noise.

    >>> [str(grade(t)) for t in (1.17, 3.0, 229.0)]
    ['noise', 'near', 'far']
    """
    if math.isnan(times):
        return None
    return Grade.NOISE if times < NEAR_FLOOR else Grade.NEAR if times < FAR_FLOOR else Grade.FAR


@dataclasses.dataclass(frozen=True)
class Assessment:
    """Quantities on which the verdict rests.

    Attributes:
        explained: Channel -> share of the baseline's squared error that the final model explains [%]; not a
            number where runs of the baseline diverge or have no error.
        remaining: Channel -> error of short free runs that remains, in multiples of the sensor noise.
        torque_nats: Log-likelihood that random torques still gain per measured value of the training
            recordings [nat]; near 0 if the model is right.
        seconds: Length of the free runs of `remaining` [s]; 0 if it is not known.
        expected: Channel -> error of such runs by noise alone, in multiples of the sensor noise: noise in the
            first samples of a run also moves its first state. Channels without a value count as 1.
    """

    explained: dict[str, float]
    remaining: dict[str, float]
    torque_nats: float
    seconds: float = 0.0
    expected: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def limits(self) -> dict[str, float]:
        """Channel -> error from which on more than noise remains, in multiples of the sensor noise."""
        return {c: NEAR_FLOOR * max(1.0, self.expected.get(c, 1.0)) for c in self.remaining}

    @property
    def at_noise(self) -> bool:
        """Whether the errors of all channels have reached what noise causes."""
        return all(times < self.limits[c] for c, times in self.remaining.items())

    @property
    def torque_free(self) -> bool:
        """Whether predictions need no random torque."""
        return self.torque_nats < TORQUE_NATS

    @property
    def is_explained(self) -> bool:
        """Whether the model explains the recordings: both criteria hold."""
        return self.at_noise and self.torque_free

    @property
    def misfit(self) -> float:
        """How far the model is from explaining the recordings; 1 if it explains them.

        It is the largest of these ratios: square of the error of short free runs in a channel over its limit,
        and gain of random torques over its limit. The limits are those of the verdict.
        """
        shares = [(times / self.limits[c]) ** 2 for c, times in self.remaining.items()]
        shares.append(self.torque_nats / TORQUE_NATS)
        return math.inf if any(map(math.isnan, shares)) else max(1.0, *shares)

    @property
    def grade(self) -> Grade | None:
        """Grade of the channel that is furthest from its noise."""
        known = [times for times in self.remaining.values() if not math.isnan(times)]
        return grade(max(known)) if known else None

    @property
    def criterion(self) -> str:
        """The criterion that decided, as a clause."""
        runs = f"free runs over {self.seconds:g} s" if self.seconds else "short free runs"
        unknown = [c for c, times in self.remaining.items() if math.isnan(times)]
        if not self.at_noise:
            if all(times < self.limits[c] for c, times in self.remaining.items() if c not in unknown):
                return (
                    f"the sensor noise of {' and '.join(unknown)} is not known, to compare what is left with"
                )
            times = in_noise(self.remaining)
            limit = in_noise(self.limits) if self.expected else f"{NEAR_FLOOR:g}"
            return f"errors of {runs} are {times} times the sensor noise (limit {limit})"
        within = f"errors of {runs} are within {NEAR_FLOOR:g} times {self._noise_alone}"
        if not self.torque_free:
            return (
                f"{within}, but predictions are likelier with a random torque ({self.torque_nats:.2g} nat "
                f"per measured value, limit {TORQUE_NATS:g})"
            )
        return f"{within}, and predictions are hardly likelier with a random torque"

    @property
    def _noise_alone(self) -> str:
        """What the limit of the errors is relative to, in words."""
        if not self.expected:
            return "the sensor noise"
        return f"what noise alone causes ({in_noise(self.expected)} times the sensor noise)"

    @property
    def explained_text(self) -> str:
        """Share that is explained of each channel, in words; empty if nothing is explained."""
        listed = [f"{c} {percent_explained(share)}" for c, share in self.explained.items() if share > 0]
        return f"{', '.join(listed)} of the baseline's squared error is explained" if listed else ""

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "explained_percent": json_numbers(self.explained),
            "remaining_over_noise": json_numbers(self.remaining),
            "expected_over_noise": json_numbers(self.expected),
            "random_torque_nats_per_value": json_number(self.torque_nats),
            "grade": self.grade,
            "criterion": self.criterion,
        }


def assess(
    before: Mapping[str, float],
    after: Mapping[str, float],
    floor: Mapping[str, float],
    nats: float,
    seconds: float = 0.0,
    expected: Mapping[str, float] | None = None,
) -> Assessment:
    """The assessment of a final model by its errors.

    Args:
        before: Channel -> error of short free runs of the baseline.
        after: Channel -> error of short free runs of the final model.
        floor: Channel -> standard deviation of the sensor noise.
        nats: Log-likelihood per measured value that random torques gain over the final model [nat].
        seconds: Length of these runs [s]; 0 if it is not known.
        expected: Channel -> error of these runs by noise alone; the sensor noise if it is not known.

    >>> end = assess({"theta": 0.1}, {"theta": 0.002}, {"theta": 0.001}, 0.005)
    >>> round(end.explained["theta"], 2), end.remaining, end.is_explained, end.grade
    (99.96, {'theta': 2.0}, False, <Grade.NEAR: 'near'>)
    """
    # There is no share where runs of the baseline diverge or have no error.
    shares = {c: 100 * (1 - (after[c] / e) ** 2) if 0 < e < math.inf else math.nan for c, e in before.items()}
    remaining = {c: ratio(after[c], floor.get(c)) for c in after}
    by_noise = {c: ratio(e, floor.get(c)) for c, e in (expected or {}).items()}
    return Assessment(shares, remaining, nats, seconds, by_noise)


def in_noise(remaining: Mapping[str, float]) -> str:
    """Remaining errors in multiples of the noise, as they stand in a sentence.

    >>> in_noise({"theta": 1.168, "alpha": 228.6})
    'theta 1.17, alpha 229'
    """
    return ", ".join(f"{c} {multiple(times) or 'an unknown number of'}" for c, times in remaining.items())


class Presentation(NamedTuple):
    """How a verdict is shown.

    Attributes:
        headline: Title of a report.
        phrase: Phrase for recordings with this verdict, after their number: "3 ...".
        tone: Class of the style sheet: good, warn or bad.
        colour: Colour of its points in a figure.
        marker: Marker of its points, which distinguishes verdicts without colour.
        filled: Whether the marker is filled.
        advice: What to do next; a text with `{effect}` and `{rivals}` is repeated for each effect that the
            recordings cannot distinguish from others.
    """

    headline: str
    phrase: str
    tone: str
    colour: str
    marker: str
    filled: bool
    advice: tuple[str, ...]


class Verdict(StrEnum):
    """The end of a search in one word, which is also the value in JSON."""

    FOUND = (
        "found",
        Presentation(
            "Found: the model explains the recording",
            "explained by what was found",
            "good",
            FINAL,
            "o",
            True,
            (
                "Use the final model: in Python it is result.model, and its method "
                "simulate(recording) runs it on any recording of this machine.",
                "Check it on a recording with another input; an effect that is real keeps its parameters.",
            ),
        ),
    )
    NOTHING_MISSING = (
        "nothing_missing",
        Presentation(
            "Nothing is missing",
            "with nothing missing",
            "good",
            INK,
            "D",
            True,
            (
                "Keep the model: on these recordings no effect makes it better.",
                "Before trusting it elsewhere, record the speeds and voltages you will use and repeat.",
            ),
        ),
    )
    AMBIGUOUS = (
        "ambiguous",
        Presentation(
            "Found, but not distinguished from others",
            "explained, by effects that are not distinguished from others",
            "warn",
            FURTHER[0],
            "s",
            False,
            (
                "To distinguish {effect} from {rivals}, record once more with another kind of input (slow "
                "reversals, larger strokes, faster steps) and give both recordings.",
                "Until then the final model simulates well, whichever of them is the cause.",
            ),
        ),
    )
    UNEXPLAINED = (
        "unexplained",
        Presentation(
            "Something remains unexplained",
            "with something left unexplained",
            "bad",
            BASELINE,
            "^",
            True,
            (
                "Look at the missing torque below, and at the places where the model still fails: the shape "
                "over speed, position and voltage says what kind of effect to think of.",
                "Check the recording (sampling, scaling, sensor range) and the constants that are "
                "held, then try an effect of your own: the search tries a class of yours after @register.",
            ),
        ),
    )
    NOT_EXCITED = (
        "not_excited",
        Presentation(
            "The recording could not have shown it",
            "that could not have shown anything",
            "warn",
            MUTED,
            "x",
            True,
            (
                "Record again with more motion: both directions, many reversals, small and large "
                "voltages, the whole range of deflection.",
            ),
        ),
    )

    shown: Presentation

    def __new__(cls, value: str, shown: Presentation) -> "Verdict":
        """A string with this value and the way in which it is shown."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.shown = shown
        return member

    @property
    def label(self) -> str:
        """The verdict in words, such as "not excited"."""
        return self.value.replace("_", " ")

    def next_steps(self, ambiguous: Sequence[tuple[str, str]], hidden: int, candidates: int) -> list[str]:
        """What the user may do next, in sentences.

        Args:
            ambiguous: Effects that were found, each with the effects that cannot be distinguished from it.
            hidden: Number of candidates that the recordings do not excite.
            candidates: Number of candidates.
        """
        steps = []
        for text in self.shown.advice:
            pairs = ambiguous if "{effect}" in text else [("", "")]
            steps += [text.format(effect=effect, rivals=rivals) for effect, rivals in pairs]
        if hidden and self is not Verdict.NOT_EXCITED:
            steps.append(
                f"{hidden} of {candidates} candidates could not have shown here; "
                "a recording with more motion would decide on them, too."
            )
        return steps
