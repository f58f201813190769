"""The end states of a search. A new one is a member here, and a case of the rule in `end_state.py`."""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

from rotflex_jax.text.colours import BASELINE, FINAL, FURTHER, INK, MUTED


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
