"""Searches that are killed at random times and continued: no result may be lost, repeated or damaged.

    python benchmarks/kills.py [--kills 50] [--seed 0]

Two kinds of processes are killed in turn: a search that stores its rounds and continues from them (as with
`--continue` on the command line), and a fleet of searches in a folder. The process gets SIGKILL, so that it
cannot clean up. After each kill, every file of results must be complete, rounds that were stored before
must still be stored, and files of finished recordings must be unchanged. After one to four
kills the process runs to its end, and its result must equal that of a process that was never killed.
"""

import argparse
import functools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
sys.path.insert(0, str(HERE.parents[1] / "tests"))  # `spindle`, a small machine

RECORDINGS, KILLS_IN_A_ROW = 3, 4
LONGEST_WAIT = 1.0
"""Longest time between a line of progress and a kill [s]."""


# -- processes that are killed ----------------------------------------------------------------------


def say(line: str) -> None:
    """Prints the first line of a message at once."""
    print(line.partition("\n")[0], flush=True)


def search(folder: Path) -> None:
    """Like the command line: rounds are stored, then the result is written, then the rounds are removed."""
    from spindle import PAIRS, SPINDLE, spun

    import rotflex_jax as rf
    from rotflex_jax.cli.rounds import RoundsSoFar
    from rotflex_jax.text.files import write_file

    rounds = RoundsSoFar(folder / "found.json")
    left = folder / "found.stopped.json"
    say("started")
    result = rf.discover(
        SPINDLE,
        *spun().split(0.7),
        candidates=PAIRS,
        resume=left if left.exists() else None,
        progress=rounds.following(say),
    )
    write_file(folder / "found.json", json.dumps(result.to_dict()))
    rounds.remove()


def fleet(folder: Path) -> None:
    """Searches of several recordings, one after the other."""
    from spindle import PAIRS, SPINDLE, spun

    import rotflex_jax as rf

    say("started")
    run = functools.partial(rf.discover, candidates=PAIRS, progress=say)
    recordings = [spun(seed=number) for number in range(RECORDINGS)]
    rf.fleet(SPINDLE, recordings, folder=folder / "fleet", workers=0, search=run)


# -- their files ------------------------------------------------------------------------------------


def kept_rounds(folder: Path) -> list[str]:
    """Models of the rounds that a search has stored; a damaged file is an error."""
    file = folder / "found.stopped.json"
    return [entry["model"] for entry in json.loads(file.read_text())["stages"]] if file.exists() else []


def finished(folder: Path) -> dict[str, tuple[int, dict[str, Any]]]:
    """Finished results of a fleet, each with the time of its file."""
    files = sorted((folder / "fleet" / "recordings").glob("[!.]*.json"))
    return {f.name: (f.stat().st_mtime_ns, json.loads(f.read_text())) for f in files}


def essence(found: dict[str, Any]) -> tuple[Any, ...]:
    """Verdict, effects and errors of a search, without times and notes."""
    rounds = [(r["effect"], r["port"]) for r in found["rounds"]]
    last = found["rounds"][-1] if rounds else found["baseline"]
    return found["verdict"], rounds, {c: float(f"{e:.2g}") for c, e in last["held_out_rmse"].items()}


def outcome(kind: str, folder: Path) -> Any:
    """Result of a search or a fleet that has ended; every file of it is read."""
    if kind == "search":
        assert not (folder / "found.stopped.json").exists(), "rounds were left behind"
        return essence(json.loads((folder / "found.json").read_text()))
    import csv

    found = {
        name: (r["state"], r["reason"] or essence(r["result"])) for name, (_, r) in finished(folder).items()
    }
    with (folder / "fleet" / "summary.csv").open(newline="") as file:
        rows = [row["name"] for row in csv.DictReader(file)]
    assert sorted(rows) == sorted(Path(name).stem for name in found), rows
    assert len(rows) == RECORDINGS, rows
    return found


# -- the process that kills -------------------------------------------------------------------------


def start(kind: str, folder: Path, programs: Path) -> subprocess.Popen[str]:
    """Starts a process, and returns when it has loaded the package."""
    # Programs are compiled once, so that most of the time is the search.
    environment = os.environ | {"PYTHONPATH": str(HERE.parents[1]), "ROTFLEX_PROGRAMS": str(programs)}
    command = [sys.executable, str(HERE), "--victim", kind, str(folder)]
    with (folder / "errors.log").open("w") as errors:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n", (folder / "errors.log").read_text()
    return process


def to_its_end(kind: str, folder: Path, programs: Path) -> int:
    """Runs a process to its end; returns the number of its lines of progress."""
    process = start(kind, folder, programs)
    said, _ = process.communicate()
    assert process.returncode == 0, (folder / "errors.log").read_text()
    return len(said.splitlines())


def killed(process: subprocess.Popen[str], lines: int, wait: float) -> bool:
    """Kills a process some time after a number of lines of progress; False if it had ended before."""
    assert process.stdout is not None
    for _ in range(lines):
        process.stdout.readline()
    try:
        process.wait(wait)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode in (0, -signal.SIGKILL)
    return process.returncode != 0


def kills(
    number: int, seed: int, folder: Path, programs: Path, kinds: tuple[str, ...] = ("search", "fleet")
) -> Iterator[str]:
    """Performs a number of kills, of each kind in turn, and yields a line for each.

    Raises:
        AssertionError: A result was lost, repeated or damaged.
    """
    draw = random.Random(seed)
    expected, lines = {}, {}
    for kind in kinds:
        whole = folder / f"{kind}-whole"
        whole.mkdir()
        lines[kind] = to_its_end(kind, whole, programs)
        expected[kind] = outcome(kind, whole)
    done, turn = 0, 0
    while done < number:
        kind, place = kinds[turn % len(kinds)], folder / f"killed-{turn}"
        place.mkdir()
        turn += 1
        for _ in range(draw.randint(1, min(KILLS_IN_A_ROW, number - done))):
            rounds_before, results_before = kept_rounds(place), finished(place)
            after, wait = draw.randint(0, lines[kind]), draw.uniform(0, LONGEST_WAIT)
            was_killed = killed(start(kind, place, programs), after, wait)
            done += was_killed
            rounds, results = kept_rounds(place), finished(place)
            whole = (place / "found.json").exists() and bool(json.loads((place / "found.json").read_text()))
            assert whole or rounds[: len(rounds_before)] == rounds_before, (rounds_before, rounds)
            # A finished result is neither lost nor computed again.
            assert {name: results[name] for name in results_before} == results_before
            left = f"{len(rounds)} models kept" if kind == "search" else f"{len(results)} finished"
            if was_killed:
                yield f"{done:3d} {kind} killed {wait:.2f} s after line {after}: {left}"
            if whole or not was_killed:
                break
        to_its_end(kind, place, programs)
        assert outcome(kind, place) == expected[kind], (outcome(kind, place), expected[kind])


if __name__ == "__main__":
    if sys.argv[1:2] == ["--victim"]:
        {"search": search, "fleet": fleet}[sys.argv[2]](Path(sys.argv[3]))
        sys.exit(0)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for said in kills(asked.kills, asked.seed, Path(temporary), Path(temporary, "programs")):
            print(said, flush=True)
    print(f"{asked.kills} kills: nothing lost, nothing twice, no damaged file read")
