"""Is alpha the deflection of the arm, or the angle of the arm in the room?

A spring that carries nothing but an inertia gives way in proportion to an acceleration, so a deflection
fades with the square of the frequency: `alpha / theta = w^2 / (w_n^2 - w^2)`. The angle of the arm in the
room is `theta + alpha`, and `(theta + alpha) / theta = 1 / (1 - w^2 / w_n^2)` tends to one. A deflection is
as large as theta at one frequency at most; an octave above it is far from that again.
"""

import numpy as np

BANDS = ((1, 4, 0.05), (4, 8, 0.15))
"""Slow motion: harmonics of the recording from, up to, and how far from one the slope may be there."""

ALIKE, SHARE = 0.99, 0.003
"""Least coherence in each band, least share of the hub's motion there."""


def looks_absolute(theta: np.ndarray, alpha: np.ndarray) -> bool:
    """Whether alpha follows theta one to one in slow motion, in two bands of it.

    Not an answer where there is no slow motion: a short recording, or one of a single sine, is never
    called so, since a deflection may look alike there.

    Args:
        theta: angle of the hub (N,) [rad].
        alpha: what is said to be the deflection of the arm (N,) [rad].

    >>> t = np.linspace(0, 10, 5000)
    >>> theta, swing = np.cos(t) + 0.3 * np.sin(3 * t), 0.05 * np.sin(20 * t)
    >>> looks_absolute(theta, theta + swing), looks_absolute(theta, swing)
    (True, False)
    """
    if len(theta) < 2 * BANDS[-1][1]:
        return False
    # Its low side lobes keep a strong motion in one band out of the other.
    window = np.blackman(len(theta))
    hub, arm = (np.fft.rfft(window * (x - window @ x / window.sum())) for x in (theta, alpha))
    for start, stop, far in BANDS:
        a, b = hub[start:stop], arm[start:stop]
        size, other = np.linalg.norm(a), np.linalg.norm(b)
        if size <= SHARE * np.linalg.norm(hub) or other == 0:
            return False
        together = np.vdot(a, b)
        if abs(together / size**2 - 1) > far or abs(together) < ALIKE * size * other:
            return False
    return True
