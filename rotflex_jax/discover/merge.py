"""One richer law in the place of a simpler one and calibrations that only mend it."""

import dataclasses

import numpy as np

from rotflex_jax.discover.decide import WINDOWS_BETTER, samples_of
from rotflex_jax.discover.grow import is_physical, with_effect, without
from rotflex_jax.discover.heldout import Away, held_out
from rotflex_jax.discover.hypothesis import Hypothesis
from rotflex_jax.discover.refit import Judge, refit
from rotflex_jax.discover.score import Score
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.kinds import Memory

# What the one law may lose against the several, beyond what its fewer numbers are worth [nat].
LOSS = 2.0


@dataclasses.dataclass(frozen=True)
class Merged:
    """Several effects that are one law as well.

    Attributes:
        final: The hypothesis with the one law.
        law: Its place.
        simpler: Place of the law that it contains.
        gone: All places that it stands for.
        alike: Whether it needs as many numbers as they, so that only taste prefers the one.
    """

    final: Hypothesis
    law: Place
    simpler: Place
    gone: tuple[Place, ...]
    alike: bool

    @property
    def note(self) -> str:
        """What a reader must know."""
        several = " and ".join(f"{CATALOG[name].title} at {port}" for name, port in self.gone)
        count = "as many numbers" if self.alike else "more numbers"
        return (
            f"{several} together are the same as {CATALOG[self.law[0]].title} at {self.law[1]}, with {count} "
            "and more effects; the one law is reported."
        )


def merged(judge: Judge, away: Away, final: Hypothesis, order: list[Place]) -> Merged | None:
    """The one law that does without the machine's calibrations what the final model does with them.

    A constant torque is a voltage offset at the hub and a shifted deflection at the joint, and an
    asymmetric friction is a symmetric one and a constant torque: calibrations, which are always at hand,
    take its asymmetry away before a search can ask for it. Fewer effects that explain as much are the
    better answer.

    Args:
        judge: With the training recordings.
        away: The held-out recordings.
        final: The final model.
        order: Its effects and the calibrations that belong to the machine.
    """
    s = judge.bench.supermodel
    asked = [p for p in order if p in s.calibrations]
    pairs = [
        (simple, law)
        for simple in order
        if simple not in asked
        for law in s.candidates
        if asked and law[1] == simple[1] and simple[0] in CATALOG[law[0]].contains and law not in order
        if not issubclass(CATALOG[law[0]], Memory)
    ]
    if not pairs:
        return None
    trials = []
    for simple, law in pairs:
        bare = final
        level = max(final.values(judge.bench).mean(axis=0)[s.parameter_indices(simple)])
        for place in (simple, *asked):
            bare = without(judge, bare, place)
        c = s.candidates[law]
        start = np.where(c.amplitudes, level, np.array(c.probes[0][0]))
        trials.append(with_effect(judge, bare, Score(law, 0.0, 0.0, start, True, 1.0, 1.0), 1.0))
    fitted = refit(judge, trials, turns=1)
    (simple, law), one = max(zip(pairs, fitted, strict=True), key=lambda pair: pair[1].log_likelihood)
    before = len(s.parameter_indices(simple)) + len(final.x0) * len(asked)
    saved = before - len(s.parameter_indices(law))
    worth = LOSS + 0.5 * saved * np.log(samples_of(judge.bench.data))
    if saved < 0 or one.log_likelihood < final.log_likelihood - worth or not is_physical(judge, one, law):
        return None
    kept = [law if p == simple else p for p in order if p not in asked]
    errors = away.short_runs(held_out(away, one).trained, kept)
    several = away.short_runs(held_out(away, final).trained, order)
    if float(np.mean(np.log(errors / several))) > WINDOWS_BETTER:
        return None
    return Merged(one, law, simple, (simple, *asked), saved == 0)
