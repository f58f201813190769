"""Mutation tests: change one constant or operator of a module at a time, and run the tests of the module.

    python benchmarks/mutants.py [--number 150] [--seed 21] [--only selection] [--again] [--store FILE]
    python benchmarks/mutants.py --workers 16 --seed 32 --fresh --store benchmarks/results/mutants_fresh.json

What is measured is the share of changes at which a test fails. The places to change are sampled with a fixed
seed, equally many from each area of `AREAS`. Annotations are never changed, nor are arguments that guard
against mistakes of the programmer and do not affect results (`strict` of zip, `frozen` of a dataclass).

The working tree is copied once for each worker. Each mutant runs in a separate process of low priority that
loads the changed code of the module. The files do not change, so compiled programs can be reused; for modules
that are traced into compiled programs, reuse is switched off. The tests stop at the first failure.

Each result is stored, and a stored mutant of the same module text is not run again. `--again` repeats mutants
that survived, for instance after tests were added; "first" in the store is the result of the first run.
Inspect every survivor: either a test is missing, or the change has no effect that matters. In the second
case, write the reason into its row of the store, as "equivalent".
"""

import argparse
import ast
import contextlib
import hashlib
import importlib
import importlib.util
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

from origin import begin

ROOT = Path(__file__).resolve().parents[1]
STORE = Path(__file__).with_name("results") / "mutants.json"


class Tested(NamedTuple):
    """A module, its test files (quick ones first), and whether JAX traces it into compiled programs."""

    module: str
    tests: tuple[str, ...]
    traced: bool = False


AREAS: dict[str, tuple[Tested, ...]] = {
    "decision": (
        Tested(
            "discover/selection.py",
            ("test_discover_selection.py", "test_discover_evaluation.py"),
        ),
        Tested("discover/probabilities.py", ("test_discover_probabilities.py",)),
    ),
    "covariance": (Tested("fit/inference.py", ("test_fit_inference.py",)),),
    "quality": (Tested("recording/quality.py", ("test_recording_quality.py",)),),
    "verdict": (
        Tested(
            "discover/conclusion.py",
            ("test_discover_conclusion.py", "test_discover_verdict.py"),
        ),
        Tested("discover/verdict.py", ("test_discover_conclusion.py", "test_discover_verdict.py")),
    ),
    "localisation": (
        Tested("discover/localise.py", ("test_discover_localise_limits.py", "test_discover_localise.py")),
    ),
    "friction": (Tested("mechanism/friction.py", ("test_mechanism_friction.py",), traced=True),),
}


class Job(NamedTuple):
    """A mutant to run; if `place` is None, the unchanged module."""

    area: str
    tested: Tested
    place: int | None = None


LEAST_LIMIT, LIMIT = 60.0, 6.0
"""Time limit of a mutant: at least so many seconds, and a multiple of the time of its tests.

A mutant that reaches the limit counts as noticed.
"""
_GUARDS = ("strict", "frozen")
_SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


# -- places and changes -----------------------------------------------------------------------------


def places(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that can be changed."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        parts += [node.value] if isinstance(node, ast.keyword) and node.arg in _GUARDS else []
        for part in parts:
            skipped |= {id(inner) for inner in ast.walk(part)} if part is not None else set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float, bool)
        compared = isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPPED
        if number or compared or (isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in _SWAPPED):
            yield node


def mutant(text: str, number: int) -> tuple[ast.AST, int, str]:
    """Syntax tree of a text with one place changed, the line of the change, and the change as text.

    A truth value is negated, an integer increased by 1, another number multiplied by 1.5 (or set to 0.1 if it
    is zero), and an operator replaced by the one in `_SWAPPED`.
    """
    tree = ast.parse(text)
    node = list(places(tree))[number]
    before = ast.unparse(node)
    if isinstance(node, ast.Constant):
        old = node.value
        node.value = (
            not old
            if isinstance(old, bool)
            else old + 1
            if isinstance(old, int)
            else 1.5 * old + 0.1 * (not old)
        )
    elif isinstance(node, ast.Compare):
        node.ops[0] = _SWAPPED[type(node.ops[0])]()  # type: ignore[assignment]
    else:
        node.op = _SWAPPED[type(node.op)]()  # type: ignore[attr-defined]
    return tree, getattr(node, "lineno", 0), f"{before} -> {ast.unparse(node)}"


def sample(number: int, seed: int) -> dict[str, list[tuple[Tested, int]]]:
    """Random places, divided evenly among the areas: area -> modules and indices of places."""
    draw, drawn = random.Random(seed), dict[str, list[tuple[Tested, int]]]()
    left = number
    for k, (area, modules) in enumerate(AREAS.items()):
        there = [(m, n) for m in modules for n in range(len(list(places(ast.parse(source(m))))))]
        count = min(round(left / (len(AREAS) - k)), len(there))
        drawn[area] = sorted(draw.sample(there, count), key=there.index)
        left -= count
    return drawn


