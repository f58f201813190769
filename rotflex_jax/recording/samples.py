"""Checks of samples: real, finite, aligned, evenly spaced; sampling period and initial samples."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.checks import entries, positive, real, shown
from rotflex_jax.errors import InputError

# Relative difference of two sampling periods that counts as rounding.
SAME_PERIOD = 1e-6
# Longest step that resampling bridges, in median steps.
LONGEST_STEP = 5.0


MISSING = "cut the recording there (docs/load_data.md shows how), since nothing is filled in"
"""What to do about a value that is missing."""


def real_numbers(values: Any, label: str, where: str = "sample", first: int = 0) -> Real[np.ndarray, "..."]:
    """An array of real numbers; text is parsed strictly.

    Args:
        values: the values that were given.
        label: first words of an error message, such as "run.csv: column 'theta'".
        where: word for one entry in an error message.
        first: number of the first entry.

    Returns:
        The array: numbers in the type in which they were given, text as float64.

    Raises:
        InputError: the values are ragged, masked, complex, text that is no number, or no numbers.
    """
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(
            f"{label} must be an array of numbers, but its rows differ in length; "
            "give every sample the same channels."
        ) from error
    if np.ma.is_masked(values):
        raise InputError(f"{label} has masked samples, but all are needed; cut or refill them.")
    if array.dtype.kind in "iuf":
        return array
    if array.dtype.kind not in "OUST" or array.ndim != 1:
        raise InputError(f"{label} must hold real numbers, but holds {array.dtype.name}; convert it first.")
    numbers = np.empty(len(array))
    for k, entry in enumerate(array):
        try:
            if isinstance(entry, str) and "_" in entry:
                raise ValueError("Python alone takes 1_000 for a number")
            numbers[k] = float(entry)
        except (TypeError, ValueError, OverflowError) as error:
            text = entry.decode(errors="replace") if isinstance(entry, bytes) else f"{entry!s:.50}"
            what = f"holds {text!r}" if text.strip() else "is empty"
            cure = "correct the data, or cut them there" if text.strip() else MISSING
            raise InputError(
                f"{label} {what} at {where} {first + k} where a number is needed; {cure}."
            ) from error
    return numbers


def finite(x: Real[np.ndarray, " N"], label: str, where: str = "sample", first: int = 0) -> None:
    """Refuses NaN and infinity.

    Raises:
        InputError: with the place of the first such value and the number of all of them.

    >>> finite(np.array([0.0, np.nan, 1.0]), "Channel 'alpha'")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Channel 'alpha' is nan at sample 1, in 1 of 3 samples in all; \
cut the recording there (docs/load_data.md shows how), since nothing is filled in.
    """
    bad = np.flatnonzero(~np.isfinite(x))
    if len(bad):
        raise InputError(
            f"{label} is {x[bad[0]]} at {where} {first + bad[0]}, in {len(bad)} of {len(x)} "
            f"samples in all; {MISSING}."
        )


def aligned(
    u: Real[np.ndarray, "..."], y: Real[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N C"]]:
    """Input and outputs in one precision, copied and read-only.

    Raises:
        InputError: a shape is not valid, or the lengths differ.
    """
    if u.ndim == 2 and u.shape[1] == 1:
        u = u[:, 0]
    if y.ndim == 1:
        y = y[:, None]
    if u.ndim != 1 or y.ndim != 2 or 0 in (len(u), *y.shape):
        raise InputError(
            "Arguments `u` and `y` must have the shapes (N,) and (N, C), one row per sample, "
            f"but have {u.shape} and {y.shape}; give one input, and outputs side by side."
        )
    if len(u) != len(y):
        hint = "transpose `y`" if y.shape[1] == len(u) else "cut both to the same samples"
        raise InputError(
            f"Arguments `u` and `y` must have the same length, but have {len(u)} and {len(y)} "
            f"samples; {hint}."
        )
    dtype = np.float32 if u.dtype == y.dtype == np.float32 else np.float64
    u, y = np.array(u, dtype=dtype), np.array(y, dtype=dtype)
    u.setflags(write=False)
    y.setflags(write=False)
    return u, y


def sampling_period(Ts: Any, label: str = "Argument `Ts`") -> float:
    """The sampling period as a positive number [s].

    Raises:
        InputError: it is no positive number.

    >>> sampling_period("fast")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `Ts` must be a positive number of seconds, \
