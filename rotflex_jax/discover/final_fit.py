"""The last fit of a search that ends unexplained: the chosen structure, to training and validation data.

A search fits its models to the training recordings alone, so that validation data can compare them. Once the
structure is chosen, the validation recordings are as useful for a fit as the others: friction differs with
the amplitude of the motion and from run to run, and half of the recordings show half of that.

Parameters of an incomplete model depend on what they are fitted to. Those of the search are fitted to
predictions, or to free runs that each have a fitted first state, which may hide a drift of the model. A user
starts the model from a measured state. So this fit is to free runs over windows, each from the state that its
first samples show. Where such a fit has clearly larger errors on validation data than the fit of the search,
tried on the training recordings alone too, it is to free runs with fitted first states instead, as in the
search. Validation data also decide whether recordings have offsets that the search could do without. A run of
which nothing is known gets the offsets that the fitted runs have in common.

In a search each free run has a fitted first state, which hides much of the difference between one law of
friction and another. Runs from measured first states show this difference: a law that the search cannot
exclude, or that contains the one found, takes its place where these runs are better with it beyond doubt.
Where every run is better beyond doubt with a friction of its own size, each has one. An offset that a single
run has shown is left out where that run is hardly better with it. So is any effect but the first where such
runs are not clearly better with it: in predictions it may make up, within a few samples, for what no
candidate explains.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.evaluation import (
    Evaluation,
    errors_as_trained,
    errors_on_test,
    errors_with_own_calibration,
)
from rotflex_jax.discover.final_structure import FinalStructure, FittedStructure, fit_structures
from rotflex_jax.discover.hypothesis import Hypothesis, with_all_calibrations
from rotflex_jax.discover.in_place import laws_in_question
from rotflex_jax.discover.likelihood import block_edges
from rotflex_jax.discover.result import FinalFit, KnownRuns, RunErrors, Stage
from rotflex_jax.discover.search_state import SearchState
from rotflex_jax.discover.selection import (
    FREE_RUN_BETTER,
    FREE_RUN_Z,
    WINDOWS_APART,
    mean_log_ratio,
    paired_gain,
)
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis
from rotflex_jax.errors import InputError
from rotflex_jax.fit.result import Fit
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import joined

# Errors of a fit from measured first states over those of the search, both fitted to training recordings,
# up to which the former is taken: logarithm of their ratio on validation data, mean over channels.
MOST_WORSE = 0.2
# Where runs validate each other, at most so many fits, each without a share of them, rate a way of fitting.
MOST_FOLDS = 3


class Refused(NamedTuple):
    """Why the final model was not fitted to training and validation recordings together.

    Attributes:
        sentence: For the notes of a result.
    """

    sentence: str


def fit_to_all(
    state: SearchState, stage: Stage, final: ValidatedHypothesis, evaluation: Evaluation
) -> FinalFit | Refused:
    """The final model fitted once more, to training and validation recordings together.

    Args:
        state: What was found.
        stage: The final model as it is reported.
        final: The same as a hypothesis.
        evaluation: The recordings that errors are reported on.

    Returns:
        The fit; or why there is none: its errors on validation data are clearly larger than those of the
        search, fitted without these data or to them as well, or it has a periodic disturbance, whose phase
        no other recording shares.
    """
    if state.problem.supermodel.phased.intersection(final.hypothesis.local):
        return _refused(state, "it has a periodic disturbance, whose phase no other recording shares")
    state.say("fitting the chosen structure to all training and validation recordings")
    try:
        return _LastFit(state, stage, evaluation).made(final.hypothesis)
    except InputError as error:  # some recordings cannot be fitted alone: no reason to lose what was found
        return _refused(state, str(error).rstrip("."))


def _refused(state: SearchState, why: str) -> Refused:
    """A reason as a sentence."""
    used = "all recordings" if state.validation.folds else "training and validation recordings together"
    return Refused(f"The model to use is that of the search, not one fitted to {used}: {why}.")


def _worse(ratio: float, seconds: float) -> str:
    """That errors are larger, by the logarithm of their ratio."""
    if np.isinf(ratio):
        return "its runs of the validation data diverge"
    return f"its errors over {seconds:g} s on validation data are {np.exp(ratio):.3g} times as large"


class _Tried(NamedTuple):
    """A structure fitted without the validation data.

    Attributes:
        fits: To the training recordings; where runs validate each other, one without each of them.
        errors: On the validation recordings, with their own offsets if these count.
    """

    fits: Sequence[FittedStructure]
    errors: RunErrors

    @property
    def structure(self) -> FinalStructure:
        """What is fitted."""
        return self.fits[0].structure


class _Candidate(NamedTuple):
    """A structure fitted to all recordings.

    Attributes:
        tried: The structure fitted without the validation data, whose errors on these may refuse it.
        fitted: It is fitted to all; its friction may belong to runs, unlike in `tried`.
        laws: Pairs of an effect that was found and the law that stands in its place.
        left_out: Effects and offsets that were found and that the structure does without.
    """

    tried: _Tried
    fitted: FittedStructure
    laws: tuple[tuple[EffectLocation, EffectLocation], ...] = ()
    left_out: tuple[EffectLocation, ...] = ()


@dataclasses.dataclass(frozen=True)
class _LastFit:
    """The final fit of one search.

    Attributes:
        state: What was found.
        stage: The final model as it is reported.
        evaluation: The recordings that errors are reported on.
    """

    state: SearchState
    stage: Stage
    evaluation: Evaluation

    @functools.cached_property
    def recordings(self) -> tuple[Recording, ...]:
        """Training and validation recordings, parts of one run that follow on each other as one."""
        validation = self.state.validation
        held_back = () if validation.folds else validation.problem.dataset.recordings
        return joined((*self.state.problem.dataset.recordings, *held_back))

    @property
    def runs(self) -> KnownRuns:
        """Those of the recordings."""
        return self.evaluation.runs._replace(recordings=self.recordings)

    @property
    def carried_over(self) -> RunErrors:
        """Errors of the search's own fit on the validation recordings, with nothing of these."""
        return RunErrors(self.stage.held_out_rmse, self.stage.held_out_rmse_windows)

    @property
    def searched(self) -> RunErrors:
        """The same with their own offsets, if these count."""
        return self.stage.calibrated or self.carried_over

    def made(self, h: Hypothesis) -> FinalFit | Refused:
        """The fit of a final model; or why that from measured first states is refused, where all are."""
        state, seconds, s = self.state, self.state.validation.window_seconds, self.state.problem.supermodel
        variants = {v.locations: v for v in (h, with_all_calibrations(s, h))}
        structures = [
            FinalStructure.of(s, state.model.solver, v, state.order, seconds) for v in variants.values()
        ]
        best = self.best_trial(structures)
        candidates = [_Candidate(best, self.fitted_to_all(best))]
        for improved in (
            self.without_needless_offsets,
            self.with_better_laws,
            self.without_needless_effects,
            self.with_own_friction,
        ):
            if (better := improved(candidates[-1])) is not candidates[-1]:
                candidates.append(better)
        made = self.accepted(candidates.pop())
        while isinstance(made, Refused) and candidates:
            made = self.accepted(candidates.pop())
        if isinstance(made, Refused):
            made = self.with_fitted_first_states(structures) or made
        return made if isinstance(made, Refused) else self.tested(*made)

    def with_fitted_first_states(
        self, structures: Sequence[FinalStructure]
    ) -> tuple[FinalFit, FittedStructure] | None:
        """The fit to free runs like those of the search; None where it is refused too."""
        self.state.say("  with fitted first states")
        best = self.best_trial([each.as_searched() for each in structures])
        if log_error_ratio(best.errors, self.searched) > MOST_WORSE:
            return None
        made = self.accepted(_Candidate(best, self.fitted_to_all(best)))
        return None if isinstance(made, Refused) else made

    def best_trial(self, structures: Sequence[FinalStructure]) -> _Tried:
        """The structure that has the smallest errors on validation data."""
        return min(self.tried(structures), key=lambda each: log_error_ratio(each.errors, self.searched))

    def fitted_to_all(self, tried: _Tried) -> FittedStructure:
        """The fit to all recordings of what was fitted without the validation data.

        It starts from there too, as laws in question do: neither has a start that the other lacks.
        """
        structure = tried.structure.also_from(tried.fits[0].fit.model)
        (fitted,) = fit_structures([(structure, self.recordings)])
        return FittedStructure(tried.structure, fitted.fit)

    def tried(self, structures: Sequence[FinalStructure]) -> list[_Tried]:
        """Structures fitted to the training recordings, and validated."""
        train = self.state.problem.dataset.recordings
        parts = _without_each(train) if self.state.validation.folds else [joined(train)]
        fits = fit_structures([(structure, part) for structure in structures for part in parts])
        tried = []
        for k, structure in enumerate(structures):
            own = fits[k * len(parts) : (k + 1) * len(parts)]
            if self.state.validation.folds:  # for each recording the fit without it
                own = [own[i % len(parts)] for i in range(len(train))]
            each = [one.as_hypothesis() for one in own]
            tried.append(_Tried(own, _on_validation(structure, each, self.evaluation)))
        return tried

    def without_needless_offsets(self, candidate: _Candidate) -> _Candidate:
        """The same without offsets that a single run has shown, if it is not clearly better with them.

        Other parameters make up for an offset that is not fitted, but not for one that is left out later.
        """
        offsets = [p for p in candidate.tried.structure.on if p in self.state.problem.supermodel.calibrations]
        if self.evaluation.runs.compared or not offsets:
            return candidate
        return self.without(candidate, offsets)

    def without_needless_effects(self, candidate: _Candidate) -> _Candidate:
        """The same without effects that free runs of all recordings are not clearly better with.

        The last one found is tried first, and the first one stays. Runs of validation data must not be
        clearly better with the effect either.
        """
        calibrations = self.state.problem.supermodel.calibrations
        effects = [p for p in candidate.tried.structure.on if p not in calibrations]
        for location in reversed(effects[1:]):
            candidate = self.without(candidate, [location], FREE_RUN_BETTER)
        return candidate

    def without(
        self, candidate: _Candidate, locations: Sequence[EffectLocation], most_worse: float = np.inf
    ) -> _Candidate:
        """The candidate fitted without some of what was found, unless data need it.

        Args:
            candidate: With all of it.
            locations: What is left out.
            most_worse: Logarithm of the ratio by which errors on validation data may be larger without it.

        Returns:
            The candidate itself where free runs of all recordings are clearly better than without, where
            errors on validation data grow by more than that, and where the fit without is refused.
        """
        self.state.say(f"  without {', '.join(map(str, locations))}")
        (tried,) = self.tried([candidate.tried.fits[0].without(locations)])
        if log_error_ratio(tried.errors, candidate.tried.errors) > most_worse:
            return candidate
        fitted = self.fitted_to_all(tried)
        if self.runs_prefer(candidate.fitted.fit, fitted.fit):
            return candidate
        found = [[before for before, used in candidate.laws if used == p] or [p] for p in locations]
        fewer = _Candidate(
            tried=tried,
            fitted=fitted,
            laws=tuple(pair for pair in candidate.laws if pair[1] not in locations),
            left_out=(*candidate.left_out, *(p for each in found for p in each)),
        )
        return candidate if isinstance(self.accepted(fewer), Refused) else fewer

    def with_better_laws(self, candidate: _Candidate) -> _Candidate:
        """The same with other laws in the places of those found, where free runs are better with them."""
        for location in self.state.order:
            if location in candidate.tried.structure.on:  # not where a law has taken its place already
                candidate = self.with_best_law(candidate, location)
        return candidate

    def with_best_law(self, candidate: _Candidate, location: EffectLocation) -> _Candidate:
        """The candidate with the best of `laws_in_question` in the place of an effect, if any passes."""
        state, structure = self.state, candidate.tried.structure
        laws = laws_in_question(state, location, structure.on)
        if laws:
            state.say(f"  in the place of {location}: {', '.join(map(str, laws))}")
        fits = fit_structures([(candidate.tried.fits[0].with_law(law), self.recordings) for law in laws])
        better = [
            (other, law)
            for other, law in zip(fits, laws, strict=True)
            if state.is_plausible(other.as_hypothesis(), law)
            and self.runs_prefer(other.fit, candidate.fitted.fit)
        ]
        for other, law in sorted(better, key=lambda each: each[0].fit.cost):
            (tried,) = self.tried([other.structure])
            # With the law, errors on validation data may grow by no more than the fit itself is allowed.
            before = (self.searched, candidate.tried.errors)
            if all(log_error_ratio(tried.errors, errors) <= MOST_WORSE for errors in before):
                replaced = [(p, law) for p in structure.on if p not in other.structure.on]
                return candidate._replace(tried=tried, fitted=other, laws=(*candidate.laws, *replaced))
        return candidate

    def with_own_friction(self, candidate: _Candidate) -> _Candidate:
        """The same with dry friction of its own size in each run, if every run is better with that."""
        if log_error_ratio(candidate.tried.errors, self.searched) > MOST_WORSE:
            return candidate  # it would be refused for that
        structure = candidate.fitted.with_own_friction()
        if not (structure.friction and self.evaluation.runs.compared and len(self.recordings) > 1):
            return candidate
        self.state.say("  with friction of its own size in each run")
        (fitted,) = fit_structures([(structure, self.recordings)])
        if not self.runs_prefer(fitted.fit, candidate.fitted.fit, every=True):
            return candidate
        return candidate._replace(fitted=fitted)

    def runs_prefer(self, a: Fit, b: Fit, every: bool = False) -> bool:
        """Whether errors of free runs of fit `a` are a tenth smaller than those of `b`, beyond doubt.

        Args:
            a: The fit in question.
            b: The fit that it is compared with.
            every: Whether the runs of every recording have to be better with it beyond doubt.
        """
        smaller = mean_log_ratio(*(np.array([x.noise[c] for c in b.noise]) for x in (a, b)))
        if np.isinf(smaller):  # one of them diverges, and its half seconds are not numbers
            return smaller < 0
        gains = list(zip(self.blocks(a), self.blocks(b), strict=True))
        if not every:
            gains = [tuple(map(np.concatenate, zip(*gains, strict=True)))]
        return smaller < -FREE_RUN_BETTER and all(paired_gain(*each)[1] > FREE_RUN_Z for each in gains)

    def blocks(self, found: Fit) -> list[Float[np.ndarray, " B"]]:
        """Log-likelihood of free runs in each half second of each recording, up to a constant [nat].

        It is the one that the fit maximises. Unlike in a search, where an effect has to help everywhere,
        large errors count by their square: they are what a user of the model sees. If a few half seconds
        decide, their scatter is as large.
        """
        out, noise = [], np.array(list(found.noise.values()))
        for k, r in enumerate(self.recordings):
            model = found.model_of(k)
            e = model.simulate_windows(r, self.state.validation.window_seconds) - model.measured(r)
            each = -np.sum(0.5 * (e / noise) ** 2 + np.log(noise), axis=1)
            out.append(np.add.reduceat(each, block_edges(r.N, r.Ts)))
        return out

    def hypotheses(self, fitted: FittedStructure, recordings: Sequence[Recording]) -> list[Hypothesis]:
        """A fit to all, for some recordings: one for each where friction belongs to runs."""
        return fitted.as_hypotheses([self.runs.index(r) for r in recordings])

    def accepted(self, candidate: _Candidate) -> tuple[FinalFit, FittedStructure] | Refused:
        """The result with a candidate and its fit, or why it is refused for its errors on validation data.

        Neither the same fit without these data nor this fit may be clearly worse than that of the search.
        """
        tried, fitted, laws, left_out = candidate
        trained, seconds = tried.errors, self.state.validation.window_seconds
        if (ratio := log_error_ratio(trained, self.searched)) > MOST_WORSE:
            others = "the other recordings" if self.state.validation.folds else "the training recordings"
            return _refused(self.state, f"fitted in that way to {others} alone, {_worse(ratio, seconds)}")
        # A fit to recordings that does clearly worse on them than one without them has failed.
        # Without their offsets it may be worse by more.
        if self.evaluation.runs.compared and len(self.recordings) > 1:
            # What most runs have in common may be far from what a run of validation data has.
            options = [fitted.with_common_offsets(), fitted]
        else:
            options = [FittedStructure(_with_offsets_that_help(tried, self.evaluation), fitted.fit)]
        validation = self.evaluation.validation
        for fitted in options:
            each = self.hypotheses(fitted, validation.problem.dataset.recordings)
            errors = errors_as_trained(validation, each, fitted.structure.on)
            carried = log_error_ratio(errors, self.carried_over)
            if carried <= MOST_WORSE:
                break
        own = log_error_ratio(_on_validation(fitted.structure, each, self.evaluation), self.searched)
        if carried > MOST_WORSE or own > WINDOWS_APART:
            worse = _worse(carried if carried > MOST_WORSE else own, seconds)
            return _refused(self.state, f"{worse}, although it was fitted to them")
        made = FinalFit(
            fit=fitted.fit,
            recordings=self.recordings,
            model=fitted.model,
            trained=trained,
            searched=self.searched,
            laws=laws,
            friction=fitted.structure.friction,
            left_out=left_out,
        )
        return made, fitted

    def tested(self, made: FinalFit, fitted: FittedStructure) -> FinalFit:
        """A final fit with its errors on test recordings, if there are any."""
        test, seconds = self.evaluation.test, self.evaluation.calibrate_seconds
        if not test:
            return made
        structure, own = fitted.structure, fitted.own_values(len(self.recordings))
        each = self.hypotheses(fitted, test.problem.dataset.recordings)
        # Of one run alone, validation data have decided already whether its own offsets are of use.
        of_runs = structure.own if self.runs.compared else ()
        errors = errors_on_test(test, each, own, structure.on, self.runs, of_runs)
        calibrated = errors_with_own_calibration(test, each, structure.on, seconds) if seconds else None
        return dataclasses.replace(made, test=errors, test_calibrated=calibrated)


