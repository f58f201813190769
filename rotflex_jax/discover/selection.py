"""The likelihood of validation data decides, and it may decide for a set of effects.

Two candidates are reported together unless log-likelihoods of all recordings differ by two standard
deviations of their differences over half-second blocks, or errors of short free runs by a tenth; far from the
noise, those that gain nearly the same are reported together too. A richer effect must beat the simpler one
that it contains on validation and on training data, by two standard deviations of all blocks and with free
runs that are no worse; or free runs of both must prefer it by 2.5 standard deviations, with errors that are
smaller by a tenth.

Every candidate is compared at two horizons, each with parameters fitted for it: as a predictor and in short
free runs. Where another part of the model is wrong, the likeliest predictor follows the data within a few
samples, and its parameters are no good for a free run; a free run alone has less power where the model is
nearly right. So both propose, and what only free runs want counts if they want it strongly.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.result import HorizonGain
from rotflex_jax.discover.score_test import Score, promising
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import ValidatedHypothesis, ValidationSet, validate
from rotflex_jax.effects.base import DRY_FRICTION
from rotflex_jax.effects.labels import law_of

# An effect must gain this on validation data [nat], beyond this many standard deviations of the block gains,
# and this on the training data after half a log N per parameter, beyond as many standard deviations.
HELD_OUT_NATS, HELD_OUT_Z, TRAIN_NATS, TRAIN_Z = 5.0, 1.5, 8.0, 2.0
# Mean log error of free runs over short windows: near the sensor noise it may rise by no more than the
# first, elsewhere it must fall by the second.
WINDOWS_WORSE, WINDOWS_BETTER = 0.02, 0.01
# Two effects are distinguished by this many standard deviations of their paired block differences, or by free
# runs over short windows whose errors differ by more than this (mean log ratio).
SEPARATE_Z, WINDOWS_APART = 2.0, 0.1
# Where the winner leaves errors far from the noise, likelihood distinguishes only what gains this share less:
# what is missing besides suits one of two that do nearly the same better by as much.
GAIN_APART = 0.1
# What predictions do not want, free runs must want by so many standard deviations of their block gains, on
# validation and on training data, with an error that falls by so much (mean log ratio).
FREE_RUN_Z, FREE_RUN_BETTER = 2.5, 0.1
# What predictions want by so many standard deviations, on validation and on training data, need not show in
# free runs whose error something else makes, if these get no worse.
PREDICTION_Z = 3.5
# Free runs of a poor model exclude a rival whose errors are larger by this (mean log ratio): its runs then
# differ by as much as the errors that are left, if the two are independent.
LAWS_APART = 0.5 * float(np.log(2.0))
# Candidates in whose place a winner may stand: so many at most, each with so much of the best score of its
# round (shares of both horizons added up), of which no more than the last share is left beside the winner.
REPLACED, REPLACED_SHARE, REPLACED_LEFT = 2, 0.25, 0.1


def paired_gain(a: Float[np.ndarray, " B"], b: Float[np.ndarray, " B"]) -> tuple[float, float]:
    """By how many nats blocks `a` exceed blocks `b`, and how many standard deviations that is."""
    d = a - b
    spread = float(np.std(d, ddof=1) * np.sqrt(len(d))) if len(d) > 1 else np.inf
    return float(d.sum()), float(d.sum()) / max(spread, 1e-12)


def horizon_gains(
    candidate: ValidatedHypothesis, current: ValidatedHypothesis
) -> tuple[HorizonGain, HorizonGain | None]:
    """What a candidate gains on validation data, as a predictor and in free runs."""
    nats, z = paired_gain(candidate.blocks, current.blocks)
    ratio = float(np.exp(_log_error_ratio(candidate, current)))
    prediction = HorizonGain(nats, z, ratio, _training_gain(candidate, current)[0])
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None:
        return prediction, None
    gain, z = paired_gain(runs.blocks, before.blocks)
    ratio, training = float(np.exp(_log_error_ratio(runs, before))), _training_gain(runs, before)[0]
    return prediction, HorizonGain(gain, z, ratio, training)


def helps(gain: HorizonGain) -> bool:
    """Whether a gain at one horizon is there beyond doubt."""
    return gain.z > HELD_OUT_Z and gain.gain > 0


def describe(candidate: ValidatedHypothesis, current: ValidatedHypothesis) -> str:
    """One line: what a candidate gained."""
    nats, z = paired_gain(candidate.blocks, current.blocks)
    train, train_z = _training_gain(candidate, current)
    ratio = float(np.exp(_log_error_ratio(candidate, current)))
    line = (
        f"{candidate.location}: {nats:.0f} nats on validation data (z {z:.1f}), {train:.0f} "
        f"on training data (z {train_z:.1f}), {error_ratio(ratio)}"
    )
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None:
        return line
    z, train_z = paired_gain(runs.blocks, before.blocks)[1], _training_gain(runs, before)[1]
    ratio = float(np.exp(_log_error_ratio(runs, before)))
    fitted = f"{ratio:.2g} times" if np.isfinite(ratio) else "they diverge"
    return f"{line}; fitted to free runs {fitted} (z {z:.1f}, training {train_z:.1f})"


def error_ratio(ratio: float) -> str:
    """How a free-run error compares with the one before.

    >>> error_ratio(1.87), error_ratio(0.534), error_ratio(float("inf"))
    ('free-run error 1.9 times as large', 'free-run error 0.53 times as large', 'free runs diverge')
    """
    return f"free-run error {ratio:.2g} times as large" if np.isfinite(ratio) else "free runs diverge"


def _training_gain(a: ValidatedHypothesis, b: ValidatedHypothesis) -> tuple[float, float]:
    return paired_gain(a.hypothesis.blocks, b.hypothesis.blocks)


def _log_error_ratio(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """Mean log ratio of the errors of short free runs; negative where `a` is better."""
    return mean_log_ratio(a.window_rmse, b.window_rmse)


def mean_log_ratio(a: Float[np.ndarray, " C"], b: Float[np.ndarray, " C"]) -> float:
    """Logarithm of errors `a` over errors `b`, mean over channels.

    Infinite where runs of `a` diverge, whatever those of `b` do; minus infinity where those of `b` alone do.
    """
    if not np.isfinite(a).all():
        return np.inf
    if not np.isfinite(b).all():
        return -np.inf
    least = np.finfo(float).tiny
    return float(np.mean(np.log(np.maximum(a, least) / np.maximum(b, least))))


def admissible(
    candidate: ValidatedHypothesis,
    current: ValidatedHypothesis,
    measured: float,
    noise: Float[np.ndarray, " C"],
) -> bool:
    """Whether what a candidate adds is there beyond doubt.

    Args:
        candidate: The richer hypothesis.
        current: Without what it adds.
        measured: How many values of training recordings were measured.
        noise: Standard deviation of the sensor noise of each channel.
    """
    nats, z = paired_gain(candidate.blocks, current.blocks)
    train, train_z = _training_gain(candidate, current)
    needed = needed_gain(candidate.parameter_count, measured)
    # Likelihood is about the next samples, a user's free runs are about many: both must agree. Far from the
    # sensor noise, an effect that leaves free runs as they were is flexibility, not a discovery.
    far = is_poor(current, noise)
    limit = -WINDOWS_BETTER if far else WINDOWS_WORSE
    enough = nats > HELD_OUT_NATS and z > HELD_OUT_Z and train > needed and train_z > TRAIN_Z
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None:
        return enough and _log_error_ratio(candidate, current) < limit
    ratio = _log_error_ratio(runs, before)
    certainty = min(paired_gain(runs.blocks, before.blocks)[1], _training_gain(runs, before)[1])
    as_trained = _log_error_ratio(candidate, current)
    if enough and min(ratio, as_trained) < limit:
        beyond_doubt = min(z, train_z) > PREDICTION_Z
        return not far or certainty > HELD_OUT_Z or as_trained < -FREE_RUN_BETTER or beyond_doubt
    return far and _free_runs_insist(candidate, current)


def is_poor(t: ValidatedHypothesis, noise: Float[np.ndarray, " C"]) -> bool:
    """Whether a model leaves errors far above the noise: what it lacks has a share in every comparison."""
    return bool(np.any(best_window_rmse(t) > 2 * noise))


def best_window_rmse(t: ValidatedHypothesis) -> Float[np.ndarray, " C"]:
    """Errors of short free runs with the parameters, of predictions or of free runs, that suit them best."""
    if t.free_run is None or runs_clearly_better(t.window_rmse, t.free_run.window_rmse):
        return t.window_rmse
    return t.free_run.window_rmse


def shares_at_each(
    candidates: Sequence[ValidatedHypothesis], current: ValidatedHypothesis
) -> Float[np.ndarray, "2 K"]:
    """What each candidate gains on validation data as a share of the most, as a predictor and in free runs.

    Zero where it gains nothing, and for free runs where one of the models has none.
    """
    shares = np.zeros((2, len(candidates)))
    for row, at in zip(shares, (lambda t: t, lambda t: t.free_run), strict=True):
        if candidates and all(at(t) is not None for t in (*candidates, current)):
            gains = np.array([at(t).log_likelihood - at(current).log_likelihood for t in candidates])
            row[:] = np.maximum(gains, 0.0) / max(float(gains.max()), 1e-9)
    return shares


def shares_of_gain(
    candidates: Sequence[ValidatedHypothesis], current: ValidatedHypothesis
) -> Float[np.ndarray, " K"]:
    """What each candidate gains on validation data as a share of the most, summed over the horizons."""
    return shares_at_each(candidates, current).sum(axis=0)


def likelier_of_each(candidates: Sequence[ValidatedHypothesis]) -> list[ValidatedHypothesis]:
    """Of each effect, at each horizon, the fit that is likelier on the training recordings."""

    def better(a: ValidatedHypothesis, b: ValidatedHypothesis) -> ValidatedHypothesis:
        return max(a, b, key=lambda v: v.hypothesis.log_likelihood)

    best: dict[EffectLocation | None, ValidatedHypothesis] = {}
    for v in candidates:
        known = best.setdefault(v.location, v)
        assert v.free_run and known.free_run
        best[v.location] = dataclasses.replace(better(known, v), free_run=better(known.free_run, v.free_run))
    return list(best.values())


def choose(
    candidates: list[ValidatedHypothesis],
    current: ValidatedHypothesis,
    measured: float,
    noise: Float[np.ndarray, " C"],
) -> tuple[ValidatedHypothesis | None, list[ValidatedHypothesis]]:
    """The best admissible candidate and those not distinguished from it; arguments as in `admissible`.

    Of admissible ones that are like the best (`_alike`), dry friction is chosen first, then what has
    the fewest parameters.
    A rival need not pass every test that the winner passed: where the effect is small, which of the two
    passes is chance. It is enough that it gains something and that nothing distinguishes it from the winner.
    """
    able = [t for t in candidates if admissible(t, current, measured, noise)]
    if not able:
        return None, []
    shares = {t.location: share for t, share in zip(able, shares_of_gain(able, current), strict=True)}
    winner = max(able, key=lambda t: shares[t.location])

    def simplest(t: ValidatedHypothesis) -> ValidatedHypothesis:
        """An effect, or one that it contains and is not clearly better than."""
        simpler = [x for x in able if _contained(x, t) and not _clearly_better(t, x, current)]
        return max(simpler, key=lambda x: shares[x.location], default=t)

    winner = simplest(winner)
    # Which of two that are alike leads is chance. Every machine has dry friction, so that goes first, then
    # what has fewer parameters; not what runs worse with the parameters of predictions, as an effect does
    # that imitates another one.
    first = _plausibility(winner)
    others = [t for t in able if not _related(t, winner) and _plausibility(t) < first]
    others = [t for t in others if _log_error_ratio(t, winner) <= WINDOWS_APART]
    if alike := [t for t in others if _alike(winner, t, current, noise)]:
        winner = simplest(min(alike, key=lambda t: (*_plausibility(t), -shares[t.location])))
    rivals = [t for t in candidates if t is not winner and not _related(t, winner)]
    gains = [
        t for t in rivals if t.log_likelihood > current.log_likelihood and _training_gain(t, current)[0] > 0
    ]
    return winner, [t for t in gains if _alike(winner, t, current, noise)]


def _plausibility(t: ValidatedHypothesis) -> tuple[bool, int]:
    """What decides between effects that data do not distinguish, the least first."""
    assert t.location
    return law_of(t.location.effect) != DRY_FRICTION, t.parameter_count


def undecided(found: ValidatedHypothesis, rival: ValidatedHypothesis, left: float, measured: float) -> bool:
    """Whether a rival in the place of an effect of a poor model remains possible.

    What such a model lacks suits one of two laws better than the other. It cannot make the whole difference
    where free runs over training and validation data differ by more than is left of their errors, or where
    predictions lose more than would be gained if what is left were the sensor noise alone. A generalisation
    must do better besides: without a use for its further parameters it is the law that was found.

    Args:
        found: The model that was found; `parameter_count` is that of the effect.
        rival: The same with the rival in the place of the effect.
        left: What predictions of training and validation data leave above the sensor noise [nat].
        measured: How many values of training recordings were measured.
    """
    if _contained(found, rival) and not (_is_worth(rival, found, measured) or _leads(rival, found)):
        return False
    lost = paired_gain(found.blocks, rival.blocks)[0] + _training_gain(found, rival)[0]
    if predictions_apart(found, rival) and lost > left:
        return False
    return _free_run_certainty(found, rival) < FREE_RUN_Z or log_best_ratio(rival, found) < LAWS_APART


def better_in_place(rival: ValidatedHypothesis, found: ValidatedHypothesis, measured: float) -> bool:
    """Whether a rival is to take the place of an effect.

    Predictions prefer it beyond doubt, and free runs by a tenth over training and over validation data; or
    free runs prefer it beyond doubt, over both, and predictions do not distinguish the two.

    Args:
        rival: The model with the rival in the place of the effect.
        found: The model that was found; `parameter_count` is that of the effect.
        measured: How many values of training recordings were measured.
    """
    if _free_runs_insist(rival, found) and not predictions_apart(found, rival):
        return True
    more = max(rival.parameter_count - found.parameter_count, 0)
    gains = paired_gain(rival.blocks, found.blocks)[0], _training_gain(rival, found)[0]
    enough = gains[0] > HELD_OUT_NATS and gains[1] > needed_gain(more, measured)
    return enough and predictions_apart(rival, found) and free_runs_apart(rival, found)


def _leads(rich: ValidatedHypothesis, simple: ValidatedHypothesis) -> bool:
    """Whether training and validation data both distinguish a generalisation, at one of the horizons.

    What it gains need not be worth its parameters: beside what a poor model leaves, that size says little.
    """
    certainty = paired_gain(rich.blocks, simple.blocks)[1], _training_gain(rich, simple)[1]
    return min(certainty) > SEPARATE_Z or _free_run_certainty(rich, simple) > SEPARATE_Z


def _is_worth(rich: ValidatedHypothesis, simple: ValidatedHypothesis, measured: float) -> bool:
    """Whether predictions of validation data prefer a generalisation, and of training data after the penalty.

    Args:
        rich: The generalisation.
        simple: What it contains.
        measured: How many values of training recordings were measured.
    """
    more = rich.parameter_count - simple.parameter_count
    gain = rich.log_likelihood - simple.log_likelihood
    return gain > 0 and _training_gain(rich, simple)[0] > needed_gain(more, measured)


def needed_gain(parameter_count: int, measured: float) -> float:
    """Gain on training data that so many more parameters have to bring [nat]."""
    return TRAIN_NATS + 0.5 * parameter_count * float(np.log(measured))


def replaced_by(
    winner: EffectLocation,
    before: Sequence[list[Score]],
    after: Sequence[list[Score]],
    tried: Sequence[EffectLocation],
) -> list[EffectLocation]:
    """Candidates that promised much and promise nothing beside the winner: it may stand in their place.

    Effects that do nearly the same at the motion of a recording (a dead zone of the input and friction at
    the hub, where the hub stops at every reversal) take each other's score. Which of them is refitted first
    is decided by slopes beside a model that lacks all of them, so those that lost theirs are refitted too.

    Args:
        winner: Effect that is going to be added; what contains it can still be added later.
        before: Scores beside the model without it, of predictions and of free runs, best first.
        after: The same beside the model with it.
        tried: Effects that were refitted beside the model without it.

    Returns:
        At most `REPLACED` locations, those first that promised most.
    """
    share: dict[EffectLocation, float] = {}
    for listed, later in zip(before, after, strict=True):
        worth = promising(listed, len(listed))
        left = {s.location: s.nats for s in later}
        for s in worth:
            if left.get(s.location, 0.0) < REPLACED_LEFT * s.nats:
                share[s.location] = share.get(s.location, 0.0) + s.nats / worth[0].nats
    lost = [
        p
        for p in share
        if share[p] >= REPLACED_SHARE and p not in tried and not p.contains(winner) and p != winner
    ]
    return sorted(lost, key=lambda p: -share[p])[:REPLACED]


def validate_from_best_states(
    validation: ValidationSet, candidates: list[ValidatedHypothesis]
) -> list[ValidatedHypothesis]:
    """Candidates; a simpler effect may also start in the first states of a richer one that does better.

    The search for these states may end in different minima, which must not decide between effects.
    """
    out = []
    for t in candidates:
        richer = [r for r in candidates if _contained(t, r) and r.log_likelihood > t.log_likelihood]
        if richer:
            best = max(richer, key=lambda r: r.log_likelihood)
            inner = t.free_run.adapted if t.free_run else None
            again = validate(validation, t.hypothesis, best, inner)
            again = dataclasses.replace(
                again, location=t.location, parameter_count=t.parameter_count, free_run=t.free_run
            )
            t = max(t, again, key=lambda x: x.log_likelihood)
        out.append(t)
    return out


def distinguished(winner: ValidatedHypothesis, rival: ValidatedHypothesis) -> bool:
    """Whether all recordings together, block by block, prefer the winner beyond doubt, or free runs do."""
    return free_runs_apart(winner, rival) or predictions_apart(winner, rival)


def predictions_apart(winner: ValidatedHypothesis, rival: ValidatedHypothesis) -> bool:
    """Whether predictions of all recordings together, block by block, prefer the winner beyond doubt."""
    # Where runs validate each other, the blocks of training are the same samples once more.
    both = [(t.blocks,) if t.folds else (t.blocks, t.hypothesis.blocks) for t in (winner, rival)]
    a, b = (np.concatenate(blocks) for blocks in both)
    return paired_gain(a, b)[1] >= SEPARATE_Z


def _alike(
    winner: ValidatedHypothesis,
    rival: ValidatedHypothesis,
    current: ValidatedHypothesis,
    noise: Float[np.ndarray, " C"],
) -> bool:
    """Whether a rival does what the winner does, as far as a model that leaves so much can tell.

    Where errors are above twice the noise, one that gains nearly as much counts as alike even if the
    likelihood distinguishes it.
    """
    if not distinguished(winner, rival):
        return True
    if free_runs_apart(winner, rival) or not is_poor(winner, noise):
        return False
    gains = [
        paired_gain(t.blocks, current.blocks)[0] + _training_gain(t, current)[0] for t in (winner, rival)
    ]
    return gains[1] > (1 - GAIN_APART) * gains[0] > 0


def _related(a: ValidatedHypothesis, b: ValidatedHypothesis) -> bool:
    """Whether one of two effects is a special case of the other."""
    assert a.location and b.location
    return a.location.is_related_to(b.location)


def free_runs_apart(winner: ValidatedHypothesis, rival: ValidatedHypothesis) -> bool:
    """Whether short free runs distinguish the winner from a rival that is worse.

    Where half-second blocks of free runs over training or over validation data prefer the rival, the smaller
    error of the winner on validation data is chance.
    """
    if log_best_ratio(rival, winner) <= WINDOWS_APART:
        return False
    return winner.free_run is None or rival.free_run is None or _free_run_certainty(winner, rival) > 0


def log_best_ratio(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """Mean log ratio of the errors of short free runs, each with the parameters that suit them best."""
    return mean_log_ratio(best_window_rmse(a), best_window_rmse(b))


def _contained(small: ValidatedHypothesis, large: ValidatedHypothesis) -> bool:
    """Whether `large` has the effect of `small` as a special case."""
    a, b = small.location, large.location
    assert a and b
    return b.contains(a)


def _clearly_better(
    rich: ValidatedHypothesis, simple: ValidatedHypothesis, current: ValidatedHypothesis
) -> bool:
    """Whether the richer effect is worth its extra parameters on validation and on training data."""
    nats = paired_gain(rich.blocks, simple.blocks)[0]
    train = rich.hypothesis.log_likelihood - simple.hypothesis.log_likelihood
    share = nats / max(paired_gain(rich.blocks, current.blocks)[0], 1e-9)
    runs_as_well = log_best_ratio(rich, simple) < WINDOWS_BETTER
    # Few seconds of validation data are few blocks: whether the gain is chance, all blocks say together.
    return _free_runs_insist(rich, simple) or (
        nats > 10 and train > 20 and share > 0.003 and runs_as_well and predictions_apart(rich, simple)
    )


def _free_runs_insist(candidate: ValidatedHypothesis, current: ValidatedHypothesis) -> bool:
    """Whether free runs alone show beyond doubt that a candidate is better."""
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None or _log_error_ratio(runs, before) > -FREE_RUN_BETTER:
        return False
    return _free_run_certainty(candidate, current) > FREE_RUN_Z


def _free_run_certainty(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """By how many standard deviations free runs prefer `a`, the less of training and of validation data."""
    runs, others = a.free_run, b.free_run
    assert runs and others
    return min(paired_gain(runs.blocks, others.blocks)[1], _training_gain(runs, others)[1])


def runs_clearly_better(a: Float[np.ndarray, " C"], b: Float[np.ndarray, " C"]) -> bool:
    """Whether errors `a` of short free runs are clearly smaller than errors `b`."""
    return mean_log_ratio(a, b) < -WINDOWS_BETTER
