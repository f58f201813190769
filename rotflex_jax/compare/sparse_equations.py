"""Terms of sparse equations of motion, their simulation, and free runs over many segments at once."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import require_period
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision


@dataclasses.dataclass(frozen=True)
class Terms:
    """A library of terms in outputs, their speeds and the input.

        1, u, q, v, v|v|, tanh(v / width) as a sign, the last for sums of two speeds too,
        and with degree 3 also q^2, q^3, v^3

    If the equations give rates of the outputs (order 1), the outputs take the place of the speeds v, and
    there are no terms in q.

    Attributes:
        channels: Names of the outputs.
        order: 2 if the equations give accelerations of the outputs, 1 if they give their rates.
        degree: 3 for powers of outputs and speeds, 1 for no powers.
        width: For each output, speed over which the sign changes.
        held: Whether the input is held between samples; otherwise it is smooth.
    """

    channels: tuple[str, ...]
    order: int
    degree: int
    width: tuple[float, ...]
    held: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the terms."""
        speeds = [f"{c}'" for c in self.channels] if self.order == 2 else list(self.channels)
        names = ["1", "u"]
        if self.order == 2:
            powers = ("", "^2", "^3") if self.degree == 3 else ("",)
            names += [f"{c}{p}" for p in powers for c in self.channels]
        forms = ("{}", "{0}|{0}|", "sign {}") + (("{}^3",) if self.degree == 3 else ())
        names += [form.format(s) for form in forms for s in speeds]
        return (*names, *(f"sign({speeds[i]} + {speeds[j]})" for i, j in self._pairs))

    @property
    def _pairs(self) -> list[tuple[int, int]]:
        n = len(self.channels)
        return [(i, j) for i in range(n) for j in range(i)]

    def values(self, x: Any, u: Any) -> Any:
        """Terms (..., P) for states (..., order C) and the input (...); numpy or traced."""
        xp = jnp if isinstance(x, jax.Array) else np
        C = len(self.channels)
        s, width = x[..., -C:], xp.asarray(self.width)
        columns = [xp.ones_like(u)[..., None], u[..., None]]
        if self.order == 2:
            q = x[..., :C]
            columns += [q, q**2, q**3] if self.degree == 3 else [q]
        columns += [s, s * xp.abs(s), xp.tanh(s / width)] + ([s**3] if self.degree == 3 else [])
        columns += [
            xp.tanh((s[..., i] + s[..., j]) / (width[i] + width[j]))[..., None] for i, j in self._pairs
        ]
        return xp.concatenate(columns, axis=-1)


