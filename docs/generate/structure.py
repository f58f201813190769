"""Measures how the package is built: `python docs/generate/structure.py [CHECKOUT] [--json FILE]`.

Everything but the search is read from the source, by rules that hold for any state of the package:

- Files: every `*.py` of the package. A line is code if it has more than comment or docstring.
- Imports: all, also those inside functions and for type checking. The package's own `__init__` counts as no
  importer, for it loads names when they are asked for. By statement, `from package import name` leads to the
  submodule of that name, else to the `__init__` of the package. By origin, a name that an `__init__` (or the
  stub beside it) takes from elsewhere leads to the module that defines it, so an `__init__` that only passes
  names on joins nothing. That the `__init__` of a package runs before its submodules does not count.
- Circle: files each of which reaches each other one along imports. Importers of a module: by statement.
- Search: a call of `discover` on the first seconds of the recording that comes with the package, with no
  compiled programs of earlier runs, for what is not traced again is not seen. All modules are imported
  before, so only the search counts. A call through another library is one of the nearest function of the
  package below it on the stack; what a new thread calls first has no caller.
- Shapes: public functions and methods with arrays among parameters or results; all are stated if every array
  in the annotations is a jaxtyping one. An alias counts as what it stands for.
- Damped least squares: functions that multiply or divide something named damping by a number or its power,
  in a module that solves a linear system. These are candidates to look at, not a count.
"""

import argparse
import ast
import contextlib
import functools
import importlib
import inspect
import io
import json
import os
import pkgutil
import re
import subprocess
import sys
import tempfile
import textwrap
import threading
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

PACKAGE = "rotflex_jax"
SHORT, LONG = 60, 500  # lines of a module
SECONDS = 6.0  # of the recording that is searched
NO_CODE = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER"}
ARRAYS = {"ndarray", "Array", "ArrayLike", "NDArray"}
SHAPED = {"Float", "Int", "Bool", "Complex", "Shaped", "Num", "Inexact", "Integer", "UInt", "Real"}
SOLVERS = {"solve", "lstsq", "cho_solve", "solve_triangular"}


