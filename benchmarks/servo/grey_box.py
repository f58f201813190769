"""The grey box: the ready-made servo with friction, fitted by free runs, and structures found by a search."""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.effects import DryFriction, Probe, Scale, register
from rotflex_jax.effects.base import Scalar
from rotflex_jax.effects.motor import DYNAMIXEL_GAIN_SCALE
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.parameters import parameter
from servo.evolved import evolved_alike
from servo.friction_models import GRAVITY as FREE_FALL
from servo.recordings import LENGTH, MASS, Split, errors


@register
@dataclasses.dataclass(frozen=True)
class WeightFriction(DryFriction):
    """Friction of a gear in proportion to the weight that it carries. |tau| = level |sin(position)|

    A custom effect, made as CONTRIBUTING describes: the friction of M3 with the load alone, without the motor
    torque. Except during acceleration, the motor torque is in proportion to the weight.
    """

    name: ClassVar[str] = "weight_friction"
    title: ClassVar[str] = "friction in proportion to the weight"
    equation: ClassVar[str] = "tau = -level * |sin(position)| * sign(speed)"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    searched: ClassVar[tuple[str, ...]] = ("hub",)

    level: float = parameter(0.1, unit="N m", lower=0.0, meaning="friction with the pendulum horizontal")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion."""
        return self.level * jnp.abs(jnp.sin(position))

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"level": 0.1 * scale.torque}]]


@register
@dataclasses.dataclass(frozen=True)
class LiftingFriction(DryFriction):
    """Excess of friction while the weight is lifted. |tau| = level max(0, direction sin(position))

    Together with `WeightFriction` it corresponds to the directional term of M5.
    """

    name: ClassVar[str] = "lifting_friction"
    title: ClassVar[str] = "friction that is more while the weight is lifted"
    equation: ClassVar[str] = "tau = -level * max(0, sign(speed) * sin(position)) * sign(speed)"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)

    level: float = parameter(0.1, unit="N m", lower=0.0, meaning="excess with the pendulum horizontal")

    def limit(self, position: Scalar, speed: Scalar, direction: Scalar) -> Scalar:
        """Level [N m] that opposes motion in `direction`."""
        rising = direction * jnp.sin(position)
        return self.level * jnp.where(rising > 0, rising, 0.0)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """One direction."""
        return [[{"level": 0.1 * scale.torque}]]


FRICTION: dict[str, tuple[fx.Effect, ...]] = {
    "no friction": (),
    "Coulomb": (fx.Coulomb("hub", level=0.03),),
    "Stribeck": (fx.Stribeck("hub", level=0.03, excess=0.01),),
    "LuGre": (fx.LuGre("hub"),),
    "load friction": (fx.LoadFriction("hub", tied=True),),
    "load friction, viscous, delay": (
        fx.LoadFriction("hub", tied=True),
        fx.Viscous("hub", coefficient=0.01),
        fx.Delay(time=0.005),
    ),
    "weight friction": (WeightFriction("hub"),),
    "weight friction, delay": (WeightFriction("hub"), fx.Delay(time=0.005)),
    "motor friction, delay": (fx.LoadFriction("hub", tied=True, of="motor"), fx.Delay(time=0.005)),
    "weight friction, Stribeck": (WeightFriction("hub"), fx.Stribeck("hub", level=0.003, excess=0.01)),
}
"""Structures that are fitted in every case, in addition to the one that a search finds."""

ROBUST = "motor friction, delay, robust"
"""Friction in proportion to the motor torque, as the runs without torque indicate. It is fitted to absolute
errors, except for the smallest ones, as M1 to M6 are."""

ABSOLUTE = 0.3
"""Standard deviations beyond which an error counts by its size in `ROBUST`."""

YIELDING = "weight friction, delay, a supply that gives way"
"""`ALIKE` with a fitted resistance of the supply, which causes a loss at large duty and current."""

ALIKE = "weight friction, delay"
"""Structure whose parameters are also fitted by CMA-ES."""

BOX = {
    "hub.inertia.inertia": (0.0050, 0.0549),
    "hub.position_servo.torque_constant": (0.1, 3.0),
    "hub.position_servo.resistance": (0.5, 10.0),
    "hub.gravity.cosine": (-0.048, 0.048),
    "hub.weight_friction.level": (0.0, 0.48),
    "input.delay.time": (0.0, 0.05),
}
"""Bounds of its parameters for CMA-ES, as wide as those of M1 to M6."""


def servo(effects: tuple[fx.Effect, ...] = ()) -> rf.Mechanism:
    """The ready-made servo with friction."""
    mechanism = rf.joints.xl330_pendulum(MASS, LENGTH)
    for effect in effects:
        mechanism = mechanism + effect
    return mechanism


def yielding() -> rf.Mechanism:
    """The ready-made servo on a supply with a resistance, with the friction of `YIELDING`."""
    name = "hub.position_servo.source_resistance"
    mechanism = servo(FRICTION[ALIKE])
    motor = mechanism.effect("position_servo", "hub").replace(source_resistance=0.3)
    effects = tuple(motor if e.name == motor.name else e for e in mechanism.effects)
    return dataclasses.replace(mechanism, effects=effects).release(name)


def supply_resistance(servo: rf.Fit) -> list[float]:
    """Resistance of the supply, estimated from its logged voltage by least squares over all logs [ohm].

    The current of the supply is the duty times the current of the armature.

    Args:
        servo: Fit with the torque constant and the resistance of the armature.

    Returns:
        The resistance and its standard deviation, for independent errors of the samples.
    """
    constant, armature = (servo[f"hub.position_servo.{n}"].value for n in ("torque_constant", "resistance"))
    rows, volts = [], []
    for path in rf.data.fetch("bam_xl330"):
        log = json.loads(path.read_text(encoding="utf-8"))
        entries = list(itertools.takewhile(lambda e: e["torque_enable"], log["entries"]))
        names = ("timestamp", "position", "goal_position", "input_volts")
        t, q, goal, v = (np.array([e[n] for e in entries]) for n in names)
        duty = np.clip(log["kp"] * DYNAMIXEL_GAIN_SCALE * (goal - q), -1, 1)
        current = duty * (v * duty - constant * np.gradient(q, t)) / armature
        rows.append(np.column_stack([np.ones(len(t)), -current]))
        volts.append(v)
    A, v = np.concatenate(rows), np.concatenate(volts)
    found, squares, _, _ = np.linalg.lstsq(A, v, rcond=None)
    covariance = squares[0] / (len(v) - 2) * np.linalg.inv(A.T @ A)
    return [float(found[1]), float(np.sqrt(covariance[1, 1]))]


def supply(split: Split) -> dict[str, list[float]]:
    """Resistance of the supply from motion and from logged voltage, with standard deviations [ohm]."""
    fit, _ = fitted(yielding(), split)
    found = fit["hub.position_servo.source_resistance"]
    return {"motion": [found.value, found.std], "logged": supply_resistance(fit)}


def released() -> dict[str, Any]:
    """Fits of three friction structures to the four runs in which the torque is off and the arm falls freely.

    Returns:
        For each structure the free parameters with standard deviations, and the root mean square errors of
        free runs of 4 s, one after each gain [deg].
    """
    runs = [r for r in map(rf.data.load_bam_xl330_released, rf.data.fetch("bam_xl330")) if r is not None]
    known = ("torque_constant", "resistance")
    passive = rf.joints.servo("xl330", 0.0069, weight=MASS * FREE_FALL * LENGTH)
    passive = passive.trust("hub.gravity.sine", *(f"hub.position_servo.{n}" for n in known))
    passive = passive.release("hub.inertia.inertia")
    structures = {
        "Coulomb, viscous": (fx.Coulomb("hub", level=0.01), fx.Viscous("hub", coefficient=0.005)),
        "weight friction, viscous": (WeightFriction("hub", level=0.03), fx.Viscous("hub", coefficient=0.005)),
        "all three": (
            fx.Coulomb("hub", level=0.01),
            WeightFriction("hub", level=0.03),
            fx.Viscous("hub", coefficient=0.005),
        ),
    }
    found = {}
    for name, effects in structures.items():
        mechanism = passive
        for effect in effects:
            mechanism = mechanism + effect
        fit = rf.fit(mechanism, runs)
        away = [float(np.rad2deg(np.sqrt(np.mean((fit.model.simulate(r) - r.y) ** 2)))) for r in runs]
        found[name] = {
            "parameters": {e.name: [e.value, e.std] for e in fit.parameters if e.free},
            "rms": away,
        }
    return found


def fitted(
    mechanism: rf.Mechanism, split: Split, robust: float | None = None
) -> tuple[rf.Fit, dict[str, Any]]:
    """A fit by free runs and its row of the results; a robust one from the measured first states."""
    began, processor = time.perf_counter(), time.process_time()
    fit = rf.fit(mechanism, split.train, robust=robust, first="measured" if robust else "fitted")
    seconds, processor = time.perf_counter() - began, time.process_time() - processor
    runs = lambda of: [fit.model.simulate(r) for r in of]  # noqa: E731
    return fit, {
        "status": fit.status,
        "seconds": seconds,
        "processor seconds": processor,
        "rollouts": fit.steps * len(split.train),
        "parameters": {e.name: [e.value, e.std] for e in fit.parameters if e.free},
        "train": errors(runs(split.train), split.train),
        "test": errors(runs(split.test), split.test),
    }


def evolved_grey_box(split: Split, rollouts: int) -> dict[str, Any]:
    """Row of the results for the structure `ALIKE`, fitted by CMA-ES."""
    model, row = evolved_alike(servo(FRICTION[ALIKE]), split.train, BOX, rollouts, seed=1)
    runs = lambda of: [model.simulate(r) for r in of]  # noqa: E731
    return row | {
        "train": errors(runs(split.train), split.train),
        "test": errors(runs(split.test), split.test),
    }


def of_the_package(mechanism: rf.Mechanism) -> list[tuple[type[fx.Effect], str]]:
    """Default candidates of a search, without the effects that this module adds to the catalogue."""
    return [p for p in search_places(mechanism) if p[0].__module__.startswith("rotflex_jax.")]


def searched(split: Split, say: Callable[[str], None]) -> dict[str, Any]:
    """Row of the structure found by a search, fitted by free runs to all training recordings.

    Args:
        split: Training and test recordings.
        say: Called with lines of progress.
    """
    base = servo()
    began = time.perf_counter()
    found = rf.discover(base, split.search, split.validation, candidates=of_the_package(base), progress=say)
    seconds = time.perf_counter() - began
    _, row = fitted(found.model.mechanism, split)
    return row | {
        "verdict": str(found.verdict.value),
        "sentence": found.sentence,
        "effects": [f"{r.effect} at {r.port}" for r in found.rounds],
        "search seconds": seconds,
        "ranking": [
            {
                "effect": r.effect,
                "port": r.port,
                "nats": r.score,
                "excited": r.excited,
                "unconfounded": r.orthogonal_fraction,
            }
            for r in found.ranking
        ],
    }


def direction(split: Split, say: Callable[[str], None]) -> dict[str, Any]:
    """Whether recordings with one mass distinguish friction while lifting from friction while lowering.

    With both levels free, torque constant, resistance and inertia can grow together with the difference of
    the levels, with nearly the same motion as a result. So a fit does not determine the level, and the
    orthogonal fraction of the candidate in a search is small.
    """
    base = servo((WeightFriction("hub"),))
    both, row = fitted(base + LiftingFriction("hub"), split)
    found = rf.discover(
        base, split.search, split.validation, candidates=[(LiftingFriction, "hub")], rounds=1, progress=say
    )
    ranked = found.ranking[0]
    names = ("hub.weight_friction.level", "hub.lifting_friction.level", "hub.inertia.inertia")
    return {
        "fit": {n: [both[n].value, both[n].std] for n in names},
        "alone": row["status"],
        "verdict": str(found.verdict.value),
        "excited": ranked.excited,
        "unconfounded": ranked.orthogonal_fraction,
        "detectable": ranked.detection_limit,
    }
