"""Every number that documents quote from the benchmarks is traced to a generated result."""

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import claims
import quoted

ROOT = Path(__file__).resolve().parent.parent

# Numbers that need no result, since they are settings of a protocol, each with its reason. Where a document
# is named here, every other number in it must stand between marks.
SETTINGS = {
    "paper/paper.md": {
        "20": "step of the arena [µs], in its documentation",
        "2": "length of the windows [s], a setting",
        "95": "level of the intervals [%], a setting",
    },
    "README.md": {
        "10": "length of the recordings [s]",
        "2": "length of the windows [s], a setting",
        "7": "seconds to learn from, the split",
        "3": "seconds of the test, the split",
        "20": "step of the arena [µs], in its documentation",
    },
}


def prose(text: str) -> str:
    """A text without marked quotations, front matter, code, links, citations and names."""
    for pattern in (
        r"\A---\n.*?\n---\n",
        quoted.MARK.pattern,
        r"```.*?```",
        r"`[^`]*`",
        r"\]\([^)]*\)(\{[^}]*\})?",
        r"\[@[^\]]*\]",
        r"<!--.*?-->",
    ):
        text = re.sub(pattern, " ", text, flags=re.DOTALL)
    return text


def numbers(text: str) -> list[str]:
    return re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*\w)", text)


