"""State of a search: the models after each round, at both horizons, with scores, gains and rivals."""

import dataclasses
import functools
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from rotflex_jax.checks import Progress
from rotflex_jax.discover.checkpoint import (
    AddedEffect,
    KeptStage,
    beginning,
    kept,
    milestone,
    not_kept,
    read_stages,
    restored,
)
from rotflex_jax.discover.friction_of_runs import validated_baseline
from rotflex_jax.discover.hypothesis import Hypothesis, is_physical, law_with_its_size
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.pairs import promising_pairs
from rotflex_jax.discover.reading import (
    nats_if_smooth,
    opposite_signs,
    sign_note,
    smooth_note,
    still_channels,
    still_note,
)
from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.score_test import PairScore, Score, ScoreTest, residual_lines, score_test
from rotflex_jax.discover.selection import best_window_rmse, runs_clearly_better
from rotflex_jax.discover.stepwise import (
    as_given,
    far_from_given,
    fit_baseline,
    fit_free_run_baseline,
)
from rotflex_jax.discover.supermodel import EffectLocation, ErrorLine
from rotflex_jax.discover.validation import (
    Horizons,
    SearchHorizon,
    ValidatedHypothesis,
    ValidationSet,
)
from rotflex_jax.effects.base import Sensing
from rotflex_jax.fit.plausibility import Reach, beyond_recordings
from rotflex_jax.models.model import Model

# An effect is not plausible if it needs an offset or bias of more than this many typical sizes: 0.2 V or
# 0.04 rad.
LARGEST_OFFSET = 4.0


