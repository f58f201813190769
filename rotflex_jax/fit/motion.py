"""Positions and speeds of ports, read off measured outputs."""

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout


def motion(
    mechanism: Mechanism, y: Float[np.ndarray, "N C"], Ts: float, smooth: float = 0.03
) -> dict[str, tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]]:
    """Port -> (position, speed) by smoothing measured outputs over `smooth` seconds.

    Ports that the measured positions do not determine are left out.
    """
    layout = Layout.of(mechanism.structure)
    rows = np.array(layout.output_rows)
    is_position = np.array([q.is_position for q in mechanism.quantities])
    if not is_position.any():
        return {}
    width = max(2 * round(smooth / Ts / 2) + 1, 5)
    width = min(width, len(y) - 1 + len(y) % 2)
    C = rows[is_position, : layout.n]
    position = np.asarray(scipy.signal.savgol_filter(y[:, is_position], width, 3, axis=0))
    speed = np.asarray(scipy.signal.savgol_filter(y[:, is_position], width, 3, deriv=1, delta=Ts, axis=0))
    back, out = np.linalg.pinv(C), {}
    for port, vector in mechanism.port_vectors.items():
        p = np.array(vector) @ back
        if np.allclose(p @ C, vector):
            out[port] = (position @ p, speed @ p)
    return out
