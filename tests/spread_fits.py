"""Fits on two devices, as a program: prints what one device found, what two did, and how many worked."""

import json

import jax
import numpy as np
import optimistix

import rotflex_jax as rf
from rotflex_jax.devices import mesh_of, spread
from rotflex_jax.fit import descent, marquardt

jax.config.update("jax_num_cpu_devices", 2)
DOGLEG = optimistix.Dogleg(rtol=1e-9, atol=1e-9)
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
    ports = {"window_seconds": 0.3, "local": ("hub.viscous.coefficient",)}
    cut = rf.fit(rf.joints.paper(), recordings, devices=devices, minimiser=DOGLEG, **ports)
    found["one" if devices else "two"] = {
        "values": [e.value for e in fitted.parameters],
        "std": [e.std for e in fitted.parameters if e.free],
        "cut": [e.value for e in cut.parameters],
        "costs": many.costs.tolist(),
        "devices": sorted(set(at_work)),
    }


def alone(rows):
    """Of four rows, two devices have two each: neither waits for the other."""
    return jax.lax.map(lambda n: jax.lax.while_loop(lambda k: k < n, lambda k: k + 1, 0), rows)


text = jax.jit(spread(alone, mesh_of())).lower(np.arange(4)).compile().as_text()
found["waits"] = [word for word in ("all-gather", "all-reduce", "collective") if word in text]
print(json.dumps(found))
