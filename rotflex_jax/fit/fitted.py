"""What a grey-box fit returns: the model, its parameters with intervals, and how it was reached."""

import dataclasses
from pathlib import Path

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.model import Model
from rotflex_jax.parameters import Estimate


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted model and how it was reached.

    Attributes:
        model: The fitted model.
        cost: Negative log-likelihood per recording sample set, constants included [nat].
        status: "converged", or in words what stopped the fit.
        parameters: Estimates, free and held.
        noise: Standard deviation of the residual per channel [unit of the channel].
        covariance: Of the free parameters [declared units], in the order of `free_names`.
        free_names: Full names of the free parameters.
        steps: Iterations on the way that ended here.
        history: Half the squared error after each descent of that way.
        weakest: Direction of the free parameters (in shares of their values) that the data say least of.
        local: Parameter that each recording has for itself -> its estimates, in the order of the
            recordings; `parameters` has the mean.
    """

    model: Model
    cost: float
    status: str
    parameters: tuple[Estimate, ...]
    noise: dict[str, float]
    covariance: np.ndarray
    free_names: tuple[str, ...]
    steps: int
    history: tuple[float, ...] = ()
    weakest: dict[str, float] = dataclasses.field(default_factory=dict)
    local: dict[str, tuple[Estimate, ...]] = dataclasses.field(default_factory=dict)

    def model_of(self, recording: int) -> Model:
        """The model with the local parameters of one of the fitted recordings, by its number."""
        own = {name: each[recording].value for name, each in self.local.items()}
        return dataclasses.replace(self.model, mechanism=self.model.mechanism.with_values(own))

    def __getitem__(self, name: str) -> Estimate:
        """An estimate by full name."""
        for estimate in self.parameters:
            if estimate.name == name:
                return estimate
        raise InputError(
            f"Parameter {name!r} was asked for, but the fit has "
            f"{', '.join(e.name for e in self.parameters)}; use one of these names."
        )

    def save(self, path: str | Path) -> Path:
        """Write the model as JSON, with estimates and their covariance; `Model.load` reads the model."""
        from rotflex_jax.export.files import Saved, save  # the layer above, on request

        return save(Saved(self.model, self.parameters, self.covariance, self.free_names), path)

    def _repr_html_(self) -> str:
        from rotflex_jax.display.cards import fit_card  # the layer above, when a notebook asks

        return fit_card(self)

    def __str__(self) -> str:
        lines = [f"Fit: {self.status} after {self.steps} steps, cost {self.cost:.1f}"]
        lines += [f"  residual {c}: {s:.3g} rms" for c, s in self.noise.items()]
        return "\n".join(lines + [f"  {e}" for e in self.parameters])
