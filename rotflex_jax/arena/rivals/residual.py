"""Regression of the free-run error on the response of the linear joint to every term."""

from __future__ import annotations

import numpy as np
from scipy.signal import dlsim

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.motion import Motion, Values, linear_joint, motions
from rotflex_jax.arena.rivals.selection import Regression, rows, select
from rotflex_jax.arena.rivals.terms import linear_columns, terms
from rotflex_jax.mechanism.linear import zero_order_hold


def residual(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Forward selection among the responses of the joint to the terms, each along the measured motion.

    The initial state of each run is unknown: responses to initial states are removed from target and columns.
    """
    fit = linear_joint(train)
    m, after = motions(train, validation, fit)
    errors = [
        (np.asarray(r.y) - fit.model.simulate(r))[v.start : v.start + len(v.u)]
        for r, v in ((train, m), (validation, after))
    ]
    unit = np.diag(1 / np.std(errors[0], axis=0))

    def regression(m: Motion, error: Values) -> Regression:
        answers = lambda columns: np.stack(  # noqa: E731
            [_answer(m, columns[:, :, k]) for k in range(columns.shape[2])], axis=2
        )
        start = rows(np.stack([_free(m, k) for k in range(4)], axis=2), unit)
        Q = np.linalg.qr(start / np.linalg.norm(start, axis=0))[0]
        rest = lambda c: c - Q @ (Q.T @ c)  # noqa: E731
        target = rest(rows(error[:, :, None], unit))[:, 0]
        flat = [rest(rows(answers(t.columns), unit)) for t in terms(m)]
        return Regression(target, rest(rows(answers(linear_columns(m)), unit)), flat)

    return select(regression(m, errors[0]), regression(after, errors[1]), terms(m))


def _answer(m: Motion, torque: Values) -> Values:
    """Angles (N, 2) of the linear joint in response to a generalised torque (N, 2), from rest."""
    push = np.zeros((len(m.joint.A), 2))
    push[2:4] = np.linalg.inv(m.mass)
    A, B = zero_order_hold(m.joint.A, push, m.Ts)
    held = 0.5 * (torque + np.vstack([torque[1:], torque[-1:]]))
    return dlsim((A, B, m.joint.C, np.zeros((2, 2)), m.Ts), held)[1]


def _free(m: Motion, k: int) -> Values:
    """Angles (N, 2) of the free response to a unit initial value of state `k`."""
    A, _ = m.joint.discretise(m.Ts)
    x, out = np.eye(len(A))[:, k], np.empty((len(m.u), 2))
    for row in out:
        row[:] = m.joint.C @ x
        x = A @ x
    return out
