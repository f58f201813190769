"""Trusted constants on which the interval of an estimate depends, from the equations of motion alone."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.base import Effect, Linear
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import second_order_matrices
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate, HeldConstant, Specification, specifications

# Constants of a motor or a load are rarely known better than this: tolerances in data sheets are 5 to 12 %.
TOLERANCE = 0.05
_PERCENT = 0.01
# Step of a difference quotient relative to a parameter, and relative size that counts as zero.
_STEP, _ZERO = 1e-6, 1e-4


class _Place(NamedTuple):
    """A parameter of an effect, and its own row among the quantities that data determine, or None."""

    effect: int
    name: str
    spec: Specification
    row: int | None


def with_held_constants(mechanism: Mechanism, estimates: Sequence[Estimate]) -> tuple[Estimate, ...]:
    """The same estimates, each with the trusted constants on which its interval depends (`given`).

        G(p + dp, c + dc) = (1 + d dlambda) G(p, c)

    `G` are the entries of the linear equations of motion and the parameters of all other effects. `d` is the
    exponent of torque in the unit of each. Input and outputs determine `G` up to one common factor
    `1 + dlambda` of all torques. If a change `dc` of a trusted constant can be compensated by a change `dp`
    of free parameters, no run changes, and no recording of these channels shows it. A constant is named if a
    change by its `TOLERANCE` moves an estimate out of its 95 % interval. A motor with armature inductance has
    the entries that it has at constant speed. For other effects with linear states of their own, the
    parameters are in `G`.

    A parameter that always equals another one gets the other's value.

    Args:
        mechanism: Mechanism with the fitted values.
        estimates: Estimates of its parameters; parameters that are not free are trusted.

    Returns:
        The estimates in the same order.
    """
    now = mechanism.named_values
    estimates = tuple(
        dataclasses.replace(e, value=now[e.name], note=f"tied to {mechanism.followers[e.name]}")
        if e.name in mechanism.followers
        else e
        for e in estimates
    )
    free = {e.name for e in estimates if e.free}
    by_name = {e.name: e for e in estimates}
    moved = _moved(mechanism, free)
    found = []
    for e in estimates:
        half = HALF_WIDTH_95 * e.std
        strong = [
            HeldConstant(c, now[c], by_name[c].unit, changes[e.name])
            for c, changes in moved.items()
            if c in by_name and abs(changes.get(e.name, 0.0)) * TOLERANCE / _PERCENT >= half > 0
        ]
        strong.sort(key=lambda c: -float(f"{abs(c.change):.6g}"))  # equal ones in the order of the parameters
        found.append(dataclasses.replace(e, given=tuple(strong)) if e.free else e)
    return tuple(found)


def _moved(m: Mechanism, free: set[str]) -> dict[str, dict[str, float]]:
    """Trusted constant -> free parameter -> its change if the constant is one per cent larger."""
    if not np.isfinite(m.values).all():
        return {}
    places: list[_Place] = []
    entries = _entries(m, m.effects)
    rows = len(entries)
    for k, e in enumerate(m.effects):
        for name, spec in specifications(e).items():
            own = not _only_entries(e)
            places.append(_Place(k, name, spec, rows if own else None))
            rows += own
    now, sizes, degrees = m.values, np.ones(rows), np.ones(rows)
    G = np.concatenate([entries, np.zeros(rows - len(entries))])
    for place, value in zip(places, now, strict=True):
        if place.row is not None:
            G[place.row], degrees[place.row] = value, _degree(place.spec)
    sizes[: len(entries)] = _kind_sizes(m, entries)
    for place in places:
        if place.row is not None:
            sizes[place.row] = max(abs(G[place.row]), place.spec.typical)
    steps = [max(abs(v), p.spec.typical) for v, p in zip(now.tolist(), places, strict=True)]
    columns = np.zeros((rows, len(places)))
    for j, place in enumerate(places):
        if place.name in m.effects[place.effect].follows:
            continue
        if place.row is not None:
            columns[place.row, j] = steps[j]
        else:
            columns[: len(entries), j] = _slope(m, place, entries, steps[j]) * steps[j]
    columns /= sizes[:, None]
    scaled = -(degrees * G / sizes)[:, None]
    names = m.parameter_names
    moving = [j for j, name in enumerate(names) if name in free]
    A = np.concatenate([columns[:, moving], scaled], axis=1)
    u, s, vt = np.linalg.svd(A, full_matrices=False)
    kept = s > _ZERO * s[0]
    # A parameter in a direction that changes nothing has no definite change.
    unclear = np.linalg.norm(vt[~kept], axis=0) > _ZERO if (~kept).any() else np.zeros(A.shape[1], bool)
    found = {}
    for j, name in enumerate(names):
        if name in free or name in m.followers or not now[j] or not columns[:, j].any():
            continue
        b = -columns[:, j] * _PERCENT * now[j] / steps[j]
        x = vt[kept].T @ ((u[:, kept].T @ b) / s[kept])
        if np.linalg.norm(A @ x - b) > _ZERO * np.linalg.norm(b):
            continue  # no change of free parameters compensates: runs show the constant
        found[name] = {names[i]: float(x[k] * steps[i]) for k, i in enumerate(moving) if not unclear[k]}
    return found


def _slope(
    m: Mechanism, place: _Place, entries: Float[np.ndarray, " E"], size: float
) -> Float[np.ndarray, " E"]:
    effect = m.effects[place.effect]
    value = float(getattr(effect, place.name))
    h = _STEP * size if value + _STEP * size <= place.spec.upper else -_STEP * size
    changed = list(m.effects)
    changed[place.effect] = effect.replace(**{place.name: value + h})
    return (_entries(m, changed) - entries) / h


def _only_entries(effect: Effect) -> bool:
    """Whether an effect acts only by its entries in the linear equations of motion."""
    if not isinstance(effect, Linear) or hasattr(effect, "force"):
        return False
    return effect.motor or not len(effect.stamp().own)


def _entries(m: Mechanism, effects: Sequence[Effect]) -> Float[np.ndarray, " E"]:
    """Entries of mass, damping, stiffness and drive from the linear effects, in one array."""
    linear = (e for e in effects if _only_entries(e) and isinstance(e, Linear))
    stamps = [(e.stamp().static(), m.vector(e)) for e in linear]
    return np.concatenate([np.ravel(part) for part in second_order_matrices(stamps, len(m.coordinates))])


def _kind_sizes(m: Mechanism, entries: Float[np.ndarray, " E"]) -> Float[np.ndarray, " E"]:
    n = len(m.coordinates)
    kinds = np.repeat(np.arange(4), [n * n, n * n, n * n, n])
    largest = np.array([np.abs(entries[kinds == k]).max(initial=0.0) or 1.0 for k in range(4)])
    return largest[kinds]


def _degree(spec: Specification) -> float:
    """Exponent of torque in a unit."""
    return math.log2(Units(effort_size=2.0).size(spec.unit))
