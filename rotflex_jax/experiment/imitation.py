"""How well one machine can pass for another: the exact inner problem of an experiment's worth.

The rival B is fitted to a run of A by Gauss-Newton steps, each an exact linear least squares over all that a
new recording leaves open: B's shape, every free parameter of the machine, first state, offset, bias.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rotflex_jax.experiment.hypotheses import Hypothesis
from rotflex_jax.fit.linear import factor
from rotflex_jax.mechanism import Mechanism, Solver, free_run, predictor_run
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.parameters import Transform
from rotflex_jax.precision import double_precision

# A fit ends when a further step promises less than this share of what is left, or this much [nat].
SHARE, NATS, STEPS = 2e-3, 0.01, 25
# Steps in a row that gain no more than that before a fit counts as stuck.
IDLE = 2
# Largest step of an unconstrained coordinate; directions weaker than this share are not moved.
LONGEST, RANK = 1.0, 1e-7


@dataclasses.dataclass(frozen=True)
class Imitation:
    """A rival at its best.

    Attributes:
        numbers: Unconstrained values of what was moved, then the first state.
        nats: Half the squared whitened difference that remains after an exact projection [nat].
        remainder: Whitened innovations of the rival on the run of the truth (N, C).
        open: What a further step still promises [nat]; small where the fit has converged.
        steps: Gauss-Newton steps taken.
    """

    numbers: np.ndarray
    nats: float
    remainder: np.ndarray
    open: float
    steps: int

    @property
    def converged(self) -> bool:
        """Whether a further step promises next to nothing."""
        return self.open <= max(SHARE * self.nats, NATS)


def truth(h: Hypothesis, u: np.ndarray, Ts: float) -> np.ndarray:
    """Outputs (N, C) of a hypothesis from rest, without noise."""
    with double_precision():
        values = jnp.asarray(h.mechanism.values)
        run = _truth(h.mechanism.structure, h.solver, values, jnp.asarray(u), jnp.asarray(float(Ts)))
        return np.asarray(run)


@kept(static=2)
def _truth(structure: Mechanism, solver: Solver, values: jax.Array, u: jax.Array, Ts: jax.Array) -> jax.Array:
    gates = jnp.ones(len(structure.effects), u.dtype)
    return free_run(structure, solver, values, gates, _rest(structure, u), u, Ts)[1]


def _rest(structure: Mechanism, like: jax.Array) -> jax.Array:
    return jnp.asarray(rest_state(structure, np.float64), like.dtype)


@dataclasses.dataclass(frozen=True)
class _Rival:
    """What of a hypothesis is static in a compiled program."""

    structure: Mechanism
    solver: Solver
    moved: tuple[int, ...]

    def whitened(
        self, numbers: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
    ) -> jax.Array:
        """Whitened innovations (N, C) on a run `y` under the voltage `u`."""
        values, K, L = fixed
        count = len(self.moved)
        place = np.array(self.moved)
        specs = self.structure.parameter_specifications
        mine = Transform.of([specs[i] for i in self.moved]).constrain(numbers[:count])
        values = values.at[place].set(mine)
        gates = jnp.ones(len(self.structure.effects), u.dtype)
        x0 = _rest(self.structure, u).at[: len(numbers) - count].set(numbers[count:])
        seen = jnp.ones_like(u)
        y_hat = predictor_run(self.structure, self.solver, values, gates, x0, u, y, seen, K, Ts)[1]
        return (y - y_hat) @ L.T


@kept(static=1)
def _whitened(
    rival: _Rival, numbers: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
) -> Any:
    return rival.whitened(numbers, fixed, u, y, Ts)


@kept(static=1)
def _with_slopes(
    rival: _Rival, numbers: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
) -> Any:
    def run(x: jax.Array) -> jax.Array:
        return rival.whitened(x, fixed, u, y, Ts)

    return jax.vmap(lambda way: jax.jvp(run, (numbers,), (way,)), out_axes=(None, -1))(jnp.eye(len(numbers)))


@kept(static=3)
def _pull(
    structure: Mechanism, solver: Solver, rival: _Rival, numbers: Any, u: jax.Array, Ts: jax.Array
) -> Any:
    """Slope along the voltage; the rival's numbers held."""
    values, moved, fixed, share, weight = numbers

    def worth(u: jax.Array) -> jax.Array:
        y = _truth(structure, solver, values, u, Ts)
        left = 0.5 * jnp.sum(rival.whitened(moved, fixed, u, y, Ts) ** 2)
        return share * left + jnp.sum(weight * y)

    return jax.grad(worth)(u)


