"""Origin of a file of results: date, commit, versions, and the source files on which the results depend.

    python benchmarks/origin.py               # for each file: whether it is from the present code
    python benchmarks/origin.py B3.json       # for one file, with the source files that have changed

Results depend on the script of the benchmark and on all modules of this folder and of the package that it
imports, also within functions. Re-exported names are followed to the module that declares them, so that a
benchmark of fits does not depend on exports. Modules that only write and show (`SHOWN`) are left out, since
they change no number. Files are compared by digests that ignore comments, layout, docstrings and the texts
of errors.

A file of results has `runs`, with one entry for each start of its benchmark, and `sources`, with the digests
of the source files under the names that the entries refer to. If a benchmark was run in parts, `parts`, or
`code` in each row, names the version that computed them; runs without any remaining result do not count.
"""

from __future__ import annotations

import argparse
import ast
import datetime
import functools
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
RESULTS = HERE / "results"

SHOWN = ("text", "report", "notebook", "cli", "errors", "checks")
"""Parts of the package that only write, show or reject input."""

DRAWN = ("page", "pages", "figure", "figures", "drawing", "origin")
"""Last words of the names of modules that only write or show, in the package and in the benchmarks."""

TABLE = "table"
"""Last word of the names of benchmark modules that only show; `rotflex_jax/compare/table.py` computes."""

REGISTRIES = ("rotflex_jax.effects", "rotflex_jax.compare")
"""Packages that count as a whole, since their contents are found through a registry."""


# -- digest of a source file --------------------------------------------------------------------------------


def meaning(text: str) -> str:
    """Digest of a Python source without comments, layout, docstrings and the texts of its errors.

    The same in every version of Python that can read the source.

    >>> meaning("a = 1  # one") == meaning("a = (1)"), meaning("a = 1") == meaning("a = 2")
    (True, False)
    """
    found = hashlib.sha256()
    for part in _parts(ast.parse(text), wordless=False):
        found.update(part.encode() + b"\0")
    return found.hexdigest()[:12]


def _parts(node: Any, wordless: bool) -> Iterator[str]:
    """Types and values of a tree, in order; without the strings in `raise` statements."""
    if isinstance(node, list):
        yield "["
        for part in node:
            yield from _parts(part, wordless)
        yield "]"
    elif isinstance(node, ast.AST):
        yield type(node).__name__
        wordless = wordless or isinstance(node, ast.Raise)
        if wordless and isinstance(node, ast.Constant) and isinstance(node.value, str):
            return
        for name, value in ast.iter_fields(node):
            # Empty fields are skipped, since some versions of Python have fields that others lack.
            if value in (None, []) or name in ("ctx", "kind", "type_comment"):
                continue
            if isinstance(value, list):
                value = [part for part in value if not _is_text(part)]
            yield name
            yield from _parts(value, wordless)
    else:
        yield repr(node)


def _is_text(statement: ast.AST) -> bool:
    """Whether a statement is only a string: a docstring, or the description of the constant above it."""
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


# -- source files on which a script depends -----------------------------------------------------------------


