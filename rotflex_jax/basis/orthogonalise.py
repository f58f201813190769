"""Orthonormal combinations of the regressors of a Volterra series: for a Gaussian input, or for a sample.

The aim is that all weights of a gradient filter converge equally fast. Least squares gives the same model for
raw and for orthonormal regressors, since they span the same space. On real data convergence is not always
faster: if a few linear directions have nearly all the power, the raw regressors with a step size per degree
may converge faster.
"""

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.basis.bank import evaluate
from rotflex_jax.basis.volterra import Index, Volterra, from_tensor, indices, spread
from rotflex_jax.checks import signal
from rotflex_jax.errors import InputError

# Relative norm of the residual below which a column counts as linearly dependent on the columns before it.
DEPENDENT_RESIDUAL = 1e-10


class Orthogonalised(eqx.Module):
    """Regressors of a Volterra series times a matrix.

        psi = T' phi,  y_hat = v' psi = (T v)' phi

    Made by `Hermite.of` or `GramSchmidt.of`. The weights have the unit of the output.

    Args:
        volterra: The raw regressors.
        transform: T (P, P'), upper triangular in blocks of the degrees.
        names: Names of the columns.
        degrees: Degrees of the columns.
    """

    volterra: Volterra
    transform: Any
    names: tuple[str, ...] = eqx.field(static=True)
    degree_list: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of regressors."""
        return len(self.names)

    @property
    def degrees(self) -> Int[np.ndarray, " P"]:
        """Highest degree in each regressor."""
        return np.array(self.degree_list, int)

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N P"]:
        """Regressors for a signal, also in traced code."""
        return self.volterra.respond(u) @ jnp.asarray(self.transform).astype(u.dtype)

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal, in its precision.

        Args:
            u: Signal (N,); zero before its first sample.
        """
        return evaluate(self, u)

    def raw_weights(self, w: Any) -> Float[np.ndarray, " P"]:
        """Weights of the raw regressors that give the same output."""
        w = np.asarray(w, float)
        if w.shape != (self.size,):
            raise InputError(
                f"The basis has {self.size} regressors, but the weights have the shape {w.shape}; "
                "give one weight per regressor."
            )
        return np.asarray(self.transform) @ w

    def kernels(self, w: Any, length: int | None = None) -> dict[int, Any]:
        """Symmetric kernels in the domain of delays, as from `Volterra.kernels`."""
        return self.volterra.kernels(self.raw_weights(w), length)

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Unit of each weight, which is the unit of the output."""
        return (output_unit,) * self.size

    def step_sizes(self, by_degree: Mapping[int, Any]) -> Any:
        """A step size per weight (P,), from one per degree.

        Args:
            by_degree: Degree -> step size, which may be traced.
        """
        return spread(by_degree, self.degrees)


class Hermite(Orthogonalised):
    """Hermite polynomials of the whitened outputs of the bank, orthonormal for a Gaussian input.

        v = L^-1 z,  R1 = E[z z'] = L L';  psi = product of He_k(v_i) / sqrt(k!),  E[psi psi'] = I

    The square of a Gaussian variable has a mean, so `(v^2 - 1) / sqrt(2)` needs the constant, and a cube
    needs the linear terms: without these the polynomials leave the span of the series. For an input that is
    not Gaussian they are at best approximately orthogonal; `GramSchmidt` is exact for a given sample.

    Source: Wiener 1958; Schetzen 1980, chapter 13. Any whitening would do; this one is by Cholesky.

    >>> from rotflex_jax.basis import Delays
    >>> basis = Hermite.of(Volterra(Delays(2)), [[1.0, 0.8], [0.8, 1.0]])
    >>> basis.names
    ('1', 'H1(v1)', 'H1(v2)', 'H2(v1)', 'H1(v1) * H1(v2)', 'H2(v2)')
    """

    @classmethod
    def of(cls, volterra: Volterra, covariance: Any) -> "Hermite":
        """The polynomials for a covariance of the bank's outputs.

        Args:
            volterra: The raw regressors, with every lower degree of the same parity.
            covariance: Covariance R1 (M, M) of the outputs of the bank, whose mean is zero.

        Raises:
            InputError: A lower degree is missing, or the matrix is no covariance.
        """
        m, chosen = volterra.bank.size, set(volterra.chosen)
        for d in sorted(chosen):
            if d >= 2 and d - 2 not in chosen:
                what = "the constant (constant=True)" if d == 2 else f"the degree {d - 2}"
                raise InputError(
                    f"Hermite polynomials of degree {d} contain terms of degree {d - 2}, but the basis has "
                    f"only the degrees {', '.join(map(str, sorted(chosen)))}; add {what}, or use GramSchmidt."
                )
        whitening = np.linalg.inv(_cholesky(covariance, m))
        listed = [i for d in volterra.chosen for i in indices(m, d, "triangular")]
        columns = [_column(volterra, index, whitening) for index in listed]
        return cls(volterra, np.stack(columns, axis=1), tuple(map(_name, listed)), tuple(map(len, listed)))


class GramSchmidt(Orthogonalised):
    """Each regressor less its projection on the regressors before it, for a sample of any input.

        phi = Q R,  T = sqrt(N) R^-1

    Columns that depend linearly on earlier ones are left out. The regressors are orthonormal on that sample
    only, and not on another one, such as a short sample of the same distribution.

    Source: Golub and Van Loan 2013, section 5.2 (QR); Korenberg 1988 for its use with Volterra series.

    >>> from rotflex_jax.basis import Delays
    >>> u = np.random.default_rng(0).standard_normal(500)
    >>> psi = GramSchmidt.of(Volterra(Delays(2)), u).regressors(u)
    >>> bool(np.max(np.abs(psi.T @ psi / 500 - np.eye(6))) < 1e-12)
    True
    """

    @classmethod
    def of(cls, volterra: Volterra, u: Any) -> "GramSchmidt":
        """The transform for a sample of the input.

        Args:
            volterra: The raw regressors.
            u: Input (N,), at least as many samples as there are regressors.

        Raises:
            InputError: Too few samples.
        """
        phi = volterra.regressors(signal(u).astype(float))
        if len(phi) < volterra.size:
            raise InputError(
                f"Orthogonalising {volterra.size} regressors needs as many samples, but `u` has {len(phi)}; "
                "give a longer sample of the input."
            )
        size = np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
        independent: list[int] = []
        for k, left in enumerate(np.abs(np.diag(np.linalg.qr(phi / size, mode="r")))):
            if left > DEPENDENT_RESIDUAL:
                independent.append(k)
        R = np.linalg.qr(phi[:, independent], mode="r")
        R *= np.sign(np.diag(R))[:, None]  # so that each column keeps the sign of its regressor
        transform = np.zeros((volterra.size, len(independent)))
        transform[independent] = np.linalg.inv(R) * np.sqrt(len(phi))
        names, degrees = volterra.names, volterra.degrees
        titles = tuple(names[k] if k == 0 and names[k] == "1" else f"GS({names[k]})" for k in independent)
        return cls(volterra, transform, titles, tuple(int(degrees[k]) for k in independent))


def _cholesky(covariance: Any, m: int) -> Float[np.ndarray, "M M"]:
    R1 = np.asarray(covariance, float)
    if R1.shape != (m, m) or not np.allclose(R1, R1.T, rtol=1e-8, atol=0):
        raise InputError(
            f"Argument `covariance` must be a symmetric matrix of {m} rows, one per output of the bank, but "
            f"has the shape {R1.shape}; give E[z z'] of the bank's outputs."
        )
    try:
        return np.linalg.cholesky((R1 + R1.T) / 2)
    except np.linalg.LinAlgError as error:
        low = np.linalg.eigvalsh((R1 + R1.T) / 2)[0]
        raise InputError(
            f"Argument `covariance` must be positive definite, but has the eigenvalue {low:.2g}; take "
            "fewer outputs, or an input with more bandwidth."
        ) from error


def _hermite(power: int) -> dict[int, float]:
    """Power of v -> coefficient of `He_power(v) / sqrt(power!)`."""
    terms = np.polynomial.hermite_e.herme2poly([0.0] * power + [1.0]) / math.sqrt(math.factorial(power))
    return {k: float(c) for k, c in enumerate(terms) if c}


def _column(volterra: Volterra, index: Index, whitening: Float[np.ndarray, "M M"]) -> Float[np.ndarray, " P"]:
    """Raw weights of one product of Hermite polynomials."""
    m = volterra.bank.size
    by_degree = {d: np.zeros((m,) * d) for d in volterra.chosen}
    powers = Counter(index)
    for combination in itertools.product(*(_hermite(p).items() for p in powers.values())):
        factor, tensor = 1.0, np.ones(())
        for i, (power, coefficient) in zip(powers, combination, strict=True):
            factor *= coefficient
            for _ in range(power):
                tensor = np.multiply.outer(tensor, whitening[i])
        by_degree[tensor.ndim] += factor * tensor
    return np.concatenate([from_tensor(by_degree[d], m, volterra.layout) for d in volterra.chosen])


def _name(index: Index) -> str:
    return " * ".join(f"H{power}(v{i + 1})" for i, power in Counter(index).items()) or "1"
