"""The final fit of a search that ends unexplained: the chosen structure, to training and validation data.

A search fits its models to the training recordings alone, so that validation data can compare them. Once the
structure is chosen, the validation recordings are as useful for a fit as the training recordings: friction
changes with the amplitude of the motion and from run to run, and more recordings show more of this.

Parameters of an incomplete model depend on what they are fitted to. The search fits them to predictions, or
to free runs with fitted first states, which may hide a drift of the model. A user starts the model from a
measured state. So the final fit is to free runs over windows that start from measured first states. If the
errors of such a fit on validation data are clearly larger than the errors of the search, the first states are
fitted instead, as in the search. Validation data also decide whether recordings get offsets that the search
has left out. A run of which nothing is known gets the offsets that the fitted runs have in common.

Fitted first states hide much of the difference between two laws of friction; measured first states show it.
A law that the search cannot exclude, or that contains the law found, replaces it if free runs from measured
first states are clearly better with it. Each run gets friction of its own size if every run is clearly better
with it, or if a large offset of a run then becomes small. The offsets of a single run are left out if free
runs are not clearly better with them. The same holds for every effect but the first: in predictions it may
compensate, within a few samples, for what no candidate explains.
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
from rotflex_jax.discover.friction_of_runs import offset_stood_for_friction
from rotflex_jax.discover.hypothesis import Hypothesis, with_all_calibrations
from rotflex_jax.discover.in_place import laws_in_question
from rotflex_jax.discover.likelihood import LikelihoodProblem, block_edges
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
from rotflex_jax.discover.validation import (
    ValidatedHypothesis,
    adapted_to_recordings,
    carried_over,
    with_friction_of,
)
from rotflex_jax.errors import InputError
from rotflex_jax.fit.result import Fit
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import joined

# A fit from measured first states is refused if its errors on validation data exceed the errors of the
# search, both fitted to training recordings, by more than this: logarithm of the ratio, mean over channels.
MOST_WORSE = 0.2
# Where runs validate each other, the largest number of fits by which a structure is rated, each of them
# without a share of the runs.
MOST_FOLDS = 3


class Refused(NamedTuple):
    """Why the final model was not fitted to training and validation recordings together.

    Attributes:
        sentence: The reason, for the notes of a result.
    """

    sentence: str


def fit_to_all(
    state: SearchState, stage: Stage, final: ValidatedHypothesis, evaluation: Evaluation
) -> FinalFit | Refused:
    """The final model fitted once more, to training and validation recordings together.

    Args:
        state: The search with what it has found.
        stage: The final model as it is reported.
        final: The final model as a hypothesis.
        evaluation: The recordings on which errors are reported.

    Returns:
        The fit, or the reason why there is none. One reason is that its errors on validation data are clearly
        larger than the errors of the search, with or without these data in the fit. Another reason is a
        periodic disturbance, whose phase no other recording shares.
    """
    if state.problem.supermodel.phased.intersection(final.hypothesis.local):
        return _refused(state, "it has a periodic disturbance, whose phase no other recording shares")
    state.say("fitting the chosen structure to all training and validation recordings")
    try:
        return _FinalFitBuilder(state, stage, evaluation).made(final.hypothesis)
    except InputError as error:  # some recordings cannot be fitted alone; the result of the search remains
        return _refused(state, str(error).rstrip("."))


def _refused(state: SearchState, why: str) -> Refused:
    """A refusal with its reason as a sentence."""
    used = "all recordings" if state.validation.folds else "training and validation recordings together"
    return Refused(f"The model to use is that of the search, not one fitted to {used}: {why}.")


def _worse(ratio: float, seconds: float) -> str:
    """A clause that errors are larger, given the logarithm of their ratio."""
    if np.isinf(ratio):
        return "its runs of the validation data diverge"
    return f"its errors over {seconds:g} s on validation data are {np.exp(ratio):.3g} times as large"


class _Tried(NamedTuple):
    """A structure fitted without the validation data.

    Attributes:
        fits: The fit to the training recordings; where runs validate each other, one fit without each run.
        errors: Errors on the validation recordings, with the own offsets of each where these are calibrated,
            and with friction fitted to them where it differs from that of the training runs.
    """

    fits: Sequence[FittedStructure]
    errors: RunErrors

    @property
    def structure(self) -> FinalStructure:
        """The structure that is fitted."""
        return self.fits[0].structure


class _Candidate(NamedTuple):
    """A structure fitted to all recordings.

    Attributes:
        tried: The structure fitted without the validation data. It is refused if its errors on them are too
            large.
        fitted: The structure fitted to all recordings. Its friction may have a size for each run, even if
            not in `tried`.
        laws: Pairs of an effect that was found and the law that replaces it.
        left_out: Effects and offsets that were found and that the structure does not have.
    """

    tried: _Tried
    fitted: FittedStructure
    laws: tuple[tuple[EffectLocation, EffectLocation], ...] = ()
    left_out: tuple[EffectLocation, ...] = ()


@dataclasses.dataclass(frozen=True)
class _FinalFitBuilder:
    """Makes the final fit of one search.

    Attributes:
        state: The search with what it has found.
        stage: The final model as it is reported.
        evaluation: The recordings on which errors are reported.
    """

    state: SearchState
    stage: Stage
    evaluation: Evaluation

    @functools.cached_property
    def recordings(self) -> tuple[Recording, ...]:
        """Training and validation recordings, with adjoining parts of one run as one recording."""
        validation = self.state.validation
        held_back = () if validation.folds else validation.problem.dataset.recordings
        return joined((*self.state.problem.dataset.recordings, *held_back))

    @property
    def runs(self) -> KnownRuns:
        """The runs of the fitted recordings."""
        return self.evaluation.runs._replace(recordings=self.recordings)

    @property
    def carried_over(self) -> RunErrors:
        """Errors of the search's own fit on the validation recordings, without their own offsets."""
        return RunErrors(self.stage.held_out_rmse, self.stage.held_out_rmse_windows)

    @property
    def searched(self) -> RunErrors:
        """Errors of the search's own fit, with the offsets of each recording where they are calibrated."""
        return self.stage.calibrated or self.carried_over

    def made(self, h: Hypothesis) -> FinalFit | Refused:
        """The final fit of a model; if all are refused, why the one from measured first states is."""
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
        """The fit to free runs with fitted first states, as in the search; None where it is refused too."""
        self.state.say("  with fitted first states")
        best = self.best_trial([each.as_searched() for each in structures])
        if log_error_ratio(best.errors, self.searched) > MOST_WORSE:
            return None
        made = self.accepted(_Candidate(best, self.fitted_to_all(best)))
        return None if isinstance(made, Refused) else made

    def best_trial(self, structures: Sequence[FinalStructure]) -> _Tried:
        """The structure with the smallest errors on validation data."""
        return min(self.tried(structures), key=lambda each: log_error_ratio(each.errors, self.searched))

    def fitted_to_all(self, tried: _Tried) -> FittedStructure:
        """The fit to all recordings of a structure that was fitted without the validation data.

        This earlier fit is one of its starts. Other laws have such a start too, so no law has an advantage.
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
            else:
                validation = self.evaluation.validation.problem
                runs = self.runs._replace(recordings=tuple(parts[0]))
                each = own[0].as_hypotheses(runs.indices(validation.dataset.recordings))
                if structure.hypothesis.sizes:
                    each = _with_friction_of_other_runs(validation, each)
            tried.append(_Tried(own, _on_validation(structure, each, self.evaluation)))
        return tried

    def without_needless_offsets(self, candidate: _Candidate) -> _Candidate:
        """The candidate without the offsets of a single run, if free runs are not clearly better with them.

        They are left out of the fit, since other parameters then compensate for them. They would not
        compensate for an offset that is fitted and then removed.
        """
        offsets = [p for p in candidate.tried.structure.on if p in self.state.problem.supermodel.calibrations]
        if self.evaluation.runs.compared or not offsets:
            return candidate
        return self.without(candidate, offsets)

    def without_needless_effects(self, candidate: _Candidate) -> _Candidate:
        """The candidate without effects that do not make free runs over all recordings clearly better.

        The effect found last is tested first, and the first effect always stays. Free runs over validation
        data must not be clearly better with the effect either.
        """
        calibrations = self.state.problem.supermodel.calibrations
        effects = [p for p in candidate.tried.structure.on if p not in calibrations]
        for location in reversed(effects[1:]):
            candidate = self.without(candidate, [location], FREE_RUN_BETTER)
        return candidate

    def without(
        self, candidate: _Candidate, locations: Sequence[EffectLocation], most_worse: float = np.inf
    ) -> _Candidate:
        """The candidate fitted without some effects or offsets, unless the data need them.

        Args:
            candidate: The candidate with all of them.
            locations: Effects or offsets that are left out.
            most_worse: Logarithm of the ratio by which errors on validation data may be larger without them.

        Returns:
            The new candidate; or the candidate itself if free runs over all recordings are clearly better
            with what is left out, if errors on validation data grow by more than `most_worse`, or if the new
            fit is refused.
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
        """The candidate with other laws in the places of those found, where free runs are better so."""
        for location in self.state.order:
            if location in candidate.tried.structure.on:  # not if a law has replaced it already
                candidate = self.with_best_law(candidate, location)
        return candidate

    def with_best_law(self, candidate: _Candidate, location: EffectLocation) -> _Candidate:
        """The candidate with the best of `laws_in_question` in the place of an effect, if any passes."""
        state, structure = self.state, candidate.tried.structure
        laws = laws_in_question(state, location, structure.on)
        if laws:
            state.say(f"  {' or '.join(map(str, laws))} instead of {location}")
        fits = fit_structures([(candidate.tried.fits[0].with_law(law), self.recordings) for law in laws])
        better = [
            (other, law)
            for other, law in zip(fits, laws, strict=True)
            if state.is_plausible(other.as_hypothesis(), law)
            and self.runs_prefer(other.fit, candidate.fitted.fit)
        ]
        for other, law in sorted(better, key=lambda each: each[0].fit.cost):
            (tried,) = self.tried([other.structure])
            # With the law, errors on validation data may grow by no more than the limit for the fit itself.
            before = (self.searched, candidate.tried.errors)
            if all(log_error_ratio(tried.errors, errors) <= MOST_WORSE for errors in before):
                replaced = [(p, law) for p in structure.on if p not in other.structure.on]
                return candidate._replace(tried=tried, fitted=other, laws=(*candidate.laws, *replaced))
        return candidate

    def with_own_friction(self, candidate: _Candidate) -> _Candidate:
        """The candidate with dry friction of its own size in each run.

        It is taken if every run is clearly better so, or if a large offset of a run then becomes small.
        """
        if log_error_ratio(candidate.tried.errors, self.searched) > MOST_WORSE:
            return candidate  # it would be refused for its errors
        structure = candidate.fitted.with_own_friction()
        if structure.friction == candidate.fitted.structure.friction:
            return candidate
        if not (self.evaluation.runs.compared and len(self.recordings) > 1):
            return candidate
        self.state.say("  with friction of its own size in each run")
        (fitted,) = fit_structures([(structure, self.recordings)])
        better = self.runs_prefer(fitted.fit, candidate.fitted.fit, every=True)
        if not (better or offset_stood_for_friction(candidate.fitted.own_offsets, fitted.own_offsets)):
            return candidate
        return candidate._replace(fitted=fitted)

    def runs_prefer(self, a: Fit, b: Fit, every: bool = False) -> bool:
        """Whether free runs are clearly better with fit `a` than with fit `b`.

        Errors must be smaller by a tenth, and the log-likelihood larger by more than 2.5 standard deviations
        of its scatter over half seconds.

        Args:
            a: The fit in question.
            b: The fit with which it is compared.
            every: Whether the log-likelihood of every recording must be larger by this much, and not only of
                all recordings together.
        """
        smaller = mean_log_ratio(*(np.array([x.noise[c] for c in b.noise]) for x in (a, b)))
        if np.isinf(smaller):  # one of them diverges, and its blocks are not finite
            return smaller < 0
        gains = list(zip(self.blocks(a), self.blocks(b), strict=True))
        if not every:
            gains = [tuple(map(np.concatenate, zip(*gains, strict=True)))]
        return smaller < -FREE_RUN_BETTER and all(paired_gain(*each)[1] > FREE_RUN_Z for each in gains)

    def blocks(self, found: Fit) -> list[Float[np.ndarray, " B"]]:
        """Log-likelihood of free runs in each half second of each recording, up to a constant [nat].

        The fit maximises this likelihood. In a search an effect must help everywhere, so errors count by
        their logarithm; here large errors count by their square, since a user of the model sees them. If a
        few half seconds dominate the gain, its scatter is large as well.
        """
        out, noise = [], np.array(list(found.noise.values()))
        for k, r in enumerate(self.recordings):
            model = found.model_of(k)
            e = model.simulate_windows(r, self.state.validation.window_seconds) - model.measured(r)
            each = -np.sum(0.5 * (e / noise) ** 2 + np.log(noise), axis=1)
            out.append(np.add.reduceat(each, block_edges(r.N, r.Ts)))
        return out

    def hypotheses(self, fitted: FittedStructure, recordings: Sequence[Recording]) -> list[Hypothesis]:
        """A fit to all recordings as hypotheses: one for each recording if friction differs between runs."""
        return fitted.as_hypotheses(self.runs.indices(recordings))

    def accepted(self, candidate: _Candidate) -> tuple[FinalFit, FittedStructure] | Refused:
        """The result for a candidate, with its fit; or why it is refused for its errors on validation data.

        Neither this fit nor the same fit without the validation data may be clearly worse on them than the
        search's own fit.
        """
        tried, fitted, laws, left_out = candidate
        trained, seconds = tried.errors, self.state.validation.window_seconds
        if (ratio := log_error_ratio(trained, self.searched)) > MOST_WORSE:
            others = "the other recordings" if self.state.validation.folds else "the training recordings"
            return _refused(self.state, f"fitted in that way to {others} alone, {_worse(ratio, seconds)}")
        # If a fit to the validation data is clearly worse on them than a fit without them, it has failed. The
        # limit is larger where errors are computed without the own offsets of the recordings.
        if self.evaluation.runs.compared and len(self.recordings) > 1:
            # The common offsets of the runs may differ much from the offsets of a validation run.
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
        """The final fit with its errors on test recordings, if there are any."""
        test, seconds = self.evaluation.test, self.evaluation.calibrate_seconds
        if not test:
            return made
        structure, own = fitted.structure, fitted.own_values(len(self.recordings))
        each = self.hypotheses(fitted, test.problem.dataset.recordings)
        # For a single run, validation data have already decided whether to carry over its offsets.
        of_runs = structure.own if self.runs.compared else ()
        errors = errors_on_test(test, each, own, structure.on, self.runs, of_runs)
        calibrated = errors_with_own_calibration(test, each, structure.on, seconds) if seconds else None
        return dataclasses.replace(made, test=errors, test_calibrated=calibrated)