class Imports:
    """Modules of the package and of the benchmarks under a folder, and what each of them imports."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        self._read: dict[Path, str] = {}
        self._handed_on: dict[str, dict[str, tuple[str, str]]] = {}

    def file(self, name: str) -> Path | None:
        """File of a module by its full name, `__init__.py` of a package; None for other projects."""
        here = self.root if name.partition(".")[0] == "rotflex_jax" else self.root / "benchmarks"
        base = here.joinpath(*name.split("."))
        files = (base.with_suffix(".py"), base / "__init__.py")
        return next((file for file in files if file.is_file()), None)

    def text(self, file: Path) -> str:
        """The text of a file."""
        if file not in self._read:
            self._read[file] = file.read_text(encoding="utf-8")
        return self._read[file]

    def sources(self, script: str) -> dict[str, str]:
        """Digests, by path, of the files on which the results of a benchmark script depend; its own is first.

        Args:
            script: name of the module, such as "B3_public".
        """
        found, waiting = dict[str, str](), [script]
        seen = set(waiting)
        while waiting:
            name = waiting.pop()
            file = self.file(name)
            # The package itself only lists names, and each of them is followed.
            if file is None or name == "rotflex_jax" or (name != script and _shows(name)):
                continue
            found[file.relative_to(self.root).as_posix()] = meaning(self.text(file))
            new = self.imported(name) - seen
            seen |= new
            waiting += sorted(new)
        return found

    def imported(self, name: str) -> set[str]:
        """Full names of the modules of this project that declare what a module imports."""
        file = self.file(name)
        assert file is not None, name
        found, called = set[str](), dict[str, str]()
        tree = ast.parse(self.text(file))
        for node in _executed(tree):
            if isinstance(node, ast.ImportFrom):
                source = _absolute(node, name, file)
                for alias in node.names:
                    modules = self.declares(source, alias.name)
                    found |= modules
                    if modules == {f"{source}.{alias.name}"}:
                        called[alias.asname or alias.name] = f"{source}.{alias.name}"
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    first = alias.name.partition(".")[0]
                    called[alias.asname or first] = alias.name if alias.asname else first
                    found |= {alias.name} if self.file(alias.name) else set()
            elif isinstance(node, ast.Attribute):
                found |= self._by_attributes(node, called)
        return found

    def _by_attributes(self, node: ast.Attribute, called: dict[str, str]) -> set[str]:
        """Modules that an expression such as `rf.effects.Coulomb` uses, where `rf` was imported."""
        names = list[str]()
        here: ast.AST = node
        while isinstance(here, ast.Attribute):
            names.append(here.attr)
            here = here.value
        package = called.get(here.id) if isinstance(here, ast.Name) else None
        found = set[str]()
        for attribute in reversed(names):
            file = package and self.file(package)
            if not package or not file or file.name != "__init__.py":
                break
            found = self.declares(package, attribute)
            package = f"{package}.{attribute}" if f"{package}.{attribute}" in found else None
        return found

    def declares(self, source: str, name: str) -> set[str]:
        """The module that declares a name, which a package may re-export; empty for other projects."""
        file = self.file(source)
        if file is None:
            return set()
        whole = {source} if source in REGISTRIES else set()
        if file.name == "__init__.py" and name != "*":
            # A name may be the name of a subpackage too: `rf.fit` is the function.
            further = self.handed_on(source).get(name)
            if further is not None and further != (source, name):
                return whole | self.declares(*further)
        inner = f"{source}.{name}"
        return whole | {inner if self.file(inner) else source}

    def handed_on(self, package: str) -> dict[str, tuple[str, str]]:
        """Names that a package re-exports -> their module and name there, from its `.pyi` if it has one."""
        if package not in self._handed_on:
            file = self.file(package)
            assert file is not None, package
            listed = file.with_suffix(".pyi")
            file = listed if listed.is_file() else file
            self._handed_on[package] = {
                alias.asname or alias.name: (_absolute(node, package, file), alias.name)
                for node in ast.parse(self.text(file)).body
                if isinstance(node, ast.ImportFrom)
                for alias in node.names
            }
        return self._handed_on[package]


def _shows(name: str) -> bool:
    """Whether a module only writes, shows or rejects input, so that it changes no number."""
    parts = name.split(".")
    inside = parts[0] == "rotflex_jax" and len(parts) > 1
    drawn = parts[-1].split("_")[-1] in DRAWN
    return drawn or (inside and parts[1] in SHOWN) or (not inside and _is_table(parts[-1]))


def _is_table(name: str) -> bool:
    """Whether a module of the benchmarks is a table, by the last part of its name."""
    return name.split("_")[-1] == TABLE


def _absolute(node: ast.ImportFrom, name: str, file: Path) -> str:
    """Full name of the module that is imported from."""
    if not node.level:
        return str(node.module)
    parts = name.split(".")
    parts = parts[: len(parts) - node.level + (file.stem == "__init__")]
    return ".".join([*parts, *([node.module] if node.module else [])])


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a tree, imports before the rest, without code for type checkers alone."""
    inner = list[ast.AST]()
    waiting = [node]
    while waiting:
        here = waiting.pop()
        if isinstance(here, ast.If) and "TYPE_CHECKING" in ast.unparse(here.test):
            waiting += here.orelse
            continue
        inner.append(here)
        waiting += ast.iter_child_nodes(here)
    return iter(sorted(inner, key=lambda n: not isinstance(n, ast.Import | ast.ImportFrom)))


