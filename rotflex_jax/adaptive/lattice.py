"""Recursive least squares for a second-order Volterra filter, stage by stage of its memory."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.lattice_weights import Stage, direct_form, known_channels, monomials
from rotflex_jax.adaptive.ranges import Number, count, real_data, within
from rotflex_jax.adaptive.root import correct
from rotflex_jax.adaptive.sums import times


class Ladder(NamedTuple):
    """All stages, the past of the input, and the regression on a constant that ends the ladder.

    Attributes:
        u: the last `memory - 1` input samples, newest first.
        stages: one per sample of memory, along the first axis.
        level: coefficient of what the stages leave of a constant.
        energy: of what they leave of it.
    """

    u: Float[Array, " M-1"]
    stages: Stage
    level: Float[Array, ""]
    energy: Float[Array, ""]


class VolterraLattice(AdaptiveFilter):
    """RLS on all products of up to two of the last M input samples, without forming them all.

    Stage m goes from the memory m to m + 1. What is new in the regressors is `u_t (1, u_t, ...,
    u_(t-m))`, what leaves them `u_(t-m) (1, u_(t-m), ..., u_t)`, so the series is a linear filter with
    M + 1 channels, of which stage m knows m + 2. The part of the new that the samples between do not
    tell (f) and that of the old (b) predict each other, and b predicts the output. Each of these
    small regressions takes a-priori errors, corrects itself by them, and weighs its samples by the
    share of an error that the stages before leave after their correction.

    The a-priori errors are those of `RLS` on the same regressors to rounding, with the same start:
    `RLS(lam, delta=lattice.start)`. A start has to be the same for every stage at any time, so the
    delayed regressors are thought to have been excited earlier, which they forget by the same factor:
    `P0 = delta lam^j`, with j the smaller delay of a regressor. With `lam = 1` it is `delta` for all.

    One sample costs of the order of M^3 operations, RLS M^4. Not for speed at a small memory, where
    the many small steps take longer than one large one. Nor for regressors other than these: other
    degrees, an orthonormal basis, a first delay that is not in the input it is given.

    Its `phi` is the input `u` (N,) itself. Its weights are in the order constant, u_t ... u_(t-M+1),
    then u_(t-i) u_(t-j) for i <= j, by i.

    Args:
        memory: M [samples].
        lam: forgetting factor, above 0 and at most 1 [-].
        delta: start of the inverse Gram matrix, as in `RLS` [1 / regressor^2].
        constant: whether a constant is among the regressors.

    Source: Syed and Mathews, IEEE Trans. Circuits Syst. II 41(3), 1994, 202-214; a-priori errors with
    feedback: Ling, Manolakis and Proakis 1986.

    >>> lattice = VolterraLattice(memory=2, lam=0.5, delta=8.0)
    >>> lattice.start  # of 1, u_t, u_(t-1), u_t^2, u_t u_(t-1), u_(t-1)^2
    array([8., 8., 4., 8., 8., 4.])
    """

    from_input: ClassVar[bool] = True

    memory: int = eqx.field(static=True)
    lam: Number = 1.0
    delta: Number = 1e6
    constant: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        count("memory", self.memory)
        within("lam", self.lam, 0, 1, open_low=True)
        within("delta", self.delta, 0, float("inf"), open_low=True)

    @property
    def size(self) -> int:
        """How many weights, one of the constant, M linear and M (M + 1) / 2 quadratic ones."""
        return len(monomials(self.memory)) + self.constant

    @property
    def start(self) -> np.ndarray:
        """Start of the inverse Gram matrix (P,), for an `RLS` with the same errors."""
        delays = [0] * self.constant + [delays[0] for delays in monomials(self.memory)]
        return np.asarray(self.delta, float) * np.asarray(self.lam, float) ** np.array(delays)

    def init(self, size: int, dtype: Any) -> Ladder:
        """All weights zero, after silence; `size` plays no part."""
        del size
        real_data("VolterraLattice", dtype)
        M, n = self.memory, self.memory + 1
        delta, lam = jnp.asarray(self.delta).astype(dtype), jnp.asarray(self.lam).astype(dtype)
        # Delays, within their channels, of u_(t-m) (1, u_(t-m), ..., u_t).
        delays = np.array([[m] + [m - i for i in range(n - 1)] for m in range(M)])
        known, _ = known_channels(M)
        root = jnp.sqrt(delta * lam ** jnp.asarray(np.maximum(delays, 0), dtype))
        diagonal = jax.vmap(jnp.diag)
        zeros = lambda *shape: jnp.zeros((M, *shape), dtype)  # noqa: E731
        stages = Stage(
            b=zeros(n),
            g=zeros(n),
            gamma=jnp.ones(M, dtype),
            root_b=diagonal(jnp.where(known, root, 0)),
            output=zeros(n, 1 + self.constant),
            root_f=diagonal(jnp.where(known, jnp.sqrt(delta), 0)),
            forward=zeros(n, n),
            backward=zeros(n, n),
        )
        return Ladder(jnp.zeros(M - 1, dtype), stages, jnp.zeros((), dtype), 1 / delta)

    def step(self, state: Ladder, phi: Array, y: Array) -> tuple[Ladder, Array]:
        """One sample through all stages."""
        M = self.memory
        past = jnp.concatenate([phi[None], state.u])
        f = jnp.concatenate([phi[None], phi * past])
        # The constant rides along as a second output; what is left of it then serves the first.
        e = jnp.stack([y, jnp.ones_like(y)]) if self.constant else y[None]

        def climb(carry: tuple[Array, ...], stage: tuple[Stage, Array, Array]) -> tuple[Any, Stage]:
            f, b, gamma, e = carry
            old, known, joins = stage
            root_b, g, left = correct(old.root_b, b, self.lam, gamma)
            e = e - times(b, old.output)
            own = jnp.where(known, f, 0)
            root_f, g_f, _ = correct(old.root_f, own, self.lam, old.gamma)
            # The next product joins those that leave, its own past being nothing yet.
            above = old.b + jnp.where(joins, f, 0) - times(own, old.backward)
            f = f - times(old.b, old.forward)
            new = Stage(
                b=b,
                g=g,
                gamma=gamma,
                root_b=root_b,
                output=old.output + g[:, None] * e[None],
                root_f=root_f,
                forward=old.forward + old.g[:, None] * f[None],
                backward=old.backward + g_f[:, None] * above[None],
            )
            return (f, above, left, e), new

        known, joins = known_channels(M)
        start = (f, jnp.where(known[0], f, 0), jnp.ones_like(phi), e)
        (_, _, gamma, e), stages = jax.lax.scan(
            climb, start, (state.stages, jnp.asarray(known), jnp.asarray(joins))
        )
        if not self.constant:
            return Ladder(past[:-1], stages, state.level, state.energy), e[0]
        error = e[0] - state.level * e[1]
        energy = self.lam * state.energy + gamma * e[1] ** 2
        level = state.level + gamma * e[1] * error / energy
        return Ladder(past[:-1], stages, level, energy), error

    def weights(self, state: Ladder) -> Array:
        """Weights (P,) of the direct form, from the coefficients of all stages."""
        w = direct_form(state.stages, self.memory)
        if not self.constant:
            return w[:, 0]
        return jnp.concatenate([state.level[None], w[:, 0] - state.level * w[:, 1]])