def _parts(h: Hypothesis) -> tuple[_Rival, Any]:
    fixed = tuple(map(jnp.asarray, (h.mechanism.values, h.K, h.L)))
    return _Rival(h.mechanism.structure, h.solver, h.moved), fixed


def imitate(
    rival: Hypothesis, u: np.ndarray, y: np.ndarray, Ts: float, start: np.ndarray | None = None
) -> Imitation:
    """The rival fitted to a run of the truth.

        nats = min over numbers of  1/2 sum_k |L (y_k - y_hat_k)|^2

    Args:
        rival: Who imitates.
        u: Voltage (N,) [V].
        y: Run of the truth (N, C), without noise.
        Ts: Sampling period [s].
        start: Numbers to begin with; the rival's own if None.
    """
    numbers = rival.start if start is None else start
    with double_precision():
        part, fixed = _parts(rival)
        data = tuple(map(jnp.asarray, (u, y, float(Ts))))
        damping, cost, steps, idle = 1e-6, np.inf, 0, 0
        kept: Any = None
        trial = numbers
        while steps < STEPS:
            w, J = map(np.asarray, _with_slopes(part, jnp.asarray(trial), fixed, *data))
            new = 0.5 * float(np.sum(w**2))
            steps += 1
            if np.isfinite(new) and new <= cost and np.all(np.isfinite(J)):
                gain = cost - new
                numbers, cost, damping = trial, new, max(damping / 10, 1e-9)
                kept = (w, _best_step(w, J, 0.0), J)
                promised = 0.5 * float(np.sum((w.ravel() + J.reshape(w.size, -1) @ kept[1]) ** 2))
                if cost - promised <= max(SHARE * promised, NATS):
                    break
                # A law with corners promises again and again what it does not keep.
                idle = idle + 1 if gain <= max(SHARE * new, NATS) else 0
                if idle == IDLE:
                    break
            else:
                damping = max(damping * 30, 1e-4)
                if damping > 1e6 or kept is None:
                    break
            step = _best_step(kept[0], kept[2], damping)
            trial = numbers + np.clip(step, -LONGEST, LONGEST)
    if kept is None:
        return Imitation(numbers, np.inf, np.full_like(y, np.inf), np.inf, steps)
    w, step, J = kept
    left = w.ravel() + J.reshape(w.size, -1) @ step
    nats = 0.5 * float(left @ left)
    return Imitation(numbers, nats, w, cost - nats, steps)


def best_imitation(
    rival: Hypothesis, u: np.ndarray, y: np.ndarray, Ts: float, starts: Sequence[np.ndarray]
) -> Imitation:
    """The imitation that leaves least, of those from several starts; arguments as in `imitate`."""
    return min((imitate(rival, u, y, Ts, start) for start in starts), key=lambda i: i.nats)


def _best_step(w: np.ndarray, J: np.ndarray, damping: float) -> np.ndarray:
    """The step that takes most away to first order; exact where there is no damping."""
    A, r = J.reshape(w.size, -1), w.ravel()
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    R = factor(np.column_stack([A / size, r]))
    top, b = R[:-1, :-1], R[:-1, -1]
    if damping:
        top = np.vstack([top, np.sqrt(damping) * np.eye(len(size))])
        b = np.concatenate([b, np.zeros(len(size))])
    return -np.linalg.lstsq(top, b, rcond=RANK)[0] / size


def pull(
    true: Hypothesis,
    rival: Hypothesis,
    numbers: np.ndarray,
    u: np.ndarray,
    Ts: float,
    share: float = 1.0,
    weight: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Slope (N,) of `share * nats + sum weight * y` along the voltage [1/V], the rival at its best.

    At the minimum over the rival's numbers their own slopes vanish, so the slope of the minimum is the slope
    with the numbers held.

    Args:
        true: Whose run is imitated.
        rival: Who imitates.
        numbers: The rival's best numbers under this voltage.
        u: Voltage (N,) [V].
        Ts: Sampling period [s].
        share: Factor of the nats.
        weight: Factors of the run of the truth (N, C).
    """
    with double_precision():
        part, fixed = _parts(rival)
        m = true.mechanism
        weight = np.broadcast_to(np.asarray(weight, float), (len(u), len(m.channels)))
        held = (m.values, numbers, fixed, float(share), weight)
        args = jax.tree.map(jnp.asarray, (held, u, float(Ts)))
        return np.asarray(_pull(m.structure, true.solver, part, *args))
