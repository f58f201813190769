"""Rules by which validation data choose an effect, or a set of effects that cannot be distinguished.

Two candidates are reported together unless log-likelihoods of all recordings differ by two standard
deviations of their differences over half-second blocks, or errors of short free runs by a tenth. Far from the
noise, candidates with nearly the same gain are reported together too. A richer effect must be better than the
simpler effect that it contains in one of three ways:

- Predictions of validation data are better by 10 nats, those of training data by 20 nats, and both together
  by two standard deviations of their blocks; free runs are no worse.
- Free runs over validation and over training data are better, each by 2.5 standard deviations, with errors
  over validation data smaller by a tenth.
- The model is poor with the simpler effect. Predictions of training data are better after the penalty for the
  parameters, and those of all data by two standard deviations; free runs over validation and over training
  data are better, each by 1.5 standard deviations, with errors over validation data smaller by a tenth.
  Predictions of validation data may then be worse, by less than 1.5 standard deviations.

Every candidate is compared at two horizons, with parameters fitted at each: predictions and short free runs.
Where another part of the model is wrong, the likeliest predictor follows the data within a few samples, and
its parameters are of no use for a free run. Where the model is nearly right, free runs have less power. So
both horizons count, and a preference of free runs alone counts if it is strong.
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

# Least gain of an effect on validation data [nat], and least number of standard deviations of the block gains
# there; least gain on training data [nat] beyond half a log N per parameter, and least number of standard
# deviations there.
HELD_OUT_NATS, HELD_OUT_Z, TRAIN_NATS, TRAIN_Z = 5.0, 1.5, 8.0, 2.0
# Change of the mean log error of free runs over short windows: near the sensor noise the error may rise by no
# more than the first, elsewhere it must fall by at least the second.
WINDOWS_WORSE, WINDOWS_BETTER = 0.02, 0.01
# Two effects are distinguished if their paired block differences exceed this many standard deviations, or if
# errors of free runs over short windows differ by more than this (mean log ratio).
SEPARATE_Z, WINDOWS_APART = 2.0, 0.1
# If the winner leaves errors far above the noise, a rival is distinguished by likelihood only if its gain is
# smaller by this share. Whatever else the model lacks may cause a smaller difference between two effects that
# do nearly the same.
GAIN_APART = 0.1
# Every machine has dry friction. In a poor model it is chosen before a leading effect from which free runs do
# not distinguish it, if its gain in predictions is at least this share of the gain of that effect.
FRICTION_SHARE = 0.75
# An effect that predictions do not prefer must be preferred by free runs: by this many standard deviations of
# the block gains, on validation and on training data, and with errors smaller by this (mean log ratio).
FREE_RUN_Z, FREE_RUN_BETTER = 2.5, 0.1
# A richer effect that predictions of training data prefer needs less certainty of free runs. Predictions of
# validation data refuse it if they prefer the simpler effect by the second number of standard deviations.
SUPPORT_Z, OBJECTION_Z = 1.5, 1.5
# An effect that predictions prefer by this many standard deviations, on validation and on training data, need
# not improve free runs that are dominated by another error, if it does not make them worse.
PREDICTION_Z = 3.5
# Where a channel hardly moves in the validation data, dry friction must be preferred by free runs of training
# data by this many standard deviations of the block gains; those of validation data need only agree.
RESTING_TRAIN_Z = 5.0
# Free runs of a poor model exclude a rival whose errors are larger by this (mean log ratio). If the
# difference between the runs is independent of the errors that are left, it is then as large as they are.
LAWS_APART = 0.5 * float(np.log(2.0))
# Candidates in whose place a winner may stand: their largest number, the least score of each as a share of
# the best score of the round (shares of both horizons added), and the largest share of its score that is left
# beside the winner.
REPLACED, REPLACED_SHARE, REPLACED_LEFT = 2, 0.25, 0.1


def paired_gain(a: Float[np.ndarray, " B"], b: Float[np.ndarray, " B"]) -> tuple[float, float]:
    """Sum of the differences of blocks `a` and `b` [nat], and this sum over its standard deviation."""
    d = a - b
    spread = float(np.std(d, ddof=1) * np.sqrt(len(d))) if len(d) > 1 else np.inf
    return float(d.sum()), float(d.sum()) / max(spread, 1e-12)


def horizon_gains(
    candidate: ValidatedHypothesis, current: ValidatedHypothesis
) -> tuple[HorizonGain, HorizonGain | None]:
    """Gains of a candidate on validation data, in predictions and in free runs."""
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
    """Whether a gain at one horizon is positive by more than `HELD_OUT_Z` standard deviations."""
    return gain.z > HELD_OUT_Z and gain.gain > 0


def describe(candidate: ValidatedHypothesis, current: ValidatedHypothesis) -> str:
    """A candidate with its gains, in one line of progress."""
    return f"{candidate.location}: {gains_in_words(candidate, current)}"


def gains_in_words(candidate: ValidatedHypothesis, current: ValidatedHypothesis) -> str:
    """The gains of a candidate over a model, at both horizons, in words."""
    nats, z = paired_gain(candidate.blocks, current.blocks)
    train, train_z = _training_gain(candidate, current)
    ratio = float(np.exp(_log_error_ratio(candidate, current)))
    line = (
        f"log-likelihood of validation data {nats:+.0f} nat (z {z:.1f}), of training data {train:+.0f} nat "
        f"(z {train_z:.1f}), {error_ratio(ratio)}"
    )
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None:
        return line
    z, train_z = paired_gain(runs.blocks, before.blocks)[1], _training_gain(runs, before)[1]
    ratio = float(np.exp(_log_error_ratio(runs, before)))
    return f"{line}; fitted to free runs: {error_ratio(ratio)} (z {z:.1f}, of training data {train_z:.1f})"


# A free run whose error is this many times as large as before is called one that diverges.
DIVERGED = 1e6


def error_ratio(ratio: float) -> str:
    """How a free-run error compares with the one before.

    >>> error_ratio(1.87), error_ratio(1.002), error_ratio(5e35)
    ('free-run error 1.9 times as large', 'free-run error unchanged', 'free runs diverge')
    """
    if not ratio < DIVERGED:
        return "free runs diverge"
    times = f"{ratio:.2g}"
    return "free-run error unchanged" if times == "1" else f"free-run error {times} times as large"


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
    still: bool = False,
) -> bool:
    """Whether a candidate passes the tests of one round on training and validation data.

    Args:
        candidate: The hypothesis with the candidate.
        current: The hypothesis without it.
        measured: Number of measured values in the training recordings.
        noise: Standard deviation of the sensor noise of each channel.
        still: Whether a channel hardly moves in the validation data.
    """
    nats, z = paired_gain(candidate.blocks, current.blocks)
    train, train_z = _training_gain(candidate, current)
    needed = needed_gain(candidate.parameter_count, measured)
    # The likelihood concerns the next samples, but a user wants free runs: both must agree. Far from the
    # sensor noise, an effect that does not improve free runs is additional flexibility and no discovery.
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
    # Where the machine rests, friction that holds it and a model that is too heavy to move do the same, so
    # validation data at rest cannot be certain of either: they need only agree with training data.
    training_decides = still and _is_dry_friction(candidate)
    if training_decides and _training_gain(runs, before)[1] >= RESTING_TRAIN_Z:
        return far and _free_runs_prefer(candidate, current, 0.0)
    return far and _free_runs_prefer(candidate, current, FREE_RUN_Z)


def is_poor(t: ValidatedHypothesis, noise: Float[np.ndarray, " C"]) -> bool:
    """Whether errors of free runs exceed twice the noise, so that what the model lacks biases comparisons."""
    return bool(np.any(best_window_rmse(t) > 2 * noise))


def best_window_rmse(t: ValidatedHypothesis) -> Float[np.ndarray, " C"]:
    """Errors of short free runs, with the better of the parameters fitted to predictions and to free runs."""
    if t.free_run is None or runs_clearly_better(t.window_rmse, t.free_run.window_rmse):
        return t.window_rmse
    return t.free_run.window_rmse


def shares_at_each(
    candidates: Sequence[ValidatedHypothesis], current: ValidatedHypothesis
) -> Float[np.ndarray, "2 K"]:
    """Gain of each candidate on validation data as a share of the largest, in predictions and in free runs.

    The share is zero where a candidate gains nothing. It is zero for free runs if one of the models has none.
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
    """Gain of each candidate on validation data as a share of the largest, summed over both horizons."""
    return shares_at_each(candidates, current).sum(axis=0)


