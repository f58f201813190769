"""The command line: `rotflex demo`, `check`, `discover`, `compare` and others.

Exit status 0 on any verdict, 2 on bad input with one sentence on stderr. Everything heavy is
imported inside the commands, so that `rotflex --help` answers at once.
"""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.arena import arena
from rotflex_jax.cli.batch import check_each, search_each
from rotflex_jax.cli.data import check, data_app
from rotflex_jax.cli.experiment import experiment
from rotflex_jax.cli.models import export, simulate
from rotflex_jax.cli.recordings import Columns, joint_for, reads_files
from rotflex_jax.cli.reproduce import reproduce
from rotflex_jax.cli.rounds import RoundsSoFar
from rotflex_jax.cli.stopping import STOPPED
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import printable

if TYPE_CHECKING:
    from rotflex_jax.recording import Recording

app = typer.Typer(
    pretty_exceptions_enable=False,
    help="Find the physics a model of a rotary flexible joint is missing, from a recording of it.",
)

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
        _refuse(given.as_options(str(error)))
    except _UsageError as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else f"rotflex{_named_command(arguments)}"
        fault = error.format_message().rstrip(".")
        _refuse(f"{fault}; {command} --help lists what can be given.")
    except OSError as error:
        _refuse(f"{error.filename or 'A file'} cannot be used: {error.strerror or error}.")
    except (KeyboardInterrupt, typer.Abort):
        status = STOPPED
    if status == STOPPED:  # typer returns it after Ctrl-C, if the process belongs to another program
        print("rotflex: stopped", file=sys.stderr)
    sys.exit(status if isinstance(status, int) else 0)


def _named_command(arguments: Sequence[str] | None) -> str:
    """The command that the arguments begin with, after a space; empty if they begin with none."""
    first = next(iter(sys.argv[1:] if arguments is None else arguments), "")
    return f" {first}" if first in {c.__name__ for c in _COMMANDS} else ""


def _refuse(sentence: str) -> NoReturn:
    print("rotflex: " + printable(" ".join(sentence.split())), file=sys.stderr)
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


def demo(report: given.ReportFolder = Path("rotflex-demo"), json_file: given.JsonFile = None) -> None:
    """Show the loop on a recording that comes with the package, up to its report."""
    given.check_writable(or_stdout=json_file, folder=report)
    from rotflex_jax.data.datasets import demo_recording

    train, test = demo_recording().split(0.7)
    _discover(by_name.joint("paper"), [train], [test], report, json_file)


@reads_files
def discover(
    files: given.Files,
    joints: given.JointNames = None,
    held_out: given.HeldOut = None,
    test: given.Test = None,
    split: given.Share = None,
    calibrate: given.Calibrate = 2.0,
    resume: given.Continue = None,
    report: given.ReportFolder = None,
    json_file: given.JsonFile = None,
    save_model: given.ModelFile = None,
    each: given.Each = False,
    scheduler: given.Scheduler = None,
    workers: given.Workers = None,
    *,
    columns: Columns,
) -> None:
    """Find the effects that the model lacks, with evidence on data the fit never saw.

    Several FILES without --held-out and --split validate each other: each decides on what the others found.
    """
    refused = {"held-out": held_out, "test": test, "save-model": save_model, "continue": resume}
    check_each(each, {"scheduler": scheduler, "workers": workers}, refused)
    share = given.check_split(split, held_out or [])
    unseen = [*(held_out or []), *(test or [])]
    given.check_distinct(files, unseen)
    read = [*files, *unseen, *([resume] if resume else [])]
    given.check_writable(save_model, or_stdout=json_file, folder=report, read=read)
    model, columns = columns.of(by_name.model(joint_for(files, given.one_model(joints), columns)))
    if each:
        search_each(model, files, columns, share, report, json_file, scheduler, workers, calibrate)
        return
    train, validation = columns.load_all(files), columns.load_all(held_out or [])
    if not validation and (len(train) == 1 or split is not None):
        train, validation = map(list, zip(*(recording.split(share) for recording in train), strict=True))
    test_recordings = columns.load_all(test or [])
    options = {"calibrate_seconds": calibrate, "resume": resume}
    _discover(model, train, validation, report, json_file, save_model, test=test_recordings, **options)