def _with_offsets_that_help(tried: _Tried, evaluation: Evaluation) -> FinalStructure:
    """The structure that carries over the offsets with which runs of validation data are better."""
    each, structure = [fitted.as_hypothesis() for fitted in tried.fits], tried.structure
    for location in structure.own:
        more = structure.carrying(location)
        errors = (errors_as_trained(evaluation.validation, each, s.on) for s in (more, structure))
        if log_error_ratio(*errors) < 0:
            structure = more
    return structure


def log_error_ratio(a: RunErrors, b: RunErrors) -> float:
    """Logarithm of errors `a` over windows by errors `b`, mean over channels; see `mean_log_ratio`."""
    before, after = (np.array([x.windows[c] for c in b.windows]) for x in (b, a))
    return mean_log_ratio(after, before)


def _without_each(train: Sequence[Recording]) -> list[list[Recording]]:
    """Training recordings without each in turn; of many, without every third one at a time."""
    folds, each = min(len(train), MOST_FOLDS), range(len(train))
    return [[train[k] for k in each if k % folds != fold] for fold in range(folds)]


def _on_validation(
    structure: FinalStructure, trained: Sequence[Hypothesis], evaluation: Evaluation
) -> RunErrors:
    """Errors on validation recordings of one hypothesis or one for each, with own offsets if these count."""
    validation, seconds = evaluation.validation, evaluation.calibrate_seconds
    if not seconds:
        return errors_as_trained(validation, trained, structure.on)
    return errors_with_own_calibration(validation, trained, structure.on, seconds)
