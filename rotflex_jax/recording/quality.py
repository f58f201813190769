"""What is wrong with a recording, or worth knowing of it: named, never repaired.

A real joint with dry friction sits still for long, often at the very end of its motion, and its
encoder counts in steps: neither is a fault, and the checks here are built to know the difference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.recording.arm_angle import looks_absolute
from rotflex_jax.recording.sensor import cut_off

ACCEPTABLE = ("short", "constant_input", "constant", "saturated", "units", "huge")
"""Faults that a user can accept by name; all others have no sensible reading."""

SHORTEST = 50
"""Samples below which no fit is worth its name."""


@dataclass(frozen=True)
class Finding:
    """Something about the quality of a recording.

    Args:
        kind: short name, such as `quantised`; the name to accept it by where that is possible.
        channel: the signal it is about.
        message: one sentence for a person.
        severity: `note` (as it should be known), `warning` (look at it) or `error` (refused).
    """

    kind: str
    channel: str
    message: str
    severity: str

    def __str__(self) -> str:
        return self.message


def inspect(
    u: np.ndarray,
    y: np.ndarray,
    Ts: float,
    names: Sequence[str],
    units: Sequence[str],
    resolution: Mapping[str, float | None],
    accept: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """Everything there is to say about a recording, by signal.

    Args:
        u: input (N,).
        y: outputs (N, C).
        Ts: sampling period [s].
        names: of the input and then of the outputs.
        units: in the same order.
        resolution: quantisation step of each output, where there is one [unit of the output].
        accept: kinds of errors that are to be warnings.

    Returns:
        The findings; `refuse` raises the errors among them.
    """
    found = [_short(u), *_of_input(u, names[0], units[0])]
    for x, name, unit in zip(y.T, names[1:], units[1:], strict=True):
        if _still(x):
            message = (
                f"Channel {name!r} never changes from {x[0]:g} {unit}; check the sensor, "
                "or leave the channel out."
            )
            found.append(Finding("constant", name, message, "error"))
            continue
        step = resolution[name]
        found += [_quantised(name, unit, step), _cut_off(x, u, Ts, name, unit, step)]
        if unit == "rad":
            found.append(_like_degrees(x, u, Ts, name, units[0]))
    found.append(_in_the_room(y, names[1:]))
    accepted = {("error", kind): "warning" for kind in accept}
    return tuple(
        replace(finding, severity=accepted.get((finding.severity, finding.kind), finding.severity))
        for finding in found
        if finding is not None
    )


def refuse(findings: Sequence[Finding]) -> None:
    """Raises the first finding that is an error."""
    for finding in findings:
        if finding.severity == "error":
            raise InputError(finding.message)


def acceptable(accept: str | Sequence[str]) -> tuple[str, ...]:
    """The kinds of faults that are accepted, checked for spelling.

    >>> acceptable("saturated")
    ('saturated',)
    """
    kinds = (accept,) if isinstance(accept, str) else tuple(accept)
    unknown = [kind for kind in kinds if kind not in ACCEPTABLE]
    if unknown:
        raise InputError(
            f"Argument `accept` must name faults among {', '.join(ACCEPTABLE)}, "
            f"but has {unknown[0]!r}; correct it or leave it out."
        )
    return kinds


def _still(x: np.ndarray) -> bool:
    return bool(np.ptp(x) <= 1e-12 * np.max(np.abs(x)))


def _short(u: np.ndarray) -> Finding | None:
    if len(u) >= SHORTEST:
        return None
    message = f"The recording must have at least {SHORTEST} samples, but has {len(u)}; record longer."
    return Finding("short", "time", message, "error")


def _of_input(u: np.ndarray, name: str, unit: str) -> list[Finding]:
    if _still(u):
        message = (
            f"Input {name!r} is {u[0]:g} {unit} throughout, which moves nothing to learn from; "
            "check the column, or record with an input that varies."
        )
        return [Finding("constant_input", name, message, "error")]
    found = []
    levels, counts = np.unique(u, return_counts=True)
    # A two-level or stepped input holds every level for long; a clipped one only the outermost.
    often = max(5.0, 0.005 * len(u), 5.0 * float(np.median(counts)))
    ends = [f"{levels[k]:g}" for k in (0, -1) if counts[k] >= often and levels[k] != 0]
    if len(levels) >= 10 and ends:
        message = (
            f"Input {name!r} stands at its limit, {' and '.join(ends)} {unit}, unusually often: "
            "it looks clipped, and is right if it was recorded behind the limit."
        )
        found.append(Finding("clipped_input", name, message, "note"))
    if unit == "V" and np.max(np.abs(u)) > 100:
        message = (
            f"Input {name!r} reaches {np.max(np.abs(u)):g} V, more than a servo takes: it looks "
            "like millivolts; divide it by 1000, or pass accept=('units',)."
        )
        found.append(Finding("units", name, message, "warning"))
    return found


def _quantised(name: str, unit: str, step: float | None) -> Finding | None:
    if step is None:
        return None
    size = f"{step:.4g} {unit}" + (f" ({np.rad2deg(step):.4g} deg)" if unit == "rad" else "")
    return Finding("quantised", name, f"Channel {name!r} is quantised in steps of {size}.", "note")


def _like_degrees(x: np.ndarray, u: np.ndarray, Ts: float, name: str, input_unit: str) -> Finding | None:
    """Angles beyond what a joint can do in radians.

    A deflection of half a turn is none. A geared servo makes about 2 rad/s per volt, in degrees
    100; the line is drawn between them, for the speed over 20 ms, which noise cannot reach.
    """
    lag = max(1, round(0.02 / Ts))
    speed = np.max(np.abs(x[lag:] - x[:-lag]), initial=0.0) / (lag * Ts)
    if name == "alpha" and np.max(np.abs(x)) > np.pi:
        what = f"reaches {np.max(np.abs(x)):.3g} rad, more than half a turn"
    elif input_unit == "V" and speed > max(60.0, 15.0 * np.max(np.abs(u))):
        what = f"turns at up to {speed:.3g} rad/s on {np.max(np.abs(u)):.3g} V"
    else:
        return None
    message = (
        f"Channel {name!r} {what}: it looks like degrees; pass degrees=True, "
        "or accept=('units',) if it is radians."
    )
    return Finding("units", name, message, "warning")


def _in_the_room(y: np.ndarray, names: Sequence[str]) -> Finding | None:
    if not {"theta", "alpha"} <= set(names):
        return None
    if not looks_absolute(*(y[:, names.index(name)] for name in ("theta", "alpha"))):
        return None
    message = (
        "Channel 'alpha' follows 'theta' one to one in slow motion, as the angle of the arm in the room "
        "does and a deflection never: if it is that angle, subtract theta."
    )
    return Finding("absolute", "alpha", message, "warning")


def _cut_off(
    x: np.ndarray, u: np.ndarray, Ts: float, name: str, unit: str, step: float | None
) -> Finding | None:
    end, count = cut_off(x, step, u, Ts) or (None, 0)
    if end is None:
        return None
    where = f"is exactly {end:g} {unit}, its extreme, in {count} of {len(x)} samples"
    if end == 0:
        message = f"Channel {name!r} {where}, and looks rectified; check the sensor."
        return Finding("rectified", name, message, "warning")
    message = (
        f"Channel {name!r} {where}, and was on its way further: the sensor is saturated or the "
        "joint hits a stop; record within the range, or pass accept=('saturated',)."
    )
    return Finding("saturated", name, message, "error")
