"""What a search found, as data: stages, rounds, ranking, places of failure, a verdict."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.probabilities import Probabilities
from rotflex_jax.discover.verdict import NEAR_FLOOR as NEAR_FLOOR, Assessment, Verdict, assess
from rotflex_jax.effects.labels import effect_phrase, effect_title, law_of, law_phrase, with_titles
from rotflex_jax.experiment import Experiment
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism.roles import calibrations
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import of_one_run
from rotflex_jax.text.numbers import json_number, json_numbers


class ConditionalInterval(NamedTuple):
    """A parameter of the final model whose intervals from predictions and from free runs are disjoint.

    Attributes:
        prediction: Its estimate from one-step predictions.
        free_run: Its estimate from free runs over some seconds of the same recordings.
    """

    prediction: Estimate
    free_run: Estimate

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "parameter": self.prediction.name,
            "prediction": self.prediction.to_dict(),
            "free_run": self.free_run.to_dict(),
        }


def excluding(
    prediction: Sequence[Estimate], free_run: Sequence[Estimate]
) -> tuple[ConditionalInterval, ...]:
    """Parameters whose 95 % intervals from predictions and from free runs have nothing in common.

        |a - b| > 1.96 (std_a + std_b)

    If the model is complete, both fits estimate the same number, and their difference scatters by less than
    this limit. If the model is incomplete, each horizon has its own best number.

    Args:
        prediction: Estimates of a model fitted to predictions.
        free_run: The same model fitted to free runs of the same recordings.
    """
    found, other = [], {e.name: e for e in free_run}
    for a in prediction:
        b = other.get(a.name)
        if b is None or not (a.free and b.free):
            continue
        if max(a.ci95[0], b.ci95[0]) > min(a.ci95[1], b.ci95[1]):
            found.append(ConditionalInterval(a, b))
    return tuple(found)


def conditional_note(found: Sequence[ConditionalInterval]) -> tuple[str, ...]:
    """A note for the reader with both intervals of each parameter; no note where all intervals agree."""
    if not found:
        return ()
    listed = "; ".join(
        f"{a.name} {_interval(a)} {a.unit}".rstrip() + f" from predictions, {_interval(b)} from free runs"
        for a, b in found
    )
    whose = "its intervals hold" if len(found) == 1 else "their intervals hold"
    return (
        f"The intervals from predictions and from free runs exclude each other ({listed}): the model is "
        f"incomplete, and {whose} only under it and at the horizon that it was fitted to.",
    )


def _interval(e: Estimate) -> str:
    _, low, high = e.texts
    return f"[{low}, {high}]"


class RunErrors(NamedTuple):
    """Root mean square errors of free runs.

    Attributes:
        whole: Channel -> error of one free run over each recording.
        windows: Channel -> error of free runs that start again every few seconds.
    """

    whole: dict[str, float]
    windows: dict[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """One model of the search, fitted, and evaluated on validation recordings.

    Attributes:
        model: Fitted model.
        estimates: Parameters with intervals; calibrations (offset, bias) among them.
        held_out_rmse: Channel -> root mean square error of one free run over each validation recording.
        held_out_rmse_windows: Channel -> root mean square error of free runs over the validation recordings
            that start again every `window_seconds`.
        simulated: Free run over each validation recording.
        windowed: Free run over each validation recording, started again every `window_seconds`.
        window_seconds: Length of the windows [s].
        process_noise: Port -> likeliest intensity of the process noise [(N m)^2 s]; small where the model is
            right.
        process_noise_nats: Log-likelihood per measured value of the training recordings that the process
            noise gains [nat]; near zero where the model is right.
        log_likelihood: Log-likelihood of the validation recordings at the horizon `horizon` [nat].
        horizon: What the parameters were fitted to: "prediction", or "free_run" where short free runs over
            the validation recordings are then clearly better.
        calibrated: Validation errors with the offsets of each recording fitted to its first
            `calibrate_seconds`.
        test: Errors on test recordings, which were used for no fit and no choice; None without test
            recordings.
        test_calibrated: Test errors with the offsets of each recording fitted to its first
            `calibrate_seconds`.
        calibrate_seconds: Length of the part of a recording to which its own offsets are fitted [s].
        of_validation: The model for each validation recording, with the phase of a periodic disturbance
            there and with the friction of its run, which may have been fitted there; empty without either.
        friction_of_runs: Sizes of friction that differ between runs: name -> value in each training
            recording.
        friction_of_validation: The same in each validation recording: that of its run, or fitted to it.
        expected: Channel -> error of short free runs by noise alone (`evaluation.errors_by_noise`); empty
            where the verdict does not depend on it.
    """

    model: Model
    estimates: tuple[Estimate, ...]
    held_out_rmse: dict[str, float]
    held_out_rmse_windows: dict[str, float]
    simulated: tuple[Float[np.ndarray, "_ C"], ...]
    windowed: tuple[Float[np.ndarray, "_ C"], ...]
    window_seconds: float
    process_noise: dict[str, float]
    process_noise_nats: float
    log_likelihood: float
    horizon: str = "prediction"
    calibrated: RunErrors | None = None
    test: RunErrors | None = None
    test_calibrated: RunErrors | None = None
    calibrate_seconds: float = 0.0
    of_validation: tuple[Model, ...] = ()
    friction_of_runs: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    friction_of_validation: dict[str, tuple[float, ...]] = dataclasses.field(default_factory=dict)
    expected: dict[str, float] = dataclasses.field(default_factory=dict)

    def model_on(self, i: int) -> Model:
        """The model for validation recording `i`."""
        return self.of_validation[i] if self.of_validation else self.model

    def with_friction_of(self, i: int) -> "Stage":
        """The stage with a model that has the friction of training recording `i`."""
        sizes = {name: each[i] for name, each in self.friction_of_runs.items()}
        return dataclasses.replace(self, model=self.model.with_values(sizes)) if sizes else self

    def errors(self) -> dict[str, Any]:
        """All errors as plain JSON."""
        named = {
            "held_out_rmse": (RunErrors(self.held_out_rmse, self.held_out_rmse_windows), ""),
            "held_out_rmse_calibrated": (self.calibrated, "_calibrated"),
            "test_rmse": (self.test, ""),
            "test_rmse_calibrated": (self.test_calibrated, "_calibrated"),
        }
        out: dict[str, Any] = {}
        for name, (errors, suffix) in named.items():
            if errors is not None:
                windows = name.removesuffix(suffix) + "_windows" + suffix
                out[name] = json_numbers(errors.whole)
                out[windows] = {"seconds": self.window_seconds, **json_numbers(errors.windows)}
        return out


class KnownRuns(NamedTuple):
    """The runs that a model was fitted to, and whether their offsets were compared with another run.

    An offset of the voltage or a bias of a sensor counts as a property of its run until another run shows the
    same value.

    Attributes:
        recordings: The recordings that were fitted.
        compared: Whether offsets of one run were tested on another run. If so, the offsets that a model keeps
            are properties of the machine.
    """

    recordings: tuple[Recording, ...]
    compared: bool

    @classmethod
    def of(cls, train: Sequence[Recording], validation: Sequence[Recording]) -> "KnownRuns":
        """The runs of the training recordings.

        Where training recordings validate each other, `validation` has the same recordings as `train`.
        """
        return cls(tuple(train), any(not of_one_run(a, b) for a in train for b in validation))

    def index(self, recording: Recording) -> int | None:
        """Index of the fitted recording that belongs to the same run as a given recording; None if none does.

        If several parts of the run were fitted, this is the part that overlaps most in time with the given
        recording, or that is nearest to it.
        """
        end = recording.start + recording.N * recording.Ts

        def shared(k: int) -> float:
            part = self.recordings[k]
            return min(part.start + part.N * part.Ts, end) - max(part.start, recording.start)

        of_run = [k for k, r in enumerate(self.recordings) if of_one_run(r, recording)]
        return max(of_run, key=shared, default=None)

    def indices(self, recordings: Sequence[Recording]) -> tuple[int | None, ...]:
        """`index` of each recording."""
        return tuple(map(self.index, recordings))


def _as_lists(values: Mapping[str, tuple[float, ...]]) -> dict[str, list[float]]:
    return {name: list(each) for name, each in values.items()}


def _parameters(estimates: Sequence[Estimate]) -> dict[str, Any]:
    """Estimates by name as plain JSON."""
    return {e.name: {**e.to_dict(), "free": e.free, "note": e.note} for e in estimates}


def assess_stages(baseline: Stage, final: Stage, floor: dict[str, float]) -> Assessment:
    """The assessment of a final stage, on which the verdict rests.

    Args:
        baseline: Stage before any effect was added.
        final: Stage after the last round.
        floor: Standard deviation of the sensor noise per channel.
    """
    errors = baseline.held_out_rmse_windows, final.held_out_rmse_windows
    return assess(*errors, floor, final.process_noise_nats, final.window_seconds, final.expected)


@dataclasses.dataclass(frozen=True)
class FinalFit:
    """The final model of a search that ends unexplained, fitted to training and validation recordings.

    It is fitted to free runs over windows, each of which starts from the state that its first samples show.
    If the errors of such a fit on validation data are clearly larger than the errors of the search, the first
    states are fitted as well (`fit.options.first`).

    Attributes:
        fit: Fit to the training and validation recordings together, with local parameters of each recording.
            For a local parameter, `fit.model` and `fit.parameters` have the value that the runs have in
            common, or the mean of the runs.
        recordings: Training and validation recordings, as they were fitted. Adjoining parts of one run are
            one recording here (`recording.joined`), since they share the offsets of their run.
        model: The model of the fit, without what belongs to single recordings.
        trained: Errors on validation recordings of the same structure, fitted in the same way to the training
            recordings alone; with the own offsets of each recording where offsets are calibrated, and with
            friction fitted to a validation run where it differs from that of the training runs.
        searched: The same errors of the final model with the parameters of the search.
        test: Errors on test recordings, if there are any.
        test_calibrated: Errors on test recordings with the own offsets of each recording.
        laws: Pairs of an effect that the search has found and the law that replaces it in this model.
        friction: Full names of the sizes of dry friction that have a value of their own in each run; `model`
            has the mean of these values.
        left_out: Effects that the search has found and this model lacks, since free runs are not clearly
            worse without them. Where all recordings belong to one run, its offsets may be among them.
    """

    fit: Fit
    recordings: tuple[Recording, ...]
    model: Model
    trained: RunErrors
    searched: RunErrors
    test: RunErrors | None = None
    test_calibrated: RunErrors | None = None
    laws: tuple[tuple[tuple[str, str], tuple[str, str]], ...] = ()
    friction: tuple[str, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Parameters of `model` with intervals; without offsets that belong to single runs."""
        names = self.model.mechanism.parameter_names
        return tuple(self._noted(e) for e in self.fit.parameters if e.name in names)

    def _noted(self, e: Estimate) -> Estimate:
        """The estimate; a size of friction that differs between runs has its value in each run as a note."""
        if e.name not in self.friction:
            return e
        of_runs = "mean of runs with " + ", ".join(f"{own.value:.3g}" for own in self.fit.local[e.name])
        return dataclasses.replace(e, note="; ".join(filter(None, (e.note, of_runs))))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        out: dict[str, Any] = {
            "window_seconds": self.fit.options.window_seconds,
            "first": self.fit.options.first,
            "status": self.fit.status,
            "parameters": _parameters(self.estimates),
            "laws": [{"found": list(found), "used": list(used)} for found, used in self.laws],
            "friction_of_runs": {n: [e.value for e in self.fit.local[n]] for n in self.friction},
            "left_out": [{"effect": effect, "port": port} for effect, port in self.left_out],
        }
        for name, suffix, errors in (
            ("held_out_rmse_of_training_fit", "", self.trained),
            ("held_out_rmse_of_search", "", self.searched),
            ("test_rmse", "", self.test),
            ("test_rmse", "_calibrated", self.test_calibrated),
        ):
            if errors is not None:
                out[name + suffix] = json_numbers(errors.whole)
                seconds = {"seconds": self.fit.options.window_seconds}
                out[f"{name}_windows{suffix}"] = seconds | json_numbers(errors.windows)
        return out


