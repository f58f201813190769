"""Numbers, units and equations for print and for JSON, and safe forms of text from elsewhere."""

import math
import re
import unicodedata
from collections.abc import Mapping

from rotflex_jax.parameters import Estimate


def printable(text: str) -> str:
    r"""A text with control codes of a terminal replaced by escapes; line ends and tabs are kept.

    >>> print(printable("run\x1b[2J.csv"))
    run\x1b[2J.csv
    """
    return "".join(c if c in "\n\t" or not _steers(c) else ascii(c)[1:-1] for c in text)


def _steers(character: str) -> bool:
    """Whether a character is a control code, a change of the writing direction, or a lone surrogate."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")


def one_line(text: str) -> str:
    r"""A text as in `printable`, on one line: line ends are replaced by escapes too.

    >>> print(one_line("run\n.csv"))
    run\n.csv
    """
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def spreadsheet_cell(text: str) -> str:
    """A text that no spreadsheet reads as a formula: an apostrophe precedes a character that begins one.

    >>> spreadsheet_cell("=1+1"), spreadsheet_cell("run 7")
    ("'=1+1", 'run 7')
    """
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def together(text: str) -> str:
    r"""A text in which numbers stay on one line with their units, and powers are superscripts.

    >>> together("0.03 N m at 2 deg").split(" ")
    ['0.03\xa0N\xa0m', 'at', '2\xa0deg']
    """
    text = unit_text(text).replace("N m", "N\xa0m").replace("kg m", "kg\xa0m")
    return re.sub(r"(?<=\d) (?=(?:N|V|deg|rad|Hz|ms|s|kg|A|%)(?![a-zA-Z]))", "\xa0", text)


def equation(text: str) -> str:
    """An equation with typographic characters.

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
    """A unit with typographic characters.

    >>> unit_text("N m/rad^3")
    'N m/rad³'
    """
    return unit.replace("^2", "²").replace("^3", "³")


