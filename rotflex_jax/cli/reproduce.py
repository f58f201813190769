"""`rotflex reproduce`: the experiment of the paper, simulated or on recordings."""

import json
from pathlib import Path
from typing import Any

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.cli.recordings import Columns, reads_files
from rotflex_jax.errors import InputError
from rotflex_jax.joints import by_name
from rotflex_jax.text.files import write_file


@reads_files
def reproduce(
    out: given.PageFolder = Path("rotflex-reproduce"),
    data: given.PaperData = None,
    scenario: given.Scenario = None,
    seed: given.Seed = None,
    grey_box: given.GreyBox = False,
    changes: given.Changes = None,
    listed: given.ListSettings = False,
    joints: given.JointNames = None,
    held_out: given.HeldOutForErrors = None,
    split: given.Share = None,
    json_file: given.JsonFile = None,
    *,
    columns: Columns,
) -> None:
    """Run the experiment of the paper this started from: its figures, its model, and better ones."""
    from rotflex_jax.reproduce.settings import Settings

    if listed:
        _list(Settings)
        return
    named = {"scenario": scenario, "seed": seed, "grey_box": grey_box or None}
    settings = Settings().replace(_pairs(changes or []) | {k: v for k, v in named.items() if v is not None})
    if columns.intersample != "held":
        raise InputError(
            "--intersample was given, but the experiment of the paper holds its input; leave it out."
        )
    if columns.substeps is not None:
        raise InputError(
            "--substeps was given, but the experiment of the paper has steps of its own; leave it out."
        )
    if columns.signals:
        raise InputError(
            "--signal was given, but the experiment of the paper has its input alone; leave it out."
        )
    read = [*map(Path, data or []), *(held_out or [])]
    given.check_writable(or_stdout=json_file, folder=out, read=read)
    joint = given.one_model(joints)
    mechanism = by_name.joint(joint)
    parts = _recordings(columns, data or [], held_out or [], split, joints)
    if parts and joint == "paper" and data == ["rotflex"]:
        mechanism = by_name.joint("quanser_2002")  # the laboratory's own constants
    from rotflex_jax.runtime.xla import enable_fast_start

    enable_fast_start()
    from rotflex_jax.reproduce import reproduce as run
    from rotflex_jax.reproduce.page import headings, headline, table, write

    with terminal.progress("Reproducing") as step:
        result = run(settings, *parts, joint=mechanism if parts else None, progress=step)
    terminal.print_findings([recording for part in parts for recording in part])
    quiet = json_file == given.STDOUT
    if quiet:
        print(json.dumps(result.to_dict(), indent=2), flush=True)
    else:
        console = terminal.output()
        console.print(headline(result), style="bold", markup=False)
        console.print("\nSquared error over the variance of the output (NMSE)", style="bold")
        terminal.print_rows(("model", "fitted", *headings(result)), table(result))
        online = f"Online, while it adapted: {result.adaptation.online:.3g}, which is no error of a model."
        console.print(online, markup=False)
        if json_file is not None:
            write_file(json_file, json.dumps(result.to_dict(), indent=2) + "\n")
    with terminal.progress("Writing figures and page"):
        page = write(result, out)
    terminal.message(f"Page: {page}", error=quiet)


def _pairs(texts: list[str]) -> dict[str, str]:
    pairs = {}
    for text in texts:
        name, separator, value = (part.strip() for part in text.partition("="))
        if not separator or not value:
            raise InputError(f"--set was given {text!r}, but needs a name and a value; write --set Ts=0.05.")
        pairs[name] = value
    return pairs


def _recordings(
    columns: Columns,
    data: list[str],
    held_out: list[Path],
    split: float | None,
    joints: list[str] | None,
) -> tuple[Any, ...]:
    """Recordings to fit and held-out recordings; empty for a simulation."""
    share = given.check_split(split, held_out)
    if not data:
        if columns.Ts is not None:
            raise InputError(
                "--Ts was given without --data, but it is the sampling period of a file without a time "
                f"column; write --set Ts={columns.Ts:g} for that of the experiment."
            )
        for option, value in (("held-out", held_out), ("split", split), ("joint", joints)):
            if value:
                raise InputError(
                    f"--{option} was given without --data, but a simulation makes its own held-out data from "
                    "a machine of its own; give --data too, or leave it out."
                )
        if columns != Columns():
            raise InputError(
                "An option that says how to read a file was given without --data; give --data too, or leave "
                "it out."
            )
        return ()
    if data == ["rotflex"] and not Path("rotflex").exists():
        if split is not None:
            raise InputError(
                "--split was given with --data rotflex, but the first recording of that set is fitted and "
                "the second is held out; leave it out, or name a file with --data."
            )
        if columns != Columns() and not held_out:
            raise InputError(
                "An option that says how to read a file was given with --data rotflex, but its files are "
                "read as they need; leave it out, or name a file with --data."
            )
        from rotflex_jax.data.datasets import load_dataset

        first, second = load_dataset("rotflex")
        return [first], [columns.load(file) for file in held_out] or [second]
    files = [Path(file) for file in data]
    given.check_distinct(files, held_out)
    train, test = columns.load_parts(files, held_out, share)
    return train, test


def _list(settings: Any) -> None:
    from rotflex_jax.reproduce.settings import machine_rows

    rows = []
    for row in settings.table() + machine_rows(settings()):
        default = ",".join(map(str, row["default"])) if isinstance(row["default"], tuple) else row["default"]
        default = f"{default:.6g}" if isinstance(default, float) else default
        rows.append((row["name"], f"{default} {row['unit']}".strip(), row["source"], row["why"]))
    terminal.print_rows(("setting", "default", "source", "why"), rows)
