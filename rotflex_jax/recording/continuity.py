"""Samples that do not continue the signal: wrapped angles, outliers, sensors that stand still."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

MOST_OUTLIERS = 10
"""Places at which a signal may be out of line; where there are more, it moves so."""

LONGEST_OUTLIER = 20
"""Samples that one place may have."""

FAR_OUT = 8.0
"""How many times the motion of a sample a jump is that is out of line."""

JUMP_FROM_REST = 3.0
"""The same for the jump that ends a stretch in which nothing was measured: what is at rest starts slowly."""

SHORTEST_STILL, SHORTEST_STILL_SECONDS = 20, 0.05
"""Least length of such a stretch, both in samples and in seconds."""


def motion(x: Float[np.ndarray, " N"]) -> float:
    """How far a signal moves from one sample to the next at most, up to `MOST_OUTLIERS` outliers aside.

    >>> x = np.arange(100.0)
    >>> x[50] = -9999
    >>> motion(x)
    1.0
    """
    steps = np.sort(np.abs(np.diff(x)))
    return float(steps[-1 - 2 * MOST_OUTLIERS]) if len(steps) > 2 * MOST_OUTLIERS else 0.0


def wraps(x: Float[np.ndarray, " N"], turn: float) -> Int[np.ndarray, " W"]:
    """The samples behind which an angle jumps by a whole turn, within the motion of the samples around.

    Args:
        x: angle.
        turn: a whole turn [unit of x].

    >>> angle = np.linspace(0, 10, 200)
    >>> wraps((angle + np.pi) % (2 * np.pi) - np.pi, 2 * np.pi)
    array([ 62, 187])
    """
    steps = np.diff(x)
    size = np.abs(steps)
    jumps = np.flatnonzero((size > 0.5 * turn) & (size < 1.5 * turn))
    # What moves by a good part of a turn from sample to sample, as noise may, jumps by a whole one by chance.
    between = int(np.sum((size > 0.25 * turn) & (size < 0.75 * turn)))
    if len(jumps) > len(x) // 10 or between > min(2 * MOST_OUTLIERS, len(x) // 10):
        return jumps[:0]
    found = []
    for k in jumps:
        around = size[max(0, k - 10) : k + 11]
        usual = float(np.max(around[around <= 0.5 * turn], initial=0.0))
        if usual < 0.25 * turn and abs(size[k] - turn) <= max(2 * usual, 0.01 * turn):
            found.append(k)
    return np.asarray(found, dtype=int)


def unwrapped(
    x: Float[np.ndarray, " N"], behind: Int[np.ndarray, " W"], turn: float
) -> Float[np.ndarray, " N"]:
    """An angle without the jumps by a whole turn behind these samples, to check it for other faults.

    >>> unwrapped(np.array([3.0, -3.0]), np.array([0]), 6.25)
    array([3.  , 3.25])
    """
    turns = np.zeros(len(x))
    turns[behind + 1] = np.sign(x[behind + 1] - x[behind])
    return x - turn * np.cumsum(turns)


def outliers(x: Float[np.ndarray, " N"], least: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Which samples are out of line with their neighbours on both sides.

    They jump by `FAR_OUT` times what the signal moves otherwise, and a few samples later back to where it
    has gone on.

    Args:
        x: signal.
        least: jumps up to this size are motion, of a machine that mostly rests for instance [unit of x].

    >>> x = np.sin(np.arange(200) / 20)
    >>> x[120:123] = -9999
    >>> np.flatnonzero(outliers(x))
    array([120, 121, 122])
    """
    out = np.zeros(len(x), dtype=bool)
    usual = motion(x)
    steps = np.abs(np.diff(x))
    jumps = np.flatnonzero(steps > max(FAR_OUT * usual, least))
    if usual == 0 or len(jumps) > 2 * MOST_OUTLIERS:
        return out
    last = -1
    for first in jumps:
        for end in jumps[(jumps > first) & (jumps <= first + LONGEST_OUTLIER)]:
            count = end - first
            height = np.max(np.abs(x[first + 1 : end + 1] - x[first]))
            back = abs(x[end + 1] - x[first]) <= (count + 1) * usual
            if first >= last and back and min(steps[first], steps[end]) >= 0.5 * height:
                out[first + 1 : end + 1] = True
                last = end
                break
    return out


