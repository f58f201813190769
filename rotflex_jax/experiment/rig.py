"""Rigs, machines on which voltages can be played: a base class, and three ready-made classes."""

import abc
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.data.files import load
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.result import voltage_file
from rotflex_jax.experiment.standard_inputs import Limits, checked_limits
from rotflex_jax.mechanism import Mechanism, simulate
from rotflex_jax.mechanism.mechanism import check_input_alone
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording


class Rig(abc.ABC):
    """A machine on which voltages can be played; derive a class and implement `play`.

    Attributes:
        limits: Limits of the machine.
        Ts: Sampling period [s].
        continues: Whether a segment begins with the motion at the end of the segment before. If not, the
            machine comes to rest in between, and each segment has its own offsets and first states.
    """

    limits: Limits
    Ts: float
    continues: bool = True

    @abc.abstractmethod
    def play(self, u: Float[np.ndarray, " N"]) -> Recording | Float[np.ndarray, "N C"]:
        """Play a voltage and record.

        Args:
            u: Voltage [V], each value held for one sampling period.

        Returns:
            Outputs at the sampling instants of the voltage, or a recording; the voltage of a recording is
            taken as the one that was really applied.
        """


class SimulatedRig(Rig):
    """A model in place of the machine; its motion continues from one segment to the next.

    Args:
        model: Model of the machine.
        limits: Limits of the machine.
        Ts: Sampling period [s].
        noise: Channel -> standard deviation of the sensor noise; channels that are not named have none.
        seed: Seed of the noise.

    Raises:
        InputError: An argument is out of range, or the noise is that of no channel.
    """

    def __init__(
        self,
        model: Model | Mechanism,
        limits: Limits,
        Ts: float,
        noise: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> None:
        self.model, self.limits, self.Ts = (
            Model.of(model).without_gates(),
            checked_limits(limits),
            checks.positive(Ts, "Ts", "s", "0.002"),
        )
        check_input_alone(self.model.mechanism, "a simulated rig")
        channels = self.model.mechanism.channels
        given = {} if noise is None else noise
        strange = [c for c in given if c not in channels] if isinstance(given, Mapping) else None
        if strange or strange is None:
            what = f"names {strange[0]!r}" if strange else f"is {checks.shown(noise)}"
            raise InputError(
                f"Argument `noise` must be standard deviations by the channels {', '.join(channels)}, but "
                f"{what}; give for instance {{{channels[0]!r}: 5e-4}}."
            )
        self._sd = np.array(
            [checks.number(given.get(c, 0.0), "noise", least=0, example="{'theta': 5e-4}") for c in channels]
        )
        self._rng, self._played = np.random.default_rng(checks.seed(seed)), np.zeros(0)

    def play(self, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N C"]:
        """Outputs with noise, continuing the motion of the last segment."""
        # From the start each time: a delay or a drift depends on earlier voltages, which are in no state.
        self._played = np.concatenate([self._played, checks.signal(u)])
        m = self.model.mechanism
        y = simulate(m, self._played, self.Ts, solver=self.model.solver)[-len(u) :]
        return y + self._sd * self._rng.standard_normal(y.shape)


class CallbackRig(Rig):
    """A rig that is operated by a function.

    Args:
        function: Function of the voltage [V] that returns the outputs, or a recording.
        limits: Limits of the machine.
        Ts: Sampling period [s].
        continues: Whether the motion continues from one segment to the next.
    """

    def __init__(
        self,
        function: Callable[[Float[np.ndarray, " N"]], Any],
        limits: Limits,
        Ts: float,
        continues: bool = True,
    ) -> None:
        if not callable(function):
            raise InputError(
                f"Argument `function` must be a function from voltages to outputs, but is "
                f"{checks.shown(function)}; give one that plays on the rig."
            )
        self.function, self.limits, self.continues = function, checked_limits(limits), bool(continues)
        self.Ts = checks.positive(Ts, "Ts", "s", "0.002")

    def play(self, u: Float[np.ndarray, " N"]) -> Recording | Float[np.ndarray, "N C"]:
        """The result of the function."""
        return self.function(u)


class FileRig(Rig):
    """A rig that is operated by files: it writes `voltage_001.csv` and waits for `recording_001.csv`.

    Args:
        folder: Folder of the files.
        limits: Limits of the machine.
        Ts: Sampling period [s].
        patience: Longest wait for a recording [s].
        continues: Whether the motion continues from one segment to the next.
        columns: Arguments of `rotflex_jax.load`, such as `degrees=True`.
    """

    def __init__(
        self,
        folder: str | Path,
        limits: Limits,
        Ts: float,
        patience: float = 600.0,
        continues: bool = False,
        **columns: Any,
    ) -> None:
        self.folder, self.limits, self.continues = Path(folder), checked_limits(limits), bool(continues)
        if not self.folder.is_dir():
            raise InputError(f"{self.folder} is no folder; make it first, or name one that is there.")
        if (old := next(iter(sorted(self.folder.glob("recording_*.csv"))), None)) is not None:
            raise InputError(f"{old} is there already and would count as an answer; name an empty folder.")
        self.Ts = checks.positive(Ts, "Ts", "s", "0.002")
        self.patience, self.columns, self._count = checks.positive(patience, "patience"), columns, 0

    def play(self, u: Float[np.ndarray, " N"]) -> Recording:
        """Write the voltage and wait for the recording."""
        self._count += 1
        answer = self.folder / f"recording_{self._count:03d}.csv"
        voltage_file(self.folder / f"voltage_{self._count:03d}.csv", u, self.Ts)
        ends = time.monotonic() + self.patience
        size = 0
        # A file that still grows is still being written.
        while (now := answer.stat().st_size if answer.exists() else 0) == 0 or now != size:
            size = now
            if time.monotonic() > ends:
                raise InputError(
                    f"{answer} did not appear within {self.patience:g} s; play the voltage beside it and put "
                    "the recording there, or give more `patience`."
                )
            time.sleep(0.05)
        return load(answer, **self.columns)
