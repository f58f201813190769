"""B0: how often the search finds one hidden effect, and nothing where nothing is hidden.

An independent simulator (`rotflex_jax.arena.simulator`) makes recordings of the flexible joint with a known
hidden effect. Its constants differ by up to 20 % from those of the model with which the search starts; the
search is given the voltage and the encoder readings. By default the recordings hide

- every effect of the catalogue at every port where it makes sense, with two inputs and two seeds each;
- effects that the catalogue lacks, for which the right verdict is `unexplained`;
- nothing, in 20 recordings.

Each answer is compared with the hidden effects, and the errors of the final model with those of the true
structure fitted to the same data (the oracle). Settings of the search are tuned with the tuning seeds,
results are reported with the report seeds. Recordings with the first two report seeds were read during
revisions of the search (`claims.SEEN`), so that quoted figures leave them out.

    python benchmarks/B0_discovery.py --workers 2
    python benchmarks/B0_discovery.py --tuning --seeds 100 --inputs noise
    python benchmarks/B0_discovery.py --size 1,0.3,0.1 --inputs noise --seeds 1000
    python benchmarks/B0_discovery.py --channels theta --inputs noise --seeds 1000
    python benchmarks/B0_discovery.py --pairs 36 --triples 12 --inputs noise --seeds 1000

    python benchmarks/B0_discovery.py --oracles
    python benchmarks/B0_discovery.py --again --minutes 5 --workers 16

    python benchmarks/B0_discovery.py --wrong-worlds 96 --workers 16
    python benchmarks/B0_discovery.py --wrong-worlds 24 --tuning

Wrong worlds (`rotflex_jax.arena.wrong_worlds`) are recordings as in a laboratory, of machines whose model
has more than one error. They have separate seeds and a separate results file and page
(`results/B0_wrong_worlds.json`).

Results are written to `results/B0.json` (`B0_tuning.json` with `--tuning`) after each recording. Recordings
that the file already contains are skipped; `--fresh` starts a new file. The tables and figures beside the
file cover all of its recordings. `--again` repeats the recordings of the file that were searched with
another version of the code, and replaces them one by one, so that it can be interrupted and continued.
`--oracles` only repeats the fits of the true structures.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

from rich.console import Console

from arena.pages import publish
from arena.probability import drawn_probabilities, summary
from arena.table import answer, label, show
from arena.wrong_seeds import REPORT as WORLDS_REPORT, TUNING as WORLDS_TUNING
from arena.wrong_table import publish_worlds, show_worlds
from origin import begin
from rotflex_jax.arena.simulator.draws import drawn
from rotflex_jax.arena.simulator.hidden import DEFAULTS, OUTSIDE
from rotflex_jax.arena.simulator.records import INPUTS

TUNING, REPORT = tuple(range(100, 120)), tuple(range(1000, 1020))
Job = dict[str, Any]
JOB = ("world", "effects", "kind", "seed", "size", "seconds", "channels", "keep_evidence")
"""Keys of a row that repeat its job, from which `--again` rebuilds the job."""

from rotflex_jax.text.files import write_file


def jobs(a: argparse.Namespace, seeds: list[int], inputs: list[str]) -> list[Job]:
    """Jobs of a run; those with nothing hidden have one seed each and take the kinds of input in turn."""
    groups = [(place,) for place in (*DEFAULTS, *OUTSIDE)]
    if a.pairs or a.triples:
        groups = [*drawn(a.pairs, 2), *drawn(a.triples, 3)]
    sizes = [float(x) for x in a.size.split(",")]
    channels = {"both": ["theta", "alpha"]}.get(a.channels, [a.channels])
    plain = sizes == [1.0] and len(channels) == 2 and not (a.pairs or a.triples)
    hidden = [
        {"effects": [list(place) for place in group], "kind": kind, "seed": seed, "size": size}
        for size in sizes
        for group in groups
        for kind in inputs
        for seed in seeds
        if all(place[1] in channels or place[1] not in ("theta", "alpha") for place in group)
    ]
    base, kinds = seeds[0] // 100 * 100, list(INPUTS)
    count = a.nulls if a.nulls is not None else 20 * plain
    nothing = [
        {"effects": [], "kind": kinds[k % len(kinds)], "seed": base + k, "size": 1.0} for k in range(count)
    ]
    every = [{**j, "seconds": a.seconds, "channels": channels} for j in hidden + nothing]
    return [j for j in every if not a.only or a.only in label(j)]


def key(job: Job) -> str:
    """Key of a recording in the results."""
    if "world" in job:
        return f"wrong world|{job['world']}"
    return f"{label(job)}|{job['kind']}|{job['seed']}|{job['seconds']:g}s"


def prepare(started: Any = None) -> None:
    """Settings of a process that must be made before JAX starts.

    Args:
        started: counter of the processes that share this machine; each process is then bound to one core, so
            that JAX starts one thread. None for a single process.
    """
    from rotflex_jax.runtime.xla import bind_to_cores, cores, enable_fast_loops

    enable_fast_loops()
    if started is not None:
        with started.get_lock():
            place = started.value
            started.value += 1
        every = cores()
        bind_to_cores(place % every, every)


def one(job: Job) -> dict[str, Any]:
    """Row of a job, computed in a worker; imports follow the settings of the process."""
    if "world" in job:
        from arena.wrong_trial import trial
    else:
        from arena.trial import trial

    return trial(job)


def again(row: Job) -> dict[str, Any]:
    """A finished row with its oracle fitted again, computed in a worker."""
    from arena.trial import evaluated_again

    return evaluated_again(row)


def rows(
    todo: list[Job],
    workers: int,
    task: Callable[[Job], dict[str, Any]] = one,
    minutes: float = math.inf,
) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Yields each job with its row as soon as it is finished; if a process dies, the rest is started again.

    Args:
        todo: Jobs to run.
        workers: Number of processes; with 1, the jobs run in this process.
        task: Function that computes the row of a job.
        minutes: Time after which no further job is started; running jobs are completed.
    """
    until = time.monotonic() + 60 * minutes
    if workers == 1:
        prepare()
        yield from ((job, task(job)) for job in todo if time.monotonic() < until)
        return
    context = get_context("spawn")
    started = context.Value("i", 0)
    left = todo
    while left:
        broken = list[Job]()
        with ProcessPoolExecutor(workers, context, initializer=prepare, initargs=(started,)) as pool:
            running = {pool.submit(task, job): job for job in left}
            for done in finished(running, until):
                job = running[done]
                try:
                    row = done.result()
                except BrokenProcessPool:
                    broken.append(job)
                    continue
                except Exception as problem:  # a failure is recorded as a row
                    row = {**job, "error": f"{type(problem).__name__}: {problem}", "lines": []}
                yield job, row
        if len(broken) == len(left):  # no job was completed
            for job in broken:
                yield job, {**job, "error": "its process died", "lines": []}
            return
        left = broken


