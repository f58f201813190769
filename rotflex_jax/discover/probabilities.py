"""Probabilities of the sets of effects that a search has fitted, and of each effect.

A set is rated by its predictions and free runs of recordings that it was not fitted to, half second by half
second. Residuals within half a second are correlated, so sums over half seconds are computed with many draws
of random weights (Bayesian bootstrap). If a set leads only by a few half seconds, it does not lead in many of
these draws.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.discover.likelihood import DIVERGED
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.validation import Horizons, SearchHorizon, ValidatedHypothesis
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.roles import BIAS, OFFSET
from rotflex_jax.text.numbers import percent_probable

# Number of draws of the weights of half seconds, and the seed that makes them reproducible.
DRAWS, SEED = 2000, 0
# Least probability of a set that a sentence names.
LEAST_NAMED = 0.01


@dataclasses.dataclass(frozen=True)
class FittedSet:
    """A set of effects that a search has fitted, with the evidence of each half second of validation data.

    Attributes:
        effects: Names, such as "coulomb@hub".
        prediction: Log-likelihood of predictions [nat]; None if the set was not fitted to predictions.
        free_run: Minus the logarithm of the error of free runs; None if the set was not fitted to free runs.
    """

    effects: frozenset[str]
    prediction: Float[np.ndarray, " B"] | None = None
    free_run: Float[np.ndarray, " F"] | None = None


class EvidenceRule(NamedTuple):
    """Constants by which evidence becomes probability, calibrated on simulated machines.

    Attributes:
        temperature: Number of nats of predictions that count as one nat, since innovations are correlated
            from sample to sample. It is multiplied by the misfit of the model that was found: if much
            remains, predictions follow the data within a few samples, whatever the model.
        run_nats: Evidence of half a second in which the error of the free run is larger by a factor e [nat].
        prior_nats: Prior log-odds of the absence of an effect against its presence [nat].
        passed_nats: Prior log-odds of the set that has passed all tests of the search against any other set
            [nat]. The tests require more than this evidence, such as a gain on training data.
        elsewhere: Probability that no set that was fitted is the right one, if recordings are explained.
        elsewhere_unexplained: Probability of the same if recordings are far from explained.
    """

    temperature: float = 5.0
    run_nats: float = 0.2
    prior_nats: float = 2.0
    passed_nats: float = 3.0
    elsewhere: float = 0.02
    elsewhere_unexplained: float = 0.17

    def none_of_them(self, misfit: float) -> float:
        """Probability that no set that was fitted is the right one.

        Args:
            misfit: Misfit of the model that was found, 1 if it explains the recordings.
        """
        return self.elsewhere + (self.elsewhere_unexplained - self.elsewhere) * (1 - 1 / misfit)


RULE = EvidenceRule()


class SetProbability(NamedTuple):
    """One set of effects and its probability.

    Attributes:
        effects: Names, such as "coulomb@hub"; empty for the user's model.
        probability: Probability from 0 to 1.
    """

    effects: frozenset[str]
    probability: float


@dataclasses.dataclass(frozen=True)
class Probabilities:
    """Probabilities of sets of effects and of single effects.

    Attributes:
        sets: Sets that were fitted, the most probable one first; with `elsewhere` they sum to one.
        effects: Name of an effect -> probability that it is present: probability of the fitted sets that have
            it, divided by the probability of all fitted sets. A right set that was not fitted is assumed to
            have the effect as often.
        elsewhere: Probability that no set that was fitted is the right one.
        remarks: Conditions of these numbers, in sentences.
        evidence: Evidence from which they were computed.
    """

    sets: tuple[SetProbability, ...]
    effects: dict[str, float]
    elsewhere: float
    remarks: tuple[str, ...] = ()
    evidence: tuple[FittedSet, ...] = dataclasses.field(default=(), repr=False, compare=False)

    def credible(self, share: float = 0.9) -> tuple[SetProbability, ...]:
        """The smallest number of sets that together have a share of the probability of all fitted sets.

        The share is conditional on the right set being among the fitted sets; the probability that it is not
        is `elsewhere`.

        Args:
            share: Share of the probability, above 0 and at most 1.

        Raises:
            InputError: If `share` is no probability.
        """
        share = checks.number(share, "share", above=0, example="0.9")
        if share > 1:
            raise InputError(
                f"share was given {share:g}, but it is a probability; give one above 0, up to 1."
            )
        total = np.cumsum([s.probability for s in self.sets])
        return self.sets[: int(np.searchsorted(total, (share - 1e-12) * (1 - self.elsewhere))) + 1]

    @property
    def sentence(self) -> str:
        """A sentence that names the most probable sets, at most three, and the reported one."""
        if not self.sets:
            return ""
        reported = self.evidence[0].effects if self.evidence else None
        likeliest = [s for s in self.sets[:3] if s.probability >= LEAST_NAMED] or [self.sets[0]]
        named = likeliest + [s for s in self.sets if s.effects == reported and s not in likeliest]
        listed = [
            (set_label(s.effects) + (" (the reported set)" if s.effects == reported else ""), s.probability)
            for s in named
        ]
        if others := [s.probability for s in self.sets if s not in named]:
            rest = "the other fitted set" if len(others) == 1 else "all other fitted sets together"
            listed.append((rest, sum(others)))
        listed.append(("a set that was not fitted", self.elsewhere))
        each = "; ".join(f"{label} {percent_probable(p)}" for label, p in listed)
        if len(self.sets) == 1:
            return f"One set of effects was fitted: {each}."
        return f"Most probable of the {len(self.sets)} sets of effects that were fitted: {each}."

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
    """Effect and port of a name in a set.

    >>> parts("coulomb@hub")
    ('coulomb', 'hub')
    """
    effect, _, port = name.partition("@")
    return effect, port


def set_label(effects: frozenset[str]) -> str:
    """A set of effects in words.

    >>> set_label(frozenset({"sensor_bias@alpha", "coulomb@hub"})), set_label(frozenset())
    ('Coulomb friction at hub + sensor bias of alpha', 'nothing more')
    >>> set_label(frozenset({"voltage_offset@input"}))
    'nothing beside voltage offset'
    """
    return " + ".join(set_labels(effects))


def set_labels(effects: frozenset[str]) -> tuple[str, ...]:
    """The effects of a set in words; for the user's model, one phrase that nothing was added.

    An offset or bias that belongs to the machine is in every set, so a set of these alone adds no effect.
    """
    labels = tuple(effect_label(*parts(n)) for n in sorted(effects))
    if labels and all(parts(n)[0] in (OFFSET, BIAS) for n in effects):
        return (f"nothing beside {' and '.join(labels)}",)
    return labels or ("nothing more",)


def set_probabilities(
    fitted: Sequence[FittedSet], *, misfit: float = 1.0, rule: EvidenceRule = RULE
) -> Float[np.ndarray, " S"]:
    r"""Probabilities of fitted sets, given that one of them is right, with the scatter of the half seconds.

    .. math::
        p_s = E_w \frac{e^{l_s(w)}}{\sum_r e^{l_r(w)}}, \qquad
        l_s(w) = \frac{1}{m T} \sum_b w_b v_{sb} + \nu \sum_b w_b f_{sb} - \lambda n_s + \rho_s

    with blocks of predictions `v` and of free runs `f` over validation recordings, `n` effects, `rho` for the
    set that passed the tests of the search (0 for others), and weights `w` of mean one with a uniform
    Dirichlet distribution (Bayesian bootstrap).

    Args:
        fitted: The sets, first the set that passed the tests. If a set was not fitted at a horizon, it gets
            the evidence of the first set that was fitted at both horizons.
        misfit: `Assessment.misfit` m of the model that was found: 1 if it explains the recordings.
        rule: Constants: temperature T, nats of free runs nu, prior nats lambda and rho.

    Returns:
        A probability for each set; they sum to one.

    Source:
        Y. Yao, A. Vehtari, D. Simpson, A. Gelman, "Using stacking to average Bayesian predictive
        distributions", Bayesian Analysis 13, 2018, section 3.4.
    """
    rng, drawn = np.random.default_rng(SEED), {}
    both = [k for k, s in enumerate(fitted) if s.prediction is not None and s.free_run is not None]
    reference = both[0] if both else 0

    def resampled(rows: list[np.ndarray | None]) -> np.ndarray:
        """Weighted sums over half seconds less the sums of the reference set (DRAWS, S)."""
        of_reference = rows[reference]
        if of_reference is None or not len(of_reference):
            return np.zeros((DRAWS, len(rows)))
        d = np.array([of_reference if row is None else row for row in rows]) - of_reference
        if d.shape[1] not in drawn:
            drawn[d.shape[1]] = d.shape[1] * rng.dirichlet(np.ones(d.shape[1]), DRAWS)
        return drawn[d.shape[1]] @ np.nan_to_num(d, nan=DIVERGED).T

    log_weight = resampled([s.prediction for s in fitted]) / (misfit * rule.temperature)
    log_weight += rule.run_nats * resampled([s.free_run for s in fitted])
    log_weight -= rule.prior_nats * np.array([len(s.effects) for s in fitted])
    log_weight[:, 0] += rule.passed_nats
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    return np.mean(weight / weight.sum(axis=1, keepdims=True), axis=0)


def probabilities(fitted: Sequence[FittedSet], *, misfit: float, rule: EvidenceRule = RULE) -> Probabilities:
    """Probabilities of the sets that a search has fitted.

    Args:
        fitted: The sets, first the set that is reported; of several fits of one set the first counts.
        misfit: `Assessment.misfit` of the model that was found: 1 if it explains the recordings.
        rule: Constants by which evidence becomes probability.

    Returns:
        Probabilities.
    """
    known = {s.effects: s for s in reversed(fitted)}
    once = [known[e] for e in dict.fromkeys(s.effects for s in fitted)]
    elsewhere = rule.none_of_them(misfit)
    p = (1 - elsewhere) * set_probabilities(once, misfit=misfit, rule=rule)
    sets = [SetProbability(s.effects, float(x)) for s, x in zip(once, p, strict=True)]
    effects: dict[str, float] = {}
    for s in sets:
        for name in sorted(s.effects):
            effects[name] = effects.get(name, 0.0) + s.probability / (1 - elsewhere)
    remarks = [
        "Only sets that the search has fitted have a probability of their own; that the right one is none of "
        f"them has the probability {percent_probable(elsewhere)}, as often as on simulated machines with "
        "such an end.",
    ]
    if misfit > 1:
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


# Fits of one set count as the same fit if their log-likelihoods in training differ by no more than this
# [nat].
AS_LIKELY_NATS = 1.0


def set_names(locations: Iterable[EffectLocation]) -> frozenset[str]:
    """Names of effects, as they stand in a set."""
    return frozenset(f"{p.effect}@{p.port}" for p in locations)


def fitted_sets(
    horizons: Horizons,
    at_both: Sequence[ValidatedHypothesis],
    at_reported: Sequence[ValidatedHypothesis],
    reported: SearchHorizon,
    machine: Sequence[EffectLocation],
) -> list[FittedSet]:
    """Every fitted set once, beginning with the first of `at_both`.

    Calibrations are in every model of the search. A separate test has decided which of them belong to the
    machine; these belong to every set.

    Args:
        horizons: Training and validation recordings at both horizons.
        at_both: Models fitted at both horizons, or to predictions alone.
        at_reported: Models fitted at the reported horizon.
        reported: The reported horizon.
        machine: Calibrations that belong to the machine.
    """
    s = horizons.prediction.problem.supermodel
    at_prediction: dict[frozenset[str], list[ValidatedHypothesis]] = {}
    at_free_run: dict[frozenset[str], list[ValidatedHypothesis]] = {}
    known: dict[frozenset[str], None] = {}
    fits = [(v, v.free_run) for v in at_both]
    fits += [(v, v if reported is horizons.free_run else v.free_run) for v in at_reported]
    for v, free in fits:
        effects = [p for p in v.hypothesis.locations if p not in s.calibrations]
        names = set_names([*effects, *machine])
        known[names] = None
        if free:
            at_free_run.setdefault(names, []).append(free)
        if v is not free:
            at_prediction.setdefault(names, []).append(v)
    return [
        FittedSet(n, best_blocks(at_prediction.get(n, ())), best_blocks(at_free_run.get(n, ())))
        for n in known
    ]


def best_blocks(fits: Sequence[ValidatedHypothesis]) -> Float[np.ndarray, " B"] | None:
    """Evidence of each half second for the best fit of a set at one horizon; None without a fit.

    If several fits are equally likely in training, the one with the largest validation likelihood counts.
    They differ there by the minimum in which the fit of first states ended, which must not decide between
    sets.
    """
    if not fits:
        return None
    likeliest = max(v.hypothesis.log_likelihood for v in fits)
    equal = [v for v in fits if v.hypothesis.log_likelihood >= likeliest - AS_LIKELY_NATS]
    return max(equal, key=lambda v: v.log_likelihood).blocks
