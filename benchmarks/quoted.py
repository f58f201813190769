"""Writes the numbers that documents quote from the benchmarks, between two marks that name their source.

    the error falls to <!--= B3.json silverbox/rows/6/free run/multisine .2f -->0.24<!--=--> mV
    the error falls to <!--= silverbox_multisine -->0.24<!--=--> mV

The first form names a file of `results/`, the path of a number in it (keys and indices), optionally a unit in
which to show the number ([deg], [mm], [ms] or [%]), and a format. The second form names a function of
`claims.py`. Both forms may be used in README.md, docs/*.md and paper/*.md.

    <!--= versions -->Measured with an earlier version of the code: B3 (28c8341).<!--=-->

lists the results that were measured with code that has changed since (`origin.py`), among the results that
its section quotes and those that the mark names (`versions B3.json B5`). It is added at the end of each
section that needs it, unless the section already has it, and at the end of the pages in results/.

    python benchmarks/quoted.py           # write the present results into the documents
    python benchmarks/quoted.py --check   # write nothing; exit status 1 if a document is out of date
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from claims import ASKED, NAMED, RESULTS, results
from origin import remark

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
MARK = re.compile(r"<!--= *(?P<source>[^>]*?) *-->(?P<text>.*?)<!--=-->", re.DOTALL)
DIRECT = re.compile(r"(?P<file>\S+\.json) (?P<way>.+?)(?: \[(?P<unit>[^\]]+)\])? (?P<form>[.,+]?\S*[dfg])")
HEADING = re.compile(r"^(?=#{1,6} )", re.MULTILINE)
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
VERSIONS = "versions"
UNITS = {"deg": 180 / math.pi, "mm": 1e3, "%": 100.0, "ms": 1e3}

from rotflex_jax.text.files import write_file


def at(file: str, way: str) -> Any:
    """Value in a file of results at a path, for instance "rows/-1/free run"."""
    here = results(file)
    for step in way.split("/"):
        here = here[int(step)] if isinstance(here, list) else here[step]
    return here


def quoted(source: str) -> str:
    """The present text for a mark.

    Raises:
        LookupError: There is no such name, file or path.
    """
    if source in NAMED:
        return NAMED[source]()
    direct = DIRECT.fullmatch(source)
    if direct is None:
        raise LookupError(f"{source!r} is neither a name of benchmarks/claims.py nor a way into a file")
    try:
        value = at(direct["file"], direct["way"])
    except (OSError, KeyError, IndexError, ValueError, TypeError) as error:
        raise LookupError(f"{source!r} leads nowhere: {error}") from error
    scale = UNITS[direct["unit"]] if direct["unit"] else 1
    return format(scale * value, direct["form"]).replace("-", "−")


def documents() -> list[Path]:
    """Documents that may contain marks."""
    found = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "paper").glob("*.md")]
    return sorted(p for p in found if p.is_file())


def pages() -> list[Path]:
    """Pages that benchmarks write beside their results."""
    return sorted(p for p in RESULTS.rglob("*.md") if p.with_suffix(".json").is_file())


def renewed(text: str) -> str:
    """A text with the present results between its marks, and with marks of versions where needed."""
    return "".join(_section(part) for part in sections(text))


def renewed_page(page: Path, text: str) -> str:
    """A page of results, with a last line if the results are from an earlier version of the code."""
    file = page.with_suffix(".json").relative_to(RESULTS).as_posix()
    return _marked(text, [file])


def sections(text: str) -> list[str]:
    """The parts of a text from heading to heading; a `#` in a block of code starts no part."""
    code = [m.span() for m in FENCE.finditer(text)]
    starts = [m.start() for m in HEADING.finditer(text)]
    cuts = [k for k in starts if k and not any(first <= k < last for first, last in code)]
    return [text[i:k] for i, k in zip([0, *cuts], [*cuts, len(text)], strict=True)]


def told_of(text: str) -> set[str]:
    """Files of results that a text quotes or that its marks of versions name."""
    ASKED.clear()
    named = set[str]()
    for mark in MARK.finditer(text):
        if _of_versions(mark):
            named |= set(mark["source"].split()[1:])
        else:
            quoted(mark["source"])
    return ASKED | named


def _section(text: str) -> str:
    """One section with the present results between its marks."""
    files = sorted(told_of(text))
    now = lambda m: m[0] if _of_versions(m) else _mark(m["source"], quoted(m["source"]))  # noqa: E731
    return _marked(MARK.sub(now, text), files)


def _marked(text: str, files: list[str]) -> str:
    """A text that quotes these files, with its mark of versions updated, or added where one is needed."""
    said = remark(files)
    if any(_of_versions(m) for m in MARK.finditer(text)):
        return MARK.sub(lambda m: _mark(m["source"], said) if _of_versions(m) else m[0], text)
    if not said:
        return text
    body = text.rstrip("\n")
    return f"{body}\n\n{_mark(VERSIONS, said)}\n" + text[len(body) + 1 :]


def _of_versions(mark: re.Match[str]) -> bool:
    return mark["source"].split(" ", 1)[0] == VERSIONS


def _mark(source: str, said: str) -> str:
    return f"<!--= {source} -->{said}<!--=-->"


def main() -> None:
    """Update the documents, or only check them with --check."""
    parser = argparse.ArgumentParser(description="Write the numbers of the benchmarks into the documents.")
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    arguments = parser.parse_args()
    stale = False
    for document in (*documents(), *pages()):
        text = document.read_text(encoding="utf-8")
        new = renewed_page(document, text) if RESULTS in document.parents else renewed(text)
        if new == text:
            continue
        stale = True
        before, after = (Counter((m["source"], m["text"]) for m in MARK.finditer(t)) for t in (text, new))
        for source, said in after - before:
            print(f"{document.relative_to(ROOT)}: {source}: {said}")
        if not arguments.check:
            write_file(document, new)
    if stale and arguments.check:
        sys.exit("Run python benchmarks/quoted.py.")


if __name__ == "__main__":
    main()
