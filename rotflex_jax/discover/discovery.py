"""The result of `discover`: what was found, and what can be done with it."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rotflex_jax import checks
from rotflex_jax.discover.bands import bands_of_final_fit, bands_of_sets
from rotflex_jax.discover.conclusion import proposed
from rotflex_jax.discover.explanation import (
    SHOWN_SECONDS,
    Explanation,
    LatentTorqueComparison,
    compare_latent_torques,
    model_tests,
    remaining_failures,
)
from rotflex_jax.discover.learned_torque import LearnedTorqueResult, learn_torque
from rotflex_jax.discover.result import NEXT, KnownRuns, SearchResult
from rotflex_jax.discover.tables import (
    channel_headings,
    channel_units,
    description_in_use,
    error_rows,
    estimates_in_use,
    final_fit_sentence,
    noise_row,
    notes_in_words,
    outcomes,
    stage_labels,
    where_sentence,
)
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects.labels import effect_label, sentence
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import Experiment
from rotflex_jax.experiment.until_decided import models_of
from rotflex_jax.fit.bands import Bands, checked_level
from rotflex_jax.fit.greybox import fit
from rotflex_jax.fit.identifiable import Identifiability, identifiable
from rotflex_jax.fit.result import Fit
from rotflex_jax.models.model import Model
from rotflex_jax.models.model_json import Saved, save
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, listed_if_given, single
from rotflex_jax.text.markup import as_json, bullets, card, folded, paragraph, picture, table, write_files
from rotflex_jax.text.numbers import equation, plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.svg import staircase

# Candidates of the ranking that a notebook lists.
LISTED_CANDIDATES = 8


@dataclasses.dataclass(frozen=True)
class Discovery(SearchResult):
    """The result of a search, with its report, the torques that are missing, and the next experiment."""

    @functools.cached_property
    def _fits(self) -> list[tuple[Fit, float]]:
        """Cache, filled by the first call of `_probable_fits`."""
        return []

    def __str__(self) -> str:
        lines = [self.sentence]
        lines += [f"  {i}. {description_in_use(self, r)}" for i, r in enumerate(self.rounds, 1)]
        lines += [self.probabilities.sentence] if self.probabilities else []
        return "\n".join(line for line in (*lines, final_fit_sentence(self)) if line)

    def latent_torque(self, progress: Callable[[str], None] | None = None) -> LatentTorqueComparison:
        """Torques that the baseline and the final model lack, on a fitted and a validation recording.

        If a part of the final model belongs to single recordings, they are those on a fitted recording alone.
        """
        groups = (self.train, self.validation) if self.held_back else (self.train,)
        before, after, alone = self.baseline, self.final, None
        if any(e.line for e in after.model.mechanism.effects):
            alone = 0  # a periodic disturbance has the phase of the first recording in this model
        elif before.friction_of_runs or after.friction_of_runs:
            alone = max(range(len(self.train)), key=lambda k: self.train[k].N)
        if alone is not None:
            groups = (self.train[alone : alone + 1],)
            before, after = before.with_friction_of(alone), after.with_friction_of(alone)
        longest = [max(group, key=lambda r: r.N) for group in groups]
        return compare_latent_torques(before, after if self.rounds else None, longest, progress)

    def learned_torque(
        self, at: str = "hub", progress: Callable[[str], None] | None = None
    ) -> LearnedTorqueResult:
        """Learn a torque as a smooth map of position and speed, in addition to the final model.

        Args:
            at: Port of the torque.
            progress: Called with a line of text at each stage.

        Raises:
            InputError: If the search had no validation data, which decide whether the map is kept, or if
                friction differs between its runs.
        """
        self._learns(True)  # refuses what cannot be learned
        seconds, m = self.baseline.window_seconds, self.final.model.mechanism  # not fitted to validation data
        for effect in [e for e in m.effects if e.line]:  # its phase belongs to one recording
            m = m.without(effect.name, effect.at)
        model = Model(m, self.final.model.solver)
        return learn_torque(model, self.train, self.validation, at, window_seconds=seconds, progress=progress)

    def _learns(self, learned: bool | None) -> bool:
        """Whether a report learns a torque, given what the user asks for.

        Raises:
            InputError: It is asked for, but there are no validation data, or friction differs between runs.
        """
        differs = ", ".join(self.final.friction_of_runs)
        if learned is None:
            return self.verdict == Verdict.UNEXPLAINED and self.held_back and not differs
        if checks.yes_or_no(learned, "learned") and not self.held_back:
            raise InputError(
                "A learned torque needs validation data, but the training recordings of this search validate "
                "each other; give `rf.discover` a recording as its `validation`."
            )
        if learned and differs:
            raise InputError(
                f"The runs differ in {differs}, but a torque is learned beside one friction for all runs; "
                "give result.model_of(recording) and two parts of this recording to rf.learn_torque."
            )
        return learned

    def identifiability(self) -> Identifiability | None:
        """Identifiability of the model to use from its sensors and the longest training recording.

        It assumes that sensor noise is the only error, which is the best case. None if no parameter is free,
        or if runs with other parameters diverge.
        """
        longest = max(self.train, key=lambda r: r.N)
        shown = longest.slice(0, min(longest.N, round(SHOWN_SECONDS / longest.Ts)))
        try:
            return identifiable(self.model, shown) if self.model.mechanism.free_names else None
        except InputError:
            return None

    def explanation(
        self, learned: bool | None = None, progress: Callable[[str], None] | None = None
    ) -> Explanation:
        """Compute everything that a report needs beyond the search itself, which takes about a minute.

        Args:
            learned: Whether to learn a torque at the port where most is left; if None, it is learned if the
                verdict is `unexplained`, there are validation data and friction does not differ between runs.
            progress: Called with a line of text at each stage.

        Raises:
            InputError: If a torque is to be learned without validation data, or beside friction that
                differs between runs.
        """
        say, learned = checks.progress(progress), self._learns(learned)
        say("report: torques that the models lack")
        latent, torque = self.latent_torque(progress), None
        if learned:
            gains = (latent.after or latent.before).gain_nats
            try:
                torque = self.learned_torque(max(gains, key=lambda port: gains[port]), progress)
            except InputError:
                torque = None  # the sensors do not determine the motion of that port
        say("report: tests of the residuals and frequency responses")
        tests = model_tests(self)
        say("report: what the recording determines")
        return Explanation(latent, torque, remaining_failures(self), tests, self.identifiability())

    def save(self, path: str | Path) -> Path:
        """Write the model to use as JSON, with its estimates; `Model.load` reads the model."""
        seen = self.train[0]
        return save(Saved(self.model, self.estimates, Ts=seen.Ts, n_init=seen.n_init), path)

    def prediction_bands(
        self,
        recording: Recording,
        level: float = 0.9,
        *,
        known: Recording | Sequence[Recording] = (),
        progress: Callable[[str], None] | None = None,
    ) -> Bands:
        """Bands around the free run of `model_of(recording)`, or of the probable sets of effects.

        If the search ended unexplained and has a final fit, bands are around the run of this fit. The error
        of the model is measured by free runs over the fitted recordings. Otherwise the probable sets are
        fitted to the training recordings, once, and have their probabilities as weights. If the search has no
        probabilities, the final model is the only one. The error of these models is included if recordings
        are `known`, or, if the search ended unexplained, by its validation recordings.

        A run that was not fitted has offsets and biases of its own. For offsets that only single runs have
        shown, bands allow values of about the same size.

        Args:
            recording: Recording whose input, first samples and sensor noise are used; other samples are used
                by `coverage` only.
            level: Probability, between 0 and 1.
            known: Recordings by which the error of models is measured, see `rotflex_jax.prediction_bands`.
            progress: Called with a line of text at each fit of a set.

        Raises:
            InputError: As `rotflex_jax.prediction_bands`; or without a final fit, if friction differs between
                runs, unless the recording is of the only run that was trained.
        """
        recording = single(recording, "recording", shortest=SHORTEST_TO_FIT)
        say, level = checks.progress(progress), checked_level(level)
        others = listed_if_given(known, "known", SHORTEST_TO_FIT)
        if self.final_fit:
            return bands_of_final_fit(self, recording, level, others)
        differs = ", ".join(self.final.friction_of_runs)
        known_run = KnownRuns.of(self.train, self.validation).index(recording) is not None
        if differs and not (known_run and len(self.train) == 1):
            raise InputError(
                f"The runs differ in {differs}, but the probable sets are fitted with one friction "
                "for all runs; fit result.model_of(recording) to recordings of one run, and give this fit to "
                "rf.prediction_bands."
            )
        return bands_of_sets(self, self._probable_fits(say), recording, level, others)

    def _probable_fits(self, say: Callable[[str], None]) -> list[tuple[Fit, float]]:
        """Probable sets of effects, fitted to the training recordings once, with their probabilities."""
        if not self._fits:
            fits, share = (
                models_of(self, say) if self.probabilities else ({"": fit(self.model, self.train)}, None)
            )
            self._fits[:] = [(fitted, share[name] if share else 1.0) for name, fitted in fits.items()]
        return self._fits

    def next_experiment(self, **changes: Any) -> Experiment | None:
        """Design the input that distinguishes the first ambiguous effect from its equivalent; or None.

        Noise and limits come from the recordings: voltage, slew rate and deflection exceed none that they
        hold.

        Args:
            changes: Other arguments of `rotflex_jax.next_experiment`, its `limits` for instance.
        """
        return proposed(self, **changes)

    def report(
        self,
        folder: str | Path,
        *,
        learned: bool | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> Path:
        """Write `report.html` (self-contained) and `result.json` into a folder; returns the HTML path.

        If the verdict is ambiguous, the input of the next experiment is written beside them as a file.

        Args:
            folder: Folder to write to.
            learned: Whether to learn a torque for what is left, which takes about as long as a round; if
                None, as for `explanation`.
            progress: Called with a line of text at each stage.

        Raises:
            InputError: As `explanation`; nothing is written then.
        """
        from rotflex_jax.report import write_report  # the layer above, on request

        folder, learned = Path(folder), self._learns(learned)
        # The result is written first, so that it is kept whatever fails below.
        write_files(folder, {"result.json": as_json(self.to_dict())})
        explanation = self.explanation(learned, progress)
        checks.progress(progress)("report: drawing figures")
        page = write_report(self, folder, explanation)
        if self.proposal is not None:
            self.proposal.save_csv(folder / NEXT)
        return page

    def _repr_html_(self) -> str:
        """A card with verdict, errors of each model, effects of each round, and failures of the baseline.

        Parameters are the parameters of the model to use.
        """
        scale = {c: readable(1.0, unit) for c, unit in channel_units(self).items()}
        heading = {c: f"{c} [{read}]" for c, (_, read) in scale.items()}
        errors = {
            heading[c]: [f * s.held_out_rmse_windows[c] for s in self.stages] for c, (f, _) in scale.items()
        }
        floor = {heading[c]: f * self.noise_floor.get(c, 0.0) for c, (f, _) in scale.items()}
        rounds, parameters = [], []
        for k, added in enumerate(self.rounds, 1):
            rounds.append(
                (str(k), effect_label(added.effect, added.port), equation(added.equation), added.doubt)
            )
            for name, used in estimates_in_use(self, added).items():
                e = used or added.parameters[name]
                label = e.name if used else f"{e.name} (not in the model to use)"
                parameters.append((label, unit_text(e.unit), *value_and_interval(e)))
        seconds = f"{self.baseline.window_seconds:g} s"
        headings = channel_headings(self)
        rows = [(r.label, *(c.value for c in (*r.windows, *r.whole))) for r in error_rows(self)]
        rows.append(("sensor noise", *noise_row(self), *noise_row(self)))
        ranked = [
            (effect_label(r.effect, r.port), outcome.value, plain_number(r.score))
            for r, outcome in outcomes(self)[:LISTED_CANDIDATES]
        ]
        where = bullets(sentence(w.statement) for w in self.where)
        where = paragraph(where_sentence(self)) + where if where else ""
        return card(
            self.verdict.shown.headline,
            paragraph(sentence(self.sentence)),
            *([paragraph(self.probabilities.sentence)] if self.probabilities else []),
            picture(
                staircase(stage_labels(self), errors, floor),
                f"Held-out error over {seconds} of each model, with the noise of the sensor.",
            ),
            table(("", "effect", "equation", ""), rounds, words=4),
            table(("parameter", "unit", "value", "95 %"), parameters, words=2),
            table(
                (
                    "held-out rms error",
                    *(f"{h}, {seconds}" for h in headings),
                    *(f"{h}, one run" for h in headings),
                ),
                rows,
            ),
            folded("Where the baseline failed", where),
            folded("Ranking before any was added", table(("candidate", "", "score [nat]"), ranked, words=2)),
            bullets([*([fitted] if (fitted := final_fit_sentence(self)) else []), *notes_in_words(self)]),
        )
