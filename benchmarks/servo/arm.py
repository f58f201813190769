"""Joints of the SO-101: the models of the XL-330, with unknown gain and motor parameters."""

from __future__ import annotations

import functools
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax import effects as fx
from servo import friction_models
from servo.evolved import Box, evolved_alike, evolved_models
from servo.friction_models import Logs
from servo.grey_box import of_the_package

# Motions for the fit, motion for the evaluation, and joints, which carry little weight.
TRAIN, TEST = ("multisine", "chirp_sweep"), "step_response"
JOINTS = ("Rotation", "Elbow", "Wrist_Pitch", "Wrist_Roll")

INERTIA, SUPPLY = 0.03, 7.4
SUBSTEPS = 4
"""Integration steps per sample of 20 ms."""

# Bounds of the parameters of M1 to M6 beside friction. The weight of the arm at the joint is unknown too.
ARM_BOX: Box = {"slope": (0.5, 12.0), "load": (0.0, 2.0)}
ARM_MOTOR: Box = {
    "kt": (0.1, 5.0),
    "R": (0.5, 40.0),
    "armature": (0.0, 0.0),
    "q_offset": (-np.pi, np.pi),
    "base": (0.0, 0.5),
}
# Bounds of the parameters of the grey box for CMA-ES.
GREY_BOX: Box = {
    "hub.position_servo.gain": (3.0, 72.0),
    "hub.position_servo.torque_constant": (0.1, 5.0),
    "hub.position_servo.resistance": (0.5, 40.0),
    "hub.gravity.sine": (-2.0, 2.0),
    "hub.gravity.cosine": (-2.0, 2.0),
    "hub.coulomb.level": (0.0, 0.5),
    "input.delay.time": (0.0, 0.05),
}

STRUCTURES: dict[str, tuple[fx.Effect, ...]] = {
    "no friction": (),
    "Coulomb": (fx.Coulomb("hub", level=0.05),),
}
# A fit without the fast end of the chirp, where the error of every model is several times that elsewhere.
SLOW, SLOW_SAMPLES = "Coulomb, slow", 4000
# A model with the same parameters as M1, fitted from the preset alone to all of both motions. The fit is
# robust (all but the smallest errors count by their absolute values, as for M1 to M6) and uses windows, whose
# cost has fewer local minima than that of whole runs. The steps in each of the four minimisations of a robust
# fit are so few that they need less than a fiftieth of the free runs of CMA-ES.
LIKE_M1 = "parameters of M1"
LIKE_M1_EFFECTS = (
    fx.Coulomb("hub", level=0.05),
    fx.Viscous("hub", coefficient=0.05),
    fx.Delay(time=0.01),
)
ABSOLUTE, WINDOW_SECONDS, MOST_STEPS = 0.3, 2.0, 18
EVOLVED = "Coulomb, delay, CMA-ES"


def logs(recordings: list[rf.Recording]) -> Logs:
    """Recordings for the extended friction models: `SUBSTEPS` steps per sample, with a constant goal."""
    N = max(r.N for r in recordings) * SUBSTEPS
    pad = lambda x: np.pad(np.repeat(x, SUBSTEPS), (0, N - SUBSTEPS * len(x)))  # noqa: E731
    slopes = [np.polyfit(np.arange(r.n_init) * r.Ts, r.y[: r.n_init, 0], 1)[0] for r in recordings]
    many = np.ones(len(recordings))
    return Logs(
        goal=np.array([pad(r.u) for r in recordings]),
        angle=np.array([pad(r.y[:, 0]) for r in recordings]),
        length=np.array([r.N * SUBSTEPS for r in recordings]),
        slope=many,
        supply=SUPPLY * many,
        start=np.array([(r.y[0, 0], v) for r, v in zip(recordings, slopes, strict=True)]),
        Ts=recordings[0].Ts / SUBSTEPS,
        load=0.0,
        inertia=INERTIA,
    )


