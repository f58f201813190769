"""What the experiment learns from and is judged on: simulated, or measured and thinned out."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.reproduce import signals
from rotflex_jax.reproduce.machine import linear_joint, machine, symmetric_twin
from rotflex_jax.reproduce.plants import response
from rotflex_jax.reproduce.settings import Settings

REMEMBERED = 0.4
"""What the joint remembers of its input [s]; where a record begins in motion, errors count after it."""


@dataclasses.dataclass(frozen=True)
class Records:
    """Records of one sampling interval.

    Attributes:
        train: To learn from; each with voltage and outputs.
        test: To be judged on.
        channel: The output that is identified.
        unit: Of that output.
        linearised: What the linear physical model makes of each record in `test` (N,).
        joint: That model.
        machine: The simulated machine; None for measured records.
        repeats: More records like the first of `train`, with other inputs; none for measured ones.
        pulses: Answers to the pulse and to its negative; none for measured ones.
        phases: Into how many records each recording was thinned out.
        whole: Recordings to learn from and to judge on as they were before that.
    """

    train: tuple[Recording, ...]
    test: tuple[Recording, ...]
    channel: str
    unit: str
    linearised: tuple[np.ndarray, ...]
    joint: Mechanism
    machine: Mechanism | None = None
    repeats: tuple[Recording, ...] = ()
    pulses: "tuple[PulseRun, ...]" = ()
    phases: int = 1
    whole: tuple[tuple[Recording, ...], tuple[Recording, ...]] = ((), ())

    @property
    def Ts(self) -> float:
        """Sampling interval [s]."""
        return self.train[0].Ts

    @property
    def measured(self) -> bool:
        """Whether a real machine was recorded."""
        return self.machine is None


@dataclasses.dataclass(frozen=True)
class PulseRun:
    """One pulse test.

    Attributes:
        height: Of the pulse [V].
        recording: Voltage and answer, one sample per `Ts`.
        linearised: Answer of the linearised model (N,).
        t: Times of the answer between the samples [s], counted from the start of the pulse.
        alpha: The answer there.
        alpha_linearised: That of the linearised model.
    """

    height: float
    recording: Recording
    linearised: np.ndarray
    t: np.ndarray
    alpha: np.ndarray
    alpha_linearised: np.ndarray


def simulated(s: Settings) -> Records:
    """The experiment on a simulated machine.

    Args:
        s: Settings.

    Returns:
        Training, held-out and repeated records, and the pulse.
    """
    real, linear = machine(s), linear_joint(s)
    streams = np.random.SeedSequence(s.seed).spawn(s.runs + 1)
    lengths = [s.samples] * s.runs + [s.held_out]
    voltages = [
        signals.filtered_noise(s, N, np.random.default_rng(stream.spawn(1)[0]))
        for N, stream in zip(lengths, streams, strict=True)
    ]
    noises = [np.random.default_rng(stream.spawn(1)[0]) for stream in streams]
    *learn, judge = (_record(s, real, u, noise) for u, noise in zip(voltages, noises, strict=True))
    return Records(
        train=(learn[0],),
        test=(judge,),
        channel="alpha",
        unit="rad",
        linearised=(s.sign * response(linear, judge.u, s.Ts, step=s.step)[:, 1],),
        joint=linear,
        machine=real,
        whole=((learn[0],), (judge,)),
        repeats=tuple(learn[1:]),
        # The kernel of even degree answers both alike, friction both oppositely: one pulse cannot tell.
        pulses=(_pulse(s, real, linear, s.pulse), _pulse(s, real, linear, -s.pulse)),
    )


def symmetric(s: Settings, like: Recording) -> Recording:
    """The same input to the machine with symmetric friction and dead zone alone."""
    return _record(s, symmetric_twin(s), like.u, np.random.default_rng(0))


def _record(s: Settings, real: Mechanism, u: np.ndarray, noise: np.random.Generator) -> Recording:
    y = s.sign * response(real, u, s.Ts, step=s.step)
    y = y + s.sensor_noise * noise.standard_normal(y.shape)
    return _plain(Recording(u=u, y=y, Ts=s.Ts, source=s.scenario), s)


def _plain(recording: Recording, s: Settings) -> Recording:
    """With as many samples before errors count as the memory of model and machine needs."""
    n_init = max(s.memory - 1, round(REMEMBERED / recording.Ts))
    return dataclasses.replace(recording, n_init=min(recording.N // 2, n_init), accept=ACCEPTABLE)


def _pulse(s: Settings, real: Mechanism, linear: Mechanism, height: float) -> PulseRun:
    u = signals.pulse(s, height)
    fine = max(1, round(s.Ts / 0.005))
    answers = [
        s.sign * response(joint, np.repeat(u, fine), s.Ts / fine, step=s.step)[:, 1]
        for joint in (real, linear)
    ]
    t = np.arange(len(u) * fine) * s.Ts / fine - s.pulse_delay
    recording = Recording(
        u=u, y=answers[0][::fine], Ts=s.Ts, channels="alpha", source="pulse", accept=ACCEPTABLE
    )
    return PulseRun(height, recording, answers[1][::fine], t, *answers)


def from_measured(
    s: Settings,
    train: Sequence[Recording],
    test: Sequence[Recording],
    joint: Mechanism,
    channel: str | None = None,
) -> Records:
    """Measured recordings at the sampling interval of the experiment.

    A recording is thinned out to every k-th sample, from each of its first k samples on: k records of
    one sampling interval, no sample lost. They say the same thing k times over, so they do not make up
    for a short recording.

    Args:
        s: Settings; of the machine and the input nothing is used.
        train: To learn from.
        test: To be judged on.
        joint: Linear physical model to compare with; it must have the channel.
        channel: Output to identify; alpha, or the only one, if None.

    Raises:
        InputError: No deflection, sampled more slowly than `Ts`, or too short.
    """
    name = channel or ("alpha" if "alpha" in train[0].channels else train[0].channels[0])
    if name == "theta":
        raise InputError(
            "The servo angle theta was to be identified, but it adds up its past for ever, which no "
            "series of fading memory can hold; give recordings with the deflection alpha, or name its "
            "column."
        )
    thin = [_thinned(s, recording, name) for recording in (*train, *test)]
    learn, judge = thin[: len(train)], thin[len(train) :]
    test_parts = tuple(part for parts in judge for part in parts)
    return Records(
        train=tuple(part for parts in learn for part in parts),
        test=test_parts,
        channel=name,
        unit=train[0].units[train[0].channels.index(name)],
        linearised=thinned_like(test_parts, [_physical(joint, recording, name) for recording in test]),
        joint=joint,
        phases=len(thin[0]),
        whole=(tuple(train), tuple(test)),
    )


def thinned_like(parts: Sequence[Recording], outputs: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Outputs of whole recordings, thinned out as the recordings were.

    Args:
        parts: Thinned-out records, those of one recording after the other.
        outputs: One for each whole recording (N,).
    """
    k = len(parts) // len(outputs)
    return tuple(outputs[i // k][i % k :: k][: part.N] for i, part in enumerate(parts))


def _thinned(s: Settings, recording: Recording, name: str) -> list[Recording]:
    k = round(s.Ts / recording.Ts)
    where = recording.source or "The recording"
    if k < 1 or abs(k * recording.Ts / s.Ts - 1) > 0.02:
        raise InputError(
            f"{where} is sampled every {recording.Ts:g} s, but Ts is {s.Ts:g} s, which must be a multiple of "
            f"that; set Ts={max(1, k) * recording.Ts:g}."
        )
    y = recording.channel(name)[:, None]
    unit = recording.units[recording.channels.index(name)]
    one = dataclasses.replace(recording, y=y, channels=(name,), units=(unit,), accept=ACCEPTABLE)
    least = 4 * max(s.memory, round(REMEMBERED / s.Ts))
    if (one.N - k + 1) // k < least:
        raise InputError(
            f"{where} has a part of {one.duration:.3g} s, but memory {s.memory} at a sampling interval of "
            f"{s.Ts:g} s needs {least * s.Ts:.3g} s; give a longer recording or a shorter Ts."
        )
    # All of one length: whatever is compiled for one of them serves the others.
    N = (one.N - k + 1) // k * k
    return [_plain(one.slice(phase, phase + N).decimate(k), s) for phase in range(k)]


def _physical(joint: Mechanism, recording: Recording, name: str) -> np.ndarray:
    """Free run of the physical model at the recording's own sampling interval."""
    model = Model(joint)
    missing = [c for c in joint.channels if c not in recording.channels]
    if name not in joint.channels:
        raise InputError(
            f"The channel {name!r} was to be identified, but the linear model has "
            f"{', '.join(joint.channels)}; name one of these with --output."
        )
    if not missing:
        return model.simulate(recording)[:, joint.channels.index(name)]
    at_rest = np.zeros(2 * len(joint.coordinates))
    y = np.zeros((recording.N, len(joint.channels)))
    bare = dataclasses.replace(
        recording, y=y, channels=joint.channels, units=("rad",) * y.shape[1], accept=ACCEPTABLE
    )
    return model.simulate(bare, x0=at_rest)[:, joint.channels.index(name)]