def without(x: Float[np.ndarray, " N"], out: Bool[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """A signal with lines in the place of some samples, to check it for other faults.

    >>> without(np.array([1.0, 50.0, 2.0]), np.array([False, True, False]))
    array([1. , 1.5, 2. ])
    """
    if not out.any():
        return x
    k = np.arange(len(x))
    return np.interp(k, k[~out], x[~out])


class Still(NamedTuple):
    """A stretch in which nothing was measured.

    Attributes:
        first: First sample of it.
        last: Last sample of it.
        channel: Column that jumps most behind it, measured by how it moves otherwise.
        jump: How far.
        alone: Whether the other channels move meanwhile.
    """

    first: int
    last: int
    channel: int
    jump: float
    alone: bool


def frozen(u: Float[np.ndarray, " N"], y: Float[np.ndarray, "N C"], Ts: float) -> Still | None:
    """The first stretch in which sensors stand still though the machine moved.

    A machine that is held by friction stands still too, and starts slowly. What tells a sensor or a log that
    stands still is a jump at the end, to where the machine has gone meanwhile, while the input has varied as
    it does where the machine moves. One channel alone must jump to its value too, as to the zeros of a
    sensor that was lost.

    Args:
        u: input.
        y: outputs.
        Ts: sampling period [s].

    >>> t = np.arange(2000) / 500
    >>> u, y = np.cos(9 * t), np.sin(5 * t)[:, None]
    >>> frozen(u, y, 0.002)
    >>> y[800:1000] = y[800]
    >>> found = frozen(u, y, 0.002)
    >>> found.first, found.last
    (800, 999)
    """
    usual = np.array([motion(x) for x in y.T])
    if not np.any(usual > 0):
        return None
    scale = np.where(usual > 0, usual, np.inf)
    steps = np.abs(np.diff(y, axis=0))
    least = max(SHORTEST_STILL, round(SHORTEST_STILL_SECONDS / Ts))
    moves = np.any(steps > 0, axis=1)
    found = []
    for first, last in _constant(moves, least):
        far = steps[last] / scale if last < len(steps) else np.zeros(1)
        if first > 0 and np.max(far) > JUMP_FROM_REST and _driven(u, moves, first, last):
            c = int(np.argmax(far))
            found.append(Still(first, last, c, float(steps[last, c]), False))
    for c in range(y.shape[1] if y.shape[1] > 1 else 0):
        for first, last in _constant(steps[:, c] > 0, least):
            inside = first > 0 and last < len(steps) and np.any(moves[first:last])
            if inside and min(steps[first - 1, c], steps[last, c]) > FAR_OUT * scale[c]:
                found.append(Still(first, last, c, float(steps[last, c]), True))
    return min(found, default=None)


def _constant(moves: Bool[np.ndarray, " M"], least: int) -> list[tuple[int, int]]:
    """First and last samples of stretches without a step, of at least so many samples."""
    edges = np.flatnonzero(np.diff(~moves, prepend=False, append=False))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(first, last) for first, last in pairs if last - first + 1 >= least]


def _driven(u: Float[np.ndarray, " N"], moves: Bool[np.ndarray, " M"], first: int, last: int) -> bool:
    """Whether the input varies there, over `SHORTEST_STILL` samples, as it mostly does in motion."""
    starts = np.arange(0, len(u) - SHORTEST_STILL + 1, SHORTEST_STILL // 2)
    span = np.ptp(np.lib.stride_tricks.sliding_window_view(u, SHORTEST_STILL)[starts], axis=1)
    moving = np.array([np.any(moves[k : k + SHORTEST_STILL - 1]) for k in starts])
    here = u[first : last + 1]
    most = np.max(np.ptp(np.lib.stride_tricks.sliding_window_view(here, SHORTEST_STILL), axis=1))
    return bool(moving.any() and most > 0 and most >= np.quantile(span[moving], 0.1))
