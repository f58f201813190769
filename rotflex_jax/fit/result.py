"""Result of a grey-box fit: the model, its parameters with intervals, and how it was reached."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.comparison import compare_plot
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.text.markup import card, paragraph, picture, table
from rotflex_jax.text.numbers import plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.svg import bars

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rotflex_jax.fit.profile_result import Profile, Quantity


# A parameter with a bound whose 95 % interval is wider than this share of it, to either side, hardly has a
# symmetric one.
WIDE_INTERVAL = 0.3


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """How a fit was asked for, so that what follows from it asks the same.

    Attributes:
        process_noise: Port -> intensity of the process torque [(N m)^2 s]; None for a free run.
        local: Parameters that each recording has for itself.
        first: Whether first states were fitted, or held at what the first samples show.
        window_seconds: Runs started again so often [s]; None for whole recordings.
        max_steps: Most iterations of each minimisation.
        restarts: Most restarts.
        bend: Errors of each channel beyond which they counted by their size [unit of the channel]; None where
            all counted by their square.
    """

    process_noise: dict[str, float] | None = None
    local: tuple[str, ...] = ()
    first: str = "fitted"
    window_seconds: float | None = None
    max_steps: int = 60
    restarts: int = 8
    bend: tuple[float, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Fit:
    """A fitted model and how it was reached.

    Attributes:
        model: The fitted model.
        cost: Negative log-likelihood of all samples of all recordings, constants included [nat].
        status: "converged", or in words what stopped the fit.
        parameters: Estimates, free and held.
        noise: Standard deviation of the residual per channel [unit of the channel].
        covariance: Of the F free parameters [declared units], in the order of `free_names`.
        free_names: Full names of the free parameters.
        steps: Iterations of all attempts together.
        history: Negative log-likelihood after each minimisation that led here, constants left out [nat].
        local: Parameter that each recording has for itself -> its estimates, in the order of the
            recordings; `parameters` has the mean.
        remarks: Parameters at a bound, far beyond what the recordings reach, or moved by steps of integration
            that are too long, each with a sentence.
        options: How it was asked for.
        Ts: Sampling period of the first recording [s], which a saved model keeps; None where none is known.
        n_init: Samples at its start that the fit looked at, or None.
        data: Digest of the recordings, in their order; "" where it is not known.
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
    local: dict[str, tuple[Estimate, ...]] = dataclasses.field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()
    options: FitOptions = FitOptions()
    Ts: float | None = None
    n_init: int | None = None
    data: str = ""

    @property
    def profile_advised(self) -> tuple[str, ...]:
        """Free parameters whose symmetric interval is in doubt by its own numbers, without any run.

        They have no interval, or one that reaches a bound, or a bound and an interval of more than 30 % to
        either side. `rotflex_jax.profile` gives them a better one.
        """
        m = self.model.mechanism
        specs = dict(zip(m.parameter_names, m.parameter_specifications, strict=True))
        found = []
        for e in self.parameters:
            spec, half = specs[e.name], HALF_WIDTH_95 * e.std
            bounds = [b for b in (spec.lower, spec.upper) if math.isfinite(b)]
            room = min((abs(e.value - b) for b in bounds), default=math.inf)
            if e.free and not half <= WIDE_INTERVAL * room:
                found.append(e.name)
        return tuple(found)

    def profile(self, of: "Quantity", recordings: "Recording | Sequence[Recording]") -> "Profile":
        """Profile likelihood of a parameter or of a function of parameters; as `rotflex_jax.profile`.

        Args:
            of: Full name, or a function from the values by full name to a number.
            recordings: Those that were fitted.
        """
        from rotflex_jax.fit.profile import profile  # imported on request: it needs this module

        return profile(self, recordings, of)

    def profiles(self, recordings: "Recording | Sequence[Recording]") -> "dict[str, Profile]":
        """Profiles of the parameters for which one is advised, by full name.

        Args:
            recordings: Those that were fitted.
        """
        return {name: self.profile(name, recordings) for name in self.profile_advised}

    def model_of(self, recording: int) -> Model:
        """The model with the local parameters of one of the fitted recordings, by its number."""
        return self.model.with_values({name: each[recording].value for name, each in self.local.items()})

    def with_values(self, values: Mapping[str, float]) -> "Fit":
        """The fit with other values of some parameters in its model; its estimates stay."""
        return dataclasses.replace(self, model=self.model.with_values(values))

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
        """Write model, estimates, covariance and sampling period as JSON; `Model.load` reads the model."""
        from rotflex_jax.models.model_json import Saved, save  # the layer above, on request

        own = self.model, self.parameters, self.covariance, self.free_names
        return save(Saved(*own, self.Ts, self.n_init), path)

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
            note = e.remark if e.free else e.note or "held"
            estimates.append((e.name, unit_text(e.unit), note, *value_and_interval(e)))
        for e in self.parameters:
            width = 100 * HALF_WIDTH_95 * e.std / abs(e.value) if e.free and e.value else math.nan
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
