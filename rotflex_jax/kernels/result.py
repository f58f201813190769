"""Kernels of order zero to two of one output, and the agreement of two sets of kernels."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.errors import InputError


@dataclasses.dataclass(frozen=True, eq=False)
class Kernels:
    """The second-order Volterra series of one output about an input level.

        y[t] = h0 + sum_k h1[k] v[t-k] + sum_kj h2[k, j] v[t-k] v[t-j],   v = u - about

    Attributes:
        channel: Output.
        Ts: Sampling period [s]; kernels are per sample of the held input.
        h0: Output at the level `about` (local), or the constant of the series (average) [output_unit].
        h1: Linear kernel, index = lag in samples [output_unit / input_unit].
        h2: Quadratic kernel, symmetric [output_unit / input_unit^2].
        about: Input level about which the series is defined [input_unit].
        kind: "local", "average" or "identified".
        input: Input for which the kernels are valid, in words.
        note: Restriction on the use of the kernels; empty for none.
        covariance: Covariance of the input at the lags [input_unit^2]; if None, sizes are computed for white
            noise of unit variance.
        h0_std: Standard error of `h0`; zero for exact kernels.
        h1_std: Standard errors of `h1`; None for exact kernels.
        h2_std: Standard errors of `h2`; None for exact kernels.
        h3_diagonal: `h3[k, k, k]` of the cubic kernel [output_unit / input_unit^3], or None.
        input_unit: Unit of the input.
        output_unit: Unit of the output.
    """

    channel: str
    Ts: float
    h0: float
    h1: Real[np.ndarray, " M"]
    h2: Real[np.ndarray, "M M"]
    about: float = 0.0
    kind: str = "local"
    input: str = ""
    note: str = ""
    covariance: Real[np.ndarray, "M M"] | None = None
    h0_std: float = 0.0
    h1_std: Real[np.ndarray, " M"] | None = None
    h2_std: Real[np.ndarray, "M M"] | None = None
    h3_diagonal: Real[np.ndarray, " M"] | None = None
    input_unit: str = "V"
    output_unit: str = "rad"

    @property
    def memory(self) -> int:
        """Number of lags M."""
        return len(self.h1)

    @property
    def lags(self) -> Float[np.ndarray, " M"]:
        """Lags [s]."""
        return self.Ts * np.arange(self.memory)

    @property
    def spread(self) -> Real[np.ndarray, "M M"]:
        """Covariance of the input for sizes; the unit matrix if `covariance` is None."""
        return np.eye(self.memory) if self.covariance is None else self.covariance

    @property
    def errors(self) -> tuple[Real[np.ndarray, " M"], Real[np.ndarray, "M M"]]:
        """Standard errors of `h1` and `h2`; zero for exact kernels."""
        M = self.memory
        first = np.zeros(M) if self.h1_std is None else self.h1_std
        return first, np.zeros((M, M)) if self.h2_std is None else self.h2_std

    @property
    def sizes(self) -> tuple[float, float]:
        """Size of the linear and of the quadratic part of the output under a Gaussian input [output_unit].

        The linear size is the root mean square, the quadratic size the standard deviation.
        """
        return linear_size(self.h1, self.spread), quadratic_size(self.h2, self.spread)

    def units(self, degree: int) -> str:
        """Unit of the kernel of a degree, for instance "rad/V²"."""
        power = {0: "", 1: f"/{self.input_unit}", 2: f"/{self.input_unit}²", 3: f"/{self.input_unit}³"}
        return self.output_unit + power[degree]

    def moved(self, about: float) -> "Kernels":
        """The same series about another input level; standard errors to first order, without correlations.

        Args:
            about: New level [input_unit].
        """
        step = about - self.about
        first, second = self.errors
        twice = 2 * second - np.diag(np.diag(second))  # of the two equal entries off the diagonal together
        changes = (self.h0_std, *(step * first), *(step**2 * twice[np.triu_indices_from(twice)]))
        return dataclasses.replace(
            self,
            h0=float(self.h0 + step * np.sum(self.h1) + step**2 * np.sum(self.h2)),
            h1=self.h1 + 2 * step * np.sum(self.h2, axis=1),
            about=about,
            h0_std=float(np.linalg.norm(changes)),
            h1_std=np.hypot(first, 2 * step * np.sqrt(np.sum(second**2, axis=1))),
        )

    def response(self, u: Real[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        """Output of the series; before its first sample the input is assumed to be `about`.

        Args:
            u: Input [input_unit].
        """
        v = np.concatenate([np.zeros(self.memory - 1), np.asarray(u, float) - self.about])
        phi = np.lib.stride_tricks.sliding_window_view(v, self.memory)[:, ::-1]
        return self.h0 + phi @ self.h1 + np.einsum("tk,kj,tj->t", phi, self.h2, phi, optimize=True)

    def against(self, other: "Kernels") -> "Agreement":
        """Difference from other kernels in units of their standard errors.

        Args:
            other: Kernels of the same channel, units, sampling period and memory; they are converted to this
                input level.

        Raises:
            InputError: Channel, sampling period, memory or units differ.
        """
        units = [(self.output_unit, other.output_unit), (self.input_unit, other.input_unit)]
        for one, two in units:
            if one and two and one != two:
                raise InputError(
                    f"Kernels of {self.channel!r} in {self.units(1)} were compared with kernels in "
                    f"{other.units(1)}; form both in the same units."
                )
        mine, theirs = (self.channel, self.memory), (other.channel, other.memory)
        if mine != theirs or abs(self.Ts - other.Ts) > 1e-9 * self.Ts:
            raise InputError(
                f"Kernels of {self.channel!r} with {self.memory} lags of {self.Ts:g} s were compared with "
                f"those of {other.channel!r} with {other.memory} lags of {other.Ts:g} s; form both for "
                "the same channel, sampling period and memory."
            )
        return Agreement(self, other.moved(self.about))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON."""
        listed = lambda a: a.tolist() if isinstance(a, np.ndarray) else a  # noqa: E731
        out = {f.name: listed(getattr(self, f.name)) for f in dataclasses.fields(self)}
        return out | {"lags": self.lags.tolist(), "units": [self.units(d) for d in range(3)]}

    def __str__(self) -> str:
        peak = int(np.argmax(np.abs(self.h1)))
        first, second = self.sizes
        i, j = np.unravel_index(np.argmax(np.abs(self.h2)), self.h2.shape)
        lines = [
            f"{self.kind.capitalize()} kernels of {self.channel}, {self.memory} lags of {self.Ts:g} s"
            f"{f' ({self.input})' if self.input else ''}",
            f"  h0 {self.h0:.4g} {self.units(0)}{_plus(self.h0_std)}",
            f"  h1 largest at {self.lags[peak]:g} s: {self.h1[peak]:.4g} {self.units(1)}"
            f"{_plus(self.errors[0][peak])}; gives {first:.3g} {self.output_unit} rms",
            f"  h2 largest at ({self.lags[i]:g} s, {self.lags[j]:g} s): {self.h2[i, j]:.4g} {self.units(2)}"
            f"{_plus(self.errors[1][i, j])}; gives {second:.3g} {self.output_unit} rms",
        ]
        return "\n".join(lines + [f"  {self.note}"] * bool(self.note))


