"""Torques that a model does not know of, estimated from recordings by a Kalman smoother."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.fit.greybox import everywhere, torque_scale
from rotflex_jax.fit.residuals import Data, first_states, sensor_noise, stack
from rotflex_jax.latent.intensity import Intensities
from rotflex_jax.latent.pushed import Push, PushedStep, followed, linear_model
from rotflex_jax.latent.result import LatentTorque, assembled
from rotflex_jax.latent.smoother import Linear, Start
from rotflex_jax.mechanism import Mechanism, kalman_gains
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.model import Model
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

Progress = Callable[[str], None]

# Times that the model is linearised anew along the motion just found, at most.
TURNS = 4
# A torque smaller than this share of the motor's is none at all.
NOTHING = 1e-6


def latent_torque(
    model: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    ports: Sequence[str] | None = None,
    *,
    progress: Progress | None = None,
) -> LatentTorque:
    """Estimate the torques that a model lacks, from what was measured.

        x[k+1] = F(x[k], u[k], d[k]),   d[k+1] = exp(-Ts / T) d[k] + w[k],   y[k] = h(x[k]) + v[k]

    Each port gets an unknown torque `d`, a random walk that fades over the length `T` of the longest
    recording (an Ornstein-Uhlenbeck process). Its intensity is chosen by maximum likelihood; where the
    model is right it falls to nothing. Mean and deviation of `d` given all samples come from a smoother
    along the motion, about which a nonlinear model is linearised anew until the motion settles.

    The numbers of the model are taken as they are: fit it first. What the fit already bent to imitate the
    missing effect (a damper takes the slope of a friction) is not in the torque; `given_back` adds it.
    Not for effects that are no torque: a sensor error, a delay.

    Args:
        model: Fitted model.
        recordings: One or several.
        ports: Where torques act; as few as push every coordinate if None (`hub` and `joint`).
        progress: Called with a line of text now and then.

    Returns:
        Torques with their deviations, positions and speeds of their ports.

    Raises:
        InputError: No recording, a channel that the model lacks, ports that do not exist or push alike.

    Source: B. Bell, SIAM J. Optim. 4, 1994 (the iterated smoother); T. Rogers and T. Friis, arXiv
    2109.10681, 2021 (unknown forces as states).
    """
    model = model if isinstance(model, Model) else Model(model)
    listed = [recordings] if isinstance(recordings, Recording) else list(recordings)
    m, say = model.mechanism, progress or (lambda _: None)
    chosen = tuple(everywhere(m, 1.0)) if ports is None else _checked(m, ports)
    data, noise = stack(listed, model), sensor_noise(listed, model)
    torque = torque_scale(m, data)
    memory = float(max(r.duration for r in listed))
    decay = np.exp(-data.Ts / memory)
    pushed = m
    for port in chosen:
        pushed = pushed + Push(at=port)
    step = PushedStep(pushed.structure, model.solver, len(chosen))
    switches = np.r_[model._switches(), np.ones(len(chosen))]
    with double_precision():
        values, gates, arrays = jax.tree.map(jnp.asarray, (pushed.values, switches, data))
        S = _followed(model, pushed, listed, data, noise, torque)
        search = Intensities(
            noise=noise,
            grows=memory / 2 * (1 - decay**2),
            memory=memory,
            least=2 * (NOTHING * torque) ** 2 / memory,
            most=torque**2 / float(data.Ts.min()),
            states=S.shape[2],
            ports=len(chosen),
        )
        S = np.concatenate([S, np.zeros((*S.shape[:2], len(chosen)))], axis=2)
        start, level = _begin(S, data.seen), np.full(len(chosen), np.sqrt(search.least * search.most))
        std, lines, nats = S, None, np.zeros(len(chosen))
        for turn in range(TURNS):
            new = linear_model(step, values, gates, jnp.asarray(S), arrays, jnp.asarray(decay))
            if lines is not None and _alike(lines, new):
                break
            lines = new
            level = search.likeliest(lines, start, level, 10.0 if turn else 1e3)
            say("latent torque: " + ", ".join(f"{p} {q:.2g}" for p, q in zip(chosen, level, strict=True)))
            S, std = search.smooth(lines, start, level)
            nats = search.gains(lines, start, level)
    return assembled(model, listed, chosen, (S, std), level, nats, torque)


def _checked(m: Mechanism, ports: Sequence[str]) -> tuple[str, ...]:
    """Ports that exist and push in different ways."""
    known, listed = m.port_vectors, (ports,) if isinstance(ports, str) else tuple(ports)
    for port in listed:
        if port not in known:
            raise InputError(
                f"Port {port!r} was asked for, but the mechanism has {', '.join(known)}; name one of these."
            )
    if not listed or np.linalg.matrix_rank([known[p] for p in listed]) < len(listed):
        raise InputError(
            f"The ports {', '.join(listed) or 'none'} were given, but their torques must push in different "
            f"ways to be told apart; give up to {len(m.coordinates)} ports of different directions."
        )
    return listed


def _followed(
    model: Model,
    pushed: Mechanism,
    recordings: Sequence[Recording],
    data: Data,
    noise: np.ndarray,
    torque: float,
) -> np.ndarray:
    """States (R, N, n) near what was measured, where the first linearisation is made."""
    m = model.mechanism
    x0 = np.tile(rest_state(m.structure, np.float64), (len(recordings), 1))
    first = first_states(model, recordings)
    x0[:, : first.shape[1]] = first
    near = everywhere(m, (0.03 * torque) ** 2)
    K = np.stack([kalman_gains(m, [near], noise, float(Ts))[0] for Ts in data.Ts])
    count = len(pushed.effects) - len(m.effects)
    switches = np.r_[model._switches(), np.ones(count)]
    arrays = jax.tree.map(jnp.asarray, (pushed.values, switches, x0, data, K))
    return np.asarray(followed(pushed.structure, model.solver, *arrays))


def _begin(S: np.ndarray, seen: np.ndarray) -> Start:
    """First states: as followed, and as uncertain as they vary over the recording."""
    variance = np.array([np.var(x[s > 0], axis=0) for x, s in zip(S, seen, strict=True)])
    # A state that never moves may still not be where it is thought to be.
    return Start(S[:, 0], np.maximum(variance, 1e-6 * variance.max(axis=1, keepdims=True)))


def _alike(a: Linear, b: Linear) -> bool:
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-12) for x, y in zip(a, b, strict=True))
