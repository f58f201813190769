"""Conclusions of a search: the verdict, signs that effects stand in for others, and the next experiment.

If the final model leaves more than sensor noise, it lacks something else, and an effect may have been added
because it imitates a part of that. There are three signs of this, by which the search does not decide:

- Its size differs between the windows of the recordings, while an effect of the machine has one size.
- It changes free runs by less than half of the error that is left.
- It gains less in predictions than would be gained if their errors were the sensor noise alone.

If a model explains its recordings, these signs mean nothing, since only noise is left.
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
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

# Orthogonal fraction below which a candidate can hardly be distinguished from the model.
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
        baseline: Stage before any effect was added.
        rounds: Effects that were added.
        final: Stage after the last round.
        floor: Channel -> standard deviation of the sensor noise.
        ranking: Scores of candidates for the baseline.
    """
    end = assess_stages(baseline, final, floor)
    seconds = final.window_seconds
    reached = f"the held-out error over {seconds:g} s is {in_noise(end.remaining)} times the sensor noise"
    if end.expected:
        reached += f" ({in_noise(end.expected)} by noise in the first samples alone)"
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
    """Clause on candidates that fitted parameters can imitate by other values; empty if there are none."""
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

# Length of a proposal, and of the reference input to which the rival is fitted [s]; enough to rank inputs.
PROPOSAL_SECONDS = 10.0


def with_proposal(found: Found) -> Found:
    """The result with the standard input that best distinguishes the first two equivalent effects, if any."""
    if found.verdict != Verdict.AMBIGUOUS:
        return found
    if found.final.model.mechanism.takes_signals:
        note = "No next experiment is proposed: inputs are designed for machines without further signals."
        return dataclasses.replace(found, notes=(*found.notes, note))
    try:
        return dataclasses.replace(found, proposal=proposed(found, seconds=PROPOSAL_SECONDS, improve=False))
    except InputError as error:  # the result is returned without a proposal
        return dataclasses.replace(found, notes=(*found.notes, f"No next experiment is proposed: {error}"))


def proposed(found: SearchResult, **changes: Any) -> Experiment | None:
    """The next experiment for the first effect of a result that has an equivalent effect; None without one.

    Args:
        found: The result of a search.
        changes: Arguments of `next_experiment` that replace the arguments from the recordings.
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
        "limits": seen_limits(recordings, found.final.model),
        "Ts": longest.Ts,
        "noise": found.noise_floor,
        "process_noise": found.final.process_noise,
        "reference": longest.u[: round(PROPOSAL_SECONDS / longest.Ts)],
    }
    # Not the model to use, in which another law may replace the first effect (`FinalFit.laws`).
    return next_experiment(found.final.model, first, second, **(settings | changes))


def seen_limits(recordings: Sequence[Recording], model: Model) -> Limits:
    """Limits that the machine has withstood: largest voltage, slew rate and deflection of the recordings.

    The deflection is the second output of the model, whatever the order of the columns of a recording. It
    counts from its start.
    """
    voltage = max(float(np.max(np.abs(r.u))) for r in recordings)
    slew = max(float(np.max(np.abs(np.diff(r.u)))) / r.Ts for r in recordings)
    limits = Limits(voltage=voltage, slew=slew, margin=0.0)
    if len(model.mechanism.channels) < 2:
        return limits
    seen = [np.asarray(model.measured(r), float)[:, 1] for r in recordings]
    return dataclasses.replace(limits, deflection=max(float(np.max(np.abs(y - y[0]))) for y in seen))


# Limits for an effect of the machine: largest root mean square change of its size between windows, over the
# size; least root mean square change of free runs by it, over the error that is left.
SCATTER, LEAST_CHANGE = 0.15, 0.5
# A larger scatter or a smaller change than this is not written as a number.
MOST_WRITTEN, LEAST_WRITTEN = 10.0, 0.01


class WindowSizes(NamedTuple):
    """Consistency of the size of an effect over the windows of free runs.

    Attributes:
        scatter: Root mean square change of its size if it is fitted to each window alone, over its size.
        change: Root mean square change of the errors by the effect, over the error that is left.
    """

    scatter: float
    change: float


def window_sizes(
    problem: LikelihoodProblem, h: Hypothesis, locations: Sequence[EffectLocation]
) -> dict[EffectLocation, WindowSizes]:
    """How consistent the sizes of effects are over the windows of some recordings.

    In each window the amplitudes `a` of an effect are fitted to the whitened errors `w` by one Gauss-Newton
    step `d`. The first state and the other local parameters are projected out of the slopes `J`, and all
    other parameters are held. The scatter is the root of `sum |J d|^2 / sum |J a|^2`, the change is the root
    of `sum |J a|^2 / sum |w|^2`. So the weight of a window is the size of what the effect does there.

    Args:
        problem: Likelihood of free runs over the recordings.
        h: Hypothesis fitted to these recordings, or to others. Windows in which its run diverges are left
            out.
        locations: Effects of `h`. Effects without an amplitude, and effects with values for each recording,
            are left out.
    """
    s, seen = problem.supermodel, problem.seen
    e, J = problem.slopes([h])
    w, W = h.whitener(e[0], seen), h.whitener(J[0, : h.moved], seen)
    values, derivative = h.physical(s)
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
                slopes = W[moved, r, samples].reshape(len(own), -1) / derivative[r, own, None]
                rows = np.concatenate([slopes, w[None, r, samples].reshape(1, -1)])
                others = W[beside, r, samples].reshape(len(beside), -1)
                if not (np.isfinite(rows).all() and np.isfinite(others).all()):
                    continue  # the run diverges in this window
                rows = orthogonal_to(rows, others)
                slopes, left = rows[:-1], rows[-1]
                step = np.linalg.lstsq(slopes.T, left, rcond=1e-6)[0]
                totals += [np.sum((step @ slopes) ** 2), np.sum((values[r, own] @ slopes) ** 2), left @ left]
        wanted, acts, rest = totals
        if acts > 0 and rest > 0:
            found[location] = WindowSizes(float(np.sqrt(wanted / acts)), float(np.sqrt(acts / rest)))
    return found


def nats_above_noise(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """Log-likelihood that predictions would gain if their errors were the sensor noise alone [nat].

    It is `N log(rms / noise)`, summed over the channels whose error is above the noise.
    """
    multiples = np.maximum(problem.channel_errors(h) / problem.noise, 1.0)
    return float(np.sum(problem.seen > 0) * np.sum(np.log(multiples)))


def nats_left(prediction: SearchHorizon, final: ValidatedHypothesis) -> float:
    """Sum of `nats_above_noise` over training and validation data [nat].

    Args:
        prediction: The recordings, for predictions.
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
    """Effects of an unexplained model -> signs that each may stand in for something else, in words.

    Args:
        horizons: The recordings for predictions and for free runs.
        final: The model, fitted and validated at both horizons.
        gains: Effects that were added -> gain of predictions of training and validation data [nat].
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
