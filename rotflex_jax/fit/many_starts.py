"""The same fit from many starts: which numbers are the answer, and not the nearest dip."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from rotflex_jax.devices import mesh_of
from rotflex_jax.errors import InputError
from rotflex_jax.fit.marquardt import ENOUGH, ROUGHLY, Problem, Reached, descend
from rotflex_jax.fit.residuals import first_states, sensor_noise, stack
from rotflex_jax.fit.signs import check_signs
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.parameters import Transform
from rotflex_jax.precision import double_precision
from rotflex_jax.recording import Recording
from rotflex_jax.threads import one_thread

TOGETHER = 8
"""Starts of a device in one compiled call; progress is told between calls."""
SAME = 1e-3
"""Costs that differ by less than this share belong to one minimum."""


@dataclasses.dataclass(frozen=True, eq=False)
class ManyStarts:
    """Where many starts ended.

    Attributes:
        model: With the numbers of the least cost.
        cost: Half the sum of squared errors there, in units of the sensor's noise.
        costs: Of all that went to the end, the least first (K,).
        values: Parameter values of these (K, P).
        steps: Runs that each of them took on the whole recordings (K,).
        starts: How many there were.
    """

    model: Model
    cost: float
    costs: Float[np.ndarray, " K"]
    values: Float[np.ndarray, "K P"]
    steps: np.ndarray
    starts: int

    @property
    def share(self) -> float:
        """Share of those that went to the end that ended at the least cost."""
        return float(np.mean(self.costs <= self.cost * (1 + SAME)))

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

    All starts are fitted to the beginning of the recordings, which is cheap and has fewer dips, and only
    the best of them to the whole. A step moves no bounded parameter by more than a factor of e. Recordings
    are fitted jointly: parameters are common, first states each recording's own.

    It gives numbers, not intervals: hand the `model` to `fit` for those. Not for a model that is known to
    miss something large: a long free run then has its least cost at wrong numbers, and `fit` with
    `process_noise` does better. Memory is that of the recordings, whatever the starts.

    Args:
        mechanism: What to fit; its numbers are the first start and the middle of the others, its trusted
            parameters are held.
        recordings: One or several.
        starts: How many.
        spread: Each parameter begins within this share of its size, above or below, between 0 and 1; one
            that may be negative within this share of its typical size.
        short_seconds: Beginning of each recording that all starts are fitted to [s]; None for all of it.
        keep: How many of the best go on to the whole.
        max_steps: Most runs of one start in each stage.
        seed: Of the starts.
        devices: Those of this process that the starts are shared out to; all of them if None, unless
            `jax.default_device` names one.
        progress: Called with a line of text now and then.

    Returns:
        The best, and where the others ended.

    Raises:
        InputError: Nothing to fit, numbers out of their range, a channel that moves against the model, or
            no start with a finite error.
    """
    model = mechanism if isinstance(mechanism, Model) else Model(mechanism)
    listed = [recordings] if isinstance(recordings, Recording) else list(recordings)
    m = model.mechanism
    if not m.free_names:
        raise InputError("All parameters are trusted, but a fit needs a free one; release one.")
    for name, value in (("starts", starts), ("keep", keep), ("max_steps", max_steps)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise InputError(f"Argument `{name}` must be a whole number from 1, but is {value!r}; give one.")
    if not 0 < spread < 1:
        raise InputError(
            f"Argument `spread` must lie between 0 and 1, but is {spread!r}; give for instance 0.7."
        )
    if short_seconds is not None and not short_seconds > 0:
        raise InputError(
            f"Argument `short_seconds` must be positive, but is {short_seconds!r}; give for instance 1.5, or "
            "None."
        )
    check_signs(model, listed)
    free = np.array([m.parameter_names.index(n) for n in m.free_names])
    transform = Transform.of(m.parameter_specifications)
    z = transform.unconstrain(_box(m, free, starts, spread, seed))[:, free]
    x0 = np.broadcast_to(first_states(model, listed), (starts, len(listed), 2 * len(m.coordinates)))
    noise = sensor_noise(listed, model)
    say = progress or (lambda _: None)
    stage = functools.partial(
        _stage, model=model, free=free, noise=noise, most=max_steps, mesh=mesh_of(devices), say=say
    )
    short = _beginnings(listed, short_seconds)
    if short is not None:
        found = stage(z, x0, short, ROUGHLY, f"{starts} starts, beginnings")
        best = np.argsort(found.cost)[:keep]
        z, x0 = np.asarray(found.z[best]), np.asarray(found.x0[best])
    found = stage(z, x0, listed, ENOUGH, f"{len(z)} starts, whole recordings")
    order = np.argsort(found.cost)
    if not np.isfinite(found.cost[order[0]]):
        raise InputError(
            "The model runs away from every start, so that none has an error; give numbers that are nearer."
        )
    fitted = dataclasses.replace(model, mechanism=m.with_values(found.values[order[0]]))
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


def _beginnings(recordings: list[Recording], seconds: float | None) -> list[Recording] | None:
    """Their beginnings; None where these are no shorter to speak of."""
    if seconds is None:
        return None
    lengths = [max(round(seconds / r.Ts), 2 * r.n_init) for r in recordings]
    if sum(lengths) > 0.5 * sum(r.N for r in recordings):
        return None
    return [r.slice(0, min(n, r.N)) for r, n in zip(recordings, lengths, strict=True)]


def _stage(
    z: np.ndarray,
    x0: np.ndarray,
    recordings: list[Recording],
    enough: float,
    title: str,
    *,
    model: Model,
    free: np.ndarray,
    noise: np.ndarray,
    most: int,
    mesh: Mesh | None,
    say: Callable[[str], None],
) -> Reached:
    """All starts on some recordings; what is not finite costs infinitely much."""
    parts, mesh = [], mesh if len(z) > 1 else None
    # As many for each device, so that none waits for another: some take sixty runs where others take three.
    size = mesh.size if mesh else 1
    together = size * min(TOGETHER, -(-len(z) // size))
    with double_precision():
        data = stack(recordings, model)
        arrays = type(data)(*(jnp.asarray(part) for part in data))
        problem = Problem(jnp.asarray(model.mechanism.values), jnp.asarray(free), arrays, jnp.asarray(noise))
        for at in range(0, len(z), together):
            pick = np.minimum(np.arange(at, at + together), len(z) - 1)
            found = descend(
                model.mechanism.structure,
                model.solver,
                mesh,
                jnp.asarray(z[pick]),
                jnp.asarray(x0[pick]),
                problem,
                most,
                enough,
            )
            real = min(together, len(z) - at)
            parts.append([np.asarray(part)[:real] for part in found])
            done = Reached(*(np.concatenate(column) for column in zip(*parts, strict=True)))
            say(f"{title}: {len(done.cost)} done, least cost {np.nanmin(done.cost):.1f}")
    return done._replace(cost=np.where(np.isfinite(done.cost), done.cost, np.inf))
