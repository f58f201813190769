"""The command line: `rotflex demo`, `discover`, `simulate`, `effects`, `data`.

Exit status 0 on any verdict, 2 on bad input with one sentence on stderr. Everything heavy is
imported inside the commands, so that `rotflex --help` answers at once.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from rotflex_jax import arguments as given, terminal
from rotflex_jax.errors import InputError

if TYPE_CHECKING:
    from rotflex_jax.recording import Recording

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Find the physics a model of a rotary flexible joint is missing, from a recording of it.",
)
data_app = typer.Typer(help="Public recordings: list them, fetch them.")
app.add_typer(data_app, name="data")

# The class of every mistake in the arguments; typer does not export it by name.
_UsageError: Any = typer.BadParameter.__bases__[0]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit status."""
    try:
        status = app(
            args=None if arguments is None else list(arguments),
            prog_name="rotflex",
            standalone_mode=False,
        )
    except InputError as error:
        _refuse(str(error))
    except _UsageError as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "rotflex"
        fault = error.format_message().rstrip(".")
        _refuse(f"{fault}; {command} --help lists what can be given.")
    except OSError as error:
        _refuse(f"{error.filename or 'A file'} cannot be used: {error.strerror or error}.")
    except KeyboardInterrupt:
        print("rotflex: stopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(status if isinstance(status, int) else 0)


def _refuse(sentence: str) -> NoReturn:
    print("rotflex: " + " ".join(sentence.split()), file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _start(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        from rotflex_jax import __version__

        print(__version__)
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(context.get_help())


@data_app.callback(invoke_without_command=True)
def _start_data(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def demo(
    report: given.ReportFolder = Path("rotflex-demo"), json_file: given.JsonFile = None
) -> None:
    """Show the loop on a recording that comes with the package, up to its report."""
    given.check_writable(json_file=json_file, folder=report)
    from rotflex_jax.data.datasets import demo_recording

    train, test = demo_recording().split(0.7)
    _discover(given.joint("paper"), [train], [test], report, json_file)


@app.command()
def discover(
    files: given.Files,
    joint: given.JointName = "paper",
    held_out: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Recording to judge on; may be given several times."),
    ] = None,
    split: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Share of each FILE to learn from; 0.7 unless given."),
    ] = None,
    input_column: given.InputColumn = None,
    output_columns: given.OutputColumns = None,
    degrees: given.Degrees = False,
    Ts: given.SamplingPeriod = None,
    time_column: given.TimeColumn = None,
    accept: given.Accept = None,
    report: given.ReportFolder = None,
    json_file: given.JsonFile = None,
) -> None:
    """Find the effects that the model lacks, with evidence on data the fit never saw."""
    share = given.check_split(split, held_out or [])
    given.check_distinct(files, held_out or [])
    given.check_writable(json_file=json_file, folder=report)
    mechanism = given.joint(joint)
    columns = given.Columns(input_column, output_columns, degrees, Ts, time_column, accept)
    train = [columns.load(file) for file in files]
    test = [columns.load(file) for file in held_out or []]
    if not test:
        parts = [recording.split(share) for recording in train]
        train, test = [part[0] for part in parts], [part[1] for part in parts]
    _discover(mechanism, train, test, report, json_file)


@app.command()
def simulate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording to simulate.")],
    joint: given.JointName = "paper",
    add: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT@PORT", help="Add an effect: coulomb@hub or coulomb@hub:level=0.03."
        ),
    ] = None,
    fit: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Fit the model to this recording before."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Write what was measured and simulated.")
    ] = None,
    input_column: given.InputColumn = None,
    output_columns: given.OutputColumns = None,
    degrees: given.Degrees = False,
    Ts: given.SamplingPeriod = None,
    time_column: given.TimeColumn = None,
    accept: given.Accept = None,
) -> None:
    """Simulate a recording in free run and compare with what was measured."""
    given.check_distinct([file], fit or [])
    given.check_writable(json_file=save)
    columns = given.Columns(input_column, output_columns, degrees, Ts, time_column, accept)
    mechanism = given.joint(joint)
    for text in add or []:
        mechanism = mechanism + given.effect(text)
    recording = columns.load(file)
    train = [columns.load(other) for other in fit or []]
    terminal.print_findings([recording, *train])
    _quicken()
    import rotflex_jax as rf
    from rotflex_jax.model import Model

    model = Model(mechanism)
    if train:
        with terminal.progress("Fitting"):
            model = rf.fit(model, train).model
    y, y_hat = model.measured(recording), model.simulate(recording)
    rmse = rf.metrics.rmse(y, y_hat, recording.n_init).tolist()
    units = {name: terminal.unit_of(recording, name) for name in mechanism.channels}
    errors = dict(zip(units, rmse, strict=True))
    console = terminal.output()
    console.print(terminal.error_table([("RMS error of the free run", errors)], units))
    if save is not None:
        terminal.save_simulation(save, recording, dict(zip(units, y_hat.T, strict=True)))


@app.command()
def effects(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")] = False,
) -> None:
    """List the effects that the search knows, with equations and parameters."""
    from rotflex_jax.effects import CATALOG

    descriptions = [kind.describe() for kind in CATALOG.values()]
    if as_json:
        print(json.dumps({"schema": 1, "effects": descriptions}, indent=2))
    else:
        terminal.print_effects(descriptions)


@data_app.command("list")
def data_list() -> None:
    """List the public recordings that can be fetched."""
    from rotflex_jax.data.datasets import list_datasets

    rows = [(d.name, d.about, d.units, d.licence, d.source) for d in list_datasets()]
    terminal.print_rows(("name", "what", "units", "licence", "source"), rows)


@data_app.command("fetch")
def data_fetch(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names that `list` shows.")],
) -> None:
    """Fetch public recordings into the user's cache folder, check their hash, print their paths."""
    from rotflex_jax.data.datasets import DATASETS, fetch

    for name in names:
        given.choose(name, DATASETS, "data set")
    for name in names:
        with terminal.progress(f"Fetching {name}"):
            paths = fetch(name)
        for path in paths:
            print(path)


def _quicken() -> None:
    """Set up JAX for a program of its own; after the arguments, since an error needs no JAX."""
    from rotflex_jax.fastloops import enable_compilation_cache, enable_fast_loops

    enable_fast_loops()
    enable_compilation_cache()


def _discover(
    mechanism: Any,
    train: "list[Recording]",
    test: "list[Recording]",
    report: Path | None,
    json_file: Path | None,
) -> None:
    terminal.print_findings([*train, *test])
    _quicken()
    import rotflex_jax as rf

    with terminal.progress("Searching for missing effects") as step:
        result = rf.discover(mechanism, train, test, progress=step)
        page = None if report is None else result.report(report)
    text = json.dumps(result.to_dict(), indent=2)
    if json_file == given.STDOUT:
        print(text)
    else:
        terminal.print_discovery(result)
        if json_file is not None:
            json_file.write_text(text + "\n", encoding="utf-8")
    if page is not None:
        terminal.message(f"Report: {page}", error=json_file == given.STDOUT)
