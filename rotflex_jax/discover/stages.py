"""Turns a hypothesis into what a person reads: estimates with intervals, held-out runs and errors."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.decide import Trial
from rotflex_jax.discover.lanes import Hypothesis, constrain
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.result import Stage
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.discover.whiten import log_likelihood
from rotflex_jax.fit.covariance import sandwich
from rotflex_jax.metrics import rmse
from rotflex_jax.model import Model, window_starts
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording


@dataclasses.dataclass(frozen=True)
class Scribe:
    """Writes stages.

    Attributes:
        judge: With the training recordings.
        away: With the held-out recordings.
        model: The user's.
        train: Training recordings.
        test: Held-out recordings.
        window_seconds: Length of the short held-out runs [s].
    """

    judge: Judge
    away: Judge
    model: Model
    train: Sequence[Recording]
    test: Sequence[Recording]
    window_seconds: float

    def stage(self, h: Hypothesis, trial: Trial) -> Stage:
        """A stage of the loop from a trained hypothesis and its held-out likelihood."""
        s = self.judge.bench.supermodel
        values = h.values(self.judge.bench).mean(axis=0)
        # All stages run in the super-model, gates apart, and so share its compiled code.
        runner = Model(s.mechanism.with_values(values), self.model.solver, tuple(s.gates(h.places)))
        simulated = tuple(runner.simulate(r) for r in self.test)
        windowed = tuple(runner.simulate_windows(r, self.window_seconds) for r in self.test)
        return Stage(
            model=Model(s.clean(values, h.places), self.model.solver),
            estimates=self.estimates(h),
            held_out_rmse=self._errors(simulated, whole=True),
            held_out_rmse_windows=self._errors(windowed, whole=False),
            simulated=simulated,
            windowed=windowed,
            window_seconds=self.window_seconds,
            process_noise=h.process_noise,
            process_noise_nats=self._process_noise_nats(h),
            log_likelihood=trial.held_out,
        )

    def _errors(self, runs: Sequence[np.ndarray], whole: bool) -> dict[str, float]:
        """Root mean square error per channel over all held-out samples that no run was started from."""
        channels = self.model.mechanism.channels
        measured, modelled = [], []
        for r, y_hat in zip(self.test, runs, strict=True):
            counts = np.ones(r.N, bool)
            for start in [0] if whole else window_starts(r, self.window_seconds)[0]:
                counts[start : start + r.n_init] = False
            measured.append(self.model.measured(r)[counts])
            modelled.append(y_hat[counts])
        errors = rmse(np.concatenate(measured), np.concatenate(modelled))
        return dict(zip(channels, np.asarray(errors).tolist(), strict=True))

    def _process_noise_nats(self, h: Hypothesis) -> float:
        """Log-likelihood that process torques gain over a free run with the same parameters."""
        judge = self.judge
        still = judge.with_process_noise(h, dict.fromkeys(judge.ports, judge.horizon[0]))
        e = judge.bench.innovations([h.lane(judge.bench), still.lane(judge.bench)])
        seen = judge.bench.data.seen
        with_noise, without = (log_likelihood(x, seen, judge.noise, 0) for x in e)
        return with_noise - without

    def estimates(self, h: Hypothesis) -> tuple[Estimate, ...]:
        """Parameters of the baseline and of what was added, intervals robust to correlated residuals."""
        bench, s = self.judge.bench, self.judge.bench.supermodel
        e, J = bench.slopes([h.lane(bench)], [h.directions(bench, max(self.judge.directions(), h.moved))])
        seen = bench.data.seen
        w = h.whitener(e[0], seen)
        W = h.whitener(J[0, : h.moved], seen)
        R, shared, each = len(h.x0), len(h.free), h.moved - len(h.free)
        slopes = np.zeros((*w.shape, shared + R * each))
        for r in range(R):
            slopes[r, ..., :shared] = np.moveaxis(W[:shared, r], 0, -1)
            here = slice(shared + r * each, shared + (r + 1) * each)
            slopes[r, ..., here] = np.moveaxis(W[shared:, r], 0, -1)
        inside = seen.ravel() > 0
        C, D = w.shape[-1], slopes.shape[-1]
        segments = np.repeat(np.arange(R), w.shape[1])[inside]
        covariance = sandwich(slopes.reshape(-1, C, D)[inside], w.reshape(-1, C)[inside], segments)
        z = np.tile(h.z, (R, 1))
        if h.local:
            z[:, list(h.local)] = h.own
        values, stretch = constrain(bench, z)
        out = []
        clean = s.clean(values.mean(axis=0), h.places)
        names = s.mechanism.parameter_names
        for name, spec in zip(clean.parameter_names, clean.parameter_specifications, strict=True):
            i = names.index(name)
            value = float(values[:, i].mean())
            if i in h.free:
                rows, weight = [h.free.index(i)], np.array([stretch[0, i]])
            elif i in h.local:
                rows = [shared + r * each + h.local.index(i) for r in range(R)]
                weight = stretch[:, i] / R
            else:
                nan = float("nan")
                out.append(Estimate(name, value, nan, (nan, nan), spec.unit, free=False))
                continue
            std = float(np.sqrt(max(weight @ covariance[np.ix_(rows, rows)] @ weight, 0.0)))
            low, high = spec.physical
            note = "" if low <= value <= high else "outside its physical range"
            if i in h.local and R > 1:
                note = "mean of " + ", ".join(f"{v:.3g}" for v in values[:, i])
            out.append(Estimate(name, value, std, (value - 1.96 * std, value + 1.96 * std), spec.unit, note=note))
        return tuple(out)

    def own_estimates(self, stage: Stage, place: Place) -> dict[str, Estimate]:
        """Estimates of one effect of a stage, by short name."""
        head = f"{place[1]}.{place[0]}."
        return {e.name.removeprefix(head): e for e in stage.estimates if e.name.startswith(head)}
