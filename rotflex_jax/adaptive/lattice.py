"""Recursive least squares for a second-order Volterra filter, in one stage for each sample of memory."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rotflex_jax.adaptive.filter import AdaptiveFilter, Number, count, real_data, times, within
from rotflex_jax.adaptive.rls import potter_update


class LatticeStage(NamedTuple):
    """One stage: three regressions with the a-priori errors f and b, one of each per channel.

    Stage m uses the first m + 2 channels; entries of the other channels stay zero. In a `LatticeState` all M
    stages are stacked along a first axis.

    Attributes:
        b: errors of the samples that leave, predicted from the samples after them.
        g: gain of the regressions on b.
        gamma: a-posteriori over a-priori error after the stages before this one.
        root_b: square root of the inverse Gram matrix of b.
        output: coefficients of b for the outputs.
        root_f: square root of the inverse Gram matrix of f.
        forward: coefficients of the previous b for f of the next stage.
        backward: coefficients of f for b of the next stage.
    """

    b: Float[Array, "*M n"]
    g: Float[Array, "*M n"]
    gamma: Float[Array, "*M"]
    root_b: Float[Array, "*M n n"]
    output: Float[Array, "*M n T"]
    root_f: Float[Array, "*M n n"]
    forward: Float[Array, "*M n n"]
    backward: Float[Array, "*M n n"]


def monomials(memory: int) -> list[tuple[int, ...]]:
    """Delays of every regressor, the smaller first: linear ones, then products by their first delay.

    >>> monomials(2)
    [(0,), (1,), (0, 0), (0, 1), (1, 1)]
    """
    delays = range(memory)
    return [(i,) for i in delays] + [(i, j) for i in delays for j in delays[i:]]


def direct_form(stages: LatticeStage, memory: int) -> Float[Array, "P T"]:
    """Weights of the outputs on the monomials, from the coefficients of the stages.

    In a vector over all monomials, with C and A the predictors of what leaves and of what is new:
    b = old - C'x and f = new - A'x, with x the samples between, so that

        w <- w + (old - C) output
        C <- (old - C before, new - A) - (new - A) backward,    A <- A + (old - C before) forward

    where "before" is one sample earlier. It need not be stored, for the last update
    was `C = C before + k b'`, with k the gain of RLS, which the stages hold as well: `k <- k + (old - C) g`.

    Args:
        stages: stages of a lattice, along the first axis.
        memory: memory of the lattice.
    """
    names = monomials(memory)
    place = {delays: i for i, delays in enumerate(names)}
    size, channels, dtype = len(names), memory + 1, stages.b.dtype
    # The samples of row i, seen one sample earlier, are those of row `earlier[i]`.
    earlier = [place.get(tuple(d - 1 for d in delays), size) for delays in names]
    later = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])[np.array(earlier)]  # noqa: E731
    new = np.eye(size)[:, [place[delays] for delays in [(0,), *((0, j) for j in range(memory))]]]
    known, joining = (jnp.asarray(x) for x in known_channels(memory))

    def next_stage(carry: tuple[Array, ...], stage: tuple[LatticeStage, Array, Array]) -> tuple[Any, None]:
        # B and F are error filters, the monomials less their predictors: of b and of f.
        w, k, B, F = carry
        own, knows, joins = stage
        before = later(B + k[:, None] * own.b[None])
        B_next = before + jnp.where(joins[None], F, 0) - jnp.where(knows[None], F, 0) @ own.backward
        return (w + B @ own.output, k + B @ own.g, B_next, F - before @ own.forward), None

    F = jnp.asarray(new, dtype)
    start = (
        jnp.zeros((size, stages.output.shape[2]), dtype),
        jnp.zeros(size, dtype),
        jnp.where(np.arange(channels)[None] < 2, F, 0),
        F,
    )
    return jax.lax.scan(next_stage, start, (stages, known, joining))[0][0]


def known_channels(memory: int) -> tuple[Bool[np.ndarray, "M M+1"], Bool[np.ndarray, "M M+1"]]:
    """Which channels each stage knows, the first m + 2, and which the next one knows besides."""
    known = np.arange(memory + 1) < np.arange(2, memory + 2)[:, None]
    return known, np.diff(known, axis=0, append=known[-1:])


class LatticeState(NamedTuple):
    """All stages, the past of the input, and the regression on a constant that follows the last stage.

    Attributes:
        u: the last `memory - 1` input samples, newest first.
        stages: one per sample of memory, along the first axis.
        level: coefficient of the residual of a constant after all stages.
        energy: weighted sum of squares of this residual.
    """

    u: Float[Array, " M-1"]
    stages: LatticeStage
    level: Float[Array, ""]
    energy: Float[Array, ""]


class VolterraLattice(AdaptiveFilter):
    """RLS on all products of up to two of the last M input samples, without computing all of them.

    Stage m increases the memory from m to m + 1. The new regressors are `u_t (1, u_t, ..., u_(t-m))`, the
    regressors that leave are `u_(t-m) (1, u_(t-m), ..., u_t)`. So the series is a linear filter with M + 1
    channels, of which stage m uses m + 2. The parts of the new regressors (f) and of the old ones (b) that
    the samples in between do not predict are regressed on each other, and the output is regressed on b. Each
    of these small regressions is corrected by its a-priori errors, and weights its samples by the ratio of
    a-posteriori to a-priori error after the stages before it.

    The a-priori errors agree to rounding with the errors of `RLS` on the same regressors with the same start:
    `RLS(lam, delta=lattice.start)`. A start has to be the same for every stage at any time. The delayed
    regressors are therefore assumed to have been excited earlier, which is forgotten by the same factor:
    `P0 = delta lam^j`, with j the smaller delay of a regressor. With `lam = 1` it is `delta` for all.

    One sample needs of the order of M^3 operations, with RLS of the order of M^4. Not for a small memory,
    where many small steps take longer than one large step. Also not for other regressors: other degrees, an
    orthonormal basis, or a first delay that the given input does not contain.

    The argument `phi` of the filter is the input `u` (N,) itself. The weights have the order constant,
    u_t ... u_(t-M+1), then u_(t-i) u_(t-j) for i <= j, by i.

    Args:
        memory: memory M [samples].
        lam: forgetting factor, above 0 and at most 1 [-].
        delta: start of the inverse Gram matrix, as in `RLS` [1 / regressor^2].
        constant: whether the regressors include a constant.

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
        """Number of weights, with one for a constant, M linear and M (M + 1) / 2 quadratic ones."""
        return len(monomials(self.memory)) + self.constant

    @property
    def start(self) -> Float[np.ndarray, " P"]:
        """Diagonal of the inverse Gram matrix at the start, for an `RLS` with the same errors."""
        delays = [0] * self.constant + [delays[0] for delays in monomials(self.memory)]
        return np.asarray(self.delta, float) * np.asarray(self.lam, float) ** np.array(delays)

    def init(self, size: int, dtype: Any) -> LatticeState:
        """All weights zero, after zero input; `size` is not used."""
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
        stages = LatticeStage(
            b=zeros(n),
            g=zeros(n),
            gamma=jnp.ones(M, dtype),
            root_b=diagonal(jnp.where(known, root, 0)),
            output=zeros(n, 1 + self.constant),
            root_f=diagonal(jnp.where(known, jnp.sqrt(delta), 0)),
            forward=zeros(n, n),
            backward=zeros(n, n),
        )
        return LatticeState(jnp.zeros(M - 1, dtype), stages, jnp.zeros((), dtype), 1 / delta)

    def step(
        self, state: LatticeState, phi: Float[Array, ""], y: Float[Array, ""]
    ) -> tuple[LatticeState, Float[Array, ""]]:
        """One sample through all stages."""
        M = self.memory
        past = jnp.concatenate([phi[None], state.u])
        f = jnp.concatenate([phi[None], phi * past])
        # The constant is a second output; its residual is a further regressor of the first.
        e = jnp.stack([y, jnp.ones_like(y)]) if self.constant else y[None]

        def next_stage(
            carry: tuple[Array, ...], stage: tuple[LatticeStage, Array, Array]
        ) -> tuple[Any, LatticeStage]:
            f, b, gamma, e = carry
            old, known, joins = stage
            root_b, g, left = potter_update(old.root_b, b, self.lam, gamma)
            e = e - times(b, old.output)
            own = jnp.where(known, f, 0)
            root_f, g_f, _ = potter_update(old.root_f, own, self.lam, old.gamma)
            # The next product joins those that leave; it has no past of its own yet.
            above = old.b + jnp.where(joins, f, 0) - times(own, old.backward)
            f = f - times(old.b, old.forward)
            new = LatticeStage(
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
            next_stage, start, (state.stages, jnp.asarray(known), jnp.asarray(joins))
        )
        if not self.constant:
            return LatticeState(past[:-1], stages, state.level, state.energy), e[0]
        error = e[0] - state.level * e[1]
        energy: Any = self.lam * state.energy + gamma * e[1] ** 2
        level = state.level + gamma * e[1] * error / energy
        return LatticeState(past[:-1], stages, level, energy), error

    def weights(self, state: LatticeState) -> Float[Array, " P"]:
        """Weights of the direct form, from the coefficients of all stages."""
        w = direct_form(state.stages, self.memory)
        if not self.constant:
            return w[:, 0]
        return jnp.concatenate([state.level[None], w[:, 0] - state.level * w[:, 1]])
