"""`rotflex discover --each`: every file by itself, many at once."""

import functools
import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.recordings import Columns, public_name
from rotflex_jax.errors import InputError
from rotflex_jax.text.files import write_file

SUMMARY_FOLDER = Path("rotflex-each")


def check_each(each: bool, only: Mapping[str, Any], never: Mapping[str, Any]) -> None:
    """Refuse options that need --each if it is missing, and options that exclude --each if it is given."""
    for name, value in (never if each else only).items():
        if value is None or value == []:
            continue
        if each:
            raise InputError(
                f"--{name} and --each were both given, but with --each every FILE is split and gets a "
                "model of its own; leave one of the two out."
            )
        raise InputError(
            f"--{name} was given, but one search of all FILEs together runs in this process; add --each to "
            "search each by itself."
        )


def search_each(
    model: Any,
    files: Sequence[Path],
    columns: Columns,
    share: float,
    folder: Path | None,
    json_file: Path | None,
    scheduler: str | None,
    workers: int | None,
    calibrate_seconds: float = 2.0,
) -> None:
    """Search every file, and every recording of a public data set, write the summary, show it."""
    from rotflex_jax.batch import fleet
    from rotflex_jax.discover import discover
    from rotflex_jax.runtime.xla import enable_fast_start

    # With the usual value no `search` is given, so that the results are those of a usual `rotflex_jax.fleet`.
    usual = inspect.signature(discover).parameters["calibrate_seconds"].default
    options: dict[str, Any] = {}
    if calibrate_seconds != usual:
        options["search"] = functools.partial(discover, calibrate_seconds=calibrate_seconds)
    sources = [
        source
        for file in files
        for source in ([file] if public_name(file) is None else columns.load_all([file]))
    ]
    if workers == 0:
        enable_fast_start()  # this process then does the work
    with terminal.progress("Searching") as step:
        result = fleet(
            model,
            sources,
            folder=folder or SUMMARY_FOLDER,
            scheduler=scheduler,
            workers=workers,
            split=share,
            pages=True,
            progress=lambda line: step(given.as_options(line)),
            **options,
            **columns.reading(),
        )
    if len(result.failed) == len(sources):
        raise InputError(
            f"No search of {len(sources)} gave an answer; the first, {result.rows[0].name}: "
            f"{result.rows[0].reason}"
        )
    text = json.dumps(result.to_dict(), indent=2)
    if json_file == given.STDOUT:
        print(text)
    else:
        terminal.print_fleet(result)
        if json_file is not None:
            write_file(json_file, text + "\n")
    terminal.message(f"Summary: {result.page}", error=json_file == given.STDOUT)
