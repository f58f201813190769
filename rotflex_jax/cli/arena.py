"""`rotflex arena`: methods that look for missing effects, scored on records of a known truth."""

import json
from pathlib import Path

from rotflex_jax.cli import arguments as given, terminal
from rotflex_jax.errors import InputError, optional
from rotflex_jax.text.files import write_file


def arena(
    methods: given.ArenaMethods = None,
    entrants: given.Entrants = None,
    records: given.Records = 12,
    seed: given.ArenaSeed = None,
    seconds: given.RecordSeconds = 20.0,
    limit: given.AnswerLimit = 600.0,
    measured: given.WithMeasured = False,
    report: given.ReportFile = None,
    json_file: given.JsonFile = None,
) -> None:
    """Score methods, your own or the arena's, on records whose truth none of them sees."""
    own = [Path(m.partition(":")[0]) for m in methods or []]
    given.check_writable(report, or_stdout=json_file, read=own)
    optional("numba", "The simulator of the arena")
    from rotflex_jax.arena.entrants import ENTRANTS

    named = [n for n in (entrants or "").split(",") if n]
    if named == ["all"]:
        named = list(ENTRANTS)
    unknown = [n for n in named if n not in ENTRANTS]
    if unknown:
        raise InputError(
            f"--entrants was given {unknown[0]!r}, but the arena has {', '.join(ENTRANTS)}; name "
            "some of these, or all."
        )
    listed = [*(methods or []), *named]
    if not listed:
        raise InputError(
            "No method was given; name FILE.py:FUNCTION, or --entrants all for those of the arena."
        )
    from rotflex_jax.arena.scores import COLUMNS, FAILED, cells, score

    with terminal.progress("Preparing the records; the simulator is compiled when it is first used") as step:
        scores = score(
            listed,
            records,
            seed,
            seconds=seconds,
            limit=limit,
            with_measured=measured,
            progress=step,
        )
    text = json.dumps(scores.to_dict(), indent=2)
    if json_file == given.STDOUT:
        print(text, flush=True)
    else:
        terminal.print_arena(scores.seed, list(COLUMNS.values()), [cells(s) for s in scores.methods])
        for s in scores.methods:
            for r in s.rows:
                if r.verdict == FAILED:
                    terminal.message(f"{s.method}, record {r.record}: {r.reason}")
        if json_file is not None:
            write_file(json_file, text + "\n")
    if report is not None:
        page = scores.report(Path(report))
        terminal.message(f"Report: {page}", error=json_file == given.STDOUT)
