"""Small drawings as SVG text: signals over time, bars, and held-out errors of successive models."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import Real

from rotflex_jax.text.colours import AXIS, BASELINE, FINAL, MUTED

_LEFT, _POINTS = 86, 600


class Panel(NamedTuple):
    """Lines over one axis.

    Attributes:
        label: Label of the vertical axis, with its unit.
        lines: Values, colour and SVG dash pattern of each line; as many values as the horizontal axis has.
    """

    label: str
    lines: Sequence[tuple[Real[np.ndarray, "_"], str, str]]


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" font-family="sans-serif" font-size="11" fill="{MUTED}">'
        + "".join(parts)
        + "</svg>"
    )


def _text(x: float, y: float, text: str, anchor: str = "start", more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{escape(text)}</text>'


def _path(x: np.ndarray, y: np.ndarray, colour: str, dash: str = "", width: float = 1.2) -> str:
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width:g}"{dashed}/>'


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line with fewer points: the smallest and the largest value of each group of neighbours."""
    group = -(-len(y) // (_POINTS // 2))
    if group < 3:
        return x, y
    rows = y[: len(y) // group * group].reshape(-1, group)
    first = group * np.arange(len(rows))
    pick = np.sort(np.stack([rows.argmin(1), rows.argmax(1)], 1), axis=1) + first[:, None]
    return x[pick.ravel()], y[pick.ravel()]


def signals(
    x: Real[np.ndarray, " N"], panels: Sequence[Panel], label: str, width: float = 560, height: float = 58
) -> str:
    """Panels one below the other with a common horizontal axis.

    Args:
        x: Values of the horizontal axis (N,).
        panels: Panels from top to bottom.
        label: Label of the horizontal axis, with its unit.
        width: Width of the drawing [px].
        height: Height of each panel [px].
    """
    parts, low, high = [], float(x[0]), float(x[-1])
    across = lambda v: _LEFT + (width - _LEFT - 8) * (np.asarray(v) - low) / ((high - low) or 1.0)  # noqa: E731
    for k, panel in enumerate(panels):
        top, bottom = k * (height + 8) + 4.0, k * (height + 8) + height
        finite = np.concatenate([v[np.isfinite(v)] for v, _, _ in panel.lines])
        least, most = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        span = (most - least) or 1.0
        frame = f"M{_LEFT - 4},{top:.1f}V{bottom:.1f}H{width - 8:.1f}"
        parts += [
            f'<path d="{frame}" stroke="{AXIS}" fill="none"/>',
            _text(2, (top + bottom) / 2 + 4, panel.label),
        ]
        parts += [
            _text(_LEFT - 7, y, f"{v:.3g}".replace("-", "−"), "end", ' font-size="9"')
            for v, y in ((most, top + 7), (least, bottom))
        ]
        for values, colour, dash in panel.lines:
            a, b = _thin(x, np.clip(np.nan_to_num(values, nan=least), least, most))
            parts.append(_path(across(a), bottom - (bottom - top) * (b - least) / span, colour, dash))
    end = len(panels) * (height + 8) + 10.0
    parts += [_text(_LEFT, end, f"{low:.3g}"), _text(width - 8, end, f"{high:.3g}", "end")]
    parts.append(_text((_LEFT + width) / 2, end, label, "middle"))
    return _svg(width, end + 6, parts)


def bars(rows: Sequence[tuple[str, float, str]], label: str, width: float = 560) -> str:
    """Horizontal bars on a logarithmic scale.

    Args:
        rows: Name, value and text of the value of each bar; rows whose value is not positive are left out.
        label: Label of the axis, with its unit.
        width: Width of the drawing [px].
    """
    rows = [row for row in rows if math.isfinite(row[1]) and row[1] > 0]
    if not rows:
        return ""
    logs = [math.log10(value) for _, value, _ in rows]
    low = math.floor(min(logs)) - 0.3
    pixels = (width - 300) / (max(max(logs), low + 1) - low)
    parts = []
    for k, ((name, _, text), log) in enumerate(zip(rows, logs, strict=True)):
        y, length = 16 * k + 4, max(1.0, pixels * (log - low))
        parts += [
            _text(222, y + 10, name, "end"),
            f'<rect x="230" y="{y + 1}" width="{length:.1f}" height="10" fill="{FINAL}"/>',
            _text(235 + length, y + 10, text),
        ]
    return _svg(width, 16 * len(rows) + 24, [*parts, _text(230, 16 * len(rows) + 18, label)])


def staircase(
    labels: Sequence[str],
    errors: Mapping[str, Sequence[float]],
    floor: Mapping[str, float],
    width: float = 560,
    height: float = 190,
) -> str:
    """Held-out error of each model, one panel per channel, on a logarithmic scale, with the sensor noise.

    Args:
        labels: Label of each model, in order.
        errors: Channel with its unit -> error of each model; errors that are not finite are left out.
        floor: Channel with its unit -> noise of its sensor.
        width: Width of the drawing [px].
        height: Height of the drawing [px].
    """
    parts: list[str] = []
    each = width / max(len(errors), 1)
    top, bottom = 30.0, height - 54.0
    for k, (channel, values) in enumerate(errors.items()):
        noise = floor.get(channel, 0.0)
        drawn = [(i, v) for i, v in enumerate(values) if math.isfinite(v) and v > 0]
        sizes = [v for _, v in drawn] + [noise] * (noise > 0)
        if not drawn:
            continue
        low, high = math.log10(min(sizes)) - 0.22, math.log10(max(sizes)) + 0.18
        left, right = k * each + 14, (k + 1) * each - 14
        step = (right - left) / max(len(labels), 1)

        def up(value: float, low: float = low, high: float = high) -> float:
            return bottom - (bottom - top) * (math.log10(value) - low) / (high - low)

        parts.append(_text(left, 14, channel, more=' font-weight="bold"'))
        parts.append(f'<path d="M{left:.1f},{bottom}H{right:.1f}" stroke="{AXIS}"/>')
        if noise > 0:
            parts.append(
                f'<path d="M{left:.1f},{up(noise):.1f}H{right:.1f}" stroke="{MUTED}" stroke-dasharray="4 3"/>'
            )
            parts.append(_text(left, up(noise) + 11, f"sensor noise {noise:.2g}", more=' font-size="9"'))
        before = None
        for i, value in drawn:
            a, y = left + i * step, up(value)
            colour = BASELINE if i == 0 else FINAL
            if before is not None:
                parts.append(f'<path d="M{a:.1f},{before:.1f}V{y:.1f}" stroke="{AXIS}"/>')
            parts.append(f'<path d="M{a:.1f},{y:.1f}H{a + step:.1f}" stroke="{colour}" stroke-width="3"/>')
            parts.append(_text(a + step / 2, y - 5, f"{value:.3g}", "middle"))
            before = y
        for i, label in enumerate(labels):
            middle, line = left + (i + 0.5) * step, bottom + 14
            for word in _lines(label, step):
                parts.append(_text(middle, line, word, "middle", ' font-size="9.5"'))
                line += 11
    return _svg(width, height, parts) if parts else ""


def _lines(text: str, width: float) -> list[str]:
    """The words of a text in lines of approximately a given width [px]."""
    lines = [""]
    for word in text.split(" "):
        if lines[-1] and 5.4 * (len(lines[-1]) + len(word) + 1) > width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return lines[:4]
