"""The grey-box fit: parameters of the physics, first states and bounds, by Levenberg-Marquardt."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from rotflex_jax.errors import InputError
from rotflex_jax.fit.descent import NATS, Given, Moved, descend, residuals_and_slopes
from rotflex_jax.fit.estimates import report
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.fit.residuals import Coordinates, Data, first_states, sensor_noise, stack
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Mechanism, kalman_gains
from rotflex_jax.mechanism.linearise import inverse_mass, linearise
from rotflex_jax.model import Model, window_starts
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

if TYPE_CHECKING:
    from rotflex_jax.fit.compressed import Minimiser

Progress = Callable[[str], None]

# A stage that only leads to the next one ends where steps gain less than this [nat].
NEAR = 1.0


# Matrices here are small: threads of a linear algebra library only wait for one another.
@threadpool_limits.wrap(limits=1, user_api="blas")
def fit(
    mechanism: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    *,
    process_noise: Mapping[str, float] | None = None,
    local: Sequence[str] = (),
    first: Literal["fitted", "measured"] = "fitted",
    window_seconds: float | None = None,
    max_steps: int = 60,
    minimiser: "Minimiser | None" = None,
    progress: Progress | None = None,
    throw: bool = False,
) -> Fit:
    """Fit the free parameters of a mechanism to recordings.

        minimise  sum_k |(y_k - y_hat_k) / s|^2   over free parameters and first states

    `y_hat` is a free run, or, with `process_noise`, the prediction of a steady Kalman filter whose
    model admits white torques of that intensity. A free run asks the model to be right over the whole
    recording; where physics is missing, it bends the parameters to hide that, and a prediction bends
    them less. The fit starts with short predictions, which are easy to get right from a distant start,
    and ends with what was asked for. The scale `s` of each channel is the deviation of its residuals.

    Args:
        mechanism: What to fit; its numbers are the start, its trusted parameters are held.
        recordings: One or several; parameters are common, first states are each recording's own.
        process_noise: Port -> intensity of the process torque [(N m)^2 s]; None for a free run.
        local: Full names of parameters that each recording has for itself, an offset for instance.
        first: Whether first states are fitted, or held at what the first `n_init` samples tell: where
            nothing pulls the machine back, a free first position hides a drift of the model.
        window_seconds: Begin anew every so often [s], each time with a first state of its own and with
            memories at rest: the numbers with which free runs of that length are best.
        max_steps: Most iterations of each stage.
        minimiser: Solver of optimistix in the place of the toolkit's own Levenberg-Marquardt, for instance
            `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`.
        progress: Called with a line of text now and then.
        throw: Raise instead of reporting a failure in `status`.

    Returns:
        Fit, whose model has the fitted numbers, of a local parameter the mean over recordings;
        `local` has each recording's own and `model_of` the model with them.

    Raises:
        InputError: Nothing to fit, a local name that is not a free parameter, or a channel that moves
            against the model.
        RuntimeError: The fit failed and `throw` is set.
    """
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    listed = [recordings] if isinstance(recordings, Recording) else list(recordings)
    m = model.mechanism
    names = m.parameter_names
    for name in local:
        if name not in m.free_names:
            raise InputError(
                f"Parameter {name!r} was to be local to each recording, but the free parameters are "
                f"{', '.join(m.free_names)}; name one of these."
            )
    if not m.free_names:
        raise InputError("All parameters are trusted, but a fit needs a free one; release one.")
    check_signs(model, listed)
    indices = tuple(names.index(n) for n in local)
    listed, windows_of = _windows(listed, window_seconds)
    coordinates = Coordinates(m.structure, indices, len(listed), windows_of)
    data = stack(listed, model)
    say = progress or (lambda _: None)
    noise = sensor_noise(listed, model)
    # Torques as large as those of the motion make the filter follow the data within a few samples.
    reach = torque_scale(m, data)
    stages: list[Mapping[str, float] | None] = [everywhere(m, (0.03 * reach) ** 2)]
    stages.append(process_noise)
    flat = coordinates.flatten(m.values, first_states(model, listed))
    free = tuple(names.index(n) for n in m.free_names)
    moved = Moved(coordinates, model.solver, free, first == "fitted")
    history, steps, status, scale = [], 0, "converged", noise
    gates = np.ones(len(m.effects))
    with double_precision():
        given = Given(gates, data, None, scale)
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            for _ in range(3 if last else 1):
                now = m.with_values(coordinates.values(flat).mean(axis=0))
                if first == "measured":
                    there = dataclasses.replace(model, mechanism=now)
                    for r, recording in enumerate(listed):
                        start = there._start(recording)
                        flat[coordinates.state_index(r)] = start[: coordinates.states]
                K = np.stack([kalman_gains(now, [stage or {}], noise, float(Ts))[0] for Ts in data.Ts])
                given = Given(*jax.tree.map(jnp.asarray, (gates, data, K, scale)))
                if minimiser is None:
                    flat, squares, used, status = descend(
                        moved, flat, given, max_steps, say, NATS if last else NEAR
                    )
                else:
                    from rotflex_jax.fit.compressed import minimise  # takes long to import

                    flat, squares, used, status = minimise(minimiser, moved, flat, given, max_steps)
                steps += used
                history.append(float(squares.sum()))
                new = np.sqrt(2 * squares / np.sum(data.seen)) * scale
                settled = np.all(np.abs(np.log(new / scale)) < 0.02)
                scale = np.maximum(new, noise * 0.1)
                if settled or status != "converged":
                    break
        e, J = residuals_and_slopes(moved, jnp.asarray(flat), given._replace(scale=jnp.asarray(scale)))
        if throw and status != "converged":
            raise RuntimeError(f"The fit did not converge: {status}.")
        return report(model, coordinates, flat, moved.index, data, scale, e, J, status, steps, history)


def _windows(recordings: list[Recording], seconds: float | None) -> tuple[list[Recording], tuple[int, ...]]:
    """The recordings cut into windows, and of which recording each is; whole where no length is given."""
    if seconds is None:
        return recordings, ()
    if not seconds > 0:
        raise InputError(
            f"Argument `window_seconds` is {seconds}, but windows need a positive length; give for "
            "instance 2.0, or None for whole recordings."
        )
    cut = []
    for number, r in enumerate(recordings):
        starts = window_starts(r, seconds)[0].tolist()
        cut += [(r.slice(i, j), number) for i, j in zip(starts, [*starts[1:], r.N], strict=True)]
    return [part for part, _ in cut], tuple(number for _, number in cut)


def everywhere(m: Mechanism, intensity: float) -> dict[str, float]:
    """The same intensity along every coordinate; ports that move one coordinate each."""
    chosen: dict[str, float] = {}
    span = np.zeros((0, len(m.coordinates)))
    for port, vector in m.port_vectors.items():
        grown = np.vstack([span, vector])
        if np.linalg.matrix_rank(grown) > len(span):
            span, chosen[port] = grown, intensity
    return chosen


def torque_scale(m: Mechanism, data: Data) -> float:
    """Torque [N m] that the motor gives at the root mean square voltage."""
    n = len(m.coordinates)
    push = np.linalg.solve(inverse_mass(m), linearise(m).B[n : 2 * n])
    level = float(np.sqrt(np.sum(data.u**2 * data.seen) / np.sum(data.seen)))
    return max(float(np.max(np.abs(push))) * level, 1e-6)
