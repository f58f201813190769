"""`rotflex discover --each`: accepted and refused arguments, error messages, and output."""

import functools
import importlib
import json
import shlex
from collections.abc import Callable
from pathlib import Path

import batch_search
import numpy as np
import pytest

from rotflex_jax.cli import app
from rotflex_jax.errors import InputError
from rotflex_jax.runtime import xla
from rotflex_jax.text.numbers import digits


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[str], tuple[int, str, str]]:
    """The command line in this process, with an instant replacement of the search."""
    fleet = importlib.import_module("rotflex_jax.batch")
    monkeypatch.setattr(fleet, "fleet", functools.partial(fleet.fleet, search=batch_search.quick))
    monkeypatch.setattr(xla, "enable_fast_start", lambda: None)  # global settings
    monkeypatch.chdir(tmp_path)
    for k, volts in enumerate((0.3, 3.0, 3.0)):
        u = volts * np.random.default_rng(k).normal(size=200 + k)
        columns = np.c_[0.002 * np.arange(len(u)), u, 0.1 * np.cumsum(u), 0.1 * u]
        np.savetxt(f"run_{k}.csv", columns, delimiter=",", header="t,voltage,theta,alpha", comments="")
    Path("torn.csv").write_text("t,voltage\n0,1\n")

    def run(line: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            app.main(shlex.split(line))
        assert isinstance(left.value.code, int)
        return left.value.code, *capsys.readouterr()

    return run


def test_every_file_is_searched_by_itself(run) -> None:
    status, out, err = run("discover run_0.csv run_1.csv torn.csv run_2.csv --each --workers 0 --degrees")
    assert status == 0
    lines = {line.split()[0]: line for line in out.splitlines() if line}
    assert "nothing missing" in lines["run_0"]
    assert "coulomb@hub" in lines["run_1"]
    # The message names options of the command line, not arguments of Python.
    assert lines["torn"].startswith("torn failed: ")
    assert "--output" in lines["torn"]
    table = np.loadtxt("run_1.csv", delimiter=",", skiprows=1)
    last = table[round(0.7 * len(table)) :, 2]
    assert digits(float(np.sqrt(np.mean(last**2)))) in lines["run_1"]
    assert "4 of 4: run_2: found coulomb@hub" in err
    assert Path("rotflex-each/summary.html").exists()
    assert "rotflex-each/summary.html" in out


def test_searches_by_themselves_have_the_options_of_a_search(run, monkeypatch) -> None:
    batch, given = importlib.import_module("rotflex_jax.batch"), []

    def fleet(*_, search, **options):
        given.append(search.keywords)
        raise InputError("Enough.")

    monkeypatch.setattr(batch, "fleet", fleet)
    run("discover run_0.csv run_1.csv --each --calibrate 0.5")
    assert given == [{"calibrate_seconds": 0.5}]


def test_json_on_stdout_stands_alone_and_the_folder_can_be_chosen(run) -> None:
    status, out, err = run("discover run_0.csv run_1.csv --each --workers 0 --degrees --report o --json -")
    assert status == 0
    found = json.loads(out)
    assert (found["schema"], found["total"]) == (1, 2)
    assert [r["verdict"] for r in found["recordings"]] == ["nothing_missing", "found"]
    assert "o/summary.html" in err
    run("discover run_0.csv run_1.csv --each --workers 0 --degrees --report o --json again.json")
    again = json.loads(Path("again.json").read_text())
    assert again["recordings"] == found["recordings"]


REFUSED = {
    "discover run_0.csv --scheduler tcp://127.0.0.1:1": "--each",
    "discover run_0.csv --workers 2": "--each",
    "discover run_0.csv --each --held-out run_1.csv": "--held-out",
    "discover run_0.csv --each --save-model m.json": "--save-model",
    "discover run_0.csv --each --workers -1": "whole number from 0",
    "discover run_0.csv --each --workers many": "--workers",
    "discover run_0.csv --each --workers 2 --scheduler tcp://127.0.0.1:1": "one of the two",
    "discover run_0.csv missing.csv --each": "missing.csv",
    "discover run_0.csv run_0.csv --each": "twice",
    "discover --each": "FILE",
    "discover torn.csv --each --workers 0": "No search of 1",
    "discover run_0.csv --each --workers 0 --signal wind": "name the right one with --signal",
    "discover run_0.csv --each --workers 0 --signal wind --signal base=alpha": "has a name or none",
}


@pytest.mark.parametrize("line", REFUSED)
def test_bad_arguments_are_refused_with_one_sentence(line, run) -> None:
    status, out, err = run(line)
    assert (status, out) == (2, "")
    sentence = err.splitlines()[-1]
    assert sentence.startswith("rotflex: ")
    assert sentence[-1] in ".?"
    assert REFUSED[line] in sentence
    assert "Traceback" not in err
    if "No search" not in sentence:
        assert not Path("rotflex-each").exists()


OTHER_UNITS = {
    "t,voltage [A],theta,alpha": ("--degrees", "the input 'voltage' is in A, but the model is driven in V"),
    "t,voltage,theta [rev],alpha": (
        '--output "theta [rev]=theta" --output alpha=alpha',
        "the output 'theta' is in rev, but that of the model is in rad",
    ),
}


@pytest.mark.parametrize("header", OTHER_UNITS)
def test_each_refuses_a_file_that_one_search_refuses(header, run) -> None:
    """The same sentence, with the name of the file."""
    rows = Path("run_1.csv").read_text().partition("\n")[2]
    Path("other.csv").write_text(f"{header}\n{rows}")
    options, fault = OTHER_UNITS[header]
    status, _, err = run(f"discover other.csv {options}")
    sentence = err.strip().removeprefix("rotflex: ")
    assert status == 2 and sentence.startswith(f"other.csv: {fault}") and "--accept units" in sentence
    status, _, err = run(f"discover other.csv --each --workers 0 {options}")
    assert status == 2 and err.strip().endswith(sentence)
    assert run(f"discover other.csv --each --workers 0 --accept units {options}")[0] == 0


def test_each_recording_of_a_public_data_set_is_searched(run, monkeypatch) -> None:
    from rotflex_jax.data import datasets, load

    runs = [load(f"run_{k}.csv", degrees=True) for k in range(2)]
    monkeypatch.setattr(datasets, "load_dataset", {"rotflex": runs}.get)
    assert run("discover rotflex run_2.csv --each --workers 0 --degrees")[0] == 2  # not for a data set
    status, out, _ = run("discover rotflex --each --workers 0")
    rows = [line.split()[0] for line in out.splitlines() if line.startswith("run_")]
    assert status == 0 and rows == ["run_0", "run_1"]


def test_each_file_has_its_page_and_the_summary_links_to_it(run, monkeypatch) -> None:
    """With the real search without candidates, on a machine with one coordinate."""
    from spindle import SPINDLE, spun

    import rotflex_jax as rf
    from rotflex_jax.batch import fleet

    recording = spun()
    search = functools.partial(rf.discover, candidates=[], rounds=0)
    options = {"folder": "each", "workers": 0, "search": search}
    found = fleet(SPINDLE, [recording], pages=True, **options)
    (page,) = Path("each/pages").iterdir()
    text = page.read_text()
    assert found.rows[0].verdict.replace("_", " ") in text.lower() and "shaft.inertia.inertia" in text
    assert f'href="pages/{page.name}"' in Path("each/summary.html").read_text()
    assert f'href="recordings/{page.stem}.json"' in Path("each/summary.html").read_text()
    # A further call keeps an existing page. Without a page, the summary has no link to one.
    fleet(SPINDLE, [recording], **options)
    assert page.read_text() == text
    page.unlink()
    fleet(SPINDLE, [recording], **options)
    assert "pages/" not in Path("each/summary.html").read_text()
