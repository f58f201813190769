"""Section 5 of the paper as a whole: record, adapt, freeze the weights, evaluate, apply a pulse."""

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
"""By degree: about those of the experiment itself."""


@dataclasses.dataclass(frozen=True)
class ShortMemoryErrors:
    """Three errors of one model class, relative to the variance of the output.

    Attributes:
        Ts: Sampling interval [s].
        online: A-priori errors of LMS over the last half of its run.
        frozen: Its last weights on other data.
        least_squares: Least squares on the same data.
    """

    Ts: float
    online: float
    frozen: float
    least_squares: float


def short_memory_errors(s: Settings, Ts: float = 1e-3, N: int = 15000) -> ShortMemoryErrors:
    """Online, frozen and least-squares error where the memory is far too short.

    Args:
        s: Settings of the machine, the input and the memory.
        Ts: Sampling interval instead of theirs [s].
        N: Samples for training, and as many for the evaluation.
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
        settings: Of this run.
        records: For training and for the evaluation.
        adaptation: Result of the paper's algorithm.
        rows: Every model, with its errors on other data than it was fitted to.
        short_memory: Online and frozen error where the memory is too short; None on measured data.
        kernels: Kernels of the machine's equations beside those from data; None on measured data.
        elapsed_s: Time it took [s].
    """

    settings: Settings
    records: Records
    adaptation: Adaptation
    rows: tuple[EvaluatedModel, ...]
    short_memory: ShortMemoryErrors | None
    kernels: KernelComparison | None
    elapsed_s: float

    def row(self, name: str) -> EvaluatedModel:
        """A model by name."""
        return next(row for row in self.rows if row.name == name)

    def setting_rows(self) -> list[dict[str, Any]]:
        """Settings with source and reason; the numbers of a simulated machine after them."""
        rows = self.settings.rows()
        return rows if self.records.measured else rows + machine_rows(self.settings)

    def to_dict(self) -> dict[str, Any]:
        """For scripts: settings with their sources, prediction and measurement, table."""
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
    """Run the paper's experiment, simulated or on recordings.

    Args:
        settings: Defaults if None.
        train: Recordings for training; None simulates them.
        test: Recordings for the evaluation.
        joint: Linear model to compare with on recordings; the paper's joint if None.
        channel: Output to identify; the deflection if None.
        progress: Called with a line of text for every step.

    Raises:
        InputError: Recordings that do not fit the settings.
    """
    start, s = time.perf_counter(), settings or Settings()
    progress = progress or (lambda step: None)
    if train is None:
        machine(s)  # a parameter that it does not have is refused before any work
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
