"""Rival models built into one structure, with the prior distributions of their parameters."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.effects.base import Actuation, DryFriction, Effect, Gear
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.rival_fit import with_calibrations
from rotflex_jax.experiment.rival_set import RivalSet
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Exponential, Mechanism, Solver
from rotflex_jax.mechanism.gear import gear_steps
from rotflex_jax.mechanism.mechanism import check_input_alone, process_noise_of
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Transform

# Standard deviations of a fit hold for one recording at one amplitude: they are multiplied by the first
# number. The second number limits them: a logarithm with a larger one would be undetermined.
FIT_SPREAD, LARGEST_SPREAD = 2.0, 2.0

# Uncertainty of a parameter without a standard deviation, as a share of its value.
UNKNOWN_SHARE = 0.05


def rival_set(
    given: Any,
    *,
    Ts: float,
    noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    uncertainty: float = UNKNOWN_SHARE,
) -> RivalSet:
    """Rival models in one structure, with the prior distributions of their parameters.

    Args:
        given: Name -> `Fit`, `Model` or `Mechanism`; or a list of these, whose names are then the effects
            that not all models have.
        Ts: Sampling period [s].
        noise: Channel -> standard deviation of the sensor noise; from the fits if None.
        process_noise: Port -> intensity of the process noise [(N m)^2 s]; None for free runs.
        uncertainty: Standard deviation of parameters for which none is known, as a share of their value.

    Raises:
        InputError: There are fewer than two models, they differ in more than effects, or the noise is not
            known.
    """
    uncertainty = checks.number(uncertainty, "uncertainty", above=0, example="0.05")
    items = _items(given)
    models = [g.model if isinstance(g, Fit) else Model.of(g) for _, g in items]
    for m in models:
        check_input_alone(m.mechanism, "a designed experiment")
    reduced = [m.without_gates() for m in models]
    labels = _labels([name for name, _ in items], reduced)
    _check_one_machine(labels, reduced)
    first, complete = reduced[0].mechanism, [with_calibrations(m.mechanism) for m in reduced]
    effects = _all_effects(complete)
    union = dataclasses.replace(first, effects=effects, trusted=frozenset())
    names, specs = union.parameter_names, union.parameter_specifications
    transform = Transform.of(specs)
    before = {n for m in reduced for n in m.mechanism.parameter_names}
    calibrations = {n for m in complete for n in m.parameter_names} - before
    calibrations |= {e.full_name(p) for e in union.effects if e.name == "voltage_offset" for p in e.values}
    own = np.array([i for i, n in enumerate(names) if n in calibrations], dtype=int)
    gates, values, free, mean, covariance = [], [], [], [], []
    for m, (_, source) in zip(complete, items, strict=True):
        mine = {(e.name, e.at) for e in m.effects}
        gates.append([float((e.name, e.at) in mine) for e in union.effects])
        of = m.named_values
        v = np.array([of.get(n, x) for n, x in zip(names, union.values, strict=True)])
        v[own] = 0.0
        pick = np.array(
            [i for i, n in enumerate(names) if n in of and n not in m.trusted | calibrations], int
        )
        values.append(v)
        free.append(pick)
        mean.append(transform.unconstrain(v)[pick])
        listed = [names[i] for i in pick]
        covariance.append(_known_covariance(source, listed, v[pick], specs, transform, pick, uncertainty))
    sd = noise_std([g for _, g in items], noise, first.channels)
    return RivalSet(
        labels,
        tuple(reduced),
        union,
        _switching_solver(reduced, union),
        np.array(gates),
        np.array(values),
        tuple(free),
        own,
        tuple(mean),
        tuple(covariance),
        sd,
        process_noise_of(first, process_noise),
        float(Ts),
    )


def _check_one_machine(labels: Sequence[str], models: Sequence[Model]) -> None:
    """Refuse models that differ in more than effects."""
    first = models[0].mechanism
    for label, m in zip(labels, models, strict=True):
        other = m.mechanism
        same = (
            other.coordinates == first.coordinates
            and dict(other.ports) == dict(first.ports)
            and other.outputs == first.outputs
            and other.units == first.units
            and m.solver == models[0].solver
        )
        if not same:
            raise InputError(
                f"{labels[0]!r} and {label!r} differ in coordinates, ports, outputs or solver, but models of "
                "one machine may differ in effects only; build them from the same mechanism."
            )


def _all_effects(mechanisms: Sequence[Mechanism]) -> tuple[Effect, ...]:
    """The effects of all mechanisms, each once; refuse effects that differ in more than parameter values."""
    effects: dict[tuple[str, str], Effect] = {}
    for m in mechanisms:
        for e in m.effects:
            known = effects.setdefault((e.name, e.at), e)
            if (
                type(known) is not type(e)
                or set(known.values) != set(e.values)
                or e.replace(**known.values) != known
            ):
                raise InputError(
                    f"The effect {e.name}@{e.at} has another form in one model than in another, but one "
                    "structure must serve all; give it the same settings."
                )
    return tuple(effects.values())


def _switching_solver(models: Sequence[Model], union: Mechanism) -> Solver:
    """The solver of the models, with voltages that switch within a sample if the machine allows it.

    A delay and a lag of a quarter of a sample differ by less than the error of holding the voltage.
    """
    solver = models[0].solver
    switched = [
        m.mechanism.effects
        for m in models
        if any(isinstance(e, Actuation) and e.changes_within_samples for e in m.mechanism.effects)
    ]
    sticks = any(isinstance(e, DryFriction | Gear) for effects in switched for e in effects)
    if not switched or sticks or gear_steps(union.structure) > 1:
        return solver
    if not isinstance(solver, Exponential) or solver.substeps > 1 or solver.between != "held":
        return solver
    return dataclasses.replace(solver, between="switched")


def _items(given: Any) -> list[tuple[str | None, Any]]:
    pairs = list(given.items()) if isinstance(given, Mapping) else None
    if pairs is None and isinstance(given, Sequence) and not isinstance(given, str):
        pairs = [(None, g) for g in given]
    good = pairs is not None and all(isinstance(g, Fit | Model | Mechanism) for _, g in pairs)
    if pairs is None or not good or len(pairs) < 2:
        raise InputError(
            "Two or more fitted models are needed to tell which is true, but "
            f"{'one' if good else checks.shown(given)} was given; give a list of them, or name -> model."
        )
    return [(None if n is None else str(n), g) for n, g in pairs]


def _labels(names: list[str | None], models: list[Model]) -> tuple[str, ...]:
    sets = [{f"{e.name}@{e.at}" for e in m.mechanism.effects} for m in models]
    common = set.intersection(*sets)
    labels = [n or " + ".join(sorted(s - common)) or "nothing more" for n, s in zip(names, sets, strict=True)]
    twice = [n for n in labels if labels.count(n) > 1]
    if twice:
        raise InputError(
            f"Two of the models are both {twice[0]!r}, but each needs a name or effects of its own; give "
            "name -> model."
        )
    return tuple(labels)


def _known_covariance(
    source: Any,
    names: list[str],
    values: np.ndarray,
    specs: Sequence[Any],
    transform: Transform,
    pick: np.ndarray,
    uncertainty: float,
) -> np.ndarray:
    """Covariance of unconstrained free parameters: enlarged from a fit, else from a share of their values."""
    whole = np.array([s.typical for s in specs], float)
    whole[pick] = values
    z = transform.unconstrain(whole)
    slope = np.abs(transform.physical(z)[1][pick])
    typical = np.array([specs[i].typical for i in pick])
    spread = uncertainty * np.maximum(np.abs(values), uncertainty * typical) / np.maximum(slope, 1e-300)
    out = np.diag(np.clip(spread, 1e-6, LARGEST_SPREAD) ** 2)
    if not isinstance(source, Fit):
        return out
    of = {n: i for i, n in enumerate(source.free_names)}
    known = [k for k, n in enumerate(names) if n in of]
    at = [of[names[k]] for k in known]
    C = source.covariance[np.ix_(at, at)] * FIT_SPREAD**2
    scale = slope[known]
    C = C / np.maximum(np.outer(scale, scale), 1e-300)
    good = np.isfinite(np.diag(C)) & (np.diag(C) > 0)
    sd = np.where(good, np.sqrt(np.where(good, np.diag(C), 1.0)), LARGEST_SPREAD)
    correlation = np.nan_to_num(C / np.outer(sd, sd)) * np.outer(good, good)
    np.fill_diagonal(correlation, 1.0)
    # If only the ratio of two parameters is determined, their correlation is nearly one, and with rounding
    # errors may exceed it.
    w, V = np.linalg.eigh((correlation + correlation.T) / 2)
    correlation = (V * np.maximum(w, 1e-9)) @ V.T
    sd = np.clip(sd, 1e-6, LARGEST_SPREAD)
    out[np.ix_(known, known)] = correlation * np.outer(sd, sd)
    return out


def noise_std(
    given: Sequence[Any], noise: Mapping[str, float] | None, channels: tuple[str, ...]
) -> Float[np.ndarray, " C"]:
    """Standard deviation of the sensor noise of each channel: the given one, or the least of the fits.

    Raises:
        InputError: The noise is neither given nor known from a fit, or not for every channel.
    """
    if noise is None:
        fits = [g for g in given if isinstance(g, Fit)]
        noise = {c: min(f.noise[c] for f in fits) for c in channels} if fits else None
    good = isinstance(noise, Mapping) and set(noise) == set(channels)
    sd = [checks.real(noise[c]) for c in channels] if isinstance(noise, Mapping) and good else []
    if not (sd and all(0 < v < np.inf for v in sd)):
        raise InputError(
            f"The sensor noise was given as {noise if good else checks.shown(noise)}, but every channel "
            f"({', '.join(channels)}) needs a positive standard deviation; give "
            f"noise={dict.fromkeys(channels, 5e-4)}, or a Fit, which has it."
        )
    return np.array(sd)
