"""A recording: the measured input and outputs of one experiment, its digest, and lists of recordings."""

import copy
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import entries, number, real, shown
from rotflex_jax.errors import InputError
from rotflex_jax.recording import quality
from rotflex_jax.recording.quality import Finding, quantisation_step
from rotflex_jax.recording.samples import (
    aligned,
    finite,
    initial_samples,
    known_constants,
    known_resolution,
    known_signals,
    labels,
    name_and_unit,
    real_numbers,
    sampling_period,
)
from rotflex_jax.text import svg
from rotflex_jax.text.colours import FINAL
from rotflex_jax.text.markup import bullets, card, paragraph, picture, table
from rotflex_jax.text.numbers import plain_number, readable


def _known_remarks(given: Any) -> tuple[Finding, ...]:
    """The findings that the maker of the recording gives, checked."""
    listed: tuple[Any, ...] = (given,)
    if isinstance(given, Sequence) and not isinstance(given, str):
        listed = tuple(given)
    for entry in listed:
        if not isinstance(entry, Finding):
            raise InputError(
                f"Argument `remarks` must be a list of findings, but has {shown(entry)}; give those "
                "of another recording (`recording.findings`), or leave it out."
            )
    return listed


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Recording:
    """One experiment: the input, the outputs and the sampling period, uniformly sampled.

    `u[k]` and `signals[name][k]` are held over `[k Ts, (k + 1) Ts)`; `y[k]` is measured at the start of this
    interval.

    Not for unevenly sampled data: resample them first, with a method that you can justify.

    Args:
        u: input (N,) [input_unit].
        y: outputs (N, C), or (N,) for one output [units].
        Ts: sampling period [s].
        channels: names of the outputs; by default `("theta", "alpha")` for two, `("theta",)` for one.
        units: units of the outputs; radians by default.
        input_name: name of the input.
        input_unit: unit of the input.
        n_init: number of samples at the start that a model may use and that are not scored; by default 0.2 s,
            but at least 10 samples and at most a quarter of the recording.
        source: where the recording comes from.
        start: time of the first sample [s].
        accept: faults to accept, which then are findings of severity `warning`: `short`,
            `constant_input`, `constant`, `saturated`, `units`, `absolute`, `swapped`, `huge`, `slow`,
            `wrapped`, `outliers`, `frozen`.
        resolution: channel -> its quantisation step, if it is known; otherwise it is found from the data.
        continues: the recording that ended where this one starts, if any. A part of a recording has the part
            before it. States that no sensor measures (the temperature of a motor) continue from there.
        remarks: findings on the source, such as lost rows. Parts of the recording keep them.
        constants: full name of a parameter -> its value, for values that are known in this recording and may
            differ in another, such as the gain of a servo. A model simulates this recording with these
            values, and a fit holds them. Names that a model does not have are ignored.
        signals: name with unit in brackets -> samples (N,), for measured quantities other than the input that
            act on the machine, such as the acceleration of the base (a measured disturbance). They are held
            between samples like the input.

    Raises:
        InputError: the data are not valid.

    >>> u = np.sin(np.arange(100.0))
    >>> recording = Recording(u=u, y=0.01 * np.cumsum(u), Ts=0.01, source="an integrator")
    >>> recording
    Recording(100 samples, 1 s at 100 Hz, voltage [V] to theta [rad], an integrator)
    >>> train, test = recording.split(0.7)
    >>> train.N, test.N, round(test.start, 9)
    (70, 30, 0.7)
    """

    u: Float[np.ndarray, " N"]
    y: Float[np.ndarray, "N C"]
    Ts: float
    channels: tuple[str, ...]
    units: tuple[str, ...]
    input_name: str
    input_unit: str
    n_init: int
    source: str
    start: float
    accept: tuple[str, ...]
    resolution: Mapping[str, float | None]
    continues: "Recording | None"
    constants: Mapping[str, float]
    remarks: tuple[Finding, ...]
    signals: Mapping[str, Float[np.ndarray, " N"]]

    def __init__(
        self,
        u: Any,
        y: Any,
        Ts: Any,
        channels: str | Sequence[str] | None = None,
        units: str | Sequence[str] | None = None,
        input_name: str = "voltage",
        input_unit: str = "V",
        n_init: int | None = None,
        source: str = "",
        start: float = 0.0,
        accept: str | Sequence[str] = (),
        resolution: Mapping[str, float | None] | None = None,
        continues: "Recording | None" = None,
        constants: Mapping[str, float] | None = None,
        remarks: Sequence[Finding] = (),
        signals: Mapping[str, Any] | None = None,
    ) -> None:
        u, y = aligned(real_numbers(u, "Argument `u`"), real_numbers(y, "Argument `y`"))
        Ts = sampling_period(Ts)
        names, units = labels(channels, units, y.shape[1])
        finite(u, f"Input {input_name!r}")
        for x, name in zip(y.T, names, strict=True):
            finite(x, f"Channel {name!r}")
        known = known_resolution(resolution, names)
        for what, word in (("input_name", input_name), ("input_unit", input_unit), ("source", source)):
            if not isinstance(word, str):
                raise InputError(f"Argument `{what}` must be text, but is {shown(word)}; give a word.")
        if not (continues is None or isinstance(continues, Recording)):
            raise InputError(
                f"Argument `continues` must be the recording before this one, but is {shown(continues)}; "
                "leave it out."
            )
        values = {
            "u": u,
            "y": y,
            "Ts": Ts,
            "channels": names,
            "units": units,
            "input_name": input_name,
            "input_unit": input_unit,
            "n_init": initial_samples(n_init, len(u), Ts),
            "source": source,
            "start": number(start, "start", unit="s", example="0.0"),
            "accept": quality.acceptable(accept),
            "resolution": {
                name: known[name] if name in known else quantisation_step(x)
                for x, name in zip(y.T, names, strict=True)
            },
            "continues": continues,
            "constants": known_constants(constants),
            "remarks": _known_remarks(remarks),
            "signals": known_signals(signals, u, (input_name, *names)),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        # A part of a recording accepts all faults: its findings are computed when they are needed.
        if self.accept != quality.ACCEPTABLE:
            quality.refuse(self.findings)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """A copy, or a recording of another process: NumPy does not keep that an array is read-only."""
        for x in (state["u"], state["y"], *state["signals"].values()):
            x.setflags(write=False)
        self.__dict__.update(state)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the quality of the data."""
        names, units = (self.input_name, *self.channels), (self.input_unit, *self.units)
        found = quality.inspect(
            self.u, self.y, self.Ts, names, units, self.resolution, self.accept, self.start
        )
        return (*self.remarks, *found)

    @property
    def N(self) -> int:
        """Number of samples."""
        return len(self.u)

    @property
    def t(self) -> Float[np.ndarray, " N"]:
        """Time of every sample [s]."""
        return self.start + self.Ts * np.arange(self.N)

    @property
    def duration(self) -> float:
        """Time from the first sample to the end of the last [s]."""
        return self.N * self.Ts

    def inputs(self, signals: Iterable[str]) -> Float[np.ndarray, "N m"]:
        """The input and some of the signals, in columns.

        Raises:
            InputError: The recording lacks one of these signals.
        """
        signals = tuple(signals)
        if missing := [name for name in signals if name not in self.signals]:
            has = ", ".join(map(repr, self.signals)) or "none"
            raise InputError(
                f"The signal {missing[0]!r} is needed, but the recording has {has}; give one that has it, or "
                "add it by `recording.with_signals`."
            )
        return np.column_stack([self.u, *(self.signals[name] for name in signals)])

    def channel(self, name: str) -> Float[np.ndarray, " N"]:
        """One output by name.

        Raises:
            InputError: The recording has no such channel.
        """
        return self.y[:, self._column(name)]

    def unit(self, channel: str) -> str:
        """The unit of one output by name.

        Raises:
            InputError: The recording has no such channel.
        """
        return self.units[self._column(channel)]

    def _column(self, channel: str) -> int:
        if not isinstance(channel, str) or channel not in self.channels:
            given = repr(channel) if isinstance(channel, str) else shown(channel)
            raise InputError(f"The recording has no channel {given}; it has {', '.join(self.channels)}.")
        return self.channels.index(channel)

    def slice(self, i: int, j: int) -> "Recording":
        """The samples from `i` up to, but not including, `j`; at least two, of which a model may see one.

        A part that is short, or at rest, is no error: the whole recording has passed the checks.
        """
        ends = [real(end) for end in (i, j)]
        if not all(0 <= end <= self.N and end == int(end) for end in ends) or j - i < 2:
            raise InputError(
                f"A part of the recording must lie within its {self.N} samples and have two or more of them, "
                f"but was asked from {shown(i)} to {shown(j)}; choose 0 <= i and i + 2 <= j <= {self.N}."
            )
        i, j = int(i), int(j)
        part = replace(
            self,
            u=self.u[i:j],
            y=self.y[i:j],
            signals={name: x[i:j] for name, x in self.signals.items()},
            start=self.start + i * self.Ts,
            n_init=min(self.n_init, max(1, (j - i) // 4)),
            accept=quality.ACCEPTABLE,
            # A single sample is no recording that could be continued.
            continues=self.slice(0, i) if i > 1 else self.continues if not i else None,
        )
        return self._made(part)

    def _made(self, part: "Recording") -> "Recording":
        """A recording that was made from this one, marked as a part of the same run."""
        vars(part)["_beginnings"] = self._beginnings
        return part

    @cached_property
    def _beginnings(self) -> dict[int, tuple[int, str]]:
        """Digests of the first samples of the run, by which its parts are known without their samples.

        Number of samples, a power of two -> how many of them differ from the sample before, and the digest.
        """
        if self.continues is not None:
            return self.continues._beginnings
        samples = np.column_stack([self.u, self.y]).astype(float) + 0.0  # one zero, without a sign
        moving = np.any(samples[1:] != samples[:-1], axis=1)
        digest, found, done = hashlib.sha256(repr((self.Ts, samples.shape[1])).encode()), {}, 0
        for n in (2**k for k in range(1, self.N.bit_length())):
            digest.update(samples[done:n].tobytes())
            found[n], done = (int(moving[: n - 1].sum()), digest.hexdigest()), n
        return found

    def split(
        self, share: float | None = None, *, seconds: float | None = None
    ) -> tuple["Recording", "Recording"]:
        """Cuts the recording into two consecutive parts: one for training, one for validation.

        Args:
            share: share of the samples in the first part [-]; 0.7 if neither argument is given.
            seconds: length of the first part [s], instead of `share`.

        Returns:
            The first and the second part.
        """
        if share is not None and seconds is not None:
            raise InputError(
                f"Arguments `share` ({shown(share)}) and `seconds` ({shown(seconds)}) were both given, "
                "but say the same thing; give one of them."
            )
        if seconds is not None:
            wanted = number(seconds, "seconds", unit="s", example="10.0") / self.Ts
        else:
            wanted = self.N * (0.7 if share is None else number(share, "share", example="0.7"))
        if not 2 <= round(min(max(wanted, 0.0), self.N)) <= self.N - 2:
            raise InputError(
                f"Both parts of a split must have two samples or more, but the first would have {wanted:.6g} "
                f"of {self.N}; give a share between 0 and 1, or fewer than {self.duration:g} s."
            )
        return self.slice(0, round(wanted)), self.slice(round(wanted), self.N)

    def decimate(self, k: int) -> "Recording":
        """Every k-th sample: means of the input and of the signals over k samples, outputs unfiltered.

        The mean keeps the impulse of the held input, to first order in `k Ts`. The output is not
        filtered: a filter would have to be part of the model, and angles have almost no content
        above the new Nyquist frequency. Not for outputs with strong noise there, which is aliased.
        Parts of a recording remain parts of one run.

        Args:
            k: factor; samples at the end that do not fill a group of k are left out.
        """
        factor = real(k)
        if not (1 <= factor <= self.N / 2 and factor == int(factor)):
            raise InputError(
                f"Argument `k` must be a whole number from 1 to half of the {self.N} samples, but is "
                f"{shown(k)}; give for instance 2."
            )
        k = int(factor)
        groups, before = self.N // k, self.continues
        # Its last group of samples ends where this recording begins; one group is no recording.
        if before is not None:
            before = before.slice(before.N % k, before.N).decimate(k) if 2 * k <= before.N else None
        u, *acting = (
            x[: groups * k].reshape(groups, k).mean(axis=1) for x in (self.u, *self.signals.values())
        )
        fewer = replace(
            self,
            u=u,
            y=self.y[: groups * k : k],
            signals=dict(zip(self.signals, acting, strict=True)),
            Ts=self.Ts * k,
            n_init=max(1, min(round(self.n_init / k), groups // 4)),
            accept=quality.ACCEPTABLE,
            continues=before,
        )
        return self._made(fewer)

    def with_signals(self, signals: Mapping[str, Any]) -> "Recording":
        """The recording with these signals in place of its own.

        A part of a recording then loses the part before it, which has other signals. Give signals to the
        whole recording before you cut it.

        Args:
            signals: as in `Recording`.

        >>> recording = Recording(u=np.sin(np.arange(100.0)), y=np.cos(np.arange(100.0)), Ts=0.01)
        >>> recording.with_signals({"second motor [A]": np.zeros(100)})
        Recording(100 samples, 1 s at 100 Hz, voltage [V] to theta [rad], beside second motor [A])
        """
        return replace(self, signals=signals, continues=None if signals else self.continues)

    def _repr_html_(self) -> str:
        """Extent, ranges, steps of the sensors, findings, and the measured signals over time."""
        rows, panels = [], []
        outputs = zip(self.channels, self.units, self.y.T, strict=True)
        columns = [(self.input_name, self.input_unit, self.u, None)]
        columns += [(name, unit, values, self.resolution.get(name)) for name, unit, values in outputs]
        columns += [(*name_and_unit(name), values, None) for name, values in self.signals.items()]
        for name, unit, values, step in columns:
            factor, read = readable(1.0, unit)
            low, high = factor * float(np.min(values)), factor * float(np.max(values))
            quantum = "" if step is None else plain_number(factor * step)
            std = plain_number(factor * float(np.std(values)))
            rows.append((name, read, f"{plain_number(low)} … {plain_number(high)}", std, quantum))
            lines = [(factor * np.asarray(values, float), FINAL, "")]
            label = f"{name} [{read}]"  # an axis has room for 15 characters; the table has all
            panels.append(svg.Panel(label if len(label) <= 15 else f"{label[:14]}…", lines))
        rate = f"{self.N} samples, {self.duration:g} s at {1 / self.Ts:g} Hz"
        return card(
            f"Recording{f': {self.source}' if self.source else ''}",
            paragraph(f"{rate}; models may see the first {self.n_init} samples"),
            picture(svg.signals(self.t, panels, "time [s]"), "What was measured over time."),
            table(("signal", "unit", "range", "standard deviation", "sensor step"), rows, words=2),
            bullets(finding.message for finding in self.findings),
        )

    def __repr__(self) -> str:
        pairs = zip(self.channels, self.units, strict=True)
        outputs = ", ".join(f"{name} [{unit}]" for name, unit in pairs)
        beside = f", beside {' and '.join(self.signals)}" if self.signals else ""
        return (
            f"Recording({self.N} samples, {self.duration:.6g} s at {1 / self.Ts:.6g} Hz, "
            f"{self.input_name} [{self.input_unit}] to {outputs}{beside}"
            f"{f', {self.source}' if self.source else ''})"
        )


FEWEST_MOVING = 20
"""Least number of samples that differ from the one before; with fewer, a match may be by chance."""
LEAST_SHARED = 0.25
"""Least share of the shorter recording that two pieces of one recording must have in common."""
_PROBES = 16


def content(recording: Recording) -> tuple[bytes, ...]:
    """Everything in a recording on which a computation can depend, as bytes; not the name of its file."""
    r = recording
    labels = (r.Ts, r.channels, r.units, r.input_name, r.input_unit)
    accepted = quality.IN_DIGESTS if r.accept == quality.ACCEPTABLE else r.accept
    labels = (*labels, r.n_init, r.start, accepted, sorted(r.resolution.items()))
    labels = (*labels, sorted(r.constants.items()), *sorted(r.signals))
    arrays = (r.u, r.y, *(r.signals[name] for name in sorted(r.signals)))
    own = (repr(labels).encode(), *(np.ascontiguousarray(a).tobytes() for a in arrays))
    # States that no sensor measures start from the end of a run over the recording before.
    return own if r.continues is None else (*own, *content(r.continues))


def digest_of(*parts: bytes) -> str:
    """SHA-256 of several parts, each preceded by its length."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "big") + part)
    return found.hexdigest()


def digest_of_recordings(recordings: Sequence[Recording]) -> str:
    """Digest of everything in several recordings on which a fit can depend, in their order."""
    return digest_of(*(part for r in recordings for part in content(r)))


def shared_samples(a: Recording, b: Recording) -> int:
    """How many samples two recordings have in common because both were cut from one; 0 if they were not.

    They count as cut from one if some shift makes the whole stretch in which both have samples identical,
    number for number, in input and outputs. Standstill proves nothing: the first `LEAST_SHARED` of the
    shorter recording must have `FEWEST_MOVING` samples that differ from the sample before.
    """
    # Periods that are computed from time stamps differ a little between pieces of one file.
    if not math.isclose(a.Ts, b.Ts, rel_tol=0.01) or a.y.shape[1] != b.y.shape[1]:
        return 0
    first, second = (np.column_stack([r.u, r.y]) + 0.0 for r in (a, b))  # one zero, without a sign
    return max(_shared_from(first, second), _shared_from(second, first))


def _shared_from(a: np.ndarray, b: np.ndarray) -> int:
    """Samples of the longest stretch that begins with the first sample of `b`."""
    least = max(int(np.ceil(LEAST_SHARED * min(len(a), len(b)))), FEWEST_MOVING)
    if least > min(len(a), len(b)):
        return 0
    moving = 1 + np.flatnonzero(np.any(b[1:least] != b[: least - 1], axis=1))
    if len(moving) < FEWEST_MOVING:
        return 0
    # A few moving samples are compared first; they leave almost no wrong shift to be compared as a whole.
    count, at = len(a) - least + 1, int(moving[0])
    shifts = np.flatnonzero(a[at : at + count, -1] == b[at, -1])
    for at in moving[np.linspace(0, len(moving) - 1, _PROBES).astype(int)]:
        shifts = shifts[np.all(a[shifts + at] == b[at], axis=1)]
    for shift in shifts:
        length = min(len(a) - shift, len(b))
        same = np.array_equal(a[shift : shift + least], b[:least])
        if same and np.array_equal(a[shift : shift + length], b[:length]):
            return int(length)
    return 0


def _one_after_the_other(a: Recording, b: Recording) -> bool:
    """Whether one part is known to end before the other begins; a periodic signal may look the same."""
    first, second = sorted((a, b), key=lambda r: r.start)
    before = second.continues
    if before is None or first.start + (first.N - 0.5) * first.Ts > second.start:
        return False
    at = round((first.start - before.start) / before.Ts)
    here = slice(at, at + first.N)
    return at >= 0 and np.array_equal(before.u[here], first.u) and np.array_equal(before.y[here], first.y)


def of_one_run(a: Recording, b: Recording) -> bool:
    """Whether two recordings are parts of one run, or the same one.

    Parts that `slice` and `decimate` have made know the beginning of their run, and so does a recording that
    continues another one. Two different runs may begin with the same standstill, so the common beginning must
    have `FEWEST_MOVING` samples that differ from the sample before.
    """
    common = max(a._beginnings.keys() & b._beginnings.keys(), default=None)
    if common is None or a._beginnings[common] != b._beginnings[common]:
        return False
    return a._beginnings[common][0] >= FEWEST_MOVING


# Attributes that two parts of one run of one machine have in common.
_OF_ONE_MACHINE = ("Ts", "channels", "units", "input_name", "input_unit", "constants")


def common_signals(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Names of the signals that all recordings have."""
    return tuple(name for name in recordings[0].signals if all(name in r.signals for r in recordings))


def joined(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Recordings in their order, with adjoining parts of one run joined to one recording.

    The joined recording has the position of the part that is first in time.
    """
    found = list(recordings)
    for r in sorted(recordings, key=lambda r: r.start):
        here = next(k for k, a in enumerate(found) if a is r)
        before = next((k for k, a in enumerate(found) if k != here and _goes_on(a, r)), None)
        if before is None:
            continue
        a = found[before]
        u, y = (np.concatenate(pair) for pair in ((a.u, r.u), (a.y, r.y)))
        acting = {name: np.concatenate([x, r.signals[name]]) for name, x in a.signals.items()}
        found[before] = replace(a, u=u, y=y, signals=acting, accept=quality.ACCEPTABLE)
        del found[here]
    return tuple(found)


def _goes_on(a: Recording, b: Recording) -> bool:
    """Whether `b` is known to begin where `a` ends, as parts of one run of the same machine."""
    before = b.continues
    if before is None or a.signals.keys() != b.signals.keys():
        return False
    if any(getattr(a, n) != getattr(b, n) for n in _OF_ONE_MACHINE):
        return False
    n = min(a.N, before.N)  # `a` may be joined already, and longer than the part that `b` continues
    ends = math.isclose(a.start + a.N * a.Ts, b.start, abs_tol=0.5 * a.Ts)
    return ends and np.array_equal(before.u[-n:], a.u[-n:]) and np.array_equal(before.y[-n:], a.y[-n:])


def check_apart(fitted: Sequence[Recording], unseen: Sequence[Recording], purpose: str, reason: str) -> None:
    """Refuses held-out recordings that share samples with recordings of a fit.

    Args:
        fitted: Recordings that a fit uses.
        unseen: Recordings that the fit must not use.
        purpose: Purpose of the two groups, such as "to fit and to validate".
        reason: Why the groups must differ, and what to give instead.

    Raises:
        InputError: A recording is in both groups, or the groups share samples of one measurement.
    """
    for a in fitted:
        for b in unseen:
            if a is not b and _one_after_the_other(a, b):
                continue
            same = a is b or (a.Ts == b.Ts and np.array_equal(a.u, b.u) and np.array_equal(a.y, b.y))
            if same:
                raise InputError(f"The same recording was given {purpose}, but {reason}.")
            if shared := shared_samples(a, b):
                raise InputError(
                    f"Recordings with the same {shared} samples were given {purpose}, but {reason} (a signal "
                    "that repeats itself without noise looks the same)."
                )


SHORTEST_TO_FIT = 11
"""Least number of samples from which a fit can estimate the sensor noise: the width of the local polynomials
that it uses for this."""


def listed(recordings: Any, name: str = "recordings", shortest: int = 1) -> tuple[Recording, ...]:
    """One recording, or several in any iterable, as a tuple.

    Args:
        recordings: The argument that was given.
        name: Name of the argument.
        shortest: Least number of samples of each recording.

    Raises:
        InputError: There is no recording, an entry is no recording, or a recording is too short.

    >>> listed("run.csv", "train")
    Traceback (most recent call last):
        ...
    rotflex_jax.errors.InputError: Argument `train` must be a Recording or a list of them, but is 'run.csv'; \
read a file with rotflex_jax.load.
    """
    if isinstance(recordings, Recording):
        found: tuple[Any, ...] = (recordings,)
    else:
        found = (None,) if (given := entries(recordings)) is None else given
    wrong = [(k, r) for k, r in enumerate(found, 1) if not isinstance(r, Recording)]
    if wrong:
        number, entry = wrong[0]
        several = len(found) > 1 or isinstance(recordings, list | tuple)
        what = f"has {shown(entry)} as entry {number}" if several else f"is {shown(recordings)}"
        raise InputError(
            f"Argument `{name}` must be a Recording or a list of them, but {what}; "
            "read a file with rotflex_jax.load."
        )
    if not found:
        raise InputError(f"No recording was given as `{name}`, but at least one is needed; pass a Recording.")
    for r in found:
        if shortest > r.N:
            raise InputError(
                f"A recording in `{name}` has {r.N} samples, but at least {shortest} are needed to tell "
                "the motion from the noise of the sensors; give a longer one."
            )
    return found


def listed_if_given(recordings: Any, name: str, shortest: int = 1) -> tuple[Recording, ...]:
    """As `listed`, for an argument that may be empty."""
    none = isinstance(recordings, Sequence) and not len(recordings)
    return () if none else listed(recordings, name, shortest)


def with_findings_on_file(recording: Recording, found: Sequence[Finding]) -> Recording:
    """The recording with further findings on the file as a whole, which its parts do not keep."""
    with_them = copy.copy(recording)
    vars(with_them)["findings"] = (*recording.findings, *found)
    return with_them


def single(recording: Any, name: str = "recording", shortest: int = 1) -> Recording:
    """The one recording that was given, alone or in a list.

    Args:
        recording: The argument that was given.
        name: Name of the argument.
        shortest: Least number of samples of the recording.

    Raises:
        InputError: There is no recording or more than one, it is no recording, or it is too short.
    """
    found = listed(recording, name, shortest)
    if len(found) != 1:
        raise InputError(
            f"{len(found)} recordings were given as `{name}`, but one is needed; give one at a time."
        )
    return found[0]