def likelier_of_each(candidates: Sequence[ValidatedHypothesis]) -> list[ValidatedHypothesis]:
    """For each effect and at each horizon, the likeliest fit on the training recordings."""

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
    still: bool = False,
) -> tuple[ValidatedHypothesis | None, list[ValidatedHypothesis]]:
    """The best admissible candidate, and the candidates that are not distinguished from it.

    Among admissible candidates that are like the best (`_alike`), dry friction is chosen first, then the
    candidate with the fewest parameters. A rival need not pass every test that the winner passed: where the
    effect is small, chance decides which of the two passes. It is enough that the rival gains something and
    that nothing distinguishes it from the winner. Arguments are as in `admissible`.
    """
    able = [t for t in candidates if admissible(t, current, measured, noise, still)]
    if not able:
        return None, []
    shares = {t.location: share for t, share in zip(able, shares_of_gain(able, current), strict=True)}
    winner = max(able, key=lambda t: shares[t.location])

    def clearly_better(rich: ValidatedHypothesis, simple: ValidatedHypothesis) -> bool:
        return _clearly_better(rich, simple, current, measured, noise)

    def simplest(t: ValidatedHypothesis) -> ValidatedHypothesis:
        """The best effect that `t` contains and is not clearly better than; `t` itself if there is none."""
        simpler = [x for x in able if _contained(x, t) and not clearly_better(t, x)]
        return max(simpler, key=lambda x: shares[x.location], default=t)

    # An effect that is clearly better than the leading one, which it contains, need not lead itself.
    richer = [t for t in able if _contained(winner, t) and clearly_better(t, winner)]
    winner = simplest(max(richer, key=lambda t: shares[t.location], default=winner))
    # Chance decides which of two alike candidates leads. Every machine has dry friction, so dry friction
    # comes first, then the candidate with fewer parameters. A candidate whose free runs are worse with the
    # parameters of predictions is excepted: such an effect may imitate another one.
    first = _plausibility(winner)
    others = [t for t in able if not _related(t, winner) and _plausibility(t) < first]

    def replaces_winner(t: ValidatedHypothesis) -> bool:
        like = _log_error_ratio(t, winner) <= WINDOWS_APART and _alike(winner, t, current, noise)
        return like or _friction_comes_first(winner, t, current, noise)

    if alike := [t for t in others if replaces_winner(t)]:
        winner = simplest(min(alike, key=lambda t: (*_plausibility(t), -shares[t.location])))
    rivals = [t for t in candidates if t is not winner and not _related(t, winner)]
    gains = [
        t for t in rivals if t.log_likelihood > current.log_likelihood and _training_gain(t, current)[0] > 0
    ]
    return winner, [t for t in gains if _alike(winner, t, current, noise)]


