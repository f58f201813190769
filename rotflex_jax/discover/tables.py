"""Tables and sentences on a result, for notebook, terminal and report: errors, parameters, outcomes."""

import dataclasses
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from rotflex_jax.discover.explanation import advice, coloured_sensors
from rotflex_jax.discover.result import (
    KnownRuns,
    Ranked,
    Round,
    RunErrors,
    SearchResult,
    longest_recording,
)
from rotflex_jax.discover.verdict import Grade, Verdict, grade
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import full_name
from rotflex_jax.effects.labels import effect_label, effect_phrase
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.text.numbers import (
    multiple,
    plain_number,
    ratio,
    readable,
    together,
    unit_text,
    value_and_interval,
)


@dataclasses.dataclass(frozen=True)
class ErrorCell:
    """One error: the number, its multiple of the noise, and its grade."""

    value: str
    multiple: str
    grade: Grade | None

    @property
    def reached(self) -> bool:
        """Whether the error has reached the noise."""
        return self.grade is Grade.NOISE


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """Errors of one stage: over windows and over the whole run, one cell per channel."""

    label: str
    windows: tuple[ErrorCell, ...]
    whole: tuple[ErrorCell, ...]


@dataclasses.dataclass(frozen=True)
class ParameterRow:
    """One parameter in all stages: (value, interval) for each stage, None where a stage lacks it.

    `given` names the trusted constants on which the interval of the last stage depends, in words.
    """

    name: str
    meaning: str
    unit: str
    held: bool
    stages: tuple[tuple[str, str] | None, ...]
    note: str
    given: str = ""


# Share of the scored data to which offsets may be fitted without a remark.
MOST_CALIBRATED = 0.5
FITTED_TO_ALL = "the last, fitted to all training and validation data"
"""Label of the final fit."""


def stage_labels(discovery: SearchResult) -> tuple[str, ...]:
    """A short name for each stage."""
    added = (f"+ {effect_label(r.effect, r.port)}" for r in discovery.rounds)
    return ("baseline", *added)


@dataclasses.dataclass(frozen=True)
class ErrorTable:
    """Errors of every stage on some recordings.

    Attributes:
        title: Which recordings, and with which offsets.
        note: Whether the model was chosen on these recordings.
        rows: One row for each stage.
    """

    title: str
    note: str
    rows: tuple[ErrorRow, ...]


class NamedErrors(NamedTuple):
    """Errors of several models on some recordings.

    Attributes:
        title: Which recordings, and with which offsets.
        note: Whether the model was chosen on these recordings.
        errors: Label of a model -> its errors.
    """

    title: str
    note: str
    errors: dict[str, RunErrors]


def error_lists(discovery: SearchResult) -> list[NamedErrors]:
    """Errors of every stage on validation and test data, with and without offsets fitted to each recording.

    Only errors that were computed are listed. The final fit has errors on test data only, since it was fitted
    to the validation data.
    """
    stages, labels, last = discovery.stages, stage_labels(discovery), discovery.final_fit
    own, own_tested = (
        ", each recording with " + _own_offsets(stages[0].calibrate_seconds, recordings)
        for recordings in (discovery.validation, discovery.test)
    )
    chose, not_used = "The model was chosen on these recordings.", "Used for no fit and no choice."
    if fitted_friction(discovery):
        chose += " Friction that differs between runs was fitted to those of a run that was not trained."
    if not discovery.test:
        chose += (
            " Test recordings (test= in Python, --test on the command line), used for no fit and no choice, "
            "would give an unbiased error."
        )
    tested = (last.test, last.test_calibrated) if last else (None, None)
    short, short_tested = (
        _mostly_calibrated(stages[0].calibrate_seconds, recordings, what)
        for recordings, what in ((discovery.validation, "validation"), (discovery.test, "test"))
    )
    same, same_tested = (
        _one_window(stages[0].window_seconds, recordings)
        for recordings in (discovery.validation, discovery.test)
    )
    listed = [
        (
            "Validation data",
            chose + same,
            [RunErrors(s.held_out_rmse, s.held_out_rmse_windows) for s in stages],
            None,
        ),
        ("Validation data" + own, chose + same + short, [s.calibrated for s in stages], None),
        ("Test data", not_used + same_tested, [s.test for s in stages], tested[0]),
        (
            "Test data" + own_tested,
            not_used + same_tested + short_tested,
            [s.test_calibrated for s in stages],
            tested[1],
        ),
    ]
    found = []
    for title, note, of_stages, of_fit in listed:
        errors = {label: e for label, e in zip(labels, of_stages, strict=True) if e is not None}
        if errors:
            found.append(NamedErrors(title, note, errors | ({FITTED_TO_ALL: of_fit} if of_fit else {})))
    return found


