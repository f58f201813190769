"""The end state in one word and one sentence."""

from collections.abc import Sequence

from rotflex_jax.discover.result import Round, Stage
from rotflex_jax.discover.score import Score
from rotflex_jax.recording import Recording

# The model explains the record if short held-out runs come this near to the sensor noise and process
# torques gain no more than this per measured number [nat].
NEAR_FLOOR, NATS_PER_NUMBER = 1.5, 0.07


def judge_end(
    rounds: Sequence[Round],
    final: Stage,
    floor: dict[str, float],
    ranking: Sequence[Score],
    test: Sequence[Recording],
) -> tuple[str, str]:
    """Verdict and sentence.

    Args:
        rounds: What was added.
        final: Stage after the last round.
        floor: Deviation of the sensor noise per channel.
        ranking: Scores of the baseline.
        test: Held-out recordings.
    """
    ratios = {c: final.held_out_rmse_windows[c] / floor[c] for c in floor}
    numbers = sum(r.N for r in test) * len(floor)
    near = all(ratio < NEAR_FLOOR for ratio in ratios.values())
    explained = near and final.process_noise_nats < NATS_PER_NUMBER * numbers
    seconds = final.window_seconds
    left = ", ".join(f"{c} {_times(r)}" for c, r in ratios.items())
    reached = f"the held-out error over {seconds:g} s is {left} times the sensor noise"
    names = " and ".join(f"{r.effect.replace('_', ' ')} at the {r.port}" for r in rounds)
    explain, others = "explain", "some of them from others (listed with each)"
    if len(rounds) == 1:
        explain, others = "explains", "this from others (listed with it)"
    visible = [s for s in ranking if s.excited]
    unseen = len(ranking) - len(visible)
    if not explained:
        found = f"{names} found, but something" if rounds else "Something"
        return "unexplained", f"{found} remains that no candidate explains: {reached}."
    if any(r.equivalent for r in rounds):
        return "ambiguous", (f"{names} {explain} the recording, but it cannot tell {others}: {reached}.")
    if rounds:
        return "found", f"{names} {explain} the recording: {reached}."
    if ranking and unseen > len(ranking) / 2:
        return "not_excited", (
            f"Nothing was found, but {unseen} of {len(ranking)} candidates could not have shown in this "
            f"recording: move the machine more, over more speeds and voltages."
        )
    hidden = f"; {unseen} of {len(ranking)} candidates could not have shown" if unseen else ""
    return "nothing_missing", f"Nothing is missing: {reached}{hidden}."


def _times(ratio: float) -> str:
    """A ratio in two decimals, or where those mean nothing, in three digits."""
    return f"{ratio:.2f}" if ratio < 100 else f"{ratio:.3g}"
