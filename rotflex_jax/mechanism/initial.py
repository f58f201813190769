"""The state that a recording's first samples tell, by a short least-squares fit through the simulator."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.programs import kept
from rotflex_jax.mechanism.simulate import Solver, free_run
from rotflex_jax.precision import double_precision

# Stretches of one call at least; short as they are, more of them cost next to nothing.
TOGETHER = 8


def rough_state(structure: Mechanism, y: np.ndarray, Ts: float) -> np.ndarray:
    """Positions and speeds from a straight line through the samples.

    What the sensors leave open is taken from the springs, which are relaxed, and is zero where there is
    none. Speeds come from the slopes of positions before they come from sensors of speed, whose sign a
    rectifier may hide.
    """
    layout = Layout.of(structure)
    t = np.arange(len(y)) * Ts
    slope, start = np.polyfit(t, y, 1) if len(y) > 1 else (0 * y[0], y[0])
    rows = np.array(layout.output_rows)
    n, is_position = layout.n, np.any(np.array(layout.output_rows)[:, : layout.n] != 0, axis=1)
    C, V = rows[is_position, :n], rows[~is_position, n:]
    ports = {e.at for e in structure.effects if e.name == "spring"}
    springs = np.array([structure.port_vectors[p] for p in sorted(ports)]).reshape(-1, n)
    relaxed = np.zeros(len(springs))
    q = _stepwise([(C, start[is_position]), (springs, relaxed)], n)
    dq = _stepwise([(C, slope[is_position]), (springs, relaxed), (V, start[~is_position])], n)
    return np.concatenate([q, dq])


def _stepwise(rows: list[tuple[np.ndarray, np.ndarray]], n: int) -> np.ndarray:
    """The smallest `x` with `A x = b` for the first pair, then for the next as far as that leaves it open."""
    x, free = np.zeros(n), np.eye(n)
    for A, b in rows:
        left = A @ free
        x = x + free @ np.linalg.pinv(left) @ (b - A @ x)
        free = free @ scipy.linalg.null_space(left)
    return x


@kept(static=2)
def _refine(structure, solver, values, gates, guess, hidden, u, y, Ts):  # noqa: ANN001, ANN202
    """Damped Gauss-Newton on all stretches at once.

    Slopes are secants: stretches are short, and the derivative of the simulation would take longer to
    compile than all the runs take.
    """
    W, m = guess.shape
    reach = 1e-6
    nudges = jnp.concatenate([jnp.zeros((1, m)), reach * jnp.eye(m)])
    run = functools.partial(free_run, structure, solver)
    runs = jax.vmap(run, in_axes=(None, None, 0, 0, None))

    def errors(states):  # noqa: ANN001, ANN202 - (W, V, m) -> (W, V, samples * C)
        V = states.shape[1]
        flat = states.reshape(W * V, m)
        start = jnp.concatenate([flat, jnp.repeat(hidden, V, axis=0)], axis=1)
        y_hat = runs(values, gates, start, jnp.repeat(u, V, axis=0), Ts)[1]
        return (y_hat.reshape(W, V, *y.shape[1:]) - y[:, None]).reshape(W, V, -1)

    def iterate(_, state):  # noqa: ANN001, ANN202
        s, damping, previous, kept = state
        e = errors(s[:, None] + nudges[None])
        r, J = e[:, 0], (e[:, 1:] - e[:, :1]) / reach
        cost = jnp.sum(r**2, axis=1)
        better = cost <= previous
        damping = jnp.where(better, damping / 10, damping * 10)
        kept = jnp.where(better[:, None], s, kept)
        H = jnp.einsum("wik,wjk->wij", J, J)
        # A trace of damping also decides what a stretch cannot tell: such directions stay put.
        D = jnp.diagonal(H, axis1=1, axis2=2) * damping[:, None] + 1e-9 * jnp.max(H, axis=(1, 2))[:, None]
        step = jnp.linalg.solve(
            H + D[:, :, None] * jnp.eye(m)[None], -jnp.einsum("wik,wk->wi", J, r)[..., None]
        )
        moved = jnp.where(better[:, None], s + step[..., 0], (s + kept) / 2)
        return moved, damping, jnp.minimum(cost, previous), kept

    start = (guess, jnp.full(W, 1e-2), jnp.full(W, jnp.inf), guess)
    return jax.lax.fori_loop(0, 25, iterate, start)[3]


def initial_states(
    mechanism: Mechanism,
    solver: Solver,
    gates: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    Ts: float,
    hidden: np.ndarray | None = None,
) -> np.ndarray:
    """First states (W, n) of W stretches of a recording, each by itself.

    Positions and speeds are fitted; errors of the channels count in their own units. States that no
    sensor shows (memories, motor current, modes of a part) are given.

    Args:
        mechanism: Model.
        solver: Integration rule.
        gates: One factor per effect.
        u: Voltage (W, m) [V].
        y: Measured outputs (W, m, C).
        Ts: Sampling period [s].
        hidden: What follows positions and speeds in the first states; at rest if None.
    """
    structure = mechanism.structure
    if hidden is None:
        rest = rest_state(structure, np.float64)[2 * Layout.of(structure).n :]
        hidden = np.tile(rest, (len(u), 1))
    guess = np.array([rough_state(structure, stretch, Ts) for stretch in y])
    # Filled up with copies of the last, so that few numbers of stretches are compiled for.
    rows = np.minimum(np.arange(max(TOGETHER, 2 ** (len(u) - 1).bit_length())), len(u) - 1)
    with double_precision():
        stretches = map(jnp.asarray, (guess[rows], hidden[rows], u[rows], y[rows], np.float64(Ts)))
        numbers = map(jnp.asarray, (mechanism.values, gates))
        found = np.asarray(_refine(structure, solver, *numbers, *stretches))
    return np.concatenate([found[: len(u)], hidden], axis=1)
