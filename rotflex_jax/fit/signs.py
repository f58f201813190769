"""Checks that channels move in the direction that the model predicts: with a wrong sign no fit succeeds."""

import itertools
from collections.abc import Sequence

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import linearise
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

# Moves over each of these shares of the recording, of at most so many samples, are compared.
MOVE_SHARES, MAX_SIGN_SAMPLES = (0.001, 0.003, 0.01, 0.03), 20_000
# RecordingSamples of a block of the linear run.
LINEAR_RUN_BLOCK = 64
# A channel that moves against the model at all shares, correlated at least this much.
OPPOSED_CORRELATION = -0.6


def check_signs(model: Model, recordings: Sequence[Recording]) -> None:
    """Refuses recordings whose channels move against the model.

    The linear part of the model, with the parameters that it has, runs under the recorded input. Rough
    values will do, as only the direction of each move counts. A resonance that the model puts on the other
    side of all excited frequencies reverses a channel as well: then a nearer start helps.

    Args:
        model: Before any fit.
        recordings: To be fitted.

    Raises:
        InputError: Channels that move in the opposite direction.
    """
    against: set[str] = set()
    worst = 0.0
    for recording in recordings:
        linear = linearise(model.at(recording).mechanism)
        r = recording.slice(0, min(recording.N, MAX_SIGN_SAMPLES))
        y, would = model.measured(r).astype(float), _response(linear.discretise(r.Ts), linear.C, r.u)
        if not np.all(np.isfinite(would)):
            continue
        for channel, a, b in zip(model.mechanism.channels, y.T, would.T, strict=True):
            found = [_correlation(a, b, max(round(share * r.N), 1)) for share in MOVE_SHARES]
            if max(found) < OPPOSED_CORRELATION:
                against.add(channel)
                worst = min(worst, *found)
    if not against:
        return
    every = against == set(model.mechanism.channels)
    names = " and ".join(c for c in model.mechanism.channels if c in against)
    what = "the input" if every else f"the column of {names}"
    verb = "moves" if len(against) == 1 else "move"
    raise InputError(
        f"{names} {verb} against what the model would do under this input (correlation {worst:.2f}), as with "
        f"a sign turned round; negate {what} if that is so, or give the model a start nearer to the machine."
    )


def _response(discrete: tuple[np.ndarray, np.ndarray], C: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs (N, C) of a linear system from rest, a block of samples at a time."""
    A, B = discrete
    with np.errstate(all="ignore"):
        powers = np.array([*itertools.accumulate([A] * LINEAR_RUN_BLOCK, np.matmul, initial=np.eye(len(A)))])
        left, pushed = (
            C @ powers[:-1],
            powers[:-1] @ B,
        )  # what a state and an input do later (L, C, n), (L, n)
        lag = np.subtract.outer(np.arange(LINEAR_RUN_BLOCK), np.arange(LINEAR_RUN_BLOCK)) - 1
        kernel = np.where(lag[..., None] >= 0, (pushed @ C.T)[lag], 0.0)  # (L, L, C)
        blocks = np.pad(u, (0, -len(u) % LINEAR_RUN_BLOCK)).reshape(-1, LINEAR_RUN_BLOCK)
        adds = blocks @ pushed[::-1]
        states = np.array(
            [*itertools.accumulate(adds[:-1], lambda x, new: powers[-1] @ x + new, initial=0 * B)]
        )
        y = np.tensordot(blocks, kernel, (1, 1)) + np.tensordot(states, left, (1, 2))
    return y.reshape(-1, len(C))[: len(u)]


def _correlation(a: np.ndarray, b: np.ndarray, step: int) -> float:
    """Correlation of moves over a number of samples; zero where nothing moves."""
    moves = [x[step:] - x[:-step] for x in (a, b)]
    if min(np.ptp(m) for m in moves) == 0:
        return 0.0
    return float(np.corrcoef(moves[0], moves[1])[0, 1])
