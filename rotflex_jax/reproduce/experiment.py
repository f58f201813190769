"""The experiment of section 5 of the paper: record, adapt, freeze the weights, evaluate, apply a pulse."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rotflex_jax.adaptive import LMS, run
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.fit import least_squares
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import ACCEPTABLE
from rotflex_jax.reproduce import models, records as sources
from rotflex_jax.reproduce.adaptation import Adaptation, adapt
from rotflex_jax.reproduce.models import EvaluatedModel, KernelComparison, compare_kernels, grey_box, nmse
from rotflex_jax.reproduce.plants import response
from rotflex_jax.reproduce.records import Records
from rotflex_jax.reproduce.settings import Settings, linear_joint, machine, machine_rows, symmetric_twin

STEP_SIZES = {0: 1e-2, 1: 1e-2, 2: 2e-4}
"""Degree -> step size, approximately as in the experiment itself."""


@dataclasses.dataclass(frozen=True)
class ShortMemoryErrors:
    """Three errors of one model class, relative to the variance of the output (NMSE).

    Attributes:
        Ts: Sampling interval [s].
        online: A-priori errors of LMS over the last half of the training data.
        frozen: Error of the last weights of LMS on evaluation data.
        least_squares: Error of the least-squares weights on evaluation data.
    """

    Ts: float
    online: float
    frozen: float
    least_squares: float


def short_memory_errors(s: Settings, Ts: float = 1e-3, N: int = 15000) -> ShortMemoryErrors:
    """Online, frozen and least-squares error at a sampling interval for which the memory is far too short.

    Args:
        s: Settings of the machine, the input and the memory.
        Ts: Sampling interval, which replaces the interval of the settings [s].
        N: Number of samples for training, and of samples for evaluation.
    """
    fast = dataclasses.replace(s, Ts=Ts, filter="ar1")
    u = sources.filtered_noise(fast, 2 * N, np.random.default_rng(s.seed))
    y = response(symmetric_twin(fast), u, Ts, step=s.step)[:, 1]
    whole = Recording(u=u, y=y, Ts=Ts, channels="alpha", accept=ACCEPTABLE)
    train, test = whole.slice(0, N), whole.slice(N, 2 * N)
    basis = Volterra(Delays(s.memory))
    lms = run(LMS(mu=basis.step_sizes(STEP_SIZES)), basis.regressors(train.u), train.y[:, 0])
    fitted = least_squares(basis, [train], "alpha").model
    frozen = basis.regressors(test.u) @ lms.weights
    half, skip = N // 2, s.memory
    seen = test.y[skip:, 0]
    return ShortMemoryErrors(
        Ts,
        nmse([train.y[half:, 0]], [train.y[half:, 0] - lms.errors[half:]]),
        nmse([seen], [frozen[skip:]]),
        nmse([seen], [fitted.simulate(test)[skip:, 0]]),
    )


@dataclasses.dataclass(frozen=True)
class Reproduction:
    """The experiment and its results.

    Attributes:
        settings: Settings of this run.
        records: Recordings for training and evaluation.
        adaptation: Result of the paper's algorithm.
        rows: All models, with their errors on data that they were not fitted to.
        short_memory: Errors with a memory that is too short; None on measured data.
        kernels: Kernels of the machine's equations and kernels from data; None on measured data.
        elapsed_s: Computing time [s].
    """

    settings: Settings
    records: Records
    adaptation: Adaptation
    rows: tuple[EvaluatedModel, ...]
    short_memory: ShortMemoryErrors | None
    kernels: KernelComparison | None
    elapsed_s: float

    def row(self, name: str) -> EvaluatedModel:
        """The model with a name."""
        return next(row for row in self.rows if row.name == name)

    def setting_rows(self) -> list[dict[str, Any]]:
        """Rows of the settings with source and reason, then of the parameters of a simulated machine."""
        rows = self.settings.rows()
        return rows if self.records.measured else rows + machine_rows(self.settings)

    def to_dict(self) -> dict[str, Any]:
        """Settings with sources, predicted and measured convergence, and errors, as plain JSON types."""
        a = self.adaptation
        return {
            "schema": 1,
            "settings": [
                row | {"value": list(v) if isinstance(v := row["value"], tuple) else v}
                for row in self.setting_rows()
            ],
            "data": {
                "measured": self.records.measured,
                "channel": self.records.channel,
                "Ts": self.records.Ts,
                "train": [r.source for r in self.records.train[:: self.records.phases]],
                "test": [r.source for r in self.records.test[:: self.records.phases]],
            },
            "figure_9": {
                "coefficient": list(self.settings.coefficient),
                "step_sizes": {str(k): v for k, v in a.prediction.step_sizes.items()},
                "eigenvalue": a.prediction.eigenvalue,
                "predicted_settle": a.prediction.settle,
                "measured_settle": a.settle,
                "target": a.target,
                "status": a.status,
                "passes": a.passes,
            },
            "online_nmse": a.online,
            "trap": None if self.short_memory is None else dataclasses.asdict(self.short_memory),
            "kernels": None
            if self.kernels is None
            else {
                "physics": self.kernels.physics.to_dict(),
                "data": self.kernels.data.to_dict(),
            },
            "models": [
                {"name": r.name, "about": r.about, "learnt": r.size, "held_out_nmse": r.held_out}
                | {
                    "pulse_nmse": {
                        f"{p.height:+g} V": e for p, e in zip(self.records.pulses, r.pulses, strict=True)
                    }
                }
                for r in self.rows
            ],
            "elapsed_s": self.elapsed_s,
        }


def reproduce(
    settings: Settings | None = None,
    train: Sequence[Recording] | None = None,
    test: Sequence[Recording] | None = None,
    *,
    joint: Mechanism | None = None,
    channel: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Reproduction:
    """Runs the paper's experiment, simulated or on recordings.

    Args:
        settings: Settings; the defaults if None.
        train: Recordings for training; if None, all recordings are simulated.
        test: Recordings for evaluation.
        joint: Linear model for comparison on recordings; the paper's joint if None.
        channel: Output to identify; if None, the deflection, or the first output of recordings without it.
        progress: Called with a line of text for every step.

    Raises:
        InputError: The recordings do not fit the settings.
    """
    start, s = time.perf_counter(), settings or Settings()
    progress = progress or (lambda step: None)
    if train is None:
        machine(s)  # refuses an unknown parameter before any computation
        progress("simulating the machine")
        data = sources.simulated(s)
    else:
        data = sources.from_measured(s, train, test or (), joint or linear_joint(s), channel)
    adaptation = adapt(s, data, progress)
    rows = [
        models.linearised(data),
        models.evaluate_model(
            data,
            f"M={s.memory} quadratic, LMS",
            "the paper's: delays, degree 2, LMS, last weights frozen",
            adaptation.size,
            series=adaptation.model,
        ),
        *models.black_boxes(s, data, progress),
    ]
    if s.grey_box and (row := grey_box(data, progress)) is not None:
        rows.append(row)
    short_memory = None
    if not data.measured:
        progress("the online error at 1 ms")
        short_memory = short_memory_errors(s)
        progress("kernels of the equations")
    return Reproduction(
        s, data, adaptation, tuple(rows), short_memory, compare_kernels(s, data), time.perf_counter() - start
    )