@reads_files
def compare(
    files: given.Files,
    methods: given.Methods = None,
    quick: given.Quick = False,
    joints: given.JointNames = None,
    held_out: given.HeldOutForErrors = None,
    split: given.Share = None,
    report: given.ReportFolder = None,
    json_file: given.JsonFile = None,
    *,
    columns: Columns,
) -> None:
    """Compare methods on the same data by their free runs over held-out data."""
    share = given.check_split(split, held_out or [])
    given.check_distinct(files, held_out or [])
    given.check_writable(or_stdout=json_file, folder=report, read=[*files, *(held_out or [])])
    if quick and methods is not None:
        raise InputError(
            "Options --quick and --methods were both given, but each says which methods to run; give one."
        )
    model, columns = columns.of(by_name.model(joint_for(files, given.one_model(joints), columns)))
    names = methods if methods is None else methods.split(",")
    from rotflex_jax.compare import QUICK
    from rotflex_jax.compare.method import selected_methods

    wanted = selected_methods(QUICK if quick else names)  # an unknown one is refused before any file is read
    train, test = columns.load_parts(files, held_out or [], share)
    terminal.print_findings([*train, *test])
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    import rotflex_jax as rf

    with terminal.progress("Comparing") as step:
        result = rf.compare(train, wanted, mechanism=model, test=test, progress=step)
    with _each_by_itself() as attempt:
        attempt(lambda: _give(result, terminal.print_comparison, json_file))
        attempt(lambda: _report(result, report, json_file))


def effects(
    as_json: given.AsJson = False,
) -> None:
    """List the effects of the catalogue, with equations and parameters."""
    from rotflex_jax.effects import CATALOG

    descriptions = [kind.describe() for kind in CATALOG.values()]
    if as_json:
        print(json.dumps({"schema": 1, "effects": descriptions}, indent=2))
    else:
        terminal.print_effects(descriptions)


def _discover(
    mechanism: Any,
    train: "list[Recording]",
    validation: "list[Recording]",
    report: Path | None,
    json_file: Path | None,
    save_model: Path | None = None,
    *,
    test: "Sequence[Recording]" = (),
    **options: Any,
) -> None:
    terminal.print_findings([*train, *validation, *test])
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    import rotflex_jax as rf

    kept = RoundsSoFar(json_file)
    with terminal.progress("Searching for missing effects") as step:
        result = rf.discover(
            mechanism, train, validation, test=test, progress=kept.following(step), **options
        )
    with _each_by_itself() as attempt:
        attempt(lambda: _give(result, terminal.print_discovery, json_file))
        attempt(kept.remove)
        if save_model is not None:
            attempt(lambda: result.save(save_model))
        attempt(lambda: _report(result, report, json_file))


@contextmanager
def _each_by_itself() -> Iterator[Callable[[Callable[[], Any]], None]]:
    """Writes one output after the other: a failure prevents none of the others and is reported at the end."""
    failed: list[Exception] = []

    def attempt(write: Callable[[], Any]) -> None:
        try:
            write()
        except (InputError, OSError) as error:
            failed.append(error)

    yield attempt
    for error in failed[:-1]:
        terminal.message(f"rotflex: {error}", error=True)
    if failed:
        raise failed[-1]


def _give(result: Any, show: Callable[[Any], None], json_file: Path | None) -> None:
    """Print a result as JSON; or print it for a person, and write it as JSON if a file is named."""
    if json_file != given.STDOUT:
        show(result)
    if json_file is None:
        return
    text = json.dumps(result.to_dict(), indent=2)
    if json_file == given.STDOUT:
        print(text, flush=True)
    else:
        write_file(json_file, text + "\n")


def _report(result: Any, folder: Path | None, json_file: Path | None) -> None:
    """Write the report, last of all, so that a failure does not affect results that were given before.

    Raises:
        InputError: The report could not be written; the message has the reason.
    """
    if folder is None:
        return
    from rotflex_jax.discover.discovery import Discovery  # already loaded by the command

    try:
        with terminal.progress("Writing the report") as step:
            searched = isinstance(result, Discovery)
            page = result.report(folder, progress=step) if searched else result.report(folder)
    except Exception as error:
        if isinstance(error, OSError):
            reason = f"{error.filename or folder} cannot be used: {error.strerror or error}"
        else:
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"The report could not be written: {reason.rstrip('.')}.") from error
    terminal.message(f"Report: {page}", error=json_file == given.STDOUT)


# In the order in which a newcomer needs them.
_COMMANDS = (demo, check, discover, compare, simulate, experiment, export, effects, reproduce, arena)
for _command in _COMMANDS:
    app.command()(_command)
app.add_typer(data_app, name="data")
