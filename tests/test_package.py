"""What is distributed: wheel, source distribution, recipe, container, citation, manual page, completion."""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import installed
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
sys.path.append(str(ROOT / "docs"))  # for `generate`

from generate import manual  # noqa: E402


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel, made from the unpacked source distribution, and the source distribution."""
    folder = tmp_path_factory.mktemp("built")
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    subprocess.run([*build, "-t", "sdist"], cwd=ROOT, check=True, capture_output=True)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    source = next((folder / "unpacked").iterdir())
    subprocess.run([*build, "-t", "wheel"], cwd=source, check=True, capture_output=True)
    return folder


def ours(folder: Path) -> set[str]:
    return {
        str(file.relative_to(folder))
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts and not file.name.startswith(".")
    }


def test_wheel_holds_the_package_its_data_and_the_manual_page(built: Path) -> None:
    wheel = zipfile.ZipFile(next(built.glob("*.whl")))
    names = set(wheel.namelist())
    package = {f"rotflex_jax/{name}" for name in ours(ROOT / "rotflex_jax")}
    assert {name for name in names if name.startswith("rotflex_jax/")} == package
    assert {f"rotflex_jax/{name}" for name in installed.DATA} <= names
    stem = f"rotflex_jax-{PROJECT['version']}"
    assert f"{stem}.data/data/share/man/man1/rotflex.1" in names
    uplot = "rotflex_jax/text/templates/uplot/LICENSE"  # in every report
    for licence in ("LICENSE", "NOTICE", uplot):
        assert wheel.read(f"{stem}.dist-info/licenses/{licence}") == (ROOT / licence).read_bytes()
    assert "rotflex = rotflex_jax.cli:main" in wheel.read(f"{stem}.dist-info/entry_points.txt").decode()


def test_source_distribution_holds_tests_documents_and_licence(built: Path) -> None:
    (source,) = (built / "unpacked").iterdir()
    assert ours(source / "tests") == ours(ROOT / "tests")
    for name in (
        "LICENSE",
        "NOTICE",
        "SECURITY.md",
        "CITATION.cff",
        "docs/design.md",
        ".ci/run",
        "Containerfile",
    ):
        assert (source / name).read_bytes() == (ROOT / name).read_bytes()


def test_unpacked_wheel_runs_outside_of_the_tree(built: Path, tmp_path: Path) -> None:
    """The dependencies are those of this environment; `.ci/package` tests the wheel in an empty one."""
    zipfile.ZipFile(next(built.glob("*.whl"))).extractall(tmp_path / "site")
    program = (
        "import pathlib, sys, rotflex_jax, rotflex_jax.cli as cli;"
        "assert pathlib.Path(rotflex_jax.__file__).is_relative_to(sys.argv.pop(1)); cli.main()"
    )
    around = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    arguments = [sys.executable, "-P", "-c", program, str(tmp_path / "site"), "--version"]
    run = subprocess.run(arguments, cwd=tmp_path, env=around, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, PROJECT["version"] + "\n", "")


def test_completion_is_installed_and_completes(tmp_path: Path) -> None:
    around = os.environ | {
        "HOME": str(tmp_path),
        "PYTHONPATH": str(ROOT),
        "COMP_WORDS": "rotflex dis",
        "COMP_CWORD": "1",
    }
    command = f'"{sys.executable}" -m rotflex_jax'
    # Completion is installed for the shell that runs the command.
    install = ["bash", "-c", f"{command} --install-completion; exit $?"]
    run = subprocess.run(install, env=around, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    (script,) = tmp_path.rglob("rotflex*")
    assert "_ROTFLEX_COMPLETE" in script.read_text()
    assert str(script) in (tmp_path / ".bashrc").read_text()
    complete = [sys.executable, "-m", "rotflex_jax"]
    around["_ROTFLEX_COMPLETE"] = "complete_bash"
    run = subprocess.run(complete, env=around, capture_output=True, text=True, check=False)
    assert run.stdout.split() == ["discover"], run.stderr


def test_manual_page_is_that_of_the_program() -> None:
    page = (ROOT / "docs/rotflex.1").read_text()
    assert page == manual.page(), "write it again: python docs/generate/manual.py"
    # The page contains no commands for the formatter other than those of man(7).
    commands = {line.split()[0] for line in page.splitlines() if line.startswith((".", "'"))}
    assert commands == {'.\\"', ".TH", ".SH", ".SS", ".P", ".TP"}
    for option in ("--held-out", "--continue", "--counts", "--install-completion"):
        assert option.replace("-", r"\-") in page


def requirements(lines: list[str]) -> dict[str, str]:
    found = (re.fullmatch(r"([\w.-]+) ?(>=.*)", line) for line in lines)
    return {match[1]: match[2] for match in found if match is not None}


def test_conda_recipe_says_what_the_project_says() -> None:
    recipe = yaml.safe_load((ROOT / "conda/recipe.yaml").read_text())
    assert recipe["package"]["name"] == PROJECT["name"]
    assert recipe["context"]["version"] == PROJECT["version"]
    wanted = requirements(PROJECT["dependencies"]) | {"python": PROJECT["requires-python"]}
    wanted["matplotlib-base"] = wanted.pop("matplotlib")  # the package of conda without a window toolkit
    needs = recipe["requirements"]
    assert requirements(needs["run"]) == wanted
    assert len(needs["run"]) == len(PROJECT["dependencies"]) + 1
    built_by = requirements(PYPROJECT["build-system"]["requires"]) | {"python": PROJECT["requires-python"]}
    assert requirements(needs["host"]) == built_by
    (entry,) = PROJECT["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [" = ".join(entry)]
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["summary"] == PROJECT["description"]


def test_citation_says_what_the_project_says() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["license"] == PROJECT["license"]
    assert citation["version"] == PROJECT["version"]
    names = [author["name"] for author in citation["authors"]]
    assert names == [author["name"] for author in PROJECT["authors"]]


PUBLISHED_SCHEMAS = {
    "CITATION.cff": "citation-file-format",
    ".github/workflows/release.yml": "github-workflows",
    ".github/workflows/versions.yml": "github-workflows",
}


def schema_errors(file: Path, schema: str) -> str:
    """Errors of a file by a published schema, of which `check_jsonschema` contains a copy; empty if none."""
    pytest.importorskip("check_jsonschema")
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}", str(file)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stderr
    return done.stdout if done.returncode else ""


@pytest.mark.parametrize("name", PUBLISHED_SCHEMAS)
def test_files_for_other_services_pass_their_published_schemas(name: str) -> None:
    assert schema_errors(ROOT / name, PUBLISHED_SCHEMAS[name]) == ""


@pytest.mark.parametrize(
    ("name", "right", "wrong"),
    [
        ("CITATION.cff", "license: MIT", "license: mine"),
        ("CITATION.cff", "message:", "note:"),
        (".github/workflows/release.yml", "runs-on: ubuntu-latest", "runs: ubuntu-latest"),
    ],
)
def test_a_mistake_in_such_a_file_is_found(tmp_path: Path, name: str, right: str, wrong: str) -> None:
    text = (ROOT / name).read_text()
    assert right in text
    broken = tmp_path / Path(name).name
    broken.write_text(text.replace(right, wrong))
    assert "Schema validation errors" in schema_errors(broken, PUBLISHED_SCHEMAS[name])


def test_container_takes_files_that_exist_and_a_python_that_is_allowed() -> None:
    lines = (ROOT / "Containerfile").read_text().splitlines()
    taken = [word for line in lines if re.match(r"COPY (?!--)", line) for word in line.split()[1:-1]]
    assert {"pyproject.toml", "README.md", "LICENSE", "rotflex_jax"} <= set(taken)
    assert set(PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["shared-data"]) <= set(taken)
    assert all((ROOT / name).exists() for name in taken)
    pythons = {line.split("python:")[1].split("-")[0] for line in lines if line.startswith("FROM")}
    assert len(pythons) == 1
    assert f"Programming Language :: Python :: {pythons.pop()}" in PROJECT["classifiers"]


@pytest.mark.parametrize("name", ["release", "versions"])
def test_workflows_keep_no_password_and_run_what_exists(name: str) -> None:
    text = (ROOT / ".github/workflows" / f"{name}.yml").read_text()
    jobs = yaml.safe_load(text)["jobs"]
    assert "secrets." not in text
    assert "password" not in re.sub(r"#.*", "", text)
    runs = " ".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
    scripts = re.findall(r"(?:bash|python) ([\w./]+)", runs)
    assert scripts
    assert all((ROOT / script).is_file() for script in scripts), scripts
    if name == "release":
        assert jobs["publish"]["permissions"] == {"id-token": "write"}
        assert set(jobs["publish"]["needs"]) == {"build", "checks"}
        assert "bash .ci/run" in [step.get("run") for step in jobs["checks"]["steps"]]
    else:
        chosen = jobs["slice"]["strategy"]["matrix"]["include"]
        assert {job["versions"] for job in chosen} == {"lowest", "newest"}
        assert {job["python"] for job in chosen} == {"3.11", "3.13"}
