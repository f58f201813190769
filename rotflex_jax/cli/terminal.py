"""What the command line shows to a person: progress on stderr, results on stdout."""

import csv
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Real
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rotflex_jax.cli.arguments import as_options
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import digits, one_line, printable, readable, spreadsheet_cell

# Rows of a long table that are shown.
LISTED_RECORDINGS = 60
# Longest time without a line of progress [s]; largest length of a line that is repeated [characters].
SILENCE, LONGEST_AGAIN = 10.0, 60


class SafeConsole(Console):
    """A console on which names from files cannot steer the terminal."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print texts without their control codes, and tables, whose cells `cell` has made safe."""
        super().print(*(printable(x) if isinstance(x, str) else x for x in objects), **options)


def cell(text: str) -> str:
    """A text for a table: no markup, no control codes."""
    return escape(one_line(text))


def output() -> Console:
    """The console for results. Made on use, so that it follows a redirected stdout."""
    console = SafeConsole(highlight=False, soft_wrap=True)
    # A file or a pipe has no width of its own; 80 columns would break the tables.
    return console if console.is_terminal else SafeConsole(highlight=False, soft_wrap=True, width=160)


class _LastLine:
    """The last line of progress, and the time since it was shown."""

    def __init__(self, title: str) -> None:
        self.line, self.time_left = title, None
        self.began = self.since = self.shown = time.monotonic()

    def take(self, step: str) -> str:
        """Store a new line and return the text to show."""
        if self.time_left is None and hasattr(step, "kind"):  # a search has begun
            from rotflex_jax.discover.checkpoint import TimeLeft

            self.time_left = TimeLeft()
        if self.time_left is not None:
            self.time_left.follow(step)
        self.line = _named(step)
        self.since = self.shown = time.monotonic()
        return self.line if step.startswith(" ") else f"{self.line} ({self._times()})"

    def _times(self) -> str:
        return self.time_left.words() if self.time_left else f"{time.monotonic() - self.began:.0f} s so far"

    def again(self) -> str:
        """The text to show after a while without a new line: the last line with its time so far."""
        self.shown = time.monotonic()
        line = self.line.strip()
        short = line if len(line) <= LONGEST_AGAIN else line[: LONGEST_AGAIN - 1].rsplit(" ", 1)[0] + " …"
        return f"  still {short} ({self.shown - self.since:.0f} s; {self._times()})"


@contextmanager
def progress(title: str) -> Iterator[Callable[[str], None]]:
    """Show what long work is doing: a spinner on a terminal, one line per step elsewhere.

    Each step has the time so far, and in a search the remaining time if it can be estimated. If no step is
    reported for `SILENCE` seconds, the last one is repeated with its time so far.

    Args:
        title: What is shown until the work reports its first step.

    Yields:
        The function to call with one short phrase per step.
    """
    console, last, ended = SafeConsole(stderr=True, highlight=False), _LastLine(title), threading.Event()
    if console.is_terminal:
        with console.status(title) as status:
            show, every = lambda text: status.update(cell(text)), 1.0
            with _repeating(last, show, every, ended):
                yield lambda step: show(last.take(step))
        return
    show = lambda text: console.print(text, markup=False, soft_wrap=True)  # noqa: E731
    with _repeating(last, show, SILENCE, ended):
        yield lambda step: show(last.take(step))


@contextmanager
def _repeating(
    last: _LastLine, show: Callable[[str], None], every: float, ended: threading.Event
) -> Iterator[None]:
    """Repeats the last line whenever nothing was shown for `every` seconds."""

    def watch() -> None:
        while not ended.wait(min(every / 4, 1.0)):
            if time.monotonic() - last.shown >= every:
                show(last.again())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


def _named(step: str) -> str:
    """A line of progress, with effects named by their nouns."""
    from rotflex_jax.effects.labels import with_titles  # imported here, so that `--help` answers at once

    return with_titles(step)


def _errors(errors: Mapping[str, float], units: Mapping[str, str]) -> list[str]:
    return [_readable(errors.get(name), unit) for name, unit in units.items()]


def _readable(value: float | None, unit: str) -> str:
    return digits(None if value is None else readable(value, unit)[0])


