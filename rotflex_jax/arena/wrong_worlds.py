"""Wrong worlds: recordings as in a laboratory, of a machine whose model has more than one error.

A world has one hidden effect that a search should name, with random strength and shape. In addition it has
what laboratories have: torques that no candidate describes, and faults that a candidate does describe.
Trusted constants of the model are wrong, every run has its own voltage offset, and the machine is in closed
loop; the voltage of the controller and the angles in encoder counts are recorded.

    world = wrong_worlds.world(3000)
    rf.discover(world.model, world.train, world.validation)      # world.test is for the errors only

Two kinds: the flexible joint of the paper, and a flexible link with a strain gauge on the same servo.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.simulator.closed_loop import COUNT, Loop, Sensors, recorded
from rotflex_jax.arena.simulator.control import KINDS, LIMIT, REFERENCES, Controller, designed
from rotflex_jax.arena.simulator.laws import Place, laws
from rotflex_jax.arena.simulator.plant import Plant
from rotflex_jax.arena.simulator.records import perturbed
from rotflex_jax.arena.simulator.seen import distinctness

Ranges = Mapping[str, tuple[float, float]]

VISIBLE = 8.0
"""Least ratio to the sensor noise of the part of a run that only the hidden effect explains.

It must be reached in training and in validation data.
"""

_HUB = {"level": (0.012, 0.06)}
_FINE = {"level": (0.003, 0.015)}
_SHAPE = {"presliding": (0.003, 0.03)}
_LUGRE = {"rise": (0.2, 1.0), "speed": (0.1, 0.8), "presliding": (0.002, 0.01)}

HIDDEN: dict[Place, Ranges] = {
    ("coulomb", "hub"): _HUB,
    ("coulomb", "arm"): _FINE,
    ("coulomb", "joint"): _FINE,
    ("coulomb_asymmetric", "hub"): {"level_plus": (0.03, 0.06), "level_minus": (0.008, 0.024)},
    ("stribeck", "hub"): {"level": (0.012, 0.04), "excess": (0.012, 0.05), "speed": (0.15, 1.0)},
    ("viscous", "arm"): {"coefficient": (0.002, 0.015)},
    ("quadratic_drag", "hub"): {"coefficient": (0.003, 0.02)},
    ("quadratic_drag", "arm"): {"coefficient": (0.001, 0.008)},
    ("cubic_spring", "joint"): {"coefficient": (8.0, 80.0)},
    ("quadratic_spring", "joint"): {"coefficient": (0.5, 4.0)},
    ("joint_play", "joint"): {"play": (0.003, 0.03)},
    ("gravity", "hub"): {"moment": (0.015, 0.15), "phase": (0.2, 1.4)},
    ("gravity", "arm"): {"moment": (0.015, 0.15), "phase": (0.2, 1.4)},
    ("cogging", "hub"): {"amplitude": (0.01, 0.06), "phase": (0.2, 3.0), "periods": (4.0, 24.0)},
    ("dahl", "hub"): _HUB | _SHAPE,
    ("dahl", "joint"): {"level": (0.006, 0.03)} | _SHAPE,
    ("lugre", "hub"): _HUB | _LUGRE | {"damping": (0.003, 0.03)},
    ("bouc_wen", "hub"): {"level": (0.012, 0.06), "width": (0.008, 0.06), "beta": (0.2, 0.8)},
    ("bouc_wen", "joint"): {"level": (0.01, 0.06), "width": (0.008, 0.06), "beta": (0.2, 0.8)},
    ("second_mode", "arm"): {"inertia": (3e-4, 2e-3), "frequency": (5.0, 20.0), "damping": (0.01, 0.06)},
    ("backlash", "hub"): {"play": (0.006, 0.04)},
    ("heating", "hub"): {"rate": (0.5, 5.0), "time": (5.0, 60.0)},
    ("dead_zone", "input"): {"width": (0.06, 0.5)},
    ("saturation", "input"): {"limit": (1.5, 6.0)},
    ("lag", "input"): {"time": (0.003, 0.02)},
    ("delay", "input"): {"time": (0.002, 0.01)},
    ("sensor_gain", "alpha"): {"error": (0.03, 0.2)},
    ("sensor_cubic", "alpha"): {"cubic": (1.0, 15.0)},
    ("sensor_cubic", "theta"): {"cubic": (0.01, 0.15)},
    ("rectifier", "alpha"): {"loss": (0.05, 0.4)},
}
"""Effects that a world may hide; parameters are drawn log-uniformly, in units of `simulator.hidden.DEFAULTS`.

