"""0: three facts that matter for the evaluation of such models."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.adaptive.learning_curve import settling_step_size
from rotflex_jax.basis import Delays, Volterra
from seed_paper.blocks import Block, mean_and_spread
from seed_paper.records import deflection, nmse, record, voltage

TITLE = "Facts that decide how such models are evaluated"
MU1, MU2 = 0.004, 1e-4


def blocks(quick: bool, say: Callable[[str], None]) -> Iterator[Block]:
    """The parts of the table."""
    say("on line and frozen")
    yield trap(*((4000, 3) if quick else (15_000, 12)))
    say("odd plants")
    yield parity(2000 if quick else 15_000)
    yield Block(
        "Step sizes that settle at 7000 samples",
        "Mean theory for the quadratic weights under white input, at any sampling interval: ln 20 / (7000 "
        "eigenvalue).",
        ("value",),
        {
            "products of unlike lags": (settling_step_size(1, 7000),),
            "squares": (settling_step_size(2, 7000),),
        },
        relative=0.03,
    )


def trap(N: int, records: int) -> Block:
    """A-priori errors of LMS against errors of its last weights on another recording, with 1 ms sampling.

    The a-priori error of LMS is below the error of least squares, but the frozen weights of LMS predict worse
    than the mean does.
    """
    basis = Volterra(Delays(5, first=0), order=2)
    mu = basis.step_sizes({0: MU1, 1: MU1, 2: MU2})
    lms, batch = [], []
    for seed in range(records):
        (u, y), (v, z) = (record("S1", 1e-3, N, 5.0, 2 * seed + k) for k in (0, 1))
        X, Z = basis.regressors(u), basis.regressors(v)
        done = run(LMS(mu=mu), X, y)
        lms.append([nmse(y, y - done.errors), nmse(z, Z @ done.weights)])
        w = np.linalg.lstsq(X, y, rcond=None)[0]
        batch.append([nmse(y, X @ w), nmse(z, Z @ w)])
    (lms_mean, lms_spread), (batch_mean, batch_spread) = mean_and_spread(lms), mean_and_spread(batch)
    return Block(
        "Errors on line and of frozen weights",
        f"S1, 1 ms, 5 Hz, five delays, {N} samples; step sizes {MU1:g} and {MU2:g} (the reference's are "
        "unknown). NMSE of the a-priori errors, and of the last weights on another record; mean of "
        f"{records}.",
        ("on line", "frozen"),
        {"LMS": lms_mean, "least squares": batch_mean},
        {"LMS": lms_spread, "least squares": batch_spread},
        relative=0.05,
    )


def parity(N: int) -> Block:
    """Least squares on a recording of S1 together with the recording for the negative input.

    The plant is odd, so quadratic terms do not reduce the error and even coefficients are zero.
    """
    u = voltage(N, 0.1, 5.0, 0)
    y = deflection("S1", u, 0.1)
    both = (np.concatenate(pair) for pair in ((u, -u), (y, deflection("S1", -u, 0.1))))
    u, y = both
    errors, even = [], 0.0
    for order in (1, 2):
        basis = Volterra(Delays(5, first=0), order=order)
        X = np.concatenate([basis.regressors(part) for part in np.split(u, 2)])
        w = np.linalg.lstsq(X, y, rcond=None)[0]
        errors.append(nmse(y, X @ w))
        even = float(np.max(np.abs(w[basis.degrees % 2 == 0])))
    return Block(
        "Even and odd parts of symmetric friction",
        f"S1, five delays, 100 ms, {N} samples (5 Hz) with their mirror image; least squares in the sample.",
        ("value",),
        {
            "NMSE, degree 1": (errors[0],),
            "NMSE, degrees 1 and 2": (errors[1],),
            "largest even coefficient of antithetic pairs": (even,),
        },
        relative=0.05,
        absolute=1e-12,
    )