@functools.cache
def sources(*scripts: str) -> dict[str, str]:
    """Present digests, by path, of the files on which the results of benchmark scripts depend."""
    imports = Imports()
    return {path: digest for script in scripts for path, digest in imports.sources(script).items()}


# -- entry of a run -----------------------------------------------------------------------------------------


def git(*command: str) -> str:
    """Output of a git command in the folder of the project; empty without git."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *command], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip()


def provenance() -> dict[str, Any]:
    """Date, commit, digests of the code, versions and machine of a run."""
    code, arena = hashlib.sha256(), hashlib.sha256()
    for file in sorted((ROOT / "rotflex_jax").rglob("*.py")):
        code.update(file.read_bytes())
    simulator = ROOT / "rotflex_jax" / "arena" / "simulator"
    for file in sorted([*(HERE / "arena").glob("*.py"), *simulator.glob("*.py")]):
        arena.update(file.read_bytes())
    commit = git("rev-parse", "--short", "HEAD")
    # Results are written while a benchmark runs, and they are not code.
    changes = git("status", "--porcelain", "--", ".", ":!benchmarks/results", ":!docs/figures")
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit,
        "changed": not commit or bool(git("status", "--porcelain", "--", "rotflex_jax")),
        "clean": bool(commit) and not changes,
        "code": code.hexdigest()[:12],
        "arena": arena.hexdigest()[:12],
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": {n: importlib.metadata.version(n) for n in ("jax", "numpy", "scipy")},
    }


KEYS = ("runs", "sources", "parts")
"""Keys of a file of results that are not results."""


def begin(
    results: dict[str, Any],
    script: str,
    arguments: Any = (),
    *,
    scripts: Sequence[str] = (),
    files: Iterable[str] = (),
) -> dict[str, Any]:
    """Adds a run to a file of results, with the digests of the files on which the run depends.

    Args:
        results: content of the file, changed in place.
        script: `__file__` of the benchmark.
        arguments: arguments with which it was started.
        scripts: further modules that it runs but does not import.
        files: further files on which it depends, by path from the folder of the project.

    Returns:
        The entry without its `sources`; rows of results keep its `code`.
    """
    measured = dict(sources(Path(script).stem, *scripts))
    measured |= {path: meaning((ROOT / path).read_text(encoding="utf-8")) for path in files}
    name = hashlib.sha256(json.dumps(sorted(measured.items())).encode()).hexdigest()[:12]
    made = provenance() | {"arguments": without_place(arguments)}
    run = made | {"sources": name}
    # A run from a clean tree replaces runs from changed trees with the same code and sources, since changes
    # elsewhere do not affect the numbers.
    same = lambda old: (old.get("code"), old.get("sources")) == (run["code"], run["sources"])  # noqa: E731
    before = [
        old
        for old in results.get("runs", [])
        if of_changed_tree(run) or not (of_changed_tree(old) and same(old))
    ]
    results["runs"] = [*before, run]
    results.setdefault("sources", {})[name] = measured
    used = {run.get("sources") for run in results["runs"]}
    results["sources"] = {key: value for key, value in results["sources"].items() if key in used}
    return made


def without_place(arguments: Any) -> Any:
    """Arguments without `--out` and the file that it names, which does not affect the results."""
    if not isinstance(arguments, list) or "--out" not in arguments:
        return arguments
    k = arguments.index("--out")
    return arguments[:k] + arguments[k + 2 :]


def part(results: dict[str, Any], name: str) -> None:
    """Records that a part of a file is from the run that was started last."""
    results.setdefault("parts", {})[name] = results["runs"][-1]["code"]


# -- state of a file of results -----------------------------------------------------------------------------


class Standing(NamedTuple):
    """Whether results are from the present code; if not, the runs that made them and the changed files."""

    present: bool
    of: tuple[str, ...]
    changed: tuple[str, ...]


def runs_that_count(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs that made results still in a file; for rows whose run is missing, an entry without a commit."""
    runs = list(results.get("runs") or ([results] if "commit" in results else []))
    rest = {key: value for key, value in results.items() if key not in (*KEYS, "code")}
    codes = set(results.get("parts", {}).values()) | set(_codes(rest))
    if not codes:
        return runs
    lost = codes - {run.get("code") for run in runs}
    return [run for run in runs if run.get("code") in codes] + [{"code": code} for code in sorted(lost)]


