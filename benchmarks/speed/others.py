"""Comparison with packages that use other methods for similar tasks, or need a separate environment."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax import forward_regression, many_starts, simulate
from rotflex_jax.basis import Delays, Volterra
from speed.fits import recording, start
from speed.machine import MOVED, smooth
from speed.rounds import least

PEERS = ("jax-sysid==1.1.0", "sysidentpy==0.9.0")


def others(seconds: float) -> dict[str, float]:
    """Wall-clock times, the least of several runs, and the errors that were reached."""
    r, p0 = recording(seconds), start(0.3, 1)
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/recording.npz"
        np.savez(file, u=r.u, y=r.y, Ts=r.Ts, start=p0, moved=np.array(MOVED))
        told = subprocess.run(
            [_environment(), str(Path(__file__).with_name("elsewhere.py")), file],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    fit_seconds, fit = least(lambda: many_starts(smooth(p=p0), r, starts=1, short_seconds=None), visits=20)
    chosen_seconds, chosen = least(
        lambda: forward_regression(Volterra(Delays(20)), r, "alpha", terms=10), visits=5
    )
    error = (simulate(fit.model.mechanism, r.u, r.Ts) - r.y) / (0.01 * np.std(r.y, axis=0))
    left = (r.y[:, 1] - chosen.model.simulate(r)[:, 0])[20:]
    return {
        "rotflex_jax, a fit, compiled before, seconds": fit_seconds,
        "rotflex_jax, cost from rest, in units of the noise": float(np.sum(error**2) / 2),
        "rotflex_jax, ten of 231 regressors, seconds": chosen_seconds,
        "rotflex_jax, error of the ten [rad]": float(np.sqrt(np.mean(left**2))),
        **json.loads(told.splitlines()[-1]),
        **{f"pysindy, degree {d}, its regression alone, seconds": _sindy(r, d) for d in (1, 2, 3)},
    }


def _sindy(r: Any, degree: int) -> float:
    """Seconds of pysindy's sparse regression on both angles and their speeds."""
    import pysindy

    states = np.hstack([r.y, np.gradient(r.y, r.Ts, axis=0)])

    def regress() -> Any:
        model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=0.1),
            feature_library=pysindy.PolynomialLibrary(degree=degree),
        )
        return model.fit(states, t=r.Ts, u=r.u)

    return least(regress, visits=5)[0]


def _environment() -> str:
    """Python of an environment with the other packages; it is created once, which takes minutes."""
    folder = Path(tempfile.gettempdir()) / "_".join(["rotflex_jax", *PEERS])
    python = folder / "bin" / "python"
    if not (folder / "complete").exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PEERS], check=True)
        (folder / "complete").touch()
    return str(python)
