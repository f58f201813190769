"""Faster forms of LMS and RLS over a Volterra series; all give the same errors to rounding.

Stored regressors need P numbers per sample, and reading them takes longer than computing them. A form has its
own loop state: `begin` makes it from the state of the filter, `end` converts it back.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.adaptive.filter import AdaptiveFilter, Weights, per_weight, times
from rotflex_jax.adaptive.lms import LMS
from rotflex_jax.adaptive.rls import RLS, SquareRootState
from rotflex_jax.basis import Basis, Delays, Volterra
from rotflex_jax.basis.volterra import counts, indices, positions

BlockStep = Callable[[Any, tuple[Float[Array, " B"], Float[Array, " B"]]], tuple[Any, Float[Array, " B"]]]
"""Function of state and block (input, output) that returns the next state and the errors of the block."""


@dataclasses.dataclass(frozen=True)
class RegressorsInLoop:
    """Form of any filter with regressors that are products of delays and are computed sample by sample.

    Attributes:
        memory: number of delays M.
        degrees: degrees of the products, 0 for the constant.
        layout: layout of the products.
    """

    memory: int
    degrees: tuple[int, ...]
    layout: str

    @property
    def size(self) -> int:
        """Number of regressors."""
        return sum(len(indices(self.memory, d, self.layout)) for d in self.degrees)

    def begin(self, state: Any, lags: Float[Array, " M"]) -> Any:
        """State of the loop, after the samples `lags`, the newest first."""
        return state, lags

    def scan(
        self, filter: AdaptiveFilter, carry: Any, x: Float[Array, " N"], y: Float[Array, " N"]
    ) -> tuple[Any, Float[Array, " N"]]:
        """State of the loop after the samples, and a-priori errors (N,)."""

        def step(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            state, lags = carry
            lags = jnp.concatenate([sample[0][None], lags[:-1]])
            state, e = filter.step(state, self.regressors(lags), sample[1])
            return (state, lags), e

        return jax.lax.scan(step, carry, (x, y))

    def regressors(self, lags: Float[Array, "*B M"]) -> Float[Array, "*B P"]:
        """Products of delays, the newest first."""
        listed = [(indices(self.memory, d, self.layout), d) for d in self.degrees]
        factors = [np.array(each, int).reshape(len(each), d) for each, d in listed]
        return jnp.concatenate([_products(lags, f) for f in factors], axis=-1)

    def newest(
        self, x: Float[Array, " B"], lags: Float[Array, " M"]
    ) -> tuple[Float[Array, " B+M"], Float[Array, "B M"]]:
        """The input up to the end of a block, and the delays of each of its samples, all newest first."""
        line = jnp.concatenate([x[::-1], lags])
        return line, jnp.stack([line[k : k + self.memory] for k in reversed(range(len(x)))])

    def end(self, carry: Any) -> Any:
        """The filter's state."""
        return carry[0]


def scan_blocks(
    step: BlockStep, carry: Any, x: Float[Array, " N"], y: Float[Array, " N"], length: int
) -> tuple[Any, Float[Array, " N"]]:
    """A loop over blocks of samples; the samples that are left form one shorter block.

    Args:
        step: step of the loop.
        carry: first state.
        x: input.
        y: output.
        length: number of samples in a block.

    Returns:
        Last state, and errors.
    """
    whole = len(y) // length * length
    blocks = x[:whole].reshape(-1, length), y[:whole].reshape(-1, length)
    carry, e = jax.lax.scan(step, carry, blocks)
    if whole == len(y):
        return carry, e.reshape(-1)
    carry, last = step(carry, (x[whole:], y[whole:]))
    return carry, jnp.concatenate([e.reshape(-1), last])


def _products(lags: Float[Array, "*B M"], factors: Int[np.ndarray, "K degree"]) -> Float[Array, "*B K"]:
    """Products of the lags `factors`."""
    product = jnp.ones((*lags.shape[:-1], len(factors)), lags.dtype)
    for k in range(factors.shape[1]):
        product = product * lags[..., factors[:, k]] if k else lags[..., factors[:, 0]]
    return product


QuadraticTerms = tuple[Float[Array, ""], Float[Array, " M"], Float[Array, "M M"]]
"""Constant, linear part and symmetric matrix of a polynomial of degree 2."""


