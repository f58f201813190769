"""`rotflex data`: the public recordings, listed and fetched."""

from typing import Annotated

import typer

from rotflex_jax import arguments as given, terminal

data_app = typer.Typer(help="Public recordings: list them, fetch them.")


@data_app.callback(invoke_without_command=True)
def _start(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@data_app.command("list")
def data_list() -> None:
    """List the public recordings: those that can be fetched, then those to get by hand."""
    from rotflex_jax.data.by_hand import BY_HAND
    from rotflex_jax.data.datasets import list_datasets

    rows = [(d.name, d.about, d.units, d.licence, d.source) for d in list_datasets()]
    terminal.print_rows(("name", "what", "units", "licence", "source"), rows)
    print("\nTo get by hand, and to read with rf.load from what nonlinear_benchmarks gives:\n")
    for d in BY_HAND.values():
        print(f"{d.name}: {d.about}\n  {d.address}\n  nonlinear_benchmarks.{d.loader}")


@data_app.command("fetch")
def data_fetch(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names that `list` shows.")],
) -> None:
    """Fetch public recordings into the user's cache folder, check their hash, print their paths."""
    from rotflex_jax.data.by_hand import BY_HAND
    from rotflex_jax.data.datasets import DATASETS, fetch

    for name in names:
        given.choose(name, (*DATASETS, *BY_HAND), "data set")
    for name in names:
        with terminal.progress(f"Fetching {name}"):
            paths = fetch(name)
        for path in paths:
            print(path)