@dataclasses.dataclass(frozen=True)
class SparseEquations:
    """Equations of motion with few terms, as a simulator.

    Attributes:
        terms: Library of terms.
        W: Weights of the terms (P, C).
        Ts: Sampling period for which the equations are simulated [s].
        speeds: Number of past samples from which a speed is estimated for a prediction.
    """

    terms: Terms
    W: Float[np.ndarray, "P C"]
    Ts: float
    speeds: int = 15

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """Free run; the first state is the best fit to the first `n_init` samples."""
        self._check(recording)
        u, m = recording.u.astype(float), recording.n_init
        x = self._start(u[:m], recording.y[:m].astype(float))
        return motions(self.terms, self.W[None], x[None, None], u[None], self.Ts)[
            0, 0, :, : len(self.terms.channels)
        ]

    def predict(self, recording: Recording) -> Float[np.ndarray, "N C"]:
        """One-step-ahead prediction from the last sample, with speeds from the last few samples."""
        self._check(recording)
        y, C, k = recording.y.astype(float), len(self.terms.channels), self.speeds
        t = np.arange(-k + 1, 1) * self.Ts
        slope = np.linalg.pinv(np.vander(t, 3))[1]
        v = np.stack([np.convolve(c, slope[::-1])[: len(y)] for c in y.T], axis=1)
        # Before there are enough samples, of those that there are; one sample alone shows no speed.
        for i in range(min(k - 1, len(y))):
            degree = min(i, 2)
            rows = np.vander(t[k - 1 - i :], degree + 1)
            v[i] = np.linalg.lstsq(rows, y[: i + 1], rcond=None)[0][-2] if degree else 0.0
        x = np.concatenate([y, v], axis=1) if self.terms.order == 2 else y
        u = recording.u.astype(float)
        pairs = np.stack([u, np.concatenate([u[1:], u[-1:]])], axis=1)
        ahead = motions(self.terms, self.W[None], x[None], pairs, self.Ts)
        return np.concatenate([y[:1], ahead[0, :-1, 1, :C]])

    def _check(self, recording: Recording) -> None:
        require_period(self.Ts, recording.Ts, "The equations hold")

    def _start(self, u: np.ndarray, y: np.ndarray) -> Float[np.ndarray, " n"]:
        """First state by Gauss-Newton steps; the start is a parabola through the samples."""
        m, C = y.shape
        if m < 4:
            return np.concatenate([y[0], np.zeros(C)]) if self.terms.order == 2 else y[0]
        p = np.polynomial.polynomial.polyfit(np.arange(m) * self.Ts, y, 2)
        x = np.concatenate([p[0], p[1]]) if self.terms.order == 2 else p[0]
        size = np.maximum(
            np.abs(x), 1e-3 * np.maximum(np.tile(np.abs(y).max(axis=0), self.terms.order), 1e-9)
        )
        scale = np.maximum(y.std(axis=0), 1e-9 + 1e-3 * np.abs(y).max())
        best, least = x, np.inf
        for _ in range(4):
            states = np.concatenate([x[None], x + np.diag(1e-4 * size)])
            runs = motions(self.terms, self.W[None], states[None], np.tile(u, (len(states), 1)), self.Ts)[
                0, :, :, :C
            ]
            e = ((y - runs) / scale).reshape(len(states), -1)
            cost = float(e[0] @ e[0])
            if not cost < least:
                break
            best, least = x, cost
            J = (e[1:] - e[0]).T / 1e-4
            if not np.isfinite(J).all():
                break
            x = x - size * np.linalg.lstsq(J, e[0], rcond=1e-6)[0]
        return best


def motions(
    terms: Terms,
    W: Float[np.ndarray, "K P C"],
    x0: Float[np.ndarray, "K M n"],
    u: Float[np.ndarray, "M N"],
    Ts: float,
) -> Float[np.ndarray, "K M N n"]:
    """States of K models from M first states each, with M inputs."""
    N = u.shape[1]
    padded = np.repeat(u[:, -1:], max(2, 1 << (N - 1).bit_length()), axis=1)
    padded[:, :N] = u
    with double_precision():
        run = _motions(
            terms.order,
            terms.degree,
            terms.channels,
            terms.held,
            np.array(terms.width),
            *map(jnp.asarray, (W, x0, padded, float(Ts))),
        )
        return np.asarray(run)[:, :, :N]


@persistent_jit(static=4)
def _motions(
    order: int,
    degree: int,
    channels: tuple[str, ...],
    held: bool,
    width: Array,
    W: Array,
    x0: Array,
    u: Array,
    Ts: Array,
) -> Array:
    terms, C = Terms(channels, order, degree, width), len(channels)  # pyright: ignore[reportArgumentType]

    def one(W: Array, x: Array, u: Array) -> Array:
        def rate(x: Array, u: Array) -> Array:
            last = terms.values(x, u) @ W
            return jnp.concatenate([x[C:], last]) if order == 2 else last

        def step(x: Array, u: Array) -> tuple[Array, Array]:
            a = rate(x, u[0])
            b = rate(x + Ts / 2 * a, u[1])
            c = rate(x + Ts / 2 * b, u[1])
            d = rate(x + Ts * c, u[2])
            return x + Ts / 6 * (a + 2 * b + 2 * c + d), x

        return jax.lax.scan(step, x, u)[1]

    end = u if held else jnp.concatenate([u[:, 1:], u[:, -1:]], axis=1)
    middle = (u + end) / 2
    if not held and u.shape[1] > 3:  # a cubic through the four samples around
        middle = middle.at[:, 1:-2].set((9 * (u[:, 1:-2] + u[:, 2:-1]) - u[:, :-3] - u[:, 3:]) / 16)
    within = jnp.stack([u, middle, end], axis=-1)
    return jax.vmap(lambda W, x: jax.vmap(lambda x, u: one(W, x, u))(x, within))(W, x0)


