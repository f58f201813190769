"""Result of a grey-box fit: the model, its parameters with intervals, and how it was reached."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.comparison import compare_plot
from rotflex_jax.models.model import Model
from rotflex_jax.models.model_json import Saved, save
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.text.markup import card, paragraph, picture, table
from rotflex_jax.text.numbers import plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.svg import bars

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rotflex_jax.fit.profile_result import Profile, Quantity


# A symmetric 95 % interval is in doubt if its half width exceeds this share of the distance to the nearest
# bound.
WIDE_INTERVAL = 0.3


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Options of a fit, so that later computations such as a profile use the same.

    Attributes:
        process_noise: Port -> intensity of the process noise [(N m)^2 s]; None for a free run.
        local: Full names of parameters with a value for each recording.
        first: "fitted" if first states were fitted, "measured" if they were held at what first samples show.
        window_seconds: Length of windows after which runs started again [s]; None for whole recordings.
        max_steps: Largest number of iterations of each minimisation.
        restarts: Largest number of restarts.
        bend: Size of an error in each channel beyond which errors counted linearly [unit of the channel];
            None if all errors counted by their square.
        ranges: Least and largest unconstrained value of each parameter. They depend on the start of the fit,
            see `physical_ranges`; None to derive them from the fitted model.
    """

    process_noise: dict[str, float] | None = None
    local: tuple[str, ...] = ()
    first: str = "fitted"
    window_seconds: float | None = None
    max_steps: int = 60
    restarts: int = 8
    bend: tuple[float, ...] | None = None
    ranges: tuple[tuple[float, ...], tuple[float, ...]] | None = None


class RunResidual(NamedTuple):
    """Residual of a fit in one of its recordings.

    Attributes:
        source: Where the recording comes from.
        rms: Channel -> root mean square of the residual [unit of the channel].
    """

    source: str
    rms: dict[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model and how it was reached.

    Attributes:
        model: The fitted model.
        cost: Negative log-likelihood of all samples of all recordings, constants included [nat].
        status: "converged", or in words what stopped the fit.
        parameters: Estimates of all parameters, free and held.
        noise: Channel -> root mean square of the residual [unit of the channel].
        covariance: Covariance of the F free parameters [declared units], in the order of `free_names`.
        free_names: Full names of the free parameters.
        steps: Number of evaluations in all attempts together.
        history: Negative log-likelihood after each minimisation that led here, without constants [nat].
        local: Full name of each local parameter -> its estimates in each recording; `parameters` has the
            mean.
        remarks: Remarks on parameters at a bound, far beyond what the recordings reach, or changed by
            integration steps that are too long.
        options: Options of the fit.
        Ts: Sampling period of the first recording [s], which a saved model keeps; None if unknown.
        n_init: Number of first samples of the first recording that give its first state; None if unknown.
        data: Digest of the recordings, in their order; "" if unknown.
        residuals: Residual in each recording, in their order; empty if unknown.
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
    residuals: tuple[RunResidual, ...] = ()

    @property
    def profile_advised(self) -> tuple[str, ...]:
        """Free parameters whose symmetric interval is in doubt; no run is needed to see this.

        They have no interval; or they have a bound, and half the width of the interval is more than 30 % of
        the distance to it. `rotflex_jax.profile` gives a better interval.
        """
        m = self.model.mechanism
        specs = dict(zip(m.parameter_names, m.parameter_specifications, strict=True))
        found = []
        for e in self.parameters:
            spec, half = specs[e.name], HALF_WIDTH_95 * e.std
            bounds = [b for b in (spec.lower, spec.upper) if math.isfinite(b)]
            to_bound = min((abs(e.value - b) for b in bounds), default=math.inf)
            if e.free and not half <= WIDE_INTERVAL * to_bound:
                found.append(e.name)
        return tuple(found)

    def profile(self, of: "Quantity", recordings: "Recording | Sequence[Recording]") -> "Profile":
        """Profile likelihood of a parameter or of a function of parameters; see `rotflex_jax.profile`.

        Args:
            of: Full name of a parameter, or a function of the values by full name that gives a number.
            recordings: The recordings that were fitted.
        """
        from rotflex_jax.fit.profile import profile  # imported on request: it needs this module

        return profile(self, recordings, of)

    def profiles(self, recordings: "Recording | Sequence[Recording]") -> "dict[str, Profile]":
        """Full name -> profile, for the parameters of `profile_advised`.

        Args:
            recordings: The recordings that were fitted.
        """
        return {name: self.profile(name, recordings) for name in self.profile_advised}

    def model_of(self, recording: int) -> Model:
        """The model with the local parameters of one of the fitted recordings, given by its index."""
        return self.model.with_values({name: each[recording].value for name, each in self.local.items()})

    def with_values(self, values: Mapping[str, float]) -> "Fit":
        """The fit with other values of some parameters in its model; its estimates do not change."""
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
        """The status of the fit and the number of steps, in words."""
        counted = re.search(r"\bafter \d+ steps\b", self.status)
        return self.status if counted else f"{self.status} after {self.steps} steps"

    def save(self, path: str | Path) -> Path:
        """Write model, estimates, covariance and sampling period as JSON; `Model.load` reads the model."""
        own = self.model, self.parameters, self.covariance, self.free_names
        return save(Saved(*own, self.Ts, self.n_init), path)

    def plot(self, recording: Recording, seconds: float | None = None) -> "Figure":
        """Figure of measured and simulated outputs, with errors and the fit in per cent.

        Args:
            recording: A recording, preferably one that was not fitted.
            seconds: Length of windows after which runs start again [s]; None for one free run over all of it.
        """
        return compare_plot(recording, self, seconds=seconds)

    def _extremes(self, channel: str, unit: str) -> str:
        """The recordings with the least and the largest residual, in words; empty for one recording."""
        if len(self.residuals) < 2:
            return ""
        sources = [r.source for r in self.residuals]
        names = [s if s and sources.count(s) == 1 else f"recording {k + 1}" for k, s in enumerate(sources)]
        sizes = [r.rms[channel] for r in self.residuals]
        least, largest = int(np.argmin(sizes)), int(np.argmax(sizes))
        shown = (readable(sizes[k], unit) for k in (least, largest))
        low, high = (f"{value:.3g} {read}".rstrip() for value, read in shown)
        return f"from {low} in {names[least]} to {high} in {names[largest]}"

    def _repr_html_(self) -> str:
        """A card with the status of the fit, its residuals, and every parameter with unit and interval."""
        residuals, estimates, widths = [], [], []
        units = output_units(self.model.mechanism)
        extremes = [(channel, self._extremes(channel, own)) for channel, own in units.items()]
        for channel, own in units.items():
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
            *(paragraph(f"{channel}: {said}") for channel, said in extremes if said),
            table(("parameter", "unit", "", "value", "95 %"), estimates, words=3),
            *(paragraph(remark.sentence) for remark in self.remarks),
            picture(
                bars(widths, "half of the 95 % interval, share of the value [%]"),
                "Width of the interval of each free parameter.",
            ),
        )

    def __str__(self) -> str:
        lines = [f"Fit: {self.ending}, cost {self.cost:.1f} nat"]
        for channel, own in output_units(self.model.mechanism).items():
            value, unit = readable(self.noise[channel], own)
            extremes = self._extremes(channel, own)
            where = f", {extremes}" if extremes else ""
            lines.append(f"  residual {channel}: {f'{value:.3g} {unit}'.rstrip()} rms{where}")
        lines += [f"  {e}" for e in self.parameters]
        return "\n".join(lines + [f"  {remark.sentence}" for remark in self.remarks])
