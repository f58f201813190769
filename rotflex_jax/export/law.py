"""The `equation` of an effect, a line of plain text, as LaTeX. There is no second list of equations."""

import re
from collections.abc import Iterable

from rotflex_jax.effects.kinds import Effect
from rotflex_jax.parameters import specifications

_FUNCTIONS = {"sin", "cos", "tan", "exp", "log", "tanh", "min", "max", "sinh", "cosh", "arctan"}
_SYMBOLS = {
    "tau": r"\tau",
    "speed": r"\dot{\varphi}",
    "position": r"\varphi",
    "voltage": "v",
    "value": "y_0",
    "pi": r"\pi",
    "sign": r"\operatorname{sign}",
    "sqrt": r"\operatorname{sqrt}",
    "abs": r"\operatorname{abs}",
    "limit": r"\mathit{limit}",
}
_MARKS = {"*": r"\cdot", "->": r"\mapsto", "<=": r"\leq", ">=": r"\geq", "**": "^", "%": r"\%"}
_TOKEN = re.compile(
    r"(?P<rate>\bd(?P<of>[a-zA-Z])/dt\b)"
    r"|(?P<prime>\b[a-zA-Z]'{1,2})"
    r"|(?P<power>(?:\*\*|\^)\s*(?P<exponent>-?\d+(?:\.\d+)?|[A-Za-z_]\w*))"
    r"|(?P<number>\d+(?:\.\d+)?(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[^\W\d]\w*)"
    r"|(?P<mark>->|<=|>=|\*\*|\S)"
)


def law(effect: Effect | type[Effect]) -> str:
    r"""The equation of an effect in LaTeX, without dollar signs.

    Position and speed of the effect's port are written as phi and its rate, the true value at a sensor
    as y_0; parameters keep their names, in italics.

    >>> from rotflex_jax.effects import CubicSpring
    >>> print(law(CubicSpring))
    \tau = -\mathit{stiffness} \cdot \varphi^{3}
    """
    return to_latex(effect.equation, specifications(effect))


def to_latex(equation: str, parameters: Iterable[str]) -> str:
    """LaTeX of a line of plain text whose `parameters` are names."""
    names = set(parameters)
    out: list[tuple[str, str]] = []
    for match in _TOKEN.finditer(equation):
        kind, word = str(match.lastgroup), match.group()
        if match["rate"]:
            out.append(("math", rf"\dot{{{match['of']}}}"))
        elif match["prime"]:
            out.append(
                ("math", (r"\ddot" if word.endswith("''") else r"\dot") + f"{{{word.rstrip(chr(39))}}}")
            )
        elif match["power"]:
            exponent = match["exponent"]
            out.append(("power", f"^{{{_name(exponent, names) or exponent}}}"))
        elif match["number"]:
            out.append(("math", word))
        elif match["name"]:
            found = _name(word, names)
            out.append(("math", found) if found else ("text", word))
        else:
            out.append((kind, _MARKS.get(word, word)))
    return _joined(out)


def _name(word: str, parameters: set[str]) -> str | None:
    """A name in mathematics, or None for a word."""
    if word in parameters:
        return rf"\mathit{{{word.replace('_', chr(92) + ' ')}}}"
    if word in _FUNCTIONS:
        return rf"\{word}"
    if word in _SYMBOLS:
        return _SYMBOLS[word]
    return word if len(word) == 1 else None


def _joined(pieces: list[tuple[str, str]]) -> str:
    line, words, opens = "", [], False
    for kind, piece in [*pieces, ("end", "")]:
        if kind == "text":
            words.append(piece)
            continue
        if words:
            line += rf" \text{{ {' '.join(words)} }} "
            words = []
        if kind == "power":
            line = line.rstrip() + piece + " "
        elif piece == "(" or (piece == "|" and (opens := not opens)):
            line += piece
        elif piece == "," and line.count("(") == line.count(")"):
            line = line.rstrip() + r", \quad "  # from one equation to the next
        elif piece in (")", ",", "|"):
            line = line.rstrip() + piece + " "
        elif piece == "-" and (not line.strip() or line.rstrip()[-1] in "=(,"):
            line += "-"  # a sign, not a difference
        else:
            line += piece + " "
    return re.sub(r" +", " ", line).strip()
