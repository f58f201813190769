"""An experiment on a rig until it is decided which model is true."""

from collections.abc import Mapping, Sequence
from typing import Any

from rotflex_jax import checks
from rotflex_jax.checks import Progress
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.common_structure import UNKNOWN_SHARE
from rotflex_jax.experiment.result import SequentialResult
from rotflex_jax.experiment.rig import Rig
from rotflex_jax.experiment.sequential import (
    ERROR,
    MOST_SECONDS,
    SEGMENT_SECONDS,
    sequential_experiment,
)
from rotflex_jax.experiment.standard_inputs import checked_limits
from rotflex_jax.fit.greybox import fit
from rotflex_jax.mechanism.mechanism import check_input_alone


def experiment_until(
    models: Any,
    rig: Rig,
    *,
    probabilities: Mapping[str, float] | Sequence[float] | None = None,
    error: float = ERROR,
    max_seconds: float = MOST_SECONDS,
    segment_seconds: float = SEGMENT_SECONDS,
    check_seconds: float | None = None,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    uncertainty: float = UNKNOWN_SHARE,
    improve: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> SequentialResult:
    """Experiment until it is decided which of several models is true.

    In each step a segment is chosen, played and recorded, and each model is fitted to everything recorded so
    far. The probabilities follow from the averaged likelihoods,

        p_h ~ p_h0 * integral of p(y | parameters, h) p(parameters | h) over the parameters.

    The experiment stops when one model has at least the probability `1 - error`. If one of the models is
    true, a wrong model is then named with at most the probability `error`, averaged over the prior
    probabilities (Wald's test; for two models of equal probability its thresholds are those for error rates
    of `error` in both directions). The experiment also stops when the time is up, or when no input within the
    limits would decide in the time that is left.

    Not if none of the models is near the machine: the probabilities hold among the given models only.

    Args:
        models: Name -> `Fit`, `Model` or `Mechanism`, or a list of them; or the result of a search, whose
            probable sets of effects are fitted. A `Fit` has the uncertainty of its parameters.
        rig: Rig that plays the voltages and has the limits.
        probabilities: Prior probability of each model. If None, the probabilities of the search, or equal
            ones without a search.
        error: Probability of a wrong answer at which the experiment stops.
        max_seconds: Time on the rig at which the experiment stops [s].
        segment_seconds: Length of a segment [s].
        check_seconds: Interval at which the recording is evaluated [s]: on a rig whose motion continues, a
            segment is played in pieces of this length, and stopped early when it is decided. None for whole
            segments.
        noise: Channel -> standard deviation of the sensor noise; from the fits if None.
        process_noise: Port -> intensity of the process noise [(N m)^2 s]; None for free runs.
        uncertainty: Standard deviation of parameters for which none is known, as a share of their value.
        improve: Whether inputs are improved by gradient ascent; otherwise standard inputs are played.
        seed: Seed of standard inputs and draws.
        progress: Called with a line of text now and then.

    Returns:
        SequentialResult.

    Raises:
        InputError: There is no rig, there are fewer than two models, the noise is not known, or a recording
            does not fit the voltage.

    Source: A. Wald, Sequential tests of statistical hypotheses, Annals of Mathematical Statistics 16, 1945;
        C. W. Baum and V. V. Veeravalli, A sequential procedure for multihypothesis testing, IEEE Trans.
        Information Theory 40, 1994; G. E. P. Box and W. J. Hill, Discrimination among mechanistic models,
        Technometrics 9, 1967.
    """
    say = checks.progress(progress)
    if not isinstance(rig, Rig):
        raise InputError(
            f"Argument `rig` must be a Rig, but is {checks.shown(rig)}; derive a class from rotflex_jax.Rig, "
            "or use CallbackRig, SimulatedRig or FileRig."
        )
    models, found = models_of(models, say)
    e = sequential_experiment(
        models,
        checked_limits(getattr(rig, "limits", None)),
        checks.positive(getattr(rig, "Ts", None), "Ts", "s", "0.002"),
        probabilities=found if probabilities is None else probabilities,
        error=error,
        max_seconds=max_seconds,
        segment_seconds=segment_seconds,
        check_seconds=check_seconds,
        continues=rig.continues,
        noise=noise,
        process_noise=process_noise,
        uncertainty=uncertainty,
        improve=improve,
        seed=seed,
    )
    while not (e := e.with_next_segment(say)).verdict:
        assert e.planned is not None
        say(f"{e.seconds:g} s: playing {e.planned.input}, {e.planned.setting}")
        e = e.with_recording(rig.play(e.due))
        say(e.result().standing)
    return e.result()


# Least probability of a set of effects of a search that is fitted, and largest number of sets.
LEAST_PROBABLE, MOST_SETS = 0.02, 5


def models_of(given: Any, say: Progress) -> tuple[Any, Mapping[str, float] | None]:
    """The models unchanged; for the result of a search, its probable sets, fitted to its recordings.

    Args:
        given: The argument `models` of `experiment_until`.
        say: Called with a line of text for each fit.

    Returns:
        Models, and name -> probability if they come from a search, else None.
    """
    known, train = getattr(given, "probabilities", None), getattr(given, "train", None)
    if known is None or not train:
        return given, None
    check_input_alone(given.final.model.mechanism, "a designed experiment")
    models, found = {}, {}
    # The final model may have another law in place of one that was found (`FinalFit.laws`).
    fitted = (*given.final.model.mechanism.effects, *given.model.mechanism.effects)
    final = {(e.name, e.at): e for e in fitted}
    for s in known.sets[:MOST_SETS]:
        if s.probability < LEAST_PROBABLE and len(models) >= 2:
            continue
        m, label = given.baseline.model, " + ".join(sorted(s.effects)) or "nothing more"
        have = {(e.name, e.at) for e in m.mechanism.effects}
        for name in sorted(s.effects):
            at = tuple(name.split("@", 1))
            # The phase of a disturbance in the next seconds is not known.
            if at not in have and not CATALOG[at[0]].line:
                m = m + final.get(at, CATALOG[at[0]](at=at[1]))
        say(f"fitting {label}")
        models[label], found[label] = fit(m, list(train)), s.probability
    return models, found
