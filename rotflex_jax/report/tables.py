"""Rows of the tables, and the same tables for a terminal or a notebook."""

import dataclasses
import math

from rich.markup import escape
from rich.table import Table

from rotflex_jax.discover.result import Discovery, Stage
from rotflex_jax.report.wording import (
    AT_NOISE,
    effect_label,
    plain_number,
    ratio,
    readable,
    unit_text,
    units,
    value_and_interval,
)


@dataclasses.dataclass(frozen=True)
class ErrorCell:
    """One error: the number, its multiple of the noise, and whether it has reached the noise."""

    value: str
    multiple: str
    reached: bool


@dataclasses.dataclass(frozen=True)
class ErrorRow:
    """Errors of one stage: over windows and over the whole run, one cell per channel."""

    label: str
    windows: tuple[ErrorCell, ...]
    whole: tuple[ErrorCell, ...]


@dataclasses.dataclass(frozen=True)
class ParameterRow:
    """One parameter in all stages: (value, interval) each, None where the stage lacks it."""

    name: str
    meaning: str
    unit: str
    held: bool
    stages: tuple[tuple[str, str] | None, ...]
    note: str


def stage_labels(discovery: Discovery) -> tuple[str, ...]:
    """A short name for each stage."""
    added = (f"+ {effect_label(r.effect, r.port)}" for r in discovery.rounds)
    return ("baseline", *added)


def error_rows(discovery: Discovery) -> tuple[ErrorRow, ...]:
    """Held-out errors of every stage."""
    by_channel = units(discovery)

    def cells(errors: dict[str, float]) -> tuple[ErrorCell, ...]:
        return tuple(_cell(errors[c], unit, discovery.noise_floor.get(c)) for c, unit in by_channel.items())

    return tuple(
        ErrorRow(label, cells(s.held_out_rmse_windows), cells(s.held_out_rmse))
        for label, s in zip(stage_labels(discovery), discovery.stages, strict=True)
    )


def _cell(value: float, unit: str, floor: float | None) -> ErrorCell:
    times = ratio(value, floor)
    text = "" if math.isnan(times) else f"{times:.2f}" if times < 10 else f"{times:.0f}"
    return ErrorCell(plain_number(readable(value, unit)[0]), text, times < AT_NOISE)


def noise_row(discovery: Discovery) -> tuple[str, ...]:
    """Noise floor of each channel."""
    floor = discovery.noise_floor
    return tuple(
        plain_number(readable(floor[c], unit)[0] if c in floor else None)
        for c, unit in units(discovery).items()
    )


def channel_headings(discovery: Discovery) -> tuple[str, ...]:
    """Each channel with the unit it is read in."""
    return tuple(f"{c} [{readable(0.0, unit)[1]}]" for c, unit in units(discovery).items())


def parameter_rows(discovery: Discovery) -> tuple[ParameterRow, ...]:
    """Parameters of the final model, then those of earlier stages that it lacks; held ones last."""
    stages = [{e.name: e for e in s.estimates} for s in discovery.stages]
    names = list(dict.fromkeys(n for s in reversed(stages) for n in s))
    meanings = _meanings(discovery.stages)
    rows = []
    for name in names:
        last = next(s[name] for s in reversed(stages) if name in s)
        each = tuple(value_and_interval(s[name]) if name in s else None for s in stages)
        rows.append(
            ParameterRow(name, meanings.get(name, ""), unit_text(last.unit), not last.free, each, last.note)
        )
    return tuple(sorted(rows, key=lambda r: r.held))


def _meanings(stages: tuple[Stage, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    for stage in stages:
        m = stage.model.mechanism
        pairs = zip(m.parameter_names, m.parameter_specifications, strict=True)
        found |= {name: spec.meaning for name, spec in pairs}
    return found


def summary_table(discovery: Discovery) -> Table:
    """Held-out errors from the baseline through each round, for `rich.print`.

    Args:
        discovery: What was found.

    Returns:
        A table; a notebook shows it by itself.
    """
    seconds = f"{discovery.baseline.window_seconds:g} s"
    table = Table(
        title=escape(discovery.sentence),
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )
    table.add_column("", no_wrap=True)
    for kind in (f"runs of {seconds}", "one long run"):
        for heading in channel_headings(discovery):
            table.add_column(escape(f"{heading}\n{kind}"), justify="right")
    for row in error_rows(discovery):
        cells = (*row.windows, *row.whole)
        styled = (f"[green]{c.value}[/green]" if c.reached else c.value for c in cells)
        table.add_row(escape(row.label), *styled)
    floor = noise_row(discovery)
    table.add_row("sensor noise", *floor, *floor, style="dim")
    return table


def parameter_table(discovery: Discovery) -> Table:
    """Parameters of the final model with 95 % intervals, for `rich.print`.

    Args:
        discovery: What was found.

    Returns:
        A table; a notebook shows it by itself.
    """
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("parameter", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("95 %", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for row in parameter_rows(discovery):
        last = row.stages[-1]
        if last is not None:
            interval = "held" if row.held else last[1]
            style = "dim" if row.held else ""
            table.add_row(escape(row.name), last[0], interval, escape(row.unit), style=style)
    return table
