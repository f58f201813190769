"""What a search has found so far: the models after each round, at both horizons, and what led to them."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

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
from rotflex_jax.discover.stepwise import as_given, far_from_given, fit_baseline, fit_free_run_baseline
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import (
    Horizons,
    SearchHorizon,
    ValidatedHypothesis,
    ValidationSet,
)
from rotflex_jax.effects.base import Sensing
from rotflex_jax.fit.plausibility import Reach, beyond_recordings
from rotflex_jax.models.model import Model

Progress = Callable[[str], None]


@dataclasses.dataclass
class SearchState:
    """What a search has found so far.

    Attributes:
        model: The user's model.
        horizons: The training and validation recordings as predictions and as free runs.
        say: Called with lines of progress.
        current: The best model so far, fitted at both horizons.
        ranking: Scores of all candidates beside the baseline, of predictions and of free runs.
        scores: Effects that were added, in order -> the penalised score that put them forward [nat].
        rivals: Effects that were added -> those that were not distinguished from them.
        passed: Baseline and the models after each round.
        worth: What the last test of need gave each effect and calibration [nat].
        order: Effects and calibrations of the machine, in order.
        own: Calibrations that belong to the training recordings alone.
        notes: Remarks for a reader.
        gains: Effects that were added -> what they gained at both horizons.
        final: The model that is reported, with the parameters of `reported`.
        tried: Models fitted and validated at both horizons on the way.
        alternatives: Models fitted and validated at the reported horizon beside the final one.
        merged: The final model with one effect in the place of several, where it has one.
        in_place_of: That effect -> the one of several whose place in the order it took.
        machine: Calibrations that belong to the machine.
        start: The model beside which all candidates were scored first, and the best pairs of these.
        tests: Score tests of the model of `tested`, of predictions and of free runs.
        tested: The model whose score tests were made last.
        nominal: The user's model with the values that it has, where the fit has moved far away from these.
        resumed: After how many rounds of a search that was stopped this one went on.
        reading_notes: That recordings may have been read wrongly or cannot decide, in sentences.
        digest: Of all that the models depend on.
    """

    model: Model
    horizons: Horizons
    say: Progress
    current: ValidatedHypothesis
    digest: str = ""
    resumed: int = 0
    reading_notes: tuple[str, ...] = ()
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
    tests: tuple[ScoreTest, ScoreTest] | None = None
    tested: Hypothesis | None = None
    nominal: ValidatedHypothesis | None = None

    @property
    def origin(self) -> ValidatedHypothesis:
        """The model beside which slopes say what a candidate would do: the current one, or the nominal one.

        Beside a baseline that hardly moves no candidate has a slope; beside the given values it has.
        """
        return self.nominal if self.nominal and not self.scores else self.current

    @functools.cached_property
    def reach(self) -> Reach:
        """How far the signals of the training recordings go."""
        return Reach.of(self.model, self.problem.dataset.recordings)

    def is_plausible(self, h: Hypothesis, location: EffectLocation) -> bool:
        """Whether the parameters of an effect are physical, and of sizes that the recordings reach.

        A sensor of which readings as large as the recorded ones belong to no true value is not physical.
        """
        s = self.problem.supermodel
        if not is_physical(s, h, location):
            return False
        m = s.clean(h.mean_values(s), h.locations)
        effect = m.effect(*location)
        if isinstance(effect, Sensing) and self.reach.position[effect.at] > effect.largest_reading():
            return False
        return not beyond_recordings(m, self.reach, [effect])

    @property
    def problem(self) -> LikelihoodProblem:
        """The likelihood of predictions of the training recordings."""
        return self.horizons.prediction.problem

    @property
    def validation(self) -> ValidationSet:
        """Predictions of the validation recordings."""
        return self.horizons.prediction.validation

    @property
    def noise_floor(self) -> dict[str, float]:
        """Channel -> standard deviation of what the sensor adds by itself."""
        return dict(zip(self.model.mechanism.channels, self.problem.noise.tolist(), strict=True))

    @property
    def units(self) -> dict[str, str]:
        """Channel -> its own unit."""
        channels, recording = self.model.mechanism.channels, self.validation.problem.dataset.recordings[0]
        return {c: recording.unit(c) for c in channels}

    @property
    def reported(self) -> SearchHorizon:
        """The horizon whose parameters a user gets: that of predictions, unless free runs are clearly better.

        Where the model is complete both give the same within their scatter, and predictions have the narrower
        intervals.
        """
        runs = self.current.free_run
        if runs is None or not runs_clearly_better(runs.window_rmse, self.current.window_rmse):
            return self.horizons.prediction
        return self.horizons.free_run

    def at(self, horizon: SearchHorizon, found: ValidatedHypothesis) -> ValidatedHypothesis:
        """A validated structure with the parameters of one horizon."""
        return found.free_run if horizon is self.horizons.free_run and found.free_run else found

    def reached(self, label: str, added: Sequence[AddedEffect] = ()) -> None:
        """Report the error of the current model, after effects were added."""
        channels, errors = self.model.mechanism.channels, best_window_rmse(self.current)
        line = milestone(label, channels, self.units, errors, self.problem.noise)
        if (runs := self.current.free_run) is not None:
            stage = KeptStage(kept(self.current.hypothesis), kept(runs.hypothesis), tuple(added))
            line.kept = stage.to_dict(self.digest)
        self.say(line)

    def score_tests(self, beside: ValidatedHypothesis) -> tuple[ScoreTest, ScoreTest]:
        """Score tests of predictions and of free runs beside a model; those made last are kept."""
        assert beside.free_run
        if self.tests is None or self.tested is not beside.hypothesis:
            self.tested = beside.hypothesis
            lines = residual_lines(self.problem, beside.hypothesis)
            self.tests = (
                score_test(self.problem, beside.hypothesis, lines),
                score_test(self.horizons.free_run.problem, beside.free_run.hypothesis, lines),
            )
        return self.tests

    def rank(self, beside: ValidatedHypothesis) -> tuple[list[Score], list[Score]]:
        """Scores of all candidates beside a model, of predictions and of free runs; the first are kept."""
        listed, runs = (test.listed for test in self.score_tests(beside))
        if not self.ranking:
            by_runs = {x.location: x.nats for x in runs}
            self.ranking = [(x, by_runs[x.location]) for x in listed]
            self.start = beside, promising_pairs(*self.score_tests(beside))
        return listed, runs

    def add(self, found: ValidatedHypothesis, added: Sequence[AddedEffect]) -> None:
        """One model more, with the effects that led to it."""
        for effect in added:
            self.scores[effect.location] = effect.score
            self.rivals[effect.location] = list(effect.rivals)
            self.gains[effect.location] = effect.gains
        self.current = dataclasses.replace(found, location=None, parameter_count=0)
        self.passed.append(self.current)
        self.reached("+ " + " + ".join(str(effect.location) for effect in added), added)

    def in_order(self, on: Collection[EffectLocation]) -> list[EffectLocation]:
        """Those of some effects that were added, in order.

        A law stands where an earlier one of the same thing was added that is off: more of what was already
        found is no later discovery.
        """
        added, other_laws = list(self.scores), self.problem.supermodel.other_laws

        def place(location: EffectLocation) -> int:
            before = [p for p in other_laws(location) if p in added and p not in on]
            return min(map(added.index, [location, *before]))

        return sorted((p for p in added if p in on), key=place)

    def hand_over(self, left_out: EffectLocation, h: Hypothesis) -> None:
        """Give what an effect has gained to the law that has its size now, if that was more, and its rivals.

        Args:
            left_out: The effect.
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
        """Put another law in the place of an effect that was added, whose score and gains remain."""
        new = found.location
        assert new
        # The new one may have been added before, and left out again.
        self.scores = {new if p == old else p: score for p, score in self.scores.items() if p != new}
        self.gains = {new if p == old else p: gains for p, gains in self.gains.items() if p != new}
        self.rivals = {new if p == old else p: rivals for p, rivals in self.rivals.items() if p != new}
        self.rivals[new] = [old, *(p for p in self.rivals[new] if p != new)]
        self.current = dataclasses.replace(found, location=None, parameter_count=0)


