"""`rotflex experiment`: the input that distinguishes two effects."""

import io
import json
import math
from pathlib import Path
from typing import Any

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import digits

FIGURE_ENDINGS = (".png", ".svg", ".pdf", ".jpg")


@given.reads_files
def experiment(
    fit: given.AmbiguousFiles,
    between: given.Between,
    voltage: given.Voltage,
    slew: given.Slew = math.inf,
    travel: given.Travel = math.inf,
    deflection: given.Deflection = math.inf,
    seconds: given.Length = 20.0,
    rank_only: given.RankOnly = False,
    joint: given.JointName = "paper",
    add: given.FoundBefore = None,
    save: given.InputFile = None,
    plot: given.PlotFile = None,
    json_file: given.JsonFile = None,
    *,
    columns: given.Columns,
) -> None:
    """Design the input that distinguishes two effects which a recording cannot."""
    given.check_distinct(fit, [])
    for file in (save, plot, json_file):
        given.check_writable(json_file=file)
    if plot is not None and plot.suffix not in FIGURE_ENDINGS:
        raise InputError(
            f"{plot} has the ending {plot.suffix or '(none)'}, but a figure is written as "
            f"{', '.join(FIGURE_ENDINGS)}; choose one of these."
        )
    if given.STDOUT in (save, plot):
        raise InputError("A file was given as -, but only --json goes to stdout; name the file.")
    model = by_name.model(joint, add or ())
    model, columns = columns.of(model)
    first, second = (by_name.effect(text) for text in between)
    if (first.name, first.at) == (second.name, second.at):
        raise InputError(f"--between was given {between[0]} twice, but needs two effects; name another.")
    limits = _limits(voltage, slew, travel, deflection)
    recordings = [columns.load(file) for file in fit]
    longest = max(recordings, key=lambda r: r.N)
    _check_length(seconds, longest.Ts)
    terminal.print_findings(recordings)
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    import rotflex_jax as rf
    from rotflex_jax.experiment import next_experiment

    with terminal.progress("Designing") as step:
        step(f"fitting the model with {between[0]}")
        fitted = rf.fit(model + first, recordings, progress=step)
        found = next_experiment(
            fitted,
            (first.name, first.at),
            (second.name, second.at),
            limits=limits,
            seconds=seconds,
            Ts=longest.Ts,
            reference=longest.u,
            improve=not rank_only,
            progress=step,
        )
    result = found.to_dict(None if save is None else str(save))
    if json_file == given.STDOUT:
        print(json.dumps(result, indent=2), flush=True)
        _write_files(found, save, plot)
        return
    terminal.output().print(str(found), markup=False)
    names = found.channels
    rows = [
        (
            f"{r.input}, {r.setting}",
            digits(r.nats),
            digits(r.nats / seconds),
            digits(r.voltage),
            digits(r.slew),
            *(digits(math.degrees(r.peaks[n])) for n in names),
        )
        for r in found.table
    ]
    heads = ("input", "nats", "nats/s", "V", "V/s", *(f"{n} [deg]" for n in names))
    terminal.print_rows(heads, rows)
    if json_file is not None:
        write_file(json_file, json.dumps(result, indent=2) + "\n")
    _write_files(found, save, plot)
    for path in (save, plot):
        if path is not None:
            terminal.message(f"Written: {path}")


def _write_files(found: Any, save: Path | None, plot: Path | None) -> None:
    """The input, then its figure in the format that the name of the file ends in."""
    if save is not None:
        found.save_csv(save)
    if plot is not None:
        found.plot().savefig(picture := io.BytesIO(), dpi=150, format=plot.suffix[1:])
        write_file(plot, picture.getvalue())


def _limits(voltage: float, slew: float, travel: float, deflection: float) -> Any:
    """Limits, angles given in degrees."""
    from rotflex_jax.experiment import Limits

    return Limits(voltage, slew, math.radians(travel), math.radians(deflection))


def _check_length(seconds: float, Ts: float) -> None:
    """Refuse an impossible length before anything is fitted."""
    from rotflex_jax.experiment.design import sample_counts

    sample_counts(seconds, Ts)
