"""Methods with Volterra series of the input: banks, regression on integrated regressors, free runs."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Orthonormal, Volterra
from rotflex_jax.basis.bank import Averages, Bank
from rotflex_jax.basis.volterra import factors
from rotflex_jax.checks import Progress
from rotflex_jax.compare.linear_models import chosen_system, refined
from rotflex_jax.compare.method import Fitted, require_one_sampling_period
from rotflex_jax.fit.linear import factor, solve
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import require_period

BankKind = Literal["delays", "laguerre", "kautz", "poles"]


def candidate_banks(kind: BankKind, count: int, train: Sequence[Recording]) -> list[Bank]:
    """Banks of a kind to choose from.

    Args:
        kind: Kind of bank. `delays`: means of the input over successive intervals. `laguerre`: one real pole.
            `kautz`: one pair of poles. `poles`: the poles of a linear model that is identified first, all
            repeated until there are at least `count`.
        count: Number of columns of each bank; the least number for `poles`.
        train: Training recordings, whose length limits the memory.
    """
    longest = max(r.N for r in train)
    if kind == "delays":
        widths = np.unique(np.round(np.geomspace(1, max(2, longest / 8 / count), 8)).astype(int))
        return [Averages(count, int(w)) for w in widths]
    if kind == "laguerre":
        return [Orthonormal.laguerre(float(np.exp(-1 / s)), count) for s in np.geomspace(2, longest / 30, 10)]
    if kind == "kautz":
        found = []
        for cycles in np.geomspace(4 / longest, 0.1, 7):
            for damping in (0.15, 0.5):
                s = 2 * np.pi * cycles * (-damping + 1j * np.sqrt(1 - damping**2))
                found.append(Orthonormal.kautz(complex(np.exp(s)), count))
        return found
    return [Orthonormal(_decaying_poles(train, count), label="pole")]


def _decaying_poles(train: Sequence[Recording], count: int) -> list[complex]:
    """At least `count` poles of an identified linear model that decay within a recording, slow ones first."""
    start = chosen_system(train, (4, 6), (16, 64), 0.7, lambda _: None)[0]
    slowest = np.exp(-20 / max(r.N for r in train))
    poles = [p for p in refined(start, train).poles.tolist() if 0.5 < abs(p) < slowest]
    pairs = sorted(
        {(round(p.real, 12), round(abs(p.imag), 12)) for p in poles}, key=lambda p: -abs(complex(*p))
    )
    if not pairs:
        raise RuntimeError("the linear model has no pole that decays within the recording")
    found: list[complex] = []
    while len(found) < count:
        for re, im in pairs:
            found += [complex(re, im), complex(re, -im)] if im else [complex(re)]
    return found


# Number of segments of constant unknown input before the recording, which are longer further in the past.
PAST_SEGMENTS = 12
LONGEST_PAST_SAMPLES = 4000


@dataclasses.dataclass(frozen=True)
class ChannelSeries:
    """A weighted sum of the regressors of a basis of the input, for one output.

        y[t] = w phi[t],  or where it integrates  y[t] = y[t-1] + Ts w phi[t]

    Attributes:
        basis: Volterra series on a bank.
        weights: Weights of the regressors.
        integrates: Whether the series models the rate of the output.
        Ts: Sampling period for which the series holds [s].
        noise: Error of the series over intervals of `n_init` samples [unit of the output].
        mean: Mean of the input; prior mean of the unknown past input.
        spread: Standard deviation of the input; prior standard deviation of the unknown past input.
    """

    basis: Volterra
    weights: Float[np.ndarray, " P"]
    integrates: bool
    Ts: float
    noise: float
    mean: float
    spread: float

    def simulate(self, u: Float[np.ndarray, " N"], head: Float[np.ndarray, " M"]) -> Float[np.ndarray, " N"]:
        """Free run from the input and the first samples of the output."""
        reach, m = min(int(self.basis.bank.reach), LONGEST_PAST_SAMPLES), len(head)
        edges = np.unique(np.round(np.geomspace(1, reach, PAST_SEGMENTS)).astype(int))
        edges = np.concatenate([[0], edges])
        # The bank is linear and time-invariant: a segment of input is a step less a later step.
        step = bank_outputs(self.basis.bank, np.ones(reach + m))
        until = [step[b : b + m] for b in edges]
        unknown = self.spread * np.stack([b - a for a, b in itertools.pairwise(until)])
        known = bank_outputs(self.basis.bank, np.concatenate([np.full(reach, self.mean), u]))[reach:]
        a = self._past(head, known[:m], unknown)
        past = np.full(reach, self.mean)
        for k, (late, early) in enumerate(itertools.pairwise(edges)):
            past[reach - early : reach - late] += self.spread * a[k]
        run = self._output(bank_outputs(self.basis.bank, np.concatenate([past, u]))[reach:])
        return run + np.mean(head - run[:m]) if self.integrates else run

    def _output(self, z: Float[np.ndarray, "N M"]) -> Float[np.ndarray, " N"]:
        rate = monomials(self.basis, z) @ self.weights
        return self.Ts * np.cumsum(rate) if self.integrates else rate

    def _past(self, head: np.ndarray, known: np.ndarray, unknown: np.ndarray) -> Float[np.ndarray, " K"]:
        """Most likely input before the first sample, in standard deviations from its mean."""

        def missed(a: np.ndarray) -> np.ndarray:
            e = head - self._output(known + np.tensordot(a, unknown, axes=1))
            return np.concatenate([(e - e.mean() if self.integrates else e) / self.noise, a])

        a = np.zeros(len(unknown))
        e = missed(a)
        damping = 1e-3
        for _ in range(12):
            J = np.stack([(missed(a + d) - e) / 1e-4 for d in 1e-4 * np.eye(len(a))], axis=1)
            H, b, before = J.T @ J, J.T @ e, float(e @ e)
            # With a polynomial a step may overshoot: then a shorter step is taken, or none.
            for _ in range(5):
                move = np.linalg.solve(H + damping * np.diag(np.diag(H)), -b)
                new = missed(a + move)
                if new @ new < before:
                    a, e, damping = a + move, new, damping / 10
                    break
                damping *= 10
            if not float(e @ e) < 0.99 * before:
                break
        return a


@dataclasses.dataclass(frozen=True)
class SeriesModel:
    """One series for each output, independent of how its weights were learned."""

    channels: tuple[ChannelSeries, ...]

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run from the input and the first `n_init` samples of the outputs."""
        Ts, m = self.channels[0].Ts, recording.n_init
        require_period(Ts, recording.Ts, "The series holds")
        u = recording.u.astype(float)
        return np.stack([c.simulate(u, recording.y[:m, i]) for i, c in enumerate(self.channels)], axis=1)

    def predict(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """One-step-ahead prediction: a rate is added to the last sample; other outputs are free runs."""
        run, y = self.simulate(recording), recording.y.astype(float)
        for i, c in enumerate(self.channels):
            if c.integrates:
                run[1:, i] = y[:-1, i] + np.diff(run[:, i])
        return run

    @property
    def parameters(self) -> int:
        """Number of weights that are not zero."""
        return sum(int(np.count_nonzero(c.weights)) for c in self.channels)


def bank_outputs(bank: Bank, u: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N M"]:
    """Outputs of a bank; signals of similar lengths share one compilation."""
    padded = np.zeros(max(512, 1 << (len(u) - 1).bit_length()))
    padded[: len(u)] = u
    return np.asarray(bank.outputs(padded))[: len(u)]


def monomials(basis: Volterra, z: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N P"]:
    """Regressors from outputs of the bank, degree by degree."""
    columns = []
    for degree in basis.chosen:
        if degree == 0:
            columns.append(np.ones((len(z), 1)))
            continue
        picked = factors(basis.bank.size, degree, basis.layout)
        product = z[:, picked[:, 0]]
        for column in picked.T[1:]:
            product = product * z[:, column]
        columns.append(product)
    return np.concatenate(columns, axis=1)


def series_model(parts: Sequence[ChannelSeries]) -> SeriesModel:
    """The series of all outputs as one model.

    Raises:
        RuntimeError: A weight is not finite.
    """
    if not all(np.isfinite(c.weights).all() for c in parts):
        raise RuntimeError("the weights are not finite")
    return SeriesModel(tuple(parts))


@dataclasses.dataclass(frozen=True)
class SeriesRegression:
    """Regressors and output of one recording.

    Attributes:
        phi: Regressors; integrated if the series models the rate of the output.
        y: Output.
        skip: Number of samples at the start that do not count, because the input before is unknown.
        integrates: Whether only changes of the output count, not its level.
    """

    phi: Float[np.ndarray, "N P"]
    y: Float[np.ndarray, " N"]
    skip: int
    integrates: bool

    @classmethod
    def of(cls, basis: Volterra, recording: Recording, channel: int, integrates: bool) -> "SeriesRegression":
        """The regression of a recording."""
        phi = monomials(basis, bank_outputs(basis.bank, recording.u.astype(float)))
        if integrates:
            phi = recording.Ts * np.cumsum(phi, axis=0)
        skip = max(recording.n_init, min(int(basis.bank.reach), recording.N // 5))
        return cls(phi, recording.y[:, channel].astype(float), skip, integrates)

    def part(self, start: int, end: int) -> Float[np.ndarray, "M K"]:
        """Rows `[phi, y]`; without their mean if the level does not count."""
        joined = np.column_stack([self.phi[start:end], self.y[start:end]])
        return joined - joined.mean(axis=0) if self.integrates else joined

    def error(self, w: Float[np.ndarray, " P"], start: int, head: int) -> Float[np.ndarray, " M"]:
        """Error of the weights in a free run that starts at `start` and uses the first `head` samples."""
        e = self.y[start:] - self.phi[start:] @ w
        return (e - e[:head].mean() if self.integrates else e)[head:]


@dataclasses.dataclass(frozen=True)
class SelectedSeries:
    """The selected basis for one output, with weights from all training data.

    Attributes:
        series: Series with the weights of batch least squares.
        cost: Logarithm of the free-run error over the validation part, with weights from the first part.
        penalty: Ridge penalty on the weights of regressors of size one, per sample.
    """

    series: ChannelSeries
    cost: float
    penalty: float


def select_series(
    bases: Iterable[Volterra],
    train: Sequence[Recording],
    channel: int,
    share: float,
    penalties: Sequence[float] = (0.0,),
) -> SelectedSeries:
    """The basis, series of output or rate, and ridge with the least free-run error over the validation part.

    An angle that integrates has no finite memory: a series of the angle would be arbitrarily wrong, but a
    series of its rate is not. Both are fitted to the free run, by regression on integrated regressors.

    Args:
        bases: Candidates.
        train: Recordings with one sampling period.
        channel: Index of the output.
        share: Share of each recording in the first part.
        penalties: Ridge penalties to choose from, on the weights of regressors of size one, per sample.
    """
    best: tuple[float, Volterra, bool, float] | None = None
    cuts = [round(share * r.N) for r in train]
    for basis in bases:
        for integrates in (False, True):
            rows = [SeriesRegression.of(basis, r, channel, integrates) for r in train]
            parts = [x.part(x.skip, c) for x, c in zip(rows, cuts, strict=True)]
            for penalty, w in zip(penalties, _ridge_path(parts, penalties), strict=True):
                e = [x.error(w, c, r.n_init) for x, c, r in zip(rows, cuts, train, strict=True)]
                cost = float(np.log(np.sqrt(np.mean(np.concatenate(e) ** 2)) + 1e-300))
                if best is None or cost < best[0]:
                    best = (cost, basis, integrates, penalty)
    assert best is not None
    cost, basis, integrates, penalty = best
    rows = [SeriesRegression.of(basis, r, channel, integrates) for r in train]
    w = ridge_weights([x.part(x.skip, len(x.y)) for x in rows], penalty)
    return SelectedSeries(channel_series(basis, w, integrates, train, channel, rows), cost, penalty)


def channel_series(
    basis: Volterra,
    w: Float[np.ndarray, " P"],
    integrates: bool,
    train: Sequence[Recording],
    channel: int,
    rows: Sequence[SeriesRegression] | None = None,
) -> ChannelSeries:
    """The series with these weights, and with the size of its error."""
    rows = rows or [SeriesRegression.of(basis, r, channel, integrates) for r in train]
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


def ridge_weights(parts: Sequence[Float[np.ndarray, "M K"]], penalty: float) -> Float[np.ndarray, " P"]:
    """Weights by least squares, with a ridge penalty on the weights of regressors of size one, per sample."""
    size, count = _regressor_scales(parts), sum(map(len, parts))
    return solve(factor(np.concatenate([p / size for p in parts])), penalty * count).w / size[:-1]


def _ridge_path(parts: Sequence[Float[np.ndarray, "M K"]], penalties: Sequence[float]) -> list[np.ndarray]:
    """Weights for several ridge penalties, from the normal equations: accurate enough for a choice."""
    size = _regressor_scales(parts)
    H = np.sum([p.T @ p for p in (p / size for p in parts)], axis=0) / sum(map(len, parts))
    values, V = np.linalg.eigh(H[:-1, :-1])
    along = V.T @ H[:-1, -1]
    kept = values > 1e-11 * values[-1]
    return [V[:, kept] @ (along[kept] / (values[kept] + penalty)) / size[:-1] for penalty in penalties]


def _regressor_scales(parts: Sequence[Float[np.ndarray, "M K"]]) -> Float[np.ndarray, " K"]:
    size = np.sqrt(np.sum([np.sum(p**2, axis=0) for p in parts], axis=0) / sum(map(len, parts)))
    size = np.where(size > 1e-12 * size[:-1].max(initial=0.0), size, 1.0)
    size[-1] = 1.0
    return size


RIDGES = (1e-9, 1e-7, 1e-5, 1e-3, 1e-1)


@dataclasses.dataclass(frozen=True)
class BatchSeries:
    """A Volterra series of the input by batch least squares, fitted to free runs.

    The time scale of the bank, and whether the series models an output or its rate, are chosen for each
    output by the best free run over the last part of the training recordings. Not for friction that sticks:
    no polynomial of the past input keeps a machine at rest.

    Source: Schetzen 1980; orthonormal banks Wahlberg 1991, IEEE Trans. Autom. Control 36.

    Attributes:
        name: Short name.
        title: Description in words.
        bank: Kind of the bank.
        order: Order of the Volterra series.
        count: Number of columns of the bank.
        penalties: Ridge penalties to choose from, on the weights of regressors of size one, per sample.
        share: Share of each training recording to learn from; the rest is for validation.
    """

    name: str
    title: str
    bank: BankKind = "delays"
    order: int = 2
    count: int = 12
    penalties: tuple[float, ...] = (0.0,)
    share: float = 0.7
    family: str = "series"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose a series for each output and fit it; `model` is ignored."""
        require_one_sampling_period(train, "a series")
        candidates = [Volterra(b, self.order) for b in candidate_banks(self.bank, self.count, train)]
        choices = []
        for c, name in enumerate(train[0].channels):
            choices.append(select_series(candidates, train, c, self.share, self.penalties))
            say(f"{name}: log error {choices[-1].cost:.2f}")
        found = series_model([choice.series for choice in choices])
        return Fitted(found, found.parameters, describe_selection(choices, train[0]), found.predict)


def describe_selection(choices: Sequence[SelectedSeries], recording: Recording) -> str:
    """The selection for each channel, as a phrase."""
    phrases = []
    for choice, name in zip(choices, recording.channels, strict=True):
        bank = choice.series.basis.bank
        seconds = min(int(bank.reach), recording.N) * recording.Ts
        rate = "rate of " if choice.series.integrates else ""
        phrases.append(f"{rate}{name} from {seconds:.2g} s of input")
    return ", ".join(phrases)