@dataclasses.dataclass(frozen=True, eq=False)
class Agreement:
    """Two sets of kernels side by side.

    Attributes:
        first: First set, usually the kernels of the model.
        second: Second set, usually the kernels identified from data.
    """

    first: Kernels
    second: Kernels

    @property
    def z1(self) -> Float[np.ndarray, " M"]:
        """Difference of `h1` over its standard error; NaN where neither set has one."""
        return _over(self.first.h1 - self.second.h1, self.first.errors[0], self.second.errors[0])

    @property
    def z2(self) -> Float[np.ndarray, "M M"]:
        """Difference of `h2` over its standard error; NaN where neither set has one."""
        return _over(self.first.h2 - self.second.h2, self.first.errors[1], self.second.errors[1])

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of `z1` and of `z2`: about one if the two sets differ by chance only."""
        upper = self.z2[np.triu_indices(len(self.z2))]
        return root_mean_square(self.z1), root_mean_square(upper)

    @property
    def relative(self) -> tuple[float, float]:
        """Sizes of the differences of `h1` and `h2`, as shares of the linear response of the second set."""
        whole = self.second.sizes[0] or 1.0
        spread = self.second.spread
        first = linear_size(self.first.h1 - self.second.h1, spread)
        return first / whole, quadratic_size(self.first.h2 - self.second.h2, spread) / whole

    def __str__(self) -> str:
        rows = zip((1, 2), self.relative, self.rms, strict=True)
        return "\n".join(
            f"h{degree} of {self.first.kind} and {self.second.kind} kernels differ by {100 * share:.2g} % of "
            f"the linear response, {z:.2g} standard errors (rms)"
            for degree, share, z in rows
        )


def linear_size(h1: Real[np.ndarray, " M"], covariance: Real[np.ndarray, "M M"]) -> float:
    """Root mean square of the linear part, `sqrt(h1' R h1)`."""
    return float(np.sqrt(max(h1 @ covariance @ h1, 0.0)))


def quadratic_size(h2: Real[np.ndarray, "M M"], covariance: Real[np.ndarray, "M M"]) -> float:
    """Standard deviation of the quadratic part under a Gaussian input, `sqrt(2 tr(h2 R h2 R))`."""
    product = h2 @ covariance
    return float(np.sqrt(max(2 * np.sum(product * product.T), 0.0)))


def root_mean_square(z: Float[np.ndarray, "..."]) -> float:
    """Root mean square of the finite entries; zero if there are none."""
    finite = z[np.isfinite(z)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0


def _over(difference: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    error = np.hypot(first, second)
    known = error > 1e-12 * np.max(error, initial=0.0)
    return np.where(known, difference / np.where(known, error, 1.0), np.nan)


def _plus(std: float) -> str:
    return f" ± {std:.2g}" if std > 0 else ""
