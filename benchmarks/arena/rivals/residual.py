"""Regression of the free-run error on the linear joint's answer to every term."""

from __future__ import annotations

import numpy as np
from scipy.signal import dlsim

import rotflex_jax as rf
from arena.rivals.answer import Answer
from arena.rivals.motion import Array, Motion, linear_joint, motion
from arena.rivals.selection import rows, select
from arena.rivals.terms import linear_columns, terms
from rotflex_jax.mechanism.linear import zero_order_hold


def residual(train: rf.Recording) -> Answer:
    """Forward selection among the answers of the joint to the terms, each along the measured motion."""
    fit = linear_joint(train)
    m = motion(train, fit)
    inside = slice(m.start, m.start + len(m.u))
    error = (np.asarray(train.y) - fit.model.simulate(train))[inside]
    listed = terms(m)
    unit = np.diag(1 / np.std(error, axis=0))
    start = [_free(m, k) for k in range(4)]
    linear = linear_columns(m)
    own = [_answer(m, linear[:, :, k]) for k in range(linear.shape[2])]
    base = np.stack([*start, *own], axis=2)
    columns = [
        np.stack([_answer(m, t.columns[:, :, k]) for k in range(t.columns.shape[2])], axis=2) for t in listed
    ]
    flat = [rows(c, unit) for c in columns]
    return select(rows(error[:, :, None], unit)[:, 0], rows(base, unit), listed, flat)


def _answer(m: Motion, torque: Array) -> Array:
    """Angles (N, 2) that a generalised torque (N, 2) makes of the linear joint, from rest."""
    push = np.zeros((len(m.joint.A), 2))
    push[2:4] = np.linalg.inv(m.mass)
    A, B = zero_order_hold(m.joint.A, push, m.Ts)
    held = 0.5 * (torque + np.vstack([torque[1:], torque[-1:]]))
    return dlsim((A, B, m.joint.C, np.zeros((2, 2)), m.Ts), held)[1]


def _free(m: Motion, k: int) -> Array:
    """Angles (N, 2) after a unit of one first state."""
    A, _ = m.joint.discretise(m.Ts)
    x, out = np.eye(len(A))[:, k], np.empty((len(m.u), 2))
    for row in out:
        row[:] = m.joint.C @ x
        x = A @ x
    return out
