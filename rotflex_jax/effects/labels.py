"""Names of effects for people: nouns with the place of action, and sentences that mention effects."""

import re

from rotflex_jax.effects.base import CATALOG, port_and_signal
from rotflex_jax.recording.samples import name_and_unit
from rotflex_jax.text.numbers import together


def effect_label(effect: str, port: str) -> str:
    """Short label of an effect with its port or channel; an effect on the input is named without a place.

    >>> effect_label("cubic_spring", "joint"), effect_label("sensor_bias", "alpha")
    ('cubic spring at joint', 'sensor bias of alpha')
    >>> effect_label("delay", "input"), effect_label("measured_disturbance", "arm: wind [N]")
    ('input delay', 'wind at arm')
    """
    return _placed(effect, port, "")


def effect_phrase(effect: str, port: str) -> str:
    """Name of an effect with its port or channel, for use within a sentence.

    >>> effect_phrase("coulomb", "hub"), effect_phrase("sensor_bias", "alpha")
    ('Coulomb friction at the hub', 'sensor bias of alpha')
    """
    return _placed(effect, port, "the ")


def law_phrase(effect: str, port: str) -> str:
    """The phenomenon of which an effect is a law, with its port, for use within a sentence.

    The text is empty if no other law describes the phenomenon.

    >>> law_phrase("stribeck", "hub"), law_phrase("lag", "input"), law_phrase("saturation", "input")
    ('dry friction at the hub', 'late input', '')
    """
    thing = law_of(effect)
    return _placed(effect, port, "the ", thing) if thing else ""


def law_of(effect: str) -> str:
    """Phenomenon that an effect and other laws describe, such as dry friction; empty if no other law does."""
    known = CATALOG.get(effect)
    return known.law_of if known else ""


def _placed(effect: str, port: str, article: str, noun: str = "") -> str:
    known, noun = CATALOG.get(effect), noun or effect_title(effect)
    if known is not None and known.acts_on == "input" and port == "input":
        return noun
    if known is not None and known.acts_on == "channel":
        return f"{noun} of {port}"
    if known is not None and known.acts_on == "signal":
        port, signal = port_and_signal(port)
        noun = name_and_unit(signal)[0] or noun
    return f"{noun} at {article}{port}"


def effect_title(effect: str) -> str:
    """Noun for an effect; its name with spaces if the catalogue lacks it."""
    known = CATALOG.get(effect)
    return known.title if known else effect.replace("_", " ")


# What may precede the name of an effect in a list. After any other word, "spring" or "delay" is an
# ordinary word.
_BEFORE_A_NAME = re.compile(
    r"(?:^\s*|[^\w\s]\s*|\b(?:and|or|from|fitting|refitting|scoring|without|instead of)\s)$"
)


def with_titles(text: str) -> str:
    """A text in which nouns replace the names of effects that scripts use.

    >>> with_titles("+ coulomb at hub"), with_titles("lugre at the hub and delay at the input")
    ('+ Coulomb friction at hub', 'LuGre friction at the hub and input delay')
    >>> with_titles("cubic spring at the joint"), with_titles("the spring at the joint hardens")
    ('cubic spring at the joint', 'the spring at the joint hardens')
    >>> with_titles("  lugre at hub instead of coulomb at hub")
    '  LuGre friction at hub instead of Coulomb friction at hub'
    """

    def noun(found: re.Match[str]) -> str:
        listed = "_" in found[1] or _BEFORE_A_NAME.search(text[: found.start()])
        return _placed(found[1], found[3], found[2] or "") if listed else found[0]

    names = "|".join(sorted(map(re.escape, CATALOG), key=len, reverse=True))
    return re.sub(rf"\b({names}) at (the )?(\w+)", noun, text)


def sentence(text: str) -> str:
    """A text as a printed sentence: capital letter, full stop, titles of effects, units next to numbers.

    >>> sentence("cubic_spring explains it")
    'Cubic spring explains it.'
    >>> sentence("sensor_bias at the alpha explains it")
    'Sensor bias of alpha explains it.'
    """
    text = with_titles(text.strip())
    for name in CATALOG:
        if "_" in name:
            text = re.sub(rf"\b{name}\b", effect_title(name), text)
    if text and text[-1] not in ".!?":
        text += "."
    return together(text[:1].upper() + text[1:])
