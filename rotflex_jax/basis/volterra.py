"""Volterra series: weighted monomials of a bank's outputs."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rotflex_jax.basis.bank import Bank, evaluate
from rotflex_jax.checks import entries, shown, whole
from rotflex_jax.errors import InputError

Index = tuple[int, ...]
"""Columns of the bank that form a product; () is the constant."""


@cache
def indices(size: int, degree: int, layout: str) -> tuple[Index, ...]:
    """Products of one degree: each once ("triangular"), or in every order of its factors ("full").

    >>> indices(2, 2, "triangular")
    ((0, 0), (0, 1), (1, 1))
    >>> indices(2, 2, "full")
    ((0, 0), (0, 1), (1, 0), (1, 1))
    """
    if layout == "full":
        return tuple(itertools.product(range(size), repeat=degree))
    return tuple(itertools.combinations_with_replacement(range(size), degree))


@cache
def factors(size: int, degree: int, layout: str) -> Int[np.ndarray, "P d"]:
    """The products of `indices` as an array that cannot be written to: column k has the factor k of each.

    >>> factors(2, 2, "triangular").tolist()
    [[0, 0], [0, 1], [1, 1]]
    """
    listed = indices(size, degree, layout)
    found = np.array(listed, int).reshape(len(listed), degree)
    found.flags.writeable = False
    return found


def orders(index: Index) -> int:
    """Number of orders in which the factors of a product can be written.

    >>> orders((0, 0, 1))
    3
    """
    return math.factorial(len(index)) // math.prod(math.factorial(n) for n in Counter(index).values())


def title(index: Index, names: Sequence[str]) -> str:
    """Name of a product, such as `u[t]^2 * u[t-1]`.

    >>> title((0, 0, 1), ["u[t]", "u[t-1]"])
    'u[t]^2 * u[t-1]'
    """
    if not index:
        return "1"
    if len(index) == 1:
        return names[index[0]]
    words = []
    for k, power in Counter(index).items():
        name = f"({names[k]})" if " " in names[k] else names[k]
        words.append(f"{name}^{power}" if power > 1 else name)
    return " * ".join(words)


@cache
def positions(size: int, degree: int) -> Int[np.ndarray, "*M"]:
    """Position of every entry of a tensor (size, ...) in the triangular list."""
    place = {index: k for k, index in enumerate(indices(size, degree, "triangular"))}
    flat = [place[tuple(sorted(i))] for i in indices(size, degree, "full")]
    return np.array(flat, int).reshape((size,) * degree)


@cache
def counts(size: int, degree: int) -> Int[np.ndarray, " P"]:
    """`orders` of the triangular list."""
    return np.array([orders(i) for i in indices(size, degree, "triangular")], int)


def symmetric(kernel: Float[np.ndarray, "*L"]) -> Float[np.ndarray, "*L"]:
    """Mean over all orders of the axes, which leaves the output of a Volterra series unchanged."""
    axes = list(itertools.permutations(range(kernel.ndim)))
    return np.asarray(sum((np.transpose(kernel, a) for a in axes[1:]), kernel) / len(axes))


def to_tensor(w: Float[np.ndarray, " P"], size: int, degree: int, layout: str) -> Float[np.ndarray, "*M"]:
    """Symmetric tensor (size, ...) of the weights of one degree."""
    if layout == "full":
        return symmetric(w.reshape((size,) * degree))
    return (w / counts(size, degree))[positions(size, degree)]


def from_tensor(tensor: Float[np.ndarray, "*M"], size: int, layout: str) -> Float[np.ndarray, " P"]:
    """Weights of one degree from a tensor (size, ...) of any symmetry."""
    if layout == "full":
        return symmetric(tensor).ravel()
    places = positions(size, tensor.ndim)
    return np.bincount(places.ravel(), tensor.ravel(), minlength=len(counts(size, tensor.ndim)))


def change_axes(tensor: Float[np.ndarray, "*M"], matrix: Float[np.ndarray, "L m"]) -> Float[np.ndarray, "*L"]:
    """The matrix applied to every axis of a tensor (m, ...)."""
    for _ in range(tensor.ndim):
        # The first axis becomes the last, so the original order returns after all axes.
        tensor = np.tensordot(tensor, matrix, axes=(0, 1))
    return tensor


LARGEST_KERNEL = 20_000_000
"""Largest number of entries of one kernel, a limit for the memory."""


def kernels_of(
    bank: Bank, parts: Mapping[int, Float[np.ndarray, " P"]], layout: str, length: int | None
) -> dict[int, Any]:
    """Degree -> symmetric kernel (length, ...), from the weights of each degree.

    Args:
        bank: Bank of the series.
        parts: Degree -> weights.
        layout: Layout of the weights.
        length: Number of delays, from 0 [samples]; `bank.reach` if None.
    """
    length = whole(bank.reach if length is None else length, "length", 1)
    most = max(parts)
    if length**most > LARGEST_KERNEL:
        raise InputError(
            f"A kernel of degree {most} over {length} delays has {float(length**most):.1e} numbers, but at "
            f"most {LARGEST_KERNEL:.0e} are made; give a smaller `length`."
        )
    B = bank.impulse_responses(length)
    found: dict[int, Any] = {}
    for d, w in parts.items():
        found[d] = float(w[0]) if d == 0 else change_axes(to_tensor(w, bank.size, d, layout), B)
    return found


def weights_of(
    bank: Bank, kernels: Mapping[int, Any], layout: str, tolerance: float
) -> dict[int, Float[np.ndarray, " P"]]:
    """Degree -> weights, from kernels over the delays from 0 on.

    Args:
        bank: Bank of the series.
        kernels: Degree -> kernel (length, ...), of any symmetry.
        layout: Layout of the weights.
        tolerance: Share of a kernel that may lie outside the span of the bank.
    """
    found = {}
    for d, kernel in kernels.items():
        H = np.asarray(kernel, float)
        if H.ndim != d or len(set(H.shape)) > 1:
            raise InputError(
                f"A kernel of degree {d} must have {d} axes of one length, but has the shape {H.shape}; "
                "give it over the same delays on each axis."
            )
        if d == 0:
            found[d] = H[None]
            continue
        B = bank.impulse_responses(len(H))
        H = symmetric(H)
        tensor = change_axes(H, np.linalg.pinv(B))
        left, size = np.linalg.norm(change_axes(tensor, B) - H), np.linalg.norm(H)
        if left > tolerance * size:
            raise InputError(
                f"The kernel of degree {d} lies outside the span of the bank by {100 * left / size:.2g} % "
                "of its norm; take other poles or a longer memory, or give a larger `tolerance` for the "
                "best approximation."
            )
        found[d] = from_tensor(tensor, bank.size, layout)
    return found


Layout = Literal["triangular", "full"]


class Volterra(eqx.Module):
    """Monomials of a bank's outputs: the regressors of a Volterra series.

        y_hat[t] = w_0 + sum w_i z_i[t] + sum w_ij z_i[t] z_j[t] + ...,  z = outputs of the bank

    The full layout lists a product once for every order of its factors, as the sums over all delays are often
    written. Equal columns make it rank deficient, so least squares needs the minimum norm solution. Not for
    dry friction that sticks or for a strong threshold, which no low degree approximates.

    Args:
        bank: `Delays`, `Orthonormal`, or another bank.
        order: Highest degree; the series has all degrees from 1 to this one.
        degrees: The degrees, instead of `order`, such as (1, 3) for an odd plant.
        constant: Whether the series has a constant. Without it the even degrees also have to fit the
            mean of the output, and are biased.
        layout: "triangular" for each product once, or "full".

    Raises:
        InputError: Degrees or layout are not valid.

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
            tuple(range(1, whole(2 if order is None else order, "order", 1) + 1))
            if degrees is None
            else entries(degrees)
        )
        if listed is None:
            raise InputError(
                f"Argument `degrees` must be a list of degrees, but is {shown(degrees)}; give for instance "
                "(1, 2)."
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
        """Regressors for a signal, also in traced code."""
        return self.products(self.bank.respond(u))

    def products(self, z: Float[Array, "N M"]) -> Float[Array, "N P"]:
        """Regressors for outputs of the bank."""
        columns = []
        for d in self.chosen:
            picked = factors(self.bank.size, d, self.layout)
            product = jnp.ones((len(z), len(picked)), z.dtype)
            for k in range(d):
                product = product * z[:, picked[:, k]] if k else z[:, picked[:, 0]]
            columns.append(product)
        return jnp.concatenate(columns, axis=1)

    def regressors(self, u: Any) -> Float[np.ndarray, "N P"]:
        """Regressors for a signal, in its precision.

        Args:
            u: Signal (N,); zero before its first sample.
        """
        return evaluate(self, u)

    def units(self, input_unit: str = "V", output_unit: str = "rad") -> tuple[str, ...]:
        """Units of the weights.

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
            length: Number of delays, from 0 [samples]; `bank.reach` if None.

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
            kernels: Degree -> kernel over the delays from 0 on, of any symmetry; missing kernels are zero.
            tolerance: Share of a kernel that may lie outside the span of the bank; `numpy.inf` gives the
                best approximation in any case.

        Raises:
            InputError: The basis lacks a degree, the axes of a kernel have different lengths, or a kernel
                lies outside the span of the bank.
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
            by_degree: Degree -> step size, which may be traced.
            as_full: Whether to multiply the step size of a product by its number of orders, so that a filter
                in the triangular layout behaves exactly like a filter in the full layout.

        >>> from rotflex_jax.basis import Delays
        >>> Volterra(Delays(2)).step_sizes({0: 0.1, 1: 0.01, 2: 0.001}, as_full=True)
        array([0.1  , 0.01 , 0.01 , 0.001, 0.002, 0.001])
        """
        multiplicity = np.array(
            [orders(i) if as_full and self.layout == "triangular" else 1 for i in self.indices]
        )
        sizes = spread(by_degree, self.degrees)
        return sizes * multiplicity.astype(sizes.dtype)


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