class HorizonGain(NamedTuple):
    """Gain of an effect on validation data at one horizon, with parameters fitted at this horizon.

    Attributes:
        gain: For predictions, increase of the log-likelihood [nat]; for free runs, decrease of the logarithm
            of the error, summed over half seconds.
        z: The gain divided by its standard deviation, which is estimated from its scatter over half seconds.
        error_ratio: Error of short free runs with the effect divided by the error without it.
        training_gain: The same gain on training data.
    """

    gain: float
    z: float
    error_ratio: float
    training_gain: float = 0.0


@dataclasses.dataclass(frozen=True)
class Round:
    """One round of the search: an effect that was added.

    At the end of the search another effect may replace the effect that the round added: a law that fits the
    data better, or one effect for several. Then `score`, `prediction` and `free_run` still belong to the
    effect that the round added. So does `held_out_gain_nats` if the parameters of the stages were fitted to
    free runs.

    Attributes:
        effect: Name of the effect.
        port: Where it acts.
        equivalent: Other (effect, port) that these recordings cannot distinguish from it.
        parameters: Estimates of the parameters of the effect, by short name.
        stage: The model with the effect, refitted and evaluated.
        score: Penalised score of the candidate [nat]. NaN if it was refitted without a score: a law that
            contains an effect with memory that is on, which no derivative distinguishes from it.
        held_out_gain_nats: Gain in log-likelihood of the validation recordings [nat].
        sentence: What was found, in words.
        equation: Equation of the effect.
        doubts: Further reasons why the effect may stand in for something else, in words.
        prediction: Gain of predictions when the round added its effect; None for a calibration.
        free_run: Gain of free runs when the round added its effect; None for a calibration.
    """

    effect: str
    port: str
    equivalent: tuple[tuple[str, str], ...]
    parameters: dict[str, Estimate]
    stage: Stage
    score: float
    held_out_gain_nats: float
    sentence: str
    equation: str
    doubts: tuple[str, ...] = ()
    prediction: HorizonGain | None = None
    free_run: HorizonGain | None = None

    @property
    def certain(self) -> str:
        """What is certain although the law is not, such as "dry friction at the hub"; otherwise empty."""
        others = {(law_of(effect), port) for effect, port in self.equivalent}
        one_thing = others == {(law_of(self.effect), self.port)}
        return law_phrase(self.effect, self.port) if one_thing and not self.doubts else ""

    @property
    def phrase(self) -> str:
        """The effect in words; where only its law is open, the phenomenon that the laws describe."""
        return self.certain or effect_phrase(self.effect, self.port)

    @property
    def doubt(self) -> str:
        """Why the effect may stand in for something else, in words; empty without a reason to think so."""
        if self.certain:
            *laws, last = (effect_title(effect) for effect in (self.effect, *(e for e, _ in self.equivalent)))
            return f"{self.certain} is certain, but not whether it is {', '.join(laws)} or {last}"
        alike = " or ".join(effect_phrase(*place) for place in self.equivalent)
        reasons = [f"these recordings cannot distinguish it from {alike}"] if alike else []
        return with_titles("; ".join([*reasons, *self.doubts]))

    @property
    def status(self) -> str:
        """`established`, or `provisional` where the effect may stand in for something else."""
        return "provisional" if self.doubt else "established"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": self.effect,
            "port": self.port,
            "equivalent": [{"effect": e, "port": p} for e, p in self.equivalent],
            "parameters": {n: e.to_dict() for n, e in self.parameters.items()},
            **self.stage.errors(),
            "evidence": {
                "score": json_number(self.score),
                "held_out_gain_nats": json_number(self.held_out_gain_nats),
                **{
                    name: {key: json_number(value) for key, value in g._asdict().items()}
                    for name, g in (("prediction", self.prediction), ("free_run", self.free_run))
                    if g is not None
                },
            },
            "status": self.status,
            "doubt": self.doubt,
            "certain": self.certain,
            "parameters_fitted_to": self.stage.horizon,
            "sentence": self.sentence,
            "equation": self.equation,
        }


