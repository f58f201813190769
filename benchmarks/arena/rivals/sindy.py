"""Sparse identification with control through pysindy: plain, as an ensemble, and in weak form.

States are the smoothed angles and speeds, features the linear terms and all terms of `terms`. A
threshold on the size of normalised coefficients is the knob; it is the one whose balance predicts the
last fifth of the training part best, a larger one preferred while the error stays within a twentieth.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pysindy as ps

import rotflex_jax as rf
from arena.laws import Place
from arena.rivals.answer import Answer
from arena.rivals.balance import weights
from arena.rivals.motion import Array, Motion, motion
from arena.rivals.terms import Term, terms

THRESHOLDS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
# Share of an ensemble in which a feature must be, and how much of the torque it must explain.
INCLUDED, SHARE = 0.9, 0.02
WEAK_SECONDS = 0.25

Solve = Callable[[Array, Array, float], Array]


def plain(train: rf.Recording) -> Answer:
    """Sequentially thresholded least squares."""
    return _search(train, _thresholded, lambda x, _: x)


def ensemble(train: rf.Recording) -> Answer:
    """Bagging: a feature counts that most bootstrap models keep."""
    return _search(train, _bagged, lambda x, _: x)


def weak(train: rf.Recording) -> Answer:
    """Both sides of the balance against smooth test functions, which spares a derivative of its noise."""
    return _search(train, _thresholded, _against_bumps)


def _search(train: rf.Recording, solve: Solve, view: Callable[[Array, Motion], Array]) -> Answer:
    m = motion(train)
    # A damper at the arm is a linear term, and the parts of an asymmetric friction are others' columns.
    listed = [t for t in terms(m) if t.place[0] not in ("coulomb_asymmetric", "viscous")]
    scale = weights(m)
    # Accelerations of hub and arm are regressed apart, as SINDy does: torque on each, in its scatter.
    target = view(m.a @ m.mass.T @ scale.T, m)
    names, raw = _features(m, listed)
    features = _normalised(view(raw, m))
    cut = int(0.8 * len(target))
    errors, found = [], []
    for threshold in THRESHOLDS:
        w = _thresholded(features[:cut], target[:cut], threshold)
        left = target[cut:] - features[cut:] @ w.T
        errors.append(float(np.mean(left**2)))
        found.append(threshold)
    limit = 1.05 * min(errors)
    threshold = max(t for t, e in zip(found, errors, strict=True) if e <= limit)
    w = solve(features, target, threshold)
    power = np.sum(w**2, axis=0)
    total = float(np.sum(np.var(target - features[:, :_LINEAR] @ _lstsq(features, target).T, axis=0)))
    order = np.argsort(-power)
    rounds: list[Place] = []
    for k in order:
        place = names[k]
        if place is None or power[k] <= SHARE * max(total, 1e-12) or place in rounds:
            continue
        rounds.append(place)
    rounds = _merged(rounds)[:4]
    return Answer(rounds, f"window {m.window}, threshold {threshold:g}")


_LINEAR = 5


def _normalised(features: Array) -> Array:
    """Columns of unit deviation, the others without what the linear ones can say in their place.

    The span is the same; a sine of small angles is no longer a second name for the angle.
    """
    linear, rest = features[:, :_LINEAR], features[:, _LINEAR:]
    whole = np.std(rest, axis=0)
    padded = np.column_stack([linear, np.ones(len(linear))])
    rest = rest - padded @ np.linalg.lstsq(padded, rest, rcond=None)[0]
    size = np.std(rest, axis=0)
    size[size <= 1e-4 * whole] = np.inf
    return np.column_stack([linear / np.std(linear, axis=0), rest / size])


def _lstsq(features: Array, target: Array) -> Array:
    return np.linalg.lstsq(features[:, :_LINEAR], target, rcond=None)[0].T


def _features(m: Motion, listed: list[Term]) -> tuple[list[Place | None], Array]:
    """Names (None for a linear term) and values (N, F), each shape once."""
    columns = [*m.q.T, *m.v.T, m.u]
    names: list[Place | None] = [None] * _LINEAR
    for t in listed:
        for k in range(t.columns.shape[2]):
            shape = t.columns[:, 0, k] if np.any(t.columns[:, 0, k]) else t.columns[:, 1, k]
            if any(np.array_equal(shape, c) for c in columns):
                continue  # a level that Coulomb's and Stribeck's law share
            columns.append(shape)
            names.append(t.place)
    return names, np.column_stack(columns)


def _thresholded(features: Array, target: Array, threshold: float) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(_stlsq(threshold).fit(features, target).coef_)


def _bagged(features: Array, target: Array, threshold: float) -> Array:
    optimizer = ps.EnsembleOptimizer(_stlsq(threshold), bagging=True, n_models=20, n_subset=len(target) // 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.random.seed(0)  # noqa: NPY002 - the library draws from the global stream
        optimizer.fit(features, target)
    models = np.asarray(optimizer.coef_list)
    kept = np.mean(models != 0, axis=0) >= INCLUDED
    return np.where(kept, np.median(models, axis=0), 0.0)


def _stlsq(threshold: float) -> ps.STLSQ:
    return ps.STLSQ(threshold=threshold, alpha=1e-4, max_iter=30)


def _against_bumps(signal: Array, m: Motion) -> Array:
    """Integrals against overlapping bumps `(1 - s^2)^4`, the test functions of weak SINDy."""
    half = max(2, round(WEAK_SECONDS / 2 / m.Ts))
    s = np.arange(-half, half + 1) / half
    bump = (1 - s**2) ** 4
    bump /= bump.sum()
    smooth = np.apply_along_axis(lambda c: np.convolve(c, bump, mode="valid"), 0, signal)
    return smooth[:: max(1, half // 8)]


def _merged(rounds: list[Place]) -> list[Place]:
    """Stribeck's law has Coulomb's level: where both are named at a port, Stribeck's stands for both."""
    return [p for p in rounds if not (p[0] == "coulomb" and ("stribeck", p[1]) in rounds)]
