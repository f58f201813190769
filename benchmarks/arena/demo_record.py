"""Makes the demonstration recording of the package, with two effects that the textbook joint lacks.

Run ``python -m arena.demo_record`` with `benchmarks` on the path to write `demo.csv` and
`demo_truth.json` into `rotflex_jax/data`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.arena.simulator.records import make_record

FOLDER = Path(__file__).parents[2] / "rotflex_jax" / "data"
HEADER = "t,voltage,theta,alpha"
SEED = 11
EFFECTS = {
    ("coulomb", "hub"): {"level": 0.03},
    ("cubic_spring", "joint"): {"coefficient": 60.0},
}


def demo() -> dict[str, Any]:
    """The demonstration recording and its truth: 20 s of noise at 500 Hz."""
    return make_record(EFFECTS, kind="noise", seed=SEED)


def write(folder: Path = FOLDER) -> tuple[Path, Path]:
    """Write recording and truth.

    Args:
        folder: folder of the files; created if missing.

    Returns:
        Paths of the recording and of the truth.
    """
    record = demo()
    folder.mkdir(parents=True, exist_ok=True)
    table, truth = folder / "demo.csv", folder / "demo_truth.json"
    t = record["Ts"] * np.arange(record["u"].size)
    np.savetxt(
        table,
        np.column_stack([t, record["u"], record["y"]]),
        delimiter=",",
        header=HEADER,
        comments="",
        fmt=["%.3f", "%.7g", "%.7g", "%.7g"],
    )
    truth.write_text(json.dumps(record["truth"], indent=2) + "\n")
    return table, truth


if __name__ == "__main__":
    for path in write():
        print(f"{path} ({path.stat().st_size / 1e3:.0f} kB)")
