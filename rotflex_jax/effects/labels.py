"""Effects as people read them: short labels, titles, and sentences that mention them."""

import re

from rotflex_jax.effects.base import CATALOG
from rotflex_jax.text.numbers import together


def effect_label(effect: str, port: str) -> str:
    """An effect and its port, short; a sensor error is one of its channel.

    >>> effect_label("cubic_spring", "joint"), effect_label("sensor_bias", "alpha")
    ('cubic spring at joint', 'sensor bias of alpha')
    """
    return f"{effect.replace('_', ' ')} {'of' if effect in _sensing() else 'at'} {port}"


def _sensing() -> list[str]:
    return [name for name, effect in CATALOG.items() if effect.acts_on == "channel"]


def effect_title(effect: str) -> str:
    """What an effect is, in words; its name where the catalogue lacks it."""
    known = CATALOG.get(effect)
    return known.title if known else effect.replace("_", " ")


def sentence(text: str) -> str:
    """A text as a sentence in print: capital letter, full stop, names and units kept together.

    >>> sentence("cubic_spring explains it")
    'Cubic spring explains it.'
    >>> sentence("sensor_bias at the alpha explains it")
    'Sensor bias of alpha explains it.'
    """
    text = text.strip()
    for name in CATALOG:
        text = re.sub(rf"\b{name}\b", name.replace("_", " "), text)
    for name in _sensing():
        text = text.replace(f"{name.replace('_', ' ')} at the ", f"{name.replace('_', ' ')} of ")
    if text and text[-1] not in ".!?":
        text += "."
    return together(text[:1].upper() + text[1:])
