"""Where figures and tables take their numbers from, and where they go."""

import importlib
import sys
from pathlib import Path

PAPER = Path(__file__).resolve().parent.parent
ROOT = PAPER.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

# The results, and what is said of them; a folder of scripts and no package, so it is found by its path.
claims = importlib.import_module("claims")


def save(figure, name: str, folder: Path = PAPER / "figures", dpi: float = 200) -> None:
    """Write a figure; without the version of what drew it, so that equal results give equal files."""
    folder.mkdir(exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=dpi, metadata={"Software": None})
