"""The flexible joint of the measurements, with smooth friction and cubic spring, and its parameters for C."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from rotflex_jax.effects import Coulomb, CubicSpring
from rotflex_jax.effects.base import Force, Probe, Scalar, Scale
from rotflex_jax.parameters import parameter

Ts = 1e-3
RESISTANCE, INDUCTANCE, CONSTANT, GEAR = 2.6, 0.18e-3, 0.00767, 70.0
# Hub inertia, arm inertia, stiffness, motor gain, motor damping, hub damping, joint damping, cubic
# stiffness, friction level, width of its tanh.
GAIN = CONSTANT * GEAR / RESISTANCE
TRUE = np.array([0.0021, 0.0059, 1.61, GAIN, GAIN * CONSTANT * GEAR, 0.005, 0.004, 5.0, 0.05, 0.05])
MOTOR = np.array([CONSTANT * GEAR, CONSTANT * GEAR, RESISTANCE, INDUCTANCE])
MOVED = (0, 1, 2, 5, 6, 7, 8, 9)
"""Indices of the eight parameters that are fitted; those of the motor are known."""


@dataclasses.dataclass(frozen=True)
class SmoothFriction(Force):
    """Friction without sticking. tau = -level tanh(speed / width)"""

    name: ClassVar[str] = "smooth_friction"
    title: ClassVar[str] = "friction without sticking"
    equation: ClassVar[str] = "tau = -level * tanh(speed / width)"
    amplitudes: ClassVar[tuple[str, ...]] = ("level",)
    searched: ClassVar[tuple[str, ...]] = ()

    level: float = parameter(0.05, unit="N m", lower=0.0, meaning="friction torque")
    width: float = parameter(0.05, unit="rad/s", lower=1e-4, meaning="speed over which it changes sign")

    def force(self, position: Scalar, speed: Scalar, voltage: Scalar) -> Scalar:
        """Torque [N m]."""
        return -self.level * jnp.tanh(speed / self.width)

    @classmethod
    def probes(cls, scale: Scale) -> list[list[Probe]]:
        """None."""
        return []


@dataclasses.dataclass(frozen=True)
class Hardening(CubicSpring):
    """A cubic spring known to harden, so that its logarithm can be fitted."""

    name: ClassVar[str] = "hardening_spring"

    stiffness: float = parameter(5.0, unit="N m/rad^3", lower=0.0, meaning="cubic stiffness")


def voltage(N: int, seed: int = 0) -> np.ndarray:
    """Voltage with steps of random height between -6 V and 6 V, each 0.05 s long [V]."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-6, 6, -(-N // 50)), 50)[:N]


def multisine(N: int) -> np.ndarray:
    """Sum of five sines below 8 Hz, 2.1 V root mean square and up to 5.1 V in the first 4 s [V]."""
    t = np.arange(N) * Ts
    return 3 / 2.2 * np.sum([np.sin(2 * np.pi * f * t + f * f) for f in (0.5, 1.3, 2.9, 4.7, 7.1)], axis=0)


def linear(current: bool = False) -> Any:
    """The joint without its nonlinear effects."""
    return rf.joints.paper(
        hub_damping=TRUE[5], joint_damping=TRUE[6], inductance=INDUCTANCE if current else None
    )


def smooth(current: bool = False, p: np.ndarray = TRUE) -> Any:
    """The joint with smooth friction and cubic spring; eight parameters are free."""
    joint = rf.joints.paper(
        hub_inertia=p[0],
        arm_inertia=p[1],
        stiffness=p[2],
        hub_damping=p[5],
        joint_damping=p[6],
        inductance=INDUCTANCE if current else None,
    )
    joint = joint + Hardening(at="joint", stiffness=p[7]) + SmoothFriction(at="hub", level=p[8], width=p[9])
    return joint.release("arm.inertia.inertia").trust("hub.motor.torque_constant")


def dry(current: bool = False) -> Any:
    """The joint with dry friction, which sticks, and the cubic spring."""
    return linear(current) + Hardening(at="joint", stiffness=TRUE[7]) + Coulomb(at="hub", level=TRUE[8])
