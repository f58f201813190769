"""Export of a servo to a parameter file of Better Actuator Models (BAM), for users of MuJoCo and Isaac."""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.checks import number, shown
from rotflex_jax.effects import (
    Coulomb,
    Delay,
    GearFriction,
    Gravity,
    Inertia,
    LoadFriction,
    PositionLoop,
    Stribeck,
    Viscous,
)
from rotflex_jax.errors import InputError
from rotflex_jax.export.certificate import Exported, Subject, label
from rotflex_jax.joints.servos import FREE_FALL
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model

# Largest step of the simulation with the equations of BAM, for the certificate [s].
_LONGEST_STEP = 1e-4

_MODELS = {(False, False): "m1", (True, False): "m2", (False, True): "m3", (True, True): "m4"}


def to_bam(
    model: Mechanism | Model,
    Ts: float = 0.005,
    actuator: str = "xl330",
    length: float = 0.1,
    u: Real[np.ndarray, " N"] | Sequence[float] | None = None,
) -> Exported:
    """A servo as a parameter file of Better Actuator Models, with its certificate.

        motor = kt/R (supply duty - kt q'),   friction up to friction_base + friction_viscous |q'| + ...

    The friction model is M1 for Coulomb and viscous friction, M2 with Stribeck friction, M3 with friction
    that grows with the load, and M4 with both. BAM separates the pendulum from the servo: the pendulum has
    the weight and inertia of a mass at `length`, the rest of the inertia is the servo's (`armature`). BAM
    keeps gain, supply and limit of the duty in the class of the actuator, not in the file. The certificate
    lists them with their values.

    Args:
        model: Mechanism of one coordinate with a `PositionLoop`, or a Model.
        Ts: Sampling period of the certificate's input [s].
        actuator: Name of the class of the actuator in BAM.
        length: Length of the pendulum [m], if the servo lifts a weight.
        u: Input of the certificate: goals [rad]; None for three sines with rests.

    Returns:
        The text of the JSON file, with a certificate that compares a simulation by the equations of BAM at
        fine steps with the toolkit. JSON has no comments, so the file does not contain the certificate.

    Raises:
        InputError: The model has no servo, or less inertia than the pendulum; `Ts` is no sampling period, or
            `u` no signal.

    Source: M. Duclusaud, G. Passault, V. Padois and O. Ly, Extended friction models for the physics
    simulation of servo actuators, 2024, arXiv 2410.08650; parameter files of the repository Rhoban/bam.
    """
    subject = Subject.of(model, Ts, u).of_motion()
    length = number(length, "length", above=0, unit="m", example="0.1")
    if not (isinstance(actuator, str) and actuator.strip()):
        raise InputError(
            f"The actuator of BAM needs a name, but {shown(actuator)} was given; give for instance 'xl330'."
        )
    servo = _servo(subject.mechanism)
    content, left_out, approximated = _parameters(subject.mechanism, servo, actuator, length)
    y = run_by_bam_equations(content, servo, _weight(subject.mechanism), length, subject.u, subject.Ts)
    by = "the equations of BAM, stepped finely,"
    certificate = subject.certificate("BAM", by, y, left_out, approximated)
    return Exported(json.dumps(content, indent=2) + "\n", certificate)


def _servo(mechanism: Mechanism) -> PositionLoop:
    servos = [e for e in mechanism.effects if isinstance(e, PositionLoop)]
    if len(servos) == 1 and mechanism.ports and len(mechanism.coordinates) == 1 and mechanism.channels:
        return servos[0]
    raise InputError(
        f"BAM describes one servo, but the mechanism has {len(mechanism.coordinates)} coordinates and "
        f"{len(servos)} motors under a position loop; give for instance rotflex_jax.joints.xl330_pendulum()."
    )


def _weight(mechanism: Mechanism) -> tuple[float, float]:
    weights = [e for e in mechanism.effects if isinstance(e, Gravity)]
    return sum(w.sine for w in weights), sum(w.cosine for w in weights)


