"""Fits from many starts, which show whether parameters are the global minimum or a local one."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import (
    StackedRecordings,
    check_moving,
    first_states,
    sensor_noise,
    stack,
    with_common_constants,
)
from rotflex_jax.fit.plausibility import check_signs
from rotflex_jax.fit.problem import directions, normal_equations
from rotflex_jax.mechanism import Mechanism, Solver
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.sensitivities import RecordingSamples, RunParameters
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import (
    NormalEquations,
    Rules,
    bounded_solution,
    damped,
    minimise_compiled,
    step_limits,
)
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, listed
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision, mesh_of, one_thread, spread

CONVERGED_SHARE = 1e-9
"""A step that would lower the cost by less than this share of it is not taken."""
RANKING_SHARE = 1e-3
"""This share of the cost in the first stage, where starts are only ranked."""


class SharedInputs(NamedTuple):
    """Inputs that all starts have in common.

    Attributes:
        values: Values of all parameters; parameters that are not free keep them.
        free: Indices of the free parameters.
        data: The recordings.
        scale: Size of the error of each channel.
    """

    values: Float[Any, " P"]
    free: Int[Any, " K"]
    data: StackedRecordings
    scale: Float[Any, " C"]


class JointEquations(NamedTuple):
    """Normal equations of R recordings, in K common coordinates and the first state (m,) of each recording.

    A point or a step is a pair of the common coordinates (K,) and the first states (R, m). First states are
    eliminated from the step, since each affects only the samples of its own recording.
    """

    recordings: NormalEquations

    @property
    def cost(self) -> Float[Array, ""]:
        """Half the squared error of all recordings."""
        return jnp.sum(self.recordings.costs)

    def step(
        self, damping: Float[Array, ""], limit: Float[Array, " K"]
    ) -> tuple[tuple[Float[Array, " K"], Float[Array, "R m"]], Bool[Array, ""]]:
        """Damped step, with common coordinates within their limits, and whether a limit shortens it.

        Far from the minimum the linear model is wrong about where the minimum is. Without a limit, two of
        three starts from a wide box do not end at the least cost.
        """
        K, (_, g, H) = len(limit), self.recordings
        common, mixed = damped(jnp.sum(H[:, :K, :K], axis=0), damping), H[:, :K, K:]
        own = damped(H[:, K:, K:], damping)
        # Response of the first states to the parameters, and their own step.
        inner = jnp.linalg.solve(own, jnp.concatenate([jnp.swapaxes(mixed, 1, 2), g[:, K:, None]], axis=2))
        left = common - jnp.sum(jnp.einsum("rkm,rml->rkl", mixed, inner[:, :, :K]), axis=0)
        right = jnp.sum(g[:, :K] - jnp.einsum("rkm,rm->rk", mixed, inner[:, :, K]), axis=0)
        dz, limited = bounded_solution(left, -right, limit)
        return (dz, -inner[:, :, K] - jnp.einsum("rmk,k->rm", inner[:, :, :K], dz)), limited

    def predicted_decrease(self, step: tuple[Float[Array, " K"], Float[Array, "R m"]]) -> Float[Array, ""]:
        """Decrease of the quadratic model along a step."""
        dz, dx0 = step
        each = jnp.concatenate([jnp.broadcast_to(dz, (len(dx0), len(dz))), dx0], axis=1)
        return jnp.sum(self.recordings.predicted_decrease(each))


class StartResults(NamedTuple):
    """Results of the fits from several starts.

    Attributes:
        values: Values of all parameters at the end of each fit.
        x0: First states there.
        cost: Half the sum of squared scaled errors there.
        steps: Number of evaluations of each fit.
        z: Unconstrained coordinates of the free parameters at the end of each fit.
    """

    values: Float[Any, "S P"]
    x0: Float[Any, "S R m"]
    cost: Float[Any, " S"]
    steps: Int[Any, " S"]
    z: Float[Any, "S K"]


@persistent_jit(static=3)
def minimise_starts(
    structure: Mechanism,
    solver: Solver,
    mesh: Mesh | None,
    z: Float[Array, "S K"],
    x0: Float[Array, "S R m"],
    inputs: SharedInputs,
    max_steps: int,
    tolerance: float = CONVERGED_SHARE,
) -> StartResults:
    """Fits from all starts, one after the other on each device.

    In a batch, all would wait for the slowest one, and a single run already uses a core fully.

    Args:
        structure: Mechanism without values; static.
        solver: Integration rule; static.
        mesh: Devices among which the starts are divided; None for one device; static.
        z: Unconstrained coordinates of the free parameters at each start.
        x0: First positions and speeds at each start.
        inputs: Inputs that all starts have in common.
        max_steps: Largest number of evaluations of each fit.
        tolerance: A fit ends if a step would lower the cost by less than this share of it.
    """
    each = functools.partial(_minimise_each, structure, solver)
    return spread(each, mesh)((z, x0), inputs, max_steps, tolerance)


def _minimise_each(
    structure: Mechanism,
    solver: Solver,
    starts: tuple[Array, Array],
    inputs: SharedInputs,
    max_steps: int,
    tolerance: float,
) -> StartResults:
    transform = Transform.of(structure.parameter_specifications)

    def values(z: Array) -> Array:
        whole = jnp.zeros_like(inputs.values).at[inputs.free].set(z)
        return inputs.values.at[inputs.free].set(transform.constrain(whole)[inputs.free])

    def linearise(point: tuple[Array, Array]) -> JointEquations:
        z, x0 = point
        p, slopes = jax.jvp(values, (z,), (jnp.ones_like(z),))
        tangents = directions(structure, slopes, inputs.free, x0.shape[1])
        gates = jnp.ones(len(structure.effects), p.dtype)

        def run(r: Any) -> NormalEquations:
            parameters = RunParameters(p, gates, whole_state(structure, r[0]), None)
            return normal_equations(
                structure, solver, parameters, tangents, RecordingSamples(*r[1]), inputs.scale
            )

        return JointEquations(jax.lax.map(run, (x0, tuple(inputs.data))))

    def one(start: tuple[Array, Array]) -> StartResults:
        (z, x0), equations, progress = minimise_compiled(
            linearise,
            start,
            Rules(enough_share=tolerance),
            limit=step_limits(jnp.asarray(transform.bounded)[inputs.free], start[0]),
            max_steps=max_steps,
        )
        return StartResults(values(z), x0, equations.cost, progress.evaluations, z)

    return jax.lax.map(one, starts)


STARTS_PER_CALL = 8
"""Starts of a device in one compiled call; progress is reported between calls."""
SAME_MINIMUM_SHARE = 1e-3
"""Costs that differ by less than this share belong to one local minimum."""


@dataclasses.dataclass(frozen=True, eq=False)
class ManyStarts:
    """Results of the fits from many starts.

    Attributes:
        model: The model with the parameters of the least cost.
        cost: Least cost: half the sum of squared errors, in units of the sensor noise.
        costs: Costs of all starts that were fitted to the whole recordings, the least first.
        values: Parameter values of these starts.
        steps: Number of evaluations of each of these starts on the whole recordings.
        starts: Number of all starts.
    """

    model: Model
    cost: float
    costs: Float[np.ndarray, " K"]
    values: Float[np.ndarray, "K P"]
    steps: Int[np.ndarray, " K"]
    starts: int

    @property
    def share(self) -> float:
        """Share of the starts fitted to the whole recordings that reached the least cost."""
        return float(np.mean(self.costs <= self.cost * (1 + SAME_MINIMUM_SHARE)))

    def __str__(self) -> str:
        lines = [
            f"{self.starts} starts, {len(self.costs)} of them to the end: cost {self.cost:.4f}, "
            f"reached by {100 * self.share:.0f} %"
        ]
        m = self.model.mechanism
        named = zip(m.parameter_names, m.parameter_specifications, m.values, strict=True)
        lines += [
            f"  {name} = {value:.6g} {s.unit}".rstrip() for name, s, value in named if name in m.free_names
        ]
        return "\n".join(lines)


@one_thread
def many_starts(
    mechanism: Mechanism | Model,
    recordings: Recording | Sequence[Recording],
    *,
    starts: int = 64,
    spread: float = 0.7,
    short_seconds: float | None = 1.5,
    keep: int = 8,
    max_steps: int = 60,
    seed: int = 0,
    devices: Sequence[Any] | None = None,
    progress: Callable[[str], None] | None = None,
) -> ManyStarts:
    """Fit the free parameters of a mechanism from many starts, and keep the best.

        minimise  sum_k |(y_k - y_hat_k) / s|^2   over free parameters and first states, y_hat a free run

    All starts are fitted to the first seconds of the recordings, which takes little time and has fewer local
    minima. Only the best of them are fitted to the whole recordings. A step changes no parameter with one
    bound by more than a factor of e. Recordings are fitted jointly: parameters are common, and each recording
    has its own first state.

    The result has estimates without intervals: give its `model` to `fit` for intervals. Do not use it for a
    model that is known to lack something large: a long free run then has its least cost at wrong parameters,
    and `fit` with `process_noise` is better. The memory needed does not depend on the number of starts.

    Args:
        mechanism: Mechanism to fit. Its values are the first start and the centre of the others, and its
            trusted parameters are held.
        recordings: One or several recordings.
        starts: Number of starts.
        spread: Share of its size, between 0 and 1, within which a parameter starts above or below its value;
            for a parameter without a lower bound, or at zero, share of its typical size.
        short_seconds: Length of the first part of each recording to which all starts are fitted [s]; None for
            all of it.
        keep: Number of the best starts that are fitted to the whole recordings.
        max_steps: Largest number of evaluations of one start in each stage.
        seed: Seed of the random starts.
        devices: Devices of this process among which the starts are divided; all of them if None, unless
            `jax.default_device` names one.
        progress: Called with a line of text now and then.

    Returns:
        The best fit, and the results of the other starts.

    Raises:
        InputError: If there is nothing to fit, if arguments are out of their range, if a channel moves
            against the model, or if no start has a finite error.
    """
    model, say = Model.of(mechanism).without_gates(), checks.progress(progress)
    given = list(listed(recordings, shortest=SHORTEST_TO_FIT))
    m, seed = model.mechanism, checks.whole(seed, "seed", 0, math.inf)
    if not m.free_names:
        raise InputError("All parameters are trusted, but a fit needs a free one; release one.")
    starts, keep, max_steps = (
        checks.whole(value, name, 1)
        for name, value in (("starts", starts), ("keep", keep), ("max_steps", max_steps))
    )
    checks.number(spread, "spread", above=0, below=1, example="0.7")
    if short_seconds is not None:
        checks.positive(short_seconds, "short_seconds", "s", "1.5, or None")
    check_signs(model, given)
    check_moving(model, given)
    model = with_common_constants(model, given)
    m = model.mechanism
    free = np.array([m.parameter_names.index(n) for n in m.free_names])
    transform = Transform.of(m.parameter_specifications)
    z = transform.unconstrain(_box(m, free, starts, spread, seed))[:, free]
    x0 = np.broadcast_to(first_states(model, given), (starts, len(given), 2 * len(m.coordinates)))
    noise = sensor_noise(given, model)
    stage = functools.partial(
        _stage, model=model, free=free, noise=noise, max_steps=max_steps, mesh=mesh_of(devices), say=say
    )
    short = _first_parts(given, short_seconds)
    if short is not None:
        found = stage(z, x0, short, RANKING_SHARE, f"{starts} starts, first seconds")
        best = np.argsort(found.cost)[:keep]
        z, x0 = np.asarray(found.z[best]), np.asarray(found.x0[best])
    found = stage(z, x0, given, CONVERGED_SHARE, f"{len(z)} starts, whole recordings")
    order = np.argsort(found.cost)
    if not np.isfinite(found.cost[order[0]]):
        raise InputError(
            "The model diverges from every start, so that none has an error; give values that are nearer."
        )
    fitted = model.with_values(found.values[order[0]])
    cost = float(found.cost[order[0]])
    return ManyStarts(fitted, cost, found.cost[order], found.values[order], found.steps[order], starts)


def _box(m: Mechanism, free: np.ndarray, starts: int, spread: float, seed: int) -> Float[np.ndarray, "S P"]:
    """Values of all parameters at the starts; the first is the mechanism's own."""
    specs = m.parameter_specifications
    size = np.array(
        [abs(v) if np.isfinite(s.lower) and v else s.typical for v, s in zip(m.values, specs, strict=True)]
    )
    away = np.zeros((starts, len(size)))
    away[1:, free] = np.random.default_rng(seed).uniform(-spread, spread, (starts - 1, len(free)))
    low, high = (np.array([getattr(s, end) for s in specs]) for end in ("lower", "upper"))
    return np.clip(m.values + away * size, low, high)


