"""`rotflex check`: quality of recordings; `rotflex data`: the public ones, listed and fetched."""

from typing import TYPE_CHECKING

import typer

from rotflex_jax.checks import choose
from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.recordings import Columns, joint_for, reads_files
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name

if TYPE_CHECKING:
    from rotflex_jax.models.model import Model
    from rotflex_jax.recording import Recording

# Shortest recording without a note [s]; a shorter one has too few reversals to fit and to validate.
SHORTEST_FOR_SEARCH = 5.0

data_app = typer.Typer(help="Public recordings: list them, fetch them.")


@data_app.callback(invoke_without_command=True)
def _start(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@data_app.command("list")
def data_list() -> None:
    """List the public recordings: those that can be fetched, then those to get by hand."""
    from rotflex_jax.data.datasets import list_datasets
    from rotflex_jax.data.registry import BY_HAND

    rows = [(d.name, d.about, d.units, d.licence, d.source) for d in list_datasets()]
    terminal.print_rows(("name", "what", "units", "licence", "source"), rows)
    print("\nTo get by hand, and to read with rf.load from what nonlinear_benchmarks gives:\n")
    for d in BY_HAND.values():
        print(f"{d.name}: {d.about}\n  {d.address}\n  nonlinear_benchmarks.{d.loader}")


@data_app.command("fetch")
def data_fetch(
    names: given.DataNames,
) -> None:
    """Fetch public recordings into the user's cache folder, check their hash, print their paths."""
    from rotflex_jax.data.datasets import DATASETS, fetch
    from rotflex_jax.data.registry import BY_HAND

    for name in names:
        choose(name, (*DATASETS, *BY_HAND), "data set")
    for name in names:
        with terminal.progress(f"Fetching {name}"):
            paths = fetch(name)
        for path in paths:
            terminal.message(str(path))


@reads_files
def check(
    files: given.Files,
    joints: given.JointNames = None,
    *,
    columns: Columns,
) -> None:
    """Say what is in a recording and what is wrong with it; takes seconds.

    With --joint also which parameters of that model the recording can determine.
    """
    named = bool(joints)
    given.check_distinct(files, [])
    joint = joint_for(files, given.one_model(joints), columns)
    model = by_name.model(joint)
    model, columns = columns.of(model)
    refused = []
    for file in files:
        try:
            for recording in columns.load_all([file]):
                _say_what_is_in(recording, str(file), model, joint, named)
        except InputError as error:
            if len(files) == 1:
                raise
            refused.append(str(file))
            terminal.message(f"error: {given.as_options(str(error))}")
    if refused:
        raise InputError(
            f"{len(refused)} of {len(files)} files were refused, {', '.join(refused)}; the lines that begin "
            "with error: say why."
        )


def _say_what_is_in(recording: "Recording", name: str, model: "Model", joint: str, named: bool) -> None:
    """Print what was read, whether its signs agree with the model and, if it is named, what can be known."""
    from rotflex_jax.fit.plausibility import check_signs

    terminal.print_recording(recording)
    if recording.duration < SHORTEST_FOR_SEARCH:
        terminal.message(
            f"note: {recording.duration:g} s are little for a search; ten to twenty with many reversals "
            "are right."
        )
    try:
        check_signs(model, [recording])
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    channels = " and ".join(model.mechanism.channels)
    terminal.message(
        f"The signs of {channels} were not compared with {joint}, since a signal may move the machine "
        "more than the input does."
        if recording.signals
        else f"The signs of {channels} do not contradict {joint}."
    )
    if named:
        _say_what_can_be_known(model, recording, joint)


def _say_what_can_be_known(model: "Model", recording: "Recording", joint: str) -> None:
    """Print which parameters of a model a recording determines, at the model's own parameter values."""
    from rotflex_jax.fit.identifiable import identifiable

    if not model.mechanism.free_names:
        return
    try:
        with terminal.progress("What these sensors can determine"):
            found = identifiable(model, recording)
    except InputError as error:  # the recording may be good where the parameters of the model are not
        terminal.message(f"note: {error}")
        return
    terminal.message(f"What can be known of {joint}, at its own parameters:")
    for sentence in found.sentences:
        terminal.message(f"  {sentence}")
