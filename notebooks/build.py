"""Make the notebooks from their scripts, or check that the two agree.

The scripts (`NN_name.py`, jupytext percent format) are what people edit and review; the notebooks
carry the outputs, so that figures show where the project is read on the web.

    python notebooks/build.py                 # run every script, write its notebook
    python notebooks/build.py 00_first_look   # only this one
    python notebooks/build.py --text          # take over text that changed, where no code did
    python notebooks/build.py --check         # exit status 1 where a notebook is missing or stale
    python notebooks/build.py --run           # run, two at a time, and write nothing; 1 where one fails
"""

import argparse
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

FOLDER = Path(__file__).resolve().parent
LOGGED = re.compile(r"[EWI]\d{4} [\d:.]+ +\d+ \w+\.cc:")


def scripts(names: list[str]) -> list[Path]:
    """The scripts to work on, all of them unless some are named."""
    found = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
    known = {script.stem: script for script in found}
    for name in names:
        if name not in known:
            sys.exit(f"There is no notebook {name!r}; choose from {', '.join(known)}.")
    return [known[name] for name in names] or found


def cells(notebook: nbformat.NotebookNode) -> list[tuple[str, str]]:
    """Kind and text of every cell that is not empty."""
    return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells if cell.source.strip()]


def executed(script: Path, timeout: float) -> nbformat.NotebookNode:
    """One script as a notebook, run from its first cell to its last in a process of its own."""
    notebook = jupytext.read(script)
    notebook.metadata["kernelspec"] = {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    }
    NotebookClient(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        coalesce_streams=True,
        resources={"metadata": {"path": str(FOLDER)}},
    ).execute()
    return notebook


def trial(script: Path, timeout: float) -> str:
    """Run one script and write nothing; says what went wrong, if anything did."""
    began = time.perf_counter()
    try:
        executed(script, timeout)
    except (CellExecutionError, TimeoutError) as error:
        return f"{script.stem}: {error}"
    print(f"{script.stem}: ok ({time.perf_counter() - began:.0f} s)", flush=True)
    return ""


def build(script: Path, timeout: float) -> None:
    """Run one script as a notebook and write it with its outputs."""
    notebook = executed(script, timeout)
    for number, cell in enumerate(notebook.cells):
        # Fixed names and no times: a rebuilt notebook differs only where its content does.
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":  # what the compiler logs is not said by the notebook
            cell.outputs = [o for o in cell.outputs if not LOGGED.match(o.get("text", ""))]
    notebook.metadata.pop("jupytext", None)
    nbformat.write(notebook, script.with_suffix(".ipynb"))


def retext(script: Path) -> str:
    """Take over text cells without running anything; says why, where that is not possible."""
    target = script.with_suffix(".ipynb")
    if not target.exists():
        return "is missing"
    kept, new = nbformat.read(target, as_version=4), jupytext.read(script)
    codes = [[c.source.strip() for c in n.cells if c.cell_type == "code"] for n in (kept, new)]
    if codes[0] != codes[1]:
        return "has other code"
    ran = iter([c for c in kept.cells if c.cell_type == "code"])
    kept.cells = [next(ran) if c.cell_type == "code" else c for c in new.cells]
    for number, cell in enumerate(kept.cells):
        cell["id"] = f"cell-{number}"
    nbformat.write(kept, target)
    return ""


def faults(script: Path) -> list[str]:
    """What is wrong with the notebook of a script."""
    target = script.with_suffix(".ipynb")
    if not target.exists():
        return ["is missing"]
    notebook = nbformat.read(target, as_version=4)
    found = []
    if cells(notebook) != cells(jupytext.read(script)):
        found.append("differs from its script")
    code = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    if any(cell.execution_count is None for cell in code):
        found.append("has cells that were not run")
    if not any(cell.outputs for cell in code):
        found.append("has no outputs")
    if any(output.output_type == "error" for cell in code for output in cell.outputs):
        found.append("shows an error")
    return found


def main() -> None:
    """Build, or check with --check."""
    parser = argparse.ArgumentParser(description="Build or check the notebooks.")
    parser.add_argument("names", nargs="*", help="scripts without .py; all unless given")
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    parser.add_argument("--text", action="store_true", help="run nothing, take over text")
    parser.add_argument("--run", action="store_true", help="run, write nothing")
    parser.add_argument("--timeout", type=float, default=600.0, help="limit per cell [s]")
    arguments = parser.parse_args()
    chosen = scripts(arguments.names)
    if arguments.run:
        with ThreadPoolExecutor(2) as pool:  # each thread waits for a process
            told = list(pool.map(lambda script: trial(script, arguments.timeout), chosen))
        sys.exit("\n\n".join(filter(None, told)) or 0)
    stale = False
    for script in chosen:
        if arguments.text:
            print(f"{script.stem}: {retext(script) or 'ok'}")
            continue
        if not arguments.check:
            print(f"{script.name} ...", flush=True)
            build(script, arguments.timeout)
            continue
        wrong = faults(script)
        stale = stale or bool(wrong)
        print(f"{script.stem}: {'; '.join(wrong) or 'ok'}")
    if stale:
        sys.exit("Run python notebooks/build.py and commit the notebooks.")


if __name__ == "__main__":
    main()