def _first_parts(recordings: list[Recording], seconds: float | None) -> list[Recording] | None:
    """The first seconds of recordings; None if these are more than half of the whole."""
    if seconds is None:
        return None
    lengths = [max(round(min(seconds / r.Ts, r.N)), 2 * r.n_init) for r in recordings]
    if sum(lengths) > 0.5 * sum(r.N for r in recordings):
        return None
    return [r.slice(0, min(n, r.N)) for r, n in zip(recordings, lengths, strict=True)]


def _stage(
    z: np.ndarray,
    x0: np.ndarray,
    recordings: list[Recording],
    tolerance: float,
    title: str,
    *,
    model: Model,
    free: np.ndarray,
    noise: np.ndarray,
    max_steps: int,
    mesh: Mesh | None,
    say: Callable[[str], None],
) -> StartResults:
    """Fits from all starts to some recordings; a cost that is not finite becomes infinite."""
    parts, mesh = [], mesh if len(z) > 1 else None
    # The same number of starts for each device, which fits them one after the other: some fits take sixty
    # evaluations, others three.
    size = mesh.size if mesh else 1
    together = size * min(STARTS_PER_CALL, -(-len(z) // size))
    with double_precision():
        shared = model.mechanism.values, free, stack(recordings, model), noise
        inputs = SharedInputs(*jax.device_put(shared))
        for at in range(0, len(z), together):
            pick = np.minimum(np.arange(at, at + together), len(z) - 1)
            found = minimise_starts(
                model.mechanism.structure,
                model.solver,
                mesh,
                jax.device_put(z[pick]),
                jax.device_put(x0[pick]),
                inputs,
                max_steps,
                tolerance,
            )
            real = min(together, len(z) - at)
            parts.append([np.asarray(part)[:real] for part in found])
            done = StartResults(*(np.concatenate(column) for column in zip(*parts, strict=True)))
            say(f"{title}: {len(done.cost)} done, least cost {np.nanmin(done.cost):.1f}")
    return done._replace(cost=np.where(np.isfinite(done.cost), done.cost, np.inf))
