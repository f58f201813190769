"""Volterra series: weighted monomials of a bank's outputs."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.basis.bank import Bank, evaluate, whole
from rotflex_jax.basis.kernels import kernels_of, weights_of
from rotflex_jax.basis.monomials import Index, indices, orders, title
from rotflex_jax.errors import InputError

Layout = Literal["triangular", "full"]


class Volterra(eqx.Module):
    """Monomials of a bank's outputs: the regressors of a Volterra series.

        y_hat[t] = w_0 + sum w_i z_i[t] + sum w_ij z_i[t] z_j[t] + ...,  z = outputs of the bank

    The full layout lists a product once for every order of its factors, as the sums over all delays
    are often written; equal columns make it rank deficient, so least squares needs the minimum norm.
    Not for friction that sticks, nor for a strong threshold: no low degree comes near.

    Args:
        bank: `Delays`, `Orthonormal`, or one's own.
        order: All degrees from 1 to this one.
        degrees: The degrees instead, such as (1, 3) where the plant is odd.
        constant: Whether there is a constant. Without it the even degrees also have to carry the
            mean of the output, and bend.
        layout: "triangular", each product once, or "full".

    Raises:
        InputError: Degrees, layout or step sizes that make no sense.

    Source: Schetzen 1980, The Volterra and Wiener theories of nonlinear systems.

    >>> from rotflex_jax.basis import Delays
    >>> basis = Volterra(Delays(2))
    >>> basis.names
    ('1', 'u[t]', 'u[t-1]', 'u[t]^2', 'u[t] * u[t-1]', 'u[t-1]^2')
    >>> basis.regressors([2.0, 3.0])
    array([[1., 2., 0., 4., 0., 0.],
           [1., 3., 2., 9., 6., 4.]])
    >>> basis.kernels([0.5, 1.0, 2.0, 0.0, 3.0, 0.0])[2]
    array([[0. , 1.5],
           [1.5, 0. ]])
    """

    bank: Any
    chosen: tuple[int, ...] = eqx.field(static=True)
    layout: str = eqx.field(static=True)

    def __init__(
        self,
        bank: Bank,
        order: int | None = None,
        *,
        degrees: Sequence[int] | None = None,
        constant: bool = True,
        layout: Layout = "triangular",
    ) -> None:
        if order is not None and degrees is not None:
            raise InputError(
                f"Arguments `order` ({order}) and `degrees` ({tuple(degrees)}) were both given, but say "
                "the same thing; give one of them."
            )
        listed = (
            range(1, whole(2 if order is None else order, "order", 1) + 1) if degrees is None else degrees
        )
        wanted = sorted({whole(d, "degrees", 0) for d in listed} | ({0} if constant else set()))
        if layout not in ("triangular", "full"):
            raise InputError(
                f"Argument `layout` must be 'triangular' or 'full', but is {layout!r}; choose one."
            )
        if not wanted:
            raise InputError(
                "Argument `degrees` lists no degree and there is no constant; give for instance (1, 2)."
            )
        if not all(hasattr(bank, name) for name in ("size", "names", "respond", "impulse_responses")):
            raise InputError(
                f"Argument `bank` must turn a signal into columns, but is {bank!r}; give for instance "
                "Delays(5) or Orthonormal.at(poles, Ts)."
            )
        self.bank = bank
        self.chosen = tuple(wanted)
        self.layout = layout

    @property
    def indices(self) -> tuple[Index, ...]:
        """Columns of the bank that each regressor multiplies; () for the constant."""
        return tuple(i for d in self.chosen for i in indices(self.bank.size, d, self.layout))

    @property
    def size(self) -> int:
        """Number of regressors."""
        return sum(len(indices(self.bank.size, d, self.layout)) for d in self.chosen)

    @property
    def names(self) -> tuple[str, ...]:
        """`1`, `u[t]`, `u[t]^2`, `u[t] * u[t-1]`, ..."""
        names = self.bank.names
        return tuple(title(i, names) for i in self.indices)

    @property
    def degrees(self) -> Int[np.ndarray, " P"]:
        """Degree of each regressor, 0 for the constant."""
        return np.array([len(i) for i in self.indices], int)

    def respond(self, u: Float[Array, " N"]) -> Float[Array, "N P"]:
        """Regressors for a signal, inside of traced code too."""
        return self.products(self.bank.respond(u))

    def products(self, z: Float[Array, "N M"]) -> Float[Array, "N P"]:
        """Regressors for outputs of the bank."""
        columns = []
        for d in self.chosen:
            listed = indices(self.bank.size, d, self.layout)
            factors = np.array(listed, int).reshape(len(listed), d)
            product = jnp.ones((len(z), len(listed)), z.dtype)
            for k in range(d):
                product = product * z[:, factors[:, k]] if k else z[:, factors[:, 0]]
            columns.append(product)
        return jnp.concatenate(columns, axis=1)

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal, in its precision.

        Args:
            u: Signal (N,); zero before its first sample.
        """
        return evaluate(self, u)

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Of the weights.

        >>> from rotflex_jax.basis import Delays
        >>> Volterra(Delays(1), order=3).units()
        ('rad', 'rad/V', 'rad/V^2', 'rad/V^3')
        """
        power = {0: output_unit, 1: f"{output_unit}/{input_unit}"}
        return tuple(power.get(d, f"{output_unit}/{input_unit}^{d}") for d in self.degrees)

    def kernels(self, w: Any, length: int | None = None) -> dict[int, Any]:
        """Symmetric kernels in the domain of delays.

            H_d[k_1, ..., k_d] = sum over i of W[i_1, ..., i_d] b_i1[k_1] ... b_id[k_d]

        Args:
            w: Weights (P,).
            length: Delays from 0 to give [samples]; as far as the bank reaches unless given.

        Returns:
            Degree -> kernel (length, ...); of degree 0 a number.
        """
        w = np.asarray(w, float)
        if w.shape != (self.size,):
            raise InputError(
                f"The basis has {self.size} regressors, but the weights have the shape {w.shape}; "
                "give one weight per regressor."
            )
        parts = {d: w[self.degrees == d] for d in self.chosen}
        return kernels_of(self.bank, parts, self.layout, length)

    def weights(self, kernels: Mapping[int, Any], tolerance: float = 1e-6) -> Float[np.ndarray, " P"]:
        """Weights of given kernels; the inverse of `kernels`.

        Args:
            kernels: Degree -> kernel over the delays from 0 on, of any symmetry; those left out are zero.
            tolerance: Part of a kernel that may lie outside of what the bank spans; `numpy.inf` gives
                the best approximation, whatever is lost.

        Raises:
            InputError: A degree that the basis lacks, a kernel that is no cube, or one that the bank does
                not span.
        """
        strange = sorted(set(kernels) - set(self.chosen))
        if strange:
            raise InputError(
                f"A kernel of degree {strange[0]} was given, but the basis has the degrees "
                f"{', '.join(map(str, self.chosen))}; add the degree to the basis, or leave the kernel out."
            )
        found = weights_of(self.bank, kernels, self.layout, tolerance)
        counts = {d: len(indices(self.bank.size, d, self.layout)) for d in self.chosen}
        return np.concatenate([found.get(d, np.zeros(count)) for d, count in counts.items()])

    def step_sizes(self, by_degree: Mapping[int, Any], as_full: bool = False) -> Any:
        """A step size per weight (P,), from one per degree.

        Args:
            by_degree: Degree -> step size, a number or a traced one.
            as_full: Multiply that of a product by the number of its orders, so that a triangular
                filter moves exactly as one in the full layout does.

        >>> from rotflex_jax.basis import Delays
        >>> Volterra(Delays(2)).step_sizes({0: 0.1, 1: 0.01, 2: 0.001}, as_full=True)
        array([0.1  , 0.01 , 0.01 , 0.001, 0.002, 0.001])
        """
        often = np.array([orders(i) if as_full and self.layout == "triangular" else 1 for i in self.indices])
        sizes = spread(by_degree, self.degrees)
        return sizes * often.astype(sizes.dtype)


def spread(by_degree: Mapping[int, Any], degrees: Int[np.ndarray, " P"]) -> Any:
    """One value per regressor (P,) from one per degree, which may be traced.

    >>> spread({0: 0.5, 1: 0.1}, np.array([0, 1, 1]))
    array([0.5, 0.1, 0.1])
    """
    listed, places = np.unique(degrees, return_inverse=True)
    missing = [int(d) for d in listed if d not in by_degree]
    if missing:
        raise InputError(
            f"Step sizes were given for the degrees {', '.join(map(str, sorted(by_degree)))}, but the "
            f"basis also has {missing[0]}; give one for each degree, 0 for a weight that stays."
        )
    values = [by_degree[int(d)] for d in listed]
    if any(isinstance(value, jax.Array) for value in values):
        return jnp.stack([jnp.asarray(value) for value in values])[places]
    return np.array(values, float)[places]
