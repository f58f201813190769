"""Each limit of the rule that ends a search, from both sides; the limits are written out here."""

from types import SimpleNamespace
from typing import Any

import pytest

from rotflex_jax.discover.conclusion import end_state
from rotflex_jax.discover.verdict import Verdict

SAMPLES = 1000  # of each of the two channels
NEAR = 1.5  # times the noise of the sensor


def ended(
    *,
    ratio: float = 1.0,
    noise_nats: float = 0.0,
    rounds: tuple[tuple[str, ...], ...] = (),
    excited: int = 4,
    candidates: int = 4,
) -> Verdict:
    """The verdict of a search that ended so near to the noise, with these equivalents of each round."""
    floor = {"theta": 5e-4, "alpha": 2e-3}
    errors = {"theta": 5e-4, "alpha": 2e-3 * ratio}
    baseline: Any = SimpleNamespace(held_out_rmse_windows={"theta": 5e-2, "alpha": 2e-1})
    final: Any = SimpleNamespace(
        held_out_rmse_windows=errors, process_noise_nats=noise_nats, window_seconds=2.0
    )
    found: Any = [SimpleNamespace(effect="coulomb", port="hub", equivalent=others) for others in rounds]
    ranking: Any = [SimpleNamespace(excited=k < excited) for k in range(candidates)]
    recordings: Any = [SimpleNamespace(N=SAMPLES // 2)] * 2
    return end_state(baseline, found, final, floor, ranking, recordings)[0]


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize("rounds", [(), ((),)])
def test_explained_is_near_the_noise_of_every_sensor(share: float, explained: bool, rounds: Any) -> None:
    verdict = ended(ratio=NEAR * share, rounds=rounds)
    good = Verdict.FOUND if rounds else Verdict.NOTHING_MISSING
    assert verdict == (good if explained else Verdict.UNEXPLAINED)


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
def test_explained_leaves_little_to_process_noise(share: float, explained: bool) -> None:
    # 0.07 nat for each measured value, those of both channels.
    verdict = ended(noise_nats=0.07 * 2 * SAMPLES * share)
    assert verdict == (Verdict.NOTHING_MISSING if explained else Verdict.UNEXPLAINED)


def test_one_round_that_others_equal_makes_the_end_ambiguous() -> None:
    assert ended(rounds=((), ("stribeck",))) == Verdict.AMBIGUOUS
    assert ended(rounds=((), ())) == Verdict.FOUND


def test_more_than_half_of_the_candidates_must_have_shown() -> None:
    assert ended(excited=2, candidates=4) == Verdict.NOTHING_MISSING
    assert ended(excited=1, candidates=4) == Verdict.NOT_EXCITED
    assert ended(excited=2, candidates=5) == Verdict.NOT_EXCITED
    assert ended(excited=0, candidates=0) == Verdict.NOTHING_MISSING
