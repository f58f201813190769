"""Section 5 of the paper from end to end: record, adapt, freeze, judge, pulse."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

from rotflex_jax.mechanism import Mechanism
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce import models, records as sources
from rotflex_jax.reproduce.adaptation import Adaptation, adapt
from rotflex_jax.reproduce.bridge import Bridge, bridge
from rotflex_jax.reproduce.grey import grey_box
from rotflex_jax.reproduce.machine import linear_joint, machine, machine_rows
from rotflex_jax.reproduce.models import Judged
from rotflex_jax.reproduce.records import Records
from rotflex_jax.reproduce.settings import Settings
from rotflex_jax.reproduce.trap import Trap, online_trap

Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Reproduction:
    """The experiment and its results.

    Attributes:
        settings: Of this run.
        records: What was learnt from and judged on.
        adaptation: What the paper's algorithm did.
        rows: Every model, with its errors on data it never saw.
        trap: Online and frozen error where the memory is too short; None on measured data.
        bridge: Kernels of the machine's equations beside those from data; None on measured data.
        elapsed_s: Time it took [s].
    """

    settings: Settings
    records: Records
    adaptation: Adaptation
    rows: tuple[Judged, ...]
    trap: Trap | None
    bridge: Bridge | None
    elapsed_s: float

    def row(self, name: str) -> Judged:
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
            "trap": None if self.trap is None else dataclasses.asdict(self.trap),
            "kernels": None
            if self.bridge is None
            else {"physics": self.bridge.physics.to_dict(), "data": self.bridge.data.to_dict()},
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
    progress: Say | None = None,
) -> Reproduction:
    """Run the paper's experiment, simulated or on recordings.

    Args:
        settings: Defaults if None.
        train: Recordings to learn from; None simulates.
        test: Recordings to judge on.
        joint: Linear model to compare with on recordings; the paper's joint if None.
        channel: Output to identify; the deflection if None.
        progress: Told of every step.

    Raises:
        InputError: Recordings that do not fit the settings.
    """
    began, s, say = time.perf_counter(), settings or Settings(), progress or (lambda step: None)
    if train is None:
        machine(s)  # a number that it does not have is refused before any work
        say("simulating the machine")
        data = sources.simulated(s)
    else:
        data = sources.from_measured(s, train, test or (), joint or linear_joint(s), channel)
    adaptation = adapt(s, data, say)
    rows = [
        models.linearised(data),
        models.judged(
            data,
            f"M={s.memory} quadratic, LMS",
            "the paper's: delays, degree 2, LMS, last weights frozen",
            adaptation.size,
            series=adaptation.model,
        ),
        *models.black_boxes(s, data, say),
    ]
    if s.grey_box and (row := grey_box(data, say)) is not None:
        rows.append(row)
    trap = None
    if not data.measured:
        say("the online error at 1 ms")
        trap = online_trap(s)
        say("kernels of the equations")
    return Reproduction(s, data, adaptation, tuple(rows), trap, bridge(s, data), time.perf_counter() - began)