def error_table(rows: Sequence[tuple[str, Mapping[str, float]]], units: Mapping[str, str]) -> Table:
    """A table of errors per channel; `rows` are (label, channel -> error [unit])."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    for channel, unit in units.items():
        table.add_column(cell(f"{channel} [{readable(1.0, unit)[1]}]"), justify="right")
    for label, errors in rows:
        table.add_row(cell(label), *_errors(errors, units))
    return table


def estimate_line(name: str, estimate: Any) -> str:
    """One fitted parameter with its 95 % interval."""
    value, low, high = estimate.texts
    text = f"{name} = {value} {estimate.unit}".rstrip()
    if all(map(math.isfinite, estimate.ci95)):
        text += f"   95 %: {low} .. {high}"
    return f"{text}   {estimate.remark}" if estimate.remark else text


def print_discovery(result: Any) -> None:
    """Print verdict, rounds, errors on validation and test data, and where the baseline failed.

    Parameters are those of the model to use.
    """
    from rotflex_jax.discover.tables import (
        description_in_use,
        error_lists,
        estimates_in_use,
        final_fit_sentence,
        has_moved,
        notes_in_words,
        status_sentence,
        where_sentence,
    )
    from rotflex_jax.effects.labels import with_titles

    console = output()
    units = {name: result.validation[0].unit(name) for name in result.baseline.held_out_rmse}
    console.print(result.verdict.label.upper(), style="bold", markup=False)
    console.print(with_titles(result.sentence), markup=False)
    console.print(f"What decided: {result.assessment.criterion}.", markup=False)
    for count, added in enumerate(result.rounds, start=1):
        console.print(f"\nRound {count}: {description_in_use(result, added)}", markup=False)
        if added.equation:
            console.print(f"  {added.equation}", markup=False)
        for name, used in estimates_in_use(result, added).items():
            found = added.parameters[name]
            line = estimate_line(name, used or found)
            if used is None:
                line += "   when it was added; the model to use is without it"
            elif has_moved(found, used):
                line += f"   ({f'{found.texts[0]} {found.unit}'.rstrip()} when it was added)"
            console.print(f"  {line}", markup=False)
        console.print(f"  {status_sentence(added)}", markup=False)
    if result.probabilities:
        console.print(f"\n{result.probabilities.sentence}", markup=False)
    floor, seconds = ("noise floor of the sensor", result.noise_floor), digits(result.baseline.window_seconds)
    for title, note, errors in error_lists(result):
        console.print(f"\n{title}", style="bold", markup=False)
        console.print(note, markup=False)
        for heading, each in (
            ("RMS error of one free run over all of it", [(name, e.whole) for name, e in errors.items()]),
            (f"RMS error of free runs over {seconds} s", [(name, e.windows) for name, e in errors.items()]),
        ):
            console.print(f"\n{heading}")
            console.print(error_table([*each, floor], units))
    if sentence := final_fit_sentence(result):
        console.print(f"\n{sentence}", markup=False)
    if result.where:
        console.print("\nWhere the baseline failed", style="bold")
        console.print(where_sentence(result), markup=False)
        for place in result.where:
            console.print(f"- {place.statement}", markup=False)
    for note in notes_in_words(result):
        console.print(f"Note: {note}", markup=False)


def print_comparison(result: Any) -> None:
    """Print methods side by side, best first."""
    console = output()
    console.print("Free runs over the held-out data", style="bold")
    console.print(str(result), markup=False)


def print_fleet(result: Any) -> None:
    """Print one line for each recording, and the counts."""
    good = [row for row in result.rows if row.verdict]
    rows = [
        (
            row.name,
            row.verdict.replace("_", " "),
            row.found or "-",
            *(
                " to ".join(_errors(end, {channel: unit})[0] for end in (row.before, row.after))
                for channel, unit in result.units.items()
            ),
            f"{row.seconds:.0f}",
        )
        for row in good[:LISTED_RECORDINGS]
    ]
    errors = [f"{channel} [{readable(1.0, unit)[1]}]" for channel, unit in result.units.items()]
    print_rows(("recording", "verdict", "found", *errors, "s"), rows)
    for row in result.failed[:LISTED_RECORDINGS]:
        message(f"{row.name} failed: {as_options(row.reason)}")
    if len(good) > LISTED_RECORDINGS or len(result.failed) > LISTED_RECORDINGS:
        message(f"The rest of the list is in {result.folder / 'summary.csv'}.")
    message(str(result))


def print_findings(recordings: Sequence[Any]) -> None:
    """Print findings that a user should check before trusting a result, once each, on stderr."""
    seen: set[tuple[str, str, str]] = set()
    for recording in recordings:
        for finding in recording.findings:
            key = (recording.source, finding.channel, finding.kind)
            if finding.severity != "note" and key not in seen:
                seen.add(key)
                where = f"{recording.source}: " if recording.source else ""
                message(f"Look at {where}{as_options(finding.message)}", error=True)


def print_recording(recording: Any) -> None:
    """Print what was measured: length, ranges, steps of the sensors, and all findings."""
    from rotflex_jax.recording.samples import name_and_unit  # imported here, so that `--help` answers at once

    about = f"{recording.N} samples, {recording.duration:g} s at {1 / recording.Ts:g} Hz"
    message(f"{recording.source}: {about}" if recording.source else about)
    signals = [(recording.input_name, recording.input_unit, recording.u)]
    signals += zip(recording.channels, recording.units, recording.y.T, strict=True)
    signals += [(*name_and_unit(name), x) for name, x in recording.signals.items()]
    rows = []
    for name, unit, x in signals:
        limits = [_readable(float(end), unit) for end in (x.min(), x.max())]
        step = _readable(recording.resolution.get(name), unit)
        rows.append((name, readable(1.0, unit)[1], *limits, step))
    print_rows(("signal", "unit", "from", "to", "step"), rows)
    for finding in recording.findings:
        message(f"{finding.severity}: {as_options(finding.message)}")


def print_remarks(fitted: Any, label: str = "", *, error: bool = False) -> None:
    """Print the remarks of a fit on its parameters as notes, with a label if there are several fits."""
    for remark in fitted.remarks:
        message(f"note: {f'{label}: ' if label else ''}{remark.sentence}.", error=error)


def message(text: str, *, error: bool = False) -> None:
    """Print one line for a person."""
    SafeConsole(stderr=error, highlight=False).print(text, markup=False, soft_wrap=True)


def save_simulation(file: Path, recording: Any, simulated: Mapping[str, Real[np.ndarray, " N"]]) -> None:
    """Write time, input and signals, measured and simulated outputs as CSV, in the units of the recording.

    The names of the columns have these units where `rotflex_jax.data.save_csv` has them.

    Raises:
        InputError: The file cannot be written; an old one stays.
    """
    from rotflex_jax.data.files import column_title  # imported here, so that `--help` answers at once

    names = ["t", column_title(recording.input_name, recording.input_unit, "V"), *recording.signals]
    names += [column_title(c, recording.unit(c), "rad") for c in recording.channels]
    names += [column_title(f"{c}_simulated", recording.unit(c), "rad") for c in simulated]
    columns = np.column_stack(
        [recording.t, recording.inputs(recording.signals), recording.y, *simulated.values()]
    )
    csv.writer(head := StringIO(), lineterminator="").writerow(spreadsheet_cell(one_line(n)) for n in names)
    header = head.getvalue()
    np.savetxt(text := StringIO(), columns, delimiter=",", header=header, comments="", fmt="%.9g")
    write_file(file, text.getvalue())


def print_rows(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a plain table of texts."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(cell(heading))
    for row in rows:
        table.add_row(*map(cell, row))
    output().print(table)


def print_effects(descriptions: Sequence[Mapping[str, Any]]) -> None:
    """Print the catalogue of effects as a table."""
    rows = []
    for effect in descriptions:
        parameters = (
            f"{name} [{spec['unit']}]" if spec["unit"] else name
            for name, spec in effect["parameters"].items()
        )
        cells = (effect["name"], effect["kind"], ", ".join(effect["ports"]), effect["equation"])
        rows.append((*cells, ", ".join(parameters)))
    print_rows(("effect", "kind", "ports", "equation", "parameters"), rows)


def print_arena(seed: int, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print scores of methods, one row each."""
    table = Table(title=f"Arena, seed {seed}", title_justify="left")
    for heading in ("method", *headings):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in rows:
        table.add_row(*map(cell, row))
    output().print(table)
