"""`rotflex experiment`: the input that distinguishes effects, all at once or a few seconds at a time."""

import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.recordings import Columns, reads_files
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import as_read, digits, readable

# Options of the first command of an experiment; later commands take them from its state.
FIRST_COMMAND = (
    "fit",
    "between",
    "voltage",
    "slew",
    "travel",
    "deflection",
    "state",
    "add",
    "plot",
    "further",
)
FIRST_COMMAND += ("error", "max_seconds", "seconds", "rank_only", "joints", "intersample", "substeps")
FIGURE_ENDINGS = (".png", ".svg", ".pdf", ".jpg")


@reads_files
def experiment(
    context: typer.Context,
    recording: given.Played = None,
    fit: given.AmbiguousFiles = None,
    between: given.Between = None,
    voltage: given.Voltage = None,
    slew: given.Slew = math.inf,
    travel: given.Travel = math.inf,
    deflection: given.Deflection = math.inf,
    seconds: given.Length = 20.0,
    rank_only: given.RankOnly = False,
    joints: given.JointNames = None,
    add: given.FoundBefore = None,
    save: given.InputFile = None,
    plot: given.PlotFile = None,
    json_file: given.JsonFile = None,
    further: given.Also = None,
    state: given.State = None,
    go_on: given.GoOn = None,
    error: given.ErrorProbability = 0.01,
    max_seconds: given.MostSeconds = 60.0,
    *,
    columns: Columns,
) -> None:
    """Design the input that distinguishes two effects which a recording cannot.

    With --state it becomes an experiment that stops by itself: play the voltage that is written, then call it
    again with --continue STATE.json RECORDING, until it says what is true or that nothing would tell.
    """
    if go_on is not None:
        first = any(given.was_given(context, name) for name in FIRST_COMMAND)
        _continued(go_on, recording, columns, save, json_file, first)
        return
    if between is not None and (option := next((text for text in between if text.startswith("-")), None)):
        # An option that takes two values takes whatever follows it.
        raise InputError(
            f"--between was given {option} in the place of an effect, but needs two effects; write for "
            "instance --between delay@input lag@input."
        )
    if recording is not None:
        raise InputError(
            f"{recording} was given as what was recorded, but that belongs to --continue; name the state too."
        )
    for value, option, example in ((fit, "--fit", "run.csv"), (voltage, "--voltage", "6")):
        if value is None:
            raise InputError(f"{option} is missing; write for instance {option} {example}.")
    if between is None:
        raise InputError("--between is missing; write for instance --between delay@input lag@input.")
    assert fit is not None and voltage is not None
    if further and state is None:
        raise InputError("--or was given, but more than two are told apart with --state only; add it.")
    if state is None and any(given.was_given(context, name) for name in ("error", "max_seconds")):
        raise InputError(
            "--error or --max-seconds was given, but an experiment stops by itself with --state only; add it."
        )
    given.check_distinct(fit, [])
    given.check_writable(save, plot, state, or_stdout=json_file, read=fit)
    if state is not None:
        if plot is not None or seconds != 20.0:
            raise InputError(
                "--plot or --seconds was given, but with --state neither has a meaning; leave it out."
            )
        if state.exists():
            raise InputError(
                f"{state} is there already; go on with --continue {state}, or name another state."
            )
        _check_voltage_file(state, save, 1, fit)
        _check_end(error, max_seconds)
    if plot is not None and plot.suffix not in FIGURE_ENDINGS:
        raise InputError(
            f"{plot} has the ending {plot.suffix or '(none)'}, but a figure is written as "
            f"{', '.join(FIGURE_ENDINGS)}; choose one of these."
        )
    model = by_name.model(given.one_model(joints), add or ())
    model, columns = columns.of(model)
    first, second, *others = (by_name.effect(text) for text in (*between, *(further or ())))
    if (first.name, first.at) == (second.name, second.at):
        raise InputError(f"--between was given {between[0]} twice, but needs two effects; name another.")
    limits = _limits(model, voltage, slew, travel, deflection)
    recordings = [columns.load(file) for file in fit]
    longest = max(recordings, key=lambda r: r.N)
    if state is None:
        _check_length(seconds, longest.Ts)
    terminal.print_findings(recordings)
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    import rotflex_jax as rf
    from rotflex_jax.experiment import next_experiment

    if state is not None:
        from rotflex_jax.experiment.sequential import sequential_experiment

        with terminal.progress("Designing") as step:
            models = {}
            for effect in (first, second, *others):
                step(f"fitting the model with {effect.name}@{effect.at}")
                models[f"{effect.name}@{effect.at}"] = rf.fit(model + effect, recordings, progress=step)
            begun = sequential_experiment(
                models,
                limits,
                longest.Ts,
                error=error,
                max_seconds=max_seconds,
                continues=False,
                improve=not rank_only,
            )
            begun = begun.with_next_segment(step)
        for name, fitted in models.items():
            terminal.print_remarks(fitted, f"fit with {name}", error=True)
        _report(begun, state, save, json_file)
        return
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
    terminal.print_remarks(fitted, f"fit with {between[0]}", error=True)
    result = found.to_dict(None if save is None else str(save))
    if json_file == given.STDOUT:
        print(json.dumps(result, indent=2), flush=True)
        _write_files(found, save, plot)
        return
    terminal.output().print(str(found), markup=False)
    outputs = dict(zip(found.channels, found.units, strict=True))
    rows = [
        (
            f"{r.input}, {r.setting}",
            digits(r.nats),
            digits(r.nats / seconds),
            digits(r.voltage),
            digits(r.slew),
            *(digits(readable(r.peaks[n], unit)[0]) for n, unit in outputs.items()),
        )
        for r in found.table
    ]
    driven = (found.input_unit, f"{found.input_unit}/s")
    heads = (
        "input",
        "nats",
        "nats/s",
        *driven,
        *(f"{n} [{readable(0.0, u)[1]}]" for n, u in outputs.items()),
    )
    terminal.print_rows(heads, rows)
    if json_file is not None:
        write_file(json_file, json.dumps(result, indent=2) + "\n")
    _write_files(found, save, plot)
    for path in (save, plot):
        if path is not None:
            terminal.message(f"Written: {path}")


