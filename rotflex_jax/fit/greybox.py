"""The grey-box fit: parameters of the physics, first states and bounds, by Levenberg-Marquardt."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from rotflex_jax.errors import InputError
from rotflex_jax.fit.estimates import report
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.fit.residuals import Coordinates, Data, first_states, predicted, sensor_noise, stack
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Mechanism, Solver, kalman_gains
from rotflex_jax.mechanism.assembly import equations
from rotflex_jax.model import Model, window_starts
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording

Progress = Callable[[str], None]

# A step is the last when it lowers the negative log-likelihood by less than this [nat]. A relative
# tolerance would stop a long recording many nats short of the optimum.
NATS = 0.1
# What optimistix says at length.
UNSOLVED = "stopped: a step has no finite solution; the model diverges near these numbers"


@dataclasses.dataclass(frozen=True)
class _Problem:
    """Scaled residuals as a function of the moved coordinates; hashable, so compiled once."""

    coordinates: Coordinates
    solver: Solver

    def __call__(self, moved: jax.Array, args: Any) -> jax.Array:
        flat, index, gates, data, K, scale = args
        values, x0 = self.coordinates.split(flat.at[index].set(moved))
        y_hat = predicted(self.coordinates.structure, self.solver, values, x0, gates, data, K)
        e = (data.y - y_hat) * data.seen[:, :, None] / scale[None, None, :]
        return e.ravel()


@functools.partial(jax.jit, static_argnums=(0, 3))
def _some_steps(problem: _Problem, moved: jax.Array, args: Any, count: int) -> Any:
    """At most `count` Levenberg-Marquardt steps."""
    solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
    sol = optx.least_squares(problem, solver, moved, args, max_steps=count, throw=False)
    steps = sol.stats["num_steps"]
    return sol.value, jnp.sum(problem(sol.value, args) ** 2) / 2, steps, sol.result


@functools.partial(jax.jit, static_argnums=0)
def _residuals_and_slopes(problem: _Problem, moved: jax.Array, args: Any) -> Any:
    return problem(moved, args), jax.jacfwd(problem)(moved, args)


def fit(
    mechanism: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    *,
    process_noise: Mapping[str, float] | None = None,
    local: Sequence[str] = (),
    first: Literal["fitted", "measured"] = "fitted",
    window_seconds: float | None = None,
    max_steps: int = 60,
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
    free = [names.index(n) for n in m.free_names]
    index = np.array(
        [i for i in free if i not in indices]
        + [coordinates.local_index(r, i) for r in range(coordinates.owning) for i in indices]
        + [i for r in range(len(listed)) for i in coordinates.state_index(r) if first == "fitted"]
    )
    history, steps, status, scale = [], 0, "converged", noise
    with double_precision():
        problem = _Problem(coordinates, model.solver)
        args: Any = ()
        for number, stage in enumerate(stages):
            last = number == len(stages) - 1
            for _ in range(3 if last else 1):
                now = m.with_values(np.asarray(coordinates.split(jnp.asarray(flat))[0]).mean(axis=0))
                if first == "measured":
                    there = dataclasses.replace(model, mechanism=now)
                    for r, recording in enumerate(listed):
                        start = there._start(recording)
                        flat[coordinates.state_index(r)] = start[: coordinates.states]
                K = np.stack([kalman_gains(now, [stage or {}], noise, float(Ts))[0] for Ts in data.Ts])
                gates = jnp.ones(len(m.effects), jnp.float64)
                args = jax.tree.map(jnp.asarray, (flat, index, gates, data, K, scale))
                flat, cost, used, status = _levenberg_marquardt(problem, flat, args, max_steps, say)
                steps += used
                history.append(cost)
                new = _deviation(problem, flat, args, scale)
                settled = np.all(np.abs(np.log(new / scale)) < 0.02)
                scale = np.maximum(new, noise * 0.1)
                if settled or status != "converged":
                    break
        args = (*args[:-1], jnp.asarray(scale))
        e, J = _residuals_and_slopes(problem, jnp.asarray(flat[index]), args)
        if throw and status != "converged":
            raise RuntimeError(f"The fit did not converge: {status}.")
        return report(model, coordinates, flat, index, data, scale, e, J, status, steps, history)


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
    with double_precision():
        eq = equations(m, jnp.ones(len(m.effects)))
        n = len(m.coordinates)
        push = np.linalg.solve(np.asarray(eq.inverse_mass), np.asarray(eq.B)[n : 2 * n])
    level = float(np.sqrt(np.sum(data.u**2 * data.seen) / np.sum(data.seen)))
    return max(float(np.max(np.abs(push))) * level, 1e-6)


def _levenberg_marquardt(
    problem: _Problem, flat: np.ndarray, args: Any, max_steps: int, say: Progress
) -> tuple[np.ndarray, float, int, str]:
    """Optimistix, a few steps at a time so that a long fit shows where it is and stops on nats.

    Starting anew costs nothing: the damping it begins with is far below the curvature.
    """
    index = np.asarray(args[1])
    moved = jnp.asarray(flat[index])
    cost = float(jnp.sum(_whole(problem, moved, args) ** 2) / 2)
    if not np.isfinite(cost):
        return flat, cost, 0, "diverged: the model error at the start is not finite"
    used, status = 0, f"stopped after {max_steps} steps"
    while used < max_steps:
        count = min(16, max_steps - used)
        new, new_cost, steps, result = _some_steps(problem, moved, args, count)
        used += int(steps)
        gain = cost - float(new_cost)
        if gain > 0:
            moved, cost = new, float(new_cost)
        say(f"fit: {used} steps, cost {cost:.1f}")
        if not gain > NATS and count == 16:
            bad = result not in (optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached)
            status = UNSOLVED if bad else "converged"
            break
    out = flat.copy()
    out[index] = np.asarray(moved)
    return out, cost, used, status


def _deviation(problem: _Problem, flat: np.ndarray, args: Any, scale: np.ndarray) -> np.ndarray:
    """Root mean square residual of each channel."""
    e = np.asarray(_whole(problem, jnp.asarray(flat[np.asarray(args[1])]), args))
    data: Data = args[3]
    e = e.reshape(data.y.shape) * scale
    return np.sqrt(np.sum(e**2, axis=(0, 1)) / np.sum(np.asarray(data.seen)))


@functools.partial(jax.jit, static_argnums=0)
def _whole(problem: _Problem, moved: jax.Array, args: Any) -> jax.Array:
    return problem(moved, args)
