"""Rows of regression for one output: as it is, or as the integral of its rate; and which of the two."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Volterra
from rotflex_jax.compare.series_run import ChannelSeries, products, responses
from rotflex_jax.fit.linear import factor, solve
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Rows:
    """Regressors and output of one recording.

    Attributes:
        phi: (N, P), integrated where the output integrates.
        y: (N,).
        skip: Samples at the start that do not count: the bank does not know the input before.
        integrates: Whether only changes of the output count, not its level.
    """

    phi: Float[np.ndarray, "N P"]
    y: Float[np.ndarray, " N"]
    skip: int
    integrates: bool

    @classmethod
    def of(cls, basis: Volterra, recording: Recording, channel: int, integrates: bool) -> "Rows":
        """Rows of a recording."""
        phi = products(basis, responses(basis.bank, recording.u.astype(float)))
        if integrates:
            phi = recording.Ts * np.cumsum(phi, axis=0)
        skip = max(recording.n_init, min(int(basis.bank.reach), recording.N // 5))
        return cls(phi, recording.y[:, channel].astype(float), skip, integrates)

    def part(self, start: int, end: int) -> Float[np.ndarray, "M K"]:
        """Rows `[phi, y]`, without their level where that does not count."""
        joined = np.column_stack([self.phi[start:end], self.y[start:end]])
        return joined - joined.mean(axis=0) if self.integrates else joined

    def error(self, w: np.ndarray, start: int, head: int) -> Float[np.ndarray, " M"]:
        """What weights miss in a free run that begins at `start` and may look at `head` samples."""
        e = self.y[start:] - self.phi[start:] @ w
        return (e - e[:head].mean() if self.integrates else e)[head:]


@dataclasses.dataclass(frozen=True)
class Choice:
    """A basis and a way to see the output, with the weights of all rows.

    Attributes:
        series: With weights of batch least squares.
        cost: Log of the free-run error over the last part of the recordings, of weights from the first.
        penalty: Ridge on weights of regressors of size one, per sample.
    """

    series: ChannelSeries
    cost: float
    penalty: float


def choose(
    bases: Iterable[Volterra],
    train: Sequence[Recording],
    channel: int,
    share: float,
    penalties: Sequence[float] = (0.0,),
) -> Choice:
    """The basis, output or rate, and ridge whose weights from the first part run best over the last.

    An angle that integrates has no finite memory: its own series would be arbitrarily wrong, that of
    its rate is not. Either is fitted to the free run itself, by regression on integrated regressors.

    Args:
        bases: Candidates.
        train: Recordings of one sampling period.
        channel: Number of the output.
        share: First part of each recording.
        penalties: Ridges to choose from, on weights of regressors of size one, per sample.
    """
    best: tuple[float, Volterra, bool, float] | None = None
    cuts = [round(share * r.N) for r in train]
    for basis in bases:
        for integrates in (False, True):
            rows = [Rows.of(basis, r, channel, integrates) for r in train]
            parts = [x.part(x.skip, c) for x, c in zip(rows, cuts, strict=True)]
            for penalty, w in zip(penalties, _quick(parts, penalties), strict=True):
                e = [x.error(w, c, r.n_init) for x, c, r in zip(rows, cuts, train, strict=True)]
                cost = float(np.log(np.sqrt(np.mean(np.concatenate(e) ** 2)) + 1e-300))
                if best is None or cost < best[0]:
                    best = (cost, basis, integrates, penalty)
    assert best is not None
    cost, basis, integrates, penalty = best
    rows = [Rows.of(basis, r, channel, integrates) for r in train]
    w = weights([x.part(x.skip, len(x.y)) for x in rows], penalty)
    return Choice(series(basis, w, integrates, train, channel, rows), cost, penalty)


def series(
    basis: Volterra,
    w: np.ndarray,
    integrates: bool,
    train: Sequence[Recording],
    channel: int,
    rows: Sequence[Rows] | None = None,
) -> ChannelSeries:
    """The series with these weights, which knows how wrong it is."""
    rows = rows or [Rows.of(basis, r, channel, integrates) for r in train]
    short = []
    for x, r in zip(rows, train, strict=True):
        e = x.y - x.phi @ w
        pieces = e[x.skip :][: (r.N - x.skip) // r.n_init * r.n_init].reshape(-1, r.n_init)
        short.append((pieces - pieces.mean(axis=1, keepdims=True) if integrates else pieces).ravel())
    noise = float(np.sqrt(np.mean(np.concatenate(short) ** 2)))
    u = np.concatenate([r.u for r in train]).astype(float)
    spread = float(u.std()) or 1.0
    floor = 1e-9 * float(np.concatenate([x.y for x in rows]).std())
    return ChannelSeries(
        basis, w, integrates, train[0].Ts, max(noise, floor, 1e-300), float(u.mean()), spread
    )


def weights(parts: Sequence[Float[np.ndarray, "M K"]], penalty: float) -> Float[np.ndarray, " P"]:
    """Least squares with a ridge on the weights of regressors of size one, per sample."""
    size, count = _sizes(parts), sum(map(len, parts))
    return solve(factor(np.concatenate([p / size for p in parts])), penalty * count).w / size[:-1]


def _quick(parts: Sequence[Float[np.ndarray, "M K"]], penalties: Sequence[float]) -> list[np.ndarray]:
    """The same for several ridges, by way of the squares: good enough to choose by."""
    size = _sizes(parts)
    H = np.sum([p.T @ p for p in (p / size for p in parts)], axis=0) / sum(map(len, parts))
    values, V = np.linalg.eigh(H[:-1, :-1])
    along = V.T @ H[:-1, -1]
    kept = values > 1e-11 * values[-1]
    return [V[:, kept] @ (along[kept] / (values[kept] + penalty)) / size[:-1] for penalty in penalties]


def _sizes(parts: Sequence[Float[np.ndarray, "M K"]]) -> Float[np.ndarray, " K"]:
    size = np.sqrt(np.sum([np.sum(p**2, axis=0) for p in parts], axis=0) / sum(map(len, parts)))
    size = np.where(size > 1e-12 * size[:-1].max(initial=0.0), size, 1.0)
    size[-1] = 1.0
    return size