Some effects are left out: those that the textbook joint has as free parameters, the voltage offset that every
run has, and friction that is asymmetric at arm or joint.
"""

_LINK = (("coulomb", "hub"), ("stribeck", "hub"), ("lugre", "hub"))
# Kinds of worlds in turn; one of them hides no effect.
_CYCLE = ("joint", "link", "joint", "joint") * 2 + ("joint", "link", "joint", "nothing")


@dataclass(frozen=True)
class Beside:
    """A further error of a world.

    Args:
        name: name of the error.
        values: parameters of the error.
        names: effects and ports that would be a right name for it, or that absorb it.
    """

    name: str
    values: dict[str, Any]
    names: tuple[Place, ...] = ()


@dataclass(frozen=True)
class World:
    """Three recordings of one machine, the model to start from, and the truth.

    Attributes:
        seed: number of the world.
        kind: `joint` or `link`.
        train: recording to fit.
        validation: recording with another reference, controller and offset.
        test: recording with a third reference, controller and offset; used for no fit and no choice.
        model: the textbook joint, with trusted constants as a user would have them.
        hidden: effect and port to be named, or None.
        parameters: parameters of the hidden effect, under the names of the arena.
        besides: further errors.
        visible: run -> the part of theta and of alpha that only the hidden effect explains, divided by the
            standard deviation of the sensor.
        truth: plant, controllers and offsets, in JSON types.
    """

    seed: int
    kind: str
    train: rf.Recording
    validation: rf.Recording
    test: rf.Recording
    model: rf.Mechanism
    hidden: Place | None
    parameters: dict[str, float]
    besides: tuple[Beside, ...]
    visible: dict[str, tuple[float, float]]
    truth: dict[str, Any]


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def true_plant(rng: np.random.Generator, kind: str) -> tuple[Plant, Beside]:
    """Constants of the machine, and the errors of the constants that the model trusts."""
    plant = perturbed(rng, 0.2)
    factors: dict[str, float] = {n: float(rng.uniform(0.8, 1.2)) for n in ("R_m", "k_m", "eta")}
    plant = replace(plant, **{n: getattr(plant, n) * f for n, f in factors.items()})
    if kind == "link":  # a strip of steel damps less than bearings and springs
        plant = replace(plant, B_joint=log_uniform(rng, 2e-4, 2e-3))
    # Torque constant and damper absorb a wrong gain and back-EMF.
    return plant, Beside("trusted_constants", factors, (("viscous", "hub"),))


def _unnamed_torque(rng: np.random.Generator) -> Beside:
    which = rng.choice(["push", "random_torque", "shaking"])
    if which == "push":
        return Beside(
            "push",
            {
                "amplitude": _sign(rng) * log_uniform(rng, 0.005, 0.03),
                "centre": float(rng.uniform(-0.6, 0.6)),
                "width": log_uniform(rng, 0.06, 0.3),
            },
        )
    if which == "shaking":
        values = {"amplitude": log_uniform(rng, 0.002, 0.01), "frequency": log_uniform(rng, 0.5, 4.0)}
        return Beside("shaking", values, (("periodic_disturbance", "input"),))
    return Beside("random_torque", {"size": log_uniform(rng, 0.002, 0.008), "time": log_uniform(rng, 0.3, 2)})


def _gauge(rng: np.random.Generator) -> Beside:
    error = _sign(rng) * log_uniform(rng, 0.05, 0.2)
    return Beside("gauge_gain", {"error": error}, (("sensor_gain", "alpha"), ("sensor_gain", "theta")))


def _modes(rng: np.random.Generator, link: bool) -> Beside:
    """A second mode, and for a link possibly a third; the gauge shows a share of their deflections."""
    own = lambda low, high: {  # noqa: E731
        "inertia": log_uniform(rng, 1e-4, 6e-4),
        "frequency": log_uniform(rng, low, high),
        "damping": log_uniform(rng, 0.005, 0.03),
    }
    modes = {"hub" if link else "arm": own(12.0, 25.0)}
    if link and rng.random() < 0.5:
        modes["arm"] = own(28.0, 60.0)
    share = [_sign(rng) * log_uniform(rng, 0.1, 0.8) for _ in ("hub", "arm")]
    # An oscillator that is absent stays at zero: its "deflection" would be the angle of its port.
    shown = [s if link and port in modes else 0.0 for s, port in zip(share, ("hub", "arm"), strict=True)]
    names = (("second_mode", "hub"), ("second_mode", "arm"))
    return Beside("more_modes", {"modes": modes, "shown": shown}, names)


def _crosstalk(rng: np.random.Generator) -> Beside:
    share = _sign(rng) * log_uniform(rng, 0.004, 0.02)
    return Beside("crosstalk", {"share": share}, (("cross_talk", "alpha"),))


def _late(_: np.random.Generator) -> Beside:
    return Beside("alpha_late", {"samples": 1}, (("channel_delay", "alpha"),))


def _drawn_besides(rng: np.random.Generator, kind: str, hidden: Place | None) -> list[Beside]:
    """One or two further errors; for a link its modes and its gauge, and possibly play and one more."""
    others = {"torque": _unnamed_torque, "crosstalk": _crosstalk, "late": _late}
    if kind == "link":
        made = [_modes(rng, True), _gauge(rng)]
        if rng.random() < 0.3:
            made.append(Beside("play", {"play": log_uniform(rng, 0.002, 0.01)}, (("backlash", "hub"),)))
        return made + [others[n](rng) for n in rng.permutation(list(others))[: rng.integers(0, 2)]]
    if hidden != ("sensor_gain", "alpha"):
        others["gauge"] = _gauge
    if hidden is None or hidden[0] != "second_mode":
        others["modes"] = lambda r: _modes(r, False)
    count = rng.integers(1, 3)
    # The torque that no candidate describes is drawn most often.
    chance = np.array([2.0 if n == "torque" else 1.0 for n in others])
    chosen = rng.choice(list(others), size=count, replace=False, p=chance / chance.sum())
    return [others[n](rng) for n in chosen]


def _effects(besides: Sequence[Beside]) -> dict[Place, dict[str, float]]:
    """The further errors that act in the plant, in the form of `simulator.laws`."""
    found: dict[Place, dict[str, float]] = {}
    for b in besides:
        if b.name in ("push", "shaking"):
            found[b.name, "hub" if b.name == "push" else "arm"] = b.values
        elif b.name == "gauge_gain":
            found["sensor_gain", "alpha"] = b.values
        elif b.name == "play":
            found["backlash", "hub"] = b.values
        elif b.name == "more_modes":
            found.update({("second_mode", port): v for port, v in b.values["modes"].items()})
    return found


def _sensors(rng: np.random.Generator, kind: str, besides: Sequence[Beside]) -> Sensors:
    """Two encoders, or an encoder and a gauge with a 12-bit converter."""
    values = {b.name: b.values for b in besides}
    made = Sensors(
        modes=tuple(values.get("more_modes", {}).get("shown", (0.0, 0.0))),
        crosstalk=values.get("crosstalk", {}).get("share", 0.0),
        late=values.get("alpha_late", {}).get("samples", 0),
    )
    if kind == "joint":
        return made
    noise = (0.0, log_uniform(rng, 2e-4, 1.5e-3))
    return replace(made, resolution=(COUNT, float(np.deg2rad(90) / 4096)), noise=noise)


def _wandering(size: float, time: float, N: int, Ts: float, rng: np.random.Generator) -> np.ndarray:
    """A random torque with zero mean whose correlation decays with the time constant `time`."""
    keep, w, x = np.exp(-Ts / time), rng.standard_normal(N), np.empty(N)
    x[0] = w[0]
    for k in range(1, N):
        x[k] = keep * x[k - 1] + np.sqrt(1 - keep**2) * w[k]
    return size * x


def _plausible(loop: Loop) -> bool:
    """Whether a laboratory would keep a run: it moves, does not oscillate, rarely reaches full voltage."""
    theta, alpha = np.abs(loop.clean).max(axis=0)
    limited = np.mean(np.abs(loop.u) >= LIMIT)
    late = loop.u[loop.u.size // 2 :]
    restless = np.mean(np.abs(np.diff(late)) > 1.0)
    return bool(theta < 2.0 and 0.01 < alpha < 0.6 and limited < 0.1 and restless < 0.05)


@dataclass(frozen=True)
class _Machine:
    """Hardware of a world."""

    plant: Plant
    effects: dict[Place, dict[str, float]]
    sensors: Sensors
    wander: tuple[float, float] | None


def _run(
    machine: _Machine, kind: str, N: int, Ts: float, rng: np.random.Generator
) -> tuple[Loop, Controller, str, float] | None:
    """One run that a laboratory would keep, or None if the controller does not suit this machine."""
    controller = designed(kind, Plant(), rng)
    offset, shape = float(rng.uniform(-0.06, 0.06)), str(rng.choice(list(REFERENCES)))
    before = round(rng.uniform(0.5, 2.0) / Ts)
    reference = REFERENCES[shape](before + N, Ts, rng)
    torque = _wandering(*machine.wander, before + N, Ts, rng) if machine.wander else None
    tables = laws(_with_offset(machine.effects, offset))
    loop = recorded(machine.plant, tables, machine.sensors, controller, reference, Ts, rng, torque)
    return (loop.after(before), controller, shape, offset) if _plausible(loop) else None


def _with_offset(
    effects: Mapping[Place, Mapping[str, float]], offset: float
) -> dict[Place, Mapping[str, float]]:
    return {("voltage_offset", "input"): {"offset": offset}, **effects}


def _recording(loop: Loop, Ts: float, sensors: Sensors, seed: int, name: str) -> rf.Recording:
    resolution = {"theta": sensors.resolution[0], "alpha": sensors.resolution[1]}
    return rf.Recording(
        u=loop.u, y=loop.y, Ts=Ts, source=f"wrong world {seed}, {name}", resolution=resolution
    )


def _hides(seed: int) -> tuple[str, Place | None]:
    """Kind of world and hidden effect, such that consecutive seeds go through all of them."""
    turn, place = divmod(seed, len(_CYCLE))
    if _CYCLE[place] == "nothing":
        return ("joint", "link")[turn % 2], None
    before = _CYCLE[:place].count(_CYCLE[place]) + turn * _CYCLE.count(_CYCLE[place])
    if _CYCLE[place] == "link":
        return "link", _LINK[before % len(_LINK)]
    places = list(HIDDEN)
    # A stride coprime to the length visits all entries; neighbours in the table are far apart.
    return "joint", places[7 * before % len(places)]


def world(seed: int) -> World:
    """The wrong world with this number; always the same for the same number.

    The world is drawn again until `simulator.seen` finds the hidden effect in training and validation data.

    Args:
        seed: number of the world.

    Raises:
        RuntimeError: if none of many draws shows the effect.
    """
    kind, place = _hides(seed)
    for attempt in range(40):
        rng = np.random.default_rng([seed, attempt])
        found = _attempt(seed, kind, place, rng)
        if found is not None:
            return found
    raise RuntimeError(f"Wrong world {seed} ({kind}, {place}) has no draw that shows what it hides.")


def _attempt(seed: int, kind: str, place: Place | None, rng: np.random.Generator) -> World | None:
    plant, trusted = true_plant(rng, kind)
    besides = _drawn_besides(rng, kind, place)
    sensors = _sensors(rng, kind, besides)
    parameters = {} if place is None else {n: log_uniform(rng, *r) for n, r in HIDDEN[place].items()}
    others = _effects(besides)
    # The hidden effect comes last, so that its state is the last one (`simulator.seen`).
    effects = others if place is None else {**others, place: parameters}
    wander = next(((b.values["size"], b.values["time"]) for b in besides if b.name == "random_torque"), None)
    machine = _Machine(plant, effects, sensors, wander)
    Ts = 1 / (1000 if rng.random() < 0.2 else 500)
    seconds = 5.0 if kind == "link" else float(rng.choice([5.0, 6.0, 8.0, 10.0]))
    N = round(seconds / Ts)
    names, runs = ("train", "validation", "test"), {}
    for name, controller in zip(names, rng.permutation(KINDS), strict=True):
        tries = (_run(machine, str(controller), N, Ts, rng) for _ in range(8))
        runs[name] = next((r for r in tries if r is not None), None)
        if runs[name] is None:
            return None
    visible = {}
    for name in names[:2] if place else ():
        loop, _, _, offset = runs[name]
        true, bare = (laws(_with_offset(e, offset)) for e in (effects, others))
        visible[name] = distinctness(plant, true, bare, sensors, loop, Ts)
        if max(visible[name]) < VISIBLE:
            return None
    offsets = {name: runs[name][3] for name in names}
    besides += [trusted, Beside("voltage_offset", offsets, (("voltage_offset", "input"),))]
    return World(
        seed=seed,
        kind=kind,
        **{name: _recording(runs[name][0], Ts, sensors, seed, name) for name in names},
        model=rf.joints.paper(),
        hidden=place,
        parameters=parameters,
        besides=tuple(besides),
        visible=visible,
        truth={
            "plant": asdict(plant),
            "sensors": asdict(sensors),
            "runs": {n: {"controller": asdict(runs[n][1]), "reference": runs[n][2]} for n in names},
        },
    )
