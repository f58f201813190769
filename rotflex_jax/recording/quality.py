"""Faults and properties of a recording: reported, never repaired.

A joint with dry friction is often at rest for a long time, also at the end of its motion, and its encoder
quantises. Neither is a fault, and the checks here do not take them for one.

A spring that carries only an inertia deflects in proportion to an acceleration, so at low frequency a
deflection falls with the square of the frequency: `alpha / theta = w^2 / (w_n^2 - w^2)`. The absolute
angle of the arm is `theta + alpha`, and `(theta + alpha) / theta = 1 / (1 - w^2 / w_n^2)` tends to one. A
deflection is as large as theta at no more than one frequency; an octave above, their ratio is far from one.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from rotflex_jax.checks import shown
from rotflex_jax.errors import InputError
from rotflex_jax.recording.continuity import (
    NEAR_REST,
    Still,
    frozen,
    held_speed,
    motion,
    outliers,
    unwrapped,
    without,
    wraps,
)


def quantisation_step(x: Float[np.ndarray, " N"]) -> float | None:
    """The step of a quantised signal.

    All distinct values must lie on one lattice, to 5 % of its step, so that values rounded to a few digits in
    a text file count too. A chance lattice among m free values has a probability below 0.1^(m - 1).

    Args:
        x: the signal.

    Returns:
        The step [unit of x]; None if the values are on no lattice, never repeat, or are fewer than ten.

    >>> t = np.arange(1000) / 100
    >>> quantisation_step(0.25 * np.round(8 * np.sin(t) / 0.25))
    0.25
    >>> quantisation_step(np.sin(t)) is None
    True
    """
    arithmetic = 16 * np.finfo(x.dtype).eps * np.max(np.abs(x))
    # A difference of two columns of a text file, perhaps in degrees there, has the rounding of both.
    levels, of_text = np.unique(x), 0.0
    for scale, digits in itertools.product((1.0, 180 / np.pi), range(3, 13)):
        rest = (np.abs(scale * v - np.round(scale * v, digits)) for v in (levels[:100], levels))
        if all(np.max(r) <= scale * arithmetic for r in rest):  # most signals fail in the first levels
            of_text = 2.01 * 10.0**-digits / scale
            break
    steps = (
        _lattice(levels, len(x), rounding) for rounding in (of_text, arithmetic) if rounding >= arithmetic
    )
    return next((float(f"{step:.10g}") for step in steps if step), None)


def _lattice(values: Float[np.ndarray, " M"], count: int, rounding: float) -> float | None:
    """The step of the distinct values of `count` samples; those that differ by `rounding` are one level."""
    levels = values.astype(np.float64)
    levels = levels[np.diff(levels, prepend=-np.inf) > rounding]
    if len(levels) < 10 or len(levels) == count:
        return None
    gaps = np.diff(levels)
    smallest = np.median(gaps[gaps < 1.5 * gaps.min()])
    for part in range(1, 6):  # neighbouring levels may all be missing: the smallest gap is 2 or 3
        index = np.concatenate([[0.0], np.cumsum(np.round(gaps * part / smallest))])
        spread = index - index.mean()
        step = spread @ (levels - levels.mean()) / (spread @ spread)
        if step < 100 * rounding:
            break
        if np.max(np.abs(levels - levels.mean() - step * spread)) < 0.05 * step:
            return step
    return None


def cut_off(
    x: Float[np.ndarray, " N"], step: float | None, u: Float[np.ndarray, " N"], Ts: float
) -> tuple[float, int] | None:
    """The end of a sensor's range at which the signal is cut off.

    A joint may rest exactly at the end of its motion, so many equal samples prove nothing. Saturation is
    proved by a signal that arrives at the end and leaves it without slowing down, or that stays there while
    the input is at its strongest in both directions.

    Args:
        x: signal.
        step: quantisation step of the signal, None if there is none [unit of x].
        u: input.
        Ts: sampling period [s].

    Returns:
        The end [unit of x] and the number of samples there; None if the signal is not cut off.

    >>> wave = np.sin(np.arange(2000) / 50)
    >>> cut_off(wave, None, wave, 0.002)
    >>> cut_off(np.minimum(wave, 0.7), None, wave, 0.002)
    (0.7, 553)
    """
    for end, z in ((x.max(), x.max() - x), (x.min(), x - x.min())):
        there = z <= 1e-6 * (step or 0.0)
        count = int(np.sum(there))
        if count >= 10 and (_passes_straight(z, there, step or 0.0) or _is_driven(there, u, Ts)):
            return float(end), count
    return None


def _passes_straight(z: Float[np.ndarray, " N"], there: Bool[np.ndarray, " N"], step: float) -> bool:
    """Whether the signal arrives at an end and leaves it without slowing down.

    A motion that stops or turns follows a parabola: over the last distance D it needs twice the time that it
    needs over the last D / 4. A signal that is cut off goes straight on, and needs four times as long. The
    ratio of these times, over all visits together, must be above 2.5 for arriving and for leaving. A signal
    that pauses before it creeps to its end may have such a ratio by chance. So the same must hold for D / 4
    and D / 16, if the signal takes enough samples there.
    """
    far, passing = max(40 * step, 0.1 * z.max()), _Passing(0, np.zeros(2), np.zeros(2))
    while far <= 0.5 * z.max():  # a motion of a few steps is no evidence
        passing = _passing_times(z, there, step, far)
        if passing.lasts:
            break
        far *= 2  # too few samples: half a sample at each end would matter
    if passing.visits < 2 or not passing.straight:
        return False
    closer = _passing_times(z, there, step, far / 4)
    return not closer.visits or not closer.lasts or closer.straight


class _Passing(NamedTuple):
    """How a signal arrives at an end and leaves it.

    Attributes:
        visits: Number of visits to the end.
        near: Times [samples] within a quarter of a distance D, arriving and leaving, over all visits.
        far: Times within D.
    """

    visits: int
    near: Float[np.ndarray, "2"]
    far: Float[np.ndarray, "2"]

    @property
    def lasts(self) -> bool:
        """Whether there are enough samples: twelve for each visit."""
        return bool(np.sum(self.far) >= 12 * self.visits)

    @property
    def straight(self) -> bool:
        """Whether D takes more than 2.5 times as long as D / 4."""
        return bool(np.all(self.far > 2.5 * self.near))


def _passing_times(
    z: Float[np.ndarray, " N"], there: Bool[np.ndarray, " N"], step: float, far: float
) -> _Passing:
    """Visits to an end, with the times within the distances `far / 4` and `far` of it."""
    edges = np.flatnonzero(np.diff(z < far / 4, prepend=False, append=False))
    beyond = np.concatenate([[-np.inf], np.flatnonzero(z >= far), [np.inf]])
    visits, near_times, far_times = set(), np.zeros(2), np.zeros(2)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_end = start + np.flatnonzero(there[start:stop])
        if len(at_end) < 2:
            continue
        first, last = at_end[0], at_end[-1]
        nearest = np.searchsorted(beyond, first)
        # The end is reached half a sample before the first sample there, left half a sample after the last.
        arriving = first - start + 0.5, first - beyond[nearest - 1] - 0.5
        leaving = stop - last - 0.5, beyond[nearest] - last - 0.5
        for side, (near, full) in enumerate((arriving, leaving)):
            # Above a ratio of six it paused on the way, or did not come from further away: no evidence. In
            # its time at the end it must have had further to go, at its speed, than a turning point can hide.
            if full < 6 * near and len(at_end) * far / 4 / near > 3 * np.sqrt(step * far):
                visits.add(start)
                near_times[side] += near
                far_times[side] += full
    return _Passing(len(visits), near_times, far_times)


def _is_driven(there: Bool[np.ndarray, " N"], u: Float[np.ndarray, " N"], Ts: float) -> bool:
    """Whether the input is at its strongest, in both directions, during the longest stay at an end."""
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    stay = np.argmax(edges[1::2] - edges[::2])
    start, stop = edges[2 * stay], edges[2 * stay + 1]
    width = min(len(u), max(1, round(0.1 / Ts)))
    lasting = np.convolve(u, np.full(width, 1 / width), mode="same")
    during = lasting[start:stop]
    return bool(
        stop - start >= 20
        and during.max() >= 0.8 * lasting.max() > 0
        and during.min() <= 0.8 * lasting.min() < 0
    )


SLOW_BANDS = ((1, 4, 0.05), (4, 8, 0.15))
"""Bands of slow motion: first harmonic of the recording, harmonic after the last, tolerance of slope one."""

LEAST_COHERENCE, LEAST_SLOW_SHARE = 0.99, 0.003
"""Least coherence of the two angles in each band; least share of the hub's whole motion in each band."""


