"""A sweep over several devices: `sweep_on_devices.py [PROCESS PORT]` prints its results as JSON.

Alone it has eight virtual devices. As one of two processes it has two, and the sweep uses all four.
"""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.adaptive import LMS
from rotflex_jax.adaptive.objectives import _values_on
from rotflex_jax.adaptive.tuning import grid
from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import mesh_of, spread

# Number of settings; it is divisible neither by two, nor by four, nor by eight.
ROWS = 11


def build(settings: dict) -> LMS:
    return LMS(settings["mu"])


def sweep(devices: list, factor: float = 1.0) -> list[float]:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(600)
    basis = Volterra(Delays(3))
    y = basis.regressors(u) @ rng.standard_normal(10) + 0.3 * rng.standard_normal(600)
    recordings = [Recording(u[k : k + 300], y[k : k + 300], 0.1) for k in (0, 300)]
    axes = {"mu": factor * np.geomspace(1e-3, 0.05, ROWS)}
    found = grid(build, axes, basis, recordings, "theta", objective="final", devices=devices)
    assert found.values is not None
    return found.values.tolist()


def where(devices: list) -> list[int]:
    """Index of the device that computes each row."""
    mesh = mesh_of(devices)
    run = jax.jit(spread(lambda rows: jnp.full(len(rows), jax.lax.axis_index("rows")), mesh))
    return np.asarray(run(np.zeros((ROWS, 2)))).tolist()


def main() -> None:
    """Run the sweep on one device and on several, and print the results."""
    alone = len(sys.argv) == 1
    jax.config.update("jax_num_cpu_devices", 8 if alone else 2)
    if not alone:
        jax.distributed.initialize(f"127.0.0.1:{sys.argv[2]}", num_processes=2, process_id=int(sys.argv[1]))
    sets = {str(n): jax.devices()[:n] for n in ((2, 8) if alone else (4,))}
    plain = sweep(jax.local_devices()[:1])
    spreads = {n: sweep(devices) for n, devices in sets.items()}
    compiled = _values_on.programs_made
    again = {n: sweep(devices, 0.9) for n, devices in sets.items()}
    print(
        json.dumps(
            {
                "plain": plain,
                "spread": spreads,
                "where": {n: where(devices) for n, devices in sets.items()},
                "compiled_again": _values_on.programs_made - compiled,
                "changed": all(again[n] != spreads[n] for n in sets),
            }
        )
    )


if __name__ == "__main__":
    main()
