"""Regression of the torque balance (inverse dynamics), as in the identification of robots."""

from __future__ import annotations

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.motion import Motion, Values, motions
from rotflex_jax.arena.rivals.selection import Regression, rows, select
from rotflex_jax.arena.rivals.terms import linear_columns, terms


def balance(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Forward selection among the terms, for the torque that the linear joint does not explain."""
    m, after = motions(train, validation)
    scale, listed = weights(m), terms(m)

    def regression(m: Motion) -> Regression:
        flat = [rows(t.columns, scale) for t in terms(m)]
        return Regression(rows(m.missing[:, :, None], scale)[:, 0], rows(linear_columns(m), scale), flat)

    answer = select(regression(m), regression(after), listed)
    return answer._replace(note=f"window {m.window}; {answer.note}")


def weights(m: Motion) -> Values:
    """Matrix (2, 2) from generalised torques to torques on hub and arm, each of unit standard deviation."""
    # Hub: generalised torque on theta minus the one on alpha; arm: generalised torque on alpha.
    split = np.array([[1.0, -1.0], [0.0, 1.0]])
    return split / np.std(m.missing @ split.T, axis=0)[:, None]
