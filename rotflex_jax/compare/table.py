"""The result of a comparison: one row for each method, best first, and the sensor noise."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.compare.method import Horizon, Simulator
from rotflex_jax.errors import InputError, optional
from rotflex_jax.recording import Recording
from rotflex_jax.text.markup import bullets, card, folded, table
from rotflex_jax.text.numbers import digits, json_number, json_numbers, readable


def cells(comparison: "Comparison") -> list[list[str]]:
    """The table as text: headings, the methods with the status `ok`, the sensor noise."""
    units = comparison.units
    head = ["method"]
    for what in (f"{comparison.window_seconds:g} s rms", "rms", "worst"):
        head += [f"{c} {what} [{readable(0.0, unit)[1]}]" for c, unit in units.items()]
    head += [f"{c} fit [%]" for c in units]
    head += [f"{c} 1 step [{readable(0.0, unit)[1]}]" for c, unit in units.items()]
    head += ["fitted", "fit [s]", "simulate [s]"]
    body = []
    for row in comparison.rows:
        if row.status == "ok":
            lengths = [
                digits(readable(errors[c], unit)[0])
                for errors in (row.rmse_windows, row.rmse, row.worst)
                for c, unit in units.items()
            ]
            shares = [f"{row.fit_percent[c]:.2f}" for c in units]
            ahead = [digits(_one_step(row, c, unit)) for c, unit in units.items()]
            times = [digits(row.fit_seconds), digits(row.simulate_seconds)]
            body.append([row.method, *lengths, *shares, *ahead, str(row.parameters), *times])
    floor = [digits(readable(comparison.noise_floor[c], unit)[0]) for c, unit in units.items()]
    noise = ["sensor noise", *floor, *floor]
    return [head, *body, noise + [""] * (len(head) - len(noise))]


def aligned(cells: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a plain table; headings in two lines, so that it stays narrow."""
    halves = [[h.rpartition(" ")[0] for h in cells[0]], [h.rpartition(" ")[2] for h in cells[0]]]
    halves[0][0], halves[1][0] = "", cells[0][0]
    rows = [*halves, *cells[1:]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            [
                row[0].ljust(widths[0]),
                *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)),
            ]
        ).rstrip()
        for row in rows
    ]


def _one_step(row: "Row", channel: str, unit: str) -> float | None:
    return readable(row.rmse_one_step[channel], unit)[0] if channel in row.rmse_one_step else None


