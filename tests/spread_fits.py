"""Fits on two devices, as a program: prints what one device found, what two did, and how many worked."""

import json

import jax
import numpy as np

import rotflex_jax as rf
from rotflex_jax.devices import spread
from rotflex_jax.fit import descent, marquardt

jax.config.update("jax_num_cpu_devices", 2)
at_work: list[int] = []


def watched(function, mesh):
    """`spread`, which notes how many devices it was given."""
    at_work.append(mesh.size if mesh else 1)
    return spread(function, mesh)


descent.spread = marquardt.spread = watched

rng = np.random.default_rng(3)
truth = rf.joints.paper(stiffness=1.3, hub_damping=0.007)
recordings = []
# Two devices divide neither three recordings nor five starts.
for N in (400, 700, 500):
    u = np.repeat(rng.uniform(-3, 3, N // 50), 50)
    y = rf.simulate(truth, u, 0.002) + 1e-3 * rng.standard_normal((N, 2))
    recordings.append(rf.Recording(u=u, y=y, Ts=0.002))

found = {}
for devices in (jax.devices()[:1], None):
    at_work.clear()
    fitted = rf.fit(rf.joints.paper(), recordings, devices=devices)
    many = rf.many_starts(rf.joints.paper(), recordings, starts=5, short_seconds=None, devices=devices)
    found["one" if devices else "two"] = {
        "values": [e.value for e in fitted.parameters],
        "std": [e.std for e in fitted.parameters if e.free],
        "costs": many.costs.tolist(),
        "devices": sorted(set(at_work)),
    }
print(json.dumps(found))