def is_absolute(theta: Float[np.ndarray, " N"], alpha: Float[np.ndarray, " N"]) -> bool:
    """Whether alpha follows theta one to one in slow motion, in each of two bands.

    False if there is no slow motion, as in a short recording or with a single sine: a deflection may then
    look the same.

    Args:
        theta: angle of the hub [rad].
        alpha: angle that is given as the deflection of the arm [rad].

    >>> t = np.linspace(0, 10, 5000)
    >>> theta, swing = np.cos(t) + 0.3 * np.sin(3 * t), 0.05 * np.sin(20 * t)
    >>> is_absolute(theta, theta + swing), is_absolute(theta, swing)
    (True, False)
    """
    if len(theta) < 2 * SLOW_BANDS[-1][1]:
        return False
    hub, arm = _spectrum(theta), _spectrum(alpha)
    for start, stop, far in SLOW_BANDS:
        a, b = hub[start:stop], arm[start:stop]
        size, other = np.linalg.norm(a), np.linalg.norm(b)
        if size <= LEAST_SLOW_SHARE * np.linalg.norm(hub) or other == 0:
            return False
        together = np.vdot(a, b)
        if abs(together / size**2 - 1) > far or abs(together) < LEAST_COHERENCE * size * other:
            return False
    return True


IN_DIGESTS = ("short", "constant_input", "constant", "saturated", "units", "absolute", "swapped", "huge")
"""Accepted faults in the digest of a part of a recording; fixed, since results are stored by digest."""

