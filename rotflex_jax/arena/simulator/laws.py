"""From an effect's name, port and parameters to the plant's tables of coefficients."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rotflex_jax.arena.simulator import tables as t
from rotflex_jax.arena.simulator.tables import Laws

Place = tuple[str, str]
"""An effect's name and its port: ``("coulomb", "hub")``."""

# Which coefficients a parameter sets. Friction has one column per direction of motion.
_TORQUE: dict[str, dict[str, tuple[int, ...]]] = {
    "coulomb": {"level": (t.FRICTION_PLUS, t.FRICTION_MINUS)},
    "coulomb_asymmetric": {"level_plus": (t.FRICTION_PLUS,), "level_minus": (t.FRICTION_MINUS,)},
    "stribeck": {
        "level": (t.FRICTION_PLUS, t.FRICTION_MINUS),
        "excess": (t.STRIBECK,),
        "speed": (t.STRIBECK_SPEED,),
    },
    "viscous": {"coefficient": (t.VISCOUS,)},
    "quadratic_drag": {"coefficient": (t.DRAG,)},
    "quadratic_spring": {"coefficient": (t.QUADRATIC,)},
    "cubic_spring": {"coefficient": (t.CUBIC,)},
    "gravity": {"moment": (t.GRAVITY,), "phase": (t.PHASE,)},
    "cogging": {"amplitude": (t.COGGING,), "phase": (t.COGGING_PHASE,), "periods": (t.PERIODS,)},
    "joint_play": {"play": (t.PLAY,)},
    "patchy_friction": {"level": (t.PATCHY,), "share": (t.PATCHY_SHARE,)},
    "drifting_spring": {"drift": (t.DRIFT,)},
    "shaking": {"amplitude": (t.SHAKE,), "frequency": (t.SHAKE_RATE,)},
    "push": {"amplitude": (t.PUSH,), "centre": (t.PUSH_AT,), "width": (t.PUSH_WIDTH,)},
}
_VOLTAGE: dict[str, dict[str, tuple[int, ...]]] = {
    "dead_zone": {"width": (t.DEAD_PLUS, t.DEAD_MINUS)},
    "saturation": {"limit": (t.LIMIT,)},
    "voltage_offset": {"offset": (t.OFFSET,)},
    "lag": {"time": (t.LAG,)},
    "delay": {"time": (t.DELAY,)},
}
_MOTOR: dict[str, dict[str, int]] = {
    "heating": {"rate": t.HEAT_RATE, "time": t.COOLING},
    "backlash": {"play": t.GEAR_PLAY},
    "worm": {"loss": t.WEAKENING, "speed": t.WEAKENING_SPEED},
}
_SENSORS: dict[str, dict[str, int]] = {
    "sensor_bias": {"bias": t.BIAS},
    "sensor_gain": {"error": t.GAIN_ERROR},
    "sensor_cubic": {"cubic": t.CUBIC_ERROR},
    "rectifier": {"loss": t.BACKWARD_LOSS},
}
_HYSTERESIS: dict[str, dict[str, int]] = {
    "bouc_wen": {"level": t.LEVEL, "width": t.WIDTH, "beta": t.BETA},
    "dahl": {"level": t.LEVEL, "presliding": t.WIDTH},
    "lugre": {
        "level": t.LEVEL,
        "rise": t.RISE,
        "speed": t.RISE_SPEED,
        "presliding": t.WIDTH,
        "damping": t.DAMPING,
    },
    "slack_cable": {"level": t.LEVEL, "width": t.WIDTH, "time": t.FADING},
}


def _entry(effect: str, name: str, value: float) -> float:
    """Coefficient for a parameter: times become rates, frequencies become angular frequencies."""
    if (effect, name) in {("heating", "time"), ("slack_cable", "time")}:
        return 1 / value
    if (effect, name) == ("shaking", "frequency"):
        return 2 * np.pi * value
    return value


def _row(effect: str, port: str, values: Mapping[str, float]) -> np.ndarray:
    """A row of the hysteresis table."""
    row = np.zeros(t.HYSTERESIS)
    row[t.AT], row[t.BETA], row[t.RISE_SPEED] = t.PORTS[port], 1.0, 1.0
    for name, value in values.items():
        row[_HYSTERESIS[effect][name]] = _entry(effect, name, value)
    return row


def laws(effects: Mapping[Place, Mapping[str, float]]) -> Laws:
    """The plant's coefficient tables with the given effects.

    Coefficients that several effects share, such as friction levels at a port, add up; a limit replaces the
    default.

    Args:
        effects: parameters of every effect by name and port.

    Returns:
        Tables for `simulator.plant.simulate`.
    """
    made, rows = Laws(), []
    for (effect, port), values in effects.items():
        if effect in _HYSTERESIS:
            rows.append(_row(effect, port, values))
        elif effect == "second_mode":
            own = [values["inertia"], 2 * np.pi * values["frequency"], values["damping"]]
            made.modes[t.PORTS[port]] = own
        else:
            for name, value in values.items():
                entry = _entry(effect, name, value)
                if effect in _TORQUE:
                    made.torque[t.PORTS[port], list(_TORQUE[effect][name])] += entry
                elif effect in _VOLTAGE:
                    at = list(_VOLTAGE[effect][name])
                    made.volts[at] = entry if at == [t.LIMIT] else made.volts[at] + entry
                elif effect in _MOTOR:
                    made.motor[_MOTOR[effect][name]] += entry
                else:
                    made.sensors[t.CHANNELS[port], _SENSORS[effect][name]] += entry
    if rows:
        return Laws(made.torque, made.volts, np.array(rows), made.modes, made.motor, made.sensors)
    return made
