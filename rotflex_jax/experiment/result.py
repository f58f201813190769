"""Results: the input to play next, its expected evidence and predicted motion; sequential experiments."""

import dataclasses
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.experiment.standard_inputs import Limits
from rotflex_jax.mechanism.quantity import input_word
from rotflex_jax.recording import Recording
from rotflex_jax.text.files import write_file
from rotflex_jax.text.markup import bullets, card, paragraph, table
from rotflex_jax.text.numbers import json_numbers, one_line, readable


def voltage_file(
    path: str | os.PathLike[str],
    u: Float[np.ndarray, " N"],
    Ts: float,
    purpose: str = "",
    unit: str = "V",
) -> Path:
    """Write a voltage to play: a comment with the units, then `t,voltage`; another input is `t,input [unit]`.

    Args:
        path: Path of the file.
        u: Voltage [V], or input in the unit `unit`.
        Ts: Sampling period [s].
        purpose: Purpose of the voltage, for the comment.
        unit: Unit of the input.

    Raises:
        InputError: The folder does not exist, or the file cannot be written; an existing file stays as it is.
    """
    path = Path(path)
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(
            f"{path} cannot be written, since it is a folder or in one that does not exist; name a file "
            "in a folder that is there."
        )
    word = input_word(unit)
    head = f"# t in s, {word} in {unit}, each held for {Ts:g} s{'; ' * bool(purpose)}{purpose}\n"
    head += f"t,{word}" if unit == "V" else f"t,{word} [{unit}]"
    rows = np.column_stack([Ts * np.arange(len(u)), u])
    form = ["%.15g", "%.17g"]
    np.savetxt(text := io.StringIO(), rows, fmt=form, delimiter=",", header=head, comments="")
    return write_file(path, text.getvalue())


def json_limits(limits: Limits) -> dict[str, float | None]:
    """Limits as plain JSON; None for a quantity without a limit."""
    return json_numbers(dataclasses.asdict(limits))


def _predicted(peaks: dict[str, float], units: tuple[str, ...]) -> str:
    """Largest predicted outputs in words, in the units of tables and limits, such as deg and mm."""
    listed = ((name, *readable(peak, unit)) for (name, peak), unit in zip(peaks.items(), units, strict=True))
    return ", ".join(f"{name} to {value:.3g} {unit}".rstrip() for name, value, unit in listed)


@dataclasses.dataclass(frozen=True)
class Rated:
    """One input and its expected evidence.

    Attributes:
        input: `noise`, `multisine`, `prbs`, `steps`, `sweep`, or `design`.
        setting: Parameters of the input in words.
        nats: Log-likelihood by which the true model is expected to win, whichever it is [nat].
        each: This log-likelihood if the first model is true, and if the second model is true [nat].
        voltage: Peak voltage [V], or peak input in the unit of the input.
        slew: Fastest change [V/s].
        peaks: Channel -> largest predicted |output| [unit of the output].
        settled: Whether the fits of the rival models have converged.
    """

    input: str
    setting: str
    nats: float
    each: tuple[float, float]
    voltage: float
    slew: float
    peaks: dict[str, float]
    settled: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return dataclasses.asdict(self) | {"each": list(self.each)}