def fitted_friction(discovery: SearchResult) -> bool:
    """Whether friction of a stage was fitted to validation recordings, which are of another run."""
    runs = KnownRuns.of(discovery.train, discovery.validation).indices(discovery.validation)
    return None in runs and any(s.friction_of_validation for s in discovery.stages)


def _own_offsets(seconds: float, recordings: Sequence[Recording]) -> str:
    """To which part of each recording its offsets were fitted, in words."""
    short, count = sum(r.duration <= seconds for r in recordings), len(recordings)
    if short and short == count:
        return f"offsets fitted to all of it, which is no longer than {seconds:g} s"
    ending = f", which is all of it in {short} of {count}" if short else ""
    return f"the offsets of its own first {seconds:g} s{ending}"


def _one_window(seconds: float, recordings: Sequence[Recording]) -> str:
    """A sentence where every recording is one window, so that both kinds of error are equal; else empty."""
    if any(len(window_starts(r, seconds)[0]) > 1 for r in recordings):
        return ""
    return f" Each recording is one window, so errors over {seconds:g} s are those of one run over all of it."


def _mostly_calibrated(seconds: float, recordings: Sequence[Recording], what: str) -> str:
    """A sentence where offsets were fitted to more than half of the data that are scored; else empty."""
    total = sum(r.duration for r in recordings)
    used = sum(min(r.duration, seconds) for r in recordings)
    if used <= MOST_CALIBRATED * total:
        return ""
    return (
        f" {used:.1f} of {total:.1f} s of the {what} data were used for the offsets: these errors are nearly "
        f"errors of a fit. Record more, or pass calibrate_seconds={seconds / 4:g} (on the command line "
        f"--calibrate {seconds / 4:g})."
    )


def error_tables(discovery: SearchResult) -> tuple[ErrorTable, ...]:
    """The errors of `error_lists` as tables, with numbers as people read them."""
    by_channel = channel_units(discovery)

    def cells(errors: dict[str, float]) -> tuple[ErrorCell, ...]:
        return tuple(_cell(errors[c], unit, discovery.noise_floor.get(c)) for c, unit in by_channel.items())

    def rows(errors: dict[str, RunErrors]) -> tuple[ErrorRow, ...]:
        return tuple(ErrorRow(label, cells(e.windows), cells(e.whole)) for label, e in errors.items())

    return tuple(ErrorTable(title, note, rows(errors)) for title, note, errors in error_lists(discovery))


def final_fit_sentence(discovery: SearchResult) -> str:
    """How the model of the final fit was fitted, with its errors; empty without a final fit."""
    found = discovery.final_fit
    if found is None:
        return ""
    used = "training and validation recordings" if discovery.held_back else "all recordings"
    before, after = found.searched.windows, found.trained.windows
    shown = []
    for channel, unit in channel_units(discovery).items():
        (old, read), (new, _) = (readable(errors[channel], unit) for errors in (before, after))
        shown.append(f"{channel} {plain_number(new)} {read} (of the search: {plain_number(old)})")
    seconds, calibrated = found.fit.options.window_seconds, discovery.final.calibrate_seconds
    own = f", each with {_own_offsets(calibrated, discovery.validation)}" if calibrated else ""
    ending = "" if found.fit.status == "converged" else f" The fit {found.fit.status}."
    remarks = "".join(f" {remark.sentence}." for remark in found.fit.remarks)
    laws = "".join(
        f" It has {effect_phrase(*used)} in the place of {effect_phrase(*replaced)}, which the search has "
        "found: such runs of all fitted recordings are far better with it."
        for replaced, used in found.laws
    )
    sizes = "; ".join(
        f"{name} {', '.join(plain_number(e.value) for e in each)} {unit_text(each[0].unit)}"
        for name, each in found.fit.local.items()
        if name in found.friction
    )
    searched = discovery.final.friction_of_runs
    found_by = "as the search has found" if searched else "without which every run is worse by far"
    apart = ", apart from their friction" if fitted_friction(discovery) else ""
    friction = f" Each run has a friction of its own size, {found_by}: {sizes}." if sizes else ""
    offsets = [p for p in found.left_out if p in discovery.calibrations]
    effects = [p for p in found.left_out if p not in offsets]
    pronoun = "it" if len(offsets) == 1 else "them"
    left_out = "".join(
        f" It is without {' and '.join(effect_phrase(*p) for p in each)}, which the search has found: such "
        f"runs are not clearly worse{further}."
        for each, further in ((offsets, f", and other runs may not have {pronoun}"), (effects, ""))
        if each
    )
    compared = (
        f"Fitted in the same way without the validation data{apart}, its errors on these"
        if discovery.held_back
        else "Fitted in the same way to a part of the recordings, its errors on the others"
    )
    first = (
        "from measured first states"
        if found.fit.options.first == "measured"
        else "with fitted first states, since from measured ones it does worse on data that no fit has seen"
    )
    return (
        f"The model to use is the last one, fitted to {used} together, by free runs over {seconds:g} s "
        f"{first}.{left_out}{laws}{friction} {compared} over {seconds:g} s are {', '.join(shown)}{own}."
        f"{ending}{remarks}"
    )