ChannelErrors = dict[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """Result of one method.

    Attributes:
        method: Name of the method.
        title: Description of the method.
        family: Kind of method: `physics`, `linear`, `series`, `adaptive`, `sindy`, `learned` or `other`.
        status: `ok`, `diverged` or `failed`.
        reason: Why the method failed or diverged; "" if its status is `ok`.
        note: Further information, such as its order, or what it left out or added.
        rmse: Channel -> root mean square error of one free run over the test data [unit].
        nrmse: Channel -> `rmse` divided by the standard deviation of the measurement [-].
        fit_percent: Channel -> 100 (1 - nrmse) [%].
        worst: Channel -> largest error of this free run [unit].
        rmse_windows: Channel -> root mean square error of free runs over windows [unit].
        rmse_one_step: Channel -> root mean square error one step ahead [unit]; empty without a predictor.
        horizon: Error of free runs as a function of the horizon; None if the method failed.
        parameters: Number of fitted parameters; None if the method failed.
        fit_seconds: Time to learn [s], including compilation of code that no earlier method needed.
        simulate_seconds: Time of the free runs over the test data, without compilation [s].
        simulator: The learned model; None if the method failed.
        simulated: Free run of the model over each test recording.
    """

    method: str
    title: str
    family: str = "other"
    status: str = "ok"
    reason: str = ""
    note: str = ""
    rmse: ChannelErrors = dataclasses.field(default_factory=dict)
    nrmse: ChannelErrors = dataclasses.field(default_factory=dict)
    fit_percent: ChannelErrors = dataclasses.field(default_factory=dict)
    worst: ChannelErrors = dataclasses.field(default_factory=dict)
    rmse_windows: ChannelErrors = dataclasses.field(default_factory=dict)
    rmse_one_step: ChannelErrors = dataclasses.field(default_factory=dict)
    horizon: Horizon | None = None
    parameters: int | None = None
    fit_seconds: float | None = None
    simulate_seconds: float | None = None
    simulator: Simulator | None = dataclasses.field(default=None, repr=False)
    simulated: tuple[Float[np.ndarray, "_ C"], ...] = dataclasses.field(default=(), repr=False)

    @property
    def score(self) -> float:
        """Mean over the channels of the logarithm of `rmse`; infinite unless the status is `ok`."""
        if self.status != "ok":
            return math.inf
        return float(np.mean([math.log(max(e, 1e-300)) for e in self.rmse.values()]))

    def to_dict(self, window_seconds: float) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "method": self.method,
            "title": self.title,
            "family": self.family,
            "status": self.status,
            "reason": self.reason,
            "note": self.note,
            "held_out_rmse": json_numbers(self.rmse),
            "held_out_rmse_windows": {"seconds": window_seconds, **json_numbers(self.rmse_windows)},
            "held_out_nrmse": json_numbers(self.nrmse),
            "held_out_fit_percent": json_numbers(self.fit_percent),
            "held_out_worst": json_numbers(self.worst),
            "held_out_rmse_one_step": json_numbers(self.rmse_one_step),
            "horizon": None
            if self.horizon is None
            else {
                "seconds": list(self.horizon.seconds),
                "runs": self.horizon.runs,
                **{c: [json_number(v) for v in e] for c, e in self.horizon.rmse.items()},
            },
            "parameters": self.parameters,
            "fit_seconds": self.fit_seconds,
            "simulate_seconds": self.simulate_seconds,
        }


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Results of several methods on the same data.

    Attributes:
        rows: One row for each method: smallest free-run error first, diverged and failed methods last.
        train: Training recordings.
        test: Test recordings; of their outputs each method received only the first `n_init` samples.
        noise_floor: Channel -> standard deviation of the sensor noise [unit].
        window_seconds: Length of the windows [s].
        elapsed_s: Time taken [s].
    """

    rows: tuple[Row, ...]
    train: tuple[Recording, ...]
    test: tuple[Recording, ...]
    noise_floor: ChannelErrors
    window_seconds: float
    elapsed_s: float

    @property
    def best(self) -> Row | None:
        """The method with the smallest error of one free run (geometric mean over the channels), if any."""
        return self.rows[0] if self.rows and self.rows[0].status == "ok" else None

    @property
    def units(self) -> dict[str, str]:
        """Channel -> its unit."""
        first = self.test[0]
        return dict(zip(first.channels, first.units, strict=True))

    @property
    def longest_test(self) -> int:
        """Index of the longest test recording, the first of several."""
        return max(range(len(self.test)), key=lambda k: self.test[k].N)

    def __getitem__(self, method: str) -> Row:
        """The row of a method."""
        for row in self.rows:
            if row.method == method:
                return row
        raise InputError(
            f"The row of {method!r} was asked for, but the table has "
            f"{', '.join(row.method for row in self.rows)}; name one of these."
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, schema 1."""
        return {
            "schema": 1,
            "best": self.best.method if self.best else None,
            "rows": [row.to_dict(self.window_seconds) for row in self.rows],
            "noise_floor": json_numbers(self.noise_floor),
            "train": [_described(r) for r in self.train],
            "test": [_described(r) for r in self.test],
            "elapsed_s": self.elapsed_s,
        }

    @property
    def best_of_each_family(self) -> tuple[Row, ...]:
        """The best method of each family among those with the status `ok`, best first."""
        first: dict[str, Row] = {}
        for row in self.rows:
            if row.status == "ok":
                first.setdefault(row.family, row)
        return tuple(first.values())

    def to_markdown(self) -> str:
        """The table in Markdown, then a line for each method with a remark."""
        head, *body = self.cells()
        align = ["---", *["---:"] * (len(head) - 1)]
        lines = ["| " + " | ".join(cells) + " |" for cells in (head, align, *body)]
        return "\n".join([*lines, "", *(f"- {line}" for line in self.remarks())]) + "\n"

    def to_frame(self) -> Any:
        """The numbers as a pandas DataFrame, one row for each method, in the units of the recordings.

        Raises:
            InputError: pandas is not installed.
        """
        pandas = optional("pandas", "A table as a DataFrame")
        records = []
        for row in self.rows:
            errors = {
                "rmse": row.rmse,
                "nrmse": row.nrmse,
                "fit_percent": row.fit_percent,
                "worst": row.worst,
                "rmse_windows": row.rmse_windows,
                "rmse_one_step": row.rmse_one_step,
            }
            plain = ("family", "status", "parameters", "fit_seconds", "simulate_seconds", "reason", "note")
            records.append(
                {"method": row.method}
                | {f"{name}_{c}": e for name, by in errors.items() for c, e in by.items()}
                | {name: getattr(row, name) for name in plain}
            )
        return pandas.DataFrame(records).set_index("method")

    def plot(self) -> Any:
        """Measured and simulated outputs of the best method of each family, as a matplotlib Figure."""
        from rotflex_jax.compare.page import overlays  # matplotlib is loaded only where it draws

        return overlays(self)

    def report(self, folder: str | Path) -> Path:
        """Write `comparison.html` (self-contained) and `comparison.json` into a folder, which is created.

        Returns:
            Path of the HTML page.
        """
        from rotflex_jax.compare.page import write  # matplotlib is loaded only where it draws

        return write(self, Path(folder))

    def cells(self) -> list[list[str]]:
        """The table as text: headings, the methods with the status `ok`, the sensor noise."""
        return cells(self)

    def __str__(self) -> str:
        """The table, then a line for each method with a remark."""
        return "\n".join([*aligned(self.cells()), *self.remarks()])

    def _repr_html_(self) -> str:
        """Every method on the same held-out data, best first."""
        head, *rows = self.cells()
        best = f", best: {self.best.method}" if self.best else ""
        return card(
            f"Comparison of {len(self.rows)} methods in free run on held-out data{best}",
            table(head, rows),
            folded("What there is to say about each", bullets(self.remarks())),
        )

    def remarks(self) -> list[str]:
        """Remarks on the methods: why a method failed, what it chose."""
        lines = []
        for row in self.rows:
            said = "; ".join(filter(None, (row.reason, row.note)))
            state = "" if row.status == "ok" else f"{row.status}: "
            if said or state:
                lines.append(f"{row.method}: {state}{said}")
        return lines


def _described(recording: Recording) -> dict[str, Any]:
    return {
        "source": recording.source,
        "start_s": recording.start,
        "seconds": recording.duration,
        "samples": recording.N,
        "n_init": recording.n_init,
    }
