"""The lowest versions that pyproject.toml allows, as constraints of pip: `name>=1.2` becomes `name==1.2`.

python .ci/constraints.py [EXTRA ...], or --version for the version of the project itself
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())["project"]


def lowest(extras: Iterable[str] = ()) -> list[str]:
    """One constraint for each dependency, and for those of the extras."""
    wanted = list(PROJECT["dependencies"])
    for extra in extras:
        wanted += PROJECT["optional-dependencies"][extra]
    found = []
    for requirement in wanted:
        bound = re.fullmatch(r"([\w.-]+)>=([\w.]+)", requirement)
        if bound is None:
            raise SystemExit(f"{requirement!r} in pyproject.toml has no lowest version; write name>=version.")
        found.append(f"{bound[1]}=={bound[2]}")
    return found


if __name__ == "__main__":
    print(PROJECT["version"] if sys.argv[1:] == ["--version"] else "\n".join(lowest(sys.argv[1:])))