def in_turn(drawn: dict[str, list[tuple[Tested, int]]]) -> Iterator[Job]:
    """Jobs of all areas in turn, so that every area has results if the run is stopped early."""
    for row in itertools.zip_longest(
        *([Job(area, *place) for place in chosen] for area, chosen in drawn.items())
    ):
        yield from (place for place in row if place is not None)


def row_name(tested: Tested, number: int | None) -> str:
    """Key of a mutant in the store: module, digest of its text, place."""
    return f"{tested.module} {hashlib.sha256(source(tested).encode()).hexdigest()[:12]} {number}"


def source(tested: Tested) -> str:
    """Text of a module."""
    return (ROOT / "rotflex_jax" / tested.module).read_text()


# -- a process with the changed module --------------------------------------------------------------


class Changed(SourceFileLoader):
    """Import hook that loads changed code for one module."""

    def __init__(self, name: str, path: str, code: CodeType) -> None:
        super().__init__(name, path)
        self._code = code

    def get_code(self, fullname: str) -> CodeType:
        """The changed code."""
        del fullname
        return self._code

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Specification of this module; None for all others."""
        del path, target
        return (
            importlib.util.spec_from_file_location(name, self.path, loader=self)
            if name == self.name
            else None
        )


def run_tests(folder: Path, tested: Tested, tree: ast.AST | None) -> int:
    """Exit status of the tests, run in the child process; the module is unchanged if `tree` is None."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(10)
    os.chdir(folder)
    with open(folder / "said.log", "w") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    os.environ["PYTHONPATH"] = str(folder)
    if tested.traced:
        os.environ["ROTFLEX_PROGRAMS"] = "off"  # stored programs are keyed by the files, which do not change
    sys.path[:0] = [str(folder)]
    name = "rotflex_jax." + tested.module.removesuffix(".py").replace("/", ".")
    if tree is not None:
        file = str(folder / "rotflex_jax" / tested.module)
        sys.meta_path.insert(0, Changed(name, file, compile(tree, file, "exec", dont_inherit=True)))
    importlib.import_module(name)
    import pytest

    # Array shapes are not checked, to save time, so no mutant is noticed by a shape alone.
    options = [
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-o",
        "addopts=--import-mode=importlib --doctest-modules",
    ]
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # for libraries that are already loaded
    files = [f"rotflex_jax/{tested.module}", *(f"tests/{test}" for test in tested.tests)]
    return int(pytest.main([*options, *files]))