def _friction_comes_first(
    winner: ValidatedHypothesis,
    rival: ValidatedHypothesis,
    current: ValidatedHypothesis,
    noise: Float[np.ndarray, " C"],
) -> bool:
    """Whether a rival is dry friction that is chosen before a leading effect of another kind.

    In a poor model predictions do not decide between the two. Friction that differs between runs has one size
    in them, and what the model lacks may favour either. A dead zone of the input does nearly the same.
    """
    if not _is_dry_friction(rival) or _is_dry_friction(winner) or not is_poor(winner, noise):
        return False
    if winner.free_run is None or rival.free_run is None:
        return False
    if free_runs_apart(winner, rival) or _free_run_certainty(winner, rival) > SEPARATE_Z:
        return False
    return _prediction_gain(rival, current) > FRICTION_SHARE * _prediction_gain(winner, current) > 0


def _prediction_gain(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """Gain in predictions of validation and training data together [nat]."""
    return paired_gain(a.blocks, b.blocks)[0] + _training_gain(a, b)[0]


def _plausibility(t: ValidatedHypothesis) -> tuple[bool, int]:
    """Sort key of effects that data do not distinguish: dry friction first, then fewer parameters."""
    return not _is_dry_friction(t), t.parameter_count


def _is_dry_friction(t: ValidatedHypothesis) -> bool:
    """Whether the effect of a candidate is a law of dry friction."""
    assert t.location
    return law_of(t.location.effect) == DRY_FRICTION


def undecided(found: ValidatedHypothesis, rival: ValidatedHypothesis, left: float, measured: float) -> bool:
    """Whether a rival remains possible in the place of an effect of a poor model.

    What such a model lacks may favour one of two laws. It cannot explain the whole difference if free runs
    over training and validation data differ by more than the errors that are left, or if predictions lose
    more by the rival than they would gain if only sensor noise were left. A rival that contains the effect
    found must also be better: if its further parameters are of no use, it is the law that was found.

    Args:
        found: The model that was found; its `parameter_count` counts the parameters of the effect.
        rival: The same model with the rival in the place of the effect.
        left: Log-likelihood that predictions of training and validation data would gain if their errors were
            the sensor noise alone [nat].
        measured: Number of measured values in the training recordings.
    """
    if _contained(found, rival) and not (_is_worth(rival, found, measured) or _leads(rival, found)):
        return False
    if predictions_apart(found, rival) and _prediction_gain(found, rival) > left:
        return False
    return _free_run_certainty(found, rival) < FREE_RUN_Z or log_best_ratio(rival, found) < LAWS_APART


def better_in_place(rival: ValidatedHypothesis, found: ValidatedHypothesis, measured: float) -> bool:
    """Whether a rival replaces an effect.

    It does if predictions clearly prefer it and free runs have errors smaller by a tenth with it; or if free
    runs over training and over validation data clearly prefer it, and predictions do not clearly prefer the
    effect.

    Args:
        rival: The model with the rival in the place of the effect.
        found: The model that was found; its `parameter_count` counts the parameters of the effect.
        measured: Number of measured values in the training recordings.
    """
    if _free_runs_prefer(rival, found, FREE_RUN_Z) and not predictions_apart(found, rival):
        return True
    gain = paired_gain(rival.blocks, found.blocks)[0]
    enough = gain > HELD_OUT_NATS and _pays_in_training(rival, found, measured)
    return enough and predictions_apart(rival, found) and free_runs_apart(rival, found)


def _leads(rich: ValidatedHypothesis, simple: ValidatedHypothesis) -> bool:
    """Whether training and validation data both clearly prefer a richer effect, at one of the horizons.

    The gain need not exceed the penalty for the parameters: in a poor model, the size of a gain says little.
    """
    certainty = paired_gain(rich.blocks, simple.blocks)[1], _training_gain(rich, simple)[1]
    return min(certainty) > SEPARATE_Z or _free_run_certainty(rich, simple) > SEPARATE_Z


def _is_worth(rich: ValidatedHypothesis, simple: ValidatedHypothesis, measured: float) -> bool:
    """Whether predictions prefer a richer effect: of validation data, and of training data after the penalty.

    Args:
        rich: The model with the richer effect.
        simple: The model with the effect that it contains.
        measured: Number of measured values in the training recordings.
    """
    return rich.log_likelihood > simple.log_likelihood and _pays_in_training(rich, simple, measured)


def _pays_in_training(a: ValidatedHypothesis, b: ValidatedHypothesis, measured: float) -> bool:
    """Whether predictions of training data prefer `a` to `b` after the penalty for further parameters."""
    more = max(a.parameter_count - b.parameter_count, 0)
    return _training_gain(a, b)[0] > needed_gain(more, measured)


def needed_gain(parameter_count: int, measured: float) -> float:
    """Least gain on training data that justifies a number of further parameters [nat]."""
    return TRAIN_NATS + 0.5 * parameter_count * float(np.log(measured))


def replaced_by(
    winner: EffectLocation,
    before: Sequence[list[Score]],
    after: Sequence[list[Score]],
    tried: Sequence[EffectLocation],
) -> list[EffectLocation]:
    """Candidates whose high score the winner takes away almost entirely: it may stand in their place.

    Two effects may do nearly the same in the motion of a recording, such as a dead zone of the input and
    friction at a hub that stops at every reversal. Adding one of them then removes the score of the other.
    Slopes beside a model that lacks both decide which one is refitted, so the other one is refitted too.

    Args:
        winner: Effect that is going to be added. Effects that contain it can still be added later.
        before: Scores beside the model without the winner, of predictions and of free runs, best first.
        after: Scores beside the model with the winner.
        tried: Effects that were refitted beside the model without the winner.

    Returns:
        At most `REPLACED` locations, the highest scores first.
    """
    share: dict[EffectLocation, float] = {}
    for listed, later in zip(before, after, strict=True):
        worth = promising(listed)
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
    """Candidates; a simpler effect is validated again from the first states of a richer one that is better.

    The fit of first states may end in different minima, which must not decide between effects.
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
    """Whether predictions of all recordings, or free runs, distinguish the winner from a worse rival."""
    return free_runs_apart(winner, rival) or predictions_apart(winner, rival)


def predictions_apart(winner: ValidatedHypothesis, rival: ValidatedHypothesis) -> bool:
    """Whether predictions of all recordings, by their half-second blocks, clearly prefer the winner."""
    # Where runs validate each other, the training blocks are the same samples as the validation blocks.
    both = [(t.blocks,) if t.folds else (t.blocks, t.hypothesis.blocks) for t in (winner, rival)]
    a, b = (np.concatenate(blocks) for blocks in both)
    return paired_gain(a, b)[1] >= SEPARATE_Z


def _alike(
    winner: ValidatedHypothesis,
    rival: ValidatedHypothesis,
    current: ValidatedHypothesis,
    noise: Float[np.ndarray, " C"],
) -> bool:
    """Whether a rival cannot be distinguished from the winner, given the errors that the model leaves.

    Where errors are above twice the noise, a rival with nearly the same gain counts as alike even if the
    likelihood distinguishes the two.
    """
    if not distinguished(winner, rival):
        return True
    if free_runs_apart(winner, rival) or not is_poor(winner, noise):
        return False
    return _prediction_gain(rival, current) > (1 - GAIN_APART) * _prediction_gain(winner, current) > 0


def _related(a: ValidatedHypothesis, b: ValidatedHypothesis) -> bool:
    """Whether one of two effects is a special case of the other."""
    assert a.location and b.location
    return a.location.is_related_to(b.location)


def free_runs_apart(winner: ValidatedHypothesis, rival: ValidatedHypothesis) -> bool:
    """Whether short free runs distinguish the winner from a worse rival.

    If half-second blocks of free runs over training or over validation data prefer the rival, the smaller
    error of the winner on validation data counts as chance.
    """
    if log_best_ratio(rival, winner) <= WINDOWS_APART:
        return False
    return winner.free_run is None or rival.free_run is None or _free_run_certainty(winner, rival) > 0


def log_best_ratio(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """Mean log ratio of the errors of short free runs, each as in `best_window_rmse`."""
    return mean_log_ratio(best_window_rmse(a), best_window_rmse(b))


def _contained(small: ValidatedHypothesis, large: ValidatedHypothesis) -> bool:
    """Whether `large` has the effect of `small` as a special case."""
    a, b = small.location, large.location
    assert a and b
    return b.contains(a)


def _clearly_better(
    rich: ValidatedHypothesis,
    simple: ValidatedHypothesis,
    current: ValidatedHypothesis,
    measured: float,
    noise: Float[np.ndarray, " C"],
) -> bool:
    """Whether a richer effect is clearly better than the simpler one, in one of the ways of this module."""
    if _free_runs_prefer(rich, simple, FREE_RUN_Z):
        return True
    if is_poor(simple, noise) and _preferred_but_for_validation_predictions(rich, simple, measured):
        return True
    nats = paired_gain(rich.blocks, simple.blocks)[0]
    train = rich.hypothesis.log_likelihood - simple.hypothesis.log_likelihood
    share = nats / max(paired_gain(rich.blocks, current.blocks)[0], 1e-9)
    runs_as_well = log_best_ratio(rich, simple) < WINDOWS_BETTER
    # Short validation data have few blocks, so the blocks of all data decide whether the gain is chance.
    return nats > 10 and train > 20 and share > 0.003 and runs_as_well and predictions_apart(rich, simple)


def _preferred_but_for_validation_predictions(
    rich: ValidatedHypothesis, simple: ValidatedHypothesis, measured: float
) -> bool:
    """Whether a richer effect is preferred by all but predictions of validation data, which do not object.

    Where a model is poor, predictions of short validation data differ little between two laws of friction,
    and rounding may decide their sign. They must not refuse a law that all else prefers.
    """
    if paired_gain(rich.blocks, simple.blocks)[1] < -OBJECTION_Z:
        return False
    preferred = _pays_in_training(rich, simple, measured) and predictions_apart(rich, simple)
    return preferred and _free_runs_prefer(rich, simple, SUPPORT_Z)


def _free_runs_prefer(candidate: ValidatedHypothesis, current: ValidatedHypothesis, least: float) -> bool:
    """Whether free runs prefer a candidate: by errors, and by blocks of training and of validation data.

    Args:
        candidate: The model that may be better.
        current: The model with which it is compared.
        least: Standard deviations that the blocks of either data must exceed.
    """
    runs, before = candidate.free_run, current.free_run
    if runs is None or before is None or _log_error_ratio(runs, before) > -FREE_RUN_BETTER:
        return False
    return _free_run_certainty(candidate, current) > least


def _free_run_certainty(a: ValidatedHypothesis, b: ValidatedHypothesis) -> float:
    """Standard deviations by which free runs prefer `a`; the smaller one of training and validation data."""
    runs, others = a.free_run, b.free_run
    assert runs and others
    return min(paired_gain(runs.blocks, others.blocks)[1], _training_gain(runs, others)[1])


def runs_clearly_better(a: Float[np.ndarray, " C"], b: Float[np.ndarray, " C"]) -> bool:
    """Whether errors `a` of short free runs are clearly smaller than errors `b`."""
    return mean_log_ratio(a, b) < -WINDOWS_BETTER
