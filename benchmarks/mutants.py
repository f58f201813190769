"""Change one constant or operator of a module at a time and run its tests: which changes does no test notice?

    python benchmarks/mutants.py [--number 48] [--seed 0] [--only selection]

The sample is fixed by its seed. The working tree is copied, each mutant gets a process of its own, and the
tests stop at the first failure. A mutant that survives is printed with its line, to be read: it is a missing
test, or it changes nothing that counts.
"""

import argparse
import ast
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = {
    "discover/selection.py": ("test_discover_selection.py",),
    "discover/probabilities.py": ("test_discover_probabilities.py",),
    "discover/localise.py": ("test_discover_localise.py",),
    "discover/conclusion.py": (
        "test_discover_conclusion.py",
        "test_discover_verdict.py",
    ),
    "mechanism/friction.py": ("test_mechanism.py", "test_mechanism_load_friction.py"),
}
LONGEST = 600.0
"""A mutant whose tests take longer hangs, and counts as noticed [s]."""
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


def places(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that can be changed; not texts, and not what annotations say."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            skipped |= {id(inner) for inner in ast.walk(part)} if part is not None else set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float, bool)
        compared = isinstance(node, ast.Compare) and type(node.ops[0]) in _SWAPPED
        if number or compared or (isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in _SWAPPED):
            yield node


def mutant(text: str, number: int) -> tuple[str, int, str]:
    """The text with one place changed, the line of it, and what was changed."""
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
    return ast.unparse(tree), getattr(node, "lineno", 0), f"{before} -> {ast.unparse(node)}"


def noticed(folder: Path, tests: tuple[str, ...]) -> bool:
    """Whether the tests of a copy fail, in a process of its own that has only the libraries in common."""
    child = os.fork()
    if not child:
        import pytest

        os.chdir(folder)
        sys.path[:0] = [str(folder)]
        with open(folder / "said.log", "w") as said:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
        status = pytest.main(["-x", "-q", "-p", "no:warnings", *(f"tests/{name}" for name in tests)])
        os._exit(int(status))
    begun = time.monotonic()
    while time.monotonic() - begun < LONGEST:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status != 0
        time.sleep(0.1)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--number", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    draw = random.Random(asked.seed)
    each = -(-asked.number // len(TESTS))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "tree"
        ignored = shutil.ignore_patterns(".git", "__pycache__", "_build", ".venv")
        shutil.copytree(ROOT, folder, symlinks=True, ignore=ignored)
        import jax  # noqa: F401 - loaded once for all, and not started
        import pytest  # noqa: F401

        for name, tests in TESTS.items():
            text = (ROOT / "rotflex_jax" / name).read_text()
            count = sum(1 for _ in places(ast.parse(text)))
            chosen = sorted(draw.sample(range(count), min(each, count)))
            if asked.only not in name:
                continue
            begun = time.perf_counter()
            if noticed(folder, tests):
                sys.exit(f"{name}: its tests fail as it is\n" + (folder / "said.log").read_text()[-2000:])
            print(f"{name}: {count} places, tests take {time.perf_counter() - begun:.0f} s", flush=True)
            for number in chosen:
                changed, line, what = mutant(text, number)
                (folder / "rotflex_jax" / name).write_text(changed)
                word = "noticed " if noticed(folder, tests) else "SURVIVED"
                print(f"  {word} line {line}: {what[:90]}", flush=True)
            (folder / "rotflex_jax" / name).write_text(text)


if __name__ == "__main__":
    main()
