"""How large the signals of recordings are at each port: what a plausible effect is measured by."""

from collections.abc import Sequence

import numpy as np
import scipy

from rotflex_jax.effects.kinds import Linear, Scale
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.mechanism.linearise import inverse_mass
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording


def motion(
    mechanism: Mechanism, y: np.ndarray, Ts: float, smooth: float = 0.03
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Port -> (position, speed) by smoothing measured outputs (N, C) over `smooth` seconds.

    Ports that the measured positions do not determine are left out.
    """
    layout = Layout.of(mechanism.structure)
    rows = np.array(layout.output_rows)
    is_position = np.any(rows[:, : layout.n] != 0, axis=1)
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


def _known_motion(model: Model, recording: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Motion of every port: as measured, or where no sensor tells it, as the model has it."""
    measured = motion(model.mechanism, model.measured(recording).astype(float), recording.Ts)
    silent = {port: v for port, v in model.mechanism.port_vectors.items() if port not in measured}
    if not silent:
        return measured
    n = len(model.mechanism.coordinates)
    states = model.simulate_states(recording)
    if not np.all(np.isfinite(states)):
        return measured
    q, dq = states[:, :n], states[:, n : 2 * n]
    return measured | {port: (q @ np.array(v), dq @ np.array(v)) for port, v in silent.items()}


def at_port(mechanism: Mechanism, port: str) -> tuple[float, float]:
    """Stiffness of the linear springs at a port [N m/rad], and the inertia that a torque there meets."""
    springs = [e for e in mechanism.effects if isinstance(e, Linear) and e.at == port]
    stiffness = sum(float(e.stamp().stiffness) for e in springs)
    p = np.array(mechanism.port_vectors[port])
    return stiffness, float(1 / (p @ inverse_mass(mechanism) @ p))


def scales(model: Model, recordings: Sequence[Recording], torque: float) -> dict[str, Scale]:
    """Port, `input` or channel -> size of its signals.

    Args:
        model: Its ports and outputs.
        recordings: Measured data.
        torque: Torque that moves the machine [N m].
    """
    voltage = max(float(np.max(np.abs(r.u))) for r in recordings)
    mechanism = model.mechanism
    out = {}
    found = [_known_motion(model, r) for r in recordings]
    for port in mechanism.port_vectors:
        known = [m[port] for m in found if port in m]
        speed = max((float(np.sqrt(np.mean(s**2))) for _, s in known), default=1.0)
        position = max((float(np.max(np.abs(q - q.mean()))) for q, _ in known), default=0.1)
        stiffness, inertia = at_port(mechanism, port)
        out[port] = Scale(voltage, max(speed, 1e-6), max(position, 1e-6), torque, stiffness, inertia)
    whole = Scale(voltage, 1.0, 1.0, torque)
    for channel in mechanism.channels:
        y = np.concatenate([model.measured(r)[:, mechanism.channels.index(channel)] for r in recordings])
        out[channel] = Scale(voltage, 1.0, max(float(np.std(y)), 1e-9), torque)
    return out | {"input": whole}