@dataclasses.dataclass
class SearchState:
    """State of a search: everything that it has found so far.

    Attributes:
        model: The user's model.
        horizons: Training and validation recordings at both horizons.
        say: Called with lines of progress.
        current: The best model so far, fitted at both horizons.
        ranking: Scores of all candidates for the baseline, in predictions and in free runs.
        scores: Effects that were added, in order -> penalised score for which they were refitted [nat].
        rivals: Effects that were added -> effects that were not distinguished from them.
        passed: Baseline and the models after each round.
        worth: Effects and calibrations -> gain in log-likelihood by them in the last elimination [nat].
        order: Effects and calibrations of the machine, in order.
        own: Calibrations that belong to the training recordings alone.
        notes: Remarks for a reader.
        gains: Effects that were added -> their gains in predictions and in free runs.
        final: The model that is reported, with parameters of the horizon `reported`.
        tried: Models that were fitted and validated at both horizons.
        alternatives: Other models that were fitted and validated at the reported horizon.
        merged: The final model with one effect that replaces several; None without such an effect.
        in_place_of: The effect that replaces several -> the replaced effect whose place in the order it has.
        machine: Calibrations that belong to the machine.
        start: The model for which candidates were scored first, and its best pairs of candidates.
        tested: The model of which `lines` and `tests` are kept.
        lines: Lines in the spectrum of its errors that the input does not have.
        tests: Its score tests, in predictions and in free runs; None before they are made.
        nominal: The user's model with its given values; None unless the fit has moved far away from them.
        resumed: Number of rounds of a stopped search after which this search continued.
        reading_notes: Notes that recordings may have been read wrongly, or cannot decide.
        step_note: A note that steps of integration are shorter than asked for; empty if they are not.
        digest: Digest of everything that the models depend on.
    """

    model: Model
    horizons: Horizons
    say: Progress
    current: ValidatedHypothesis
    digest: str = ""
    resumed: int = 0
    reading_notes: tuple[str, ...] = ()
    step_note: tuple[str, ...] = ()
    ranking: list[tuple[Score, float]] = dataclasses.field(default_factory=list)
    scores: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    rivals: dict[EffectLocation, list[EffectLocation]] = dataclasses.field(default_factory=dict)
    passed: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    worth: dict[EffectLocation, float] = dataclasses.field(default_factory=dict)
    order: list[EffectLocation] = dataclasses.field(default_factory=list)
    own: list[EffectLocation] = dataclasses.field(default_factory=list)
    notes: tuple[str, ...] = ()
    gains: dict[EffectLocation, tuple[HorizonGain, HorizonGain | None]] = dataclasses.field(
        default_factory=dict
    )
    final: Hypothesis | None = None
    tried: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    alternatives: list[ValidatedHypothesis] = dataclasses.field(default_factory=list)
    merged: ValidatedHypothesis | None = None
    in_place_of: dict[EffectLocation, EffectLocation] = dataclasses.field(default_factory=dict)
    machine: list[EffectLocation] = dataclasses.field(default_factory=list)
    start: tuple[ValidatedHypothesis, list[tuple[PairScore, PairScore]]] | None = None
    tested: Hypothesis | None = None
    lines: tuple[ErrorLine, ...] = ()
    tests: tuple[ScoreTest, ScoreTest] | None = None
    nominal: ValidatedHypothesis | None = None

    @property
    def origin(self) -> ValidatedHypothesis:
        """The model for which candidates are scored: the current one, or the nominal one in the first round.

        In a baseline that hardly moves, no candidate has a slope. With the given values candidates have one.
        """
        return self.nominal if self.nominal and not self.scores else self.current

    @functools.cached_property
    def reach(self) -> Reach:
        """Ranges of the signals of the training recordings."""
        return Reach.of(self.model, self.problem.dataset.recordings)

    def is_plausible(self, h: Hypothesis, location: EffectLocation) -> bool:
        """Whether nothing speaks against the parameters of an effect; see `fault`."""
        return not self.fault(h, location)

    def fault(self, h: Hypothesis, location: EffectLocation) -> str:
        """Why an effect is not physical, or not of a size that the recordings reach; empty if it is both.

        A sensor is not physical if readings as large as the recorded ones correspond to no true value. An
        effect is not plausible either if an offset cancels a part of it (`_needs_large_offset`).
        """
        s = self.problem.supermodel
        if not is_physical(s, h, location):
            return "a parameter is outside its physical range"
        if self._needs_large_offset(h):
            return "an offset far beyond the usual cancels a part of it"
        effect = s.effect(h.mean_values(s), location)
        if isinstance(effect, Sensing) and self.reach.position[effect.at] > effect.largest_reading():
            return "such a sensor could not read what was recorded"
        remarks = beyond_recordings(s.mechanism, self.reach, [effect])
        return next((remark.sentence for remark in remarks), "")

    def _needs_large_offset(self, h: Hypothesis) -> bool:
        """Whether an offset is far beyond its typical size, and over twice as large as in the present model.

        Over a small angle, a large gravity torque and the offset that cancels it are a weak spring. Together
        they follow the errors of the recording, and fail where the angle is another one.
        """
        s = self.problem.supermodel
        for i in [i for p in s.calibrations for i in s.parameter_indices(p) if i in h.local]:
            known = [np.abs(fit.values(s)[:, i]).max() for fit in self.fits if i in fit.local]
            typical = s.mechanism.parameter_specifications[i].typical
            if np.abs(h.values(s)[:, i]).max() > max([LARGEST_OFFSET * typical, *(2 * x for x in known)]):
                return True
        return False

    @property
    def fits(self) -> list[Hypothesis]:
        """The present model, fitted to predictions and, where it was, to free runs."""
        return [v.hypothesis for v in (self.current, self.current.free_run) if v]

    @property
    def problem(self) -> LikelihoodProblem:
        """Likelihood of predictions of the training recordings."""
        return self.horizons.prediction.problem

    @property
    def validation(self) -> ValidationSet:
        """Predictions of the validation recordings."""
        return self.horizons.prediction.validation

    @functools.cached_property
    def still(self) -> dict[str, tuple[float, float]]:
        """Channels that hardly move in the validation data; see `still_channels`."""
        at = self.horizons.free_run
        if at.validation.folds:  # the validation recordings are those of training
            return {}
        return still_channels(at.problem, at.validation.problem)

    @property
    def noise_floor(self) -> dict[str, float]:
        """Channel -> standard deviation of the sensor noise."""
        return dict(zip(self.model.mechanism.channels, self.problem.noise.tolist(), strict=True))

    @property
    def units(self) -> dict[str, str]:
        """Channel -> its own unit."""
        channels, recording = self.model.mechanism.channels, self.validation.problem.dataset.recordings[0]
        return {c: recording.unit(c) for c in channels}

    @property
    def reported(self) -> SearchHorizon:
        """The horizon whose parameters a user gets: predictions, unless fits to free runs are clearly better.

        If the model is complete, both horizons give the same parameters within their scatter, and predictions
        give the narrower intervals.
        """
        runs = self.current.free_run
        if runs is None or not runs_clearly_better(runs.window_rmse, self.current.window_rmse):
            return self.horizons.prediction
        return self.horizons.free_run

    def at(self, horizon: SearchHorizon, found: ValidatedHypothesis) -> ValidatedHypothesis:
        """A validated model with the parameters of one horizon."""
        return found.free_run if horizon is self.horizons.free_run and found.free_run else found

    def reached(self, label: str, added: Sequence[AddedEffect] = ()) -> None:
        """Report the error of the current model, with the effects that were added last."""
        channels, errors = self.model.mechanism.channels, best_window_rmse(self.current)
        line = milestone(label, channels, self.units, errors, self.problem.noise)
        if (runs := self.current.free_run) is not None:
            stage = KeptStage(kept(self.current.hypothesis), kept(runs.hypothesis), tuple(added))
            line.kept = stage.to_dict(self.digest)
        self.say(line)

    def error_lines(self, beside: ValidatedHypothesis) -> tuple[ErrorLine, ...]:
        """Lines in the errors of a model, at which a periodic disturbance is scored; the last are kept."""
        if self.tested is not beside.hypothesis:
            self.tested, self.tests = beside.hypothesis, None
            self.lines = residual_lines(self.problem, beside.hypothesis)
        return self.lines

    def score_tests(self, beside: ValidatedHypothesis) -> tuple[ScoreTest, ScoreTest]:
        """Score tests of all candidates for a model, in predictions and in free runs; the last are kept."""
        assert beside.free_run
        lines = self.error_lines(beside)
        if self.tests is None:
            self.tests = (
                score_test(self.problem, beside.hypothesis, lines, self.is_plausible),
                score_test(
                    self.horizons.free_run.problem, beside.free_run.hypothesis, lines, self.is_plausible
                ),
            )
        return self.tests

    def rank(self, beside: ValidatedHypothesis) -> tuple[list[Score], list[Score]]:
        """Scores of all candidates for a model, in predictions and in free runs; the first are kept."""
        listed, runs = (test.listed for test in self.score_tests(beside))
        if not self.ranking:
            by_runs = {x.location: x.nats for x in runs}
            self.ranking = [(x, by_runs[x.location]) for x in listed]
            self.start = beside, promising_pairs(*self.score_tests(beside))
        return listed, runs

    def add(self, found: ValidatedHypothesis, added: Sequence[AddedEffect]) -> None:
        """Take a model with further effects as the current one, with the data of the effects added."""
        for effect in added:
            self.scores[effect.location] = effect.score
            self.rivals[effect.location] = list(effect.rivals)
            self.gains[effect.location] = effect.gains
        self.current = dataclasses.replace(found, location=None, parameter_count=0)
        self.passed.append(self.current)
        self.reached("+ " + " + ".join(str(effect.location) for effect in added), added)

    def take_refit(self, found: ValidatedHypothesis) -> None:
        """Take another fit of the current model in its place."""
        self.current = self.passed[-1] = found
        self.tried.insert(0, found)

    def in_order(self, on: Collection[EffectLocation]) -> list[EffectLocation]:
        """The effects, among those that are on, that the search has added, in order.

        If an earlier law of the same thing was added and is now off, a law takes the place of this earlier
        law in the order: it describes what was found then.
        """
        added, other_laws = list(self.scores), self.problem.supermodel.other_laws

        def place(location: EffectLocation) -> int:
            before = [p for p in other_laws(location) if p in added and p not in on]
            return min(map(added.index, [location, *before]))

        return sorted((p for p in added if p in on), key=place)

    def hand_over(self, left_out: EffectLocation, h: Hypothesis) -> None:
        """Hand over score, gains and rivals of an effect that was left out to the law that now has its size.

        Score and gains are handed over only if the effect had gained more than the law.

        Args:
            left_out: The effect that was left out.
            h: The model without it.
        """
        law = law_with_its_size(h.locations, left_out)
        if law is None or law not in self.scores:
            return

        def nats(p: EffectLocation) -> float:
            prediction, _ = self.gains[p]
            return prediction.gain + prediction.training_gain

        if nats(left_out) > nats(law):
            self.scores[law], self.gains[law] = self.scores[left_out], self.gains[left_out]
        rivals = dict.fromkeys([*self.rivals[law], *self.rivals[left_out]])
        self.rivals[law] = [p for p in rivals if p not in (law, left_out) and p not in h.locations]

    def replace(self, old: EffectLocation, found: ValidatedHypothesis) -> None:
        """Replace an effect that was added by another law, which gets its score and gains."""
        new = found.location
        assert new
        # The new one may have been added before, and left out again.
        self.scores = {new if p == old else p: score for p, score in self.scores.items() if p != new}
        self.gains = {new if p == old else p: gains for p, gains in self.gains.items() if p != new}
        self.rivals = {new if p == old else p: rivals for p, rivals in self.rivals.items() if p != new}
        self.rivals[new] = [old, *(p for p in self.rivals[new] if p != new)]
        self.current = dataclasses.replace(found, location=None, parameter_count=0)


