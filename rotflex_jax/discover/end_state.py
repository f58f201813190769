"""The rule that decides how a search ended: the verdict, and what it says of this recording."""

from collections.abc import Sequence

from rotflex_jax.discover.assessment import Assessment, assess, in_noise
from rotflex_jax.discover.result import Round, Stage
from rotflex_jax.discover.score_test import Score
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects.labels import effect_phrase
from rotflex_jax.recording import Recording


def assess_stages(
    baseline: Stage, final: Stage, floor: dict[str, float], validation: Sequence[Recording]
) -> Assessment:
    """The final model by its errors on validation data; arguments as in `end_state`."""
    errors = baseline.held_out_rmse_windows, final.held_out_rmse_windows
    return assess(*errors, floor, final.process_noise_nats, sum(r.N for r in validation))


def end_state(
    baseline: Stage,
    rounds: Sequence[Round],
    final: Stage,
    floor: dict[str, float],
    ranking: Sequence[Score],
    test: Sequence[Recording],
) -> tuple[Verdict, str]:
    """The verdict, and a sentence that gives its reason.

    Args:
        baseline: Stage before any was added.
        rounds: What was added.
        final: Stage after the last round.
        floor: Standard deviation of the sensor noise per channel.
        ranking: Scores of the baseline.
        test: Held-out recordings.
    """
    end = assess_stages(baseline, final, floor, test)
    seconds = final.window_seconds
    reached = f"the held-out error over {seconds:g} s is {in_noise(end.remaining)} times the sensor noise"
    names = " and ".join(effect_phrase(r.effect, r.port) for r in rounds)
    share = f"; {end.explained_text}" if rounds and end.explained_text else ""
    explain, others = "explain", "some of them from others (listed with each)"
    if len(rounds) == 1:
        explain, others = "explains", "this from others (listed with it)"
    visible = [s for s in ranking if s.excited]
    invisible = len(ranking) - len(visible)
    if not end.is_explained:
        found = f"{names} found, but something" if rounds else "Something"
        why = "" if not end.at_noise else f"; {end.criterion}"
        return Verdict.UNEXPLAINED, f"{found} remains that no candidate explains: {reached}{why}{share}."
    if any(r.equivalent for r in rounds):
        return Verdict.AMBIGUOUS, (
            f"{names} {explain} the recording, but it cannot distinguish {others}: {reached}{share}."
        )
    if rounds:
        return Verdict.FOUND, f"{names} {explain} the recording: {reached}{share}."
    if ranking and invisible > len(ranking) / 2:
        return Verdict.NOT_EXCITED, (
            f"Nothing was found, but {invisible} of {len(ranking)} candidates could not have shown in this "
            f"recording: move the machine more, over more speeds and voltages."
        )
    hidden = f"; {invisible} of {len(ranking)} candidates could not have shown" if invisible else ""
    return Verdict.NOTHING_MISSING, f"Nothing is missing: {reached}{hidden}."
