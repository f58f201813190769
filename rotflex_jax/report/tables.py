"""Rows of the tables, and the same tables for a terminal or a notebook."""

from rich.markup import escape
from rich.table import Table

from rotflex_jax.discover.result import SearchResult
from rotflex_jax.discover.tables import channel_headings, error_rows, noise_row, parameter_rows


def summary_table(discovery: SearchResult) -> Table:
    """Table of the held-out errors of the baseline and after each round, for `rich.print`.

    Args:
        discovery: Result of a search.

    Returns:
        A table, which a notebook displays.
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
    for kind in (f"free runs over {seconds}", "one long run"):
        for heading in channel_headings(discovery):
            table.add_column(escape(f"{heading}\n{kind}"), justify="right")
    for row in error_rows(discovery):
        cells = (*row.windows, *row.whole)
        styled = (f"[green]{c.value}[/green]" if c.reached else c.value for c in cells)
        table.add_row(escape(row.label), *styled)
    floor = noise_row(discovery)
    table.add_row("sensor noise", *floor, *floor, style="dim")
    return table


def parameter_table(discovery: SearchResult) -> Table:
    """Table of the parameters of the final model, or of the final fit, with 95 % intervals, for `rich.print`.

    Args:
        discovery: Result of a search.

    Returns:
        A table, which a notebook displays.
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
