"""Checks of the recordings of a search: whether they were read wrongly, and whether they can decide.

An input may be smooth between its samples. A converter holds each value until the next sample. A voltage that
was measured behind a low-pass filter is band-limited, so its samples determine it between the samples. The
two differ by a delay of half a sample. At a low sampling rate, a wrong assumption has the phase of friction,
and a search may find a richer friction than there is.

A channel may have the opposite sign: a deflection measured from the arm to the hub, or a sensor mounted in
the opposite direction. A fit then ends at values far from those of any machine.

In the validation data, a channel that moves in the training data may be nearly at rest, for example at the
end of a step. Effects on this channel then make no difference, whatever their size.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.selection import paired_gain
from rotflex_jax.discover.stepwise import values_given
from rotflex_jax.discover.validation import as_free_run
from rotflex_jax.fit.dataset import Windows, prepare
from rotflex_jax.mechanism.intersample import KERNEL_HALF_WIDTH, interpolation_weights
from rotflex_jax.models.model import Model
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.text.numbers import plain_number, readable

# A smooth input is reported if it gains more than this [nat] and this many standard deviations of block
# gains.
LEAST_NATS, LEAST_Z = 20.0, 3.0
# An input counts as held if more than this share of its samples repeat the sample before.
MOST_REPEATED = 0.5


def held_equivalent(u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Values that, each held over its sample, act as the band-limited signal through the samples.

    These are the values of the signal in the middle of each sampling interval, with a correction of the
    amplitude that holding reduces.

    >>> t = 0.1 * np.arange(200.0)
    >>> bool(np.allclose(held_equivalent(np.sin(t))[50:150], np.sin(t + 0.05)[50:150], atol=1e-3))
    True
    """
    before, after = KERNEL_HALF_WIDTH - 1, KERNEL_HALF_WIDTH
    ends = np.concatenate([np.full(before, u[0]), u, np.full(after, u[-1])])
    return np.correlate(ends, interpolation_weights(1)[0], "valid")


