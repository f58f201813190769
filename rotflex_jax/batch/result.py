"""Result of a fleet: one row for each recording, and a summary."""

import csv
import dataclasses
import io
from collections import Counter
from pathlib import Path
from typing import Any

from rotflex_jax.batch.task import Record
from rotflex_jax.text.numbers import printable, spreadsheet_cell

Errors = dict[str, float | None]


@dataclasses.dataclass(frozen=True)
class RecordingRow:
    """One recording.

    Attributes:
        name: Name of the recording, and of its file of results.
        source: File of the recording, or its `source`.
        verdict: As in `Discovery`; empty if there is none, and then `reason` states why.
        effects: Added effects: effect, port, and the equivalent effects of this recording.
        before: Channel -> validation error of the given model, in short free runs.
        after: Channel -> validation error of the final model, in short free runs.
        whole_before: Channel -> error of the given model in one free run over all validation data.
        whole_after: Channel -> error of the final model in one free run over all validation data.
        noise: Channel -> standard deviation of the sensor noise.
        window_seconds: Length of the short runs [s].
        seconds: Time taken [s].
        reason: One sentence if the search failed.
        known: Whether the result is from an earlier call.
    """

    name: str
    source: str
    verdict: str = ""
    effects: tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...] = ()
    before: Errors = dataclasses.field(default_factory=dict)
    after: Errors = dataclasses.field(default_factory=dict)
    whole_before: Errors = dataclasses.field(default_factory=dict)
    whole_after: Errors = dataclasses.field(default_factory=dict)
    noise: Errors = dataclasses.field(default_factory=dict)
    window_seconds: float | None = None
    seconds: float = 0.0
    reason: str = ""
    known: bool = False

    @classmethod
    def of(cls, record: Record, known: bool = False) -> "RecordingRow":
        """The row for the content of a file of results."""
        head = {k: record[k] for k in ("name", "source", "reason", "seconds")}
        found = record["result"]
        if found is None:
            return cls(**head, known=known)
        rounds = found.get("rounds", [])
        ends = found["baseline"], (rounds or [found["baseline"]])[-1]
        first, last = (dict(e["held_out_rmse_windows"]) for e in ends)
        last.pop("seconds", None)
        return cls(
            **head,
            known=known,
            verdict=found["verdict"],
            effects=tuple(
                (t["effect"], t["port"], tuple((e["effect"], e["port"]) for e in t["equivalent"]))
                for t in rounds
            ),
            window_seconds=first.pop("seconds", None),
            before=first,
            after=last,
            whole_before=dict(ends[0]["held_out_rmse"]),
            whole_after=dict(ends[1]["held_out_rmse"]),
            noise=dict(found["noise_floor"]),
        )

    @property
    def found(self) -> str:
        """The effects in short, `coulomb@hub, delay@input or lag@input`."""
        sets = ([(e, p), *others] for e, p, others in self.effects)
        return ", ".join(" or ".join(f"{e}@{p}" for e, p in listed) for listed in sets)

    def flat(self, channels: tuple[str, ...]) -> dict[str, Any]:
        """One value for each column, in SI units."""
        errors = {
            f"{c}_{what}": getattr(self, field).get(c)
            for c in channels
            for what, field in (
                ("before", "before"),
                ("after", "after"),
                ("whole_before", "whole_before"),
                ("whole_after", "whole_after"),
                ("noise", "noise"),
            )
        }
        head = {"name": self.name, "verdict": self.verdict or "failed", "effects": self.found}
        return {**head, **errors, "seconds": self.seconds, "reason": self.reason, "source": self.source}


@dataclasses.dataclass(frozen=True)
class Fleet:
    """Result of a fleet.

    Attributes:
        rows: Rows of the finished recordings, in the order given.
        total: Number of recordings that were given.
        units: Output -> its unit.
        folder: Folder with `summary.html`, `summary.csv` and the folders `recordings` and `models`.
        elapsed_s: Time taken by this call [s].
    """

    rows: tuple[RecordingRow, ...]
    total: int
    units: dict[str, str]
    folder: Path
    elapsed_s: float

    @property
    def page(self) -> Path:
        """Path of the summary as a page."""
        return self.folder / "summary.html"

    @property
    def failed(self) -> tuple[RecordingRow, ...]:
        """Recordings without a verdict."""
        return tuple(r for r in self.rows if not r.verdict)

    @property
    def effects(self) -> dict[tuple[str, str], tuple[int, int]]:
        """Effect and port -> number of recordings with it alone, and as one of equivalents; descending."""
        alone, among = Counter(), Counter()
        for row in self.rows:
            for effect, port, others in row.effects:
                for pair in ((effect, port), *others):
                    (among if others else alone)[pair] += 1
        pairs = sorted({*alone, *among}, key=lambda p: (-alone[p] - among[p], -alone[p], p))
        return {p: (alone[p], among[p]) for p in pairs}

    @property
    def verdicts(self) -> dict[str, int]:
        """Verdict -> number of recordings; `failed` for recordings without a verdict."""
        return dict(Counter(r.verdict or "failed" for r in self.rows).most_common())

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, schema 1."""
        return {
            "schema": 1,
            "total": self.total,
            "verdicts": self.verdicts,
            "effects": [
                {"effect": e, "port": p, "alone": alone, "among_others": among}
                for (e, p), (alone, among) in self.effects.items()
            ],
            "recordings": [r.flat(tuple(self.units)) for r in self.rows],
            "elapsed_s": self.elapsed_s,
        }

    def to_csv(self) -> str:
        """One row for each recording; no text can act as a formula of a spreadsheet."""
        text = io.StringIO()
        table = csv.DictWriter(text, list(RecordingRow("", "").flat(tuple(self.units))), lineterminator="\n")
        safe = lambda x: spreadsheet_cell(printable(x)) if isinstance(x, str) else x  # noqa: E731
        table.writerow({name: safe(name) for name in table.fieldnames})
        rows = (r.flat(tuple(self.units)) for r in self.rows)
        table.writerows({name: safe(value) for name, value in row.items()} for row in rows)
        return text.getvalue()

    def write(self) -> Path:
        """Write `summary.csv` and `summary.html`; return the path of the page."""
        from rotflex_jax.batch.page import render  # matplotlib is loaded only where it draws
        from rotflex_jax.text.markup import write_files

        write_files(self.folder, {"summary.csv": self.to_csv(), "summary.html": render(self)})
        return self.page

    def __str__(self) -> str:
        verdicts = ", ".join(f"{n} {v.replace('_', ' ')}" for v, n in self.verdicts.items())
        return f"{len(self.rows)} of {self.total} recordings: {verdicts or 'nothing yet'}."