@dataclasses.dataclass(frozen=True, eq=False)
class Experiment:
    """What to record next to distinguish two effects.

    Attributes:
        separates: The two effects as `name@port`.
        chosen: The input and its expected evidence.
        u: Voltage [V], held over each sample.
        Ts: Sampling period [s].
        period: Time after which the input repeats [s]; its whole length if it does not repeat.
        table: Standard inputs and designs, best first.
        parameters: Effect -> its parameters.
        outputs: Runs if the first effect is true, and if the second effect is true.
        differences: Residuals of the rival fitted to each run, in units of the outputs.
        channels: Names of the outputs.
        units: Units of the outputs.
        input_unit: Unit of the input.
        noise: Channel -> standard deviation of the sensor noise.
        limits: Limits of the machine.
        notes: What the user must know before playing the input.
    """

    separates: tuple[str, str]
    chosen: Rated
    u: Float[np.ndarray, " N"]
    Ts: float
    period: float
    table: tuple[Rated, ...]
    parameters: dict[str, dict[str, float]]
    outputs: Float[np.ndarray, "2 N C"]
    differences: Float[np.ndarray, "2 N C"]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    input_unit: str
    noise: dict[str, float]
    limits: Limits
    notes: tuple[str, ...] = ()

    @property
    def t(self) -> Float[np.ndarray, " N"]:
        """Time of every sample [s]."""
        return self.Ts * np.arange(len(self.u))

    @property
    def input(self) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Voltage [V] and time [s]."""
        return self.u, self.t

    @property
    def evidence(self) -> dict[str, float]:
        """Expected log-likelihood in total [nat], and per second of the experiment."""
        seconds = len(self.u) * self.Ts
        return {"nats": self.chosen.nats, "nats_per_second": self.chosen.nats / seconds}

    @property
    def standard(self) -> Rated:
        """The best of the standard inputs."""
        return next(r for r in self.table if r.input != "design")

    def save_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the input: a comment with the units, then `t,voltage`.

        After you add the measured columns `theta` and `alpha`, `rotflex_jax.load` reads the file.

        Raises:
            InputError: The folder does not exist, or the file cannot be written; an old one stays.
        """
        purpose = f"tells {one_line(' from '.join(self.separates))}"
        return voltage_file(path, self.u, self.Ts, purpose, self.input_unit)

    def plot(self) -> Any:
        """Figure: input over time, its spectrum, and predicted difference of the models with sensor noise."""
        from rotflex_jax.experiment.figure import experiment_figure  # takes long to import

        return experiment_figure(self)

    def to_dict(self, file: str | None = None) -> dict[str, Any]:
        """Plain JSON types; `file` is where the input was written."""
        return {
            "separates": list(self.separates),
            "input": self.chosen.input,
            "setting": self.chosen.setting,
            "file": file,
            "seconds": len(self.u) * self.Ts,
            "Ts": self.Ts,
            "evidence": self.evidence,
            "expected": self.chosen.to_dict(),
            "table": [r.to_dict() for r in self.table],
            "effects": self.parameters,
            "limits": json_limits(self.limits),
            "noise": self.noise,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        c, rate = self.chosen, self.evidence["nats_per_second"]
        first, second = self.separates
        unit, peaks = self.input_unit, _predicted(c.peaks, self.units)
        lines = [
            f"To tell {first} from {second}: {c.input}, {c.setting}, {len(self.u) * self.Ts:g} s",
            f"  expected evidence {c.nats:.3g} nats, {rate:.3g} per second; "
            f"best standard input {self.standard.input} ({self.standard.setting}): {self.standard.nats:.3g}",
            f"  {input_word(unit)} to {c.voltage:.3g} {unit}, slew to {c.slew:.3g} {unit}/s, "
            f"{peaks} predicted",
        ]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


@dataclasses.dataclass(frozen=True, eq=False)
class Segment:
    """The next segment on the rig: the input after which a wrong answer is least probable.

    Attributes:
        rivals: Names of the models.
        u: Voltage [V], held over each sample.
        Ts: Sampling period [s].
        input: `noise`, `multisine`, `prbs`, `steps`, `sweep`, or `design`.
        setting: Parameters of the input in words.
        nats: Entry (h, r): log-likelihood by which h is expected to win over r if h is true, after
            `repeats` repetitions of the input, for the worst of a few draws of the parameters [nat].
        expected_error: Upper bound of the probability of a wrong answer after these repetitions; at most the
            probability of a wrong answer before them.
        probabilities: Probabilities of the models before the segment.
        repeats: Number of repetitions of the input in `nats` and `expected_error`.
        peaks: Channel -> largest predicted |output|.
        table: Kind, setting and worth [nat] of the best inputs that were compared, best first.
        tried: Number of inputs that were compared.
        limits: Limits of the machine.
        outputs: Outputs predicted by each model.
        channels: Names of the outputs.
        units: Units of the outputs.
        input_unit: Unit of the input.
    """

    rivals: tuple[str, ...]
    u: Float[np.ndarray, " N"]
    Ts: float
    input: str
    setting: str
    nats: Float[np.ndarray, "H H"]
    expected_error: float
    probabilities: tuple[float, ...]
    repeats: float
    peaks: dict[str, float]
    table: tuple[tuple[str, str, float], ...]
    tried: int
    limits: Limits
    outputs: Float[np.ndarray, "H N C"]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    input_unit: str

    @property
    def t(self) -> Float[np.ndarray, " N"]:
        """Time of every sample [s]."""
        return self.Ts * np.arange(len(self.u))

    def save_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the input: a comment with the units, then `t,voltage`.

        Raises:
            InputError: The folder does not exist, or the file cannot be written; an old one stays.
        """
        purpose = f"tells {one_line(' from '.join(self.rivals))}"
        return voltage_file(path, self.u, self.Ts, purpose, self.input_unit)

    def plot(self) -> Any:
        """Figure: the input, and the prediction of each model less the mean of all predictions."""
        from rotflex_jax.experiment.figure import segment_figure  # takes long to import

        return segment_figure(self)

    def to_dict(self, file: str | None = None) -> dict[str, Any]:
        """Plain JSON types; `file` is where the input was written."""
        return {
            "separates": list(self.rivals),
            "input": self.input,
            "setting": self.setting,
            "file": file,
            "seconds": len(self.u) * self.Ts,
            "Ts": self.Ts,
            "nats": self.nats.tolist(),
            "expected_error": self.expected_error,
            "probabilities": list(self.probabilities),
            "repeats": self.repeats,
            "peaks": dict(self.peaks),
            "table": [{"input": k, "setting": s, "nats": n} for k, s, n in self.table],
            "tried": self.tried,
            "limits": json_limits(self.limits),
        }

    def __str__(self) -> str:
        unit, peaks = self.input_unit, _predicted(self.peaks, self.units)
        seconds = len(self.u) * self.Ts
        ahead = f"{self.repeats * seconds:g} s of it" + (", repeated," if self.repeats > 1 else "")
        return (
            f"To tell {', '.join(self.rivals)} apart: {self.input}, {self.setting}, {seconds:g} s\n"
            f"  after {ahead} a wrong answer has at most the probability {self.expected_error:.2g}\n"
            f"  {input_word(unit)} to {np.max(np.abs(self.u)):.3g} {unit}, {peaks} predicted; "
            f"best of {self.tried} inputs"
        )


@dataclasses.dataclass(frozen=True)
class SequentialStep:
    """One segment of a sequential experiment, after it was played.

    Attributes:
        seconds: Time on the rig so far [s].
        input: Kind of the input.
        setting: Parameters of the input in words.
        voltage: Peak voltage [V].
        expected_error: Upper bound of the probability of a wrong answer, as expected before the segment.
        probabilities: Name -> probability of each model after the segment.
        misfit: Residual of the best model in units of the noise, at least 1.
    """

    seconds: float
    input: str
    setting: str
    voltage: float
    expected_error: float
    probabilities: dict[str, float]
    misfit: float

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class SequentialResult:
    """Result of a sequential experiment.

    Attributes:
        rivals: Names of the models.
        verdict: `decided`, `time is up`, `not distinguishable`, or `going on`.
        probabilities: Name -> probability of each model.
        prior: Name -> probability of each model before the first segment.
        error: Probability of a wrong answer at which the experiment stops.
        max_seconds: Time at which the experiment stops [s].
        seconds: Time on the rig [s].
        history: One entry for each segment.
        runs: Recordings of the segments, each run without a pause.
        limits: Limits of the machine.
        reason: Reason if no experiment would decide, else empty.
        notes: What the user must know.
    """

    rivals: tuple[str, ...]
    verdict: str
    probabilities: dict[str, float]
    prior: dict[str, float]
    error: float
    max_seconds: float
    seconds: float
    history: tuple[SequentialStep, ...]
    runs: tuple[Recording, ...]
    limits: Limits
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def input_unit(self) -> str:
        """Unit of the input."""
        return self.runs[0].input_unit if self.runs else "V"

    @property
    def best(self) -> str:
        """The most probable model."""
        return max(self.probabilities, key=lambda n: self.probabilities[n])

    @property
    def standing(self) -> str:
        """Probabilities in words."""
        ordered = sorted(self.probabilities.items(), key=lambda item: -item[1])
        listed = ", ".join(f"{n} {100 * p:.3g} %" for n, p in ordered)
        return f"after {self.seconds:g} s: {listed}"

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        if self.verdict == "decided":
            others = " or ".join(n for n in self.rivals if n != self.best)
            percent = min(100 * self.probabilities[self.best], 99.99)
            return (
                f"It is {self.best} rather than {others}: probability {percent:.4g} % "
                f"after {self.seconds:g} s on the rig."
            )
        if self.verdict == "not distinguishable":
            return self.reason
        if self.verdict == "time is up":
            return f"{self.seconds:g} s on the rig did not decide ({self.standing.split(': ', 1)[1]})."
        return f"Nothing is decided yet, {self.standing}."

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "rivals": list(self.rivals),
            "verdict": self.verdict,
            "best": self.best,
            "sentence": self.sentence,
            "probabilities": dict(self.probabilities),
            "prior": dict(self.prior),
            "error": self.error,
            "seconds": self.seconds,
            "max_seconds": self.max_seconds,
            "history": [s.to_dict() for s in self.history],
            "limits": json_limits(self.limits),
            "notes": list(self.notes),
        }

    def plot(self) -> Any:
        """Figure: probabilities over the time on the rig, the voltage, and the recorded outputs."""
        from rotflex_jax.experiment.figure import sequential_figure  # takes long to import

        return sequential_figure(self)

    def _repr_html_(self) -> str:
        """Verdict, and the probabilities after each segment."""
        rows = [
            (
                f"{s.seconds:g}",
                f"{s.input}, {s.setting}",
                f"{s.voltage:.3g}",
                *(f"{100 * s.probabilities[n]:.3g}" for n in self.rivals),
            )
            for s in self.history
        ]
        return card(
            self.verdict.capitalize(),
            paragraph(self.sentence),
            table(
                ("on the rig [s]", "input", f"peak [{self.input_unit}]", *(f"{n} [%]" for n in self.rivals)),
                rows,
                words=2,
            ),
            bullets(self.notes),
        )

    def __str__(self) -> str:
        lines = [self.sentence]
        for s in self.history:
            listed = ", ".join(f"{n} {100 * p:.3g} %" for n, p in s.probabilities.items())
            lines.append(
                f"  {s.seconds:6g} s  {s.input}, {s.setting}, {s.voltage:.3g} {self.input_unit}: {listed}"
            )
        return "\n".join([*lines, *(f"  {n}" for n in self.notes)])