def nats_if_smooth(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """Gain of a fitted model in log-likelihood with a smooth input instead of a held one [nat].

    It is zero if the gain is not clear, or if the input is obviously held. The input is data of the compiled
    programs, so this takes one refit from the fitted model.

    Args:
        problem: Likelihood of predictions of recordings.
        h: Hypothesis fitted to them with the input held.
    """
    data = problem.dataset.data
    if getattr(problem.predictor.solver, "between", "") != "held":
        return 0.0
    data = data._replace(u=np.array(data.u))
    for row, recording in zip(data.voltage, problem.dataset.recordings, strict=True):
        if np.mean(np.diff(recording.u) == 0) > MOST_REPEATED:
            return 0.0
        row[: recording.N] = held_equivalent(recording.u.astype(float))
    smooth = problem.of_dataset(dataclasses.replace(problem.dataset, data=data))
    start = smooth.with_likelihood(h)
    if not np.isfinite(start.log_likelihood):
        return 0.0
    gain, z = paired_gain(refit(smooth, [start], alternations=1)[0].blocks, h.blocks)
    return gain if gain > LEAST_NATS and z > LEAST_Z else 0.0


def smooth_note(nats: float) -> tuple[str, ...]:
    """A note that a smooth input is better, with the option for it; no note if the gain is zero."""
    if not nats:
        return ()
    return (
        "The input was taken as held between its samples, but the baseline explains the recordings "
        f"{nats:.0f} nats better with one that is smooth there, as a voltage is behind a low-pass filter: "
        "search again with --intersample smooth, in Python with "
        'rotflex_jax.Model(joint, rotflex_jax.Exponential(between="smooth", substeps=4)).',
    )


# The opposite sign of a channel is tried if errors of free runs exceed this share of the channel's standard
# deviation within windows. It is reported if errors then fall below the second share of their former size.
LEAST_LEFT, MOST_LEFT = 0.5, 0.6


def opposite_signs(
    model: Model, problem: LikelihoodProblem, h: Hypothesis, seconds: float
) -> dict[str, tuple[float, float]]:
    """Channels that the user's model explains much better with the opposite sign.

    Only channels with large errors of the fitted model are tried. Measured outputs are data of the compiled
    programs, so each channel takes one refit to free runs, from the user's values.

    Args:
        model: The user's model.
        problem: Likelihood of free runs over the training recordings.
        h: The model fitted to these free runs.
        seconds: Length of the free runs [s].

    Returns:
        Channel -> its root mean square error as it was read, and with the opposite sign. Empty if runs of the
        fitted model diverge.
    """
    found: dict[str, tuple[float, float]] = {}
    if not np.isfinite(h.log_likelihood):
        return found
    left, size = problem.channel_errors(h), _deviations(problem)
    for k, channel in enumerate(model.mechanism.channels):
        if left[k] < LEAST_LEFT * size[k]:
            continue
        reversed_ = _with_opposite_sign(model, problem, channel, seconds)
        start = as_free_run(reversed_, values_given(reversed_))
        if not np.isfinite(start.log_likelihood):
            continue
        fitted = refit(reversed_, [start])[0]
        other = reversed_.channel_errors(fitted)[k]
        if other < MOST_LEFT * left[k] and fitted.log_likelihood > h.log_likelihood:
            found[channel] = (float(left[k]), float(other))
    return found


def _deviations(problem: LikelihoodProblem) -> Float[np.ndarray, " C"]:
    """Standard deviation of each measured channel within the windows of free runs."""
    parts = []
    for r, recording in enumerate(problem.dataset.recordings):
        y = problem.dataset.data.y[r, : recording.N]  # without padding
        parts += [y[samples] - y[samples].mean(axis=0) for _, samples in problem.windows.of(r)]
    return np.concatenate(parts).std(axis=0)


def _with_opposite_sign(
    model: Model, problem: LikelihoodProblem, channel: str, seconds: float
) -> LikelihoodProblem:
    """Free runs over the same recordings with one channel negated."""
    negated = []
    for r in problem.dataset.recordings:
        sign = np.where(np.array(r.channels) == channel, -1.0, 1.0)
        # A fault that the user has accepted, such as a limit at zero, may be another fault after negation.
        negated.append(dataclasses.replace(r, y=r.y * sign, accept=ACCEPTABLE))
    length = problem.dataset.data.seen.shape[1]
    dataset = prepare(model, negated, length=length, like=problem.dataset)
    windows = Windows.of_seconds(model, dataset, seconds).filled_up(problem.windows.number)
    return dataclasses.replace(problem.of_dataset(dataset), windows=windows)


def sign_note(
    found: dict[str, tuple[float, float]], units: dict[str, str], seconds: float
) -> tuple[str, ...]:
    """A sentence on each channel that may have the opposite sign.

    Args:
        found: As `opposite_signs` gives them.
        units: Channel -> its own unit.
        seconds: Length of the free runs [s].
    """
    sentences, what = [], "the input" if set(found) == set(units) else "that column"
    for channel, errors in found.items():
        before, after = (_shown(error, units[channel]) for error in errors)
        sentences.append(
            f"{channel} may have been recorded with the opposite sign: free runs of the model as it is over "
            f"{seconds:g} s of training data leave {before} of it, and {after} where it "
            f"is negated. If so, negate {what} and search again."
        )
    return tuple(sentences)


# A channel hardly moves in validation data if its standard deviation is below this share of the one in
# training.
LEAST_MOTION = 0.1


def still_channels(train: LikelihoodProblem, validation: LikelihoodProblem) -> dict[str, tuple[float, float]]:
    """Channels that hardly move in validation data.

    Args:
        train: Likelihood of free runs over the training recordings.
        validation: Likelihood of free runs over the validation recordings.

    Returns:
        Channel -> its standard deviation within windows of training and of validation data, in its unit.
    """
    channels = train.supermodel.mechanism.channels
    pairs = zip(channels, _deviations(train).tolist(), _deviations(validation).tolist(), strict=True)
    return {c: (moved, rests) for c, moved, rests in pairs if rests < LEAST_MOTION * moved}


def still_note(
    found: dict[str, tuple[float, float]], units: dict[str, str], seconds: float
) -> tuple[str, ...]:
    """A sentence on each channel that hardly moves in validation data.

    Args:
        found: As `still_channels` gives them.
        units: Channel -> its own unit.
        seconds: Length of the windows [s].
    """
    sentences = []
    for channel, deviations in found.items():
        moved, rests = (_shown(x, units[channel]) for x in deviations)
        sentences.append(
            f"{channel} hardly moves in the validation data: its standard deviation within {seconds:g} s is "
            f"{rests}, and {moved} in the training data. They say little of what acts on {channel}; give "
            "validation data in which it moves."
        )
    return tuple(sentences)


def _shown(value: float, unit: str) -> str:
    """A value with its unit, as people read it."""
    number, read = readable(value, unit)
    return f"{plain_number(number)} {read}"