def about_results(name: str) -> str:
    """The part of a document that reports results."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if name != "README.md":
        return text
    return text[text.index("## On measured data") : text.index("## Series, filters, kernels")]


@pytest.mark.parametrize("document", quoted.documents(), ids=lambda p: p.name)
def test_what_stands_between_marks_is_what_the_results_say(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    # Line by line, so that a failure shows the mark.
    assert text.splitlines() == quoted.renewed(text).splitlines(), "python benchmarks/quoted.py"
    # A mark that is not closed, or spelt otherwise, would quote nothing.
    assert len(re.findall(r"<!--=(?!-->)", text)) == len(quoted.MARK.findall(text))


def test_a_document_quotes_each_claim_that_has_a_function_of_its_own() -> None:
    """A table that an edit has removed from a document would otherwise be missing without notice."""
    text = "".join(p.read_text(encoding="utf-8") for p in quoted.documents())
    marked = {mark["source"].strip() for mark in quoted.MARK.finditer(text)}
    own = {name for name in claims.NAMED if name in vars(claims)}
    assert own
    assert own <= marked


@pytest.mark.parametrize("page", quoted.pages(), ids=lambda p: p.name)
def test_pages_say_which_code_their_results_are_of(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text == quoted.renewed_page(page, text), "python benchmarks/quoted.py"


def test_a_section_says_where_its_results_are_of_an_earlier_version(monkeypatch) -> None:
    earlier = ["B3.json"]
    monkeypatch.setattr(quoted, "remark", lambda files: ", ".join(f for f in files if f in earlier))
    monkeypatch.setattr(claims, "_read", lambda file: {"error": 0.0034})
    quote = "<!--= {} error [mm] .1f -->3.4<!--=-->"
    first, second = (quote.format(file) for file in ("B3.json", "B4.json"))
    text = f"# One\n\n{first}\n\n```bash\n# no heading\n```\n\n# Two\n\n{second}\n"
    marked = quoted.renewed(text)
    assert marked == text.replace("```\n\n# Two", "```\n\n<!--= versions -->B3.json<!--=-->\n\n# Two")
    assert quoted.renewed(marked) == marked
    # An existing mark keeps its place, and it may name results that are shown in a table.
    placed = f"# One <!--= versions B4.json --><!--=-->\n\n{first}\n"
    assert quoted.renewed(placed) == placed.replace("--><!--=", "-->B3.json<!--=", 1)
    earlier[:] = ["B4.json"]
    assert quoted.renewed(placed) == placed.replace("--><!--=", "-->B4.json<!--=", 1)
    assert quoted.renewed(marked).count("<!--= versions --><!--=-->") == 1


def test_the_model_to_use_is_compared_with_the_best_method_that_worked():
    """The model to use is the fit to all if there is one; errors of a method that failed are left out."""
    others = [
        {"status": "ok", "held_out_rmse": {"theta": 3.0, "alpha": 0.5}},
        {"status": "ok", "held_out_rmse": {"theta": 4.0, "alpha": None}},
        {"status": "ok", "held_out_rmse": None},
        {"status": "diverged", "held_out_rmse": {"theta": 1.0, "alpha": 0.1}},
    ]
    reported = {"final": {"test_rmse": {"seconds": 9.0, "theta": 2.0, "alpha": 1.0}}, "fitted to all": None}
    row: dict[str, Any] = {"reported": reported, "others": {"rows": others}}
    assert [claims.measured_lead(row, "", channel) for channel in range(3)] == [1.5, 0.5, None]
    reported["fitted to all"] = {"test_rmse": {"theta": 6.0}}
    assert claims.measured_lead(row, "", 0) == 0.5


@pytest.mark.parametrize("name", SETTINGS)
def test_no_number_stands_outside_of_marks(name: str) -> None:
    assert quoted.MARK.search(about_results(name))
    loose = [n for n in numbers(prose(about_results(name))) if n not in SETTINGS[name]]
    assert not loose, f"{loose} of {name} are neither marked nor known settings; see benchmarks/quoted.py"


def test_another_result_is_noticed(monkeypatch) -> None:
    text = "It is <!--= B9.json rows/0/error [mm] .1f -->3.4<!--=--> mm in <!--= count -->2<!--=--> runs."
    monkeypatch.setattr(quoted, "results", lambda file: {"rows": [{"error": 0.0034}]})
    monkeypatch.setitem(quoted.NAMED, "count", lambda: "2")
    assert quoted.renewed(text) == text
    monkeypatch.setattr(quoted, "results", lambda file: {"rows": [{"error": -0.0048}]})
    assert quoted.renewed(text) == text.replace("3.4", "−4.8")
    assert "and 12 are 0.5" in prose("`7` and 12 are 0.5 [@a2024] [b](c9.md)")
    assert numbers("and 12 are 0.5, v1 x2 2D 3.") == ["12", "0.5", "3"]


@pytest.mark.parametrize("source", ["nothing", "B9.json a/b .1f", "B3.json silverbox/rows/99/model .1f"])
def test_a_mark_that_leads_nowhere_says_so(source: str) -> None:
    with pytest.raises(LookupError, match=r"neither|nowhere"):
        quoted.quoted(source)


# Pages with tables that a benchmark printed, and the files with the numbers of these tables. Other decimal
# numbers of a page must be in these files too, or be listed in `KNOWN`.
TABLES = {
    "compare.md": sorted(f"B5/{file.name}" for file in (claims.RESULTS / "B5").glob("*.json")),
    "measured_joint.md": ["B1.json"],
    "next_experiment.md": ["B4.json", "B4_sequential.json"],
    "public_recordings.md": ["B3.json"],
    "seed_paper.md": ["B2.json"],
    "kernels.md": ["B8.json"],
    "latent_torque.md": ["B8.json"],
    "many_recordings.md": ["B8.json"],
    **dict.fromkeys(["first_look.md", "glossary.md", "load_data.md", "method.md", "read_report.md"], ()),
    **dict.fromkeys(["add_effect.md", "export.md", "own_machine.md", "trust.md", "speed.md", "index.md"], ()),
    **dict.fromkeys(["from_matlab.md", "troubleshooting.md", "design.md", "cite.md"], ()),
}
KNOWN = {
    "next_experiment.md": {
        **dict.fromkeys(["0.01", "0.5", "0.3", "0.2"], "error, segment, limits and sizes, settings"),
    },
    "kernels.md": {
        **dict.fromkeys(["0.03", "0.003", "0.045", "0.015"], "levels of friction, settings [N m]"),
        **dict.fromkeys(["0.1", "1.5", "0.3", "0.25"], "dead zones, limit, offset, settings [V]"),
        **dict.fromkeys(["0.001", "0.006", "0.15"], "drag, play, loss of a sensor, settings"),
        "0.8": "bandwidth, a setting [Hz]",
    },
    "latent_torque.md": {
        **dict.fromkeys(["0.03", "0.008", "0.04", "0.8"], "what was hidden, settings"),
        **dict.fromkeys(["2109.10681", "2501.05842"], "names of preprints"),
    },
    "many_recordings.md": {"3.5": "batch.workers.PROCESS_MEMORY [GB], compared below"},
    "first_look.md": {
        "3.11": "version of Python",
        **dict.fromkeys(["1.01", "0.7", "99.82", "99.55"], "what the demo prints, compared below"),
        "1.5": "limit of what counts as explained, times the noise",
        "0.2": "time that a model may look at, a setting [s]",
        **dict.fromkeys(["0.000", "0.0000", "0.002", "0.31", "0.35", "0.0001", "-0.0002"], "lines of a file"),
    },
    "glossary.md": {"0.2": "time that a model may look at, a setting [s]"},
    "load_data.md": {"7.3": "version of a file of MATLAB"},
    "method.md": {
        **dict.fromkeys(["1.5", "0.03"], "numbers of the decision, compared in test_docs.py"),
        "2.5": "selection.FREE_RUN_Z",
        "1.75": "friction_of_runs.LARGE_DIFFERENCE",
        "13.4": "section of a book",
    },
    "read_report.md": {"1.5": "result.NEAR_FLOOR"},
    "trust.md": dict.fromkeys(["0.06", "0.11"], "printed by `benchmarks/set_probabilities.py`"),
    "measured_joint.md": {"-27.60": "reading of the sensor at rest [deg]"},
    "public_recordings.md": {
        **dict.fromkeys(["1.36", "1.56", "1.44", "2.83"], "friction of two runs, fitted by hand"),
        **dict.fromkeys(
            ["0.49", "7.1", "20.06"], "mass and clocks of measured servos, checked by their readers"
        ),
        "-3.16": "published [N]",
        **dict.fromkeys(["5.7", "9.2"], "supply of a measured servo [V], as its files have it"),
        **dict.fromkeys(["0.85", "0.80"], "errors of B9 before something that was tried"),
        **dict.fromkeys(["0.28", "0.36"], "errors of B after fits by hand to A"),
        **dict.fromkeys(["0.94", "0.48", "0.15", "0.84"], "errors of earlier searches on two processors"),
        **dict.fromkeys(
            [
                "0.88",
                "12.92",
                "2.50",
                "5.20",
                "1.62",
                "24.09",
                "5.28",
                "22.97",
                "5.09",
                "17.4",
                "2.07",
                "3.61",
                "5.08",
                "1.89",
                "0.67",
                "0.78",
                "9.43",
                "2.52",
                "13.25",
                "9.28",
            ],
            "before",
        ),
        **dict.fromkeys(
            ["185.4", "2.5", "200.3", "2.0"], "viscous damping of the two files of EMPS, fitted by hand"
        ),
        **dict.fromkeys(
            ["0.66", "0.75", "3.31", "3.2", "2.6", "0.51", "1.77", "1.10", "1.64", "3.3", "4.1"],
            "errors over 2 s of these fits",
        ),
        **dict.fromkeys(["41.9", "0.1", "40.7"], "friction at a speed in both, by hand"),
        **dict.fromkeys(
            ["4.97", "3.87", "1.33", "0.41", "4.54", "3.18", "2.04", "11.58", "3.39"], "errors before"
        ),
        **dict.fromkeys(
            ["0.70", "0.21", "0.18", "5.72", "2.92", "2.95", "0.48"], "errors before, by final fits"
        ),
        **dict.fromkeys(["1.59", "0.72", "0.83", "0.24", "0.37", "0.32"], "errors before, by final fits"),
        **dict.fromkeys(
            ["0.046", "0.028", "0.012", "0.018", "0.01", "-0.004", "-0.008"],
            "offsets of windows, by hand [V]",
        ),
        **dict.fromkeys(["0.38", "0.28", "1.93", "0.61", "0.20"], "errors with one offset for both, by hand"),
        **dict.fromkeys(
            ["0.52", "0.65", "2.4", "4.4", "2.2", "1.7", "0.62", "0.76"],
            "errors with friction of first seconds",
        ),
        **dict.fromkeys(["1.3", "1.4", "1.9", "0.13"], "errors with the best offset for A, by hand"),
        **dict.fromkeys(["0.0252", "0.0063", "0.0185", "0.0094"], "friction of both runs, by hand"),
        "2405.10779": "name of a preprint",
    },
    "seed_paper.md": {
        "-34.8": "a pole of the paper's joint, in tests/paper_numbers.json",
        "-8.99": "the other two, in tests/paper_numbers.json",
        "0.0531": "printed by `rotflex reproduce`",
        "0.126": "printed by `rotflex reproduce --data rotflex`",
        "0.413": "printed by `rotflex reproduce --data rotflex`",
    },
}


def leaves(found: Any) -> Iterator[float]:
    """Every number of a result; for the next experiment also the ratios of its table."""
    if isinstance(found, dict):
        if "original" in found and "inputs" in found:
            worth = [i["margin"] for i in (found["original"], *found["inputs"])]
            yield from (*worth, *(max(worth) / w for w in worth))
        found = list(found.values())
    if isinstance(found, list):
        for part in found:
            yield from leaves(part)
    elif isinstance(found, (int, float)):
        yield float(found)


def untraced(text: str, values: list[float]) -> list[str]:
    """Decimal numbers that equal no value in its own unit, degrees, thousandths or %, nor 1.96 times one."""
    loose = []
    for number in re.findall(r"(?<![\w.])[-−+]?\d+\.\d+(?![\w.])", text):
        digits, value = len(number.partition(".")[2]), float(number.replace("−", "-"))
        scaled = (scale * v for v in values for scale in (1, -1, 1.96, 180 / math.pi, 100, 1e3))
        if not any(abs(round(x, digits) - value) < 1e-9 for x in scaled):
            loose.append(number)
    return loose


NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_every_number_in_the_text_of_a_notebook_is_in_its_code_or_in_what_it_shows(notebook: Path) -> None:
    text, shown = "", ""
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "markdown":
            text += prose("".join(cell["source"])) + "\n"
            continue
        shown += "".join(cell["source"]).replace("_", "") + "\n"
        for output in cell["outputs"]:
            parts = {"text": output.get("text", ""), **output.get("data", {})}
            shown += "".join("".join(part) for kind, part in parts.items() if kind.startswith("text"))
    values = {float(n) for n in re.findall(r"\d+(?:\.\d+)?", shown)}
    # The text may give a share in % and a time in ms.
    values |= {round(scale * v, 9) for v in values for scale in (100, 1e3)}
    assert [n for n in numbers(text) if float(n) not in values] == []


@pytest.mark.parametrize("page", TABLES)
def test_pages_of_results_hold_what_the_results_hold(page: str) -> None:
    values = [v for file in TABLES[page] for v in leaves(claims.results(file))]
    text = prose((ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert [n for n in untraced(text, values) if n not in KNOWN.get(page, ())] == []
    # The version of the code is given for every table: the page quotes its file, or a mark names it.
    told = quoted.told_of((ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert [f for f in TABLES[page] if not {f, f.partition("/")[0]} & told] == []
    # A number that is in no result is reported.
    assert untraced("| error | 0.123456 |", values) == ["0.123456"]


def test_what_pages_say_of_settings_and_of_the_demo_is_so() -> None:
    from rotflex_jax.batch.workers import PROCESS_MEMORY

    assert (
        f"holds more than {PROCESS_MEMORY / 1e9:g} GB" in (ROOT / "docs" / "many_recordings.md").read_text()
    )
    look = (ROOT / "docs" / "first_look.md").read_text()
    shown = (ROOT / "notebooks" / "00_first_look.ipynb").read_text(encoding="utf-8")
    # The notebook runs the loop of the demo, by hand and in one call.
    (before,) = re.findall(r"textbook +[\d.]+ +[\d.]+ +([\d.]+) ", shown)
    assert f"is off by {float(before):.1f} degrees" in look
    found = re.findall(r"theta (1\.\d+), alpha (1\.\d+) times", shown)
    told = re.findall(r"theta (1\.\d+), alpha (1\.\d+) times", look)
    assert len(told) == 1 and told[0] in found