def description_in_use(discovery: SearchResult, added: Round) -> str:
    """The effect of a round in words, with its values in the model to use.

    If that model lacks the effect, the values are those of the last round.
    """
    if discovery.final_fit is None:  # the model to use is that of the last round
        return added.sentence
    m = discovery.final_fit.model.mechanism
    effect = next((e for e in m.effects if (e.name, e.at) == (added.effect, added.port)), None)
    if effect is None:
        return f"{added.sentence} (values of the last round; the model to use is without it)"
    return m.sentence(effect)


def notes_in_words(discovery: SearchResult) -> tuple[str, ...]:
    """The notes; where there is a final fit, notes on values of the search say that they are not its own."""
    of_search = {f"{remark.sentence}." for remark in discovery.remarks} if discovery.final_fit else set()
    which = " (last model of the search, before the final fit)."
    return tuple(n.removesuffix(".") + which if n in of_search else n for n in discovery.notes)


def estimates_in_use(discovery: SearchResult, added: Round) -> dict[str, Estimate | None]:
    """Estimates of an effect's parameters in the model to use, by short name; None where it lacks it."""
    known = {e.name: e for e in discovery.estimates}
    return {name: known.get(full_name(added.port, added.effect, name)) for name in added.parameters}


def has_moved(found: Estimate, used: Estimate) -> bool:
    """Whether an estimate differs in the model to use, in the digits that are significant by its interval."""
    return dataclasses.replace(found, value=used.value).texts[0] != found.texts[0]


def where_sentence(discovery: SearchResult, recording: Recording | None = None) -> str:
    """A sentence that names the recording of the statements on where a model fails.

    Args:
        discovery: The result.
        recording: One of its recordings; if None, the recording on which the baseline was localised.
    """
    r = recording or longest_recording(discovery.train, discovery.validation)
    fitted = any(r is other for other in discovery.train)
    named = f"{r.source}, " if r.source else ""
    return (
        f"All of this is about the longest {'fitted' if fitted else 'validation'} recording: "
        f"{named}{r.start:g} s to {r.start + r.duration:g} s."
    )


def error_rows(discovery: SearchResult) -> tuple[ErrorRow, ...]:
    """Errors of every stage on validation data."""
    return error_tables(discovery)[0].rows


def status_sentence(added: Round) -> str:
    """Whether an effect is established, and if not, why, as a sentence."""
    if not added.doubt and added.prediction is None:
        return "Established: training data show it, and validation runs are better with its trained value."
    if not added.doubt:
        return f"Established: predictions and free runs are better with it{_agreement(added)}."
    if added.certain:
        return f"Provisional as a law: {added.doubt}."
    return f"Provisional, it may stand in for something else: {added.doubt}."


def _agreement(added: Round) -> str:
    """A clause on the sizes of an established effect in different data; empty for an effect without a size.

    Sizes that belong to single recordings or runs are not compared.
    """
    kind = CATALOG[added.effect]
    if kind.per_recording:
        return ", and its size belongs to each recording"
    names = {full_name(added.port, added.effect, name) for name in kind.amplitudes}
    if names and names <= set(added.stage.friction_of_runs):
        return ", and its size differs between runs"
    return ", and its size agrees in all data" if names else ""


