"""Volterra series that are adapted sample by sample (LMS, NLMS, RLS, Kalman), with tuned settings."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.adaptive import LMS, NLMS, RLS, AdaptiveFilter, Kalman, grid, run, tune
from rotflex_jax.basis import Volterra
from rotflex_jax.basis.bank import evaluate
from rotflex_jax.checks import Progress
from rotflex_jax.compare.method import Fitted, require_one_sampling_period
from rotflex_jax.compare.series import (
    RIDGES,
    BankKind,
    ChannelSeries,
    SeriesRegression,
    candidate_banks,
    channel_series,
    describe_selection,
    select_series,
    series_model,
)
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE

FilterRule = Literal["lms", "nlms", "rls", "kalman"]


@dataclasses.dataclass(frozen=True)
class AdaptiveSeries:
    """A Volterra series whose weights are adapted by a filter, then frozen.

    Bank, time scale, and series of output or rate are chosen by batch least squares, so that the filter alone
    makes the difference. A rate is learned from changes of the output over `n_init` samples, because changes
    over one sample are mostly noise. The settings of the filter are chosen on halves of the recordings, each
    validated on the others; the number of passes is chosen by the free run over the last part. Not the best
    use of a whole recording: least squares is exact, and LMS only approaches it.

    Source: Mathews and Sicuranza 2000, Polynomial Signal Processing; Haykin 2002.

    Attributes:
        name: Short name.
        title: Description in words.
        rule: Kind of filter.
        gradient: Whether settings are tuned by the gradient through the filter instead of by a grid.
        bank: Kind of the bank.
        order: Order of the Volterra series.
        count: Number of columns of the bank.
        passes: Largest number of passes through the recordings; RLS and Kalman filters make one pass.
        share: Share of each recording in the first part; the rest is for validation.
    """

    name: str
    title: str
    rule: FilterRule = "lms"
    gradient: bool = False
    bank: BankKind = "delays"
    order: int = 2
    count: int = 10
    passes: int = 30
    share: float = 0.7
    family: str = "adaptive"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Choose a series for each output and adapt its weights; `model` is ignored."""
        require_one_sampling_period(train, "a series")
        candidates = [Volterra(b, self.order) for b in candidate_banks(self.bank, self.count, train)]
        choices, adapted, phrases = [], [], []
        for c, name in enumerate(train[0].channels):
            choices.append(select_series(candidates, train, c, self.share, RIDGES))
            series, words = self._adapt(choices[-1].series, train, c)
            adapted.append(series)
            phrases.append(words)
            say(f"{name}: {words}")
        result = series_model(adapted)
        words = f"{describe_selection(choices, train[0])}; {', '.join(phrases)}"
        return Fitted(result, result.parameters, words, result.predict)

    def _adapt(self, batch: ChannelSeries, train: Sequence[Recording], c: int) -> tuple[ChannelSeries, str]:
        """The series with weights of the filter, on the basis of a batch fit, and the settings in words."""
        rows = [SeriesRegression.of(batch.basis, r, c, batch.integrates) for r in train]
        hold = train[0].n_init if batch.integrates else 0
        data = [_training_rows(x, hold) for x in rows]
        size = np.sqrt(np.mean(np.concatenate(data) ** 2, axis=0))
        size = np.where(size > 0, size, 1.0)
        shaped = NormalisedSeries(batch.basis, size, hold, batch.Ts)
        halves = [h for r in train for h in _equal_parts(r, c, hold, size[-1], min(x.N for x in train) // 2)]
        noise = batch.noise / size[-1]
        settings, filter = self._settings(shaped, halves, noise)
        cuts = [round(self.share * r.N) for r in train]
        first = np.concatenate([d[:n] for d, n in zip(data, cuts, strict=True)]) / size
        passes = self.passes if self.rule in ("lms", "nlms") else 1
        path = run(
            filter, np.tile(first[:, :-1], (passes, 1)), np.tile(first[:, -1], passes), keep_every=len(first)
        ).path
        costs = []
        for w in path[1:] / size[:-1] * size[-1]:
            e = [x.error(w, n, r.n_init) for x, n, r in zip(rows, cuts, train, strict=True)]
            costs.append(float(np.mean(np.concatenate(e) ** 2)))
        best = 1 + int(np.argmin(np.nan_to_num(costs, nan=np.inf, posinf=np.inf)))
        whole = np.concatenate(data) / size
        end = run(filter, np.tile(whole[:, :-1], (best, 1)), np.tile(whole[:, -1], best))
        if end.diverged:
            raise RuntimeError(f"the filter {end.status}")
        w = end.weights / size[:-1] * size[-1]
        times = f", {best} passes" if passes > 1 else ""
        return channel_series(batch.basis, w, batch.integrates, train, c, rows), settings + times

    def _settings(
        self, basis: "NormalisedSeries", halves: Sequence[Recording], noise: float
    ) -> tuple[str, AdaptiveFilter]:
        """Settings in words and filter with the least error of its last weights on the other halves."""
        P, rule = basis.size, self.rule
        # Only the Kalman filter uses the noise; for the others 0 keeps one program for all data.
        known = float(noise) if rule == "kalman" else 0.0
        build = FilterFactory(rule, tuple((basis.degrees > 1).tolist()), known)
        axes: dict[str, Any] = {
            "lms": {"mu": np.logspace(-3.5, -0.3, 7) / P, "mu_products": np.logspace(-3.5, -0.3, 7) / P},
            "nlms": {"mu": np.logspace(-3.5, 0, 10)},
            "rls": {"lam": 1 - np.array([0.0, 1e-4, 1e-3]), "delta": np.logspace(0, 6, 7)},
            "kalman": {"q": np.logspace(-12, -4, 5), "p0": np.logspace(-2, 4, 4)},
        }[rule]
        if self.gradient:
            start = [{name: float(v[i * len(v) // 3]) for name, v in axes.items()} for i in (1, 2)]
            found = tune(build, start, basis, halves, "y", objective="final", evaluations=25)
        else:
            found = grid(build, axes, basis, halves, "y", objective="final")
        return ", ".join(f"{k} {v:.2g}" for k, v in found.settings.items()), found.filter


@dataclasses.dataclass(frozen=True)
class FilterFactory:
    """Makes a filter from named settings; equal factories share one compilation."""

    rule: str
    products: tuple[bool, ...]
    noise: float

    def __call__(self, s: dict[str, Any]) -> AdaptiveFilter:
        """The filter; settings may be traced."""
        if self.rule == "lms":
            return LMS(jnp.where(np.array(self.products), s["mu_products"], s["mu"]))
        if self.rule == "nlms":
            return NLMS(s["mu"], 0.01 * len(self.products))
        if self.rule == "rls":
            return RLS(s["lam"], s["delta"])
        return Kalman(q=s["q"], r=max(self.noise, 1e-6) ** 2, p0=s["p0"])


class NormalisedSeries(eqx.Module):
    """Regressors of a series scaled to size one; for a rate, their integrals over `hold` samples."""

    basis: Volterra
    scale: Any
    hold: int = eqx.field(static=True)
    Ts: float = eqx.field(static=True)

    def __init__(self, basis: Volterra, size: np.ndarray, hold: int, Ts: float) -> None:
        self.basis, self.scale, self.hold, self.Ts = basis, size[:-1], hold, Ts

    @property
    def size(self) -> int:
        """Number of regressors."""
        return self.basis.size

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the regressors."""
        return self.basis.names

    @property
    def degrees(self) -> Int[np.ndarray, " P"]:
        """Degree of each regressor in the input."""
        return self.basis.degrees

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Units of the weights: all 1, because regressors and output are scaled to size one."""
        return ("1",) * self.size

    def kernels(self, w: Any, length: int | None = None) -> Mapping[int, Any]:
        """Kernels for the weights of the series before scaling."""
        return self.basis.kernels(np.asarray(w) / self.scale, length)

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N P"]:
        """Regressors for a signal."""
        phi = self.basis.respond(u)
        if self.hold:
            total = self.Ts * jnp.cumsum(phi, axis=0)
            nothing = jnp.zeros((self.hold, phi.shape[1]), phi.dtype)
            phi = total - jnp.concatenate([nothing, total[: -self.hold]])
        return phi / jnp.asarray(self.scale)[None, :]

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal, in its precision."""
        return evaluate(self, u)


def _training_rows(x: SeriesRegression, hold: int) -> Float[np.ndarray, "N K"]:
    """Regressors and output, or their changes over `hold` samples; zero rows have no influence."""
    joined = np.column_stack([x.phi, x.y])
    if hold:
        joined[hold:] = joined[hold:] - joined[:-hold]
    joined[: max(x.skip, hold)] = 0.0
    return joined


def _equal_parts(r: Recording, c: int, hold: int, size: float, length: int) -> list[Recording]:
    """Parts of equal length, with the output or its changes as the only channel."""
    y = r.y[:, [c]].astype(float)
    if hold:
        y[hold:] = y[hold:] - r.y[:-hold, [c]]
        y[:hold] = 0.0
    whole = dataclasses.replace(
        r,
        y=y / size,
        channels=("y",),
        units=("1",),
        resolution={"y": None},
        n_init=length // 3,
        accept=ACCEPTABLE,
    )
    cut = lambda i: dataclasses.replace(whole.slice(i, i + length), n_init=length // 3)  # noqa: E731
    return [cut(i) for i in range(0, r.N - length + 1, length)]