ACCEPTABLE = (*IN_DIGESTS, "slow", "wrapped", "outliers", "frozen")
"""Faults that a user can accept by name; with any other fault the data have no sensible meaning."""

DOUBTED = ("units", "absolute", "swapped", "outliers", "frozen")
"""Warnings for which a file is refused unless they are accepted."""

SHORTEST_RECORDING = 50
"""Number of samples below which no fit makes sense."""


@dataclass(frozen=True)
class Finding:
    """A fault or property of a recording.

    Args:
        kind: short name, such as `quantised`; if the fault can be accepted, it is accepted by this name.
        channel: the signal to which the finding belongs.
        message: one sentence for the user.
        severity: `note` (good to know), `warning` (check it) or `error` (refused).
    """

    kind: str
    channel: str
    message: str
    severity: str

    def __str__(self) -> str:
        return self.message


def inspect(
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, "N C"],
    Ts: float,
    names: Sequence[str],
    units: Sequence[str],
    resolution: Mapping[str, float | None],
    accept: Sequence[str] = (),
    start: float = 0.0,
) -> tuple[Finding, ...]:
    """All findings on a recording, signal by signal.

    Args:
        u: input.
        y: outputs.
        Ts: sampling period [s].
        names: names of the input and then of the outputs.
        units: units in the same order.
        resolution: quantisation step of each output, if there is one [unit of the output].
        accept: kinds of errors that become warnings.
        start: time of the first sample [s].

    Returns:
        The findings; `refuse` raises the errors among them.
    """
    found = [_short(u), _slow(Ts, units[1:]), *_of_input(u, names[0], units[0])]
    y, gaps = _continued(u, y, Ts, names[1:], units[1:], start)  # gaps must not hide other faults
    found += gaps
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
        if unit.endswith("/s"):
            found.append(_held_speed(x, Ts, name, unit, step, start))
        if unit == "rad":
            found.append(_like_counts(x, name) or _like_degrees(x, u, Ts, name, units[0]))
    found += [_absolute_angle(y, names[1:]), _swapped(y, names[1:])]
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
    kinds = tuple(accept) if isinstance(accept, Sequence) and not isinstance(accept, str) else (accept,)
    unknown = [kind for kind in kinds if not isinstance(kind, str) or kind not in ACCEPTABLE]
    if unknown:
        raise InputError(
            f"Argument `accept` must name faults among {', '.join(ACCEPTABLE)}, "
            f"but has {shown(unknown[0])}; correct it or leave it out."
        )
    return kinds


