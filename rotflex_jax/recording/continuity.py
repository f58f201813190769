"""Samples that do not continue the signal: wrapped angles, outliers, frozen sensors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

MOST_OUTLIERS = 10
"""Largest number of places with outliers; a signal with more such places is taken to move like that."""

LONGEST_OUTLIER = 20
"""Largest number of samples at one such place."""

FAR_OUT = 8.0
"""Least size of the jump to an outlier, in largest usual motions from one sample to the next."""

JUMP_FROM_REST = 3.0
"""Least size of the jump after a frozen stretch, in the same unit: real motion from rest starts slowly."""

SHORTEST_STILL, SHORTEST_STILL_SECONDS = 20, 0.05
"""Least length of a frozen stretch in samples and in seconds, both of which must be met."""

SHORTEST_HELD, SHORTEST_HELD_SECONDS = 50, 0.2
"""The same for a speed that is held at one value."""

NEAR_REST = 0.1
"""Share of the largest speed up to which the reading of a tacho may be rest."""


def motion(x: Float[np.ndarray, " N"]) -> float:
    """Largest motion of a signal from one sample to the next, without the steps of `MOST_OUTLIERS` outliers.

    >>> x = np.arange(100.0)
    >>> x[50] = -9999
    >>> motion(x)
    1.0
    """
    steps = np.sort(np.abs(np.diff(x)))
    return float(steps[-1 - 2 * MOST_OUTLIERS]) if len(steps) > 2 * MOST_OUTLIERS else 0.0


def wraps(x: Float[np.ndarray, " N"], turn: float) -> Int[np.ndarray, " W"]:
    """The samples after which an angle jumps by a whole turn, up to the motion of the samples around.

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
    # A signal that often moves by a large part of a turn, such as noise, jumps by a whole turn by chance.
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
    """An angle without the jumps by a whole turn after these samples, to check it for other faults.

    >>> unwrapped(np.array([3.0, -3.0]), np.array([0]), 6.25)
    array([3.  , 3.25])
    """
    turns = np.zeros(len(x))
    turns[behind + 1] = np.sign(x[behind + 1] - x[behind])
    return x - turn * np.cumsum(turns)


def outliers(x: Float[np.ndarray, " N"], least: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Which samples are outliers: out of line with their neighbours on both sides.

    The signal jumps to them by more than `FAR_OUT` times its usual motion, and a few samples later jumps back
    to where it would be without them.

    Args:
        x: signal.
        least: size up to which a jump counts as motion, for instance of a machine mostly at rest [unit of x].

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
    """A signal with straight lines in place of some samples, to check it for other faults.

    >>> without(np.array([1.0, 50.0, 2.0]), np.array([False, True, False]))
    array([1. , 1.5, 2. ])
    """
    if not out.any():
        return x
    k = np.arange(len(x))
    return np.interp(k, k[~out], x[~out])


class Still(NamedTuple):
    """A frozen stretch, in which nothing was measured.

    Attributes:
        first: First sample of the stretch.
        last: Last sample of the stretch.
        channel: Column with the largest jump after the stretch, relative to its usual motion.
        jump: Size of this jump.
        alone: Whether other channels move during the stretch.
    """

    first: int
    last: int
    channel: int
    jump: float
    alone: bool


def frozen(u: Float[np.ndarray, " N"], y: Float[np.ndarray, "N C"], Ts: float) -> Still | None:
    """The first stretch in which sensors are frozen although the machine moved.

    A machine that is held by friction stands still too, but starts slowly. A frozen sensor or log shows by a
    jump at the end of the stretch, to where the machine has moved in the meantime, while the input varied as
    it does during motion. If one channel alone is constant, it must also jump at the beginning of the
    stretch, as a lost sensor jumps to zero.

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


def held_speed(x: Float[np.ndarray, " N"], step: float | None, Ts: float) -> tuple[int, int] | None:
    """The first stretch in which a speed is held at one value, by a sensor that is stuck or at its limit.

    A machine comes to a constant speed gradually, and to rest at once. So the value must be far from zero,
    and the last samples before it must differ by far more than the resolution.

    Args:
        x: speed.
        step: quantisation step of the speed, None if there is none.
        Ts: sampling period [s].

    Returns:
        First and last sample of the stretch; None if there is none.

    >>> x = 5 * np.sin(np.arange(2000) / 100)
    >>> held_speed(np.minimum(x, 4.0), None, 0.002), held_speed(x, None, 0.002)
    ((93, 221), None)
    """
    steps = np.abs(np.diff(x))
    least = max(SHORTEST_HELD, round(SHORTEST_HELD_SECONDS / Ts))
    rounding = max(10 * (step or 0.0), 1e-4 * float(np.ptp(x)))
    for first, last in _constant(steps > 0, least):
        before = steps[max(0, first - SHORTEST_STILL) : first]
        moved = len(before) == SHORTEST_STILL and np.median(before) > rounding
        if moved and abs(x[first]) > NEAR_REST * np.max(np.abs(x)):
            return first, last
    return None


def _constant(moves: Bool[np.ndarray, " M"], least: int) -> list[tuple[int, int]]:
    """First and last samples of stretches without motion that have at least `least` samples."""
    edges = np.flatnonzero(np.diff(~moves, prepend=False, append=False))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(first, last) for first, last in pairs if last - first + 1 >= least]


def _driven(u: Float[np.ndarray, " N"], moves: Bool[np.ndarray, " M"], first: int, last: int) -> bool:
    """Whether the input varies in this stretch as it mostly does in motion, over `SHORTEST_STILL` samples."""
    starts = np.arange(0, len(u) - SHORTEST_STILL + 1, SHORTEST_STILL // 2)
    span = np.ptp(np.lib.stride_tricks.sliding_window_view(u, SHORTEST_STILL)[starts], axis=1)
    moving = np.array([np.any(moves[k : k + SHORTEST_STILL - 1]) for k in starts])
    here = u[first : last + 1]
    most = np.max(np.ptp(np.lib.stride_tricks.sliding_window_view(here, SHORTEST_STILL), axis=1))
    return bool(moving.any() and most > 0 and most >= np.quantile(span[moving], 0.1))
