"""What a search concludes: the verdict, effects that only stand in for another one, the next experiment.

Where the final model leaves more than sensor noise, something else is wrong with it, and an effect may have
been added because it imitates a part of that. Three signs, none of which the search decides by:

- its size differs between the windows of the recordings: an effect of the machine has one size;
- free runs change by it by less than half of the error that is left;
- predictions gain less by it than they would if their errors were the sensor noise alone.

In a model that explains its recordings none of them says anything: what is left there is noise.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import Round, SearchResult, Stage, assess_stages
from rotflex_jax.discover.score_test import Score
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import SearchHorizon, ValidatedHypothesis
from rotflex_jax.discover.verdict import Verdict, in_noise
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.labels import effect_phrase
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import Experiment, Limits, next_experiment
from rotflex_jax.fit.coordinates import orthogonal_to
from rotflex_jax.recording import Recording

# Share of its trace in the outputs below which a candidate has next to nothing that the model cannot imitate.
IMITATED = 0.01


def end_state(
    baseline: Stage,
    rounds: Sequence[Round],
    final: Stage,
    floor: dict[str, float],
    ranking: Sequence[Score],
) -> tuple[Verdict, str]:
    """The verdict, and a sentence that gives its reason.

    Args:
        baseline: Stage before any was added.
        rounds: What was added.
        final: Stage after the last round.
        floor: Standard deviation of the sensor noise per channel.
        ranking: Scores of the baseline.
    """
    end = assess_stages(baseline, final, floor)
    seconds = final.window_seconds
    reached = f"the held-out error over {seconds:g} s is {in_noise(end.remaining)} times the sensor noise"
    names = " and ".join(effect_phrase(r.effect, r.port) for r in rounds)
    share = f"; {end.explained_text}" if rounds and end.explained_text else ""
    explain, others = "explain", "some of them from others (listed with each)"
    if len(rounds) == 1:
        explain, others = "explains", "this from others (listed with it)"
    visible = [s for s in ranking if s.excited]
    invisible = len(ranking) - len(visible)
    if not end.is_explained:
        found = " and ".join(r.phrase for r in rounds)
        found = f"{found} found, but something" if rounds else "Something"
        why = "" if not end.at_noise else f"; {end.criterion}"
        return Verdict.UNEXPLAINED, f"{found} remains that no candidate explains: {reached}{why}{share}."
    if any(r.equivalent for r in rounds):
        return Verdict.AMBIGUOUS, (
            f"{names} {explain} the recording, but it cannot distinguish {others}: {reached}{share}."
        )
    if rounds:
        return Verdict.FOUND, f"{names} {explain} the recording: {reached}{share}."
    if ranking and invisible > len(ranking) / 2:
        return Verdict.NOT_EXCITED, (
            f"Nothing was found, but {invisible} of {len(ranking)} candidates could not have shown in this "
            f"recording: move the machine more, over more speeds and voltages."
        )
    hidden = f"; {invisible} of {len(ranking)} candidates could not have shown" if invisible else ""
    return Verdict.NOTHING_MISSING, f"Nothing is missing: {reached}{hidden}{_imitated(visible)}."


def _imitated(visible: Sequence[Score]) -> str:
    """Clause on candidates that the fitted parameters would hide by their values; empty where none would."""
    alike = [effect_phrase(*s.location) for s in visible if s.orthogonal_fraction < IMITATED]
    if not alike:
        return ""
    named = ", ".join(alike[:3]) + (f" and {len(alike) - 3} more" if len(alike) > 3 else "")
    share = f"{100 * (1 - IMITATED):.0f} %"
    return (
        f"; but {named} would look like other values of the fitted parameters here (to {share}): a motion "
        "with more reversals, speeds and amplitudes tells them apart"
    )


Found = TypeVar("Found", bound=SearchResult)

# Length of a proposal, and of the recording to which the rival is fitted [s]; a ranking needs no more.
PROPOSAL_SECONDS = 10.0


def with_proposal(found: Found) -> Found:
    """The result with the standard input that best distinguishes the first two that look alike, if any."""
    if found.verdict != Verdict.AMBIGUOUS:
        return found
    if found.final.model.mechanism.takes_signals:
        note = "No next experiment is proposed: inputs are designed for machines without further signals."
        return dataclasses.replace(found, notes=(*found.notes, note))
    try:
        return dataclasses.replace(found, proposal=proposed(found, seconds=PROPOSAL_SECONDS, improve=False))
    except InputError as error:  # no reason to lose what was found
        return dataclasses.replace(found, notes=(*found.notes, f"No next experiment is proposed: {error}"))


def proposed(found: SearchResult, **changes: Any) -> Experiment | None:
    """The next experiment for the first effect of a result that has an equal.

    Args:
        found: What a search found.
        changes: Arguments of `next_experiment` to use instead of those of the recordings.
    """
    # The phase of a disturbance in the next recording is not known.
    phased = {name for name, effect in CATALOG.items() if effect.line}
    equal = [((r.effect, r.port), r.equivalent[0]) for r in found.rounds if r.equivalent]
    pairs = [(a, b) for a, b in equal if not phased & {a[0], b[0]}]
    if not pairs:
        return None
    recordings = (*found.train, *found.validation)
    longest = max(recordings, key=lambda r: r.N)
    first, second = pairs[0]
    settings: dict[str, Any] = {
        "limits": seen_limits(recordings),
        "Ts": longest.Ts,
        "noise": found.noise_floor,
        "process_noise": found.final.process_noise,
        "reference": longest.u[: round(PROPOSAL_SECONDS / longest.Ts)],
    }
    # The model to use may have another law in the place of the first (`FinalFit.laws`).
    return next_experiment(found.final.model, first, second, **(settings | changes))


def seen_limits(recordings: tuple[Recording, ...]) -> Limits:
    """What the machine has borne already: largest voltage, slew and deflection of the recordings."""
    r = max(recordings, key=lambda r: float(np.max(np.abs(r.u))))
    slew = max(float(np.max(np.abs(np.diff(r.u)))) / r.Ts for r in recordings)
    deflection = max(float(np.max(np.abs(r.y[:, -1]))) for r in recordings)
    single = len(r.channels) < 2
    return Limits(
        voltage=float(np.max(np.abs(r.u))),
        slew=slew,
        deflection=np.inf if single else deflection,
        margin=0.0,
    )


# Root mean square of the change of size between windows, over the size, that an effect of the machine stays
# below, and least root mean square that it changes free runs by, over the error that is left.
SCATTER, LEAST_CHANGE = 0.15, 0.5
# Beyond these a scatter or a change has no size that a reader could use.
MOST_WRITTEN, LEAST_WRITTEN = 10.0, 0.01


class WindowSizes(NamedTuple):
    """An effect in the windows of free runs.

    Attributes:
        scatter: Root mean square change of its size that the windows ask for one by one, over its size.
        change: Root mean square of what it changes in the errors, over what is left of them.
    """

    scatter: float
    change: float


def window_sizes(
    problem: LikelihoodProblem, h: Hypothesis, locations: Sequence[EffectLocation]
) -> dict[EffectLocation, WindowSizes]:
    """Whether effects have the same size in all windows of some recordings.

    In each window the amplitudes `a` of an effect are fitted to the whitened errors `w` by one Gauss-Newton
    step `d`, with slopes `J` of which the first state and the recording's own parameters are projected out,
    and all other parameters held. The scatter is the root of `sum |J d|^2 / sum |J a|^2`, the change that of
    `sum |J a|^2 / sum |w|^2`; a window counts by what the effect does there.

    Args:
        problem: Free runs over the recordings.
        h: Fitted to them, or to others. Windows in which its run diverges say nothing.
        locations: Effects of `h`; those without an amplitude, and those with values for each recording, are
            left out.
    """
    s, seen = problem.supermodel, problem.seen
    e, J = problem.slopes([h])
    w, W = h.whitener(e[0], seen), h.whitener(J[0, : h.moved], seen)
    values, derivative = (x.mean(axis=0) for x in h.physical(s))
    columns = {i: k for k, i in enumerate((*h.free, *h.local))}
    found = {}
    for location in locations:
        kind = CATALOG[location.effect]
        names = {location.full_name(n) for n in kind.amplitudes}
        own = [i for i, n in enumerate(s.mechanism.parameter_names) if n in names and i in columns]
        if kind.per_recording or not own:
            continue
        moved = [columns[i] for i in own]
        beside = [k for k in range(len(h.free), h.moved) if k not in moved]
        totals = np.zeros(3)
        for r in range(len(w)):
            for _, samples in problem.windows.of(r):
                slopes = W[moved, r, samples].reshape(len(own), -1) / derivative[own, None]
                rows = np.concatenate([slopes, w[None, r, samples].reshape(1, -1)])
                others = W[beside, r, samples].reshape(len(beside), -1)
                if not (np.isfinite(rows).all() and np.isfinite(others).all()):
                    continue  # the run diverges in this window
                rows = orthogonal_to(rows, others)
                slopes, left = rows[:-1], rows[-1]
                step = np.linalg.lstsq(slopes.T, left, rcond=1e-6)[0]
                totals += [np.sum((step @ slopes) ** 2), np.sum((values[own] @ slopes) ** 2), left @ left]
        wanted, acts, rest = totals
        if acts > 0 and rest > 0:
            found[location] = WindowSizes(float(np.sqrt(wanted / acts)), float(np.sqrt(acts / rest)))
    return found


def nats_above_noise(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """What predictions would gain if their errors were the sensor noise alone [nat].

    `N log(rms / noise)`, summed over the channels whose error is above the noise.
    """
    multiples = np.maximum(problem.channel_errors(h) / problem.noise, 1.0)
    return float(np.sum(problem.seen > 0) * np.sum(np.log(multiples)))


def nats_left(prediction: SearchHorizon, final: ValidatedHypothesis) -> float:
    """What is left above the sensor noise in training and validation data together [nat].

    Args:
        prediction: The recordings.
        final: The model, fitted to predictions.
    """
    rest = nats_above_noise(prediction.problem, final.hypothesis)
    if prediction.validation.folds:  # the validation recordings are those of training
        return 2 * rest
    return rest + nats_above_noise(prediction.validation.problem, final.adapted)


def signs(
    horizons: tuple[SearchHorizon, SearchHorizon],
    final: ValidatedHypothesis,
    gains: dict[EffectLocation, float],
) -> dict[EffectLocation, tuple[str, ...]]:
    """Effects of an unexplained model -> why each may stand in for something else, in words.

    Args:
        horizons: Predictions and free runs.
        final: The model, fitted and validated at both.
        gains: Effects that were added -> what predictions of training and validation data gained [nat].
    """
    prediction, free_run = horizons
    runs, rest = final.free_run, nats_left(prediction, final)
    assert runs
    sets = [(free_run.problem, runs.hypothesis)]
    if not free_run.validation.folds:
        sets.append((free_run.validation.problem, runs.adapted))
    locations = [p for p in runs.hypothesis.locations if p in gains]
    sizes = [window_sizes(problem, h, locations) for problem, h in sets]
    out = {}
    for location in locations:
        own, reasons = [x[location] for x in sizes if location in x], []
        if own and (scatter := max(x.scatter for x in own)) > SCATTER:
            seconds, by = free_run.validation.window_seconds, f"{scatter:.0%}"
            by = by if scatter < MOST_WRITTEN else f"more than {MOST_WRITTEN:.0%}"
            reasons.append(f"windows of {seconds:g} s differ by {by} on its size")
        if own and (change := min(x.change for x in own)) < LEAST_CHANGE:
            share = f"{change:.2g}" if change > LEAST_WRITTEN else f"less than {LEAST_WRITTEN:g}"
            reasons.append(f"it changes free runs by {share} of the error that is left")
        if gains[location] < rest:
            gain = gains[location]
            reasons.append(
                f"predictions gain {gain:.0f} nats by it, and {rest:.0f} are left above the sensor noise"
            )
        out[location] = tuple(reasons)
    return out
