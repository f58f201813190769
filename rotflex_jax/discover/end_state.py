"""The rule that decides how a search ended: the verdict, and what it says of this recording."""

from collections.abc import Sequence

from rotflex_jax.discover.result import NEAR_FLOOR, Round, Stage
from rotflex_jax.discover.score_test import Score
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.recording import Recording

# The model explains the recordings if process torques gain no more than this per measured value [nat],
# and short held-out runs come as near to the sensor noise as `NEAR_FLOOR` says.
NATS_PER_SAMPLE = 0.07


def end_state(
    rounds: Sequence[Round],
    final: Stage,
    floor: dict[str, float],
    ranking: Sequence[Score],
    test: Sequence[Recording],
) -> tuple[Verdict, str]:
    """The verdict, and a sentence that gives its reason.

    Args:
        rounds: What was added.
        final: Stage after the last round.
        floor: Standard deviation of the sensor noise per channel.
        ranking: Scores of the baseline.
        test: Held-out recordings.
    """
    ratios = {c: final.held_out_rmse_windows[c] / floor[c] for c in floor}
    samples = sum(r.N for r in test) * len(floor)
    near = all(ratio < NEAR_FLOOR for ratio in ratios.values())
    explained = near and final.process_noise_nats < NATS_PER_SAMPLE * samples
    seconds = final.window_seconds
    left = ", ".join(f"{c} {_times(r)}" for c, r in ratios.items())
    reached = f"the held-out error over {seconds:g} s is {left} times the sensor noise"
    names = " and ".join(f"{r.effect.replace('_', ' ')} at the {r.port}" for r in rounds)
    explain, others = "explain", "some of them from others (listed with each)"
    if len(rounds) == 1:
        explain, others = "explains", "this from others (listed with it)"
    visible = [s for s in ranking if s.excited]
    invisible = len(ranking) - len(visible)
    if not explained:
        found = f"{names} found, but something" if rounds else "Something"
        return Verdict.UNEXPLAINED, f"{found} remains that no candidate explains: {reached}."
    if any(r.equivalent for r in rounds):
        return Verdict.AMBIGUOUS, (
            f"{names} {explain} the recording, but it cannot distinguish {others}: {reached}."
        )
    if rounds:
        return Verdict.FOUND, f"{names} {explain} the recording: {reached}."
    if ranking and invisible > len(ranking) / 2:
        return Verdict.NOT_EXCITED, (
            f"Nothing was found, but {invisible} of {len(ranking)} candidates could not have shown in this "
            f"recording: move the machine more, over more speeds and voltages."
        )
    hidden = f"; {invisible} of {len(ranking)} candidates could not have shown" if invisible else ""
    return Verdict.NOTHING_MISSING, f"Nothing is missing: {reached}{hidden}."


def _times(ratio: float) -> str:
    """A ratio in two decimals, or where those mean nothing, in three digits."""
    return f"{ratio:.2f}" if ratio < 100 else f"{ratio:.3g}"
