"""Physical effects. One file holds one effect or a close family; each is entered by `register`.

To add one, derive a frozen dataclass from a kind (`kinds.py`), decorate it with `register`, and
import it here.
"""

from rotflex_jax.effects.backlash import Backlash
from rotflex_jax.effects.bouc_wen import BoucWen
from rotflex_jax.effects.catalogue import CATALOG, register
from rotflex_jax.effects.cogging import Cogging
from rotflex_jax.effects.coulomb import Coulomb, CoulombAsymmetric
from rotflex_jax.effects.cubic_spring import CubicSpring
from rotflex_jax.effects.current_drive import CurrentDrive
from rotflex_jax.effects.dahl import Dahl
from rotflex_jax.effects.dead_zone import DeadZone
from rotflex_jax.effects.delay import Delay
from rotflex_jax.effects.gravity import Gravity
from rotflex_jax.effects.heating import Heating
from rotflex_jax.effects.inertia import Inertia
from rotflex_jax.effects.joint_play import JointPlay
from rotflex_jax.effects.kinds import (
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
)
from rotflex_jax.effects.lag import Lag
from rotflex_jax.effects.learned import LearnedTorque
from rotflex_jax.effects.lugre import LuGre
from rotflex_jax.effects.motor import Motor
from rotflex_jax.effects.quadratic_drag import QuadraticDrag
from rotflex_jax.effects.quadratic_spring import QuadraticSpring
from rotflex_jax.effects.rectifier import Rectifier
from rotflex_jax.effects.saturation import Saturation
from rotflex_jax.effects.second_mode import SecondMode
from rotflex_jax.effects.sensor_bias import SensorBias
from rotflex_jax.effects.sensor_cubic import SensorCubic
from rotflex_jax.effects.sensor_gain import SensorGain
from rotflex_jax.effects.spring import Spring
from rotflex_jax.effects.stribeck import Stribeck
from rotflex_jax.effects.viscous import Viscous
from rotflex_jax.effects.viscous_asymmetric import ViscousAsymmetric
from rotflex_jax.effects.voltage_drift import VoltageDrift
from rotflex_jax.effects.voltage_offset import VoltageOffset

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
    "SecondMode",
    # dry friction
    "Coulomb",
    "CoulombAsymmetric",
    "Stribeck",
    # force
    "QuadraticDrag",
    "ViscousAsymmetric",
    "CubicSpring",
    "QuadraticSpring",
    "Gravity",
    "Cogging",
    "JointPlay",
    "LearnedTorque",
    # gear
    "Backlash",
    # with memory
    "Dahl",
    "LuGre",
    "BoucWen",
    "Heating",
    # actuation
    "DeadZone",
    "Saturation",
    "VoltageOffset",
    "VoltageDrift",
    "Delay",
    "Lag",
    # sensing
    "SensorBias",
    "SensorGain",
    "SensorCubic",
    "Rectifier",
]
