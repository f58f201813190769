"""Result of a grey-box fit: the model, its parameters with intervals, and how it was reached."""

import dataclasses
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.comparison import compare_plot
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.text.markup import card, paragraph, picture, table
from rotflex_jax.text.numbers import plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.svg import bars

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted model and how it was reached.

    Attributes:
        model: The fitted model.
        cost: Negative log-likelihood per recording sample set, constants included [nat].
        status: "converged", or in words what stopped the fit.
        parameters: Estimates, free and held.
        noise: Standard deviation of the residual per channel [unit of the channel].
        covariance: Of the F free parameters [declared units], in the order of `free_names`.
        free_names: Full names of the free parameters.
        steps: Iterations that led here.
        history: Negative log-likelihood after each minimisation that led here, constants left out [nat].
        weakest: Direction of the free parameters (in shares of their values) that the data determine least.
        local: Parameter that each recording has for itself -> its estimates, in the order of the
            recordings; `parameters` has the mean.
        remarks: Parameters at a bound, or far beyond what the recordings reach, each with a sentence.
    """

    model: Model
    cost: float
    status: str
    parameters: tuple[Estimate, ...]
    noise: dict[str, float]
    covariance: Float[np.ndarray, "F F"]
    free_names: tuple[str, ...]
    steps: int
    history: tuple[float, ...] = ()
    weakest: dict[str, float] = dataclasses.field(default_factory=dict)
    local: dict[str, tuple[Estimate, ...]] = dataclasses.field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()

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

    @property
    def ending(self) -> str:
        """How the fit ended and after how many steps, each said once."""
        counted = re.search(r"\bafter \d+ steps\b", self.status)
        return self.status if counted else f"{self.status} after {self.steps} steps"

    def save(self, path: str | Path) -> Path:
        """Write the model as JSON, with estimates and their covariance; `Model.load` reads the model."""
        from rotflex_jax.models.model_json import Saved, save  # the layer above, on request

        return save(Saved(self.model, self.parameters, self.covariance, self.free_names), path)

    def plot(self, recording: Recording, seconds: float | None = None) -> "Figure":
        """Measured against simulated outputs, with errors and the fit in per cent; a notebook shows it.

        Args:
            recording: What was measured, best one that was not fitted.
            seconds: Runs start again so often [s]; one free run over all of it unless given.
        """
        return compare_plot(recording, self, seconds=seconds)

    def _repr_html_(self) -> str:
        """How the fit ended, its residuals, and every parameter with unit and interval."""
        residuals, estimates, widths = [], [], []
        for channel, own in output_units(self.model.mechanism).items():
            value, unit = readable(self.noise[channel], own)
            residuals.append((channel, unit, plain_number(value)))
        for e in sorted(self.parameters, key=lambda e: not e.free):
            note = e.note if e.free else "held"
            estimates.append((e.name, unit_text(e.unit), note, *value_and_interval(e)))
        for e in self.parameters:
            width = 100 * 1.96 * e.std / abs(e.value) if e.free and e.value else math.nan
            widths.append((e.name, width, f"± {width:.2g} %"))
        return card(
            f"Fit: {self.ending}, cost {plain_number(self.cost, 4)} nat",
            table(("channel", "unit", "rms residual"), residuals, words=2),
            table(("parameter", "unit", "", "value", "95 %"), estimates, words=3),
            *(paragraph(remark.sentence) for remark in self.remarks),
            picture(
                bars(widths, "half of the 95 % interval, share of the value [%]"),
                "Width of the interval of each free parameter.",
            ),
        )

    def __str__(self) -> str:
        lines = [f"Fit: {self.ending}, cost {self.cost:.1f}"]
        lines += [f"  residual {c}: {s:.3g} rms" for c, s in self.noise.items()]
        lines += [f"  {e}" for e in self.parameters]
        return "\n".join(lines + [f"  {remark.sentence}" for remark in self.remarks])
