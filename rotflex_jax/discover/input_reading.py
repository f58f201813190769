"""Whether a model explains its recordings better with an input that is smooth between its samples.

A converter holds each value until the next; a voltage that was measured behind a low-pass filter is
determined between its samples by the samples. The two differ by half a sample of delay. Read wrongly at a low
rate, that delay has the phase of friction, and a search may name a richer friction than there is.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.likelihood import LikelihoodProblem, refit
from rotflex_jax.discover.selection import paired_gain
from rotflex_jax.mechanism.intersample import KERNEL_HALF_WIDTH, interpolation_weights

# The other reading is named where it gains this [nat], and so many standard deviations of the block gains.
LEAST_NATS, LEAST_Z = 20.0, 3.0
# An input of which more samples than this share repeat the one before is held.
MOST_REPEATED = 0.5


def held_equivalent(u: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Values that act, each held over its sample, as the band-limited signal through the samples does.

    That is its value in the middle of each sample, with the amplitude that holding takes restored.

    >>> t = 0.1 * np.arange(200.0)
    >>> bool(np.allclose(held_equivalent(np.sin(t))[50:150], np.sin(t + 0.05)[50:150], atol=1e-3))
    True
    """
    before, after = KERNEL_HALF_WIDTH - 1, KERNEL_HALF_WIDTH
    ends = np.concatenate([np.full(before, u[0]), u, np.full(after, u[-1])])
    return np.correlate(ends, interpolation_weights(1)[0], "valid")


def nats_if_smooth(problem: LikelihoodProblem, h: Hypothesis) -> float:
    """What a fitted model gains with the input read as smooth, not held [nat]; zero if that is not clear.

    The input is data of the compiled programs, so this costs one refit from where the model is.

    Args:
        problem: Predictions of recordings.
        h: Fitted to them with the input held.
    """
    data = problem.dataset.data
    if getattr(problem.predictor.solver, "between", "") != "held":
        return 0.0
    u = np.array(data.u)
    for row, recording in zip(u, problem.dataset.recordings, strict=True):
        if np.mean(np.diff(recording.u) == 0) > MOST_REPEATED:
            return 0.0
        row[: recording.N] = held_equivalent(recording.u.astype(float))
    read = data._replace(u=u)
    smooth = dataclasses.replace(
        problem,
        predictor=dataclasses.replace(problem.predictor, data=read),
        dataset=dataclasses.replace(problem.dataset, data=read),
    )
    start = smooth.with_likelihood(h)
    if not np.isfinite(start.log_likelihood):
        return 0.0
    gain, z = paired_gain(refit(smooth, [start], alternations=1)[0].blocks, h.blocks)
    return gain if gain > LEAST_NATS and z > LEAST_Z else 0.0


def smooth_note(nats: float) -> tuple[str, ...]:
    """That the other reading of the input is better, and how to ask for it; nothing for zero."""
    if not nats:
        return ()
    return (
        "The input was taken as held between its samples, but the baseline explains the recordings "
        f"{nats:.0f} nats better with one that is smooth there, as a voltage is behind a low-pass filter: "
        "search again with --intersample smooth, in Python with "
        'rotflex_jax.Model(joint, rotflex_jax.Exponential(between="smooth", substeps=4)).',
    )
