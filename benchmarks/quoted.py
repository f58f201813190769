"""Numbers that documents quote from the benchmarks: each stands between two marks that say where it is from.

    the error falls to <!--= B3.json silverbox/rows/6/free run/multisine .2f -->0.24<!--=--> mV
    the error falls to <!--= silverbox_multisine -->0.24<!--=--> mV

The first form names a file of `results/`, the way to a number in it, if need be a unit to read it in ([deg],
[mm] or [%]), and a format; the second a function of `claims.py`. Both forms may stand in README.md, docs/*.md
and paper/*.md.

    python benchmarks/quoted.py           # write what the results say into the documents
    python benchmarks/quoted.py --check   # exit status 1 where a document says anything else
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from pathlib import Path
from typing import Any

from claims import NAMED, results

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
MARK = re.compile(r"<!--= *(?P<source>[^>]*?) *-->(?P<text>.*?)<!--=-->", re.DOTALL)
DIRECT = re.compile(r"(?P<file>\S+\.json) (?P<way>.+?)(?: \[(?P<unit>[^\]]+)\])? (?P<form>[.,+]?\S*[dfg])")
UNITS = {"deg": 180 / math.pi, "mm": 1e3, "%": 100.0, "ms": 1e3}

from rotflex_jax.text.files import write_file


def at(file: str, way: str) -> Any:
    """What lies at the end of a way, for instance "rows/-1/free run"."""
    here = results(file)
    for step in way.split("/"):
        here = here[int(step)] if isinstance(here, list) else here[step]
    return here


def quoted(source: str) -> str:
    """The text for a mark.

    Raises:
        LookupError: No such name, file or way.
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
    """Where marks may stand."""
    found = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "paper").glob("*.md")]
    return sorted(p for p in found if p.is_file())


def renewed(text: str) -> str:
    """A text with what the results say now between its marks."""
    return MARK.sub(lambda m: f"<!--= {m['source']} -->{quoted(m['source'])}<!--=-->", text)


def main() -> None:
    """Write, or check with --check."""
    parser = argparse.ArgumentParser(description="Write the numbers of the benchmarks into the documents.")
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    arguments = parser.parse_args()
    stale = False
    for document in documents():
        text = document.read_text(encoding="utf-8")
        new = renewed(text)
        name = document.relative_to(ROOT)
        for before, after in zip(MARK.finditer(text), MARK.finditer(new), strict=True):
            if before["text"] != after["text"]:
                stale = True
                print(f"{name}: {before['source']} is {after['text']}, not {before['text']}")
        if new != text and not arguments.check:
            write_file(document, new)
    if stale and arguments.check:
        sys.exit("Run python benchmarks/quoted.py.")


if __name__ == "__main__":
    main()
