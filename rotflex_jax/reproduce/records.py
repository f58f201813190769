"""Recordings for training and evaluation: simulated, or measured and decimated."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.reproduce.plants import response
from rotflex_jax.reproduce.settings import Settings, linear_joint, machine, symmetric_twin

BUTTERWORTH_ORDER = 4
"""Order of the Butterworth filter."""


def filtered_noise(s: Settings, N: int, seed: int | np.random.Generator) -> Float[np.ndarray, " {N}"]:
    """The voltage [V], stationary from its first sample.

        u = sigma F(q) w / norm2(F),   w ~ N(0, 1)

    The variance of the process is scaled, by the L2 norm of the filter's impulse response. Scaling by the
    standard deviation of the sample would make the input depend on its future.

    Args:
        s: Settings `filter`, `cutoff`, `variance`, `Ts`.
        N: Number of samples.
        seed: Seed of the random numbers.

    >>> u = filtered_noise(Settings(filter="fir"), 40000, 0)
    >>> round(float(np.var(u)), 1)
    1.0
    """
    rms = float(np.sqrt(s.variance))
    if s.filter == "ar1":
        return noise(N, s.Ts, rms=rms, bandwidth=s.cutoff, seed=seed)
    h = impulse_response(s)
    w = np.random.default_rng(seed).standard_normal(N + len(h) - 1)
    return rms * np.convolve(w, h / np.linalg.norm(h), mode="valid")


def impulse_response(s: Settings) -> Float[np.ndarray, " L"]:
    """Impulse response of the filter, until it has decayed."""
    from scipy import signal  # takes long to import

    if s.filter == "ar1":
        a = np.exp(-2 * np.pi * s.cutoff * s.Ts)
        return np.sqrt(1 - a**2) * a ** np.arange(_length(a))
    if s.filter == "butterworth":
        sections = np.asarray(signal.butter(BUTTERWORTH_ORDER, s.cutoff, fs=1 / s.Ts, output="sos"))
        radius = max(float(np.max(np.abs(np.roots(section[3:])))) for section in sections)
        return np.asarray(signal.sosfilt(sections, np.eye(1, _length(radius))[0]))
    # So many taps that the window determines the pass band, not the truncation.
    taps = 2 * max(1, round(1.0 / (s.cutoff * s.Ts))) + 1
    return np.asarray(signal.firwin(taps, min(s.cutoff, 0.499 / s.Ts), fs=1 / s.Ts))


def autocovariance(s: Settings, lags: int) -> Float[np.ndarray, " {lags}"]:
    """Autocovariance of the input at the lags 0, 1, ... [V²], computed from the filter.

    >>> autocovariance(Settings(), 2).round(4)
    array([1.    , 0.0432])
    """
    h = impulse_response(s)
    h = np.pad(h / np.linalg.norm(h), (0, lags))
    return s.variance * np.array([h[: len(h) - k] @ h[k:] for k in range(lags)])


def pulse(s: Settings, height: float) -> Float[np.ndarray, " N"]:
    """A rectangular pulse with zeros before and after it [V]."""
    before, width, after = (round(t / s.Ts) for t in (s.pulse_delay, s.pulse_width, s.pulse_after))
    return np.concatenate([np.zeros(before), np.full(width, height), np.zeros(after)])


def _length(radius: float) -> int:
    """Number of samples after which the response of a pole has decayed to 1e-12."""
    return int(np.ceil(np.log(1e-12) / np.log(max(radius, 1e-9)))) + 2


MEMORY_SECONDS = 0.4
"""Memory of the joint [s]; errors are counted only after it, since a recording may start in motion."""


@dataclasses.dataclass(frozen=True)
class Records:
    """Recordings of one sampling interval.

    Attributes:
        train: Recordings for training, with voltage and outputs.
        test: Recordings for evaluation.
        channel: The output that is identified.
        unit: Unit of the output that is identified.
        linearised: Output of the linear physical model on each recording in `test`.
        joint: The linear physical model.
        machine: The simulated machine; None for measured recordings.
        repeats: Further simulated recordings with other inputs, for repeated runs of the filter.
        pulses: Simulated responses to the pulse and to its negative.
        phases: Number of decimated recordings for each measured one.
        whole: Recordings for training and for evaluation before the decimation.
    """

    train: tuple[Recording, ...]
    test: tuple[Recording, ...]
    channel: str
    unit: str
    linearised: tuple[Float[np.ndarray, " _"], ...]
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
        """Whether the recordings were measured on a real machine."""
        return self.machine is None


@dataclasses.dataclass(frozen=True)
class PulseRun:
    """One pulse test.

    Attributes:
        height: Height of the pulse [V].
        recording: Voltage and response, one sample per `Ts`.
        linearised: Response of the linearised model, one sample per `Ts`.
        t: Times of the finely sampled responses [s], from the start of the pulse.
        alpha: Deflection of the machine at the times `t`.
        alpha_linearised: Deflection of the linearised model at the times `t`.
    """

    height: float
    recording: Recording
    linearised: Float[np.ndarray, " N"]
    t: Float[np.ndarray, " F"]
    alpha: Float[np.ndarray, " F"]
    alpha_linearised: Float[np.ndarray, " F"]


def simulated(s: Settings) -> Records:
    """The experiment on a simulated machine.

    Args:
        s: Settings.

    Returns:
        Recordings for training and evaluation, repetitions, and pulses.
    """
    real, linear = machine(s), linear_joint(s)
    streams = np.random.SeedSequence(s.seed).spawn(s.runs + 1)
    lengths = [s.samples] * s.runs + [s.held_out]
    voltages = [
        filtered_noise(s, N, np.random.default_rng(stream.spawn(1)[0]))
        for N, stream in zip(lengths, streams, strict=True)
    ]
    noises = [np.random.default_rng(stream.spawn(1)[0]) for stream in streams]
    *training, evaluation = (_record(s, real, u, noise) for u, noise in zip(voltages, noises, strict=True))
    return Records(
        train=(training[0],),
        test=(evaluation,),
        channel="alpha",
        unit="rad",
        linearised=(s.sign * response(linear, evaluation.u, s.Ts, step=s.step)[:, 1],),
        joint=linear,
        machine=real,
        whole=((training[0],), (evaluation,)),
        repeats=tuple(training[1:]),
        # Both signs are needed: a kernel of even degree responds equally to them, friction oppositely.
        pulses=(_pulse(s, real, linear, s.pulse), _pulse(s, real, linear, -s.pulse)),
    )


def symmetric(s: Settings, like: Recording) -> Recording:
    """Recording of the machine with symmetric friction and dead zone only, with the input of `like`."""
    return _record(s, symmetric_twin(s), like.u, np.random.default_rng(0))


def _record(
    s: Settings, real: Mechanism, u: Float[np.ndarray, " N"], noise: np.random.Generator
) -> Recording:
    y = s.sign * response(real, u, s.Ts, step=s.step)
    y = y + s.sensor_noise * noise.standard_normal(y.shape)
    return _plain(Recording(u=u, y=y, Ts=s.Ts, source=s.scenario), s)


def _plain(recording: Recording, s: Settings) -> Recording:
    """The recording with `n_init` set to the memory of model and machine."""
    n_init = max(s.memory - 1, round(MEMORY_SECONDS / recording.Ts))
    return dataclasses.replace(recording, n_init=min(recording.N // 2, n_init), accept=ACCEPTABLE)


def _pulse(s: Settings, real: Mechanism, linear: Mechanism, height: float) -> PulseRun:
    u = pulse(s, height)
    fine = max(1, round(s.Ts / 0.005))
    responses = [
        s.sign * response(joint, np.repeat(u, fine), s.Ts / fine, step=s.step)[:, 1]
        for joint in (real, linear)
    ]
    t = np.arange(len(u) * fine) * s.Ts / fine - s.pulse_delay
    recording = Recording(
        u=u, y=responses[0][::fine], Ts=s.Ts, channels="alpha", source="pulse", accept=ACCEPTABLE
    )
    return PulseRun(height, recording, responses[1][::fine], t, *responses)


def from_measured(
    s: Settings,
    train: Sequence[Recording],
    test: Sequence[Recording],
    joint: Mechanism,
    channel: str | None = None,
) -> Records:
    """Measured recordings, decimated to the sampling interval of the experiment.

    Every k-th sample of a recording is taken, starting at each of its first k samples. This gives k
    recordings with nearly the same information, which therefore do not replace a longer recording.

    Args:
        s: Settings; the settings of the machine and of the input are not used.
        train: Recordings for training.
        test: Recordings for evaluation.
        joint: Linear physical model for comparison; it must have the channel.
        channel: Output to identify; if None, alpha, or the first output of recordings without alpha.

    Raises:
        InputError: The output is the hub angle theta or no output of `joint`, or a recording is too short, or
            `Ts` is no multiple of its sampling period.
    """
    name = channel or ("alpha" if "alpha" in train[0].channels else train[0].channels[0])
    if name == "theta":
        raise InputError(
            "The servo angle theta was to be identified, but it integrates its past, which no series "
            "of fading memory can represent; give recordings with the deflection alpha, or name its "
            "column."
        )
    decimated = [_decimated(s, recording, name) for recording in (*train, *test)]
    training, evaluation = decimated[: len(train)], decimated[len(train) :]
    test_parts = tuple(part for parts in evaluation for part in parts)
    return Records(
        train=tuple(part for parts in training for part in parts),
        test=test_parts,
        channel=name,
        unit=train[0].units[train[0].channels.index(name)],
        linearised=decimate_like(test_parts, [_physical(joint, recording, name) for recording in test]),
        joint=joint,
        phases=len(decimated[0]),
        whole=(tuple(train), tuple(test)),
    )


def decimate_like(
    parts: Sequence[Recording], outputs: Sequence[Float[np.ndarray, " _"]]
) -> tuple[Float[np.ndarray, " _"], ...]:
    """Outputs of whole recordings, decimated in the same way as the recordings.

    Args:
        parts: All decimated recordings of the first whole recording, then of the next one, and so on.
        outputs: One output for each whole recording.
    """
    k = len(parts) // len(outputs)
    return tuple(outputs[i // k][i % k :: k][: part.N] for i, part in enumerate(parts))


def _decimated(s: Settings, recording: Recording, name: str) -> list[Recording]:
    k = round(s.Ts / recording.Ts)
    where = recording.source or "The recording"
    if k < 1 or abs(k * recording.Ts / s.Ts - 1) > 0.02:
        raise InputError(
            f"{where} is sampled every {recording.Ts:g} s, but Ts is {s.Ts:g} s, which must be a multiple of "
            f"that; give Settings(Ts={max(1, k) * recording.Ts:g})."
        )
    y = recording.channel(name)[:, None]
    unit = recording.unit(name)
    one = dataclasses.replace(
        recording,
        y=y,
        channels=(name,),
        units=(unit,),
        resolution={name: recording.resolution.get(name)},
        accept=ACCEPTABLE,
    )
    least = 4 * max(s.memory, round(MEMORY_SECONDS / s.Ts))
    if (one.N - k + 1) // k < least:
        raise InputError(
            f"{where} has a part of {one.duration:.3g} s, but memory {s.memory} at a sampling interval of "
            f"{s.Ts:g} s needs {least * s.Ts:.3g} s; give a longer recording or a shorter Ts."
        )
    # All parts have the same length, so that they share one compiled program.
    N = (one.N - k + 1) // k * k
    return [_plain(one.slice(phase, phase + N).decimate(k), s) for phase in range(k)]


def _physical(joint: Mechanism, recording: Recording, name: str) -> Float[np.ndarray, " N"]:
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
