"""Turns a hypothesis into what a person reads: estimates with intervals, held-out runs and errors."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotflex_jax.discover.heldout import Away, Trial
from rotflex_jax.discover.hypothesis import Hypothesis, constrain
from rotflex_jax.discover.refit import Judge
from rotflex_jax.discover.result import Stage
from rotflex_jax.discover.supermodel import Place
from rotflex_jax.discover.whiten import log_likelihood
from rotflex_jax.fit.covariance import Part, curvature, sandwich
from rotflex_jax.mechanism import Solver
from rotflex_jax.model import Model
from rotflex_jax.parameters import Estimate


@dataclasses.dataclass(frozen=True)
class Scribe:
    """Writes stages.

    Attributes:
        judge: With the training recordings.
        away: The held-out recordings.
        solver: Of the models that a user gets.
    """

    judge: Judge
    away: Away
    solver: Solver

    def stage(self, trial: Trial, places: Sequence[Place]) -> Stage:
        """A stage of the loop.

        Args:
            trial: Trained hypothesis and its held-out likelihood.
            places: What the stage's model has; calibrations that belong to the training recordings alone
                are in the hypothesis, but not here.
        """
        h, away = trial.hypothesis, self.away
        bench = self.judge.bench
        values = h.values(bench).mean(axis=0)
        runners = [away.runner(trial.trained, places, r) for r in range(len(away.recordings))]
        pairs = list(zip(runners, away.recordings, strict=True))
        simulated = tuple(runner.simulate(r) for runner, r in pairs)
        windowed = tuple(runner.simulate_windows(r, away.seconds) for runner, r in pairs)
        channels = bench.supermodel.baseline.channels
        errors = [y_hat - runner.measured(r) for y_hat, (runner, r) in zip(simulated, pairs, strict=True)]
        whole = np.concatenate([e[r.n_init :] for e, r in zip(errors, away.recordings, strict=True)])
        return Stage(
            model=Model(bench.supermodel.clean(values, places), self.solver),
            estimates=self.estimates(h),
            held_out_rmse=dict(zip(channels, np.sqrt(np.mean(whole**2, axis=0)).tolist(), strict=True)),
            held_out_rmse_windows=dict(zip(channels, away.windows(windowed).tolist(), strict=True)),
            simulated=simulated,
            windowed=windowed,
            window_seconds=away.seconds,
            process_noise=h.process_noise,
            process_noise_nats=self._process_noise_nats(h),
            log_likelihood=trial.held_out,
        )

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
        parts = []
        for r in range(R):
            inside, own = seen[r] > 0, shared + r * each + np.arange(each)
            slopes = np.moveaxis(W[:, r], 0, -1)[inside]
            parts.append(Part(slopes, w[r][inside], np.concatenate([np.arange(shared), own])))
        covariance = sandwich(parts, curvature(parts, shared + R * each))
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
            each_own = i in h.local and R > 1
            note = "mean of " + ", ".join(f"{v:.3g}" for v in values[:, i]) if each_own else ""
            out.append(Estimate.of(name, value, std, spec, note))
        return tuple(out)

    def own_estimates(self, stage: Stage, place: Place) -> dict[str, Estimate]:
        """Estimates of one effect of a stage, by short name."""
        head = f"{place[1]}.{place[0]}."
        return {e.name.removeprefix(head): e for e in stage.estimates if e.name.startswith(head)}