class Child(NamedTuple):
    """A process that runs the tests of one mutant, or of the unchanged module."""

    process: int
    begun: float
    limit: float

    def ended(self) -> bool | None:
        """Whether the tests failed or exceeded the time limit; None while they run."""
        done, status = os.waitpid(self.process, os.WNOHANG)
        if done:
            return status != 0
        if time.monotonic() - self.begun < self.limit:
            return None
        self.stop()
        return True

    def stop(self) -> None:
        """Stop the process and the processes that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process, signal.SIGKILL)
        os.waitpid(self.process, 0)


def start(folder: Path, core: int | None, tested: Tested, tree: ast.AST | None, limit: float) -> Child:
    """Start a child process on a copy of the tree, on one core if one is given."""
    process = os.fork()
    if not process:
        status = 1
        try:
            if core is not None:
                os.sched_setaffinity(0, {core})
            status = run_tests(folder, tested, tree)
        except BaseException:  # a module that cannot be loaded counts as noticed
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return Child(process, time.monotonic(), limit)


def done(jobs: Iterable[Job], folders: list[Path], limits: dict[Tested, float]) -> Iterator[tuple]:
    """Job, whether it was noticed, seconds and folder, as jobs end; each folder runs one job at a time."""
    waiting, free = iter(jobs), list(range(len(folders)))
    cores = sorted(os.sched_getaffinity(0))
    running: dict[int, tuple[Job, Child]] = {}
    try:
        while True:
            while free and (job := next(waiting, None)) is not None:
                k = free.pop()
                tree = None if job.place is None else mutant(source(job.tested), job.place)[0]
                core = cores[k % len(cores)] if len(folders) > 1 else None
                running[k] = job, start(folders[k], core, job.tested, tree, limits.get(job.tested, 3600))
            if not running:
                return
            for k, (job, child) in list(running.items()):
                found = child.ended()
                if found is not None:
                    del running[k]
                    free.append(k)
                    yield job, found, time.monotonic() - child.begun, folders[k]
            time.sleep(0.05)
    finally:
        for _, child in running.values():
            child.stop()


def copy(folder: Path) -> None:
    """Copy the working tree without files that tests do not read; the folder of compiled code is shared."""
    ignored = shutil.ignore_patterns(".git", "__pycache__", "_build", ".venv", ".*_cache", ".hypothesis")
    shutil.copytree(ROOT, folder, symlinks=True, ignore=ignored)
    (ROOT / ".pytest_cache").mkdir(exist_ok=True)
    (folder / ".pytest_cache").symlink_to(ROOT / ".pytest_cache")


# -- results ----------------------------------------------------------------------------------------


def tally(rows: list[dict[str, Any]]) -> str:
    """Text with the number of noticed mutants and its lower bound at 95 % (Clopper and Pearson)."""
    from scipy.stats import beta

    n, k = len(rows), sum(r["noticed"] for r in rows)
    same, first = sum("equivalent" in r for r in rows), sum(r["first"] for r in rows)
    least = 100 * float(beta.ppf(0.05, k, n - k + 1)) if k else 0.0
    text = f"{k} of {n} noticed ({100 * k / n:.0f} %, at least {least:.0f} %)"
    text += f", {first} when they were drawn" if first != k else ""
    return text + (f", {same} of the others change nothing" if same else "")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--number", type=int, default=150, help="mutants in all")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--only", default="", help="part of an area or of the name of a module")
    parser.add_argument("--again", action="store_true", help="run survivors once more")
    parser.add_argument("--fresh", action="store_true", help="start a new store")
    parser.add_argument(
        "--workers", type=int, default=1, help="copies of the tree, each on a core of its own"
    )
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no mutant after so long")
    parser.add_argument("--store", type=Path, default=STORE)
    asked = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # this also stops the children
    begun = time.monotonic()
    found: dict[str, Any] = {"runs": [], "sources": {}, "mutants": {}}
    if asked.store.exists() and not asked.fresh:
        found = json.loads(asked.store.read_text())
    kept = found["mutants"]
    drawn = sample(asked.number, asked.seed)
    jobs = list[Job]()
    for job in in_turn(drawn):
        old = kept.get(row_name(job.tested, job.place))
        known = old and (old["noticed"] or "equivalent" in old or not asked.again)
        if not known and (asked.only in job.area or asked.only in job.tested.module):
            jobs.append(job)
    modules = list(dict.fromkeys(job.tested for job in jobs))
    if jobs:
        # The run measures the modules and their tests, which this script does not import.
        files = [f"rotflex_jax/{t.module}" for t in modules] + [
            f"tests/{f}" for t in modules for f in t.tests
        ]
        made = begin(found, __file__, sys.argv[1:], files=files)
        # Imported before the fork, so that children need not import them. JAX is not started here.
        import equinox  # noqa: F401
        import hypothesis  # noqa: F401
        import jax  # noqa: F401
        import jinja2  # noqa: F401
        import matplotlib.pyplot  # noqa: F401
        import pytest  # noqa: F401
        import scipy.signal
        import scipy.stats  # noqa: F401

        with tempfile.TemporaryDirectory() as temporary:
            folders = [Path(temporary) / str(k) for k in range(min(asked.workers, len(jobs)))]
            for folder in folders:
                copy(folder)
            limits = dict[Tested, float]()
            for job, failed, took, folder in done([Job("", tested) for tested in modules], folders, {}):
                if failed:
                    said = (folder / "said.log").read_text()[-2000:]
                    sys.exit(f"{job.tested.module}: its tests fail as it is\n{said}")
                limits[job.tested] = max(LEAST_LIMIT, LIMIT * took)
                print(f"{job.tested.module}: its tests take {took:.0f} s", flush=True)
            in_time = itertools.takewhile(lambda _: time.monotonic() - begun < 60 * asked.minutes, jobs)
            for job, seen, took, _ in done(in_time, folders, limits):
                key = row_name(job.tested, job.place)
                _, line, what = mutant(source(job.tested), job.place)
                first = kept[key]["first"] if key in kept else seen
                row = {"area": job.area, "line": line, "change": what, "first": first, "noticed": seen}
                kept[key] = {**row, "code": made["code"]}
                write(asked.store, found)
                word = "noticed " if seen else "SURVIVED"
                print(f"  {word} {job.tested.module} {line}: {what[:90]} ({took:.0f} s)", flush=True)
    total = []
    for area, chosen in drawn.items():
        keys = [row_name(*place) for place in chosen]
        rows = [kept[key] for key in keys if key in kept]
        total += rows
        if rows:
            print(f"{area}: {tally(rows)}")
    if total:
        print(f"all: {tally(total)}")


def write(store: Path, found: dict[str, Any]) -> None:
    """Write to a second file and rename it, so that an interruption loses nothing."""
    store.parent.mkdir(parents=True, exist_ok=True)
    beside = store.with_name(f".{store.name}")
    beside.write_text(
        json.dumps(found | {"mutants": dict(sorted(found["mutants"].items()))}, indent=1) + "\n"
    )
    beside.replace(store)


if __name__ == "__main__":
    main()
