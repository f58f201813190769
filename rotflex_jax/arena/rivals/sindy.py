"""Sparse identification with control by pysindy: plain, as an ensemble, and in weak form.

The states are the smoothed angles and speeds; the features are the linear terms and the nonlinear terms of
`terms`. The tuning parameter is the threshold on the normalised coefficients: the largest threshold whose
error on the validation recording exceeds the smallest error by no more than 5 %.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.balance import weights
from rotflex_jax.arena.rivals.motion import Motion, Values, motions
from rotflex_jax.arena.rivals.terms import TorqueTerm, terms
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.errors import optional

THRESHOLDS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
# Share of the models of an ensemble that must contain a feature; share of the torque that it must explain.
INCLUDED, SHARE = 0.9, 0.02
WEAK_SECONDS = 0.25

Solve = Callable[[Values, Values, float], Values]


def plain(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Sequentially thresholded least squares."""
    return _search(train, validation, _thresholded, lambda x, _: x)


def ensemble(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Bagging: keeps a feature if most bootstrap models contain it."""
    return _search(train, validation, _bagged, lambda x, _: x)


def weak(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Weak form: integrals of both sides of the balance over smooth test functions, which reduces noise."""
    return _search(train, validation, _thresholded, _against_bumps)


def _search(
    train: rf.Recording, validation: rf.Recording, solve: Solve, view: Callable[[Values, Motion], Values]
) -> NamedEffects:
    m, after = motions(train, validation)
    scale = weights(m)
    # Hub and arm have separate regressions, as in SINDy: torques on each, scaled to unit standard deviation.
    target = view(m.a @ m.mass.T @ scale.T, m)
    names, raw, kept = _features(m, _listed(m))
    features, normal = _normalised(view(raw, m))
    unseen = normal(view(_features(after, _listed(after), kept)[1], after))
    aim = view(after.a @ after.mass.T @ scale.T, after)
    errors = []
    for threshold in THRESHOLDS:
        left = aim - unseen @ _thresholded(features, target, threshold).T
        errors.append(float(np.mean(left**2)))
    limit = 1.05 * min(errors)
    threshold = max(t for t, e in zip(THRESHOLDS, errors, strict=True) if e <= limit)
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
    return NamedEffects(rounds, f"window {m.window}, threshold {threshold:g}")


_LINEAR = 5


# Effects with columns that are linear in angles and speeds, like the linear terms, or sums of other columns.
_LEFT_OUT = {"viscous", "sensor_gain", "cross_talk", "channel_delay", "coulomb_asymmetric"}


def _listed(m: Motion) -> list[TorqueTerm]:
    """Terms of all effects except `_LEFT_OUT`."""
    return [t for t in terms(m, accelerations=False) if t.place[0] not in _LEFT_OUT]


def _normalised(features: Values) -> tuple[Values, Callable[[Values], Values]]:
    """Columns of unit standard deviation, after the linear part of the nonlinear columns is removed.

    Apart from a constant the columns span the same space, but a sine of small angles, for example, is no
    longer nearly equal to the angle.

    Returns:
        The columns, and a function that transforms columns of other data in the same way.
    """
    linear, rest = features[:, :_LINEAR], features[:, _LINEAR:]
    whole, unit = np.std(rest, axis=0), np.std(linear, axis=0)
    padded = lambda x: np.column_stack([x[:, :_LINEAR], np.ones(len(x))])  # noqa: E731
    said = np.linalg.lstsq(padded(features), rest, rcond=None)[0]
    size = np.std(rest - padded(features) @ said, axis=0)
    size[size <= 1e-4 * whole] = np.inf

    def normal(x: Values) -> Values:
        return np.column_stack([x[:, :_LINEAR] / unit, (x[:, _LINEAR:] - padded(x) @ said) / size])

    return normal(features), normal


def _lstsq(features: Values, target: Values) -> Values:
    return np.linalg.lstsq(features[:, :_LINEAR], target, rcond=None)[0].T


def _features(
    m: Motion, listed: list[TorqueTerm], kept: list[tuple[int, int, int]] | None = None
) -> tuple[list[Place | None], Values, list[tuple[int, int, int]]]:
    """Names (None for a linear term) and values (N, F) of the features, without repeated columns.

    Args:
        m: the motion.
        listed: the terms.
        kept: nonlinear features that were kept for other data, in the form that is returned.

    Returns:
        Names, values, and the numbers of term, column and row of each nonlinear feature.
    """
    columns = [*m.q.T, *m.v.T, m.u]
    names: list[Place | None] = [None] * _LINEAR
    found: list[tuple[int, int, int]] = []
    for i, t in enumerate(listed):
        for k in range(t.columns.shape[2]):
            for row in range(2):
                shape = t.columns[:, row, k]
                # The level that Coulomb and Stribeck friction share is one column, and so is a torque that
                # acts equally on both angles; an error of a sensor gives two columns.
                again = not np.any(shape) or any(np.array_equal(shape, c) for c in columns)
                if again if kept is None else (i, k, row) not in kept:
                    continue
                columns.append(shape)
                names.append(t.place)
                found.append((i, k, row))
    return names, np.column_stack(columns), found


def _thresholded(features: Values, target: Values, threshold: float) -> Values:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(_stlsq(threshold).fit(features, target).coef_)


def _bagged(features: Values, target: Values, threshold: float) -> Values:
    optimizer = optional("pysindy", "Sparse identification").EnsembleOptimizer(
        _stlsq(threshold), bagging=True, n_models=20, n_subset=len(target) // 2
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.random.seed(0)  # noqa: NPY002 - the library draws from the global stream
        optimizer.fit(features, target)
    models = np.asarray(optimizer.coef_list)
    kept = np.mean(models != 0, axis=0) >= INCLUDED
    return np.where(kept, np.median(models, axis=0), 0.0)


def _stlsq(threshold: float) -> Any:
    return optional("pysindy", "Sparse identification").STLSQ(threshold=threshold, alpha=1e-4, max_iter=30)


def _against_bumps(signal: Values, m: Motion) -> Values:
    """Integrals of the signal times overlapping test functions `(1 - s^2)^4`, as in weak SINDy."""
    half = max(2, round(WEAK_SECONDS / 2 / m.Ts))
    s = np.arange(-half, half + 1) / half
    bump = (1 - s**2) ** 4
    bump /= bump.sum()
    smooth = np.apply_along_axis(lambda c: np.convolve(c, bump, mode="valid"), 0, signal)
    return smooth[:: max(1, half // 8)]


def _merged(rounds: list[Place]) -> list[Place]:
    """Effects without Coulomb friction at ports with Stribeck friction, which contains a Coulomb level."""
    return [p for p in rounds if not (p[0] == "coulomb" and ("stribeck", p[1]) in rounds)]