but is 'fast'; give for instance 0.002.
    """
    try:
        value = np.asarray(Ts)
    except ValueError:  # rows of different lengths
        value = np.zeros(0)
    if value.size != 1 or value.dtype.kind not in "iuf" or not 1e-300 < value.item() < np.inf:
        what = shown(value.item()) if value.size == 1 else f"{value.size} values" if value.size else shown(Ts)
        raise InputError(
            f"{label} must be a positive number of seconds, but is {what}; give for instance 0.002."
        )
    return float(value.item())


def of_one_period(periods: Iterable[float]) -> bool:
    """Whether sampling periods [s] are the same up to rounding."""
    found = list(periods)
    return max(found) / min(found) - 1 <= SAME_PERIOD


def require_period(period: float, recorded: float, what: str) -> None:
    """Refuses a recording whose sampling period differs from the period of a sampled model.

    Args:
        period: Sampling period for which the model holds [s].
        recorded: Sampling period of the recording [s].
        what: First words of the error message, such as "The system holds".

    Raises:
        InputError: The two differ by more than rounding.

    >>> require_period(0.002, 0.01, "The system holds")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: The system holds for a sampling period of 0.002 s, but the recording has \
0.01 s; fit it to a recording of that period.
    """
    if not of_one_period((period, recorded)):
        raise InputError(
            f"{what} for a sampling period of {period:g} s, but the recording has {recorded:g} s; "
            "fit it to a recording of that period."
        )


def even_spacing(t: Real[np.ndarray, " N"], label: str, where: str = "sample", first: int = 0) -> float:
    """The sampling period of time stamps that must be evenly spaced, to 1 % of the period.

    Args:
        t: time stamps [s].
        label: first words of an error message.
        where: word for one entry in an error message.
        first: number of the first entry.

    Returns:
        Sampling period [s].

    Raises:
        InputError: time stamps are equal, decrease, have a gap or jitter; with the place.

    >>> even_spacing(np.arange(100) / 500, "Time")
    0.002
    """
    finite(t, label, where, first)
    if len(t) < 2:
        raise InputError(f"{label} has {len(t)} time stamps, but a sampling period needs two; record longer.")
    steps = np.diff(t)
    period = float(np.median(steps))

    def place(k: Any) -> str:
        return f"between {where}s {first + k} and {first + k + 1}"

    fallen, equal = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0)
    if len(fallen):
        raise InputError(
            f"{label} must increase, but falls by {-steps[fallen[0]]:g} s {place(fallen[0])}; "
            "sort the rows, or load one run at a time."
        )
    if len(equal):
        raise InputError(
            f"{label} must increase, but has a duplicate time stamp {place(equal[0])}, "
            f"{len(equal)} in all; remove the repeated rows, or write the time with more digits."
        )
    worst = int(np.argmax(np.abs(steps - period)))
    if steps[worst] > 1.5 * period:
        cure = "load the parts before and after it as recordings of their own"
        if np.max(steps) <= LONGEST_STEP * period:
            cure = f"pass resample='auto' to bridge it by a line, or {cure}"
        raise InputError(
            f"{label} has a gap of {steps[worst]:g} s {place(worst)} at a sampling period of "
            f"{period:g} s, about {float(steps[worst]) / period - 1:.0f} samples lost; {cure}."
        )
    if abs(steps[worst] - period) > 0.01 * period:
        raise InputError(
            f"{label} is jittery: an interval of {steps[worst]:g} s {place(worst)} at a sampling "
            f"period of {period:g} s is off by {100 * abs(steps[worst] / period - 1):.2g} %, more "
            "than 1 %; pass resample='auto' for a uniform grid, or write the time with more digits."
        )
    mean = float(t[-1] - t[0]) / (len(t) - 1)
    # Times in a file are rounded; a short number within their error is the period that was set.
    plain = float(f"{mean:.6g}")
    return plain if abs(plain - mean) < 1e-7 * mean else mean


def initial_samples(n_init: int | None, N: int, Ts: float) -> int:
    """Samples at the start that a model may use; by default 0.2 s, but at least 10 and at most a quarter."""
    if n_init is None:
        return max(1, min(max(10, round(0.2 / Ts)), N // 4))
    given = real(n_init)
    if not (1 <= given < N and given == int(given)):
        raise InputError(
            f"Argument `n_init` must be a whole number from 1 and smaller than the recording, "
            f"but is {shown(n_init)} of {N} samples; 0.2 s are {round(0.2 / Ts)} samples."
        )
    return int(given)


def labels(
    channels: str | Sequence[str] | None, units: str | Sequence[str] | None, width: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the outputs; by default the names of the flexible joint, in radians."""
    default = ("theta", "alpha")[:width] if width <= 2 else ()
    names = _tuple(default if channels is None else channels)
    each = _tuple(("rad",) * width if units is None else units)
    if not all(isinstance(word, str) for word in (*names, *each)):
        raise InputError(
            "Arguments `channels` and `units` must be words, but one of them is not; write for instance "
            "channels=('theta', 'alpha'), units=('rad', 'rad')."
        )
    if not len(set(names)) == len(names) == len(each) == width:
        raise InputError(
            f"Arguments `channels` and `units` must have a name of its own and a unit for each of "
            f"the {width} columns of `y`, but are {names} and {each}; give them in order."
        )
    return names, each