@dataclasses.dataclass(frozen=True)
class Ranked:
    """One candidate in the score test of the baseline.

    Attributes:
        effect: Name of the effect.
        port: Where it would act.
        score: Penalised score [nat]; negative where the data are evidence against it.
        excited: False where this recording could not have shown an effect of a plausible size.
        orthogonal_fraction: Share of its trace in the outputs that the baseline cannot imitate, 0 to 1.
        detection_limit: Factor of a plausible size that would just have been visible.
        score_free_run: Penalised score in free runs over some seconds [nat]; None where it was not computed.
    """

    effect: str
    port: str
    score: float
    excited: bool
    orthogonal_fraction: float
    detection_limit: float
    score_free_run: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": self.effect,
            "port": self.port,
            "score": json_number(self.score),
            "score_free_run": None if self.score_free_run is None else json_number(self.score_free_run),
            "excited": self.excited,
            "unconfounded": json_number(self.orthogonal_fraction),
        }


@dataclasses.dataclass(frozen=True, eq=False)
class Where:
    """One statement of where the model fails.

    Attributes:
        statement: A plain sentence.
        share: Share of the squared error that the statement is about.
        p_value: Probability of a share as large as this if the error were spread evenly.
        kind: time, frequency, speed, deflection or reversal.
        channel: Channel that has the error.
        edges: Bin edges [unit].
        profile: Share of the squared error in each bin.
        expected: Share of the samples (for frequency: of the noise) in each bin.
        unit: Unit of the edges.
    """

    statement: str
    share: float
    p_value: float
    kind: str
    channel: str
    edges: Float[np.ndarray, " G"]
    profile: Float[np.ndarray, " B"]
    expected: Float[np.ndarray, " B"]
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "statement": self.statement,
            "share": json_number(self.share),
            "p_value": json_number(self.p_value),
            "kind": self.kind,
            "channel": self.channel,
        }


