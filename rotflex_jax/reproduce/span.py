"""What a model with memory M can reach at best, before any recording is made."""

import numpy as np

from rotflex_jax.basis import Delays
from rotflex_jax.basis.reach import ar1, minimum_nmse
from rotflex_jax.mechanism import Mechanism, linearise
from rotflex_jax.reproduce.settings import Settings


def impulse_response(joint: Mechanism, Ts: float, seconds: float = 1.2) -> np.ndarray:
    """Deflection [rad] after 1 V held over one sample, of the linear part of a joint.

    >>> from rotflex_jax.joints import paper
    >>> impulse_response(paper(), 0.1)[:3].round(6)
    array([ 0.      , -0.067914,  0.064805])
    """
    space = linearise(joint)
    A, x = space.discretise(Ts)
    row = space.C[joint.channels.index("alpha")]
    h = np.zeros(max(8, int(np.ceil(seconds / Ts))))
    for k in range(1, len(h)):
        h[k] = row @ x
        x = A @ x
    return h


def reach(s: Settings, joint: Mechanism, intervals: np.ndarray, *, white: bool = False) -> np.ndarray:
    """Least NMSE at several sampling intervals [s], for noise below the cutoff or white."""
    responses = [impulse_response(joint, float(Ts)) for Ts in intervals]
    length = max(map(len, responses))  # one for all, so that one thing is compiled
    found = []
    for Ts, h in zip(intervals, responses, strict=True):
        a = 0.0 if white else float(np.exp(-2 * np.pi * s.cutoff * Ts))
        h = np.concatenate([h, np.zeros(length - len(h))])
        found.append(minimum_nmse(Delays(s.memory), h, ar1(a, length)))
    return np.array(found)
