"""The next experiment for a result in which two effects look alike."""

import dataclasses
from typing import Any, TypeVar

import numpy as np

from rotflex_jax.discover.result import SearchResult
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import Experiment, Limits, next_experiment
from rotflex_jax.recording import Recording

Found = TypeVar("Found", bound=SearchResult)

# Length of a proposal, and of the recording to which the rival is fitted [s]; a ranking needs no more.
PROPOSAL_SECONDS = 10.0


def with_proposal(found: Found) -> Found:
    """The result with the standard input that best distinguishes the first two that look alike, if any."""
    if found.verdict != Verdict.AMBIGUOUS:
        return found
    try:
        return dataclasses.replace(found, proposal=proposed(found, seconds=PROPOSAL_SECONDS, improve=False))
    except InputError as error:  # no reason to lose what was found
        return dataclasses.replace(found, notes=(*found.notes, f"No next experiment is proposed: {error}"))


def proposed(found: SearchResult, **changes: Any) -> Experiment | None:
    """The next experiment for the first effect of a result that has an equal.

    Args:
        found: What a search found.
        changes: Arguments of `next_experiment` to use instead of those of the recordings.
    """
    pairs = [((r.effect, r.port), r.equivalent[0]) for r in found.rounds if r.equivalent]
    if not pairs:
        return None
    recordings = (*found.train, *found.validation)
    longest = max(recordings, key=lambda r: r.N)
    first, second = pairs[0]
    settings: dict[str, Any] = {
        "limits": seen_limits(recordings),
        "Ts": longest.Ts,
        "noise": found.noise_floor,
        "process_noise": found.final.process_noise,
        "reference": longest.u[: round(PROPOSAL_SECONDS / longest.Ts)],
    }
    return next_experiment(found.model, first, second, **(settings | changes))


def seen_limits(recordings: tuple[Recording, ...]) -> Limits:
    """What the machine has borne already: largest voltage, slew and deflection of the recordings."""
    r = max(recordings, key=lambda r: float(np.max(np.abs(r.u))))
    slew = max(float(np.max(np.abs(np.diff(r.u)))) / r.Ts for r in recordings)
    deflection = max(float(np.max(np.abs(r.y[:, -1]))) for r in recordings)
    single = len(r.channels) < 2
    return Limits(
        voltage=float(np.max(np.abs(r.u))),
        slew=slew,
        deflection=np.inf if single else deflection,
        margin=0.0,
    )