def _still(x: Float[np.ndarray, " N"]) -> bool:
    return bool(np.ptp(x) <= 1e-12 * np.max(np.abs(x)))


def _short(u: Float[np.ndarray, " N"]) -> Finding | None:
    if len(u) >= SHORTEST_RECORDING:
        return None
    message = (
        f"The recording must have at least {SHORTEST_RECORDING} samples, but has {len(u)}; record longer."
    )
    return Finding("short", "time", message, "error")


SLOWEST_SAMPLING = 0.5
"""Sampling period from which the samples of an angle no longer show the motion of a joint [s]."""


def _slow(Ts: float, units: Sequence[str]) -> Finding | None:
    if Ts < SLOWEST_SAMPLING or "rad" not in units:
        return None
    message = (
        f"The sampling period is {Ts:g} s, too slow for a joint: it looks like milliseconds; "
        f"pass Ts={Ts / 1000:g}, or accept=('slow',) if these are seconds."
    )
    return Finding("slow", "time", message, "error")


def _size(x: float, unit: str) -> str:
    return f"{x:.4g} {unit}" + (f" ({np.rad2deg(x):.4g} deg)" if unit == "rad" else "")


def _wrapped(
    x: Float[np.ndarray, " N"], Ts: float, name: str, start: float
) -> tuple[Float[np.ndarray, " N"], Finding | None]:
    """The angle without jumps by a whole turn, and the finding on them."""
    for turn, jump, cure in (
        (2 * np.pi, "a whole turn, 6.283 rad (360 deg)", " (period=360 for a column in degrees)"),
        (360.0, "360, a whole turn in degrees", "(..., period=360), and pass degrees=True"),
    ):
        behind = wraps(x, turn)
        if not len(behind):
            continue
        often = "once" if len(behind) == 1 else f"{len(behind)} times in all"
        message = (
            f"Channel {name!r} jumps by {jump}, after {start + behind[0] * Ts:.6g} s, {often}: it is "
            f"wrapped; unwrap it before loading, with numpy.unwrap{cure}, or pass accept=('wrapped',)."
        )
        return unwrapped(x, behind, turn), Finding("wrapped", name, message, "error")
    return x, None


def _outliers(
    x: Float[np.ndarray, " N"], Ts: float, name: str, unit: str, start: float
) -> tuple[Float[np.ndarray, " N"], Finding | None]:
    """The signal with outliers replaced by straight lines, and the finding on them."""
    out = outliers(x, FASTEST * Ts if unit == "rad" else 0.0)
    if not out.any():
        return x, None
    first = int(np.argmax(out))
    message = (
        f"Channel {name!r} is {_size(float(x[first]), unit)} at {start + first * Ts:.6g} s (sample {first}), "
        f"after {_size(float(x[first - 1]), unit)}, but else moves by {motion(x):.3g} {unit} per sample at "
        f"most: outliers, {np.sum(out)} of {len(x)} samples in all; remove or interpolate them before "
        "loading, cut the recording there, or pass accept=('outliers',)."
    )
    return without(x, out), Finding("outliers", name, message, "warning")


