"""Sequential experiments: segments of a few seconds are chosen, played and evaluated until it is decided.

Each segment is chosen so that the expected probability of a wrong answer after it is least. After each
segment the rivals are fitted to everything recorded so far, which gives their probabilities. The experiment
ends when one rival is probable enough (Wald's sequential test), when the time is up, or when no input within
the limits would decide.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.checks import Progress
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.common_structure import UNKNOWN_SHARE, rival_set
from rotflex_jax.experiment.result import Segment, SequentialResult, SequentialStep, json_limits
from rotflex_jax.experiment.rival_set import RivalPosterior, RivalSet, RunData
from rotflex_jax.experiment.segment_choice import BEFORE, SegmentChoice
from rotflex_jax.experiment.standard_inputs import Limits, checked_limits
from rotflex_jax.mechanism.quantity import input_word
from rotflex_jax.models import model_json
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE, SHORTEST_RECORDING
from rotflex_jax.text.files import write_file

SEGMENT_SECONDS, MOST_SECONDS, ERROR = 1.0, 60.0, 0.01
SHORTEST_SEGMENT = 0.4
# Number of samples of the shortest piece that is evaluated separately.
SHORTEST_PIECE = 10
KIND = "rotflex_jax sequential experiment"
# Least number of segments that are played before giving up, and how often in a row the gain is too small.
TRIED, IN_TURN = 2, 2
# After the first segments, up to this number, fits start also from other shapes of an effect.
SHAPES_AFTER = 3


@dataclasses.dataclass(frozen=True)
class SequentialSettings:
    """Settings of a sequential experiment.

    Attributes:
        limits: Limits of the machine.
        segment_seconds: Length of a segment [s].
        error: Probability of a wrong answer at which the experiment stops.
        max_seconds: Time on the rig at which the experiment stops [s].
        continues: Whether the motion continues from one segment to the next.
        improve: Whether inputs are improved by gradient ascent.
        seed: Seed of standard inputs and draws.
        check_seconds: Interval at which the recording is evaluated [s]: a segment is played in pieces of this
            length, and stopped early when it is decided. None for whole segments.
    """

    limits: Limits
    segment_seconds: float = SEGMENT_SECONDS
    error: float = ERROR
    max_seconds: float = MOST_SECONDS
    continues: bool = True
    improve: bool = True
    seed: int = 0
    check_seconds: float | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class SequentialExperiment:
    """The state of a sequential experiment; each step returns a new state.

    Attributes:
        rivals: The models.
        settings: Settings of the experiment.
        prior: Probability of each model before the first segment.
        runs: Voltages and recorded outputs, each run without a pause.
        unknowns: Most probable unknowns of each rival.
        history: One entry for each segment.
        too_small: How often in a row no input was expected to decide.
        verdict: `decided`, `time is up`, `not distinguishable`, or empty while the experiment continues.
        reason: Reason of the verdict if nothing was decided.
        planned: The segment to play next, or whose rest is to be played.
        played: Number of samples of this segment that were played.
    """

    rivals: RivalSet
    settings: SequentialSettings
    prior: Float[np.ndarray, " H"]
    runs: tuple[RunData, ...] = ()
    unknowns: tuple[Float[np.ndarray, " _"], ...] = ()
    history: tuple[SequentialStep, ...] = ()
    too_small: int = 0
    verdict: str = ""
    reason: str = ""
    planned: Segment | None = None
    played: int = 0

    # -- what is known -----------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        """Number of samples of a segment."""
        return round(self.settings.segment_seconds / self.rivals.Ts)

    @property
    def piece(self) -> int:
        """Number of samples that are played between two evaluations."""
        check = self.settings.check_seconds
        return self.samples if check is None else min(round(check / self.rivals.Ts), self.samples)

    @property
    def due(self) -> Float[np.ndarray, " N"]:
        """The voltage to play next: the planned segment, or a piece of it [V].

        Raises:
            InputError: No segment is planned.
        """
        if self.planned is None:
            raise InputError("No segment is planned; plan the next one first.")
        return self.planned.u[self.played : self.played + self.piece]

    @property
    def seconds(self) -> float:
        """Time on the rig so far [s]."""
        return sum(len(r.u) for r in self.runs) * self.rivals.Ts

    @property
    def samples_before(self) -> int:
        """Number of samples before a segment with which its simulation begins."""
        return round(BEFORE / self.rivals.Ts)

    @functools.cached_property
    def posteriors(self) -> tuple[RivalPosterior, ...]:
        """Posterior of each rival after all recordings."""
        place = max(0, len(self.runs[-1].u) - self.samples_before)
        return tuple(
            self.rivals.posterior(h, x, self.runs, place, self.samples) for h, x in enumerate(self.unknowns)
        )

    @functools.cached_property
    def scale(self) -> float:
        """Variance of the whitened residuals of the best rival times their correlation time; at least one.

        If no rival explains the recordings, all probabilities become less certain.
        """
        if not self.runs:
            return 1.0
        best = min(self.posteriors, key=lambda p: p.cost)
        if not math.isfinite(best.cost):
            return 1.0
        count = sum(w.size for w in best.residuals)
        variance = 2 * best.cost / max(count - len(best.unknowns), 1)
        return max(1.0, variance * _correlation_time(best.residuals))

    @functools.cached_property
    def probabilities(self) -> Float[np.ndarray, " H"]:
        """Probability of each rival."""
        if not self.runs:
            return self.prior
        logs = np.array([p.log_evidence(self.scale) for p in self.posteriors])
        if not np.any(np.isfinite(logs)):
            return self.prior
        with np.errstate(divide="ignore"):
            logs = logs - np.max(logs) + np.log(self.prior)
        weight = np.exp(logs - np.max(logs))
        return weight / weight.sum()

    # -- state of an experiment on disk ------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, from which `from_dict` restores the same experiment, bit for bit."""
        r, planned = self.rivals, self.planned
        return {
            "kind": KIND,
            "schema": 1,
            "models": {
                n: model_json.to_dict(model_json.Saved(m)) for n, m in zip(r.labels, r.models, strict=True)
            },
            "covariances": [c.tolist() for c in r.prior_covariance],
            "Ts": r.Ts,
            "noise": dict(zip(r.structure.channels, r.noise.tolist(), strict=True)),
            "process_noise": dict(r.process_noise),
            "settings": dataclasses.asdict(self.settings) | {"limits": json_limits(self.settings.limits)},
            "prior": self.prior.tolist(),
            "runs": [{"u": x.u.tolist(), "y": x.y.tolist()} for x in self.runs],
            "unknowns": [x.tolist() for x in self.unknowns],
            "history": [s.to_dict() for s in self.history],
            "too_small": self.too_small,
            "verdict": self.verdict,
            "reason": self.reason,
            "planned": None
            if planned is None
            else {
                f.name: v.tolist() if isinstance(v := getattr(planned, f.name), np.ndarray) else v
                for f in dataclasses.fields(planned)
                if f.name not in ("limits", "units", "input_unit")
            },
            "played": self.played,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "SequentialExperiment":
        """The experiment from the result of `to_dict`.

        Raises:
            InputError: The data are no sequential experiment, or from another version.
        """
        if not isinstance(data, Mapping) or data.get("kind") != KIND or data.get("schema") != 1:
            raise InputError(
                "The state of a sequential experiment is needed, but the file holds something else; give one "
                "that `rotflex experiment --state` has written."
            )
        try:
            models = {n: model_json.from_dict(m).model for n, m in data["models"].items()}
            rivals = rival_set(
                models, Ts=data["Ts"], noise=data["noise"], process_noise=data["process_noise"]
            )
            covariances = tuple(np.array(c, float) for c in data["covariances"])
            rivals = dataclasses.replace(rivals, prior_covariance=covariances)
            given = dict(data["settings"])
            bounds = {k: math.inf if v is None else v for k, v in given.pop("limits").items()}
            settings = SequentialSettings(Limits(**bounds), **given)
            planned = data["planned"]
            if planned is not None:
                arrays = {k: np.array(planned[k], float) for k in ("u", "nats", "outputs")}
                tuples = {k: tuple(planned[k]) for k in ("rivals", "probabilities", "channels")}
                table = tuple(tuple(row) for row in planned["table"])
                known = {"units": rivals.units, "input_unit": rivals.structure.units.input}
                known |= {"table": table, "limits": settings.limits}
                planned = Segment(**(planned | arrays | tuples | known))
            channels = len(rivals.noise)
            return cls(
                rivals,
                settings,
                np.array(data["prior"], float),
                tuple(
                    RunData(np.array(x["u"], float), np.array(x["y"], float).reshape(-1, channels))
                    for x in data["runs"]
                ),
                tuple(np.array(x, float) for x in data["unknowns"]),
                tuple(SequentialStep(**s) for s in data["history"]),
                int(data["too_small"]),
                str(data["verdict"]),
                str(data["reason"]),
                planned,
                int(data.get("played", 0)),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"The state of the experiment is incomplete or was changed by hand ({type(error).__name__}); "
                "begin the experiment again."
            ) from None

    def save(self, path: str | Path) -> Path:
        """Write the state as JSON; `load` reads it.

        Raises:
            InputError: The file cannot be written; an existing file then stays as it is.
        """
        return write_file(path, json.dumps(self.to_dict(), allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "SequentialExperiment":
        """The state from a file that `save` has written.

        Raises:
            InputError: The file does not exist, or is not from a sequential experiment.
        """
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(
                f"{path} cannot be read ({error.strerror}); give one that `rotflex experiment --state` wrote."
            ) from None
        except (ValueError, RecursionError):
            raise InputError(
                f"{path} is not JSON; give a file that `rotflex experiment --state` has written."
            ) from None
        return cls.from_dict(data)

    # -- the next segment --------------------------------------------------------------------------

    def with_next_segment(self, progress: Progress | None = None) -> "SequentialExperiment":
        """The experiment with the next segment planned, or with the verdict that no segment would decide."""
        if self.verdict or self.planned is not None:
            return self
        segment, reason = SegmentChoice(self).best(progress or (lambda _: None))
        too_small = self.too_small + 1 if reason else 0
        if too_small >= IN_TURN and len(self.history) >= TRIED:
            return dataclasses.replace(
                self, too_small=too_small, verdict="not distinguishable", reason=reason
            )
        return dataclasses.replace(self, too_small=too_small, planned=segment)

    def with_recording(self, recording: Recording | Float[np.ndarray, "N C"]) -> "SequentialExperiment":
        """The experiment after the voltage `due` was played.

        Args:
            recording: Outputs at the sampling instants of the voltage, or a recording.

        Raises:
            InputError: No segment is planned, or the recording does not belong to it.
        """
        if self.planned is None:
            raise InputError("A recording was given, but no segment is planned; plan the next one first.")
        run = _checked(recording, self.due, self.rivals)
        r, runs, N = self.rivals, self.runs, len(run.u)
        # Two short pieces near rest may be equal to the last count.
        whole = self.piece == self.samples
        known = [old.y[a : a + N] for old in runs for a in range(0, len(old.u), N) if whole]
        if np.ptp(run.y, axis=0).any() and any(np.array_equal(run.y, y) for y in known):
            raise InputError("This recording was given before; give one of the voltage that is planned now.")
        first = self.played == 0
        own = [r.first_unknowns(run)] if first and (not runs or not self.settings.continues) else []
        if own:
            runs = (*runs, run)
        else:
            last = runs[-1]
            whole = RunData(np.concatenate([last.u, run.u]), np.concatenate([last.y, run.y]))
            runs = (*runs[:-1], whole)
        place, unknowns = max(0, len(runs[-1].u) - self.samples_before), []
        earlier = self.history if first else self.history[:-1]
        for h in range(r.count):
            start = np.concatenate([self.unknowns[h] if self.unknowns else r.prior_mean[h], *own])
            starts = [start]
            if len(earlier) < SHAPES_AFTER:
                starts += r.other_shapes(h, start)
            unknowns.append(r.fitted(h, starts, runs, place, self.samples).unknowns)
        new = dataclasses.replace(self, runs=runs, unknowns=tuple(unknowns))
        p = new.probabilities
        step = SequentialStep(
            seconds=new.seconds,
            input=self.planned.input,
            setting=self.planned.setting,
            voltage=float(max(np.max(np.abs(run.u)), 0.0 if first else self.history[-1].voltage)),
            expected_error=self.planned.expected_error,
            probabilities=dict(zip(r.labels, p.tolist(), strict=True)),
            misfit=math.sqrt(new.scale),
        )
        verdict = ""
        if np.max(p) >= 1 - self.settings.error:
            verdict = "decided"
        elif new.seconds > self.settings.max_seconds - 0.5 * self.piece * r.Ts:
            verdict = "time is up"
        played = self.played + N
        over = bool(verdict) or played >= len(self.planned.u)
        return dataclasses.replace(
            new,
            history=(*earlier, step),
            verdict=verdict,
            planned=None if over else self.planned,
            played=0 if over else played,
        )

    def result(self) -> SequentialResult:
        """The current state as a result; its runs exclude a first piece that is too short for a recording."""
        r, s = self.rivals, self.settings
        notes = []
        if self.history and self.scale > 4:
            notes.append(
                "No rival explains the recordings: what the best one leaves counts as "
                f"{math.sqrt(self.scale):.1f} times the noise of the sensors, and probabilities are among "
                "these rivals only."
            )
        return SequentialResult(
            rivals=r.labels,
            verdict=self.verdict or "going on",
            probabilities=dict(zip(r.labels, self.probabilities.tolist(), strict=True)),
            prior=dict(zip(r.labels, self.prior.tolist(), strict=True)),
            error=s.error,
            max_seconds=s.max_seconds,
            seconds=self.seconds,
            history=self.history,
            runs=tuple(
                Recording(
                    u=x.u,
                    y=x.y,
                    Ts=r.Ts,
                    channels=r.structure.channels,
                    units=r.units,
                    input_name=input_word(r.structure.units.input),
                    input_unit=r.structure.units.input,
                    accept=ACCEPTABLE,
                )
                for x in self.runs
                if np.ptp(x.u) > 0 and len(x.u) >= SHORTEST_RECORDING
            ),
            limits=s.limits,
            reason=self.reason,
            notes=tuple(notes),
        )


def _correlation_time(residuals: Sequence[np.ndarray]) -> float:
    """Number of samples that are worth one independent sample, at least 1, for the most correlated channel.

    Source: A. D. Sokal, Monte Carlo methods in statistical mechanics, 1997, section 3: the sum of the
    autocorrelation to five times itself.
    """
    most = 1.0
    for w in residuals:
        for e in (w - w.mean(axis=0)).T:
            N = len(e)
            power = np.abs(np.fft.rfft(e, 2 * N)) ** 2
            r = np.fft.irfft(power)[:N]
            if r[0] > 0:
                tau = 2 * np.cumsum(r / r[0]) - 1
                window = np.arange(N) >= 5 * tau
                most = max(most, float(tau[np.argmax(window)] if window.any() else tau.max()))
    return most


def _checked(recording: Any, due: np.ndarray, rivals: RivalSet) -> RunData:
    """Voltage and outputs of the recording of the voltage `due`, checked."""
    N, channels = len(due), rivals.structure.channels
    if isinstance(recording, Recording):
        if abs(recording.Ts / rivals.Ts - 1) > 1e-3:
            raise InputError(
                f"The recording has a sampling period of {recording.Ts:g} s, but the experiment one of "
                f"{rivals.Ts:g} s; record at that rate."
            )
        u = recording.u.astype(float)
        y = rivals.models[0].measured(recording).astype(float)
    else:
        y = np.asarray(recording)
        u = due
        if y.dtype.kind not in "iuf" or y.ndim != 2 or y.shape[1] != len(channels):
            raise InputError(
                f"The rig returned {checks.shown(recording)} of shape {y.shape}, but {N} samples of "
                f"{', '.join(channels)} are needed; return an array of shape ({N}, {len(channels)})."
            )
        y = y.astype(float)
    if len(y) != N or not np.all(np.isfinite(y)):
        flaw = "" if np.all(np.isfinite(y)) else ", some not finite"
        raise InputError(
            f"The recording has {len(y)} samples{flaw}, but the voltage has {N}; record every sample of it, "
            "from its first."
        )
    return RunData(u, y)


def sequential_experiment(
    models: Any,
    limits: Limits,
    Ts: float,
    *,
    probabilities: Mapping[str, float] | Sequence[float] | None = None,
    error: float = ERROR,
    max_seconds: float = MOST_SECONDS,
    segment_seconds: float = SEGMENT_SECONDS,
    check_seconds: float | None = None,
    continues: bool = True,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    uncertainty: float = UNKNOWN_SHARE,
    improve: bool = True,
    seed: int = 0,
) -> SequentialExperiment:
    """A sequential experiment before its first segment; arguments as in `experiment_until`."""
    error = checks.number(error, "error", above=0, below=0.5, example="0.01")
    segment_seconds = checks.number(
        segment_seconds, "segment_seconds", least=SHORTEST_SEGMENT, unit="s", example="1.0"
    )
    max_seconds = checks.number(max_seconds, "max_seconds", least=segment_seconds, unit="s", example="60.0")
    Ts = checks.number(Ts, "Ts", above=0, below=0.05, unit="s", example="0.002")
    if check_seconds is not None:
        check_seconds = checks.number(
            check_seconds, "check_seconds", least=SHORTEST_PIECE * Ts, unit="s", example="0.1"
        )
    rivals = rival_set(models, Ts=Ts, noise=noise, process_noise=process_noise, uncertainty=uncertainty)
    settings = SequentialSettings(
        checked_limits(limits),
        segment_seconds,
        error,
        max_seconds,
        bool(continues),
        bool(improve),
        checks.whole(seed, "seed", 0, math.inf),
        check_seconds if continues else None,
    )
    return SequentialExperiment(rivals, settings, _prior(probabilities, rivals.labels))


def _prior(given: Any, labels: tuple[str, ...]) -> np.ndarray:
    """Prior probabilities in the order of the rivals; equal if none are given."""
    if given is None:
        return np.full(len(labels), 1 / len(labels))
    if isinstance(given, Mapping):
        values = [checks.real(given.get(n)) for n in labels] if set(given) == set(labels) else []
    else:
        values = [checks.real(x) for x in given] if isinstance(given, Sequence | np.ndarray) else []
    p = np.array(values)
    if len(p) != len(labels) or not (np.all(np.isfinite(p)) and np.all(p >= 0) and p.sum() > 0):
        raise InputError(
            f"Argument `probabilities` must have a number from 0 for each of {', '.join(labels)}, but is "
            f"{checks.shown(given)}; give one for each, or leave it out."
        )
    return p / p.sum()
