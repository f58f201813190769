"""Every effect of the catalogue fitted in turn, the best kept by BIC: forward selection as usual."""

from __future__ import annotations

import numpy as np

import rotflex_jax as rf
from arena.laws import Place
from arena.rivals.answer import Answer
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches

ROUNDS, MARGIN = 2, 5.0


def refit(train: rf.Recording) -> Answer:
    """Forward selection by full refits of the free run; several sizes to start from."""
    model = rf.joints.paper()
    best = rf.fit(model, train)
    bic, rounds, notes = _bic(best, train), [], []
    for _ in range(ROUNDS):
        trials: list[tuple[float, Place, rf.Fit]] = []
        for kind, port in search_places(model):
            if (kind.name, port) in rounds:
                continue
            clear_compilation_caches()
            try:
                fit = rf.fit(best.model + kind(at=port), train)
            except (rf.InputError, ValueError, FloatingPointError):
                continue  # two of a kind at one place, or a fit that fell over: not a candidate
            value = _bic(fit, train)
            if np.isfinite(value):
                trials.append((value, (kind.name, port), fit))
        value, place, fit = min(trials, key=lambda t: t[0])
        if value > bic - 2 * MARGIN:
            break
        notes.append(f"{place[0]}@{place[1]} {(bic - value) / 2:.0f} nats")
        bic, best = value, fit
        rounds.append(place)
    return Answer(rounds, "; ".join(notes))


def _bic(fit: rf.Fit, train: rf.Recording) -> float:
    """`N sum log s^2 + k log N` of the free-run errors."""
    e = (fit.model.measured(train) - fit.model.simulate(train))[train.n_init :]
    free = len(fit.model.mechanism.free_names)
    return len(e) * float(np.sum(np.log(np.mean(e**2, axis=0)))) + free * np.log(e.size)
