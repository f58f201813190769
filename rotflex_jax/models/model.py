"""A model of a recording: a mechanism with its integration rule."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Real

from rotflex_jax.checks import number, shown, vector
from rotflex_jax.effects.base import Actuation, DryFriction, Effect, Gear
from rotflex_jax.effects.motor import Motor
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Exponential, Mechanism, Solver, free_run, kalman_gains, predictor_run
from rotflex_jax.mechanism.assembly import effects_of, motor_voltage, rest_state
from rotflex_jax.mechanism.initial_state import initial_states
from rotflex_jax.mechanism.linear import check_movable, output_units
from rotflex_jax.mechanism.mechanism import check_mechanism, process_noise_of
from rotflex_jax.mechanism.simulate import first_state
from rotflex_jax.metrics import window_starts
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.recording.recording import single, with_findings_on_file
from rotflex_jax.recording.samples import in_radians, unit_factor
from rotflex_jax.runtime.persistent_jit import PersistentJit, persistent_jit
from rotflex_jax.runtime.xla import double_precision

_free, _predict = PersistentJit(free_run, static=2), PersistentJit(predictor_run, static=2)


@persistent_jit(static=2)
def _free_many(structure, solver, values, gates, x0, u, Ts):  # noqa: ANN001, ANN202 - as `free_run`, many starts
    return jax.vmap(free_run, in_axes=(None, None, None, None, 0, 0, None))(
        structure, solver, values, gates, x0, u, Ts
    )


@persistent_jit(static=1)
def _motor_voltage(structure: Mechanism, values: Array, gates: Array, u: Array, Ts: Array) -> Any:
    return motor_voltage(structure.with_values(values), gates, u, Ts)


MOST_DOUBLED = 16384
# Units of inputs that are no voltage. Other words, such as %, may stand for one.
OTHER_INPUTS = ("A", "mA", "N", "N m", "rad", "m")


def program_length(number: int, least: int = 1024) -> int:
    """A length of arrays that several numbers of samples share, and with it the compiled program.

    The next power of two; above 16384 the next of eight lengths between two powers of two, because the excess
    of a long run costs more than one more program.
    """
    step = 1 if number <= MOST_DOUBLED else 2 ** (number.bit_length() - 4)
    return -(-number // step) * step if step > 1 else max(least, 2 ** (number - 1).bit_length())


def _filled(u: Float[np.ndarray, "N *c"]) -> Float[np.ndarray, "M *c"]:
    """An input whose last value is held, up to a length that several recordings share."""
    return np.pad(u, [(0, program_length(len(u)) - len(u)), *[(0, 0)] * (u.ndim - 1)], "edge")


@dataclasses.dataclass(frozen=True)
class Model:
    """A mechanism with its integration rule; it simulates recordings.

    Attributes:
        mechanism: The physics.
        solver: Integration rule.
        gates: Factor of each effect, 0 where it is switched off; None for all on. Models that differ only
            in their gates share one compilation.
    """

    mechanism: Mechanism
    solver: Solver = Exponential()
    gates: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_mechanism(self.mechanism)
        if not isinstance(self.solver, Solver):
            raise InputError(
                f"Argument `solver` must be Exponential(...) or SmoothRK4(...), but is {shown(self.solver)}; "
                "leave it out for the default."
            )
        if self.gates is not None:
            count = len(self.mechanism.effects)
            gates = vector(self.gates, "gates", count, example=f"{[1] * count}, 1 for what is on")
            object.__setattr__(self, "gates", tuple(gates.tolist()))  # a tuple, so that a model is hashable
        check_movable(self.mechanism)
        self._check_switched()

    def _check_switched(self) -> None:
        """Refuse voltages that switch within a sample for a model that can stick: it would creep at rest."""
        if not isinstance(self.solver, Exponential) or self.solver.between != "switched":
            return
        on = [e for i, e in enumerate(self.mechanism.effects) if self.gates is None or self.gates[i]]
        late = [e for e in on if isinstance(e, Actuation) and e.changes_within_samples]
        sticks = [e for e in on if isinstance(e, DryFriction | Gear)]
        if late and sticks:
            raise InputError(
                f'The model has {late[0].title} and {sticks[0].title}, but between="switched" is for '
                'machines without dry friction and play; use between="held".'
            )

    @classmethod
    def of(cls, given: "Mechanism | Model") -> "Model":
        """A model unchanged, or a mechanism as a model with the default integration rule.

        Raises:
            InputError: The argument is neither.
        """
        return given if isinstance(given, Model) else cls(given)

    def __add__(self, effect: Effect) -> "Model":
        """The model with one more effect."""
        gates = None if self.gates is None else (*self.gates, 1.0)
        return dataclasses.replace(self, mechanism=self.mechanism + effect, gates=gates)

    def without_gates(self) -> "Model":
        """The model without the effects that its gates switch off, and without gates.

        Raises:
            InputError: A gate is neither 0 nor 1.
        """
        if self.gates is None:
            return self
        if any(gate not in (0.0, 1.0) for gate in self.gates):
            raise InputError(
                f"The gates of the model are {', '.join(f'{g:g}' for g in self.gates)}, but only effects "
                "that are on or off are taken here; give 1 or 0 for each."
            )
        m = self.mechanism
        on = tuple(e for e, gate in zip(m.effects, self.gates, strict=True) if gate)
        names = {e.full_name(parameter) for e in on for parameter in e.values}
        gone = {e.signal for e in m.effects} - {e.signal for e in on}
        signals = tuple(s for s in m.signals if s not in gone)
        m = dataclasses.replace(m, effects=on, trusted=m.trusted & names, signals=signals)
        return dataclasses.replace(self, mechanism=m, gates=None)

    def save(self, path: str | Path) -> Path:
        """Write the model as JSON; `Model.load` restores it bit for bit."""
        from rotflex_jax.models.model_json import Saved, save  # imported on request: it needs this module

        return save(Saved(self), path)

    @classmethod
    def load(cls, path: str | Path) -> "Model":
        """The model in a file that was written by `save` of a model, a fit or a discovery."""
        from rotflex_jax.models.model_json import read  # imported on request: it needs this module

        return read(path).model

    def with_values(
        self, values: Mapping[str, float] | Sequence[Any] | Real[np.ndarray, " P"] | Real[jax.Array, "P ..."]
    ) -> "Model":
        """The model with other parameter values, by full name or as the whole vector."""
        return dataclasses.replace(self, mechanism=self.mechanism.with_values(values))

    def at(self, recording: Recording) -> "Model":
        """The model with the constants of a recording in place of its own values.

        Raises:
            InputError: A constant belongs to an effect of the model, but the effect has no such parameter.
        """
        recording = single(recording)
        names, effects = self.mechanism.parameter_names, {(e.at, e.name) for e in self.mechanism.effects}
        for name in recording.constants:
            head, _, parameter = name.rpartition(".")
            if name not in names and head.rpartition(".")[::2] in effects:
                own = ", ".join(n for n in names if n.startswith(f"{head}."))
                raise InputError(
                    f"The recording has the constant {name!r}, but {head} of the model has no parameter "
                    f"{parameter!r}; use one of {own}."
                )
        known = {n: v for n, v in recording.constants.items() if n in names}
        return self.with_values(known) if known else self

    def measured(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """The channels of a recording that are outputs of the mechanism, in the order of the outputs."""
        recording = single(recording)
        missing = [c for c in self.mechanism.channels if c not in recording.channels]
        if missing:
            raise InputError(
                f"The model has the outputs {', '.join(self.mechanism.channels)}, but the recording "
                f"has the channels {', '.join(recording.channels)}; name the column of {missing[0]}, "
                f"outputs={{{missing[0]!r}: 'COLUMN'}}, or give a model with the outputs of the recording."
            )
        for channel, unit in output_units(self.mechanism).items():
            given = recording.unit(channel)
            if (factor := unit_factor(given, unit)) not in (None, 1.0):
                raise InputError(
                    f"Channel {channel!r} of the recording is in {given}, but the output {channel} of the "
                    f"model is in {unit}; multiply it by {factor:g}, or load the file with "
                    f"units={{{channel!r}: {unit!r}}}, which converts it where the file names its unit."
                )
            if in_radians(given) and unit.startswith("rad"):
                raise InputError(
                    f"Channel {channel!r} of the recording is in {given}, but the output {channel} of the "
                    f"model is in {unit}; convert it (numpy.deg2rad), or load the file with "
                    f"units={{{channel!r}: {given!r}}}, which converts it."
                )
        return np.stack([recording.channel(c) for c in self.mechanism.channels], axis=1)

    def inputs(self, recording: Recording) -> Float[np.ndarray, "N *c"]:
        """The input of a recording (N,); with the signals of the mechanism, if it has any, (N, 1 + S).

        Raises:
            InputError: The recording lacks one of these signals, or says that its input is another quantity.
        """
        recording, names = single(recording), self.mechanism.signals
        given = recording.input_unit
        other = given in OTHER_INPUTS and given != self.mechanism.units.input
        if other and effects_of(self.mechanism, Motor) and "units" not in recording.accept:
            raise InputError(
                f"The motor of the model is driven in V, but the input {recording.input_name!r} of the "
                f"recording is in {given}; give a model with such an input (for a current one with "
                "CurrentDrive and Units(input='A')), the right input_unit, or accept=('units',)."
            )
        if missing := [name for name in names if name not in recording.signals]:
            has = ", ".join(map(repr, recording.signals)) or "none"
            raise InputError(
                f"The model is driven by the signal {missing[0]!r} beside the input, but the signals of the "
                f"recording are {has}; add it, recording.with_signals({{...}})."
            )
        return (recording.inputs(names) if names else recording.u).astype(float)

    def parameters_and_gates(self) -> tuple[Float[Array, " P"], Float[Array, " E"]]:
        """Parameter values and gates, in the precision of the context."""
        return jax.device_put((self.mechanism.values, self._switches()))

    def _switches(self) -> np.ndarray:
        return np.ones(len(self.mechanism.effects)) if self.gates is None else np.array(self.gates)

    def _behind_actuation(self, recording: Recording) -> tuple[np.ndarray, "Model"]:
        """The voltage at the motor [V] (and signals), and the model without actuation that it drives."""
        v, acting, here = self.inputs(recording), effects_of(self.mechanism, Actuation), self.at(recording)
        if not acting:
            return v, here
        gates, u = self._switches(), recording.u.astype(float)
        with double_precision():
            given = jax.device_put((here.mechanism.values, gates, _filled(u), float(recording.Ts)))
            at_motor = np.asarray(_motor_voltage(self.mechanism.structure, *given))[: len(u)]
        v = at_motor if v.ndim == 1 else np.column_stack([at_motor, v[:, 1:]])
        gates[[i for i, _ in acting]] = 0.0
        return v, dataclasses.replace(here, gates=tuple(gates.tolist()))

    def behind_actuation(self, recording: Recording) -> tuple["Model", Recording]:
        """The model without its actuation, and the recording with the voltage that reaches the motor.

        In a part of that recording, a delay, lag or drift does not start again.
        """
        recording = single(recording)
        v, inner = self._behind_actuation(recording)
        return inner, dataclasses.replace(recording, u=v if v.ndim == 1 else v[:, 0], accept=ACCEPTABLE)

    def _starts(
        self, u: np.ndarray, y: np.ndarray, Ts: float, hidden: np.ndarray | None = None
    ) -> np.ndarray:
        return initial_states(self.mechanism, self.solver, self._switches(), u, y, Ts, hidden)

    def _start(self, recording: Recording) -> np.ndarray:
        """State at the start of a recording, from its first `n_init` samples.

        States that no sensor measures come from a free run over the recording that this one continues. If it
        continues none, they are at rest.
        """
        u, y = self.inputs(recording), self.measured(recording).astype(float)
        m, moving, before = recording.n_init, 2 * len(self.mechanism.coordinates), recording.continues
        hidden = None
        if before is not None and len(rest_state(self.mechanism.structure, np.float64)) > moving:
            left = self._run(before, self._start(before))[0][-1:, moving:]
            hidden = left if np.all(np.isfinite(left)) else None
        return self.at(recording)._starts(u[None, :m], y[None, :m], recording.Ts, hidden)[0]

    def _run(self, recording: Recording, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (N, n) and outputs (N, C) of a free run."""
        with double_precision():
            run = _free(
                self.mechanism.structure,
                self.solver,
                *self.at(recording).parameters_and_gates(),
                *jax.device_put((start, _filled(self.inputs(recording)), float(recording.Ts))),
            )
            return np.asarray(run[0])[: recording.N], np.asarray(run[1])[: recording.N]

    def simulate(
        self, recording: Recording, x0: Real[np.ndarray, " m"] | Sequence[float] | None = None
    ) -> Float[np.ndarray, "N C"]:
        """Free run over a recording: outputs from its voltage alone.

        The first state is estimated from the first `n_init` samples. No other measured outputs are used.

        Args:
            recording: Its voltage drives the model.
            x0: First positions and speeds, if they are known.
        """
        recording = single(recording)
        if x0 is None:
            return self._run(recording, self._start(recording))[1]
        start = first_state(rest_state(self.mechanism.structure, np.float64), x0)
        return self._run(recording, start)[1]

    def simulate_states(self, recording: Recording) -> Float[np.ndarray, "N n"]:
        """States of the free run of `simulate`: positions, speeds, then states of effects."""
        recording = single(recording)
        return self._run(recording, self._start(recording))[0]

    def simulate_windows(self, recording: Recording, seconds: float = 2.0) -> Float[np.ndarray, "N C"]:
        """Outputs of free runs over windows: the run starts again every few seconds.

        Each run starts from positions and speeds that are estimated on the first `n_init` samples of its
        window. States that no sensor measures (memories, motor current) come from a free run over the whole
        recording, and actuation (a delay, a drift) acts on the voltage of the whole recording. The servo
        angle integrates every small torque error, so a single long run hides where the error arises.

        Args:
            recording: Its voltage drives the model.
            seconds: Length of a window [s]; a remainder of up to twice `n_init` belongs to the last window.
        """
        recording = single(recording)
        y = self.measured(recording).astype(float)
        u, inner = self._behind_actuation(recording)
        starts, length = window_starts(recording, seconds)
        # Filled up, so that recordings of different lengths share the program.
        many = np.minimum(np.arange(program_length(len(starts), least=8)), len(starts) - 1)
        pick = starts[many, None] + np.arange(program_length(length))[None, :]
        inside = np.minimum(pick, len(u) - 1)
        x0 = self.states_at(recording, starts)[many]
        with double_precision():
            run = _free_many(
                inner.mechanism.structure,
                inner.solver,
                *inner.parameters_and_gates(),
                *jax.device_put((x0, u[inside], float(recording.Ts))),
            )
            answers = np.asarray(run[1])[: len(starts)]
        out = np.empty_like(y)
        for window, start, end in zip(answers, starts, [*starts[1:], len(u)], strict=True):
            out[start:end] = window[: end - start]
        return out

    def states_at(
        self,
        recording: Recording,
        begins: Int[np.ndarray, " W"],
        moving: Float[np.ndarray, "W m"] | None = None,
    ) -> Float[np.ndarray, "W n"]:
        """States in which free runs start again at some samples of a recording.

        Positions and speeds are estimated on `n_init` samples, from each of these samples on. States that no
        sensor measures come from a free run over the whole recording, unless all runs begin at its start.

        Args:
            recording: It has at least `n_init` samples after each beginning.
            begins: First samples of the runs.
            moving: Positions and speeds, if they are known.
        """
        if moving is None and not begins.any():
            return self._start(recording)[None]
        y = self.measured(recording).astype(float)
        v, inner = self._behind_actuation(recording)
        head, m = begins[:, None] + np.arange(recording.n_init), 2 * len(self.mechanism.coordinates)
        hidden, rest = None, rest_state(self.mechanism.structure, np.float64)[m:]
        if len(rest):
            left = self._run(recording, self._start(recording))[0][begins, m:]
            hidden = np.where(np.isfinite(left), left, rest)
        if moving is None:
            return inner._starts(v[head], y[head], recording.Ts, hidden)
        return moving if hidden is None else np.concatenate([moving, hidden], axis=1)

    def predict(
        self,
        recording: Recording,
        process_noise: Mapping[str, float],
        noise: Float[np.ndarray, " C"] | Sequence[float],
    ) -> Float[np.ndarray, "N C"]:
        """Outputs predicted one step ahead by the steady Kalman gain of the linear part.

        Args:
            recording: Voltage and measured outputs.
            process_noise: Port -> intensity of the process noise [(N m)^2 s].
            noise: Standard deviation of the sensor noise of each channel.
        """
        recording = single(recording)
        y, m = self.measured(recording).astype(float), self.mechanism
        u, here, process_noise = (
            self.inputs(recording),
            self.at(recording),
            process_noise_of(m, process_noise),
        )
        if np.shape(noise) != (len(m.channels),):
            raise InputError(
                f"Argument `noise` must have one number for each of {', '.join(m.channels)}, but is "
                f"{shown(noise)} of shape {np.shape(noise)}; give their standard deviations."
            )
        noise = [number(x, "noise", above=0, example="[5e-4, 5e-4]") for x in noise]
        K = kalman_gains(here.mechanism, [process_noise], noise, recording.Ts, self._switches())[0]
        x0 = self._start(recording)
        with double_precision():
            run = _predict(
                self.mechanism.structure,
                self.solver,
                *here.parameters_and_gates(),
                *jax.device_put((x0, u, y, np.ones(len(u)), K, float(recording.Ts))),
            )
            return np.asarray(run[1])