def fit_as_it_is(model: Model, horizons: Horizons, say: Progress, digest: str) -> SearchState:
    """The state at the start of a search: the user's model, fitted and validated."""
    say(beginning("baseline", "fitting the model as it is"))
    h = fit_baseline(horizons.prediction.problem)
    runs = fit_free_run_baseline(horizons.free_run.problem, h)
    current = validated_baseline(horizons, h, runs)
    state = SearchState(model, horizons, say, current, digest, passed=[current], tried=[current])
    state.reached("as it is")
    _check_baseline(state)
    return state


def _check_baseline(state: SearchState) -> None:
    """Check by the baseline how recordings were read, and whether its fit has moved far from given values."""
    notes = smooth_note(nats_if_smooth(state.problem, state.current.hypothesis))
    if runs := state.current.free_run:
        problem, seconds = state.horizons.free_run.problem, state.validation.window_seconds
        signs = opposite_signs(state.model, problem, runs.hypothesis, seconds)
        notes += sign_note(signs, state.units, seconds)
    notes += still_note(state.still, state.units, state.validation.window_seconds)
    state.reading_notes = notes
    for line in notes:
        state.say(line)
    if any(far_from_given(state.problem.supermodel, h) for h in state.fits):
        state.nominal = as_given(state.horizons)


def as_it_was(model: Model, horizons: Horizons, say: Progress, digest: str, path: str | Path) -> SearchState:
    """The state of a stopped search, read from its file and validated again."""
    stages = read_stages(path, digest)
    say(f"going on after {len(stages) - 1} finished rounds")
    # All stages are restored before any is reported, since reported stages go into the new file of rounds.
    found: list[ValidatedHypothesis] = []
    for stage in stages:
        try:
            h = restored(horizons.prediction.problem, stage.prediction)
            runs = restored(horizons.free_run.problem, stage.free_run)
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError):
            raise not_kept(path) from None
        found.append(horizons.validated(h, runs, found[-1] if found else None))
    first, *later = found
    state = SearchState(model, horizons, say, first, digest, len(later), passed=[first], tried=[first])
    _check_baseline(state)
    if later:
        state.rank(state.origin)
    state.reached("as it is")
    for reached, stage in zip(later, stages[1:], strict=True):
        state.add(reached, stage.added)
    return state