class Module:
    """A file of the package, parsed."""

    def __init__(self, root: Path, path: Path) -> None:
        self.path = path
        self.is_package = path.name == "__init__.py"
        parts = path.relative_to(root).with_suffix("").parts
        self.name = ".".join(parts[:-1] if self.is_package else parts)
        self.part = parts[1] if len(parts) > 2 else "(top)"
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text)

    def imports(self, tree: ast.Module | None = None) -> Iterator[tuple[str, str | None, str]]:
        """(module, name or None for the module itself, name here) of each import from the package."""
        home = self.name.split(".") if self.is_package else self.name.split(".")[:-1]
        for node in ast.walk(tree or self.tree):
            if isinstance(node, ast.Import):
                found = [(a.name, None, a.asname or a.name) for a in node.names]
            elif isinstance(node, ast.ImportFrom):
                above = home[: len(home) - node.level + 1] if node.level else []
                source = ".".join([*above, *([node.module] if node.module else [])])
                found = [(source, a.name, a.asname or a.name) for a in node.names]
            else:
                continue
            yield from (i for i in found if i[0].split(".")[0] == PACKAGE)

    @functools.cached_property
    def imported(self) -> dict[str, tuple[str, str]]:
        """Name here -> (module, name there), with those of the stub beside the file."""
        stub = self.path.with_suffix(".pyi")
        trees = [self.tree, *([ast.parse(stub.read_text(encoding="utf-8"))] if stub.exists() else [])]
        return {here: (source, name) for t in trees for source, name, here in self.imports(t) if name}

    @functools.cached_property
    def assigned(self) -> dict[str, ast.expr]:
        """Name -> value, at the level of the module."""
        out: dict[str, ast.expr] = {}
        for node in self.tree.body:
            if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [n for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
                out |= {n.id: node.value for n in names if isinstance(n.ctx, ast.Store)}
        return out

    def counts(self) -> tuple[int, int, int]:
        """Lines in total, of code, and of docstrings."""
        code: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if tokenize.tok_name[token.type] not in NO_CODE:
                code.update(range(token.start[0], token.end[0] + 1))
        told: set[int] = set()
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
                told.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
        return len(self.text.splitlines()), len(code - told), len(told)


class Package:
    """All modules of a checkout by name."""

    def __init__(self, root: Path) -> None:
        files = sorted((root / PACKAGE).rglob("*.py"))
        self.modules = {m.name: m for m in (Module(root, file) for file in files)}

    def resolve(self, source: str, name: str, origin: bool) -> str:
        """The module to which `from source import name` leads, by one of the two conventions."""
        if f"{source}.{name}" in self.modules:
            return f"{source}.{name}"
        module = self.modules.get(source)
        further = module.imported.get(name) if origin and module and module.is_package else None
        return self.resolve(*further, origin) if further and further != (source, name) else source

    def graph(self, origin: bool) -> dict[str, set[str]]:
        """Module -> modules that it imports."""
        out: dict[str, set[str]] = {}
        for m in self.modules.values():
            led = {s if n is None else self.resolve(s, n, origin) for s, n, _ in m.imports()}
            out[m.name] = (led & set(self.modules)) - {m.name} if m.name != PACKAGE else set()
        return out

    def arrays(self, node: ast.AST, module: Module) -> list[bool]:
        """For each array in an annotation, whether it states its shape."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return self.arrays(ast.parse(node.value.strip(), mode="eval").body, module)
        if isinstance(node, ast.Subscript) and last(node.value).rstrip("0123456789") in SHAPED:
            return [True]
        if isinstance(node, ast.Subscript) and last(node.value) in {"Annotated", "Literal"}:
            first = node.slice.elts[0] if isinstance(node.slice, ast.Tuple) else node.slice
            return self.arrays(first, module) if last(node.value) == "Annotated" else []
        if last(node) in ARRAYS:
            return [False]
        if isinstance(node, ast.Name):
            source, name = module.imported.get(node.id, (module.name, node.id))
            home = self.modules.get(self.resolve(source, name, True), module)
            value = home.assigned.get(name)
            return self.arrays(value, home) if isinstance(value, (ast.Subscript, ast.BinOp)) else []
        return [stated for child in ast.iter_child_nodes(node) for stated in self.arrays(child, module)]


def last(node: ast.AST) -> str:
    """The last part of a dotted name; empty for anything else."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def largest_circle(graph: dict[str, set[str]]) -> list[str]:
    """The largest set of modules each of which reaches each other one."""
    reached = {}
    for start in graph:
        seen, left = set(), [start]
        while left:
            new = graph[left.pop()] - seen
            seen |= new
            left += new
        reached[start] = seen
    return max((sorted(n for n in r if m in reached[n]) for m, r in reached.items()), key=len, default=[])


def sizes(package: Package) -> dict[str, Any]:
    """Files, lines, and modules that one other module imports."""
    lines = {m.name: m.counts() for m in package.modules.values()}
    importers = Counter(to for led in package.graph(origin=False).values() for to in led)
    kinds = ("lines", "lines of code", "lines of docstrings")
    return {
        "modules beside __init__": sum(not m.is_package for m in package.modules.values()),
        "modules in total": len(lines),
        **{kind: sum(c[k] for c in lines.values()) for k, kind in enumerate(kinds)},
        "modules with one importer": sorted(n for n in lines if importers[n] == 1),
        f"modules under {SHORT} lines": sorted(n for n, c in lines.items() if c[0] < SHORT),
        f"modules over {LONG} lines": sorted(f"{n} {c[0]}" for n, c in lines.items() if c[0] > LONG),
    }


def public_functions(owner: ast.AST, name: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """(dotted name, definition) of public functions of a module, and public methods of public classes."""
    for node in ast.iter_child_nodes(owner):
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield f"{name}.{node.name}", node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node, f"{name}.{node.name}")


def shapes(package: Package) -> dict[str, Any]:
    """Which public functions with arrays state the shapes of all."""
    stated, missing, parts = 0, [], defaultdict(lambda: [0, 0])
    for module in (m for m in package.modules.values() if "._" not in m.name):
        for name, node in public_functions(module.tree, module.name):
            a = node.args
            given = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            hints = [h for h in (*(g.annotation for g in given), node.returns) if h is not None]
            found = [s for hint in hints for s in package.arrays(hint, module)]
            if found:
                stated += all(found)
                parts[module.part][0] += all(found)
                parts[module.part][1] += 1
                missing += [name] * (not all(found))
    count = stated + len(missing)
    share = {p: f"{s}/{n}" for p, (s, n) in sorted(parts.items())}
    figures = {"stated": stated, "of": count, "percent": round(100 * stated / max(count, 1), 1)}
    return figures | {"by part": share, "missing": sorted(missing)}


def damped(package: Package) -> list[str]:
    """Functions that may hold a damped least-squares loop, as `module.function`."""

    def by_number(node: ast.AST) -> bool:
        if not isinstance(node, (ast.AugAssign, ast.BinOp)) or not isinstance(node.op, (ast.Mult, ast.Div)):
            return False
        one, other = (node.target, node.value) if isinstance(node, ast.AugAssign) else (node.left, node.right)
        one = one.value if isinstance(one, ast.Subscript) else one
        other = other.left if isinstance(other, ast.BinOp) and isinstance(other.op, ast.Pow) else other
        return "damping" in last(one) and isinstance(other, ast.Constant)

    out = []
    for module in package.modules.values():
        if any(isinstance(n, ast.Call) and last(n.func) in SOLVERS for n in ast.walk(module.tree)):
            owners = [n for n in ast.walk(module.tree) if isinstance(n, ast.FunctionDef)]
            hits = [f for f in owners if any(map(by_number, ast.walk(f)))]
            inner = {id(n) for f in hits for n in ast.walk(f) if n is not f}
            out += [f"{module.name}.{f.name}" for f in hits if id(f) not in inner]
    return sorted(out)


def repeated(package: Package) -> dict[str, dict[str, list[str]]]:
    """Names of classes and of constants that several modules define."""
    found: dict[str, dict[str, list[str]]] = {"classes": defaultdict(list), "constants": defaultdict(list)}
    for m in package.modules.values():
        for name in sorted({n.name for n in m.tree.body if isinstance(n, ast.ClassDef)}):
            found["classes"][name].append(m.name)
        for name in filter(re.compile(r"_?[A-Z][A-Z0-9_]+$").match, m.assigned):
            found["constants"][name].append(m.name)
    order = {k: sorted(v.items(), key=lambda i: (-len(i[1]), i[0])) for k, v in found.items()}
    return {k: {name: where for name, where in v if len(where) > 1} for k, v in order.items()}


def search_here(root: Path) -> dict[str, Any]:
    """In this process: files, functions and pairs of files that a search enters."""
    import rotflex_jax as rf

    home = root / PACKAGE
    assert Path(rf.__file__).is_relative_to(home), "another copy of the package was imported"
    for info in pkgutil.walk_packages([str(home)], f"{PACKAGE}."):
        if not info.name.endswith("__main__"):
            with contextlib.suppress(ImportError):  # a part that needs a library that is missing
                importlib.import_module(info.name)
    recording = rf.load(next(home.rglob("demo.csv")))
    train, test = recording.split(SECONDS / recording.duration)[0].split(0.7)
    joint, discover = rf.joints.paper(), rf.discover
    functions: set[tuple[str, str]] = set()
    pairs: set[tuple[str, str]] = set()

    @functools.cache
    def file(code: CodeType) -> str | None:
        path = Path(code.co_filename)
        return path.relative_to(home).as_posix() if path.is_relative_to(home) else None

    def profile(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        # The body of a module or of a class is no function.
        if event != "call" or not (here := file(code)) or not code.co_flags & inspect.CO_OPTIMIZED:
            return
        functions.add((here, code.co_qualname))
        below = frame.f_back
        while below is not None and file(below.f_code) is None:
            below = below.f_back
        if below is not None and (caller := file(below.f_code)) and caller != here:
            pairs.add((caller, here))

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        found = discover(joint, train, test)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    by_name = {(where, name.rpartition(".")[2]) for where, name in functions}
    return {
        "verdict": found.verdict,
        "files": sorted({where for where, _ in functions}),
        "functions, each name once a file": len(by_name),
        "functions without lambdas and comprehensions": sum(name[-1] != ">" for _, name in functions),
        "pairs of files": sorted(f"{a} -> {b}" for a, b in pairs),
    }


def search(root: Path) -> dict[str, Any]:
    """In a process of its own that finds the package of the checkout and nothing compiled."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        surroundings = kept | {"PYTHONPATH": str(root), "XDG_CACHE_HOME": folder, "MPLBACKEND": "agg"}
        result = Path(folder) / "search.json"
        command = [sys.executable, str(Path(__file__).resolve()), str(root), "--search-here", str(result)]
        subprocess.run(command, env=surroundings, cwd=folder, check=True)
        return json.loads(result.read_text(encoding="utf-8"))


def table(figures: dict[str, Any]) -> str:
    """The figures as lines of text, lists by their length."""
    s = figures["shapes"]
    rows: dict[str, Any] = dict(figures["sizes"])
    rows |= {f"largest circle, {k}": v for k, v in figures["circles"].items()}
    rows |= {f"search: {k}": v for k, v in figures.get("search", {}).items()}
    rows["functions with all shapes stated"] = f"{s['stated']} of {s['of']}, {s['percent']} %"
    rows |= {f"    {part}": share for part, share in s["by part"].items()}
    rows["candidates for damped least squares"] = figures["damped"]
    rows |= {f"    {name}": "" for name in figures["damped"]}
    for kind, names in figures["repeated"].items():
        rows[f"{kind} defined in several modules"] = names
        listed = ", ".join(f"{name}:{len(where)}" for name, where in names.items())
        rows |= {f"    {line}": "" for line in textwrap.wrap(listed, 90)}
    shown = {k: len(v) if isinstance(v, (list, dict)) else v for k, v in rows.items()}
    return "\n".join(f"{k:<54}{v}".rstrip() for k, v in shown.items())


def main() -> None:
    """Measure a checkout and print the table."""
    parser = argparse.ArgumentParser(description="Measure the structure of the package.")
    parser.add_argument("checkout", nargs="?", type=Path, default=Path(__file__).resolve().parents[2])
    parser.add_argument("--json", type=Path, help="also write all figures, with the names behind them")
    parser.add_argument("--missing", action="store_true", help="list public functions without shapes")
    parser.add_argument("--no-search", action="store_true", help="only what is read from the source")
    parser.add_argument("--search-here", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    root = given.checkout.resolve()
    if given.search_here:
        given.search_here.write_text(json.dumps(search_here(root)), encoding="utf-8")
        return
    package = Package(root)
    circles = {f"by {n}": largest_circle(package.graph(n == "origin")) for n in ("statement", "origin")}
    figures: dict[str, Any] = {"sizes": sizes(package), "circles": circles}
    if not given.no_search:
        figures["search"] = search(root)
    figures |= {"shapes": shapes(package), "damped": damped(package), "repeated": repeated(package)}
    print(table(figures))
    if given.missing:
        print("\nwithout shapes:", *figures["shapes"]["missing"], sep="\n    ")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