def _cell(value: float, unit: str, floor: float | None) -> ErrorCell:
    times = ratio(value, floor)
    return ErrorCell(plain_number(readable(value, unit)[0]), multiple(times), grade(times))


def noise_row(discovery: SearchResult) -> tuple[str, ...]:
    """Noise floor of each channel, as text."""
    floor = discovery.noise_floor
    return tuple(
        plain_number(readable(floor[c], unit)[0] if c in floor else None)
        for c, unit in channel_units(discovery).items()
    )


def channel_headings(discovery: SearchResult) -> tuple[str, ...]:
    """Each channel with the unit in which people read it."""
    return tuple(f"{c} [{readable(0.0, unit)[1]}]" for c, unit in channel_units(discovery).items())


def parameter_rows(discovery: SearchResult) -> tuple[ParameterRow, ...]:
    """Parameters of the final model, then parameters of earlier stages that it lacks; held ones come last.

    If there is a final fit, it is an additional stage.
    """
    stages = [{e.name: e for e in s.estimates} for s in discovery.stages]
    if discovery.final_fit:
        stages.append({e.name: e for e in discovery.estimates})
    names = list(dict.fromkeys(n for s in reversed(stages) for n in s))
    meanings = _meanings([*(s.model for s in discovery.stages), discovery.model])
    rows = []
    for name in names:
        last = next(s[name] for s in reversed(stages) if name in s)
        each = tuple(value_and_interval(s[name]) if name in s else None for s in stages)
        shown = meanings.get(name, ""), unit_text(last.unit), not last.free, each
        rows.append(ParameterRow(name, *shown, last.note, together(last.given_words)))
    return tuple(sorted(rows, key=lambda r: r.held))


def _meanings(models: Sequence[Model]) -> dict[str, str]:
    found: dict[str, str] = {}
    for model in models:
        m = model.mechanism
        pairs = zip(m.parameter_names, m.parameter_specifications, strict=True)
        found |= {name: m.units.sentence(spec.meaning) for name, spec in pairs}
    return found


def channel_units(discovery: SearchResult) -> dict[str, str]:
    """Channel of the model -> its unit in the recordings."""
    first = discovery.validation[0]
    return {c: first.unit(c) for c in discovery.baseline.held_out_rmse_windows}


def noise_ratios(discovery: SearchResult) -> dict[str, float]:
    """Channel -> validation error over windows of the final model, in multiples of the noise."""
    errors = discovery.final.held_out_rmse_windows
    return {c: ratio(v, discovery.noise_floor.get(c)) for c, v in errors.items()}


def ambiguous_rounds(discovery: SearchResult) -> list[tuple[str, str]]:
    """Label of each effect that has equivalent effects, and the labels of these effects."""
    return [
        (effect_label(r.effect, r.port), " or ".join(effect_label(*pair) for pair in r.equivalent))
        for r in discovery.rounds
        if r.equivalent
    ]


def next_steps(discovery: SearchResult) -> list[str]:
    """What the user may do next, in sentences."""
    hidden = sum(not r.excited for r in discovery.ranking)
    steps = discovery.verdict.next_steps(ambiguous_rounds(discovery), hidden, len(discovery.ranking))
    if discovery.verdict != Verdict.UNEXPLAINED:
        return steps
    if discovery.rounds:
        steps.append(
            "Take what was found for provisional: what is missing may take its place once it is in the model."
        )
    i = discovery.longest_validation
    final = discovery.final
    coloured = coloured_sensors(final.model, discovery.validation[i], np.asarray(final.simulated[i], float))
    return [*advice(coloured), *steps]


class Outcome(StrEnum):
    """Outcome of a candidate at the end of a search."""

    FOUND = "found"
    ALIKE = "cannot be distinguished from what was found"
    NOT_ADDED = "not added"
    NOT_EXCITED = "not excited"


def outcomes(discovery: SearchResult) -> list[tuple[Ranked, Outcome]]:
    """Every candidate with its outcome, in the order of the ranking."""
    found = {(r.effect, r.port) for r in discovery.rounds}
    alike = {pair for r in discovery.rounds for pair in r.equivalent}

    def outcome(r: Ranked) -> Outcome:
        pair = (r.effect, r.port)
        if pair in found:
            return Outcome.FOUND
        if pair in alike:
            return Outcome.ALIKE
        return Outcome.NOT_ADDED if r.excited else Outcome.NOT_EXCITED

    return [(r, outcome(r)) for r in discovery.ranking]
