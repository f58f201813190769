"""A small run on the side: what the online error of an adaptive filter hides."""

import dataclasses

import numpy as np

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.fit import least_squares
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.reproduce import signals
from rotflex_jax.reproduce.machine import symmetric_twin
from rotflex_jax.reproduce.models import nmse
from rotflex_jax.reproduce.plants import response
from rotflex_jax.reproduce.settings import Settings

STEP_SIZES = {0: 1e-2, 1: 1e-2, 2: 2e-4}
"""By degree: about those of the experiment itself."""


@dataclasses.dataclass(frozen=True)
class Trap:
    """Three errors of one model class, relative to the variance of the output.

    Attributes:
        Ts: Sampling interval [s].
        online: A-priori errors of LMS over the last half of its run.
        frozen: Its last weights on data they have not seen.
        least_squares: Least squares on the same data.
    """

    Ts: float
    online: float
    frozen: float
    least_squares: float


def online_trap(s: Settings, Ts: float = 1e-3, N: int = 15000) -> Trap:
    """Online, frozen and least-squares error where the memory is far too short.

    Args:
        s: Settings of the machine, the input and the memory.
        Ts: Sampling interval instead of theirs [s].
        N: Samples to learn from, and as many to judge on.
    """
    fast = dataclasses.replace(s, Ts=Ts, filter="ar1")
    u = signals.filtered_noise(fast, 2 * N, np.random.default_rng(s.seed))
    y = response(symmetric_twin(fast), u, Ts, step=s.step)[:, 1]
    whole = Recording(u=u, y=y, Ts=Ts, channels="alpha", accept=ACCEPTABLE)
    train, test = whole.slice(0, N), whole.slice(N, 2 * N)
    basis = Volterra(Delays(s.memory))
    lms = run(LMS(mu=basis.step_sizes(STEP_SIZES)), basis.regressors(train.u), train.y[:, 0])
    fitted = least_squares(basis, [train], "alpha").model
    frozen = basis.regressors(test.u) @ lms.weights
    half, skip = N // 2, s.memory
    seen = test.y[skip:, 0]
    return Trap(
        Ts,
        nmse([train.y[half:, 0]], [train.y[half:, 0] - lms.errors[half:]]),
        nmse([seen], [frozen[skip:]]),
        nmse([seen], [fitted.simulate(test)[skip:, 0]]),
    )
