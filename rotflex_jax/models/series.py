"""A model with fixed weights on a basis, such as a Volterra series: the result of filters and linear fits."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Basis
from rotflex_jax.basis.bank import require_basis
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import single
from rotflex_jax.recording.samples import require_period, sampling_period


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """A weighted sum of the regressors that a basis forms from the input.

        y_hat[t] = sum over p of w_p phi_p[t]

    The output depends on the input alone, which is taken as zero before the first sample: the first samples,
    up to the memory of the basis, are valid only if the plant started at rest.

    Attributes:
        basis: Forms the regressors from the input.
        weights: One weight for each regressor.
        channel: Output that the series models.
        Ts: Sampling period for which the series holds [s].
        input_unit: Unit of the input.
        output_unit: Unit of the output.

    Raises:
        InputError: The weights are not as many as the regressors, or are not finite.

    >>> from rotflex_jax.basis import Delays, Volterra
    >>> series = Series(Volterra(Delays(2), order=1), np.array([0.5, 1.0, 2.0]), "alpha", 0.01)
    >>> recording = Recording(u=[1.0, 0.0, 0.0], y=[0.0, 0.1, 0.2], Ts=0.01, channels="alpha", accept="short")
    >>> series.simulate(recording)[:, 0]
    array([1.5, 2.5, 0.5])
    """

    basis: Basis
    weights: Float[np.ndarray, " P"]
    channel: str
    Ts: float
    input_unit: str = "V"
    output_unit: str = "rad"

    def __post_init__(self) -> None:
        require_basis(self.basis)
        weights = np.array(self.weights)
        if weights.shape != (self.basis.size,) or weights.dtype.kind not in "iuf":
            raise InputError(
                f"The basis has {self.basis.size} regressors, but the weights are {weights.dtype.name} of "
                f"shape {weights.shape}; give one real weight per regressor."
            )
        if not np.isfinite(weights).all():
            raise InputError(
                f"Weight {self.basis.names[int(np.argmin(np.isfinite(weights)))]!r} is not finite; a filter "
                "that diverged gives no model, so take smaller step sizes."
            )
        weights.setflags(write=False)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "Ts", sampling_period(self.Ts))

    @property
    def channels(self) -> tuple[str, ...]:
        """The one output."""
        return (self.channel,)

    def measured(self, recording: Recording) -> Float[np.ndarray, "N 1"]:
        """The measured channel."""
        return single(recording).channel(self.channel)[:, None]

    def simulate(self, recording: Recording) -> Float[np.ndarray, "N 1"]:
        """Free run over a recording, from its input alone, in the precision of the recording.

        Raises:
            InputError: The recording has another sampling period.
        """
        recording = single(recording)
        require_period(self.Ts, recording.Ts, "The series holds")
        phi = self.basis.regressors(recording.u)
        return (phi @ self.weights.astype(phi.dtype))[:, None]

    def kernels(self, length: int | None = None) -> dict[int, Any]:
        """Degree -> symmetric kernel in the domain of delays [output_unit / input_unit^degree].

        Args:
            length: Number of delays, from 0 on [samples]; as far as the basis reaches if None.
        """
        return dict(self.basis.kernels(self.weights, length))

    def __str__(self) -> str:
        units = self.basis.units(self.input_unit, self.output_unit)
        lines = [f"Series of {self.channel}, {self.basis.size} terms, every {self.Ts:g} s"]
        rows = zip(self.basis.names, self.weights, units, strict=True)
        return "\n".join(lines + [f"  {name}: {w:.6g} {unit}" for name, w, unit in rows])