def _parameters(
    mechanism: Mechanism, servo: PositionLoop, actuator: str, length: float
) -> tuple[dict[str, Any], list[str], list[str]]:
    sine, cosine = _weight(mechanism)
    weight = math.hypot(sine, cosine)
    inertia = sum(e.inertia for e in mechanism.effects if isinstance(e, Inertia))
    pendulum = weight * length / FREE_FALL
    if not inertia > pendulum:
        raise InputError(
            f"The inertia of the servo with its pendulum is {inertia:.6g} kg m^2, but a weight of "
            f"{weight:.6g} N m at {length:g} m has {pendulum:.6g} kg m^2; give the length of the pendulum."
        )
    content: dict[str, Any] = {
        "kt": servo.torque_constant,
        "R": servo.resistance,
        "armature": inertia - pendulum,
        "q_offset": math.atan2(cosine, sine) if weight else 0.0,
        "friction_base": 0.0,
        "friction_viscous": 0.0,
    }
    scale = f"gain {servo.gain:g} times {servo.gain_scale:.6g} 1/rad"
    left_out = [
        f"the firmware, which the class {actuator} of BAM knows: {scale}, supply {servo.supply:g} V, "
        f"limit {servo.limit:g}"
    ]
    approximated: list[str] = []
    if servo.period:
        left_out.append(f"half a control period of {servo.period:g} s by which the firmware acts late")
    left_out += [f"{label(servo)}: {part}" for part in servo.further_parts]
    falls = loads = False
    for effect in mechanism.effects:
        if isinstance(effect, Coulomb):
            content["friction_base"] += effect.level
        elif isinstance(effect, Viscous):
            content["friction_viscous"] += effect.coefficient
        elif isinstance(effect, Stribeck) and not falls:
            falls = True
            content["friction_base"] += effect.level
            content |= {"friction_stribeck": effect.excess, "dtheta_stribeck": effect.speed, "alpha": 2.0}
        elif isinstance(effect, LoadFriction | GearFriction) and not loads:
            loads = True
            if isinstance(effect, GearFriction):
                driving = driven = effect.share
            else:
                driving, driven = effect.driving, effect.driven
            content["friction_base"] += effect.level
            # The load in BAM is the sum of the torques on both sides of the gear, here it is their mean.
            content["load_friction_base"] = (driving + driven) / 4
            if driving != driven:
                approximated.append(f"{label(effect)}: the mean of both shares")
            if effect.rest_share == 0:
                approximated.append(f"{label(effect)}: of the sum of both sides, not of the motor alone")
        elif isinstance(effect, Delay) and "command_delay" not in content:
            content["command_delay"] = effect.time
        elif not isinstance(effect, PositionLoop | Inertia | Gravity):
            left_out.append(f"{label(effect)}: {effect.equation}")
    if falls and loads:
        content["load_friction_stribeck"] = 0.0
    content |= {"model": _MODELS[falls, loads], "actuator": actuator}
    return content, left_out, approximated


def run_by_bam_equations(
    parameters: dict[str, Any],
    servo: PositionLoop,
    weight: tuple[float, float],
    length: float,
    u: Real[np.ndarray, " N"] | Sequence[float],
    Ts: float,
) -> Float[np.ndarray, "N 1"]:
    """Angle of the servo by the equations of BAM, from rest at zero.

        inertia q'' = motor + load - clip(torque that stops the servo within the step, -budget, budget)

    Args:
        parameters: Contents of a parameter file.
        servo: Position loop of the servo, for its firmware and supply.
        weight: Sine and cosine amplitudes of the weight [N m].
        length: Length of the pendulum [m].
        u: Goals, held over each sample [rad].
        Ts: Sampling period [s].
    """
    p = parameters
    steps = max(1, math.ceil(Ts / _LONGEST_STEP - 1e-9))
    h, pull = Ts / steps, math.hypot(*weight)
    inertia = p["armature"] + pull * length / FREE_FALL
    late = p.get("command_delay", 0.0) / h
    goals = np.repeat(np.asarray(u, float), steps)
    goals = goals[np.maximum(np.arange(len(goals)) - round(late), 0)].tolist()
    q = dq = 0.0
    y = np.zeros((len(goals) // steps, 1))
    for k, goal in enumerate(goals):
        if k % steps == 0:
            y[k // steps, 0] = q
        duty = min(max(servo.gain * servo.gain_scale * (goal - q), -servo.limit), servo.limit)
        motor = p["kt"] / p["R"] * (servo.supply * duty - p["kt"] * dq)
        load = -pull * math.sin(q + p["q_offset"])
        gear = abs(load - motor)
        share = math.exp(-((abs(dq) / p["dtheta_stribeck"]) ** p["alpha"])) if "alpha" in p else 0.0
        budget = (
            p["friction_base"] + p["friction_viscous"] * abs(dq) + share * p.get("friction_stribeck", 0.0)
        )
        budget += gear * (p.get("load_friction_base", 0.0) + share * p.get("load_friction_stribeck", 0.0))
        stop = inertia / h * dq + motor + load
        acceleration = (motor + load - math.copysign(min(abs(stop), budget), stop)) / inertia
        dq += acceleration * h
        q += dq * h
    return y
