"""Forward selection by BIC among groups of columns, with the effective number of independent samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rotflex_jax.arena.rivals.answer import NamedEffects
from rotflex_jax.arena.rivals.motion import Values
from rotflex_jax.arena.rivals.terms import TorqueTerm
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.effects import CATALOG

# A smoothed residual is correlated, and the smoothed motion is not exactly the true motion: without a hidden
# effect the gain reaches 25 nats, even with the effective number of samples. A simpler model is preferred if
# its gain exceeds this share of the largest gain.
ROUNDS, MARGIN, PARSIMONY = 3, 30.0, 0.9


def rows(signal: Values, scale: Values) -> Values:
    """Signal (N, 2, k) as rows (2 N, k), after the matrix `scale` (2, 2) has transformed the two channels."""
    return np.einsum("ij,njk->ink", scale, signal).reshape(-1, signal.shape[2])


class Regression(NamedTuple):
    """Target and columns of a linear regression.

    Attributes:
        target: signal to be explained (rows,).
        base: columns that are in every model (rows, k).
        columns: columns of each candidate, each (rows, k).
    """

    target: Values
    base: Values
    columns: Sequence[Values]

    def left(self, chosen: Sequence[int], coefficients: Values) -> float:
        """Mean square of the residuals with the given coefficients, which may come from other data."""
        X = np.hstack([self.base, *(self.columns[i] for i in chosen)])
        return float(np.mean((self.target - X @ coefficients) ** 2))

    def fitted(self, chosen: Sequence[int]) -> Values:
        """Coefficients of the base and of the chosen candidates, by least squares."""
        X = np.hstack([self.base, *(self.columns[i] for i in chosen)])
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-30)
        return np.linalg.lstsq(X / size, self.target, rcond=1e-10)[0] / size


def select(train: Regression, validation: Regression, candidates: Sequence[TorqueTerm]) -> NamedEffects:
    """Adds the group that lowers BIC most on training data, as long as the error on validation data falls.

    Args:
        train: regression on training data, which is fitted.
        validation: regression on validation data, which determines how many groups are kept.
        candidates: terms to which the groups of columns belong.
    """
    target, base, columns = train
    base = base / np.maximum(np.linalg.norm(base, axis=0), 1e-30)
    Q = np.linalg.qr(base)[0]
    chosen: list[int] = []
    unseen = validation.left((), train.fitted(()))
    left = target - Q @ (Q.T @ target)
    rounds: list[Place] = []
    notes: list[str] = []
    for _ in range(ROUNDS):
        samples = _independent(left)
        trials: list[tuple[float, TorqueTerm, Values]] = []
        for term, c in zip(candidates, columns, strict=True):
            if term.place in rounds:
                continue
            size = np.linalg.norm(c, axis=0)
            c = c / np.maximum(size, 1e-30)
            c = c - Q @ (Q.T @ c)
            kept = np.linalg.norm(c, axis=0) > 1e-4
            if not np.any(kept):
                continue
            q = np.linalg.qr(c[:, kept])[0]
            share = float(np.sum((q.T @ left) ** 2) / np.sum(left**2))
            count = c.shape[1] + bool(term.shape)
            nats = -0.5 * samples * np.log1p(-min(share, 1 - 1e-12)) - 0.5 * count * np.log(samples)
            trials.append((nats, term, q))
        gain, best, direction = max(trials, key=lambda t: t[0])
        if gain < MARGIN:
            break
        # The rule of parsimony of the search: a simpler model is preferred if its gain is nearly the same.
        simpler = [
            t
            for t in trials
            if t[1].place[1] == best.place[1]
            and t[1].place[0] in CATALOG[best.place[0]].contains
            and t[0] > PARSIMONY * gain
        ]
        if simpler:
            gain, best, direction = max(simpler, key=lambda t: t[0])
        chosen.append(next(i for i, t in enumerate(candidates) if t is best))
        now = validation.left(chosen, train.fitted(chosen))
        if now >= unseen:
            break
        unseen = now
        rounds.append(best.place)
        notes.append(f"{best.place[0]}@{best.place[1]} {best.shape} {gain:.0f} nats".replace("  ", " "))
        left = left - direction @ (direction.T @ left)
        Q = np.linalg.qr(np.hstack([Q, direction]))[0]
    return NamedEffects(rounds, "; ".join(notes))


def _independent(e: Values) -> float:
    """Effective number of independent samples of a correlated sequence, from its correlation time."""
    e = e - e.mean()
    n = len(e)
    spectrum = np.abs(np.fft.rfft(e, 2 * n)) ** 2
    r = np.fft.irfft(spectrum)[: n // 2]
    r = r / r[0]
    below = np.flatnonzero(r < 0.05)
    end = int(below[0]) if below.size else len(r)
    return n / max(1.0, 1 + 2 * float(np.sum(r[1:end])))