def starts() -> list[rf.Mechanism]:
    """Starts of a fit: a strong motor, and a weak one with equal stiffness and damping.

    If the duty never reaches its limit at a start, the derivatives there do not depend on the largest torque.
    """
    servo = rf.joints.sts3215(INERTIA, gain=16.0, supply=SUPPLY).release("hub.position_servo.gain")
    motor = servo.effect("position_servo", "hub").values
    weak = {"gain": 3.0 * motor["gain"], "torque_constant": 3.0 * motor["torque_constant"]}
    weak["resistance"] = 9.0 * motor["resistance"]
    return [servo, servo.with_values({f"hub.position_servo.{n}": v for n, v in weak.items()})]


def with_effects(servo: rf.Mechanism, effects: Sequence[fx.Effect]) -> rf.Model:
    """The servo with effects added, and several integration steps per sample."""
    for effect in effects:
        servo = servo + effect
    return rf.Model(servo, rf.Exponential(substeps=SUBSTEPS))


def fitted(
    models: Sequence[rf.Model], train: Sequence[rf.Recording], **how: Any
) -> tuple[rf.Fit, dict[str, Any]]:
    """The fit with the least cost from several starts, and its row with the time and runs of all of them."""
    began, processor = time.perf_counter(), time.process_time()
    fits = [rf.fit(model, train, **how) for model in models]
    best = min(fits, key=lambda f: f.cost)
    return best, {
        "seconds": time.perf_counter() - began,
        "processor seconds": time.process_time() - processor,
        "rollouts": sum(f.steps for f in fits) * len(train),
        "status": best.status,
        "parameters": {e.name: [e.value, e.std] for e in best.parameters if e.free},
    }


def _effects(name: str) -> tuple[fx.Effect, ...]:
    """Effects that a row of the grey box adds to the servo."""
    special = {LIKE_M1: LIKE_M1_EFFECTS, EVOLVED: (*STRUCTURES["Coulomb"], fx.Delay(time=0.01))}
    return special.get(name) or STRUCTURES["Coulomb" if name == SLOW else name]


def _rms(run: np.ndarray, recording: rf.Recording) -> float:
    """Root mean square error of a run [deg]."""
    return float(np.rad2deg(np.sqrt(np.mean((run - recording.y[:, 0]) ** 2))))


def _run(parameters: dict[str, Any], name: str, recording: rf.Recording) -> np.ndarray:
    """A free run over a recording [rad].

    Args:
        parameters: Fitted parameters; those of a fit by `rf.fit` are pairs of value and standard deviation.
        name: Name of the model.
        recording: Recording of a motion.
    """
    if name in friction_models.MODELS:
        run = friction_models.rollouts(parameters, logs([recording]))[0]
        return run[: recording.N * SUBSTEPS : SUBSTEPS]
    model = with_effects(starts()[0], _effects(name))
    values = {n: v[0] if isinstance(v, list) else v for n, v in parameters.items()}
    return model.with_values(values).simulate(recording)[:, 0]


