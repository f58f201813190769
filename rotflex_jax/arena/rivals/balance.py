"""Regression of the torque balance, the inverse dynamics that robots are identified by."""

from __future__ import annotations

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.motion import Motion, Values, motions
from rotflex_jax.arena.rivals.selection import Regression, rows, select
from rotflex_jax.arena.rivals.terms import linear_columns, terms


def balance(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Forward selection among torques, for the torque that the linear joint does not explain."""
    m, after = motions(train, validation)
    scale, listed = weights(m), terms(m)

    def regression(m: Motion) -> Regression:
        flat = [rows(t.columns, scale) for t in terms(m)]
        return Regression(rows(m.missing[:, :, None], scale)[:, 0], rows(linear_columns(m), scale), flat)

    answer = select(regression(m), regression(after), listed)
    return answer._replace(note=f"window {m.window}; {answer.note}")


def weights(m: Motion) -> Values:
    """(2, 2) turns generalised torques into the two independent ones, each in units of its scatter."""
    # On the hub: what acts on theta less what acts on alpha; on the arm: what acts on alpha.
    split = np.array([[1.0, -1.0], [0.0, 1.0]])
    return split / np.std(m.missing @ split.T, axis=0)[:, None]