@dataclasses.dataclass(frozen=True)
class MatrixLMS(RegressorsInLoop):
    """LMS with the weights of the products as a symmetric matrix W.

        y_hat = w_0 + (w_1 + W z)'z,    W <- W + H e z z',    H: step sizes, those off the diagonal halved

    No product of delays is computed. The second of two samples does not need the weights after the first:

        e_2 = y_2 - y_hat_2(w) - g e_1,    g = phi_1' diag(mu) phi_2 = mu_0 + (mu_1 + H b)'b,   b = z_1 z_2

    This is exact, since g e_1 is the change of the second prediction by the first correction. The weights are
    read and written half as often, and a processor works on two samples at once.

    Attributes:
        alike: whether all weights of a degree have one step size, which makes g cheaper to compute.
        leaks: whether there is leakage; then the samples are processed one by one.

    Source: Benesty and Duhamel 1992, IEEE Trans. Signal Processing 40.
    """

    alike: bool = False
    leaks: bool = False

    def begin(self, state: Weights, lags: Float[Array, " M"]) -> Any:
        """State of the loop, after the samples `lags`, the newest first."""
        return *self.parts(state.w / self._counted(state.w.dtype)), lags

    def scan(
        self, filter: LMS, carry: Any, x: Float[Array, " N"], y: Float[Array, " N"]
    ) -> tuple[Any, Float[Array, " N"]]:
        """State of the loop after the samples, and a-priori errors (N,)."""
        mu = per_weight("mu", filter.mu, self.size, x.dtype)
        mu0, mu1, H = sizes = self.parts(mu / self._counted(x.dtype))
        pull = self.parts(1 - mu * filter.leakage)

        def step(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            *w, lags = carry
            line, Z = self.newest(sample[0], lags)
            moved = w[1][None] + jnp.sum(Z[:, :, None] * w[2][None], axis=1)
            e = sample[1] - (w[0] + jnp.sum(moved * Z, axis=1))
            if len(Z) == 2:
                e = jnp.stack([e[0], e[1] - self._influence(sizes, Z[0] * Z[1]) * e[0]])
            w0, w1, W = (a * b for a, b in zip(w, pull, strict=True)) if self.leaks else w
            eZ = Z * e[:, None]
            W = W + H * jnp.sum(eZ[:, :, None] * Z[:, None, :], axis=0)
            return (w0 + mu0 * jnp.sum(e), w1 + mu1 * jnp.sum(eZ, axis=0), W, line[: self.memory]), e

        return scan_blocks(step, carry, x, y, length=1 if self.leaks else 2)

    def end(self, carry: Any) -> Weights:
        """The filter's state."""
        w0, w1, W, _ = carry
        i, j = np.triu_indices(self.memory)
        whole = {0: w0[None], 1: w1, 2: W[i, j]}
        w = jnp.concatenate([whole[d] for d in self.degrees])
        return Weights(w * self._counted(w.dtype))

    def _influence(self, sizes: QuadraticTerms, b: Float[Array, " M"]) -> Float[Array, ""]:
        """Change of the next prediction by a correction for an error of one."""
        mu0, mu1, H = sizes
        if not self.alike:
            return mu0 + jnp.sum((mu1 + jnp.sum(H * b[:, None], axis=0)) * b)
        g = jnp.sum(b)
        return mu0 + mu1[0] * g + H[0, 0] / 2 * (g * g + jnp.sum(b * b))

    def parts(self, w: Float[Array, " P"]) -> QuadraticTerms:
        """Weights, or one value per weight, as constant, linear part and matrix; zero where there is none."""
        M, at, own = self.memory, 0, {}
        for d in self.degrees:
            count = len(indices(M, d, "triangular"))
            own[d] = w[at : at + count]
            at += count
        constant = own[0][0] if 0 in own else jnp.zeros((), w.dtype)
        return constant, own.get(1, jnp.zeros(M, w.dtype)), own[2][positions(M, 2).astype(np.int32)]

    def _counted(self, dtype: Any) -> np.ndarray:
        """How often each weight occurs in the matrix."""
        return np.concatenate([counts(self.memory, d) for d in self.degrees]).astype(dtype)


LMS_BLOCK_SAMPLES = 32
"""Number of samples in a block: enough for efficient matrix products, few enough for a cheap triangular
system."""


@dataclasses.dataclass(frozen=True)
class BlockMatrixLMS(MatrixLMS):
    """LMS with one step size per degree, on blocks of samples.

        e = (I + tril(G, -1))^-1 (d - y_w),   G_ij = phi_i' diag(mu) phi_j
          = mu_0 + mu_1 g_ij + mu_2 / 2 (g_ij^2 + sum_k z_ik^2 z_jk^2),   g = Z Z',  Z the delays as rows

    The weights that predict a sample are those at the start of its block plus the corrections by the
    errors before it in the block, so all errors follow from one triangular system. The products of
    the delays appear only through the inner products g: no regressor is formed at all.

    Source: Benesty and Duhamel 1992, IEEE Trans. Signal Processing 40; the kernel of a Volterra series:
    Franz and Schoelkopf 2006, Neural Computation 18.
    """

    def scan(
        self, filter: LMS, carry: Any, x: Float[Array, " N"], y: Float[Array, " N"]
    ) -> tuple[Any, Float[Array, " N"]]:
        """State of the loop after the samples, and a-priori errors (N,)."""
        mu = self.parts(per_weight("mu", filter.mu, self.size, x.dtype))
        mu0, mu1, mu2 = mu[0], mu[1][0], mu[2][0, 0]
        M, N = self.memory, len(x)
        fill = -N % LMS_BLOCK_SAMPLES
        # Newest first before the block's first sample, as rows of the same stretch of input.
        line = jnp.concatenate([carry[3][::-1], x, jnp.zeros(fill, x.dtype)])
        rows = np.arange(LMS_BLOCK_SAMPLES)[:, None] + M - np.arange(M)[None, :]
        eye, seen = jnp.eye(LMS_BLOCK_SAMPLES, dtype=x.dtype), jnp.arange(N + fill) < N

        def step(carry: Any, block: tuple[Array, Array, Array]) -> tuple[Any, Array]:
            w0, w1, W = carry
            at, d, real = block
            Z = jax.lax.dynamic_slice(line, (at,), (LMS_BLOCK_SAMPLES + M,))[rows]
            g, squares = times(Z, Z.T), Z * Z
            G = mu0 + mu1 * g + mu2 / 2 * (g * g + times(squares, squares.T))
            free = d - (w0 + jnp.sum((times(Z, W) + w1[None]) * Z, axis=1))
            e = jax.scipy.linalg.solve_triangular(jnp.tril(G, -1) + eye, free, lower=True, unit_diagonal=True)
            e = jnp.where(real, e, 0.0)
            eZ = Z * e[:, None]
            S = times(Z.T, eZ)
            W = W + mu2 / 2 * (S + jnp.diag(jnp.diag(S)))
            return (w0 + mu0 * jnp.sum(e), w1 + mu1 * jnp.sum(eZ, axis=0), W), e

        starts = jnp.arange(0, N + fill, LMS_BLOCK_SAMPLES)
        padded = jnp.concatenate([y, jnp.zeros(fill, y.dtype)]).reshape(-1, LMS_BLOCK_SAMPLES)
        end, e = jax.lax.scan(step, carry[:3], (starts, padded, seen.reshape(-1, LMS_BLOCK_SAMPLES)))
        return (*end, line[N : N + M][::-1]), e.reshape(-1)[:N]


MOST_WEIGHTS_UNROLLED, LEAST_WEIGHTS_FOR_MATRICES = 21, 80
"""Weights up to which a block has four samples and its step is written out, and from which a block has
sixteen samples and its step uses matrix products; between them a block has two samples."""

Triangle = list[list[Array]]
"""A small lower triangular matrix as scalars: row i has i + 1 of them."""


def block_samples(P: int) -> int:
    """Number of samples in a block of `BlockRLS` for P weights.

    >>> [block_samples(P) for P in (21, 66, 231)]
    [4, 2, 16]
    """
    return 4 if P <= MOST_WEIGHTS_UNROLLED else 16 if P >= LEAST_WEIGHTS_FOR_MATRICES else 2


@dataclasses.dataclass(frozen=True)
class BlockRLS(RegressorsInLoop):
    """RLS on blocks of B samples, with a square root S of the inverse Gram matrix as in `RLS`.

        V = X S,    D + V V' = L L',  D = diag(lam, ..., lam^B),    v = L^-1 (y - X w),    e = diag(L) v,
        K = S V' L^-T,    w <- w + K v,    S <- (S - K (L + sqrt D)^-1 V) lam^(-B/2)

    With B = 1 this is the step of `RLS`. A block reads S three times where B steps read it 3 B
    times, at no loss of precision: S S' is positive whatever the rounding.

    Source: Andrews 1968, AIAA Journal 6; in Bierman, Factorization Methods for Discrete Sequential
    Estimation, 1977.
    """

    def scan(
        self, filter: RLS, carry: Any, x: Float[Array, " N"], y: Float[Array, " N"]
    ) -> tuple[Any, Float[Array, " N"]]:
        """State of the loop after the samples, and a-priori errors (N,)."""

        def step(carry: Any, sample: tuple[Array, Array]) -> tuple[Any, Array]:
            state, lags = carry
            line, Z = self.newest(sample[0], lags)
            update = _block_unrolled if self.size < LEAST_WEIGHTS_FOR_MATRICES else _block_by_matrices
            state, e = update(state, self.regressors(Z), sample[1], jnp.asarray(filter.lam))
            return (state, line[: self.memory]), e

        return scan_blocks(step, carry, x, y, block_samples(self.size))


def _block_by_matrices(
    state: SquareRootState, X: Float[Array, "B P"], y: Float[Array, " B"], lam: Float[Array, ""]
) -> tuple[SquareRootState, Float[Array, " B"]]:
    """A block of samples by matrix products; a product with a transposed matrix in front would be slow."""
    w, S = state
    D = lam ** jnp.arange(1, len(y) + 1, dtype=y.dtype)
    V = times(X, S)
    L = jnp.linalg.cholesky(times(V, V.T) + jnp.diag(D), symmetrize_input=False)
    inverse, other = (
        jax.scipy.linalg.solve_triangular(each, jnp.eye(len(y), dtype=y.dtype), lower=True)
        for each in (L, L + jnp.diag(jnp.sqrt(D)))
    )
    v = times(inverse, y - times(X, w))
    K = times(times(S, V.T), inverse.T)
    S = (S - times(times(K, other), V)) / jnp.sqrt(D[-1])
    return SquareRootState(w + times(K, v), S), jnp.diagonal(L) * v


def _block_unrolled(
    state: SquareRootState, X: Float[Array, "B P"], y: Float[Array, " B"], lam: Float[Array, ""]
) -> tuple[SquareRootState, Float[Array, " B"]]:
    """The same, written out so that the whole loop compiles into one function: no call of a library."""
    w, S = state
    D = [lam ** (k + 1) for k in range(len(y))]
    # For more weights the plain sum is too large for XLA to fuse the loop into one function.
    V = (
        jnp.sum(X[:, :, None] * S[None], axis=1)
        if len(w) <= MOST_WEIGHTS_UNROLLED
        else [times(x, S) for x in X]
    )
    U = [times(S, v) for v in V]
    A = [[jnp.sum(V[i] * V[j]) for j in range(i)] + [jnp.sum(V[i] * V[i]) + d] for i, d in enumerate(D)]
    L = _factor(A)
    # Rows of L^-1 (y - X w), of K' = L^-1 U', and of (L + sqrt D)^-1 V.
    v = _solved(L, list(y - jnp.sum(X * w[None], axis=1)))
    K = _solved(L, U)
    R = _solved([[*row[:-1], row[-1] + jnp.sqrt(d)] for row, d in zip(L, D, strict=True)], list(V))
    S = S - sum(k[:, None] * r[None] for k, r in zip(K, R, strict=True))
    e = jnp.stack([row[-1] * each for row, each in zip(L, v, strict=True)])
    return SquareRootState(w + sum(k * each for k, each in zip(K, v, strict=True)), S / jnp.sqrt(D[-1])), e


def _factor(A: Triangle) -> Triangle:
    """Lower triangle L of A = L L'."""
    L: Triangle = []
    for i, row in enumerate(A):
        L.append([])
        for j in range(i):
            L[i].append((row[j] - sum(L[i][k] * L[j][k] for k in range(j))) / L[j][j])
        L[i].append(jnp.sqrt(row[i] - sum(each * each for each in L[i])))
    return L


def _solved(L: Triangle, b: list[Array]) -> list[Array]:
    """L^-1 b, where the entries of b may be rows of a matrix."""
    x: list[Array] = []
    for row, each in zip(L, b, strict=True):
        x.append((each - sum(a * known for a, known in zip(row, x, strict=False))) / row[-1])
    return x


LEAST_DELAYS_FOR_BLOCKS = 40
"""Number of delays from which LMS is faster in long blocks of samples than in pairs."""


def fastest_form(filter: AdaptiveFilter, basis: Basis, whole: bool) -> RegressorsInLoop | None:
    """The fastest form for a filter and a basis; None if the regressors must be computed before the loop.

    Args:
        filter: filter whose settings are not traced, since some forms need equal step sizes within a degree.
        basis: basis that gives the regressors.
        whole: whether the run stores the last weights only; long blocks are not faster if weights are stored
            often.
    """
    if not (isinstance(basis, Volterra) and isinstance(basis.bank, Delays)):
        return None
    M, degrees = basis.bank.memory, basis.chosen
    second = 2 in degrees and degrees[-1] == 2 and basis.layout == "triangular"
    if type(filter) is RLS:
        return BlockRLS(M, degrees, basis.layout)
    if not (type(filter) is LMS and second):
        return RegressorsInLoop(M, degrees, basis.layout)
    leaks = bool(np.any(np.asarray(filter.leakage) != 0))
    mu = np.broadcast_to(np.asarray(filter.mu, float), basis.size)
    counts = np.cumsum([0, *(len(indices(M, d, basis.layout)) for d in degrees)])
    alike = all(np.ptp(mu[a:b]) == 0 for a, b in itertools.pairwise(counts))
    if M >= LEAST_DELAYS_FOR_BLOCKS and alike and whole and not leaks:
        return BlockMatrixLMS(M, degrees, basis.layout, alike)
    return MatrixLMS(M, degrees, basis.layout, alike, leaks)
