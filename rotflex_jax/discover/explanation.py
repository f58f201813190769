"""What a report needs beyond the search: missing torques, a learned torque, remaining failures."""

import dataclasses

import numpy as np

from rotflex_jax.discover.latent_comparison import LatentTorqueComparison
from rotflex_jax.discover.learned_torque import LearnedTorqueResult
from rotflex_jax.discover.localise import locate
from rotflex_jax.discover.model_tests import ModelTests
from rotflex_jax.discover.result import SearchResult, Where
from rotflex_jax.discover.verdict import Verdict


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Everything that is computed for a report; writing it only formats and draws.

    Attributes:
        latent: Torques that the baseline and the final model lack; None where they were not computed.
        learned: A torque learned for what is left; None where none was asked for or none can be learned.
        remaining: Where the final model still fails; empty unless effects were found and something is left.
        tests: Tests of the residuals, and frequency responses; None where they were not computed.
    """

    latent: LatentTorqueComparison | None = None
    learned: LearnedTorqueResult | None = None
    remaining: tuple[Where, ...] = ()
    tests: ModelTests | None = None


def remaining_failures(found: SearchResult) -> tuple[Where, ...]:
    """Where the final model fails on the longest held-out recording, if something is left unexplained."""
    if found.verdict != Verdict.UNEXPLAINED or not found.rounds:
        return ()
    i = max(range(len(found.validation)), key=lambda k: found.validation[k].N)
    recording, final = found.validation[i], found.final
    mechanism = final.model.mechanism
    return locate(
        recording,
        np.asarray(found.baseline.model.measured(recording), float) - np.asarray(final.windowed[i], float),
        mechanism.channels,
        found.noise_floor,
        mechanism,
        window_seconds=final.window_seconds,
    )
