"""The equations of motion with their numbers, as text and as LaTeX: for a paper, a README, a colleague."""

from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.effects.kinds import Actuation, Effect, Linear, Sensing
from rotflex_jax.export.law import law
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.parameters import specifications

_DIGITS = 4


def text(model: Model) -> str:
    """The equations of motion in plain text.

        M q'' + D q' + K q = b v + sum over ports of p tau

    with the matrices assembled from all linear effects, then the law of every other effect at its port,
    and the numbers of all parameters with their units.
    """
    mechanism = _whole(model)
    lines = [f"q = ({', '.join(mechanism.coordinates)})", "M q'' + D q' + K q = b v + sum of p tau", ""]
    for name, matrix in _matrices(mechanism).items():
        rows = [" ".join(f"{_plain(c):>11}" for c in np.atleast_1d(row)) for row in matrix]
        lines += [
            f"{name if not k else '':>2} {'=' if not k else ' '} [{row} ]" for k, row in enumerate(rows)
        ]
    lines += ["", *(f"port {p}: p = ({', '.join(_plain(c) for c in v)})" for p, v in mechanism.ports)]
    lines += [f"output {name}: {what} of {port}" for name, (port, what) in mechanism.outputs]
    for effect in _with_laws(mechanism):
        lines += ["", f"{effect.title} {_at(effect)}: {effect.equation}"]
        lines += [f"    {n} = {_plain(v)} {unit}".rstrip() for n, v, unit, _ in _numbers(mechanism, effect)]
    lines += ["", "Entered in the matrices:"]
    for effect in mechanism.effects:
        if isinstance(effect, Linear) and not effect.order:
            found = _numbers(mechanism, effect)
            lines += [f"    {effect.at}.{effect.name}.{n} = {_plain(v)} {u}".rstrip() for n, v, u, _ in found]
    return "\n".join(lines) + "\n"


def latex(model: Model) -> str:
    r"""The equations of motion in LaTeX: a display, one line per law, and a table of symbols.

    The text needs the package amsmath and goes into a document as it is.
    """
    mechanism = _whole(model)
    lines = [r"\[", r"M \ddot{q} + D \dot{q} + K q = b \, v + \sum_{p} p \, \tau_{p}, \qquad"]
    lines += [rf"q = {_matrix([[_upright(c)] for c in mechanism.coordinates], str)}", r"\]", r"\["]
    found = _matrices(mechanism)
    lines.append(
        ", \\quad\n".join(
            f"{name} = {_matrix(np.atleast_2d(m.T).T, _scientific)}" for name, m in found.items()
        )
    )
    lines += [r"\]", ""]
    for effect in _with_laws(mechanism):
        lines += [rf"% {effect.title} {_at(effect)}", rf"\[ {law(effect)} \quad \text{{({_at(effect)})}} \]"]
    lines += ["", r"\begin{tabular}{llll}", r"place & parameter & value & meaning \\ \hline"]
    for effect in mechanism.effects:
        for name, value, unit, meaning in _numbers(mechanism, effect):
            number = f"${_scientific(value)}$ {_unit(unit)}".strip()
            cells = (_words(effect.at), f"{_words(effect.name)}, {_words(name)}", number, _words(meaning))
            lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _whole(model: Model) -> Mechanism:
    """The mechanism without what is switched off."""
    mechanism = model.mechanism
    for effect, gate in zip(mechanism.effects, model.gates or (), strict=False):
        mechanism = mechanism if gate else mechanism.without(effect.name, effect.at)
    return mechanism


def _matrices(mechanism: Mechanism) -> dict[str, np.ndarray]:
    n = len(mechanism.coordinates)
    M, D, K, b = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
    for effect in mechanism.effects:
        if isinstance(effect, Linear):
            p, stamp = np.array(mechanism.port_vectors[effect.at]), effect.stamp()
            M += float(stamp.inertia) * np.outer(p, p)
            D += float(stamp.damping) * np.outer(p, p)
            K += float(stamp.stiffness) * np.outer(p, p)
            b += float(stamp.drive) * p
    return {"M": M, "D": D, "K": K, "b": b}


def _with_laws(mechanism: Mechanism) -> Iterator[Effect]:
    """Effects that the matrices do not hold: the voltage's first, the sensors' last."""
    order = lambda e: 0 if isinstance(e, Actuation) else 2 if isinstance(e, Sensing) else 1  # noqa: E731
    stage = lambda e: (order(e), getattr(e, "stage", 0))  # noqa: E731
    for effect in sorted(mechanism.effects, key=stage):
        if not isinstance(effect, Linear) or effect.order:
            yield effect


def _numbers(mechanism: Mechanism, effect: Effect) -> Iterator[tuple[str, float, str, str]]:
    """Name, value, unit and meaning of the parameters of an effect."""
    for (name, value), spec in zip(effect.values.items(), specifications(effect).values(), strict=True):
        yield name, float(value), mechanism.units.unit(spec.unit), spec.meaning


def _at(effect: Effect) -> str:
    if isinstance(effect, Actuation):
        return "on the voltage"
    return f"at the sensor {effect.at}" if isinstance(effect, Sensing) else f"at {effect.at}"


def _plain(value: float) -> str:
    return f"{float(value):.{_DIGITS + 1}g}"


def _scientific(value: float) -> str:
    r"""A number as people print it.

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
    return rf"\mathrm{{{name.replace('_', chr(92) + '_')}}}"


def _words(name: str) -> str:
    for sign in "&%$#_":
        name = name.replace(sign, "\\" + sign)
    return name


def _unit(unit: str) -> str:
    """`N m s^2/rad` in upright letters."""
    body = unit.replace("^", "^@").replace(" ", r"\,")
    for digit in "0123456789":
        body = body.replace(f"^@{digit}", f"^{{{digit}}}")
    return rf"$\mathrm{{{body}}}$" if unit else ""