def _codes(found: Any) -> Iterator[str]:
    """Digests of the code with which rows were measured."""
    if isinstance(found, dict):
        if isinstance(found.get("code"), str):
            yield found["code"]
        found = list(found.values())
    if isinstance(found, list):
        for inner in found:
            if isinstance(inner, dict | list):
                yield from _codes(inner)


def of_changed_tree(run: dict[str, Any]) -> bool:
    """Whether the results may be from code that was not committed, or this was not recorded."""
    return not run.get("commit") or run.get("clean", not run.get("changed", True)) is not True


def standing(results: dict[str, Any], root: Path = ROOT) -> Standing:
    """Whether the source files of results, under a folder, are unchanged in meaning."""
    told, changed = list[str](), set[str]()
    present = True
    runs = runs_that_count(results)
    for run in runs:
        measured = results.get("sources", {}).get(run.get("sources"))
        other = {path for path, digest in (measured or {}).items() if _now(root / path) != digest}
        # Older runs also recorded tables, which no longer count.
        other -= {path for path in other if path.startswith("benchmarks/") and _is_table(Path(path).stem)}
        if measured and not other and not of_changed_tree(run):
            continue
        present = False
        changed |= other
        told.append(_words(run))
    return Standing(present and bool(runs), tuple(dict.fromkeys(told)), tuple(sorted(changed)))


@functools.cache
def _now(file: Path) -> str:
    """Digest of a file; empty if the file does not exist."""
    return meaning(file.read_text(encoding="utf-8")) if file.is_file() else ""


def _words(run: dict[str, Any]) -> str:
    """Text that names a run by its commit."""
    if run.get("stored"):  # results from before runs were recorded
        return f"stored with {run['stored']}"
    if not run.get("commit"):
        return "not told"
    return run["commit"] + (" with changes" if of_changed_tree(run) else "")


def remark(names: Sequence[str]) -> str:
    """Text that names results from an earlier version of the code; empty if all are from the present code.

    Args:
        names: files of results, or folders of them.
    """
    told = dict[str, list[str]]()
    for name in names:
        files = [RESULTS / name] if name.endswith(".json") else sorted((RESULTS / name).glob("*.json"))
        found = [standing(json.loads(file.read_text(encoding="utf-8"))) for file in files]
        of = list(
            dict.fromkeys(words for one in found if not one.present for words in one.of or ("not told",))
        )
        if of:
            words = ", ".join(of[:3]) + (" and others" if len(of) > 3 else "")
            told.setdefault(words, []).append(name.removesuffix(".json"))
    every = "; ".join(f"{', '.join(of)} ({words})" for words, of in told.items())
    return f"Measured with an earlier version of the code: {every}." if told else ""


def main() -> None:
    """Print for each file of results whether it is from the present code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "files", nargs="*", metavar="FILE", help="of benchmarks/results; all if none is named"
    )
    given = parser.parse_args()
    for file in given.files or sorted(p.relative_to(RESULTS).as_posix() for p in RESULTS.rglob("*.json")):
        found = standing(json.loads((RESULTS / file).read_text(encoding="utf-8")))
        said = "of the present code" if found.present else f"of {', '.join(found.of) or 'what is not told'}"
        changes = f"; {len(found.changed)} files have changed" if found.changed else ""
        print(f"{file}: {said}{changes}")
        if given.files:
            print("".join(f"    {path}\n" for path in found.changed), end="")


if __name__ == "__main__":
    main()
