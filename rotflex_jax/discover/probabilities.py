"""How probable each set of effects is that a search has fitted, and each effect with it.

A set has more than one reason to be believed: what it gains on the training recordings, which is paid for by
its parameters, and how well it then predicts recordings that it has not seen. The first is Laplace's evidence
to the order of log N, the second the predictive density of the others, and their sum is the evidence of all
recordings. Residuals of half a second belong together, so sums over half seconds are drawn again with random
weights, and what a set gains only in a few moments loses its lead in many of these draws.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError

# Draws of weights of the half seconds, and the seed that makes them the same each time.
DRAWS, SEED = 2000, 0
# A sentence names sets down to this probability.
LEAST_NAMED = 0.01


class HorizonEvidence(NamedTuple):
    """What each half second says for a model at one horizon; see `Hypothesis.blocks`.

    Attributes:
        validation: Of the validation recordings.
        training: Of the training recordings; empty where runs validate each other and these are the same.
    """

    validation: Float[np.ndarray, " B"]
    training: Float[np.ndarray, " T"]


@dataclasses.dataclass(frozen=True)
class FittedSet:
    """A set of effects that a search has fitted, and what the recordings say for it.

    Attributes:
        effects: Names, as "coulomb@hub".
        parameters: How many numbers its effects take.
        prediction: Log-likelihood of predictions [nat]; None where it was not fitted to them.
        free_run: Minus the logarithm of the error of free runs; None where it was not fitted to them.
    """

    effects: frozenset[str]
    parameters: int
    prediction: HorizonEvidence | None = None
    free_run: HorizonEvidence | None = None


class EvidenceRule(NamedTuple):
    """How evidence becomes probability; the numbers are calibrated on simulated machines.

    Attributes:
        temperature: Nats of the likelihood that are worth one: residuals of an incomplete model are alike
            from sample to sample.
        run_nats: What half a second says whose error in free run is larger by a factor e [nat].
        training: Share of the training evidence that counts, 0 to 1: an incomplete model that is richer fits
            the training recordings better whatever it is made of.
        per_look: How many half seconds are worth one independent look at the machine.
        prior_nats: How much likelier than its presence the absence of an effect is beforehand [nat].
        elsewhere: Probability that the right set is none of those fitted, where the recordings are explained.
        elsewhere_unexplained: The same where something remains unexplained.
    """

    temperature: float = 3.0
    run_nats: float = 1.0
    training: float = 0.3
    per_look: float = 3.0
    prior_nats: float = 3.0
    elsewhere: float = 0.03
    elsewhere_unexplained: float = 0.3


RULE = EvidenceRule()


class SetProbability(NamedTuple):
    """One set of effects and how probable it is.

    Attributes:
        effects: Names, as "coulomb@hub"; empty for the model as it was given.
        probability: 0 to 1.
    """

    effects: frozenset[str]
    probability: float


@dataclasses.dataclass(frozen=True)
class Probabilities:
    """Probabilities of sets of effects and of effects.

    Attributes:
        sets: Sets that were fitted, the most probable one first; with `elsewhere` they sum to one.
        effects: Name -> probability that it is there, the sum over the sets that have it.
        elsewhere: Probability that the right set is none of these.
        remarks: What the numbers are conditional on, in sentences.
        evidence: What they were computed from.
    """

    sets: tuple[SetProbability, ...]
    effects: dict[str, float]
    elsewhere: float
    remarks: tuple[str, ...] = ()
    evidence: tuple[FittedSet, ...] = dataclasses.field(default=(), repr=False, compare=False)

    def credible(self, share: float = 0.9) -> tuple[SetProbability, ...]:
        """The fewest sets that together have a probability of at least `share`.

        Where too much of it lies outside of what was fitted, all sets.

        Args:
            share: Above 0, at most 1.

        Raises:
            InputError: A share that is no probability.
        """
        share = checks.number(share, "share", above=0, example="0.9")
        if share > 1:
            raise InputError(
                f"share was given {share:g}, but it is a probability; give one above 0, up to 1."
            )
        total = np.cumsum([s.probability for s in self.sets])
        return self.sets[: int(np.searchsorted(total, share - 1e-12)) + 1]

    @property
    def sentence(self) -> str:
        """The most probable set and the next one, in a sentence."""
        if not self.sets:
            return ""
        named = [s for s in self.sets[:3] if s.probability >= LEAST_NAMED] or [self.sets[0]]
        first, *others = (f"{set_label(s.effects)} {percent(s.probability)}" for s in named)
        rest = f"; then {', '.join(others)}" if others else ""
        return (
            f"Most probable of the {len(self.sets)} sets of effects that were fitted: {first}{rest}; "
            f"none of these {percent(self.elsewhere)}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "sets": [
                {
                    "effects": [
                        dict(zip(("effect", "port"), parts(n), strict=True)) for n in sorted(s.effects)
                    ],
                    "probability": s.probability,
                }
                for s in self.sets
            ],
            "effects": dict(self.effects),
            "elsewhere": self.elsewhere,
            "remarks": list(self.remarks),
        }


def parts(name: str) -> tuple[str, str]:
    """Effect and port of a name.

    >>> parts("coulomb@hub")
    ('coulomb', 'hub')
    """
    effect, _, port = name.partition("@")
    return effect, port


def set_label(effects: frozenset[str]) -> str:
    """A set of effects in words.

    >>> set_label(frozenset({"sensor_bias@alpha", "coulomb@hub"})), set_label(frozenset())
    ('Coulomb friction at hub + sensor bias of alpha', 'nothing more')
    """
    return " + ".join(set_labels(effects))


def set_labels(effects: frozenset[str]) -> tuple[str, ...]:
    """The effects of a set in words, one that says so for the model as it was given."""
    return tuple(effect_label(*parts(n)) for n in sorted(effects)) or ("nothing more",)


def percent(probability: float) -> str:
    """A probability as people read it.

    >>> [percent(p) for p in (0.9997, 0.934, 0.0312, 0.0004)]
    ['> 99 %', '93 %', '3 %', '< 1 %']
    """
    if probability < 0.01:
        return "< 1 %"
    return f"{100 * probability:.0f} %" if probability <= 0.99 else "> 99 %"


def set_probabilities(
    fitted: Sequence[FittedSet],
    measured_values: float,
    rule: EvidenceRule = RULE,
) -> Float[np.ndarray, " S"]:
    r"""Probabilities of fitted sets among each other, with the scatter of the half seconds.

    .. math::
        p_s = E_w \frac{e^{l_s(w)}}{\sum_r e^{l_r(w)}}, \qquad
        l_s(w) = \frac{1}{T} \Bigl( \sum_b w_b v_{sb}
                 + \gamma \bigl( \sum_b w_b t_{sb} - \tfrac{1}{2} k_s \log N \bigr) \Bigr)
                 + \nu \sum_b w_b f_{sb} - \lambda n_s

    with validation blocks `v`, training blocks `t`, blocks of free runs over validation recordings `f`, `k`
    parameters, `n` effects, and weights `w` of mean one that are drawn from Dirichlet's distribution with the
    concentration 1 / `per_look` (Bayesian bootstrap).

    Args:
        fitted: The sets. The first that was fitted at both horizons is the reference: a horizon at which
            another one was not fitted says as much for it as for the reference.
        measured_values: How many values the training recordings have, N.
        rule: Temperature T, share of training gamma, nats of free runs nu, prior nats lambda, `per_look`.

    Returns:
        A probability for each set; they sum to one.

    Source:
        Y. Yao, A. Vehtari, D. Simpson, A. Gelman, "Using stacking to average Bayesian predictive
        distributions", Bayesian Analysis 13, 2018, section 3.4.
    """
    rng, drawn = np.random.default_rng(SEED), {}
    first = next((s for s in fitted if s.prediction and s.free_run), fitted[0])
    reference = list(fitted).index(first)
    assert first.prediction

    def resampled(rows: list[np.ndarray]) -> np.ndarray:
        """Sums over half seconds less those of the reference (DRAWS, S)."""
        d = np.array(rows) - rows[reference]
        if not d.shape[1]:
            return np.zeros((DRAWS, len(d)))
        if d.shape[1] not in drawn:
            alike = np.full(d.shape[1], 1.0 / rule.per_look)
            drawn[d.shape[1]] = d.shape[1] * rng.dirichlet(alike, DRAWS)
        return drawn[d.shape[1]] @ np.nan_to_num(d, nan=-1e9).T

    predictions = [s.prediction or first.prediction for s in fitted]
    penalty = 0.5 * np.log(measured_values) * np.array([s.parameters for s in fitted])
    likelihood = resampled([p.validation for p in predictions])
    if len(first.prediction.training):
        likelihood += rule.training * (resampled([p.training for p in predictions]) - penalty)
    log_weight = likelihood / rule.temperature
    if first.free_run:
        runs = [(s.free_run or first.free_run).validation for s in fitted]
        log_weight += rule.run_nats * resampled(runs)
    log_weight -= rule.prior_nats * np.array([len(s.effects) for s in fitted])
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    return np.mean(weight / weight.sum(axis=1, keepdims=True), axis=0)


def probabilities(
    fitted: Sequence[FittedSet],
    measured_values: float,
    *,
    is_explained: bool,
    rule: EvidenceRule = RULE,
) -> Probabilities:
    """Probabilities of the sets that a search has fitted.

    Args:
        fitted: The sets, the one reported first; of several fits of one set the first counts.
        measured_values: How many values the training recordings have.
        is_explained: Whether the search ended with nothing left above the noise.
        rule: How evidence becomes probability.

    Returns:
        Probabilities.
    """
    known = {s.effects: s for s in reversed(fitted)}
    once = [known[e] for e in dict.fromkeys(s.effects for s in fitted)]
    elsewhere = rule.elsewhere if is_explained else rule.elsewhere_unexplained
    p = (1 - elsewhere) * set_probabilities(once, measured_values, rule)
    sets = [SetProbability(s.effects, float(x)) for s, x in zip(once, p, strict=True)]
    effects: dict[str, float] = {}
    for s in sets:
        for name in sorted(s.effects):
            effects[name] = effects.get(name, 0.0) + s.probability
    remarks = [
        "Only sets that the search has fitted have a probability of their own; that the right one is none of "
        f"them has the probability {percent(elsewhere)}, as often as on simulated machines with such an end.",
    ]
    if not is_explained:
        remarks.append(
            "Something remains that no candidate explains: the probabilities are those of what the catalogue "
            "has names for."
        )
    return Probabilities(
        tuple(sorted(sets, key=lambda s: -s.probability)),
        dict(sorted(effects.items(), key=lambda item: -item[1])),
        elsewhere,
        tuple(remarks),
        tuple(once),
    )
