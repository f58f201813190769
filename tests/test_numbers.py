"""Every number that README and paper claim of the benchmarks is traced to a generated result."""

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
        "3": "seconds to judge on, the split",
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
    """The part of a document that speaks of results."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if name != "README.md":
        return text
    return text[text.index("## On measured data") : text.index("## Series, filters, kernels")]


@pytest.mark.parametrize("document", quoted.documents(), ids=lambda p: p.name)
def test_what_stands_between_marks_is_what_the_results_say(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for mark in quoted.MARK.finditer(text):
        assert mark["text"] == quoted.quoted(mark["source"]), f"python benchmarks/quoted.py: {mark['source']}"
    # A mark that is not closed, or spelt otherwise, would quote nothing.
    assert len(re.findall(r"<!--=(?!-->)", text)) == len(quoted.MARK.findall(text))


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


# Pages whose tables stand in the text as a benchmark printed them, and the files that hold their numbers. The
# decimal numbers between the tables must be there too, or be known settings and readings.
TABLES = {
    "compare.md": sorted(f"B5/{file.name}" for file in (claims.RESULTS / "B5").glob("*.json")),
    "measured_joint.md": ["B1.json"],
    "next_experiment.md": ["B4.json"],
    "public_recordings.md": ["B3.json"],
    "seed_paper.md": ["B2.json"],
}
KNOWN = {
    "measured_joint.md": {"-27.60": "reading of the sensor at rest [deg]"},
    "public_recordings.md": {"-3.16": "published [N]", "2405.10779": "name of a preprint"},
    "seed_paper.md": {
        "-34.8": "a pole of the paper's joint, in tests/paper_numbers.json",
        "-8.99": "the other two, in tests/paper_numbers.json",
        "0.0531": "printed by `rotflex reproduce`",
        "0.126": "printed by `rotflex reproduce --data rotflex`",
        "0.413": "printed by `rotflex reproduce --data rotflex`",
    },
}


def leaves(found: Any) -> Iterator[float]:
    """Every number of a result; of the next experiment also what its table adds up and divides."""
    if isinstance(found, dict):
        if "original" in found and "inputs" in found:
            worth = [i["train"] + i["held_out"] for i in (found["original"], *found["inputs"])]
            yield from (*worth, *(max(worth) / w for w in worth))
        found = list(found.values())
    if isinstance(found, list):
        for part in found:
            yield from leaves(part)
    elif isinstance(found, (int, float)):
        yield float(found)


def untraced(text: str, values: list[float]) -> list[str]:
    """Decimal numbers that no value gives in its own unit, degrees, thousandths or %."""
    loose = []
    for number in re.findall(r"(?<![\w.])[-−+]?\d+\.\d+(?![\w.])", text):
        digits, value = len(number.partition(".")[2]), float(number.replace("−", "-"))
        scaled = (scale * v for v in values for scale in (1, -1, 1.96, 180 / math.pi, 100, 1e3))
        if not any(abs(round(x, digits) - value) < 1e-9 for x in scaled):
            loose.append(number)
    return loose


@pytest.mark.parametrize("page", TABLES)
def test_pages_of_results_hold_what_the_results_hold(page: str) -> None:
    values = [v for file in TABLES[page] for v in leaves(claims.results(file))]
    text = prose((ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert [n for n in untraced(text, values) if n not in KNOWN.get(page, ())] == []
    # A number that is nowhere is noticed.
    assert untraced("| error | 0.123456 |", values) == ["0.123456"]
