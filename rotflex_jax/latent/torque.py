"""Torques that a model lacks, estimated from recordings by an iterated Kalman smoother."""

from collections.abc import Sequence

import jax
import numpy as np

from rotflex_jax import checks
from rotflex_jax.checks import Progress
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import Dataset, prepare, process_noise_ports, with_common_constants
from rotflex_jax.latent.result import LatentTorque, latent_torque_result
from rotflex_jax.latent.smoother import (
    AugmentedStep,
    InitialDistribution,
    IntensityEstimator,
    LinearTimeVaryingModel,
    UnknownTorque,
    linearise_along,
    predicted_states,
)
from rotflex_jax.mechanism import Mechanism, kalman_gains
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, listed
from rotflex_jax.runtime.xla import double_precision

# Largest number of linearisations along the latest smoothed states.
MAX_LINEARISATIONS = 4
# A torque below this share of the motor's torque counts as zero.
NEGLIGIBLE_TORQUE_SHARE = 1e-6


def latent_torque(
    model: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    ports: Sequence[str] | None = None,
    *,
    progress: Progress | None = None,
) -> LatentTorque:
    """Estimate the torques that a model lacks, from recordings.

        x[k+1] = F(x[k], u[k], d[k]),   d[k+1] = exp(-Ts / T) d[k] + w[k],   y[k] = h(x[k]) + v[k]

    Each port has an unknown torque `d`, a random walk that decays with the length `T` of the longest
    recording as time constant (an Ornstein-Uhlenbeck process). Its intensity is estimated by maximum
    likelihood; if the model is right, it tends to zero. Mean and standard deviation of `d` given all samples
    come from a Kalman smoother along the motion. A nonlinear model is linearised again along the smoothed
    states until they no longer change.

    The parameters of the model are held, so fit it first. The torque does not contain the part of the missing
    effect for which fitted parameters compensate (a damper, for example, compensates for the mean slope of a
    friction); `given_back` adds it. Do not use it for effects that are no torques, such as a sensor error or
    a delay.

    Args:
        model: Fitted model.
        recordings: One or several recordings.
        ports: Ports at which torques act; if None, the smallest set that drives every coordinate (`hub` and
            `joint`).
        progress: Called with a line of text now and then.

    Returns:
        Torques with their standard deviations, and positions and speeds of their ports.

    Raises:
        InputError: If there is no recording, if a recording lacks a channel of the model, if ports do not
            exist, or if their directions are linearly dependent.

    Source: B. Bell, SIAM J. Optim. 4, 1994 (the iterated smoother); T. Rogers and T. Friis, arXiv
    2109.10681, 2021 (unknown forces as states).
    """
    given, say = list(listed(recordings, shortest=SHORTEST_TO_FIT)), checks.progress(progress)
    model = with_common_constants(Model.of(model), given)
    m = model.mechanism
    chosen = tuple(process_noise_ports(m, 1.0)) if ports is None else _checked_ports(m, ports)
    dataset = prepare(model, given)
    data, noise, scale = dataset.data, dataset.noise, dataset.torque_scale
    time_constant = float(max(r.duration for r in given))
    decay = np.exp(-data.Ts / time_constant)
    augmented = m
    for port in chosen:
        augmented = augmented + UnknownTorque(at=port)
    step = AugmentedStep(augmented.structure, model.solver, len(chosen))
    switches = np.r_[model._switches(), np.ones(len(chosen))]
    with double_precision():
        values, gates, arrays = jax.device_put((augmented.values, switches, data))
        S = _predicted_trajectory(model, augmented, dataset)
        estimator = IntensityEstimator(
            noise=noise,
            variance_growth=time_constant / 2 * (1 - decay**2),
            time_constant=time_constant,
            smallest=2 * (NEGLIGIBLE_TORQUE_SHARE * scale) ** 2 / time_constant,
            largest=scale**2 / float(data.Ts.min()),
            states=S.shape[2],
            torques=len(chosen),
        )
        S = np.concatenate([S, np.zeros((*S.shape[:2], len(chosen)))], axis=2)
        start = _initial_distribution(S, data.seen)
        intensity = np.full(len(chosen), np.sqrt(estimator.smallest * estimator.largest))
        std, linear, nats = S, None, np.zeros(len(chosen))
        for k in range(MAX_LINEARISATIONS):
            new = linearise_along(step, values, gates, jax.device_put(S), arrays, jax.device_put(decay))
            if linear is not None and _same_models(linear, new):
                break
            linear = new
            intensity = estimator.maximise(linear, start, intensity, 10.0 if k else 1e3)
            unit = m.units.unit("(N m)^2/s")
            said = ", ".join(f"{p} {q:.2g} {unit}" for p, q in zip(chosen, intensity, strict=True))
            say(f"latent torque: intensity of its random walk {said}")
            S, std = estimator.smooth(linear, start, intensity)
            nats = estimator.gains(linear, start, intensity)
    return latent_torque_result(model, given, chosen, (S, std), intensity, nats, scale)


def _checked_ports(m: Mechanism, ports: Sequence[str]) -> tuple[str, ...]:
    """Ports, checked to exist and to have linearly independent directions."""
    known, wanted = m.port_vectors, (ports,) if isinstance(ports, str) else checks.names(ports, "ports")
    for port in wanted:
        if port not in known:
            raise InputError(
                f"Port {port!r} was asked for, but the mechanism has {', '.join(known)}; name one of these."
            )
    if not wanted or np.linalg.matrix_rank([known[p] for p in wanted]) < len(wanted):
        raise InputError(
            f"The ports {', '.join(wanted) or 'none'} were given, but their torques cannot be "
            f"distinguished; give up to {len(m.coordinates)} ports of different directions."
        )
    return wanted


def _predicted_trajectory(model: Model, augmented: Mechanism, dataset: Dataset) -> np.ndarray:
    """States (R, N, n) of a predictor, along which the model is linearised at first."""
    m, first = model.mechanism, dataset.first_states
    x0 = np.tile(rest_state(m.structure, np.float64), (len(first), 1))
    x0[:, : first.shape[1]] = first
    intensities, gates = [process_noise_ports(m, (0.03 * dataset.torque_scale) ** 2)], model._switches()
    K = np.stack([kalman_gains(m, intensities, dataset.noise, float(Ts), gates)[0] for Ts in dataset.data.Ts])
    switches = np.r_[gates, np.ones(len(augmented.effects) - len(m.effects))]
    arrays = jax.device_put((augmented.values, switches, x0, dataset.data, K))
    return np.asarray(predicted_states(augmented.structure, model.solver, *arrays))


def _initial_distribution(S: np.ndarray, seen: np.ndarray) -> InitialDistribution:
    """Distribution of the first states: values of the predictor, variances of its states over a recording."""
    variance = np.array([np.var(x[s > 0], axis=0) for x, s in zip(S, seen, strict=True)])
    # A state that hardly varies has a least variance, since it is not known exactly.
    return InitialDistribution(S[:, 0], np.maximum(variance, 1e-6 * variance.max(axis=1, keepdims=True)))


def _same_models(a: LinearTimeVaryingModel, b: LinearTimeVaryingModel) -> bool:
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-12) for x, y in zip(a, b, strict=True))
