"""Test of the installed package outside the source tree, in an environment with only its dependencies.

`cd somewhere/else && python -I installed.py` needs no test library, and ends with an AssertionError if
something is missing.
"""

import subprocess
import sys
from importlib.resources import files
from pathlib import Path

DATA = (
    "py.typed",
    "__init__.pyi",
    "fit/__init__.pyi",
    "data/demo.csv",
    "data/demo_truth.json",
    "text/templates/page.html.j2",
    "text/templates/style.css",
    "text/templates/zoom.js",
    "text/templates/uplot/uPlot.iife.min.js",
    "report/templates/report.html.j2",
    "report/templates/simulation.html.j2",
    "compare/templates/comparison.html.j2",
    "batch/templates/summary.html.j2",
    "arena/templates/arena.html.j2",
    "reproduce/templates/reproduce.html.j2",
    "export/templates/fmi3.c",
)


def said(*command: str) -> str:
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


def main() -> None:
    import numpy as np

    import rotflex_jax as rf

    place = Path(str(rf.__file__)).parent
    assert not (place.parent / "pyproject.toml").exists(), f"{place} is the tree, not an installed package"
    missing = [name for name in DATA if not files("rotflex_jax").joinpath(name).is_file()]
    assert not missing, missing

    # The command line, by `python -m` and, where it is installed, by its command.
    module = [sys.executable, "-I", "-m", "rotflex_jax"]
    assert said(*module, "--version") == rf.__version__
    program = Path(sys.executable).with_name("rotflex")
    if program.exists():
        assert said(str(program), "--version") == rf.__version__
        assert "discover" in said(str(program), "--help")
        manual = Path(sys.prefix, "share", "man", "man1", "rotflex.1")
        assert "discover" in manual.read_text(encoding="utf-8")

    # A fit must recover the stiffness from a simulated recording of a joint with another spring.
    joint = rf.joints.paper()
    spring = "joint.spring.stiffness"
    at = joint.parameter_names.index(spring)
    stiffness = 1.3 * joint.values[at]
    voltage = rf.data.demo_recording().u[:400]
    angles = rf.simulate(joint.with_values({spring: stiffness}), voltage, 0.002)
    angles = angles + 1e-6 * np.random.default_rng(1).standard_normal(angles.shape)
    fit = rf.fit(joint, rf.Recording(voltage, angles, 0.002))
    found = fit.model.mechanism.values[at]
    assert abs(found / stiffness - 1.0) < 1e-3, (found, stiffness)
    print(f"rotflex_jax {rf.__version__} in {place}: complete, and it identifies")


if __name__ == "__main__":
    main()