def longest_recording(train: Sequence[Recording], validation: Sequence[Recording]) -> Recording:
    """The longest training or validation recording, the first of several equally long ones.

    `SearchResult.where` is about this recording.
    """
    return max((*train, *validation), key=lambda r: r.N)


# Name of the file beside a report that holds the input to play next.
NEXT = "next_experiment.csv"


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """What a search found, as data; `Discovery` adds what can be done with it.

    Attributes:
        verdict: Verdict on the final model.
        sentence: The verdict in words.
        train: Training recordings, to which the search fitted its models.
        validation: Validation recordings: the search fitted no model to them, but chose between models by
            them.
        baseline: The user's model, fitted.
        rounds: Effects that were added, in order.
        ranking: All candidates in the score test of the baseline, best first.
        where: Where the baseline fails on the longest training or validation recording.
        noise_floor: Channel -> standard deviation of the sensor noise.
        elapsed_s: Time taken [s].
        notes: Remarks for a reader.
        proposal: If two effects cannot be distinguished, the standard input that distinguishes them best.
        test: Test recordings, used for no fit and no choice.
        remarks: Parameters of the final model at a bound, or far beyond what the recordings reach.
        probabilities: Probabilities of sets of effects and of single effects; None for results made by hand.
        conditional: Parameters whose intervals from predictions and from free runs exclude each other: the
            model is incomplete, and its intervals hold only under it.
        final_fit: The final model fitted to training and validation recordings; None if the search has
            explained its recordings, or if this fit was refused.
    """

    verdict: Verdict
    sentence: str
    train: tuple[Recording, ...]
    validation: tuple[Recording, ...]
    baseline: Stage
    rounds: tuple[Round, ...]
    ranking: tuple[Ranked, ...]
    where: tuple[Where, ...]
    noise_floor: dict[str, float]
    elapsed_s: float
    notes: tuple[str, ...] = ()
    proposal: Experiment | None = None
    test: tuple[Recording, ...] = ()
    remarks: tuple[Remark, ...] = ()
    probabilities: Probabilities | None = None
    conditional: tuple[ConditionalInterval, ...] = ()
    final_fit: FinalFit | None = None

    @property
    def model(self) -> Model:
        """The model to use, from the final fit if there is one, else from the last round.

        The stages report errors of `final.model`, which was fitted to the training recordings alone.
        """
        return self.final_fit.model if self.final_fit else self.final.model

    def model_of(self, recording: Recording) -> Model:
        """The model to use for a recording: `model` with the offsets and the friction known of its run.

        If the recording belongs to a run that was fitted, the model has the offsets of that run, and its
        friction where this differs between runs; without a final fit, it also has the friction of the run of
        a validation recording. If it belongs to another run, the model lacks offsets that
        were seen in a single run only. Offsets that the final fit leaves out are in no model.

        Args:
            recording: Any recording of this machine; a part of a recording belongs to the run of the whole.
        """
        runs, m = KnownRuns.of(self.train, self.validation), self.model.mechanism
        fit = self.final_fit.fit if self.final_fit else None
        fitted = self.final_fit.recordings if self.final_fit else self.train
        k = runs._replace(recordings=fitted).index(recording)
        if fit is None:
            friction, of_run = self.final.friction_of_runs, k
            if k is None:
                of_run = runs._replace(recordings=self.validation).index(recording)
                friction = self.final.friction_of_validation
            if of_run is not None:
                m = m.with_values({name: each[of_run] for name, each in friction.items()})
        if k is None and not runs.compared:
            for location in self.offsets:
                m = m.without(*location)
        elif k is not None and fit is not None:
            if runs.compared:  # the run keeps its own offsets even if other runs do not share them
                return fit.model_of(k)
            own = {name: each[k].value for name, each in fit.local.items() if name in m.parameter_names}
            m = m.with_values(own)
        return dataclasses.replace(self.model, mechanism=m)

    @property
    def added(self) -> tuple[tuple[str, str], ...]:
        """Effects of `model` that the user's model lacks, as (effect, port)."""
        before, after = (
            [(e.name, e.at) for e in m.mechanism.effects] for m in (self.baseline.model, self.model)
        )
        return tuple(p for p in after if p not in before)

    @property
    def calibrations(self) -> tuple[tuple[str, str], ...]:
        """Offsets and biases that the search adds to the user's model."""
        return tuple(calibrations(self.baseline.model.mechanism))

    @property
    def offsets(self) -> tuple[tuple[str, str], ...]:
        """Offsets and biases among `added`."""
        return tuple(p for p in self.calibrations if p in self.added)

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Parameters of `model` with intervals."""
        return (self.final_fit or self.final).estimates

    @property
    def final(self) -> Stage:
        """The stage after the last round."""
        return self.rounds[-1].stage if self.rounds else self.baseline

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Baseline, then one stage per round."""
        return (self.baseline, *(r.stage for r in self.rounds))

    @property
    def held_back(self) -> bool:
        """Whether validation recordings were held back; if not, training recordings validated each other."""
        return self.validation != self.train

    @property
    def longest_validation(self) -> int:
        """Index of the longest validation recording, the first of several equally long ones."""
        return max(range(len(self.validation)), key=lambda k: self.validation[k].N)

    @property
    def assessment(self) -> Assessment:
        """What is explained, what remains in units of the noise, and which criterion decided."""
        return assess_stages(self.baseline, self.final, self.noise_floor)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, schema 1.

        `parameters` belong to the last stage. If there is a final fit, the parameters of the model to use are
        in `final_fit`.
        """
        first = self.validation[0]
        return {
            "schema": 1,
            "verdict": self.verdict.value,
            "sentence": self.sentence,
            "assessment": self.assessment.to_dict(),
            "units": dict(zip(first.channels, first.units, strict=True)),
            "baseline": self.baseline.errors(),
            "noise_floor": json_numbers(self.noise_floor),
            "rounds": [r.to_dict() for r in self.rounds],
            "parameters": _parameters(self.final.estimates),
            "friction_of_runs": _as_lists(self.final.friction_of_runs),
            "friction_of_validation": _as_lists(self.final.friction_of_validation),
            "ranking": [r.to_dict() for r in self.ranking],
            "where": [w.to_dict() for w in self.where],
            "next_experiment": self.proposal.to_dict(NEXT) if self.proposal else None,
            "notes": list(self.notes),
            "remarks": [r.to_dict() for r in self.remarks],
            "probabilities": self.probabilities.to_dict() if self.probabilities else None,
            "conditional_intervals": [c.to_dict() for c in self.conditional],
            "final_fit": self.final_fit.to_dict() if self.final_fit else None,
            "elapsed_s": self.elapsed_s,
        }
