"""A program that fits on one and on two devices and prints both results and the numbers of devices used."""

import json
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import optimistix

import rotflex_jax as rf
from rotflex_jax.fit import many_starts, problem
from rotflex_jax.runtime.xla import mesh_of, spread

DOGLEG = optimistix.Dogleg(rtol=1e-9, atol=1e-9)


def recorded() -> list[rf.Recording]:
    """Three recordings; neither their number nor that of the five starts below is divisible by two."""
    rng = np.random.default_rng(3)
    truth = rf.joints.paper(stiffness=1.3, hub_damping=0.007)
    recordings = []
    for N in (400, 700, 500):
        u = np.repeat(rng.uniform(-3, 3, N // 50), 50)
        y = rf.simulate(truth, u, 0.002) + 1e-3 * rng.standard_normal((N, 2))
        recordings.append(rf.Recording(u=u, y=y, Ts=0.002))
    return recordings


def fitted(recordings: list[rf.Recording], devices: Sequence[Any] | None) -> dict[str, Any]:
    """Results of a fit, of fits from many starts, and of a fit in windows with a local parameter."""
    joint = rf.joints.paper()
    fit = rf.fit(joint, recordings, devices=devices)
    many = rf.many_starts(joint, recordings, starts=5, short_seconds=None, devices=devices)
    cut = rf.fit(
        joint,
        recordings,
        window_seconds=0.3,
        local=("hub.viscous.coefficient",),
        minimiser=DOGLEG,
        devices=devices,
    )
    return {
        "values": [e.value for e in fit.parameters],
        "std": [e.std for e in fit.parameters if e.free],
        "cut": [e.value for e in cut.parameters],
        "costs": many.costs.tolist(),
    }


def alone(rows: jax.Array) -> jax.Array:
    """A loop over each row. Two devices have two of four rows each, and neither should wait for the other."""
    return jax.lax.map(lambda n: jax.lax.while_loop(lambda k: k < n, lambda k: k + 1, 0), rows)


def main() -> None:
    """Fit on one and on two devices, and list the collective operations in the program of `alone`."""
    jax.config.update("jax_num_cpu_devices", 2)
    at_work: list[int] = []

    def watched(function: Any, mesh: Any) -> Any:
        at_work.append(mesh.size if mesh else 1)
        return spread(function, mesh)

    problem.spread = many_starts.spread = watched
    recordings = recorded()
    one = fitted(recordings, jax.devices()[:1])
    at_work.clear()
    two = fitted(recordings, None)
    text = jax.jit(spread(alone, mesh_of())).lower(np.arange(4)).compile().as_text()
    waits = [word for word in ("all-gather", "all-reduce", "collective") if word in text]
    print(json.dumps({"one": one, "two": two, "devices": sorted(set(at_work)), "waits": waits}))


if __name__ == "__main__":
    main()