def _tuple(words: Any) -> tuple[Any, ...]:
    return (words,) if (given := entries(words)) is None else given


def known_resolution(
    given: Mapping[str, float | None] | None, channels: Sequence[str]
) -> Mapping[str, float | None]:
    """Channel -> quantisation step, checked: a positive number, or None for a channel without a step."""
    if not (given is None or isinstance(given, Mapping)):
        raise InputError(
            f"Argument `resolution` must give the step of each channel, but is {shown(given)}; write for "
            "instance {'theta': 0.0015}."
        )
    for name, step in (given or {}).items():
        if name not in channels:
            raise InputError(
                f"Argument `resolution` names {shown(name)}, but the recording has the channels "
                f"{', '.join(channels)}; name one of these."
            )
        if step is not None:
            positive(step, f"resolution[{name!r}]", "", "0.0015")
    return given or {}


def known_constants(given: Mapping[str, float] | None) -> Mapping[str, float]:
    """Parameter name -> known value, checked: each is a finite number."""
    found = {}
    if not (given is None or isinstance(given, Mapping)):
        raise InputError(
            f"Argument `constants` must give a value for each name, but is {shown(given)}; write for "
            "instance constants={'hub.position_servo.gain': 400.0}."
        )
    for name, value in (given or {}).items():
        number = real(value)
        if not isinstance(name, str) or not math.isfinite(number):
            raise InputError(
                f"The recording was given the constant {shown(name)} with the value {shown(value)}, but it "
                "needs the full name of a parameter and a finite number; write for instance "
                "constants={'hub.position_servo.gain': 400.0}."
            )
        found[name] = number
    return found


_UNIT_BEHIND = re.compile(r"(.*\S)\s*[\[(]\s*([^\[\]()]*[^\W\d][^\[\]()]*?|°)\s*[\])]")


def name_and_unit(name: str) -> tuple[str, str]:
    """The name of a column or a signal, and the unit in brackets after it.

    >>> name_and_unit("Theta [deg]"), name_and_unit("log[0]"), name_and_unit("u")
    (('Theta', 'deg'), ('log[0]', ''), ('u', ''))
    """
    found = _UNIT_BEHIND.fullmatch(name.strip())
    return (found[1], found[2]) if found else (name.strip(), "")


