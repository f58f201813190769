"""The effects as columns of generalised torques along a motion.

An effect with a state of its own (hysteresis, a lag, a second mode, heating of the motor) enters with this
state, computed along the measured motion and voltage. An error ``d(q)`` of a sensor enters as the torque that
it causes in the balance of the joint, ``M d'' - M A (d, d')``. Two effects have no columns: play in the gear,
since the motion of the rotor out of contact is not measured, and a drift of the voltage.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.signal import cont2discrete, dlsim, lfilter, lfilter_zi

from rotflex_jax.arena.rivals.motion import PORTS, Motion, Values
from rotflex_jax.arena.simulator.laws import Place

SPEEDS = (0.05, 0.15, 0.4, 1.0)
PERIODS = (4.0, 6.0, 8.0, 12.0)
PRESLIDING = (0.004, 0.01, 0.03)
PLAYS = (0.003, 0.006, 0.012)
WIDTHS = (0.1, 0.2, 0.4)
LIMITS = (0.7, 1.0, 1.4)
LOOPS = (0.008, 0.02, 0.05)
SLOW = (0.1, 0.3)
LATE = (0.002, 0.0045, 0.01)
LAGS = (0.003, 0.006, 0.012)
COOLING = (10.0, 30.0, 90.0)
MODES = {"hub": (12.0, 18.0, 25.0), "arm": (7.0, 10.0, 14.0)}
# Equal for all shapes of an effect: beta of Bouc-Wen, rise of LuGre's friction at rest, damping ratio.
BETA, RISE, DAMPING = 0.5, 0.5, 0.03


class TorqueTerm(NamedTuple):
    """An effect as generalised torques.

    Attributes:
        place: name and port.
        columns: (N, 2, k) shapes of the torque on (theta, alpha), one for each coefficient to be fitted.
        shape: values of the fixed parameters, as text.
    """

    place: Place
    columns: Values
    shape: str = ""


def terms(m: Motion, accelerations: bool = True) -> list[TorqueTerm]:
    """All terms along a motion; each shape of an effect is a separate term.

    Args:
        m: the motion.
        accelerations: whether terms may contain accelerations; False if accelerations are to be explained.
    """
    return [*_at_ports(m), *_of_modes(m), *_of_voltage(m), *_of_sensors(m, accelerations)]


def linear_columns(m: Motion) -> Values:
    """Torques (N, 2, k) of the linear terms of the joint, which may explain a part of the missing torque."""
    hub, joint = PORTS["hub"], PORTS["joint"]
    own = [
        np.outer(m.at("hub")[1], hub),
        np.outer(m.at("joint")[1], joint),
        np.outer(m.at("joint")[0], joint),
        np.outer(m.u, hub),
        np.outer(m.a[:, 0], hub),
    ]
    return np.stack(own, axis=2)


def _term(place: Place, port: str, *shapes: Values, note: str = "") -> TorqueTerm:
    columns = np.stack([np.outer(s, PORTS[port]) for s in shapes], axis=2)
    return TorqueTerm(place, columns, note)


def _at_ports(m: Motion) -> Iterator[TorqueTerm]:
    for port in PORTS:
        z, v = m.at(port)
        sign = np.sign(v)
        yield _term(("coulomb", port), port, sign)
        yield _term(("coulomb_asymmetric", port), port, np.maximum(sign, 0), np.minimum(sign, 0))
        for speed in SPEEDS:
            fading = np.exp(-((v / speed) ** 2)) * sign
            yield _term(("stribeck", port), port, sign, fading, note=f"{speed:g} rad/s")
        yield _term(("quadratic_drag", port), port, np.abs(v) * v)
        if port != "arm":
            for width in PRESLIDING:
                built = _hysteresis(v, np.ones_like(v), width, 1.0, m.Ts)
                yield _term(("dahl", port), port, built, note=f"{width:g} rad")
            for width in LOOPS:
                built = _hysteresis(v, np.ones_like(v), width, 2 * BETA - 1, m.Ts)
                yield _term(("bouc_wen", port), port, built, note=f"{width:g} rad")
            for width in PRESLIDING[:2]:
                for slow in SLOW:
                    level = 1 + RISE * np.exp(-((v / slow) ** 2))
                    built = _hysteresis(v, level, width, 1.0, m.Ts)
                    rate = np.gradient(built, m.Ts)
                    yield _term(("lugre", port), port, built, rate, note=f"{width:g} rad, {slow:g} rad/s")
        if port == "joint":
            yield _term(("cubic_spring", port), port, z**3)
            yield _term(("quadratic_spring", port), port, z**2)
            for play in PLAYS:
                yield _term(("joint_play", port), port, np.clip(z, -play, play), note=f"{play:g} rad")
            continue
        yield _term(("gravity", port), port, np.sin(z), np.cos(z))
        for n in PERIODS:
            yield _term(("cogging", port), port, np.sin(n * z), np.cos(n * z), note=f"{n:g} periods")
    yield _term(("viscous", "arm"), "arm", m.at("arm")[1])


def _of_modes(m: Motion) -> Iterator[TorqueTerm]:
    """A mass on a spring at a port, excited by the acceleration of the port: ``e'' + d e' + k e = -z''``.

    The torque on the port is the mass times its acceleration ``z'' + e'' = -d e' - k e``.
    """
    for port, frequencies in MODES.items():
        shaking = (m.a @ PORTS[port])[:, None]
        for frequency in frequencies:
            w = 2 * np.pi * frequency
            k, d = w**2, 2 * DAMPING * w
            A, B = np.array([[0.0, 1.0], [-k, -d]]), np.array([[0.0], [-1.0]])
            mass = (A, B, A[1:], np.zeros((1, 1)))
            # The initial deflection is the equilibrium of the spring under the first acceleration.
            start = np.array([-shaking[0, 0] / k, 0.0])
            answer = dlsim(cont2discrete(mass, m.Ts, "zoh"), shaking, x0=start)[1]
            yield _term(("second_mode", port), port, answer[:, 0], note=f"{frequency:g} Hz")


def _of_voltage(m: Motion) -> Iterator[TorqueTerm]:
    u, t = m.u, m.Ts * np.arange(len(m.u))
    yield _term(("voltage_offset", "input"), "hub", np.ones_like(u))
    for time in LATE:
        late = np.interp(t - time, t, u) - u
        yield _term(("delay", "input"), "hub", late, note=f"{1e3 * time:g} ms")
    for time in LAGS:
        # Exact for a voltage that is linear between samples.
        keep = np.exp(-m.Ts / time)
        slope = (1 - keep) * time / m.Ts
        b, a = np.array([1 - slope, slope - keep]), np.array([1.0, -keep])
        behind = lfilter(b, a, u, zi=u[0] * lfilter_zi(b, a))[0] - u
        yield _term(("lag", "input"), "hub", behind, note=f"{1e3 * time:g} ms")
    # Torque of the cold motor, in volts at rest; heating reduces the torque.
    cold = u - m.back_emf * m.v[:, 0]
    for time in COOLING:
        keep = np.exp(-m.Ts / time)
        warmth = lfilter([time * (1 - keep)], [1, -keep], cold**2)
        yield _term(("heating", "hub"), "hub", warmth * cold, note=f"{time:g} s")
    for width in WIDTHS:
        yield _term(("dead_zone", "input"), "hub", np.clip(u, -width, width), note=f"{width:g} V")
    for limit in LIMITS:
        yield _term(("saturation", "input"), "hub", u - np.clip(u, -limit, limit), note=f"{limit:g} V")


def _of_sensors(m: Motion, accelerations: bool) -> Iterator[TorqueTerm]:
    """Errors of a reading, as the torques that the joint would need if the wrong angles were true."""

    def term(name: str, channel: int, *errors: tuple[Values, Values, Values]) -> TorqueTerm:
        unit = np.eye(2)[channel]
        columns = []
        for d, rate, acceleration in errors:
            x = np.hstack([np.outer(d, unit), np.outer(rate, unit)])
            inertial = np.outer(acceleration, unit) * accelerations
            columns.append((inertial - x @ m.joint.A[2:4, :4].T) @ m.mass.T)
        return TorqueTerm((name, ("theta", "alpha")[channel]), np.stack(columns, axis=2))

    zero, one, jerk = np.zeros(len(m.u)), np.ones(len(m.u)), np.gradient(m.a, m.Ts, axis=0)
    for c in range(2):
        q, v, a = m.q[:, c], m.v[:, c], m.a[:, c]
        yield term("sensor_cubic", c, (q**3, 3 * q**2 * v, 6 * q * v**2 + 3 * q**2 * a))
        yield term("channel_delay", c, (v, a, jerk[:, c]))
        if c == 0:
            wave = (np.sin(q), np.cos(q) * v, np.cos(q) * a - np.sin(q) * v**2)
            shifted = (np.cos(q), -np.sin(q) * v, -np.sin(q) * a - np.cos(q) * v**2)
            yield term("eccentric_encoder", c, wave, shifted)
            continue
        back = q < 0
        yield term("sensor_gain", c, (q, v, a))
        yield term("sensor_bias", c, (one, zero, zero))
        yield term("rectifier", c, (q * back, v * back, a * back))
        yield term("cross_talk", c, (m.q[:, 0], m.v[:, 0], m.a[:, 0]))


def _hysteresis(v: Values, level: Values, width: float, release: float, Ts: float) -> Values:
    """State along a measured motion of ``x' = v / width - part |v| / (width level) x``.

    `part` is one while the torque builds up, and `release` while it decreases. For Dahl's law `release` and
    `level` are one; for LuGre's law `release` is one and `level` depends on the speed; for the Bouc-Wen law
    `release` is ``2 beta - 1``.
    """
    x, out = 0.0, np.empty_like(v)
    step = np.abs(v) * Ts / width
    for k, direction in enumerate(np.sign(v)):
        part = (1.0 if direction * x > 0 else release) / level[k]
        if part:
            end = direction / part
            x = end + (x - end) * np.exp(-part * step[k]) if direction else x
        else:
            x += direction * step[k]
        out[k] = x
    return out
