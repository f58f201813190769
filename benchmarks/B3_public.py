"""B3: errors of searches on public machines by their official protocols, beside published errors.

    python benchmarks/B3_public.py
    python benchmarks/B3_public.py --only silverbox emps --fresh

The Silverbox and EMPS are fitted to the official training records (of the Silverbox, to the first 16,000
samples) and evaluated by free runs over the official test records. The rotary arm is fitted to one run and
evaluated on other runs (rigid), or fitted to the first 70 % of a run and evaluated on the rest (flexible).

Needs the recordings: `rotflex data fetch emps silverbox rotary_arm`, or a folder named by `ROTFLEX_DATA`.
Writes `results/B3.json` and the page `results/B3.md`. Cases that the file already contains are kept unless
`--fresh` is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import rotflex_jax as rf
from origin import KEYS, begin, part
from public_machines import CASES
from public_machines.page import page

RESULTS = HERE / "results"

from rotflex_jax.text.files import write_file


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=tuple(CASES), default=tuple(CASES))
    parser.add_argument("--fresh", action="store_true", help="Run again what the results have already.")
    parser.add_argument("--out", type=Path, default=RESULTS / "B3.json")
    given = parser.parse_args()
    rf.enable_fast_loops()
    rf.enable_compilation_cache()
    found: dict[str, Any] = json.loads(given.out.read_text()) if given.out.is_file() else {}
    begin(found, __file__, sys.argv[1:])
    for name in given.only:
        if name in found and not given.fresh:
            continue
        began = time.perf_counter()

        def say(text: str, name: str = name, began: float = began) -> None:
            print(f"{name} {time.perf_counter() - began:6.1f} s  {text}", flush=True)

        found[name] = CASES[name](say) | {"seconds": round(time.perf_counter() - began, 1)}
        part(found, name)
        found = {name: found[name] for name in (*CASES, *KEYS) if name in found}
        given.out.parent.mkdir(exist_ok=True)
        write_file(given.out, json.dumps(found, indent=1) + "\n")
        write_file(given.out.with_suffix(".md"), page(found))
    print(page(found))


if __name__ == "__main__":
    main()