DEGREES = ("deg", "degs", "degree", "degrees", "degré", "degrés", "grados", "gradi", "°", "º")
"""Spellings of degrees in lower case; `grad` is none, which is German for a degree and English for a gon."""


def in_radians(unit: str) -> str | None:
    """The unit in radians of an angle, a speed or an acceleration that is in degrees; None for other units.

    >>> in_radians("deg"), in_radians("deg/s"), in_radians("rad"), in_radians("m")
    ('rad', 'rad/s', None, None)
    """
    angle, slash, time = unit.partition("/")
    return f"rad{slash}{time}" if angle.strip().lower() in DEGREES else None


UNIT_SIZES = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "µrad": 1e-6, "μrad": 1e-6},
}
"""Unit of a motion -> this unit and those with a prefix, with their sizes in it."""

TURNS_PER_MINUTE = ("rpm", "1/min", "u/min", "r/min", "rev/min")
"""Spellings of revolutions per minute in lower case."""


def unit_factor(given: str, wanted: str) -> float | None:
    """Factor from one unit of a length, an angle or their speeds to another; None for other units.

    Degrees are not among them, see `in_radians`.

    >>> unit_factor("mm/s", "m/s"), unit_factor("m", "m"), unit_factor("mm", "rad"), unit_factor("V", "V")
    (0.001, 1.0, None, None)
    >>> unit_factor("rpm", "rad/s") * 60 / (2 * math.pi)
    1.0
    """
    one, other = _in_base(given), _in_base(wanted)
    return one[1] / other[1] if one and other and one[0] == other[0] else None


def _in_base(unit: str) -> tuple[str, float] | None:
    """The unit without a prefix, and the size in it; None for a unit that is not of a length or an angle."""
    if unit.lower() in TURNS_PER_MINUTE:
        return "rad/s", 2 * math.pi / 60
    motion, slash, time = unit.partition("/")
    for base, sizes in UNIT_SIZES.items():
        if motion.strip() in sizes:
            return base + slash + time, sizes[motion.strip()]
    return None


def known_signals(
    given: Mapping[str, Any] | None, u: Float[np.ndarray, " N"], taken: Sequence[str]
) -> Mapping[str, Float[np.ndarray, " N"]]:
    """Signal name -> a value for each sample of the input, in the precision of the input, read-only.

    Args:
        given: The argument that was given.
        u: Input.
        taken: Names of the input and of the outputs.

    Raises:
        InputError: it is no mapping, a name is not valid, or a signal does not have the length of the input.

    >>> known_signals({"base": [0.1, 0.2]}, np.zeros(3), ())
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Signal 'base' must have one value for each of the 3 samples, but has the \
shape (2,); give each signal an array of its own that is cut to these samples.
    """
    if not (given is None or isinstance(given, Mapping)):
        raise InputError(
            f"Argument `signals` must give the samples of each signal by its name, but is {shown(given)}; "
            "write for instance signals={'acceleration of the base [m/s^2]': samples}."
        )
    found = {}
    for name, values in (given or {}).items():
        named = isinstance(name, str) and name == name.strip() != "" and name.isprintable()
        if not named or name in taken:
            what = " of the input or of a channel" if name in taken else ""
            raise InputError(
                f"A signal was given the name {shown(name)}{what}, but it needs one line of text of its own, "
                "with the unit in brackets behind; write for instance 'acceleration of the base [m/s^2]'."
            )
        x = real_numbers(values, f"Signal {name!r}")
        if x.shape != u.shape:
            raise InputError(
                f"Signal {name!r} must have one value for each of the {len(u)} samples, but has the shape "
                f"{x.shape}; give each signal an array of its own that is cut to these samples."
            )
        found[name] = np.array(x, dtype=u.dtype)
        finite(found[name], f"Signal {name!r}")
        found[name].setflags(write=False)
    return found
