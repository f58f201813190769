"""Whether every coordinate of a mechanism has an inertia, without which there is no motion to compute."""

import numpy as np
import scipy

from rotflex_jax.effects.kinds import Linear
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.mechanism import Mechanism


def check_movable(mechanism: Mechanism) -> None:
    """Raise `InputError` where a coordinate has no inertia; not while a mechanism is still being built up."""
    n = len(mechanism.coordinates)
    linear = [(e.stamp(), e.at) for e in mechanism.effects if isinstance(e, Linear)]
    rows = [np.sqrt(abs(float(s.inertia))) * np.array(mechanism.port_vectors[at]) for s, at in linear]
    free = np.abs(scipy.linalg.null_space(np.array(rows).reshape(-1, n), rcond=1e-9)).sum(axis=1) > 1e-6
    if not free.any():
        return
    still = " and ".join(q for q, f in zip(mechanism.coordinates, free, strict=True) if f)
    ports = ", ".join(name for name, vector in mechanism.ports if np.any(np.array(vector)[free] != 0))
    raise InputError(
        f"Nothing gives {still} an inertia, so any torque would move it at once; put an Inertia at a port "
        f"that moves it ({ports or 'add one first'})."
    )
