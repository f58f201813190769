"""A better input by climbing: every sample of one period, along the slope through both simulations."""

import dataclasses
from collections.abc import Callable

import numpy as np

from rotflex_jax.experiment.contest import Contest, Meeting

Progress = Callable[[str], None]

# Periods that are simulated while climbing: one from rest, the others settled.
REHEARSED = 2
# What a peak beyond its limit costs: nothing within, smoothly more up to this excess (logarithm), then this
# many times its logarithm. Making an input smaller costs at most its square, so a weight above two pays.
SOFT, WEIGHT = 0.04, 5.0
# Evaluations of a climb; strides in units of the voltage limit (root mean square): the first, the last, the
# longest; share of the last direction that is kept.
LOOKS, FIRST, LAST, LONGEST, KEPT = 60, 0.3, 2e-3, 20.0, 0.5
# Evaluations between those that start the imitations from all shapes.
THOROUGH = 20


@dataclasses.dataclass(frozen=True)
class View:
    """One period as the climb sees it.

    Attributes:
        value: Logarithm of the mean evidence, less what peaks beyond their limits cost.
        slope: Along each sample of the period, per voltage limit (P,).
        meeting: Both machines under it.
    """

    value: float
    slope: np.ndarray
    meeting: Meeting


@dataclasses.dataclass(frozen=True)
class Climb:
    """What is climbed.

    Attributes:
        contest: Hypotheses and limits.
        tighter: Factor (C,) by which doubtful numbers raise the peaks.
    """

    contest: Contest
    tighter: np.ndarray

    def played(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The voltage (N,) [V] for a period in units of the limit, and where its samples come from.

        The period's mean is taken off: a constant torque would carry the machine away.
        """
        c = self.contest
        return c.limits.routed(np.tile(c.limits.voltage * (x - x.mean()), REHEARSED), c.Ts)

    def look(self, x: np.ndarray, last: Meeting | None, thorough: bool = False) -> View:
        """Value and slope."""
        c = self.contest
        u, low, high = self.played(x)
        m = c.meet(u, last, thorough)
        over = np.log(np.maximum(c.excess(m.outputs) * self.tighter, 1e-12))
        inside = np.clip(over, 0.0, SOFT)
        cost = WEIGHT * (inside**2 / (2 * SOFT) + np.maximum(over - SOFT, 0.0))
        g = c.slope(u, m, WEIGHT * inside / SOFT)
        # A clipped sample does not follow; the others share the slope of what follows them.
        back = (np.bincount(low, g, len(u)) + np.bincount(high, g, len(u))) / 2
        period = c.limits.voltage * back.reshape(REHEARSED, -1).sum(axis=0)
        return View(np.log(m.mean) - float(np.sum(cost)), period - period.mean(), m)


def improved(
    contest: Contest, period: np.ndarray, looks: int = LOOKS, progress: Progress | None = None
) -> np.ndarray:
    """One period (P,) [V] that tells the two apart better, from a start.

    Slopes with momentum, clipped to the limit; a stride that gains is lengthened, one that does not is cut.
    Evidence grows with the square of an input, so the best ones lie at the limits, where a method that
    expects a smooth bowl would crawl.

    Args:
        contest: Hypotheses and limits.
        period: Where to begin [V].
        looks: Evaluations at most.
        progress: Called with a line of text now and then.
    """
    say = progress or (lambda _: None)
    x = np.clip((period - period.mean()) / contest.limits.voltage, -1.0, 1.0)
    plain = Climb(contest, np.ones(1))
    u = plain.played(x)[0]
    nominal = np.max(np.abs(contest.meet(u).outputs), axis=(0, 1))
    climb = Climb(contest, np.maximum(contest.peaks(u) / np.maximum(nominal, 1e-300), 1.0))
    now = climb.look(x, None, thorough=True)
    way, stride = now.slope, FIRST
    for k in range(1, looks):
        size = np.sqrt(np.mean(way**2))
        if stride < LAST or not size > 0:
            break
        trial = np.clip(x + stride * way / size, -1.0, 1.0)
        new = climb.look(trial, now.meeting, thorough=k % THOROUGH == 0)
        if new.value > now.value:
            x, now, stride = trial, new, min(1.6 * stride, LONGEST)
            turn = np.linalg.norm(now.slope) / max(float(np.linalg.norm(way)), 1e-300)
            way = KEPT * turn * way + now.slope
        else:
            stride /= 4
        if k % 10 == 0:
            say(f"  {k} of {looks} evaluations, {now.meeting.nats:.3g} nats in {REHEARSED} periods")
    return contest.limits.voltage * (x - x.mean())
