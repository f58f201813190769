"""How good a final model is (what is explained, what remains in units of the noise), and the verdicts.

A new verdict is a member here, and a case of the rule in `conclusion.py`.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, MUTED
from rotflex_jax.text.numbers import json_number, json_numbers, multiple, percent_explained, ratio

# An error of at most this times the sensor noise counts as having reached it.
NEAR_FLOOR = 1.5
# Beyond this times the sensor noise much is left.
FAR_FLOOR = 5.0
# The model explains the recordings if process torques gain no more than this per measured value of the
# training recordings [nat], and short runs over validation recordings come as near to the sensor noise as
# `NEAR_FLOOR` says.
TORQUE_NATS = 0.03


class Grade(StrEnum):
    """How far an error is from the noise of its sensor."""

    NOISE = "noise"
    NEAR = "near"
    FAR = "far"


def grade(times: float) -> Grade | None:
    """The grade of an error; None where no noise is known.

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
    """What the verdict rests on.

    Attributes:
        explained: Channel -> share of the baseline's squared error that the final model explains [%]; not a
            number where runs of the baseline diverge or have no error.
        remaining: Channel -> error of short runs that is left, in multiples of the sensor noise.
        torque_nats: What random torques still gain per measured value of the training recordings [nat]; 0
            where the model is right.
    """

    explained: dict[str, float]
    remaining: dict[str, float]
    torque_nats: float

    @property
    def at_noise(self) -> bool:
        """Whether the errors of all channels have reached the noise."""
        return all(times < NEAR_FLOOR for times in self.remaining.values())

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
        """Squared errors of short runs, or what random torques gain, over what the verdict allows of them.

        The largest of these; 1 where the model explains the recordings.
        """
        shares = [(times / NEAR_FLOOR) ** 2 for times in self.remaining.values()]
        shares.append(self.torque_nats / TORQUE_NATS)
        return math.inf if any(map(math.isnan, shares)) else max(1.0, *shares)

    @property
    def grade(self) -> Grade | None:
        """That of the channel that is furthest from its noise."""
        known = [times for times in self.remaining.values() if not math.isnan(times)]
        return grade(max(known)) if known else None

    @property
    def criterion(self) -> str:
        """Which criterion decided, as a clause."""
        unknown = [c for c, times in self.remaining.items() if math.isnan(times)]
        if not self.at_noise:
            if all(times < NEAR_FLOOR for c, times in self.remaining.items() if c not in unknown):
                return (
                    f"the sensor noise of {' and '.join(unknown)} is not known, to compare what is left with"
                )
            worst = max(set(self.remaining) - set(unknown), key=lambda c: self.remaining[c])
            return f"the error of {worst} in short runs is above {NEAR_FLOOR:g} times the sensor noise"
        if not self.torque_free:
            return (
                f"short runs are at the noise, but predictions still ask for a random torque "
                f"({self.torque_nats:.2g} nat per measured value, at most {TORQUE_NATS:g})"
            )
        return (
            f"short runs are within {NEAR_FLOOR:g} times the sensor noise, and predictions ask for "
            "no random torque"
        )

    @property
    def explained_text(self) -> str:
        """What is explained of each channel, in words; empty where nothing is."""
        listed = [f"{c} {percent_explained(share)}" for c, share in self.explained.items() if share > 0]
        return f"{', '.join(listed)} of the baseline's squared error is explained" if listed else ""

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "explained_percent": json_numbers(self.explained),
            "remaining_over_noise": json_numbers(self.remaining),
            "random_torque_nats_per_value": json_number(self.torque_nats),
            "grade": self.grade,
            "criterion": self.criterion,
        }


def assess(
    before: Mapping[str, float],
    after: Mapping[str, float],
    floor: Mapping[str, float],
    nats: float,
) -> Assessment:
    """The end of a search by its errors.

    Args:
        before: Channel -> error of short runs of the baseline.
        after: The same of the final model.
        floor: Channel -> standard deviation of the sensor noise.
        nats: Log-likelihood per measured value that random torques gain over the final model [nat].

    >>> end = assess({"theta": 0.1}, {"theta": 0.002}, {"theta": 0.001}, 0.005)
    >>> round(end.explained["theta"], 2), end.remaining, end.is_explained, end.grade
    (99.96, {'theta': 2.0}, False, <Grade.NEAR: 'near'>)
    """
    # There is no share where runs of the baseline diverge or have no error.
    shares = {c: 100 * (1 - (after[c] / e) ** 2) if 0 < e < math.inf else math.nan for c, e in before.items()}
    remaining = {c: ratio(after[c], floor.get(c)) for c in after}
    return Assessment(shares, remaining, nats)


def in_noise(remaining: Mapping[str, float]) -> str:
    """What remains, as it stands in a sentence.

    >>> in_noise({"theta": 1.168, "alpha": 228.6})
    'theta 1.17, alpha 229'
    """
    return ", ".join(f"{c} {multiple(times) or 'an unknown number of'}" for c, times in remaining.items())


class Presentation(NamedTuple):
    """How a verdict is shown.

    Attributes:
        headline: Title of a report.
        phrase: What holds for a recording with this verdict, after a count: "3 ...".
        tone: Class of the style sheet: good, warn or bad.
        colour: Of its points in a figure.
        marker: Of its points; distinguishes verdicts without colour.
        filled: Whether the marker is filled.
        advice: What to do next; a text with `{effect}` and `{rivals}` is given for each effect that the
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
    """What a search ended with; the values are those of the JSON."""

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
                "held, then try an effect of your own: one small class joins the search.",
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
        """A string of this value that knows how it is shown."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.shown = shown
        return member

    @property
    def label(self) -> str:
        """The verdict in words, such as "not excited"."""
        return self.value.replace("_", " ")

    def next_steps(self, ambiguous: Sequence[tuple[str, str]], hidden: int, candidates: int) -> list[str]:
        """What to do now, in plain words.

        Args:
            ambiguous: Effects that were found, each with those that cannot be distinguished from it.
            hidden: How many candidates the recordings do not excite.
            candidates: How many there were.
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
