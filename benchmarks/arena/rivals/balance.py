"""Regression of the torque balance, the inverse dynamics that robots are identified by."""

from __future__ import annotations

import numpy as np

import rotflex_jax as rf
from arena.rivals.answer import Answer
from arena.rivals.motion import Array, Motion, motion
from arena.rivals.selection import rows, select
from arena.rivals.terms import linear_columns, terms


def balance(train: rf.Recording) -> Answer:
    """Forward selection among torques, for the torque that the linear joint does not explain."""
    m = motion(train)
    listed = terms(m)
    scale = weights(m)
    flat = [rows(t.columns, scale) for t in listed]
    answer = select(rows(m.missing[:, :, None], scale)[:, 0], rows(linear_columns(m), scale), listed, flat)
    return answer._replace(note=f"window {m.window}; {answer.note}")


def weights(m: Motion) -> Array:
    """(2, 2) turns generalised torques into the two independent ones, each in units of its scatter."""
    # On the hub: what acts on theta less what acts on alpha; on the arm: what acts on alpha.
    split = np.array([[1.0, -1.0], [0.0, 1.0]])
    return split / np.std(m.missing @ split.T, axis=0)[:, None]