def units_to_read(mechanism: Mechanism, input: str | None = None) -> dict[str, str]:
    """Units that `rotflex_jax.load` must be given: those that are not rad, or V for the input.

    Args:
        mechanism: Mechanism for which a file is read.
        input: Column of its input that is named. If none is, the column of the voltage is read, which is not
            the input of a mechanism with another unit.

    Returns:
        Channel or column of the input -> unit.
    """
    units = {channel: unit for channel, unit in output_units(mechanism).items() if unit != "rad"}
    return units if input is None or mechanism.units.input == "V" else {**units, input: mechanism.units.input}


def in_units_of(mechanism: Mechanism, recording: Recording) -> Recording:
    """A recording of a file in the units of the mechanism; one of another machine is refused.

    Outputs whose units differ by a prefix alone, such as mm and m, are converted. `Model.measured` refuses
    such units and degrees alone, since a recording made in Python may name its units as it likes. Here any
    other unit is refused: a file is read by those of the mechanism.

    Raises:
        InputError: The input or an output has another unit, which the recording does not accept, or a signal
            is missing.
    """
    driven, any_unit = mechanism.units.input, "units" in recording.accept
    if recording.input_unit != driven and not any_unit:
        raise InputError(
            f"{recording.source}: the input {recording.input_name!r} is in {recording.input_unit}, but the "
            f"model is driven in {driven}; name the column of that with input=, give a model with such an "
            "input (for a current one with CurrentDrive and Units(input='A')), or pass accept=('units',)."
        )
    factors, changed = dict.fromkeys(recording.channels, 1.0), {}
    for channel, unit in output_units(mechanism).items():
        given = recording.unit(channel) if channel in recording.channels else unit
        if given == unit or any_unit:
            continue
        factor = unit_factor(given, unit)
        if factor is None:
            raise InputError(
                f"{recording.source}: the output {channel!r} is in {given}, but that of the model is in "
                f"{unit}; convert the column, or pass accept=('units',)."
            )
        factors[channel], changed[channel] = factor, unit
    if lacking := [name for name in mechanism.signals if name not in recording.signals]:
        has = " and ".join(map(repr, recording.signals)) or "none"
        raise InputError(
            f"{recording.source}: the model is driven by the signal {lacking[0]!r} beside its input, but the "
            f"signals that were read are {has}; name its column, signals={{{lacking[0]!r}: 'COLUMN'}}."
        )
    if not changed:
        return recording
    y = recording.y * [factors[channel] for channel in recording.channels]
    units = [changed.get(c, unit) for c, unit in zip(recording.channels, recording.units, strict=True)]
    converted = dataclasses.replace(recording, y=y, units=units, resolution=None)
    return with_findings_on_file(converted, [f for f in recording.findings if f.kind == "cut"])
