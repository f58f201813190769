"""Whether predictions and free runs give a parameter the same value within its intervals."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rotflex_jax.parameters import Estimate


class ConditionalInterval(NamedTuple):
    """A parameter of the final model whose intervals at the two horizons exclude each other.

    Attributes:
        prediction: Its estimate from one-step predictions.
        free_run: Its estimate from free runs over some seconds of the same recordings.
    """

    prediction: Estimate
    free_run: Estimate

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "parameter": self.prediction.name,
            "prediction": self.prediction.to_dict(),
            "free_run": self.free_run.to_dict(),
        }


def excluding(
    prediction: Sequence[Estimate], free_run: Sequence[Estimate]
) -> tuple[ConditionalInterval, ...]:
    """Parameters whose 95 % intervals from predictions and from free runs have nothing in common.

        |a - b| > 1.96 (std_a + std_b)

    Of a complete model both fits are estimates of the same number, whose difference scatters by less than
    that; of an incomplete one each horizon has its own best number.

    Args:
        prediction: Estimates of a model fitted to predictions.
        free_run: The same model fitted to free runs of the same recordings.
    """
    found, other = [], {e.name: e for e in free_run}
    for a in prediction:
        b = other.get(a.name)
        if b is None or not (a.free and b.free):
            continue
        if max(a.ci95[0], b.ci95[0]) > min(a.ci95[1], b.ci95[1]):
            found.append(ConditionalInterval(a, b))
    return tuple(found)


def conditional_note(found: Sequence[ConditionalInterval]) -> tuple[str, ...]:
    """What follows for a reader, as a sentence with the numbers of each; nothing where all agree."""
    if not found:
        return ()
    listed = "; ".join(
        f"{a.name} {_interval(a)} {a.unit}".rstrip() + f" from predictions, {_interval(b)} from free runs"
        for a, b in found
    )
    whose = "its intervals hold" if len(found) == 1 else "their intervals hold"
    return (
        f"The intervals from predictions and from free runs exclude each other ({listed}): the model is "
        f"incomplete, and {whose} only under it and at the horizon that it was fitted to.",
    )


def _interval(e: Estimate) -> str:
    low, high = e.ci95
    return f"[{low:.4g}, {high:.4g}]"