# A model is excluded if an output moves by more than this many measured ranges in a run over a recording.
LARGEST_EXCURSION = 3.0
# Share of a weight for difference quotients, and decrease of the mean log error that is worth a step.
WEIGHT_DIFFERENCE, LOG_ERROR_TOLERANCE = 1e-4, 1e-5


@dataclasses.dataclass(frozen=True)
class Piece:
    """A segment of a recording: smoothed state at its start, input and outputs."""

    x0: Float[np.ndarray, " K"]
    u: Float[np.ndarray, " N"]
    y: Float[np.ndarray, "N C"]


def costs(
    terms: Terms,
    W: Float[np.ndarray, "L P C"],
    pieces: Sequence[Piece],
    train: Sequence[Recording],
    states: Sequence[Float[np.ndarray, "N states"]],
) -> Float[np.ndarray, " L"]:
    """Mean log error of free runs of several models over the pieces; infinite if a run leaves the range."""
    n, C = terms.order * len(terms.channels), len(terms.channels)
    with np.errstate(all="ignore"):
        e = _missed(terms, W, pieces, train[0].Ts)
        cost = np.mean(np.log(np.sqrt(np.mean(e**2, axis=(1, 2))) + 1e-300), axis=1)
        for r, x in zip(train, states, strict=True):
            start = np.broadcast_to(x[0, :n], (len(W), 1, n))
            whole = motions(terms, W, start, r.u[None].astype(float), r.Ts)[:, 0, :, :C]
            excursion = np.max(np.abs(whole - r.y[0]) / np.maximum(np.ptp(r.y, axis=0), 1e-300), axis=(1, 2))
            cost = np.where(excursion < LARGEST_EXCURSION, cost, np.inf)
    return np.where(np.isnan(cost), np.inf, cost)


def refined(
    terms: Terms, W: Float[np.ndarray, "P C"], pieces: Sequence[Piece], Ts: float, max_steps: int = 60
) -> Float[np.ndarray, "P C"]:
    """Weights with the non-zero ones refined by damped least squares on free runs; channels count equally."""
    where = np.nonzero(W)
    start = W[where]
    if not len(start):
        return W
    samples = sum(piece.y.size for piece in pieces)

    def expanded(values: Float[np.ndarray, "L K"]) -> Float[np.ndarray, "L P C"]:
        out = np.zeros((len(values), *W.shape))
        out[:, where[0], where[1]] = values
        return out

    def cost(values: Float[np.ndarray, " K"]) -> float:
        return samples * _log_error(_missed(terms, expanded(values[None]), pieces, Ts)[0])

    def linearised(values: Float[np.ndarray, " K"]) -> NormalEquations:
        h = WEIGHT_DIFFERENCE * np.maximum(np.abs(values), 1e-3 * np.abs(start))
        e = _missed(terms, expanded(values + np.vstack([0 * h, np.diag(h)])), pieces, Ts)
        # The errors divided by their own size give the gradient of the logarithm.
        scaled = (e / (np.sqrt(np.mean(e[0] ** 2, axis=(0, 1))) + 1e-300)).reshape(len(e), -1)
        equations = NormalEquations.of(((scaled[1:] - scaled[0]) / h[:, None]).T, scaled[0])
        return equations._replace(costs=np.array([samples * _log_error(e[0])]))

    rules = Rules(enough=LOG_ERROR_TOLERANCE * samples)
    with np.errstate(all="ignore"):
        found = minimise(linearised, start, rules, cost=cost, max_steps=max_steps)
    return expanded(found.x[None])[0]


def _missed(
    terms: Terms, W: Float[np.ndarray, "L P C"], pieces: Sequence[Piece], Ts: float
) -> Float[np.ndarray, "L M N C"]:
    """Errors of free runs of several models over all pieces."""
    n, C = terms.order * len(terms.channels), len(terms.channels)
    start = np.stack([p.x0[:n] for p in pieces])
    start = np.broadcast_to(start, (len(W), *start.shape))
    return motions(terms, W, start, np.stack([p.u for p in pieces]), Ts)[..., :C] - np.stack(
        [p.y for p in pieces]
    )


def _log_error(e: np.ndarray) -> float:
    cost = float(np.mean(np.log(np.sqrt(np.mean(e**2, axis=(0, 1))) + 1e-300)))
    return cost if np.isfinite(cost) else np.inf
