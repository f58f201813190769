"""Forward selection with full fits: every effect of the catalogue is fitted in turn, BIC selects the best."""

from __future__ import annotations

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches

ROUNDS, MARGIN = 2, 5.0
# Number of the next best effects of a round that are tried in the round after it: every structure is compiled
# separately, so every pair of effects costs time.
AGAIN = 6
# Number of fits after which compiled programs are removed from memory.
_KEPT = 25


def refit(train: rf.Recording, validation: rf.Recording) -> NamedEffects:
    """Forward selection by full refits of the free run.

    An effect is added if BIC on training data falls by at least twice `MARGIN` and the error on validation
    data falls.
    """
    model = rf.Model(rf.joints.paper())
    best = rf.fit(model, train)
    bic, unseen, rounds, notes = _bic(best, train), _error(best, validation), list[Place](), list[str]()
    places = [
        (kind, port) for kind, port in search_places(model.mechanism) if model.mechanism.accepts(kind, port)
    ]
    for _ in range(ROUNDS):
        trials: list[tuple[float, Place, rf.Fit]] = []
        for k, (kind, port) in enumerate(places):
            if (kind.name, port) in rounds:
                continue
            if k % _KEPT == _KEPT - 1:
                clear_compilation_caches()
            try:
                fit = rf.fit(best.model + kind(at=port), train)
            except (rf.InputError, ValueError, FloatingPointError):
                continue  # the model cannot have this effect as well, or the fit failed: not a candidate
            value = _bic(fit, train)
            if np.isfinite(value):
                trials.append((value, (kind.name, port), fit))
        if not trials:
            break
        trials.sort(key=lambda t: t[0])
        value, place, fit = trials[0]
        error = _error(fit, validation)
        if value > bic - 2 * MARGIN or not error < unseen:
            break
        notes.append(f"{place[0]}@{place[1]} {(bic - value) / 2:.0f} nats")
        bic, best, unseen = value, fit, error
        rounds.append(place)
        ranked = [p for _, p, _ in trials[1 : AGAIN + 1]]
        places = [(kind, port) for kind, port in places if (kind.name, port) in ranked]
    return NamedEffects(rounds, "; ".join(notes))


def _bic(fit: rf.Fit, train: rf.Recording) -> float:
    """`N sum log s^2 + k log N` of the free-run errors."""
    e = (fit.model.measured(train) - fit.model.simulate(train))[train.n_init :]
    free = len(fit.model.mechanism.free_names)
    return len(e) * float(np.sum(np.log(np.mean(e**2, axis=0)))) + free * np.log(e.size)


def _error(fit: rf.Fit, validation: rf.Recording) -> float:
    """Sum over channels of the logarithm of the mean square error of short free runs."""
    e = (fit.model.measured(validation) - fit.model.simulate_windows(validation, 2.0))[validation.n_init :]
    value = float(np.sum(np.log(np.mean(e**2, axis=0))))
    return value if np.isfinite(value) else np.inf
