"""The grey-box fit: parameters of the physics, first states and bounds, by Levenberg-Marquardt."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import jax.numpy as jnp
import numpy as np

from rotflex_jax.devices import mesh_of
from rotflex_jax.errors import InputError
from rotflex_jax.fit.descent import Moved, residuals_and_slopes
from rotflex_jax.fit.estimates import report
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.fit.residuals import Coordinates, Data, first_states, sensor_noise, stack
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.fit.stages import Task
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.linearise import inverse_mass, linearise
from rotflex_jax.metrics import window_starts
from rotflex_jax.model import Model
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording
from rotflex_jax.threads import one_thread

if TYPE_CHECKING:
    from rotflex_jax.fit.compressed import Minimiser

Progress = Callable[[str], None]


@one_thread
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
    devices: Sequence[Any] | None = None,
    progress: Progress | None = None,
    throw: bool = False,
) -> Fit:
    """Fit the free parameters of a mechanism to recordings.

        minimise  sum_k |(y_k - y_hat_k) / s|^2   over free parameters and first states

    `y_hat` is a free run, or, with `process_noise`, the prediction of a steady Kalman filter whose
    model admits white torques of that intensity. A free run asks the model to be right over the whole
    recording; where physics is missing, it bends the parameters to hide that, and a prediction bends
    them less. Where the run or prediction at the start misses most of the motion, or the fit does not
    converge, it begins a second time with short predictions, which are easy to get right from afar, and the
    better of the two ends counts. From a near start they would lead away, since they say little of numbers
    that only a long run shows. The scale `s` of each channel is the deviation of its residuals.

    Args:
        mechanism: What to fit; its numbers are the start, its trusted parameters are held.
        recordings: One or several; parameters are common, first states are each recording's own.
        process_noise: Port -> intensity of the process torque [(N m)^2 s]; None for a free run.
        local: Full names of parameters that each recording has for itself, an offset for instance.
        first: Whether first states are fitted, or held at what the first `n_init` samples tell: where
            nothing pulls the machine back, a free first position hides a drift of the model.
        window_seconds: Begin anew every so often [s], each time with a first state of its own and with
            memories at rest: the numbers with which free runs of that length are best.
        max_steps: Most iterations of each descent; there are several, each with the scale of the one before.
        minimiser: Solver of optimistix in the place of the toolkit's own Levenberg-Marquardt, for instance
            `optimistix.Dogleg(rtol=1e-6, atol=1e-6)`.
        devices: Those of this process that several recordings are shared out to; all of them if None, unless
            `jax.default_device` names one.
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
    flat = coordinates.flatten(m.values, first_states(model, listed))
    free = tuple(names.index(n) for n in m.free_names)
    mesh = mesh_of(devices) if len(listed) > 1 else None
    moved = Moved(coordinates, model.solver, free, first == "fitted", mesh)
    task = Task(model, listed, moved, data, noise, first == "measured", max_steps, minimiser, say)
    with double_precision():
        end = task.run(flat, [process_noise])
        if end.doubtful:
            say("fit: once more, from short predictions")
            # Torques as large as those of the motion make the filter follow the data within a few samples.
            short = everywhere(m, (0.03 * torque_scale(m, data)) ** 2)
            end = min(end, task.run(flat, [short, process_noise]), key=lambda e: e.rank)
        e, J = residuals_and_slopes(moved, jnp.asarray(end.flat), end.given)
        if throw and end.status != "converged":
            raise RuntimeError(f"The fit did not converge: {end.status}.")
        return report(task, end, e, J)


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
