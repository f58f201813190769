"""A torque learned from recordings where no effect of the catalogue explains what is left."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from rotflex_jax.discover.decide import lead
from rotflex_jax.discover.formula import Formula, read
from rotflex_jax.discover.heldout import Away, held_out
from rotflex_jax.discover.lanes import Bench
from rotflex_jax.discover.learned_result import LearnedTorqueResult, columns
from rotflex_jax.discover.moves import begin
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.result import Stage
from rotflex_jax.discover.room import make_room
from rotflex_jax.discover.scales import motion, scales
from rotflex_jax.discover.smooth_map import fit_map, steps
from rotflex_jax.discover.stages import Scribe
from rotflex_jax.discover.supermodel import build
from rotflex_jax.effects import LearnedTorque, Linear, Viscous
from rotflex_jax.errors import InputError
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import first_states, sensor_noise, stack
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

Progress = Callable[[str], None]

# Splines along position and speed.
COUNT = (8, 15)
# Share of the usual speed below which the map is even in it.
BEND = 0.1
# Held-out data must speak for the map as clearly as this.
GAIN, SURE = 5.0, 1.5


def learn_torque(
    model: Mechanism | Model,
    train: Recording | Sequence[Recording],
    test: Recording | Sequence[Recording],
    at: str = "hub",
    *,
    window_seconds: float = 2.0,
    progress: Progress | None = None,
) -> LearnedTorqueResult:
    """Learn a torque as a smooth map of position and speed of a port, and read it as a formula.

    The map is fitted through the simulator together with the model, whose parameters it cannot imitate;
    how smooth it is, the recordings decide. It is kept only if recordings that no fit saw become likelier,
    so that a model that lacks nothing stays as it is. Use it where a search ends `unexplained`.

    Not for what depends on time, on the past or on the voltage: it then explains little, and says so.

    Args:
        model: The model so far, with the effects that were found.
        train: Recordings to fit.
        test: Recordings that no fit sees.
        at: Port of the torque.
        window_seconds: Length of the windows of the short held-out runs [s].
        progress: Called with a line of text at each stage.

    Returns:
        The model with the map, its errors, the map with deviations, and its formula.

    Raises:
        InputError: A port that does not exist or that the outputs do not determine, or a map that is there.
    """
    make_room()
    model, say = model if isinstance(model, Model) else Model(model), progress or (lambda _: None)
    trained = (train,) if isinstance(train, Recording) else tuple(train)
    unseen = (test,) if isinstance(test, Recording) else tuple(test)
    position, speed = _motion(model, trained, at)
    data = stack(trained, model)
    torque = torque_scale(model.mechanism, data)
    effect = _empty(at, position, speed, torque)
    whole = model.mechanism + effect
    names = [f"{at}.learned_torque.{n}" for n in effect.values]
    s = build(whole.trust(*names), (), scales(model, trained, torque))
    noise, ports = sensor_noise((*trained, *unseen), model), tuple(everywhere(whole, 1.0))
    judge = Judge(Bench(s, model.solver, data), noise, torque, ports)
    away = Away(
        Judge(Bench(s, model.solver, stack(unseen, model)), noise, torque, ports),
        unseen,
        first_states(model, unseen),
        window_seconds,
    )
    say("learned torque: fitting the model as it is")
    base = held_out(away, begin(judge, s, model, trained))
    say("learned torque: fitting the map")
    weights = [s.mechanism.parameter_names.index(n) for n in names]
    physics = _physics(model.mechanism, at)
    apart = effect.design(position, speed).T @ columns(physics, position, speed)
    size = torque / effect.scale
    mapped = fit_map(judge, base.hypothesis, effect, weights, apart, size)
    trial = held_out(away, mapped.hypothesis)
    if effect.count[0] > 1 and not mapped.flat:
        # Where held-out data lie beyond the positions seen, a map of speed alone may be the better one.
        level = fit_map(judge, base.hypothesis, effect, weights, np.hstack([apart, steps(effect).T]), size)
        other = held_out(away, level.hypothesis)
        if other.held_out > trial.held_out:
            mapped, trial = level, other
    gain, sure = lead(trial.blocks, base.blocks)
    kept = bool(gain > GAIN and sure > SURE and np.all(trial.windows < 1.02 * base.windows))
    say(f"learned torque: {gain:.0f} nat on held-out data, {'kept' if kept else 'not kept'}")
    scribe = Scribe(judge, away, model.solver)
    before = _bare(scribe.stage(base, s.calibrations), at)
    effect = effect.replace(weights=tuple((effect.scale * trial.hypothesis.z[weights] * kept).tolist()))
    return LearnedTorqueResult(
        at=at,
        kept=kept,
        effect=effect,
        before=before,
        after=scribe.stage(trial, s.calibrations) if kept else before,
        held_out_gain_nats=gain,
        formula=read(mapped, effect, position, speed) if kept else Formula(()),
        physics=physics,
        covariance=effect.scale**2 * mapped.covariance,
        position=position,
        speed=speed,
        noise_floor=dict(zip(whole.channels, noise.tolist(), strict=True)),
    )


def _motion(model: Model, recordings: Sequence[Recording], at: str) -> tuple[np.ndarray, np.ndarray]:
    """Position and speed of a port along the recordings."""
    m = model.mechanism
    if at not in m.port_vectors:
        raise InputError(
            f"Port {at!r} was asked for, but the mechanism has {', '.join(m.port_vectors)}; name one."
        )
    if any((e.name, e.at) == (LearnedTorque.name, at) for e in m.effects):
        raise InputError(
            f"A torque at {at!r} was to be learned, but the model already has one there; take it out with "
            "`without`."
        )
    found = [motion(m, model.measured(r).astype(float), r.Ts) for r in recordings]
    if not all(at in f for f in found):
        raise InputError(
            f"A torque at {at!r} was to be learned, but the measured positions do not determine its motion; "
            "choose a port whose position follows from the outputs."
        )
    return tuple(np.concatenate([f[at][k] for f in found]) for k in (0, 1))  # type: ignore


def _empty(at: str, position: np.ndarray, speed: np.ndarray, torque: float) -> LearnedTorque:
    """A map of nothing over where the port has been."""
    usual = max(float(np.sqrt(np.mean(speed**2))), 1e-9)
    ranges = []
    for x in (position, speed):
        low, high = np.quantile(x, (0.005, 0.995))
        ranges.append((float(low), float(high) if high > low else float(low) + 1e-6))
    return LearnedTorque(
        at=at, position=ranges[0], speed=ranges[1], bend=BEND * usual, count=COUNT, scale=0.1 * torque
    )


def _physics(m: Mechanism, at: str) -> tuple[str, ...]:
    """Terms that an offset of the recording, and dampers and springs at the port, give there."""
    stamps = {e.name: e.stamp() for e in m.effects if isinstance(e, Linear) and e.at == at}
    damped = Viscous.name in stamps or any(float(s.damping) for s in stamps.values())
    sprung = any(float(s.stiffness) for s in stamps.values())
    return ("1", *("w",) * damped, *("q",) * sprung)


def _bare(stage: Stage, at: str) -> Stage:
    """The stage of the model without the map, whose weights are all zero there."""
    head, m = f"{at}.{LearnedTorque.name}.", stage.model.mechanism
    return dataclasses.replace(
        stage,
        model=dataclasses.replace(stage.model, mechanism=m.without(LearnedTorque.name, at)),
        estimates=tuple(e for e in stage.estimates if not e.name.startswith(head)),
    )