def plain_number(value: float | None, digits: int = 3) -> str:
    """A number with some significant digits and a typographic power of ten.

    >>> plain_number(0.0123456), plain_number(1.5e-6), plain_number(None)
    ('0.0123', '1.5 × 10⁻⁶', '–')
    >>> plain_number(136.2, 2), plain_number(-99.96, 2)
    ('136', '−100')
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{float(mantissa):g} × 10{raised}".replace("-", "−")
    text = f"{value:#.{digits}g}".rstrip(".")
    if abs(value) >= 1000 or "e" in text:  # an exponent: more digits before the point than significant ones
        text = f"{value:,.0f}".replace(",", "\u202f")
    return text.replace("-", "−")


def json_number(value: float) -> float | None:
    """A number that JSON can represent; None if it is infinite or NaN.

    >>> json_number(0.5), json_number(float("inf")), json_number(float("nan"))
    (0.5, None, None)
    """
    return float(value) if math.isfinite(value) else None


def json_numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    """The mapping with `json_number` applied to every value."""
    return {name: json_number(value) for name, value in values.items()}


def digits(value: float | None, count: int = 3, missing: str = "-") -> str:
    """A number with some significant digits in plain characters, for tables in a terminal.

    >>> digits(0.0123456), digits(7052.3, 4), digits(None)
    ('0.0123', '7052', '-')
    """
    return missing if value is None or not math.isfinite(value) else f"{value:.{count}g}"


def value_and_interval(estimate: Estimate) -> tuple[str, str]:
    """The value and its 95 % interval, with as many digits as the interval justifies.

    >>> nan = float("nan")
    >>> value_and_interval(Estimate("a", 0.0300069, 1e-5, (0.029987, 0.030027), "N m"))
    ('0.030007', '0.029987 … 0.030027')
    >>> value_and_interval(Estimate("a", 2.5e-6, 1e-8, (2.48e-6, 2.52e-6), "N m"))
    ('2.500 × 10⁻⁶', '(2.480 … 2.520) × 10⁻⁶')
    >>> value_and_interval(Estimate("a", 2.6, nan, (nan, nan), "ohm", free=False))
    ('2.6', '')
    """
    if estimate.decimals is None:
        return f"{estimate.value:.6g}".replace("-", "−"), ""
    digits, power = estimate.decimals
    value, low_text, high_text = (
        f"{x / 10.0**power:.{digits}f}".replace("-", "−") for x in (estimate.value, *estimate.ci95)
    )
    if not power:
        return value, f"{low_text} … {high_text}"
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value} × 10{raised}", f"({low_text} … {high_text}) × 10{raised}"


def ratio(value: float, floor: float | None) -> float:
    """Ratio of an error to the noise; NaN if no noise is known."""
    return value / floor if floor and floor > 0 else math.nan


def multiple(times: float) -> str:
    """The ratio of an error to the noise as text, for all sentences, tiles and tables.

    >>> multiple(1.168), multiple(23.456), multiple(228.6), multiple(39885.0)
    ('1.17', '23.46', '229', 'over 10,000')
    """
    if not math.isfinite(times):
        return ""
    return f"{times:.2f}" if times < 100 else f"{times:.0f}" if times < 10_000 else "over 10,000"


def percent_explained(percent: float) -> str:
    """A share in percent, with more digits near 100 %.

    >>> [percent_explained(p) for p in (83.21, 99.871, 99.99999, -3.0)]
    ['83.2 %', '99.87 %', '> 99.99 %', '0 %']
    """
    if percent > 99.99:
        return "> 99.99 %"
    return f"{percent:.2f} %" if percent > 99 else f"{percent:.1f} %" if percent > 0 else "0 %"


def percent_of_whole(fraction: float) -> str:
    """A fraction of a whole in percent, for a sentence.

    >>> [percent_of_whole(f) for f in (0.784, 0.0042, 0.998, 1.0)]
    ['78 %', '0.4 %', '99.8 %', 'all']
    """
    p = 100 * float(fraction)
    if p >= 99.5:
        return f"{p:.1f} %" if p < 99.95 else "all"
    return f"{p:.0f} %" if p >= 1 else f"{max(p, 0.1):.1f} %"


def percent_own(fraction: float) -> str:
    """A fraction in percent with two significant digits, for shares that differ by orders of magnitude.

    >>> [percent_own(f) for f in (0.997, 0.413, 0.0152, 0.00041)]
    ['100 %', '41 %', '1.5 %', '0.041 %']
    """
    return f"{100 * fraction:.0f} %" if fraction >= 0.1 else f"{100 * fraction:.2g} %"


def percent_left(fraction: float) -> str:
    """A remaining fraction in percent, which may be above 100 %.

    >>> [percent_left(f) for f in (0.0152, 0.608, 1.59)]
    ['1.5 %', '61 %', '159 %']
    """
    if not math.isfinite(fraction):
        return "–"
    return f"{100 * fraction:.1f} %" if fraction < 0.1 else f"{100 * fraction:.0f} %"


def percent_probable(probability: float) -> str:
    """A probability in percent, limited to 1 % and 99 %.

    >>> [percent_probable(p) for p in (0.9997, 0.934, 0.0312, 0.0004)]
    ['> 99 %', '93 %', '3 %', '< 1 %']
    """
    if probability < 0.01:
        return "< 1 %"
    return f"{100 * probability:.0f} %" if probability <= 0.99 else "> 99 %"


def as_read(value: float, unit: str) -> tuple[float, str]:
    """A value in the unit for display: degrees for angles, millimetres for lengths.

    >>> as_read(0.00085, "m"), as_read(0.5, "V")
    ((0.85, 'mm'), (0.5, 'V'))
    """
    if unit in ("rad", "rad/s"):
        return math.degrees(value), unit.replace("rad", "deg")
    return (1000 * value, f"m{unit}") if unit in ("m", "m/s") else (value, unit)


def readable(value: float, unit: str) -> tuple[float, str]:
    """A value in the unit for display, as in `as_read`, with the unit in typographic characters."""
    number, read = as_read(value, unit)
    return number, unit_text(read)