def _continued(
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, "N C"],
    Ts: float,
    names: Sequence[str],
    units: Sequence[str],
    start: float,
) -> tuple[Float[np.ndarray, "N C"], list[Finding]]:
    """The outputs with wraps, outliers and frozen stretches removed, and the findings on these."""
    columns, said = [], []
    for x, name, unit in zip(y.T, names, units, strict=True):
        wrapped = None
        if unit == "rad":
            x, wrapped = _wrapped(x, Ts, name, start)
        x, out = _outliers(x, Ts, name, unit, start)
        columns.append(x)
        said += [wrapped, out]
    y = np.column_stack(columns)
    still = frozen(u, y, Ts)
    if still is not None:
        said.append(_frozen(still, y, Ts, names, units, start))
        away = (np.arange(len(y)) >= still.first) & (np.arange(len(y)) <= still.last)
        lost = [still.channel] if still.alone else range(y.shape[1])
        y = np.column_stack([without(x, away & (c in lost)) for c, x in enumerate(y.T)])
    return y, [finding for finding in said if finding is not None]


def _frozen(
    found: Still,
    y: Float[np.ndarray, "N C"],
    Ts: float,
    names: Sequence[str],
    units: Sequence[str],
    start: float,
) -> Finding:
    name = names[found.channel]
    jump = _size(found.jump, units[found.channel])
    ends = f"from {start + found.first * Ts:.6g} to {start + found.last * Ts:.6g} s"
    if found.alone:
        value = f"{y[found.first, found.channel]:g} {units[found.channel]}"
        what = f"Channel {name!r} is exactly {value} {ends}, and jumps to it and away, by {jump}"
    else:
        one = len(names) == 1
        what = (
            f"Channel{'' if one else 's'} {' and '.join(map(repr, names))} {'is' if one else 'are'} exactly "
            f"constant {ends} while the input varies, and then {'it' if one else repr(name)} jumps by {jump}"
        )
    message = (
        f"{what}: nothing was measured in that time; load the parts before and after it as recordings of "
        "their own, or pass accept=('frozen',)."
    )
    return Finding("frozen", name, message, "warning")


def _held_speed(
    x: Float[np.ndarray, " N"], Ts: float, name: str, unit: str, step: float | None, start: float
) -> Finding | None:
    held = held_speed(x, step, Ts)
    if held is None:
        return None
    first, last = (start + k * Ts for k in held)
    message = (
        f"Channel {name!r} is exactly {x[held[0]]:g} {unit} from {first:.6g} to {last:.6g} s, but changed "
        "from sample to sample before: the sensor is stuck or at its limit; load the parts before and after "
        "it as recordings of their own, or pass accept=('frozen',)."
    )
    return Finding("frozen", name, message, "warning")


def _of_input(u: Float[np.ndarray, " N"], name: str, unit: str) -> list[Finding]:
    if _still(u):
        message = (
            f"Input {name!r} is {u[0]:g} {unit} throughout, which moves nothing to learn from; "
            "check the column, or record with an input that varies."
        )
        return [Finding("constant_input", name, message, "error")]
    found = []
    levels, counts = np.unique(u, return_counts=True)
    # A two-level or stepped input holds every level for a long time; a clipped input only the extremes, and
    # it comes back to them. A controller with a constant error, as where friction holds the machine, may
    # stand once at what is the extreme of a part of a recording.
    often = max(5.0, 0.005 * len(u), 5.0 * float(np.median(counts)))
    ends = [
        f"{levels[k]:g}"
        for k in (0, -1)
        if counts[k] >= often and levels[k] != 0 and _comes_back(u, float(levels[k]))
    ]
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


