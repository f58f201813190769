"""The equations of motion with their parameters, as text and as LaTeX."""

import re
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from rotflex_jax.effects.base import Effect, Linear
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import effects_of, second_order_matrices
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import specifications
from rotflex_jax.text.numbers import one_line

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


def equation(effect: Effect | type[Effect]) -> str:
    r"""The equation of an effect in LaTeX, without dollar signs.

    Position and speed of the effect's port are written as phi and its rate, and the true value at a sensor as
    y_0. Parameters keep their names, in italics.

    >>> from rotflex_jax.effects import CubicSpring
    >>> print(equation(CubicSpring))
    \tau = -\mathit{stiffness} \cdot \varphi^{3}
    """
    return to_latex(effect.equation, specifications(effect))


def to_latex(equation: str, parameters: Iterable[str]) -> str:
    """LaTeX of an equation in plain text, in which `parameters` are names."""
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
    """LaTeX of a name in an equation, or None for an ordinary word."""
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


_DIGITS = 4


def text(model: Mechanism | Model) -> str:
    """The equations of motion in plain text.

        M q'' + D q' + K q = b v + sum over ports of p tau

    The matrices are assembled from all linear effects. The equation of every other effect follows with its
    port, then the values of all parameters with their units.
    """
    mechanism = _active(Model.of(model))
    lines = [f"q = ({', '.join(mechanism.coordinates)})", "M q'' + D q' + K q = b v + sum of p tau", ""]
    for name, matrix in _matrices(mechanism).items():
        rows = [" ".join(f"{_plain(c):>11}" for c in np.atleast_1d(row)) for row in matrix]
        lines += [
            f"{name if not k else '':>2} {'=' if not k else ' '} [{row} ]" for k, row in enumerate(rows)
        ]
    lines += ["", *(f"port {p}: p = ({', '.join(_plain(c) for c in v)})" for p, v in mechanism.ports)]
    lines += [f"output {name}: {what} of {port}" for name, (port, what) in mechanism.outputs]
    for effect in _with_equations(mechanism):
        lines += ["", f"{effect.title} {effect.location}: {effect.equation}"]
        lines += [
            f"    {n} = {_plain(v)} {unit}".rstrip() for n, v, unit, _ in _parameters(mechanism, effect)
        ]
    lines += ["", "Entered in the matrices:"]
    for effect in mechanism.effects:
        if effect.is_linear and not effect.order:
            found = _parameters(mechanism, effect)
            lines += [f"    {effect.full_name(n)} = {_plain(v)} {u}".rstrip() for n, v, u, _ in found]
    return "\n".join(map(one_line, lines)) + "\n"


def latex(model: Mechanism | Model) -> str:
    r"""The equations of motion in LaTeX: the matrices, one line per effect, and a table of parameters.

    The text needs the package amsmath. A document can include it unchanged.
    """
    mechanism = _active(Model.of(model))
    lines = [r"\[", r"M \ddot{q} + D \dot{q} + K q = b \, v + \sum_{p} p \, \tau_{p}, \qquad"]
    lines += [rf"q = {_matrix([[_upright(c)] for c in mechanism.coordinates], str)}", r"\]", r"\["]
    found = _matrices(mechanism)
    lines.append(
        ", \\quad\n".join(
            f"{name} = {_matrix(np.atleast_2d(m.T).T, _scientific)}" for name, m in found.items()
        )
    )
    lines += [r"\]", ""]
    for effect in _with_equations(mechanism):
        place = effect.location
        lines += [
            rf"% {one_line(f'{effect.title} {place}')}",
            rf"\[ {equation(effect)} \quad \text{{({_words(place)})}} \]",
        ]
    lines += ["", r"\begin{tabular}{llll}", r"place & parameter & value & meaning \\ \hline"]
    for effect in mechanism.effects:
        for name, value, unit, meaning in _parameters(mechanism, effect):
            number = f"${_scientific(value)}$ {_unit(unit)}".strip()
            cells = (_words(effect.at), f"{_words(effect.name)}, {_words(name)}", number, _words(meaning))
            lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _active(model: Model) -> Mechanism:
    """The mechanism without effects that are switched off."""
    mechanism = model.mechanism
    for effect, gate in zip(mechanism.effects, model.gates or (), strict=False):
        mechanism = mechanism if gate else mechanism.without(effect.name, effect.at)
    return mechanism


def _matrices(mechanism: Mechanism) -> dict[str, np.ndarray]:
    linear = [e for _, e in effects_of(mechanism, Linear)]
    found = second_order_matrices(
        [(e.stamp(), mechanism.port_vectors[e.at]) for e in linear], len(mechanism.coordinates)
    )
    return {name: np.array(part, float) for name, part in zip("MDKb", found, strict=True)}


def _with_equations(mechanism: Mechanism) -> Iterator[Effect]:
    """Effects that are not in the matrices, in the order of the signal flow: voltage, ports, sensors."""
    path = ("input", "signal", "port", "channel")
    stage = lambda e: (path.index(e.acts_on), getattr(e, "stage", 0))  # noqa: E731
    for effect in sorted(mechanism.effects, key=stage):
        if not effect.is_linear or effect.order or not effect.exact_step:
            yield effect


def _parameters(mechanism: Mechanism, effect: Effect) -> Iterator[tuple[str, float, str, str]]:
    """Name, value, unit and meaning of the parameters of an effect."""
    for (name, value), spec in zip(effect.values.items(), specifications(effect).values(), strict=True):
        yield name, float(value), mechanism.unit_of(effect, spec.unit), spec.meaning


def _plain(value: float) -> str:
    return f"{float(value):.{_DIGITS + 1}g}"


def _scientific(value: float) -> str:
    r"""A number in scientific notation where it is small.

    >>> print(_scientific(0.00123456), _scientific(2.0))
    1.235 \times 10^{-3} 2
    """
    mantissa, _, exponent = f"{float(value):.{_DIGITS}g}".partition("e")
    if not exponent and value and abs(value) < 0.01:
        mantissa, _, exponent = f"{float(value):.{_DIGITS - 1}e}".partition("e")
        mantissa = mantissa.rstrip("0").rstrip(".")
    return mantissa if not exponent else rf"{mantissa} \times 10^{{{int(exponent)}}}"


def _matrix(rows: object, number: Callable[..., str]) -> str:
    lines = [" & ".join(number(c) for c in row) for row in np.asarray(rows)]
    return r"\begin{bmatrix} " + r" \\ ".join(lines) + r" \end{bmatrix}"


def _upright(name: str) -> str:
    return rf"\mathrm{{{_words(name)}}}"


_SPECIAL = {c: "\\" + c for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
}


def _words(name: str) -> str:
    r"""A text with the special characters of LaTeX escaped; names may come from a file.

    >>> print(_words("100 %} \\input{x}"))
    100 \%\} \textbackslash{}input\{x\}
    """
    return "".join(_SPECIAL.get(c, c) for c in one_line(name))


def _unit(unit: str) -> str:
    """LaTeX of a unit such as `N m s^2/rad`, in upright letters."""
    pieces = re.split(r"(\^\d| )", unit)
    body = "".join(
        r"\," if p == " " else f"^{{{p[1]}}}" if re.fullmatch(r"\^\d", p) else _words(p) for p in pieces
    )
    return rf"$\mathrm{{{body}}}$" if unit else ""
