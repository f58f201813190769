"""The next experiment for two effects that a recording cannot distinguish: rank inputs, then optimise."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, overload

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.checks import Progress
from rotflex_jax.effects.base import Effect, name_prefix
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.common_structure import UNKNOWN_SHARE, noise_std
from rotflex_jax.experiment.discrimination import (
    MAX_EVALUATIONS,
    Discrimination,
    DiscriminationProblem,
    optimise_input,
    starts_with_other_shapes,
)
from rotflex_jax.experiment.result import Experiment, Rated, Segment
from rotflex_jax.experiment.rival_fit import (
    RivalModel,
    best_rival_fit,
    effect_location,
    free_run_from_rest,
    rival_model,
)
from rotflex_jax.experiment.segment_choice import SegmentChoice
from rotflex_jax.experiment.sequential import sequential_experiment
from rotflex_jax.experiment.standard_inputs import (
    REDUCED_AMPLITUDES,
    Limits,
    StandardInput,
    checked_limits,
    standard_inputs,
)
from rotflex_jax.experiment.until_decided import models_of
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.mechanism.mechanism import check_input_alone, process_noise_of
from rotflex_jax.models.model import Model

# One period of a design [s].
DESIGN_PERIOD = 4.0
# Largest number of samples of an experiment.
MOST_SAMPLES = 10_000_000
# Evidence that makes one of two equally probable effects 99 % probable [nat].
ENOUGH = math.log(99)


@overload
def next_experiment(
    model: Fit | Model | Mechanism,
    a: Any,
    b: Any,
    *,
    limits: Limits,
    seconds: float = 20.0,
    Ts: float = 0.002,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    reference: Float[np.ndarray, " N"] | None = None,
    improve: bool = True,
    starts: int = 2,
    evaluations: int = MAX_EVALUATIONS,
    progress: Progress | None = None,
) -> Experiment: ...


@overload
def next_experiment(
    model: Any,
    *,
    limits: Limits,
    seconds: float = 20.0,
    Ts: float = 0.002,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    improve: bool = True,
    probabilities: Any = None,
    progress: Progress | None = None,
) -> Segment: ...


def next_experiment(
    model: Any,
    a: Any = None,
    b: Any = None,
    *,
    limits: Limits,
    seconds: float = 20.0,
    Ts: float = 0.002,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    reference: Float[np.ndarray, " N"] | None = None,
    improve: bool = True,
    starts: int = 2,
    evaluations: int = MAX_EVALUATIONS,
    probabilities: Any = None,
    progress: Progress | None = None,
) -> Experiment | Segment:
    """The input that best distinguishes two effects, or several models, within the limits of the machine.

        maximise over u   min over (A true, B true)  min over n  1/2 sum_k |L (y_k(u) - y_hat_k(u; n))|^2

    `y` is the run of the model with one effect. `y_hat` is the prediction of the model with the other effect,
    fitted to `y` in all unknowns of a new recording (n): the parameters of the rival effect, every free
    parameter, first state, offset, bias. Half the sum is the log-likelihood by which the true model is
    expected to win [nat]. The standard inputs are ranked; the best are then optimised by the gradient through
    both simulations.

    Not if the fitted model is far from the machine: the design relies on its prediction of small differences,
    at frequencies that the recording may not contain. Compare with the standard inputs in `table`, which
    require less of the model.

    With several models and no effects (name -> `Fit` or `Model`, a list of them, or the result of a search),
    the input distinguishes all of them. It is the input after which a wrong answer is least probable, for the
    worst of a few draws of the uncertain parameters, as in each step of `experiment_until`.

    Args:
        model: Fitted model, with one of the effects or with neither; a `Fit` has noise and intervals. Or
            several models, without `a` and `b`.
        a: The first effect: "delay@input", ("delay", "input") or an effect with its parameters. An effect in
            the model has the parameters of the model. An effect that is only named is fitted to the other
            effect under `reference`; if both are only named, the first has the parameters of the catalogue.
        b: The second effect.
        limits: Limits of the machine.
        seconds: Length of the experiment [s].
        Ts: Sampling period [s].
        noise: Channel -> standard deviation of the sensor noise.
        process_noise: Port -> intensity of the process noise in the fit [(N m)^2 s]; None for a free run.
        reference: Voltage of the recording that does not distinguish the two effects [V]; noise if None.
        improve: Whether to optimise the best standard inputs, or only to rank them.
        starts: Number of standard inputs to optimise.
        evaluations: Largest number of evaluations of each optimisation.
        probabilities: Prior probabilities of several models, by name or in their order.
        progress: Called with a line of text now and then.

    Returns:
        Experiment; for several models a Segment.

    Raises:
        InputError: The effects are unknown or equal, the noise is not given, the length is not possible, or
            an argument is for the other use.

    Source: Atkinson and Fedorov 1975 (T-optimality, Biometrika 62); Pasch-Hausdorff envelopes for the slew.
    """
    say = checks.progress(progress)
    if a is None and b is None and not isinstance(model, Fit | Model | Mechanism):
        if reference is not None:
            raise InputError(
                "Argument `reference` is for two effects of one model, but several models were given, which "
                "have their parameters; leave it out."
            )
        return _next_segment(model, limits, seconds, Ts, noise, process_noise, improve, probabilities, say)
    if a is None or b is None:
        raise InputError(
            "Two effects must be named where one model is given, such as 'delay@input' and 'lag@input'; or "
            "give several models."
        )
    if probabilities is not None:
        raise InputError(
            "Argument `probabilities` is for several models, but two effects of one model were given; leave "
            "it out."
        )
    fitted = (model.model if isinstance(model, Fit) else Model.of(model)).without_gates()
    check_input_alone(fitted.mechanism, "a designed experiment")
    checked_limits(limits)
    starts, evaluations = checks.whole(starts, "starts", 0), checks.whole(evaluations, "evaluations", 1)
    reference = None if reference is None else checks.signal(reference, "reference")
    N, P = sample_counts(seconds, Ts)
    sd = noise_std([model], noise, fitted.mechanism.channels)
    process_noise = process_noise_of(fitted.mechanism, process_noise)
    say("fitting each effect to the other")
    pair = _rival_pair(fitted, a, b, process_noise, sd, Ts, reference, limits)
    problem = DiscriminationProblem(pair, Ts, limits, _parameter_variations(model, pair[0]))
    problem, ranked = _ranked_inputs(problem, N, say)
    designs = []
    for k, (rated, u, _) in enumerate(ranked[:starts] if improve else []):
        say(f"improving {rated.input}, {rated.setting} ({k + 1} of {starts})")
        period = optimise_input(problem, u[:P], evaluations, say)
        whole = limits.playable(np.tile(period, max(1, round(N / P)) + 1)[:N], Ts)
        design = StandardInput("design", f"from {rated.input}, {rated.setting}", whole)
        designs.append(_rate_input(problem, design, thorough=True))
    table = sorted([*designs, *ranked], key=_evidence, reverse=True)
    chosen, u, result = table[0]
    whitened = np.array([fit.residuals for fit in result.rival_fits])
    L = np.array([np.linalg.inv(rival.L) for rival in (pair[1], pair[0])])
    return Experiment(
        separates=(pair[0].label, pair[1].label),
        chosen=chosen,
        u=u,
        Ts=Ts,
        period=P * Ts if chosen.input == "design" else N * Ts,
        table=tuple(rated for rated, _, _ in table),
        parameters={model.label: {n: float(v) for n, v in model.effect().values.items()} for model in pair},
        outputs=result.outputs,
        differences=np.einsum("knc,kdc->knd", whitened, L),
        channels=fitted.mechanism.channels,
        units=tuple(output_units(fitted.mechanism).values()),
        input_unit=fitted.mechanism.units.input,
        noise=dict(zip(fitted.mechanism.channels, sd.tolist(), strict=True)),
        limits=limits,
        notes=_notes(model, chosen),
    )


def _next_segment(
    models: Any,
    limits: Limits,
    seconds: float,
    Ts: float,
    noise: Mapping[str, float] | None,
    process_noise: Mapping[str, float] | None,
    improve: bool,
    probabilities: Any,
    say: Progress,
) -> Segment:
    """The input that distinguishes several models; arguments as in `next_experiment`."""
    sample_counts(seconds, Ts)
    models, found = models_of(models, say)
    several = sequential_experiment(
        models,
        limits,
        Ts,
        probabilities=found if probabilities is None else probabilities,
        max_seconds=seconds,
        segment_seconds=seconds,
        noise=noise,
        process_noise=process_noise,
        improve=improve,
    )
    return SegmentChoice(several).best(say)[0]


# Rating, voltage and result of an input, as they are ranked.
_RatedInput = tuple[Rated, np.ndarray, Discrimination]


def _ranked_inputs(
    problem: DiscriminationProblem, N: int, say: Progress
) -> tuple[DiscriminationProblem, list[_RatedInput]]:
    """Standard inputs of N samples, best first, and the problem with the directions that count.

    The best two are rated at smaller amplitudes too.
    """
    offered, rated_inputs = standard_inputs(N, problem.Ts, problem.limits), []
    for k, s in enumerate(offered):
        say(f"ranking standard inputs: {k + 1} of {len(offered)}")
        rated_inputs.append(_rate_input(problem, s))
    problem = problem.without_nested_direction([result for *_, result in rated_inputs])
    ranked = [_count_directions(problem, *row) for row in rated_inputs]
    ranked.sort(key=_evidence, reverse=True)
    for rated, u, _ in ranked[:2]:
        for share in REDUCED_AMPLITUDES:
            reduced = StandardInput(rated.input, f"{rated.setting}, x {share:g}", share * u)
            ranked.append(_rate_input(problem, reduced))
    ranked.sort(key=_evidence, reverse=True)
    return problem, ranked


def _notes(model: Fit | Model | Mechanism, chosen: Rated) -> tuple[str, ...]:
    """Reasons to doubt the expected evidence."""
    notes = []
    if isinstance(model, Fit) and model.status != "converged":
        notes.append(
            f"The fit that this rests on has not converged ({model.status}): "
            "do not trust the expected evidence."
        )
    if not chosen.settled:
        notes.append(
            "A fit of the rival has not converged; the expected evidence is its first-order estimate."
        )
    if chosen.nats < ENOUGH:
        notes.append(
            f"No input within these limits is expected to distinguish the two: {chosen.nats:.2g} nats, where "
            f"{ENOUGH:.2g} make one of them 99 % probable."
        )
    return tuple(notes)


def _evidence(row: _RatedInput) -> float:
    return row[0].nats


def _rate_input(problem: DiscriminationProblem, s: StandardInput, thorough: bool = False) -> _RatedInput:
    """The input scaled to all limits, with its rating and its result."""
    u = problem.scaled_to_limits(s.u)
    result = problem.evaluate(u, thorough=thorough)
    peaks = dict(zip(problem.pair[0].mechanism.channels, problem.peaks(u).tolist(), strict=True))
    slew = float(np.max(np.abs(np.diff(u, prepend=0.0)))) / problem.Ts
    each = (result.rival_fits[0].nats, result.rival_fits[1].nats)
    settled = all(fit.converged for fit in result.rival_fits)
    rated = Rated(s.kind, s.setting, result.nats, each, float(np.max(np.abs(u))), slew, peaks, settled)
    return rated, u, result


def _count_directions(
    problem: DiscriminationProblem, rated: Rated, u: np.ndarray, result: Discrimination
) -> _RatedInput:
    """A rated input with the evidence of only the directions that count."""
    result = dataclasses.replace(result, counted=problem.counted)
    return dataclasses.replace(rated, nats=result.nats), u, result


def _rival_pair(
    model: Model,
    a: Any,
    b: Any,
    process_noise: dict[str, float],
    noise: np.ndarray,
    Ts: float,
    reference: np.ndarray | None,
    limits: Limits,
) -> tuple[RivalModel, RivalModel]:
    """Both rival models; the one whose effect has no known parameters is fitted to the other one."""
    locations = effect_location(a), effect_location(b)
    if locations[0] == locations[1]:
        raise InputError(
            f"Both effects were given as {'@'.join(locations[0])}, but two different ones are to be "
            "distinguished; change one of them."
        )
    pair = [
        rival_model(model, effect, other, process_noise, noise, Ts)
        for effect, other in ((a, locations[1]), (b, locations[0]))
    ]
    present = {(e.name, e.at) for e in model.mechanism.effects}
    known = [isinstance(e, Effect) or p in present for e, p in zip((a, b), locations, strict=True)]
    true, rival = (1, 0) if known[1] and not known[0] else (0, 1)
    if reference is None:
        second_noise = [s for s in standard_inputs(round(8.0 / Ts), Ts, limits) if s.kind == "noise"][1]
        reference = DiscriminationProblem((pair[0], pair[1]), Ts, limits).scaled_to_limits(second_noise.u)
    u = np.asarray(reference, float)
    fitted = pair[rival]
    prefix = name_prefix(locations[rival][1], locations[rival][0])
    if known[rival]:
        held = {i for i, n in enumerate(fitted.mechanism.parameter_names) if n.startswith(prefix)}
        fitted = dataclasses.replace(fitted, free=tuple(i for i in fitted.free if i not in held))
    y = free_run_from_rest(pair[true], u, Ts)
    best = best_rival_fit(fitted, u, y, Ts, [fitted.start, *starts_with_other_shapes(fitted)])
    mechanism = fitted.with_unknowns(best.unknowns).mechanism
    # Offset and bias belong to a recording; the next recording has its own.
    mechanism = mechanism.with_values(dict.fromkeys(fitted.calibrations, 0.0))
    pair[rival] = dataclasses.replace(pair[rival], mechanism=mechanism)
    return pair[0], pair[1]


def sample_counts(seconds: float, Ts: float) -> tuple[int, int]:
    """Number of samples of the experiment and of one period of a design."""
    length, period = checks.real(seconds), checks.real(Ts)
    if not (0 < period < 0.5 and 200 <= length / period <= MOST_SAMPLES):
        raise InputError(
            f"An experiment of {checks.shown(seconds)} s at a sampling period of {checks.shown(Ts)} s was "
            f"asked for, but it needs 200 to {MOST_SAMPLES} samples; give for instance seconds=20, "
            "Ts=0.002."
        )
    N = round(seconds / Ts)
    return N, min(N, round(DESIGN_PERIOD / Ts))


def _parameter_variations(model: Fit | Model | Mechanism, rival: RivalModel) -> list[np.ndarray]:
    """Values (P,) with one free parameter changed by two standard deviations, or by a fixed share."""
    m, variations = rival.mechanism, []
    known = model.parameters if isinstance(model, Fit) else ()
    std = {e.name: float(e.std) for e in known if np.isfinite(e.std)}
    for i in rival.free:
        name, spec = m.parameter_names[i], m.parameter_specifications[i]
        reach = 2 * std[name] if name in std else UNKNOWN_SHARE * abs(m.values[i])
        for step in (-reach, reach):
            values = m.values
            values[i] = np.clip(values[i] + step, spec.lower, spec.upper)
            if reach > 0:
                variations.append(values)
    return variations