def _continued(
    state: Path, recording: Path | None, columns: Any, save: Path | None, json_file: Path | None, first: bool
) -> None:
    """One step of a sequential experiment: evaluate a recording, then write the next voltage."""
    from rotflex_jax.experiment.sequential import SequentialExperiment

    if recording is None:
        raise InputError(
            f"--continue was given {state}, but no recording of its last voltage; name that too."
        )
    if first:
        raise InputError(
            "--continue was given with an option of the first command (as --fit, --between, --voltage or "
            "--travel), but the state has these; leave them out."
        )
    given.check_writable(save, or_stdout=json_file, read=[state, recording])
    e = SequentialExperiment.load(state)
    if e.verdict:
        raise InputError(f"{state} has ended ({e.verdict}); begin another experiment with --state.")
    _check_voltage_file(state, save, len(e.history) + 2, (recording,))
    _, columns = columns.of(e.rivals.models[0])
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    played = columns.load(recording)
    with terminal.progress("Evaluating") as step:
        e = e.with_recording(played).with_next_segment(step)
    _report(e, state, save, json_file)


def _report(e: Any, state: Path, save: Path | None, json_file: Path | None) -> None:
    """Save the state, write the next voltage, and print the result so far."""
    result, voltage = e.result(), None
    if e.planned is not None:
        voltage = save or _voltage_file(state, len(e.history) + 1)
        e.planned.save_csv(voltage)
    e.save(state)
    data = result.to_dict() | {
        "state": str(state),
        "next": None if e.planned is None else e.planned.to_dict(str(voltage)),
    }
    if json_file == given.STDOUT:
        print(json.dumps(data, indent=2), flush=True)
        return
    terminal.output().print(str(result) if e.planned is None else result.sentence, markup=False)
    if e.planned is not None:
        terminal.output().print(str(e.planned), markup=False)
        terminal.message(
            f"Written: {voltage}; play it from rest and record it, then: "
            f"rotflex experiment --continue {state} RECORDING"
        )
    if json_file is not None:
        write_file(json_file, json.dumps(data, indent=2) + "\n")


def _voltage_file(state: Path, count: int) -> Path:
    """File for the voltage of a segment, used unless another file is named."""
    return state.with_name(f"{state.stem}_{count:03d}.csv")


def _check_voltage_file(state: Path, save: Path | None, count: int, read: Sequence[Path]) -> None:
    """Refuse to overwrite the state, a recording that is read, or an existing file that was not named."""
    file = save or _voltage_file(state, count)
    if file.resolve() in {path.resolve() for path in (state, *read)} or (save is None and file.exists()):
        raise InputError(f"The next voltage would be written over {file}; name another file with --save.")


def _write_files(found: Any, save: Path | None, plot: Path | None) -> None:
    """Write the input, then its figure in the format given by the ending of the file's name."""
    if save is not None:
        found.save_csv(save)
    if plot is not None:
        found.plot().savefig(picture := io.BytesIO(), dpi=150, format=plot.suffix[1:])
        write_file(plot, picture.getvalue())


def _limits(model: Any, voltage: float, slew: float, travel: float, deflection: float) -> Any:
    """Limits, angles given in degrees and lengths in millimetres."""
    from rotflex_jax.experiment import Limits
    from rotflex_jax.mechanism.linear import output_units
    from rotflex_jax.models.model import Model

    units = output_units(Model.of(model).mechanism)
    first, *others = units.values()
    if not others and deflection != math.inf:
        raise InputError(
            f"--deflection {deflection:g} was given, but the model has one output, {', '.join(units)}; limit "
            "it with --travel."
        )
    travel = _in_unit("--travel", travel, first)
    if others:
        deflection = _in_unit("--deflection", deflection, others[0])
    return Limits(voltage, slew, travel, deflection)


def _in_unit(option: str, value: float, unit: str) -> float:
    """The value of an option, given in degrees or millimetres, in the unit of an output."""
    of_one, shown = as_read(1.0, unit)
    if not value > 0:
        raise InputError(
            f"{option} was given {value:g}, but needs a positive number in {shown}; give what the machine "
            "bears."
        )
    return value / of_one


def _check_end(error: float, max_seconds: float) -> None:
    """Refuse an impossible end of a sequential experiment before anything is fitted."""
    from rotflex_jax.experiment.sequential import SEGMENT_SECONDS

    if not 0 < error < 0.5:
        raise InputError(
            f"--error was given {error:g}, but it is the probability of a wrong answer and must lie between "
            "0 and 0.5; give for instance --error 0.01."
        )
    if not SEGMENT_SECONDS <= max_seconds < math.inf:
        raise InputError(
            f"--max-seconds was given {max_seconds:g}, but the experiment needs at least {SEGMENT_SECONDS:g} "
            "s, the length of one segment; give for instance --max-seconds 60."
        )


def _check_length(seconds: float, Ts: float) -> None:
    """Refuse an impossible length before anything is fitted."""
    from rotflex_jax.experiment.design import sample_counts

    sample_counts(seconds, Ts)