def _comes_back(u: Float[np.ndarray, " N"], level: float) -> bool:
    """Whether the input is at a level more than once, and in between a tenth of its range away from it."""
    there, away = u == level, np.abs(u - level) > 0.1 * np.ptp(u)
    visits = there[there | away].astype(int)
    return int(np.sum(np.diff(visits, prepend=0) == 1)) > 1


def _quantised(name: str, unit: str, step: float | None) -> Finding | None:
    if step is None:
        return None
    message = f"Channel {name!r} is quantised in steps of {_size(step, unit)}."
    return Finding("quantised", name, message, "note")


FASTEST_SAMPLING = 5e-5
"""Sampling period below which an impossible speed may come from the unit of the time [s]."""

IF_DEGREES = "it looks like degrees; pass degrees=True, or accept=('units',) if it is radians."
IF_DEGREES_OR_TIME = (
    "the unit of the time looks wrong, or that of the angle; correct time_unit= or Ts=, pass degrees=True "
    "for degrees, or accept=('units',) if both are right."
)


IF_CONVERTED = {
    IF_DEGREES: "the column was converted to radians and is in another unit than was said, or the time is; "
    "correct what was given, or pass accept=('units',) if it is right.",
    IF_DEGREES_OR_TIME: "the unit of the time looks wrong, or that of the angle; correct time_unit= or Ts=, "
    "or accept=('units',) if both are right.",
}
"""Advice on a channel in radians -> advice on a channel that was converted from degrees or counts already."""


def converted(finding: Finding) -> Finding:
    """The finding with its advice for a channel that was converted from degrees or counts already."""
    message = finding.message
    for advice, instead in IF_CONVERTED.items():
        message = message.replace(advice, instead)
    return replace(finding, message=message)


FASTEST = 60.0
"""Speed that no geared servo reaches [rad/s]."""


