"""`rotflex experiment`: the input that tells two effects apart."""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from rotflex_jax import arguments as given, terminal
from rotflex_jax.errors import InputError

Fitted = Annotated[
    list[Path],
    typer.Option("--fit", metavar="FILE", help="Recording in which the two look alike; may be repeated."),
]
Between = Annotated[
    tuple[str, str],
    typer.Option("--between", metavar="EFFECT@PORT EFFECT@PORT", help="The two: delay@input lag@input."),
]
Voltage = Annotated[
    float, typer.Option("--voltage", metavar="V", help="Largest voltage the amplifier gives.")
]
Slew = Annotated[float, typer.Option("--slew", metavar="V/S", help="Fastest change of the voltage.")]
Travel = Annotated[float, typer.Option("--travel", metavar="DEG", help="Largest servo angle from the start.")]
Deflection = Annotated[
    float, typer.Option("--deflection", metavar="DEG", help="Largest deflection of the arm.")
]
Added = Annotated[
    list[str] | None,
    typer.Option("--add", metavar="EFFECT@PORT", help="Effect that was found before; may be repeated."),
]


def experiment(
    fit: Fitted,
    between: Between,
    voltage: Voltage,
    slew: Slew = math.inf,
    travel: Travel = math.inf,
    deflection: Deflection = math.inf,
    seconds: Annotated[float, typer.Option(metavar="SECONDS", help="Length of the experiment.")] = 20.0,
    rank_only: Annotated[
        bool, typer.Option("--rank-only", help="Rank the standard inputs, design none.")
    ] = False,
    joint: given.JointName = "paper",
    add: Added = None,
    save: Annotated[Path | None, typer.Option(metavar="CSV", help="Write the input: t,voltage.")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw the input and what it shows.")
    ] = None,
    input_column: given.InputColumn = None,
    output_columns: given.OutputColumns = None,
    degrees: given.Degrees = False,
    Ts: given.SamplingPeriod = None,
    time_column: given.TimeColumn = None,
    accept: given.Accept = None,
    json_file: given.JsonFile = None,
) -> None:
    """Design the input that tells two effects apart which a recording cannot."""
    given.check_distinct(fit, [])
    for file in (save, plot, json_file):
        given.check_writable(json_file=file)
    if given.STDOUT in (save, plot):
        raise InputError("A file was given as -, but only --json goes to stdout; name the file.")
    model = given.model(joint, add or ())
    columns = given.Columns(input_column, output_columns, degrees, Ts, time_column, accept, model.mechanism)
    first, second = (given.effect(text) for text in between)
    if (first.name, first.at) == (second.name, second.at):
        raise InputError(f"--between was given {between[0]} twice, but needs two effects; name another.")
    limits = _limits(voltage, slew, travel, deflection)
    recordings = [columns.load(file) for file in fit]
    longest = max(recordings, key=lambda r: r.N)
    _check_length(seconds, longest.Ts)
    terminal.print_findings(recordings)
    from rotflex_jax.fastloops import quicken

    quicken()
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
        if save is not None:
            found.save_csv(save)
        if plot is not None:
            found.plot().savefig(plot, dpi=150)
    result = found.to_dict(None if save is None else str(save))
    if json_file == given.STDOUT:
        print(json.dumps(result, indent=2))
        return
    terminal.output().print(str(found), markup=False)
    names = found.channels
    rows = [
        (
            f"{r.input}, {r.setting}",
            terminal.number(r.nats),
            terminal.number(r.nats / seconds),
            terminal.number(r.voltage),
            terminal.number(r.slew),
            *(terminal.number(math.degrees(r.peaks[n])) for n in names),
        )
        for r in found.table
    ]
    heads = ("input", "nats", "nats/s", "V", "V/s", *(f"{n} [deg]" for n in names))
    terminal.print_rows(heads, rows)
    if json_file is not None:
        json_file.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    for path in (save, plot):
        if path is not None:
            terminal.message(f"Written: {path}")


def _limits(voltage: float, slew: float, travel: float, deflection: float) -> Any:
    """Limits, angles given in degrees."""
    from rotflex_jax.experiment import Limits

    return Limits(voltage, slew, math.radians(travel), math.radians(deflection))


def _check_length(seconds: float, Ts: float) -> None:
    """Refuse an impossible length before anything is fitted."""
    from rotflex_jax.experiment.design import lengths

    lengths(seconds, Ts)
