"""The project as a whole: its documents, its layers, and the effects of importing it."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from importlib.resources import files
from pathlib import Path

import cloudpickle
import pytest

import rotflex_jax

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "rotflex_jax"
MODULES = sorted(PACKAGE.rglob("*.py"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def name_of(file: Path) -> str:
    """`mechanism/step.py` -> `mechanism.step`."""
    return ".".join(file.relative_to(PACKAGE).with_suffix("").parts)


def imports_of(file: Path) -> set[str]:
    """What a module imports of the package, by name inside it; imports in functions count too."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "rotflex_jax":
            names = (alias.name for alias in node.names)
            found |= {name for name in names if list(PACKAGE.glob(name + "*"))}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rotflex_jax."):
            found.add(str(node.module).partition(".")[2])
        elif isinstance(node, ast.Import):
            found |= {a.name.partition(".")[2] for a in node.names if a.name.startswith("rotflex_jax.")}
    return found


def project_files() -> list[Path]:
    """Text files of the project, without caches, environments and generated files."""
    found = []
    for folder, folders, names in os.walk(ROOT):
        keep = lambda name: (  # noqa: E731 - used once, on the next line
            name == ".ci" or not (name.startswith((".", "rotflex-")) or name == "__pycache__")
        )
        folders[:] = filter(keep, folders)
        found += [Path(folder, name) for name in names]
    # Files without a suffix are scripts and licences.
    texts = {".py", ".md", ".toml", ".cff", ".json", ".ipynb", ".html", ".yml", ".bib", ""}
    return [file for file in found if file.suffix in texts]


def readme_command(name: str) -> str:
    block = re.search(
        rf"<!-- command: {name} -->\n```bash\n(.*?)\n```", (ROOT / "README.md").read_text(), re.S
    )
    assert block is not None, f"README.md lacks the command {name!r}"
    return block[1]


@pytest.mark.parametrize(("name", "end"), [("demo", "rotflex demo"), ("test", "-m pytest")])
def test_readme_promises_one_line_that_ci_runs(name: str, end: str) -> None:
    command = readme_command(name)
    assert "\n" not in command
    assert command.endswith(end)
    ci = (ROOT / ".ci" / "run").read_text()
    assert f"readme_command {name})" in ci
    # Only the commands of the README install the package there.
    assert "pip install" not in ci


def test_readme_example_uses_only_public_names() -> None:
    text = (ROOT / "README.md").read_text()
    example = re.search(r"```python\n(.*?)```", text, re.S)
    assert example is not None
    used = re.findall(r"\brf((?:\.[a-zA-Z_]+)+)", example[1])
    assert len(used) >= 6
    for chain in used:
        found = rotflex_jax
        for part in chain.strip(".").split("."):
            found = getattr(found, part)
    assert len(text.splitlines()) < 150


def test_contributing_example_is_a_working_effect() -> None:
    block = re.search(
        r"<!-- example: effect -->\n```python\n(.*?)```",
        (ROOT / "CONTRIBUTING.md").read_text(),
        re.S,
    )
    assert block is not None
    assert len(block[1].splitlines()) < 40
    namespace: dict = {"__name__": "contributed"}
    try:
        exec(compile(block[1], "CONTRIBUTING.md", "exec"), namespace)
        effect = namespace["CubicDrag"](at="hub", coefficient=2e-4)
        assert rotflex_jax.effects.CATALOG["cubic_drag"] is namespace["CubicDrag"]
        assert effect.force(0.0, -2.0, 0.0) == pytest.approx(2e-4 * 8)
        model = rotflex_jax.joints.paper() + effect
        assert "hub.cubic_drag.coefficient" in model.parameter_names
    finally:
        rotflex_jax.effects.CATALOG.pop("cubic_drag", None)


def test_no_file_names_a_place_on_some_machine() -> None:
    # Because of the brackets the pattern does not match itself.
    pattern = re.compile(r"(?<![\w.])/(?:[r]oot|[h]ome|[U]sers|[o]pt|[w]ork)/\w")
    found = project_files()
    assert ROOT / "README.md" in found
    assert ROOT / ".ci" / "run" in found
    named = [str(file.relative_to(ROOT)) for file in found if pattern.search(file.read_text())]
    assert named == []


