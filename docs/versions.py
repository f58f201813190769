"""One site with the documentation of every released version: `python docs/versions.py FOLDER [NAME ...]`.

Each version is built from its own tag (`v*`, the newest first), with its own code, settings and pages, in a
folder of its name; other NAMEs (branches, commits) can be given. A side bar leads from one version to the
others, and the address of the folder itself to the newest.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = "ROTFLEX_DOCS_VERSIONS"  # read by conf.py


def released() -> list[str]:
    """Tags of releases, the newest version first."""
    tags = subprocess.run(
        ["git", "tag", "--list", "v*"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    numbered = [tag for tag in tags.stdout.split() if re.fullmatch(r"v\d+(\.\d+)*", tag)]
    return sorted(numbered, key=lambda tag: [int(part) for part in tag[1:].split(".")], reverse=True)


def build(folder: Path, names: Sequence[str]) -> None:
    """The site of all names in a folder, each from a copy of that commit."""
    labels = [name.removeprefix("v").replace("/", "-") for name in names]
    for name, label in zip(names, labels, strict=True):
        with tempfile.TemporaryDirectory() as copy:
            files = subprocess.run(["git", "archive", name], cwd=ROOT, capture_output=True, check=True)
            subprocess.run(["tar", "-xf", "-", "-C", copy], input=files.stdout, check=True)
            around = {**os.environ, "PYTHONPATH": copy, VARIABLE: " ".join(labels)}
            command = [sys.executable, "-m", "sphinx", "-q", "docs", str(folder.resolve() / label)]
            subprocess.run(command, cwd=copy, env=around, check=True)
    folder.mkdir(parents=True, exist_ok=True)
    target = f"{labels[0]}/index.html"
    (folder / "index.html").write_text(
        f'<!doctype html><meta charset="utf-8"><title>rotflex_jax</title>'
        f'<meta http-equiv="refresh" content="0; url={target}"><a href="{target}">rotflex_jax</a>\n'
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    chosen = sys.argv[2:] or released()
    if not chosen:
        sys.exit("There is no release yet, no tag such as v1.0; name what to build, for example HEAD.")
    build(Path(sys.argv[1]), chosen)
