"""The next experiment for two effects that a recording cannot tell apart: rank, then improve."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rotflex_jax.effects.kinds import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.ascent import LOOKS, improved
from rotflex_jax.experiment.contest import Contest, Meeting, other_shapes
from rotflex_jax.experiment.hypotheses import Hypothesis, hypothesis, place_of
from rotflex_jax.experiment.imitation import best_imitation, truth
from rotflex_jax.experiment.limits import Limits
from rotflex_jax.experiment.menu import SHARES, Standard, standard_inputs
from rotflex_jax.experiment.result import Experiment, Rated
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model

Progress = Callable[[str], None]

# One period of a design [s], and the share by which a number that no fit has given an interval is doubted.
PERIOD, DOUBT = 4.0, 0.05


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
    reference: np.ndarray | None = None,
    improve: bool = True,
    starts: int = 2,
    looks: int = LOOKS,
    progress: Progress | None = None,
) -> Experiment:
    """The input that best tells two effects apart, within what the machine bears.

        maximise over u   min over (A true, B true)  min over n  1/2 sum_k |L (y_k(u) - y_hat_k(u; n))|^2

    `y` is the run of the machine with one effect, `y_hat` the prediction by the machine with the other, at
    its best over all that a new recording leaves open (n): the rival's numbers, every free parameter, first
    state, offset, bias. Half the sum is the log-likelihood by which the truth is expected to win [nat]. The
    standard inputs are ranked; the best are then improved along the slope through both simulations.

    Not where the fitted model is far from the machine: the design rests on its prediction of small
    differences, at frequencies that the recording may not have held. Compare with the standard inputs in
    `table`, which ask less of the model.

    Args:
        model: Fitted model, with one of the effects or with neither; a `Fit` brings noise and intervals.
        a: The first effect: "delay@input", ("delay", "input") or an effect with its numbers. An effect that
            is in the model has the model's numbers; one that is only named, those with which it imitates
            the other under `reference`; if both are only named, the first has the catalogue's.
        b: The second effect.
        limits: What the machine may be asked for.
        seconds: Length of the experiment [s].
        Ts: Sampling period [s].
        noise: Channel -> deviation of the sensor noise.
        process_noise: Port -> intensity of the process torque that the fit asked for [(N m)^2 s]; None for
            a free run.
        reference: Voltage of the recording in which the two look alike (N,) [V]; noise if None.
        improve: Whether to improve the best standard inputs, or only to rank them.
        starts: Standard inputs to improve.
        looks: Evaluations of each climb at most.
        progress: Called with a line of text now and then.

    Returns:
        Experiment.

    Raises:
        InputError: Unknown or equal effects, no noise, or an impossible length.

    Source: Atkinson and Fedorov 1975 (T-optimality, Biometrika 62); Pasch-Hausdorff envelopes for the slew.
    """
    say = progress or (lambda _: None)
    fitted = (
        Model(model) if isinstance(model, Mechanism) else model.model if isinstance(model, Fit) else model
    )
    N, P = lengths(seconds, Ts)
    sd = _deviations(fitted, model, noise)
    for port in process_noise or {}:
        if port not in fitted.mechanism.port_vectors:
            raise InputError(
                f"Process noise was given at {port!r}, but the model has the ports "
                f"{', '.join(fitted.mechanism.port_vectors)}; name one of these."
            )
    say("fitting each effect to the other")
    pair = _rivals(fitted, a, b, dict(process_noise or {}), sd, Ts, reference, limits)
    contest = Contest(pair, Ts, limits, _doubts(model, pair[0]))
    listed = []
    offered = standard_inputs(N, Ts, limits)
    for k, s in enumerate(offered):
        say(f"ranking standard inputs: {k + 1} of {len(offered)}")
        listed.append(_rated(contest, s))
    contest = contest.visible([m for *_, m in listed])
    listed = [_counted(contest, *row) for row in listed]
    listed.sort(key=lambda r: -r[0].nats)
    for rated, u, _ in listed[:2]:
        for share in SHARES:
            listed.append(_rated(contest, Standard(rated.input, f"{rated.setting}, x {share:g}", share * u)))
    listed.sort(key=lambda r: -r[0].nats)
    count = max(1, round(N / P))
    designs = []
    for k, (rated, u, _) in enumerate(listed[:starts] if improve else []):
        say(f"improving {rated.input}, {rated.setting} ({k + 1} of {starts})")
        period = improved(contest, u[:P], looks, say)
        whole = limits.playable(np.tile(period, count + 1)[:N], Ts)
        designs.append(
            _rated(contest, Standard("design", f"from {rated.input}, {rated.setting}", whole), True)
        )
    every = sorted([*designs, *listed], key=lambda r: -r[0].nats)
    chosen, u, meeting = every[0]
    left = np.array([i.remainder for i in meeting.imitations])
    L = np.array([np.linalg.inv(h.L) for h in (pair[1], pair[0])])
    return Experiment(
        separates=(pair[0].label, pair[1].label),
        chosen=chosen,
        u=u,
        Ts=Ts,
        period=P * Ts if chosen.input == "design" else N * Ts,
        table=tuple(r for r, _, _ in every),
        numbers={h.label: {n: float(v) for n, v in h.effect().values.items()} for h in pair},
        outputs=meeting.outputs,
        differences=np.einsum("knc,kdc->knd", left, L),
        channels=fitted.mechanism.channels,
        noise=dict(zip(fitted.mechanism.channels, sd.tolist(), strict=True)),
        limits=limits,
        notes=_notes(model, chosen),
    )


def _notes(model: Fit | Model | Mechanism, chosen: Rated) -> tuple[str, ...]:
    """Reasons to doubt the promise."""
    out = []
    if isinstance(model, Fit) and model.status != "converged":
        out.append(
            f"The fit that this rests on has not converged ({model.status}): do not trust the promise."
        )
    if not chosen.settled:
        out.append("An imitation by the rival has not converged; the promise is its first-order estimate.")
    return tuple(out)


def _rated(c: Contest, s: Standard, thorough: bool = False) -> tuple[Rated, np.ndarray, Meeting]:
    """An input within all limits, what it is worth, and the meeting under it."""
    u = c.within(s.u)
    m = c.meet(u, thorough=thorough)
    peaks = dict(zip(c.pair[0].mechanism.channels, c.peaks(u).tolist(), strict=True))
    slew = float(np.max(np.abs(np.diff(u, prepend=0.0)))) / c.Ts
    each = (m.imitations[0].nats, m.imitations[1].nats)
    settled = all(i.converged for i in m.imitations)
    return Rated(s.kind, s.setting, m.nats, each, float(np.max(np.abs(u))), slew, peaks, settled), u, m


def _counted(c: Contest, rated: Rated, u: np.ndarray, m: Meeting) -> tuple[Rated, np.ndarray, Meeting]:
    """The same with only the directions that count."""
    m = dataclasses.replace(m, counted=c.counted)
    return dataclasses.replace(rated, nats=m.nats), u, m


def _rivals(
    model: Model,
    a: Any,
    b: Any,
    process_noise: dict[str, float],
    noise: np.ndarray,
    Ts: float,
    reference: np.ndarray | None,
    limits: Limits,
) -> tuple[Hypothesis, Hypothesis]:
    """Both hypotheses, the one whose numbers are not known fitted to the other."""
    places = place_of(a), place_of(b)
    if places[0] == places[1]:
        raise InputError(
            f"Both effects were given as {'@'.join(places[0])}, but two different ones are to be told apart; "
            "change one of them."
        )
    made = [
        hypothesis(model, e, other, process_noise, noise, Ts) for e, other in ((a, places[1]), (b, places[0]))
    ]
    present = {(e.name, e.at) for e in model.mechanism.effects}
    known = [isinstance(e, Effect) or p in present for e, p in zip((a, b), places, strict=True)]
    true, rival = (1, 0) if known[1] and not known[0] else (0, 1)
    if reference is None:
        quiet = [s for s in standard_inputs(round(8.0 / Ts), Ts, limits) if s.kind == "noise"][1]
        reference = Contest((made[0], made[1]), Ts, limits).within(quiet.u)
    u = np.asarray(reference, float)
    h = made[rival]
    own = f"{places[rival][1]}.{places[rival][0]}."
    if known[rival]:
        held = {i for i, n in enumerate(h.mechanism.parameter_names) if n.startswith(own)}
        h = dataclasses.replace(h, moved=tuple(i for i in h.moved if i not in held))
    y = truth(made[true], u, Ts)
    best = best_imitation(h, u, y, Ts, [h.start, *other_shapes(h)])
    fitted = h.with_numbers(best.numbers).mechanism
    # Offset and bias belong to a recording: the next one has its own.
    fitted = fitted.with_values(dict.fromkeys(h.calibrations, 0.0))
    made[rival] = dataclasses.replace(made[rival], mechanism=fitted)
    return made[0], made[1]


def lengths(seconds: float, Ts: float) -> tuple[int, int]:
    """Samples of the experiment and of one period."""
    if not (0 < Ts < 0.5 and seconds / Ts >= 200):
        raise InputError(
            f"An experiment of {seconds:g} s at a sampling period of {Ts:g} s was asked for, but it needs at "
            "least 200 samples; give for instance seconds=20, Ts=0.002."
        )
    N = round(seconds / Ts)
    return N, min(N, round(PERIOD / Ts))


def _deviations(model: Model, given: Any, noise: Mapping[str, float] | None) -> np.ndarray:
    """Sensor noise per channel."""
    channels = model.mechanism.channels
    known = given.noise if noise is None and isinstance(given, Fit) else noise
    if known is None or set(known) != set(channels) or not all(v > 0 for v in known.values()):
        raise InputError(
            f"The sensor noise was given as {known}, but every channel ({', '.join(channels)}) needs a "
            "positive deviation; give noise={'theta': 5e-4, 'alpha': 5e-4}, or a Fit, which has it."
        )
    return np.array([float(known[c]) for c in channels])


def _doubts(model: Fit | Model | Mechanism, h: Hypothesis) -> list[np.ndarray]:
    """Values (P,) with one free number of the machine moved by two deviations, or by a fixed share."""
    names, out = h.mechanism.parameter_names, []
    known = model.parameters if isinstance(model, Fit) else ()
    std = {e.name: float(e.std) for e in known if np.isfinite(e.std)}
    for i in h.moved:
        reach = 2 * std[names[i]] if names[i] in std else DOUBT * abs(h.mechanism.values[i])
        for step in (-reach, reach):
            values = h.mechanism.values
            spec = h.mechanism.parameter_specifications[i]
            values[i] = np.clip(values[i] + step, spec.lower, spec.upper)
            if reach > 0:
                out.append(values)
    return out