@pytest.mark.parametrize("name", ["utils", "core", "common", "misc", "helpers"])
def test_no_module_has_a_name_that_says_nothing(name: str) -> None:
    assert not list(PACKAGE.rglob(f"{name}.py")) + list(PACKAGE.rglob(name))


def test_imports_point_down() -> None:
    contract = PYPROJECT["tool"]["importlinter"]["contracts"][0]
    layers, excuses = contract["layers"], contract["ignore_imports"]
    parts = [[part.strip(" ()") for part in layer.split("|")] for layer in layers]
    height = {part: -number for number, layer in enumerate(parts) for part in layer}
    wrong = []
    for file in MODULES:
        own = name_of(file).partition(".")[0]
        if own == "__init__":
            continue  # the `__init__` of the package imports from all layers
        assert own in height, f"{own} has no layer in pyproject.toml"
        for target in imports_of(file):
            part = target.partition(".")[0]
            excused = f"rotflex_jax.{name_of(file)} -> rotflex_jax.{target}" in excuses
            if part != own and height.get(part, 1) >= height[own] and not excused:
                wrong.append(f"{name_of(file)} imports {target}")
    assert wrong == []


def test_effects_do_not_import_each_other() -> None:
    bases = {"effects", "effects.base"}
    wrong = [
        f"{file.stem} imports {target}"
        for file in (PACKAGE / "effects").glob("*.py")
        if file.stem != "__init__"
        for target in imports_of(file)
        if target.startswith("effects") and target not in bases
    ]
    assert wrong == []


def test_importing_is_light_and_changes_nothing() -> None:
    program = """
import json, os, sys
import rotflex_jax as rf
nothing = "jax" not in sys.modules
import jax
before = dict(jax.config.values), dict(os.environ)
rf.fit, rf.joints.paper, rf.effects, rf.Recording, rf.load
changed = before != (dict(jax.config.values), dict(os.environ))
late = {"equinox", "optimistix", "scipy.linalg", "scipy.signal", "rotflex_jax.discover", "rotflex_jax.basis"}
late |= {"matplotlib", "pandas", "pysindy", "h5py", "numba", "pyarrow", "typer", "mujoco", "fmpy"}
loaded = sorted(late & set(sys.modules))
print(json.dumps({"nothing": nothing, "loaded": loaded, "changed": changed}))
"""
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == {"nothing": True, "loaded": [], "changed": False}


def test_a_name_that_is_also_a_folder_stays_the_function() -> None:
    program = """
import rotflex_jax.fit.greybox, rotflex_jax.discover.search, rotflex_jax.compare.method
import rotflex_jax.batch.task
import rotflex_jax as rf
print(rf.compare.__name__, rf.discover.__name__, rf.fleet.__name__, rf.fit.__name__)
print(*(name for name in rf.__all__ if getattr(rf, name) is None))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["compare", "discover", "fleet", "fit"]


def test_the_package_goes_to_other_processes_by_its_name() -> None:
    assert cloudpickle.loads(cloudpickle.dumps(rotflex_jax)) is rotflex_jax
    assert cloudpickle.loads(cloudpickle.dumps(rotflex_jax.fit)) is rotflex_jax.fit


def test_parts_that_no_list_names_are_found_too() -> None:
    program = "import rotflex_jax as rf; print(rf.runtime.__name__, hasattr(rf, 'no_such_part'))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.stdout.split() == ["rotflex_jax.runtime", "False"], run.stderr


def test_version_is_the_same_everywhere() -> None:
    version = PYPROJECT["project"]["version"]
    assert rotflex_jax.__version__ == version
    assert f"version: {version}" in (ROOT / "CITATION.cff").read_text()
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()


def test_the_demo_recording_is_part_of_the_package() -> None:
    header = files("rotflex_jax.data").joinpath("demo.csv").read_text().partition("\n")[0]
    assert header == "t,voltage,theta,alpha"
