"""The next experiment: the input to play, the evidence it is expected to give, and the predicted motion."""

import dataclasses
import io
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.experiment.standard_inputs import Limits
from rotflex_jax.text.files import write_file
from rotflex_jax.text.plain import one_line


@dataclasses.dataclass(frozen=True)
class Rated:
    """One input and the evidence that it is expected to give.

    Attributes:
        input: `noise`, `multisine`, `prbs`, `steps`, `sweep`, or `design`.
        setting: Its parameters in words.
        nats: Log-likelihood by which the true model is expected to win, whichever it is [nat].
        each: The same if the first is true, and if the second is [nat].
        voltage: Peak [V].
        slew: Fastest change [V/s].
        peaks: Channel -> largest predicted |output|.
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


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What to record next to distinguish two effects.

    Attributes:
        separates: The two effects as `name@port`.
        chosen: The input and its expected evidence.
        u: Voltage [V], held over each sample.
        Ts: Sampling period [s].
        period: Time after which the input repeats [s]; its whole length where it does not.
        table: Standard inputs beside the design, best first.
        numbers: Effect -> its parameters.
        outputs: Runs if the first, or the second is true.
        differences: Residuals of the rival fitted to each run, in units of the outputs.
        channels: Names of the outputs.
        noise: Channel -> standard deviation of the sensor noise.
        limits: Limits of the machine.
        notes: What a reader must know before playing it.
    """

    separates: tuple[str, str]
    chosen: Rated
    u: Float[np.ndarray, " N"]
    Ts: float
    period: float
    table: tuple[Rated, ...]
    numbers: dict[str, dict[str, float]]
    outputs: Float[np.ndarray, "2 N C"]
    differences: Float[np.ndarray, "2 N C"]
    channels: tuple[str, ...]
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
        """Expected log-likelihood [nat] in total, and per second of the experiment."""
        seconds = len(self.u) * self.Ts
        return {"nats": self.chosen.nats, "nats_per_second": self.chosen.nats / seconds}

    @property
    def standard(self) -> Rated:
        """The best of the standard inputs."""
        return next(r for r in self.table if r.input != "design")

    def save_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the input: a comment with the units, then `t,voltage`.

        Add the measured columns `theta` and `alpha` and `rotflex_jax.load` reads the file.

        Raises:
            InputError: The folder does not exist, or the file cannot be written; an old one stays.
        """
        path = Path(path)
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise InputError(
                f"{path} cannot be written, since it is a folder or in one that does not exist; name a file "
                "in a folder that is there."
            )
        head = (
            f"# t in s, voltage in V, each held for {self.Ts:g} s; "
            f"tells {one_line(' from '.join(self.separates))}\n"
            "t,voltage"
        )
        rows = np.column_stack([self.t, self.u])
        form = ["%.15g", "%.17g"]
        np.savetxt(text := io.StringIO(), rows, fmt=form, delimiter=",", header=head, comments="")
        return write_file(path, text.getvalue())

    def plot(self) -> Any:
        """Figure: input in time, its spectrum, predicted difference of the two against sensor noise."""
        from rotflex_jax.experiment.figure import experiment_figure  # the layer above, on request

        return experiment_figure(self)

    def to_dict(self, file: str | None = None) -> dict[str, Any]:
        """Plain JSON types; `file` is where the input was written."""
        limits = {k: v if math.isfinite(v) else None for k, v in dataclasses.asdict(self.limits).items()}
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
            "effects": self.numbers,
            "limits": limits,
            "noise": self.noise,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        c, rate = self.chosen, self.evidence["nats_per_second"]
        first, second = self.separates
        peaks = ", ".join(f"{n} to {v:.3g}" for n, v in c.peaks.items())
        lines = [
            f"To tell {first} from {second}: {c.input}, {c.setting}, {len(self.u) * self.Ts:g} s",
            f"  expected evidence {c.nats:.3g} nats, {rate:.3g} per second; "
            f"best standard input {self.standard.input} ({self.standard.setting}): {self.standard.nats:.3g}",
            f"  voltage to {c.voltage:.3g} V, slew to {c.slew:.3g} V/s, {peaks} rad predicted",
        ]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])