def finished(running: Collection[Future[Any]], until: float) -> Iterator[Future[Any]]:
    """Yields jobs as they end; none is started after the time `until` of the monotonic clock."""
    for done in as_completed(running):
        if time.monotonic() > until:
            for waiting in running:
                waiting.cancel()
        if not done.cancelled():
            yield done


def save(path: Path, results: dict[str, Any]) -> None:
    """Writes the results completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(results, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description="Does the search find one hidden effect?")
    parser.add_argument("--tuning", action="store_true", help="tuning seeds (report seeds if not)")
    parser.add_argument("--seeds", default="", help="as 1000,1001; the first two if omitted")
    parser.add_argument("--inputs", default="noise,multisine", help=", ".join(INPUTS))
    parser.add_argument("--only", default="", help="part of a name, as coulomb@hub or nothing")
    parser.add_argument("--nulls", type=int, default=None, help="records with nothing hidden")
    parser.add_argument("--size", default="1", help="shares of the usual sizes, as 1,0.3,0.1")
    parser.add_argument("--channels", default="both", choices=["both", "theta", "alpha"], help="sensors")
    parser.add_argument("--pairs", type=int, default=0, help="machines with two effects, instead of one")
    parser.add_argument("--triples", type=int, default=0, help="machines with three effects")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a record [s]")
    parser.add_argument("--quick", action="store_true", help="one seed, one input, 10 s, 5 nulls")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument(
        "--wrong-worlds", type=int, default=0, metavar="COUNT", help="so many wrong worlds, instead"
    )
    parser.add_argument("--oracles", action="store_true", help="of all known records once more, no search")
    parser.add_argument("--fresh", action="store_true", help="do not reuse records in the file")
    parser.add_argument("--again", action="store_true", help="known records of other code, once more")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin no record after so long")
    parser.add_argument("--out", type=Path, default=None, help="results file")
    return parser.parse_args()


def main() -> int:
    """Runs missing recordings, saves after each one, and prints the table."""
    a = arguments()
    of = {True: (WORLDS_TUNING, WORLDS_REPORT), False: (TUNING, REPORT)}[bool(a.wrong_worlds)]
    known_seeds, first = of[0] if a.tuning else of[1], a.wrong_worlds or 2
    seeds = [int(s) for s in a.seeds.split(",") if s] or list(known_seeds[:first])
    inputs = [k for k in a.inputs.split(",") if k]
    if set(inputs) - set(INPUTS):
        raise SystemExit(f"--inputs was given {a.inputs}; choose from {', '.join(INPUTS)}.")
    wrong = [s for s in seeds if s not in known_seeds]
    if wrong:
        kind = "tuning" if a.tuning else "report"
        raise SystemExit(f"--seeds was given {wrong}, which are no {kind} seeds.")
    if a.quick:
        seeds, inputs, a.seconds = seeds[:1], inputs[:1], 10.0
        a.nulls = min(5 if a.nulls is None else a.nulls, 5)
    if a.wrong_worlds and (a.quick or a.oracles):
        raise SystemExit("--wrong-worlds has neither --quick nor --oracles; give a smaller COUNT.")
    suffix = "_wrong_worlds" if a.wrong_worlds else ""
    suffix += ("_tuning" if a.tuning else "") + ("_quick" if a.quick else "")
    path = a.out or HERE / "results" / f"B0{suffix}.json"
    wanted = [{"world": s} for s in seeds] if a.wrong_worlds else jobs(a, seeds, inputs)
    if a.tuning:  # the calibration of probabilities uses the evidence
        wanted = [{**job, "keep_evidence": True} for job in wanted]
    title = "B0, wrong worlds" if a.wrong_worlds else "B0"
    results: dict[str, Any] = {"benchmark": title, "runs": [], "records": {}}
    if path.exists() and not a.fresh:
        results = json.loads(path.read_text())
    made = begin(results, __file__, sys.argv[1:])
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 200)
    known = results["records"]
    if a.again:
        wanted = [{name: row[name] for name in JOB if name in row} for row in known.values()]
    current = lambda row: "error" not in row and (not a.again or row.get("code") == made["code"])  # noqa: E731
    todo = [j for j in wanted if key(j) not in known or not current(known[key(j)])]
    task = one
    if a.oracles:
        task = again
        wanted = todo = [r for r in known.values() if "error" not in r]
    console.print(f"{len(wanted)} records, {len(wanted) - len(todo)} known, {len(todo)} to run")
    began = time.perf_counter()
    for count, (job, row) in enumerate(rows(todo, a.workers, task, a.minutes), 1):
        new = {"oracle_code": made["code"]} if a.oracles else {}
        known[key(job)] = {"code": made["code"], **row, **new}
        save(path, results)
        got = row.get("error") or f"{answer(row)}, {row['verdict']}, {row['wall_s']:.1f} s"
        left = (time.perf_counter() - began) / count * (len(todo) - count)
        text = f"{count}/{len(todo)} {key(job)} -> {got} ({left:.0f} s left)"
        console.print(text, markup=False, soft_wrap=True)
    shown = [known[key(j)] for j in wanted if key(j) in known]
    (show_worlds if a.wrong_worlds else show)(console, shown)
    console.print(summary(shown), markup=False, soft_wrap=True)
    codes = {r.get("code") for r in shown}
    if len(codes) > 1:
        console.print(f"[yellow]These records come from {len(codes)} versions of the package.[/]")
    pages = (publish_worlds if a.wrong_worlds else publish)(list(known.values()), path)
    for file in (path, *pages, *drawn_probabilities(list(known.values()), path)):
        console.print(f"saved: {file}", markup=False, soft_wrap=True)
    return int(any("error" in r for r in shown))


if __name__ == "__main__":
    raise SystemExit(main())