def joint_row(
    joint: str, rollouts: int, row: dict[str, Any] | None, search: bool, code: str
) -> dict[str, Any]:
    """Errors of free runs of one joint over motions that no fit used [deg].

    Args:
        joint: Name of the joint.
        rollouts: Largest number of cost evaluations of each evolution, each with a free run of every training
            recording.
        row: Results from before, which are kept; None if there are none.
        search: Whether `rf.discover` is run too. It starts from the servo without friction, with `multisine`
            as training and `step_response` as validation data.
        code: Digest of the code, stored with new results.
    """
    recordings = rf.data.load_dataset("so101")
    of = {r.source.split(",")[0]: r for r in recordings if f" {joint}," in r.source}
    train, test = [of[m] for m in TRAIN], of[TEST]
    others = {motion: r for motion, r in of.items() if motion not in (*TRAIN, TEST)}
    away = lambda run: _rms(run, test)  # noqa: E731
    if row is None:
        swept = float(np.rad2deg(np.ptp(test.y)))
        row = {"joint": joint, "motion": TEST, "range": swept, "goal": away(test.u), "takes": {}}
    slow = [r.slice(0, SLOW_SAMPLES) if r is of["chirp_sweep"] else r for r in train]
    for name in (*STRUCTURES, SLOW, LIKE_M1):
        if name not in row["takes"]:
            models, how = [with_effects(servo, _effects(name)) for servo in starts()], {}
            if name == LIKE_M1:
                models = models[:1]
                how = {"robust": ABSOLUTE, "window_seconds": WINDOW_SECONDS, "max_steps": MOST_STEPS}
            fit, took = fitted(models, slow if name == SLOW else train, **how)
            row["takes"][name] = took | {"code": code}
            row[name] = away(fit.model.simulate(test)[:, 0])
    if EVOLVED not in row["takes"]:
        model = with_effects(starts()[0], _effects(EVOLVED))
        model, row["takes"][EVOLVED] = evolved_alike(model, train, GREY_BOX, rollouts, seed=1)
        row[EVOLVED] = away(model.simulate(test)[:, 0])
    if not set(friction_models.MODELS) <= set(row["takes"]):
        for name, found in evolved_models(logs(train), rollouts, ARM_BOX, ARM_MOTOR).items():
            run = friction_models.rollouts(found["parameters"], logs([test]))[0]
            row[name] = away(run[: test.N * SUBSTEPS : SUBSTEPS])
            row["takes"][name] = found
    row["others"] = {
        motion: {name: _rms(_run(row["takes"][name]["parameters"], name, r), r) for name in row["takes"]}
        for motion, r in others.items()
    }
    if search and "search" not in row:
        known = {n: v[0] for n, v in row["takes"]["no friction"]["parameters"].items()}
        model = with_effects(starts()[0].with_values(known), ())
        ours = of_the_package(model.mechanism)
        began, processor = time.perf_counter(), time.process_time()
        say = functools.partial(print, flush=True)
        found = rf.discover(model, of[TRAIN[0]], test, candidates=ours, progress=say)
        row["search"] = {
            "code": code,
            "verdict": str(found.verdict.value),
            "sentence": found.sentence,
            "effects": [f"{r.effect} at {r.port}" for r in found.rounds],
            "seconds": time.perf_counter() - began,
            "processor seconds": time.process_time() - processor,
            "before": {m: _rms(model.simulate(r)[:, 0], r) for m, r in others.items()},
            "others": {m: _rms(found.final.model.simulate(r)[:, 0], r) for m, r in others.items()},
        }
    return row


def arm(
    say: Callable[[str], None],
    rollouts: int,
    rows: list[dict[str, Any]],
    keep: Callable[[], None],
    code: str,
    search: Sequence[str] = (),
    workers: int = 1,
) -> None:
    """Computes one row per joint by `joint_row`.

    Args:
        say: Called with a line for each joint.
        rollouts: As for `joint_row`.
        rows: Earlier rows, completed in place.
        keep: Called after each joint, to store the rows.
        code: Digest of the code, stored with new results.
        search: Joints for which `rf.discover` is run too.
        workers: Number of processes among which the joints are divided.
    """
    known = {r["joint"]: r for r in rows}
    with ProcessPoolExecutor(min(workers, len(JOINTS)), multiprocessing.get_context("spawn")) as pool:
        waiting = {pool.submit(joint_row, j, rollouts, known.get(j), j in search, code): j for j in JOINTS}
        for done in as_completed(waiting):
            known[waiting[done]] = row = done.result()
            rows[:] = [known[j] for j in JOINTS if j in known]
            said = ", ".join(f"{n} {row[n]:.2f}" for n in ("goal", *row["takes"]))
            say(f"so101 {row['joint']}: {said} deg")
            keep()