def fit_as_it_is(model: Model, horizons: Horizons, say: Progress, digest: str) -> SearchState:
    """The user's model, fitted and validated."""
    say(beginning("baseline", "fitting the model as it is"))
    h = fit_baseline(horizons.prediction.problem)
    current = horizons.validated(h, fit_free_run_baseline(horizons.free_run.problem, h))
    state = SearchState(model, horizons, say, current, digest, passed=[current], tried=[current])
    state.reached("as it is")
    _check_baseline(state)
    return state


def _check_baseline(state: SearchState) -> None:
    """Whether the baseline asks for another reading of the data, and whether its fit has gone far away."""
    notes = smooth_note(nats_if_smooth(state.problem, state.current.hypothesis))
    if runs := state.current.free_run:
        problem, seconds = state.horizons.free_run.problem, state.validation.window_seconds
        signs = opposite_signs(state.model, problem, runs.hypothesis, seconds)
        notes += sign_note(signs, state.units, seconds)
    notes += _still_channels(state)
    state.reading_notes = notes
    for line in notes:
        state.say(line)
    fits = [v.hypothesis for v in (state.current, state.current.free_run) if v]
    if any(far_from_given(state.problem.supermodel, h) for h in fits):
        state.nominal = as_given(state.horizons)


def _still_channels(state: SearchState) -> tuple[str, ...]:
    """Which channels hardly move in the validation data, in a sentence each."""
    at = state.horizons.free_run
    if at.validation.folds:  # the validation recordings are those of training
        return ()
    found = still_channels(at.problem, at.validation.problem)
    return still_note(found, state.units, at.validation.window_seconds)


def as_it_was(model: Model, horizons: Horizons, say: Progress, digest: str, path: str | Path) -> SearchState:
    """What a search that was stopped had found, validated again."""
    stages = read_stages(path, digest)
    say(f"going on after {len(stages) - 1} finished rounds")
    # All of them before any is reported: what is reported is what a file of rounds so far keeps.
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