def _like_degrees(
    x: Float[np.ndarray, " N"], u: Float[np.ndarray, " N"], Ts: float, name: str, input_unit: str
) -> Finding | None:
    """Finding on angles that are too large or too fast to be radians.

    No deflection exceeds half a turn. A geared servo turns at about 2 rad/s per volt; read as radians, its
    degrees would be about 100 per volt. The limit lies between the two. It applies to the speed over 20 ms,
    which noise does not reach; in a recording below 40 ms, to the speed over half of the recording.
    """
    lag = max(1, min(round(0.02 / Ts), len(x) // 2))
    speed = np.max(np.abs(x[lag:] - x[:-lag]), initial=0.0) / (lag * Ts)
    if name == "alpha" and np.max(np.abs(x)) > np.pi:
        what = f"reaches {np.max(np.abs(x)):.3g} rad, more than half a turn"
    elif input_unit == "V" and speed > max(FASTEST, 15.0 * np.max(np.abs(u))):
        what = f"turns at up to {speed:.3g} rad/s on {np.max(np.abs(u)):.3g} V"
        if Ts < FASTEST_SAMPLING:
            message = f"Channel {name!r} {what}, sampled at {1 / Ts:.6g} Hz: {IF_DEGREES_OR_TIME}"
            return Finding("units", name, message, "warning")
    else:
        return None
    return Finding("units", name, f"Channel {name!r} {what}: {IF_DEGREES}", "warning")


MOST_WHOLE = 20
"""Span from which whole numbers cannot be an angle in radians."""


def whole_numbers(x: Float[np.ndarray, " N"]) -> bool:
    """Whether a signal has only whole numbers, over a span that is too large for an angle in radians.

    >>> k = np.arange(100.0)
    >>> whole_numbers(k), whole_numbers(0.5 * k), whole_numbers(k % 5)
    (True, False, False)
    """
    return bool(np.ptp(x) >= MOST_WHOLE and np.all(x == np.round(x)))


def _like_counts(x: Float[np.ndarray, " N"], name: str) -> Finding | None:
    if not whole_numbers(x):
        return None
    message = (
        f"Channel {name!r} holds whole numbers from {x.min():g} to {x.max():g}, as the counts of an encoder "
        "are: give the counts of one turn, counts=4096 for instance, or degrees=True for whole degrees."
    )
    return Finding("units", name, message, "warning")


def _absolute_angle(y: Float[np.ndarray, "N C"], names: Sequence[str]) -> Finding | None:
    if not {"theta", "alpha"} <= set(names):
        return None
    if not is_absolute(*(y[:, names.index(name)] for name in ("theta", "alpha"))):
        return None
    message = (
        "Channel 'alpha' follows 'theta' one to one in slow motion, as the angle of the arm in the room "
        "does and a deflection never: if it is that angle, pass arm_absolute=True, which subtracts theta; "
        "accept=('absolute',) if it is the deflection."
    )
    return Finding("absolute", "alpha", message, "warning")


SWAPPED_RATIO = 3.0
"""Ratio to the hub's motion that a deflection cannot exceed in slow motion."""


def _spectrum(x: Float[np.ndarray, " N"]) -> Complex[np.ndarray, " F"]:
    """Fourier transform without the mean; the window has low side lobes, so bands do not leak into others."""
    window = np.blackman(len(x))
    return np.fft.rfft(window * (x - window @ x / window.sum()))


def is_swapped(theta: Float[np.ndarray, " N"], alpha: Float[np.ndarray, " N"]) -> bool:
    """Whether alpha moves far more than theta in slow motion, in each of two bands, as the hub does.

    Args:
        theta: angle that is given as that of the hub [rad].
        alpha: angle that is given as the deflection of the arm [rad].

    >>> t = np.linspace(0, 10, 5000)
    >>> theta, alpha = np.cos(t) + 0.3 * np.sin(3 * t), 0.02 * np.cos(t) + 0.5 * np.sin(20 * t)
    >>> is_swapped(theta, alpha), is_swapped(alpha, theta)
    (False, True)
    """
    if len(theta) < 2 * SLOW_BANDS[-1][1]:
        return False
    hub, arm = _spectrum(theta), _spectrum(alpha)
    for start, stop, _ in SLOW_BANDS:
        own = float(np.linalg.norm(arm[start:stop]))
        if own <= 10 * LEAST_SLOW_SHARE * np.linalg.norm(arm):
            return False
        if own <= SWAPPED_RATIO * float(np.linalg.norm(hub[start:stop])):
            return False
    return True


def _swapped(y: Float[np.ndarray, "N C"], names: Sequence[str]) -> Finding | None:
    if not {"theta", "alpha"} <= set(names):
        return None
    theta, alpha = (y[:, names.index(name)] for name in ("theta", "alpha"))
    if _still(theta) or _still(alpha) or not is_swapped(theta, alpha):
        return None
    message = (
        f"Channel 'alpha' moves {np.ptp(alpha) / np.ptp(theta):.3g} times as far as 'theta', in slow motion "
        "too, as the hub does and a deflection never: the two look swapped; give the column of the hub "
        "first with outputs=, or accept=('swapped',)."
    )
    return Finding("swapped", "alpha", message, "warning")


def _may_rest(x: Float[np.ndarray, " N"], u: Float[np.ndarray, " N"], end: float) -> bool:
    """Whether a speed at this end of its range may be rest, to which friction brings a machine at once.

    A speed of exactly zero is its extreme also for a sensor without a sign, where the input has both signs.
    """
    both_signs = u.min() < 0 < u.max()
    return abs(end) <= NEAR_REST * np.max(np.abs(x)) and not (end == 0 and both_signs)


def _cut_off(
    x: Float[np.ndarray, " N"],
    u: Float[np.ndarray, " N"],
    Ts: float,
    name: str,
    unit: str,
    step: float | None,
) -> Finding | None:
    end, count = cut_off(x, step, u, Ts) or (None, 0)
    if end is None or (unit.endswith("/s") and _may_rest(x, u, end)):
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
