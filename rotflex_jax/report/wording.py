"""How numbers, names and verdicts are put into words."""

import math
import re
from collections.abc import Collection

from rotflex_jax.discover.looks import as_read
from rotflex_jax.discover.result import Discovery, Ranked
from rotflex_jax.effects import CATALOG, Sensing
from rotflex_jax.parameters import Estimate

HEADLINES = {
    "found": "Found: the model explains the recording",
    "nothing_missing": "Nothing is missing",
    "ambiguous": "Found, but not told apart",
    "unexplained": "Something remains unexplained",
    "not_excited": "The recording could not have shown it",
}

# At most this times the sensor noise counts as having reached it.
AT_NOISE = 1.5


def effect_label(effect: str, port: str) -> str:
    """An effect and its place, short; a sensor error is one of its channel.

    >>> effect_label("cubic_spring", "joint"), effect_label("sensor_bias", "alpha")
    ('cubic spring at joint', 'sensor bias of alpha')
    """
    return f"{effect.replace('_', ' ')} {'of' if effect in _sensing() else 'at'} {port}"


def _sensing() -> list[str]:
    return [name for name, effect in CATALOG.items() if issubclass(effect, Sensing)]


def effect_title(effect: str) -> str:
    """What an effect is, in words; its name where the catalogue lacks it."""
    known = CATALOG.get(effect)
    return known.title if known else effect.replace("_", " ")


def sentence(text: str) -> str:
    """A text as a sentence in print: capital letter, full stop, names and units not torn apart.

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


def together(text: str) -> str:
    r"""A text whose numbers stay on a line with their units, powers as in print.

    >>> together("0.03 N m at 2 deg").split(" ")
    ['0.03\xa0N\xa0m', 'at', '2\xa0deg']
    """
    text = unit_text(text).replace("N m", "N\xa0m").replace("kg m", "kg\xa0m")
    return re.sub(r"(?<=\d) (?=(?:N|V|deg|rad|Hz|ms|s|kg|A|%)(?![a-zA-Z]))", "\xa0", text)


def equation(text: str) -> str:
    """An equation with the signs of print.

    >>> equation("tau = -stiffness * position^3, holds while |tau| <= level")
    'τ = −stiffness · position³, holds while |τ| ≤ level'
    """
    for plain, printed in (
        ("->", "→"),
        ("<=", "≤"),
        (">=", "≥"),
        (" * ", " · "),
        ("^2", "²"),
        ("^3", "³"),
    ):
        text = text.replace(plain, printed)
    text = re.sub(r"\btau\b", "τ", text)
    return text.replace("-", "−")


def unit_text(unit: str) -> str:
    """A unit with the signs of print.

    >>> unit_text("N m/rad^3")
    'N m/rad³'
    """
    return unit.replace("^2", "²").replace("^3", "³")


def plain_number(value: float | None, digits: int = 3) -> str:
    """A number of some significant digits, powers of ten as in print.

    >>> plain_number(0.0123456), plain_number(1.5e-6), plain_number(None)
    ('0.0123', '1.5 × 10⁻⁶', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{float(mantissa):g} × 10{raised}".replace("-", "−")
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", "\u202f").replace("-", "−")
    return f"{value:#.{digits}g}".rstrip(".").replace("-", "−")


def value_and_interval(estimate: Estimate) -> tuple[str, str]:
    """The value and its 95 % interval, with as many digits as the interval is worth.

    >>> nan = float("nan")
    >>> value_and_interval(Estimate("a", 0.0300069, 1e-5, (0.029987, 0.030027), "N m"))
    ('0.030007', '0.029987 … 0.030027')
    >>> value_and_interval(Estimate("a", 2.6, nan, (nan, nan), "ohm", free=False))
    ('2.6', '')
    """
    low, high = estimate.ci95
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        return f"{estimate.value:.6g}".replace("-", "−"), ""
    largest = max(abs(low), abs(high), abs(estimate.value))
    half = (high - low) / 2
    power = 0 if 1e-4 <= largest < 1e5 else math.floor(math.log10(largest))
    scale = 10.0**power
    digits = min(12, max(0, 1 - math.floor(math.log10(half / scale))))
    value, low_text, high_text = (
        f"{x / scale:.{digits}f}".replace("-", "−") for x in (estimate.value, low, high)
    )
    if not power:
        return value, f"{low_text} … {high_text}"
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value} × 10{raised}", f"({low_text} … {high_text}) × 10{raised}"


def units(discovery: Discovery) -> dict[str, str]:
    """Channel of the model -> its unit."""
    first = discovery.test[0]
    return {c: first.units[first.channels.index(c)] for c in discovery.baseline.held_out_rmse_windows}


def readable(value: float, unit: str) -> tuple[float, str]:
    """A value and its unit as people read them: degrees for angles."""
    number, read = as_read(value, unit)
    return number, unit_text(read)


def ratio(value: float, floor: float | None) -> float:
    """How many times the noise an error is; nan where no noise is known."""
    return value / floor if floor and floor > 0 else math.nan


def noise_ratios(discovery: Discovery) -> dict[str, float]:
    """Held-out error over windows of the final model, in multiples of the noise, by channel."""
    errors = discovery.final.held_out_rmse_windows
    return {c: ratio(v, discovery.noise_floor.get(c)) for c, v in errors.items()}


def next_steps(discovery: Discovery) -> list[str]:
    """What to do now, in plain words, by verdict."""
    hidden = [r for r in discovery.ranking if not r.excited]
    steps: list[str] = []
    if discovery.verdict == "found":
        steps.append(
            "Use the final model: in Python it is result.model, and its method "
            "simulate(recording) runs it on any recording of this machine."
        )
        steps.append("Check it on a recording with another input; an effect that is real keeps its numbers.")
    elif discovery.verdict == "nothing_missing":
        steps.append("Keep the model: on these recordings no effect makes it better.")
        steps.append("Before trusting it elsewhere, record the speeds and voltages you will use and repeat.")
    elif discovery.verdict == "ambiguous":
        for turn in discovery.rounds:
            if turn.equivalent:
                rivals = " or ".join(effect_label(*pair) for pair in turn.equivalent)
                steps.append(
                    f"To tell {effect_label(turn.effect, turn.port)} from {rivals}, record once "
                    "more with another kind of input (slow reversals, larger strokes, faster "
                    "steps) and give both recordings."
                )
        steps.append("Until then the final model simulates well, whichever of them is the cause.")
    elif discovery.verdict == "unexplained":
        steps.append(
            "Look at the missing torque below, and at the places where the model still fails: the shape "
            "over speed, position and voltage says what kind of effect to think of."
        )
        steps.append(
            "Check the recording (sampling, scaling, sensor range) and the constants that are "
            "held, then try an effect of your own: one small class joins the search."
        )
    elif discovery.verdict == "not_excited":
        steps.append(
            "Record again with more motion: both directions, many reversals, small and large "
            "voltages, the whole range of deflection."
        )
    if hidden and discovery.verdict != "not_excited":
        steps.append(
            f"{len(hidden)} of {len(discovery.ranking)} candidates could not have shown here; "
            "a recording with more motion would decide on them, too."
        )
    return steps


def standing(r: Ranked, found: Collection[tuple[str, str]], alike: Collection[tuple[str, str]]) -> str:
    """How a candidate stands at the end of the search, given the pairs found and those like them."""
    pair = (r.effect, r.port)
    if pair in found:
        return "found"
    if pair in alike:
        return "cannot be told from what was found"
    return "not added" if r.excited else "not excited"
