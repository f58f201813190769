"""Physical effects, one module for each family; `register` enters an effect in the catalogue.

To add one, derive a frozen dataclass from a kind (`base.py`), decorate it with `register`, and
import it here.
"""

from rotflex_jax.effects.actuation import (
    AmplifierSaturation,
    DeadZone,
    Delay,
    Lag,
    PeriodicDisturbance,
    Saturation,
    VoltageDrift,
    VoltageOffset,
)
from rotflex_jax.effects.angle import Cogging, Gravity
from rotflex_jax.effects.base import (
    CATALOG,
    Actuation,
    Drive,
    DryFriction,
    Effect,
    Force,
    Gear,
    Linear,
    Memory,
    Probe,
    Scale,
    Sensing,
    Stamp,
    register,
)
from rotflex_jax.effects.damping import QuadraticDrag, Viscous, ViscousAsymmetric
from rotflex_jax.effects.friction import Coulomb, CoulombAsymmetric, GearFriction, LoadFriction, Stribeck
from rotflex_jax.effects.gear import Backlash, ElasticBacklash
from rotflex_jax.effects.hysteresis import BoucWen, Dahl, LuGre
from rotflex_jax.effects.inertia import Inertia, SecondMode
from rotflex_jax.effects.learned import LearnedTorque
from rotflex_jax.effects.motor import (
    CurrentDrive,
    CurrentMeter,
    DutyMeter,
    Heating,
    Motor,
    PidServo,
    PositionLoop,
    PositionServo,
    TorqueSaturation,
)
from rotflex_jax.effects.sensors import (
    ChannelDelay,
    CrossTalk,
    EccentricEncoder,
    Rectifier,
    SensorBias,
    SensorCubic,
    SensorGain,
)
from rotflex_jax.effects.signals import MeasuredDisturbance
from rotflex_jax.effects.springs import CubicSpring, JointPlay, QuadraticSpring, Spring

__all__ = [
    # kinds, from which an effect of your own derives
    "Effect",
    "Linear",
    "Force",
    "DryFriction",
    "Memory",
    "Gear",
    "Actuation",
    "Sensing",
    "Stamp",
    "Scale",
    "Drive",
    "Probe",
    # catalogue
    "CATALOG",
    "register",
    # linear
    "Inertia",
    "Spring",
    "Viscous",
    "Motor",
    "CurrentDrive",
    "PositionLoop",
    "PositionServo",
    "PidServo",
    "CurrentMeter",
    "DutyMeter",
    "SecondMode",
    # dry friction
    "Coulomb",
    "CoulombAsymmetric",
    "Stribeck",
    "LoadFriction",
    "GearFriction",
    # force
    "QuadraticDrag",
    "ViscousAsymmetric",
    "CubicSpring",
    "QuadraticSpring",
    "Gravity",
    "Cogging",
    "JointPlay",
    "LearnedTorque",
    "MeasuredDisturbance",
    # gear
    "Backlash",
    "ElasticBacklash",
    # with memory
    "Dahl",
    "LuGre",
    "BoucWen",
    "Heating",
    "TorqueSaturation",
    # actuation
    "DeadZone",
    "Saturation",
    "AmplifierSaturation",
    "VoltageOffset",
    "VoltageDrift",
    "PeriodicDisturbance",
    "Delay",
    "Lag",
    # sensing
    "SensorBias",
    "SensorGain",
    "SensorCubic",
    "Rectifier",
    "EccentricEncoder",
    "CrossTalk",
    "ChannelDelay",
]
