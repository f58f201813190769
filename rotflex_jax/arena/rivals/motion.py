r"""Positions, speeds and accelerations from counted angles, and the linear joint to compare them with.

Every regression of accelerations depends on a good second derivative of the encoder readings. The smoother is
a cubic Savitzky-Golay filter. Its window is the one with the smallest relative residual of a linear torque
balance, since a short window passes noise and a long window removes motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

import rotflex_jax as rf
from rotflex_jax.mechanism.linear import StateSpace, inverse_mass

Values = Float[np.ndarray, "..."]
"""Array of numbers; the docstrings give the shapes."""

WINDOWS = (11, 21, 31, 41, 61)
PORTS = {"hub": np.array([1.0, 0.0]), "arm": np.array([1.0, 1.0]), "joint": np.array([0.0, 1.0])}


@dataclass(frozen=True)
class Motion:
    """The motion in a recording, sample by sample, without the ends, where the smoother is less exact.

    Attributes:
        u: voltage [V] (N,).
        q, v, a: angles [rad], speeds [rad/s], accelerations [rad/s^2] of (theta, alpha), (N, 2).
        Ts: sampling period [s].
        joint: the linear joint, fitted to the training recording.
        mass: mass matrix of the joint [kg m^2] (2, 2).
        missing: generalised torque that the linear joint does not explain [N m] (N, 2).
        window: window of the smoother [samples].
        start: index in the recording of the first sample.
        back_emf: back-EMF of the motor per speed of the hub [V s/rad].
    """

    u: Values
    q: Values
    v: Values
    a: Values
    Ts: float
    joint: StateSpace
    mass: Values
    missing: Values
    window: int
    start: int
    back_emf: float

    def at(self, port: str) -> tuple[Values, Values]:
        """Position [rad] and speed [rad/s] of a port."""
        return self.q @ PORTS[port], self.v @ PORTS[port]


def linear_joint(train: rf.Recording) -> rf.Fit:
    """The textbook joint, fitted as a predictor: missing effects bias this fit less than a free-run fit."""
    joint = rf.joints.paper()
    return rf.fit(joint, train, process_noise=dict.fromkeys(joint.port_vectors, 1e-4))


def motion(train: rf.Recording, fit: rf.Fit | None = None) -> Motion:
    """The motion in a recording.

    Args:
        train: recording of theta and alpha [rad].
        fit: fit of the linear joint; computed here if omitted.
    """
    mechanism = (fit or linear_joint(train)).model.mechanism
    joint, inverse = rf.linearise(mechanism), inverse_mass(mechanism)
    values = mechanism.named_values
    back_emf = values["hub.motor.back_emf"] * values["hub.motor.gear_ratio"]
    mass = np.linalg.inv(inverse)
    found = [_smoothed(train, joint, mass, window, back_emf) for window in WINDOWS]
    return min(found, key=_relative_residual)


def motions(
    train: rf.Recording, validation: rf.Recording, fit: rf.Fit | None = None
) -> tuple[Motion, Motion]:
    """The motion in both recordings, with the smoother and the linear joint of the training data.

    Args:
        train: training recording of theta and alpha [rad].
        validation: validation recording of theta and alpha [rad].
        fit: fit of the linear joint; computed here if omitted.
    """
    fit = fit or linear_joint(train)
    m = motion(train, fit)
    return m, _smoothed(validation, m.joint, m.mass, m.window, m.back_emf)


def _smoothed(train: rf.Recording, joint: StateSpace, mass: Values, window: int, back_emf: float) -> Motion:
    y, u, Ts = np.asarray(train.y), np.asarray(train.u).ravel(), train.Ts
    q, v, a = (
        np.asarray(savgol_filter(y, window, 3, deriv=order, delta=Ts, axis=0, mode="interp"), float)
        for order in range(3)
    )
    # The voltage is held over a sample; at the sample itself the mean of the values before and after it is
    # used. The voltage passes the same filter, so that both sides of the balance are smoothed equally.
    held = 0.5 * (u + np.concatenate([u[:1], u[:-1]]))
    smooth = np.asarray(savgol_filter(held, window, 3), float)
    x = np.hstack([q, v])
    explained = x @ joint.A[2:4, :4].T + np.outer(smooth, joint.B[2:4])
    missing = (a - explained) @ mass.T
    inside = slice(window, len(y) - window)
    return Motion(
        u=smooth[inside],
        q=q[inside],
        v=v[inside],
        a=a[inside],
        Ts=Ts,
        joint=joint,
        mass=mass,
        missing=missing[inside],
        window=window,
        start=window,
        back_emf=back_emf,
    )


def _relative_residual(m: Motion) -> float:
    """Share of the variance of the accelerations that a separately fitted linear balance does not explain.

    A window that removes motion, such as a fast oscillation, has a larger share.
    """
    columns = np.column_stack([m.q, m.v, m.u, np.ones_like(m.u)])
    left = m.a - columns @ np.linalg.lstsq(columns, m.a, rcond=None)[0]
    return float(np.sum(np.var(left, axis=0) / np.var(m.a, axis=0)))
