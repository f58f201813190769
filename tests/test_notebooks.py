"""Rules for every notebook: a question as title, claims that it checks, no algorithm of its own."""

import re
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"
SCRIPTS = sorted(FOLDER.glob("[0-9][0-9]_*.py"))


@pytest.fixture
def build(monkeypatch):
    pytest.importorskip("jupytext")
    pytest.importorskip("nbclient")
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.delitem(sys.modules, "build", raising=False)
    import build

    yield build
    sys.modules.pop("build", None)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda s: s.stem)
def test_a_notebook_asks_a_question_and_checks_its_answer(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    (title,) = re.findall(r"^# # (.+)$", text, re.MULTILINE)
    assert title.endswith("?")
    last = text.rpartition("\n# %%\n")[2]
    assert last.count("assert ") >= 3 and last.rstrip().endswith('print("All claims hold.")')
    # Algorithms belong into the package, where they are tested.
    assert not re.search(r"lax\.|jax\.jit|jax\.grad|optimize\.", text)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda s: s.stem)
def test_a_notebook_shows_the_run_of_its_script(script: Path, build) -> None:
    assert build.faults(script) == []
    shown = script.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert "All claims hold.\\n" in shown
    assert not re.search(r"/(tmp|home|root|work)/", shown)


def test_text_is_taken_over_without_a_run_and_code_is_not(build, tmp_path: Path) -> None:
    script = tmp_path / "00_question.py"
    for end in (".py", ".ipynb"):
        (tmp_path / f"00_question{end}").write_bytes((FOLDER / f"03_step_sizes{end}").read_bytes())
    source = script.read_text(encoding="utf-8")
    script.write_text(source.replace("Usually they are set by hand.", "Nobody knows."), encoding="utf-8")
    assert build.faults(script) == ["differs from its script"]
    assert build.retext(script) == "" and build.faults(script) == []
    script.write_text(source.replace("blocks = 0.1, 8", "blocks = 0.1, 9"), encoding="utf-8")
    assert build.retext(script) == "has other code"


def test_a_claim_that_does_not_hold_is_told(build, tmp_path: Path, capsys) -> None:
    good, bad = tmp_path / "00_good.py", tmp_path / "01_bad.py"
    good.write_text("# %%\nassert 1 + 1 == 2\n", encoding="utf-8")
    bad.write_text("# %%\nx = 2\n\n# %%\nassert 1 + 1 == x + 1\n", encoding="utf-8")
    assert build.trial(good, timeout=60.0) == "" and "00_good: ok" in capsys.readouterr().out
    told = build.trial(bad, timeout=60.0)
    assert told.startswith("01_bad: ") and "AssertionError" in told
    assert sorted(tmp_path.iterdir()) == [good, bad]