def _with_offsets_that_help(tried: _Tried, evaluation: Evaluation) -> FinalStructure:
    """The structure that carries over those offsets with which runs over validation data are better."""
    each, structure = [fitted.as_hypothesis() for fitted in tried.fits], tried.structure
    for location in structure.own:
        more = structure.carrying(location)
        errors = (errors_as_trained(evaluation.validation, each, s.on) for s in (more, structure))
        if log_error_ratio(*errors) < 0:
            structure = more
    return structure


def log_error_ratio(a: RunErrors, b: RunErrors) -> float:
    """Mean over channels of the logarithm of errors `a` over errors `b`, both of free runs over windows."""
    before, after = (np.array([x.windows[c] for c in b.windows]) for x in (b, a))
    return mean_log_ratio(after, before)


def _without_each(train: Sequence[Recording]) -> list[list[Recording]]:
    """Training recordings without each one in turn; of more than three, without each third in turn."""
    folds, each = min(len(train), MOST_FOLDS), range(len(train))
    return [[train[k] for k in each if k % folds != fold] for fold in range(folds)]


def _with_friction_of_other_runs(
    validation: LikelihoodProblem, each: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses for validation recordings, with friction fitted to those of runs that were not trained.

    Args:
        validation: Likelihood of free runs over the recordings.
        each: One hypothesis for each recording.
    """
    found = list(each)
    for k in validation.of_other_runs:
        alone = validation.of_recordings([k])
        start = alone.with_likelihood(carried_over(alone, each[k]))  # with the size of errors of free runs
        if np.isfinite(start.log_likelihood):
            found[k] = with_friction_of(adapted_to_recordings(alone, start, friction=True), k, each[k])
    return found


def _on_validation(
    structure: FinalStructure, trained: Sequence[Hypothesis], evaluation: Evaluation
) -> RunErrors:
    """Errors on validation recordings, with the own offsets of each recording where they are calibrated.

    Args:
        structure: Gives the effects that are on.
        trained: One hypothesis for all recordings, or one for each.
        evaluation: The recordings.
    """
    validation, seconds = evaluation.validation, evaluation.calibrate_seconds
    if not seconds:
        return errors_as_trained(validation, trained, structure.on)
    return errors_with_own_calibration(validation, trained, structure.on, seconds)
