"""One figure for each effect: its equation at the values an effect has by default."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotflex_jax import effects as fx
from rotflex_jax.effects.base import Actuation, DryFriction, Effect, Force, Linear, Memory, Sensing
from rotflex_jax.runtime.xla import double_precision
from rotflex_jax.text.colours import FINAL, MUTED
from rotflex_jax.text.plotting import blank, styled

# At rest friction holds with any torque of this band.
HELD = {"color": FINAL, "alpha": 0.25, "lw": 7, "solid_capstyle": "butt"}
LINE = {"color": FINAL, "lw": 1.8}
OTHER = {"color": MUTED, "lw": 1.2, "ls": "--"}
# Ranges over which an equation is drawn where one of its own parameters says how far it reaches.
WIDE = {"joint_play": 0.02, "cogging": math.pi / 2, "gravity": math.pi, "cubic_spring": 0.2}
Draw = Callable[[Axes, Effect], None]


@styled
def figure(cls: type[Effect]) -> Figure:
    """The figure of an effect class."""
    effect = cls(at=(*cls.ports, "hub")[0])
    if cls.amplitudes and not any(effect.values[name] for name in cls.amplitudes):
        # Off by default: drawn at a usual size.
        effect = effect.replace(**{name: cls.declared()[name].typical for name in cls.amplitudes})
    if cls is fx.LearnedTorque:
        effect = fx.LearnedTorque("hub", count=(1, 10), speed=(-5.0, 5.0), bend=0.3)
    drawing = blank(5.6, 2.9)
    ax = drawing.subplots()
    draw = DRAWINGS.get(cls) or next((d for kind, d in KINDS.items() if issubclass(cls, kind)), _force)
    with double_precision():
        draw(ax, effect)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best")
    return drawing


def _labels(ax: Axes, x: str, y: str) -> None:
    ax.set(xlabel=x, ylabel=y)
    ax.axhline(0, color=MUTED, lw=0.6, zorder=1)
    ax.axvline(0, color=MUTED, lw=0.6, zorder=1)


def _friction(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, DryFriction)
    speed = np.linspace(1e-6, 1.0, 200)
    forwards = np.array([float(effect.limit(0.0, v, 1.0)) for v in speed])
    backwards = np.array([float(effect.limit(0.0, v, -1.0)) for v in speed])
    if type(effect) is fx.CoulombAsymmetric:
        backwards = 0.5 * backwards
    ax.plot([0, 0], [-forwards[0], backwards[0]], **HELD, label="at rest: any torque between")
    ax.plot(speed, -forwards, **LINE, label="while it slides")
    ax.plot(-speed, backwards, **LINE)
    _labels(ax, "speed [rad/s]", "torque on the port [N m]")


def _load_friction(ax: Axes, effect: Effect) -> None:
    """Level against motion each way, over the torque through the gear."""
    assert isinstance(effect, fx.LoadFriction | fx.GearFriction)
    load = np.linspace(-0.5, 0.5, 201)
    for way, look, words in ((1.0, LINE, "forwards"), (-1.0, OTHER, "backwards")):
        ax.plot(load, np.asarray(effect.limit(0.0, 0.0, way, load)), **look, label=f"turning {words}")
    whose = "torque of the motor" if isinstance(effect, fx.GearFriction) else "torque through the gear"
    _labels(ax, f"{whose} [N m]", "level of friction [N m]")


def _saturation(ax: Axes, effect: Effect) -> None:
    """What is left of the torque, over what the current would give in proportion."""
    assert isinstance(effect, fx.TorqueSaturation)
    current = np.linspace(-3.0, 3.0, 201)
    ax.plot(current, current, **OTHER, label="in proportion")
    ax.plot(current, current + np.asarray(effect.force(0.0, 0.0, current)), **LINE, label="given")
    _labels(ax, "torque in proportion to the current [N m]", "torque of the motor [N m]")


def _force(ax: Axes, effect: Effect) -> None:
    """Over the position or the speed, whichever the equation depends on."""
    assert isinstance(effect, Force)
    reach = WIDE.get(effect.name, 0.3)
    x = np.linspace(-reach, reach, 400)
    over_position = np.asarray(effect.force(x, 0.0, 0.0)) + 0.0 * x
    if np.ptp(over_position) > 0:
        ax.plot(x, over_position, **LINE)
        _labels(ax, "position [rad]", "torque on the port [N m]")
        return
    x = np.linspace(-5.0, 5.0, 400)
    ax.plot(x, np.asarray(effect.force(0.0, x, 0.0)), **LINE)
    _labels(ax, "speed [rad/s]", "torque on the port [N m]")


def _over_signal(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, fx.MeasuredDisturbance)
    signal = np.linspace(-20.0, 20.0, 101)
    ax.plot(signal, np.asarray(effect.force(0.0, 0.0, signal)), **LINE)
    _labels(ax, "signal [its unit]", "torque on the port [N m]")


def _loop(ax: Axes, effect: Effect) -> None:
    """Torque over position while the port swings to and fro, first wide, then narrow."""
    assert isinstance(effect, Memory)
    size = getattr(effect, "width", getattr(effect, "presliding", 0.003))
    t = np.linspace(0, 3.25, 3251)
    swing = np.where(t < 2.25, 4.0, 1.0) * size
    position = np.where(t < 2.25, swing * np.sin(2 * np.pi * t), 3.0 * size + swing * np.sin(2 * np.pi * t))
    speed = np.gradient(position, t)
    speed[np.abs(np.diff(position, append=position[-1])) > 0.5 * size] = 0.0
    torque = _with_memory(effect, t, position, speed, 0.0 * t)
    ax.plot(1e3 * position, torque, color=FINAL, lw=1.3)
    _labels(ax, "position [mrad]", "torque on the port [N m]")


def _with_memory(effect: Memory, t: np.ndarray, *signals: np.ndarray) -> np.ndarray:
    """Torque of an effect with memory along a motion: position, speed, drive."""

    def step(z: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        return z + (t[1] - t[0]) * effect.flow(z, *now), effect.force(z, *now)

    return np.asarray(jax.lax.scan(step, jnp.asarray(effect.initial()), tuple(map(jnp.asarray, signals)))[1])


def _heating(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, fx.Heating)
    t = np.linspace(0, 120, 1200)
    for torque, look in ((0.2, LINE), (0.1, OTHER)):
        lost = -1e3 * _with_memory(effect, t, 0.0 * t, 0.0 * t, torque + 0.0 * t)
        ax.plot(t, lost, **look, label=f"cold motor gives {torque:g} N m")
    _labels(ax, "time under constant voltage, at rest [s]", "lost torque [mN m]")


def _actuation(ax: Axes, effect: Effect) -> None:
    """Voltage at the motor over the command."""
    assert isinstance(effect, Actuation)
    reach = {"saturation": 10.0, "amplifier_saturation": 20.0}.get(effect.name, 0.4)
    u = np.linspace(-reach, reach, 401)
    ax.plot(u, u, **OTHER, label="without it")
    ax.plot(u, np.asarray(effect.drive(jnp.asarray(u), 0.001)), **LINE, label="with it")
    _labels(ax, "command [V]", "voltage at the motor [V]")


def _in_time(ax: Axes, effect: Effect) -> None:
    """Voltage at the motor over time, for a pulse."""
    assert isinstance(effect, Actuation)
    Ts = 0.0005
    t = np.arange(0, 0.06, Ts)
    u = np.where((t >= 0.01) & (t < 0.03), 1.0, 0.0)
    ax.plot(1e3 * t, u, **OTHER, drawstyle="steps-post", label="command")
    v = np.asarray(effect.drive(jnp.asarray(u), Ts))
    ax.plot(1e3 * t, v, **LINE, drawstyle="steps-post", label="at the motor")
    _labels(ax, "time [ms]", "voltage [V]")


def _drift(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, Actuation)
    t = np.linspace(0, 60, 601)
    ax.plot(t, 1e3 * np.asarray(effect.drive(jnp.zeros(len(t)), float(t[1]))), **LINE)
    _labels(ax, "time since the first sample [s]", "added voltage [mV]")


def _disturbance(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, Actuation)
    t = np.linspace(0, 3, 601)
    ax.plot(t, 1e3 * np.asarray(effect.drive(jnp.zeros(len(t)), float(t[1]))), **LINE)
    _labels(ax, "time since the first sample [s]", "added voltage [mV]")


def _sensing(ax: Axes, effect: Effect) -> None:
    """Reading over the true value."""
    assert isinstance(effect, Sensing)
    value = np.linspace(-0.25, 0.25, 400)
    ax.plot(value, value, **OTHER, label="without it")
    ax.plot(value, np.asarray(effect.measure(value)) + 0.0 * value, **LINE, label="with it")
    _labels(ax, "true value [rad]", "reading [rad]")


def _runout(ax: Axes, effect: Effect) -> None:
    """What the reading adds, over the angle."""
    assert isinstance(effect, Sensing)
    value = np.linspace(-2 * math.pi, 2 * math.pi, 600)
    ax.plot(value, 1e3 * (np.asarray(effect.measure(value)) - value), **LINE)
    _labels(ax, "true value [rad]", "error of the reading [mrad]")


def _cross_talk(ax: Axes, effect: Effect) -> None:
    """Reading while the true value is zero, over the other channel."""
    assert isinstance(effect, Sensing)
    other = np.linspace(-3.0, 3.0, 100)
    ax.plot(other, 1e3 * np.asarray(effect.measure(0.0 * other, other)), **LINE)
    _labels(ax, "true value at the other sensor [rad]", "reading of a value of zero [mrad]")


def _late(ax: Axes, effect: Effect) -> None:
    """A true value that starts to swing, and its reading."""
    assert isinstance(effect, fx.ChannelDelay)
    stamp = effect.stamp()
    t = np.linspace(0.0, 0.06, 1201)
    swing = 2 * math.pi * 25
    value, speed = 0.1 * (1 - np.cos(swing * t)), 0.1 * swing * np.sin(swing * t)
    states = scipy.signal.lsim(
        (np.array(stamp.own), np.array(stamp.from_speed)[:, None], np.eye(2), np.zeros((2, 1))), speed, t
    )[1]
    ax.plot(1e3 * t, value, **OTHER, label="true value")
    ax.plot(1e3 * t, effect.measure(value, tuple(states.T), 0), **LINE, label="reading")
    _labels(ax, "time [ms]", "angle [rad]")


def _stamped(x: str, entry: str) -> Draw:
    """A linear effect: torque over what its one entry multiplies."""

    def draw(ax: Axes, effect: Effect) -> None:
        assert isinstance(effect, Linear)
        stamp = effect.stamp()
        slope = float(getattr(stamp, entry)) * (1.0 if entry == "drive" else -1.0)
        reach = {"stiffness": 0.2, "drive": 5.0}.get(entry, 5.0)
        ax.plot([-reach, reach], [-reach * slope, reach * slope], **LINE)
        _labels(ax, x, "torque on the port [N m]")

    return draw


def _motor(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, fx.Motor)
    stamp = effect.stamp()
    speed = np.linspace(0, 8, 50)
    for voltage, look in ((4.0, LINE), (2.0, OTHER)):
        torque = float(stamp.drive) * voltage - float(stamp.damping) * speed
        ax.plot(speed, torque, **look, label=f"{voltage:g} V")
    _labels(ax, "speed of the port [rad/s]", "torque on the port [N m]")


def _servo(ax: Axes, effect: Effect) -> None:
    """Torque at rest over the distance to the goal."""
    assert isinstance(effect, fx.PositionLoop)
    error = np.linspace(-1.5, 1.5, 601)
    for gain, look in ((effect.gain, LINE), (effect.gain / 4, OTHER)):
        servo = effect.replace(gain=gain)
        integral = (0.0,) if isinstance(servo, Memory) else ()
        torque = servo.stamp().stiffness * error + np.asarray(servo.force(*integral, -error, 0.0, 0.0))
        ax.plot(error, torque, **look, label=f"gain {gain:g}")
    _labels(ax, "goal less position, at rest [rad]", "torque on the port [N m]")


def _meter(ax: Axes, effect: Effect) -> None:
    """The reading after a jump of what it shows."""
    assert isinstance(effect, Memory)
    time = effect.values["time"]
    t = np.linspace(0, 5 * time, 200)
    ax.plot(1e3 * t, np.where(t > 0, 1.0, 0.0), **OTHER, label=f"{effect.shows} of the motor")
    ax.plot(1e3 * t, 1 - np.exp(-t / time), **LINE, label="reading")
    unit = {"current": "A", "duty": "-"}[effect.shows]
    _labels(ax, "time [ms]", f"{effect.shows} [{unit}]")


def _mode(ax: Axes, effect: Effect) -> None:
    """How heavy the part is to the port, over frequency."""
    assert isinstance(effect, fx.SecondMode)
    f = np.geomspace(1, 100, 800)
    r = f / float(effect.frequency)
    loss = 2j * float(effect.damping) * r
    felt = float(effect.inertia) * (1 + loss) / (1 - r**2 + loss)
    ax.loglog(f, 1e3 * np.abs(felt), **LINE)
    ax.axhline(1e3 * float(effect.inertia), **OTHER, label="its own inertia")
    ax.set(xlabel="frequency [Hz]", ylabel="inertia felt [g m²]")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")


def _gear(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, fx.Backlash)
    gap = 1e3 * float(effect.gap)
    ax.plot([-gap, gap], [0, 0], **LINE, label="rotor flies: no torque")
    ax.plot([gap, gap], [0, 0.1], color=FINAL, lw=3.5, label="teeth touch")
    ax.plot([-gap, -gap], [-0.1, 0], color=FINAL, lw=3.5)
    ax.set_xlim(-1.6 * gap, 1.6 * gap)
    _labels(ax, "rotor against port [mrad]", "torque passed on [N m]")


def _elastic_gear(ax: Axes, effect: Effect) -> None:
    """Torque over the angle of the rotor against the port, slowly and while the teeth approach each other."""
    assert isinstance(effect, fx.ElasticBacklash)
    r = np.linspace(-1.3, 1.3, 800) * float(effect.gap)
    depth, side = np.abs(r) - float(effect.gap), np.sign(r)
    for speed, look, words in ((0.0, LINE, "slowly"), (1.0, OTHER, "teeth approach at 1 rad/s")):
        push = float(effect.stiffness) * depth + float(effect.damping) * speed
        ax.plot(1e3 * r, np.where(depth > 0, push, 0.0) * side, **look, label=words)
    _labels(ax, "rotor against port [mrad]", "torque passed on [N m]")


def _splines(ax: Axes, effect: Effect) -> None:
    assert isinstance(effect, fx.LearnedTorque)
    speed = np.linspace(-5.5, 5.5, 800)
    for k, spline in enumerate(np.asarray(effect.splines(0.0 * speed, speed)[1])):
        ax.plot(speed, spline, **(LINE if k % 2 else OTHER))
    _labels(ax, "speed [rad/s]", "value of each spline [-]")


KINDS: dict[type, Draw] = {
    DryFriction: _friction,
    Memory: _loop,
    Actuation: _actuation,
    Sensing: _sensing,
    Force: _force,
}
DRAWINGS: dict[type, Draw] = {
    fx.Delay: _in_time,
    fx.Lag: _in_time,
    fx.VoltageDrift: _drift,
    fx.PeriodicDisturbance: _disturbance,
    fx.Heating: _heating,
    fx.Backlash: _gear,
    fx.ElasticBacklash: _elastic_gear,
    fx.LoadFriction: _load_friction,
    fx.GearFriction: _load_friction,
    fx.TorqueSaturation: _saturation,
    fx.EccentricEncoder: _runout,
    fx.CrossTalk: _cross_talk,
    fx.ChannelDelay: _late,
    fx.Motor: _motor,
    fx.CurrentDrive: _stamped("command [V]", "drive"),
    fx.PositionServo: _servo,
    fx.PidServo: _servo,
    fx.CurrentMeter: _meter,
    fx.DutyMeter: _meter,
    fx.SecondMode: _mode,
    fx.Inertia: _stamped("acceleration [rad/s²]", "inertia"),
    fx.Spring: _stamped("position [rad]", "stiffness"),
    fx.Viscous: _stamped("speed [rad/s]", "damping"),
    fx.LearnedTorque: _splines,
    fx.MeasuredDisturbance: _over_signal,
}
