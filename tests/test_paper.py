"""The manuscript has the form that the Journal of Open Source Software requires, and can be typeset."""

import re
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parent.parent / "paper"
TEXT = (FOLDER / "paper.md").read_text(encoding="utf-8")
BODY = TEXT.split("\n---\n", 1)[1]
SECTIONS = [
    "Summary",
    "Statement of need",
    "State of the field",
    "Software design",
    "Research impact statement",
    "AI usage disclosure",
    "Acknowledgements",
    "References",
]


def entries() -> dict[str, str]:
    """Key -> entry of the bibliography."""
    text = (FOLDER / "paper.bib").read_text(encoding="utf-8")
    return {m[1]: m[0] for m in re.finditer(r"^@\w+\{(\w+),.*?^\}", text, re.DOTALL | re.MULTILINE)}


def test_every_required_section_is_there() -> None:
    assert re.findall(r"^# (.+)$", BODY, re.MULTILINE) == SECTIONS
    for key in ("title", "tags", "authors", "affiliations", "date", "bibliography"):
        assert re.search(rf"^{key}:", TEXT, re.MULTILINE)


def test_it_is_neither_short_nor_long() -> None:
    plain = re.sub(r"<!--.*?-->|\[@[^\]]*\]|\{[^}]*\}", " ", BODY)
    assert 750 <= len(re.findall(r"\b\w[\w'’.-]*", plain)) <= 1750


def test_every_citation_has_an_entry_and_every_entry_is_cited() -> None:
    cited = set(re.findall(r"@(\w+)", BODY))
    assert cited == set(entries())


@pytest.mark.parametrize("key", entries())
def test_an_entry_can_be_found(key: str) -> None:
    entry = entries()[key]
    for field in ("author", "title", "year"):
        assert re.search(rf"^\s*{field}\s*=", entry, re.MULTILINE), f"{key} lacks {field}"
    if entry.startswith("@article"):
        assert re.search(r"doi\s*=\s*\{10\.\d{4,}/\S+\}", entry), f"{key} lacks a DOI"
    venue = re.search(r"(?:journal|booktitle)\s*=\s*\{(.+)\}", entry)
    assert venue is None or "." not in venue[1]  # in full, no abbreviations


def test_every_figure_has_a_script_and_a_caption() -> None:
    figures = re.findall(r"^!\[(.+?) ?\[\]\{label=\"(\w+)\"\}\]\(figures/(\w+)\.png\)", BODY, re.MULTILINE)
    assert figures and BODY.count("![") == len(figures)
    for caption, label, name in figures:
        assert caption.endswith(".") and rf"\autoref{{{label}}}" in BODY
        assert (FOLDER / "scripts" / f"fig_{name}.py").is_file()


def test_the_text_can_be_set(monkeypatch) -> None:
    pytest.importorskip("pypandoc")
    pytest.importorskip("typst")
    monkeypatch.syspath_prepend(str(FOLDER))
    sys.modules.pop("build", None)
    import build

    typst = build.body(TEXT)
    assert "Figure 1" in typst and "autoref" not in typst and "<!--" not in typst
    assert typst.count("#figure(") == 3
    # Every reference was resolved.
    assert "@schoukens2019" not in typst and "Schoukens" in typst
