"""The named effects as columns of torque over a motion.

What does not act as a torque that angles, speeds and voltage determine (a sensor, a delay, another mode,
a warm motor) has no column, and a rival that regresses torques cannot name it. Delay and lag enter by
their first order, the slope of the voltage; hysteresis by its state along the measured motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from arena.laws import Place
from arena.rivals.motion import PORTS, Array, Motion

SPEEDS = (0.05, 0.15, 0.4, 1.0)
PERIODS = (4.0, 6.0, 8.0, 12.0)
PRESLIDING = (0.004, 0.01, 0.03)
PLAYS = (0.003, 0.006, 0.012)
WIDTHS = (0.1, 0.2, 0.4)
LIMITS = (0.7, 1.0, 1.4)


class Term(NamedTuple):
    """An effect as generalised torques.

    Attributes:
        place: name and port.
        columns: (N, 2, k) shapes of the torque on (theta, alpha), one per number to be fitted.
        shape: the numbers that are fixed by it, for the reader.
    """

    place: Place
    columns: Array
    shape: str = ""


def terms(m: Motion) -> list[Term]:
    """All terms over a motion, several shapes of an effect as terms of their own."""
    return [*_at_ports(m), *_of_voltage(m)]


def linear_columns(m: Motion) -> Array:
    """(N, 2, k) torques of the joint's own linear terms, for their share of what is missing."""
    hub, joint = PORTS["hub"], PORTS["joint"]
    own = [
        np.outer(m.at("hub")[1], hub),
        np.outer(m.at("joint")[1], joint),
        np.outer(m.at("joint")[0], joint),
        np.outer(m.u, hub),
        np.outer(m.a[:, 0], hub),
    ]
    return np.stack(own, axis=2)


def _term(place: Place, port: str, *shapes: Array, note: str = "") -> Term:
    columns = np.stack([np.outer(s, PORTS[port]) for s in shapes], axis=2)
    return Term(place, columns, note)


def _at_ports(m: Motion) -> Iterator[Term]:
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
                built = _hysteresis(v, width, m.Ts)
                yield _term(("dahl", port), port, built, note=f"{width:g} rad")
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


def _of_voltage(m: Motion) -> Iterator[Term]:
    u = m.u
    yield _term(("voltage_offset", "input"), "hub", np.ones_like(u))
    yield _term(("delay", "input"), "hub", np.gradient(u, m.Ts))
    for width in WIDTHS:
        yield _term(("dead_zone", "input"), "hub", np.clip(u, -width, width), note=f"{width:g} V")
    for limit in LIMITS:
        over = u - np.clip(u, -limit, limit)
        if np.any(over):
            yield _term(("saturation", "input"), "hub", over, note=f"{limit:g} V")


def _hysteresis(v: Array, width: float, Ts: float) -> Array:
    """State of Dahl's law along a measured motion, `zeta' = v/width - |v|/width zeta`."""
    z, out = 0.0, np.empty_like(v)
    for k, speed in enumerate(v):
        s = np.sign(speed)
        z = s + (z - s) * np.exp(-abs(speed) * Ts / width) if s else z
        out[k] = z
    return out
