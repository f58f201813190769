"""What a sensor does to a signal: it counts in steps, and its range has ends."""

import numpy as np


def quantisation_step(x: np.ndarray) -> float | None:
    """The step of a quantised signal.

    All distinct values must lie on one lattice, to 5 % of its step, so that text rounded to a few
    digits counts too. A chance lattice among m free values has probability below 0.1^(m - 1).

    Args:
        x: the signal (N,).

    Returns:
        The step [unit of x], None where the values are on no lattice, or never repeat.

    >>> t = np.arange(1000) / 100
    >>> quantisation_step(0.25 * np.round(8 * np.sin(t) / 0.25))
    0.25
    >>> quantisation_step(np.sin(t)) is None
    True
    """
    rounding = 16 * np.finfo(x.dtype).eps * np.max(np.abs(x))
    levels = np.unique(x).astype(np.float64)
    # Equal values that arithmetic has moved apart by a rounding error are one level.
    levels = levels[np.diff(levels, prepend=-np.inf) > rounding]
    if len(levels) < 10 or len(levels) == len(x):
        return None
    gaps = np.diff(levels)
    smallest = np.median(gaps[gaps < 1.5 * gaps.min()])
    for part in range(1, 6):  # neighbouring levels may all be missing: the smallest gap is 2 or 3
        index = np.concatenate([[0.0], np.cumsum(np.round(gaps * part / smallest))])
        spread = index - index.mean()
        step = spread @ (levels - levels.mean()) / (spread @ spread)
        if step < 100 * rounding:
            break
        if np.max(np.abs(levels - levels.mean() - step * spread)) < 0.05 * step:
            return float(f"{step:.10g}")
    return None


def cut_off(x: np.ndarray, step: float | None, u: np.ndarray, Ts: float) -> tuple[float, int] | None:
    """The end of a sensor's range, where the signal shows that it wanted to go on.

    A joint may rest exactly at the end of its motion, so that many equal samples prove nothing.
    What proves it is a signal that arrives and leaves without slowing down, or one that stays
    while the input drives it, both ways, as hard as anywhere.

    Args:
        x: signal (N,).
        step: its quantisation step, None if there is none [unit of x].
        u: input (N,).
        Ts: sampling period [s].

    Returns:
        The end [unit of x] and the number of samples there, None where nothing is cut off.

    >>> wave = np.sin(np.arange(2000) / 50)
    >>> cut_off(wave, None, wave, 0.002)
    >>> cut_off(np.minimum(wave, 0.7), None, wave, 0.002)
    (0.7, 553)
    """
    for end, z in ((x.max(), x.max() - x), (x.min(), x - x.min())):
        there = z <= 1e-6 * (step or 0.0)
        count = int(np.sum(there))
        if count >= 10 and (_passes_straight(z, there, step or 0.0) or _is_driven(there, u, Ts)):
            return float(end), count
    return None


def _passes_straight(z: np.ndarray, there: np.ndarray, step: float) -> bool:
    """Whether the signal arrives at an end and leaves it without slowing down.

    What stops or turns follows a parabola: over the last distance D it needs twice the time that it
    needs over the last D / 4; what is cut off goes straight on, and needs four times. The ratio of
    these times, over all visits together, must be above 2.5 for arriving and for leaving.
    """
    far = max(40 * step, 0.1 * z.max())
    visits = 0
    near_times = far_times = np.zeros(2)
    while far <= 0.5 * z.max():  # a motion of a few steps tells nothing
        visits, near_times, far_times = _passing_times(z, there, step, far)
        if np.sum(far_times) >= 12 * visits:
            break
        far *= 2  # so few samples on the way that a half at each end counts
    return visits >= 2 and bool(np.all(far_times > 2.5 * near_times))


def _passing_times(
    z: np.ndarray, there: np.ndarray, step: float, far: float
) -> tuple[int, np.ndarray, np.ndarray]:
    """The visits to an end, and the samples from `far / 4` and from `far`, arriving and leaving."""
    edges = np.flatnonzero(np.diff(z < far / 4, prepend=False, append=False))
    beyond = np.concatenate([[-np.inf], np.flatnonzero(z >= far), [np.inf]])
    visits, near_times, far_times = set(), np.zeros(2), np.zeros(2)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_end = start + np.flatnonzero(there[start:stop])
        if len(at_end) < 2:
            continue
        first, last = at_end[0], at_end[-1]
        nearest = np.searchsorted(beyond, first)
        # The end is reached half a sample before the first there, and left half a sample late.
        arriving = first - start + 0.5, first - beyond[nearest - 1] - 0.5
        leaving = stop - last - 0.5, beyond[nearest] - last - 0.5
        for side, (near, full) in enumerate((arriving, leaving)):
            # Beyond six it has paused on the way, or not come from afar at all: says nothing.
            # In its time at the end it must have had more to go than a turning point can hide.
            if full < 6 * near and len(at_end) * far / 4 / near > 3 * np.sqrt(step * far):
                visits.add(start)
                near_times[side] += near
                far_times[side] += full
    return len(visits), near_times, far_times


def _is_driven(there: np.ndarray, u: np.ndarray, Ts: float) -> bool:
    """Whether the input is at its strongest, both ways, in the longest stay at an end."""
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    stay = np.argmax(edges[1::2] - edges[::2])
    start, stop = edges[2 * stay], edges[2 * stay + 1]
    width = min(len(u), max(1, round(0.1 / Ts)))
    lasting = np.convolve(u, np.full(width, 1 / width), mode="same")
    during = lasting[start:stop]
    return bool(
        stop - start >= 20
        and during.max() >= 0.8 * lasting.max() > 0
        and during.min() <= 0.8 * lasting.min() < 0
    )
