"""Results of fits: the model with parameters and intervals, and profiles of the likelihood."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.figure import Figure

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.comparison import compare_plot
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.text.colours import BASELINE, FINAL, HIGHLIGHT, MUTED
from rotflex_jax.text.markup import card, paragraph, picture, table
from rotflex_jax.text.numbers import as_read, digits, plain_number, readable, unit_text, value_and_interval
from rotflex_jax.text.plotting import blank, legend_above, styled
from rotflex_jax.text.svg import bars

Quantity = str | Callable[[Mapping[str, float]], float]
"""Full name of a parameter, or a function from the values of all parameters by full name to a number."""

# A Wald interval is poor where an end of it lies at another level: its root of the likelihood ratio is off
# 1.96 by more than this share. 0.15 is 90 or 97.6 % at one end in place of 95 %.
POOR = 0.15
# Every profile reaches this level: shape and sentence are those of its interval.
LEAST_LEVEL = 0.95


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood along one quantity, with all else fitted again at each value.

        drop = 2 (cost(value) - least cost) / factor,   interval: drop <= quantile of chi2 with 1 degree

    `factor` is by how much the errors' correlation in time widens the variance of the quantity (the ratio of
    sandwich and inverse curvature), so that profile and Wald interval agree where the cost is a parabola.

    Attributes:
        name: Of the quantity.
        unit: Its unit; empty for a function of parameters.
        value: Where the cost is least.
        values: Values of the quantity, ascending.
        drop: Twice the loss of log-likelihood over `factor`; zero at `value`.
        factor: Nats of the cost that say as much as one.
        std: Wald's standard deviation; nan where the curvature gives none.
        limits: Ends of what the quantity may be.
        nuisances: Values of all parameters at each value.
        parameter_names: Their full names.
        gained: By how much the least cost is below that of the fit [nat]; zero if the fit was the least.
        level: Confidence level up to which points were placed.
    """

    name: str
    unit: str
    value: float
    values: Float[np.ndarray, " K"]
    drop: Float[np.ndarray, " K"]
    factor: float
    std: float
    limits: tuple[float, float]
    nuisances: Float[np.ndarray, "K P"]
    parameter_names: tuple[str, ...]
    gained: float = 0.0
    level: float = LEAST_LEVEL

    @property
    def wald(self) -> tuple[float, float]:
        """The symmetric 95 % interval from the curvature."""
        return self.wald_interval(0.95)

    def wald_interval(self, level: float) -> tuple[float, float]:
        """The symmetric interval of another level."""
        half = float(scipy.stats.norm.ppf((1 + level) / 2)) * self.std
        return self.value - half, self.value + half

    @property
    def root(self) -> Float[np.ndarray, " K"]:
        """Signed root of the drop, negative below the least cost; a straight line for a parabola."""
        return np.sign(self.values - self.value) * np.sqrt(np.maximum(self.drop, 0.0))

    def root_at(self, values: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
        """The signed root between the points of the profile, nan outside of them."""
        if len(self.values) < 2:
            return np.where(values == self.value, 0.0, np.nan)
        return scipy.interpolate.PchipInterpolator(self.values, self.root, extrapolate=False)(values)

    def regions(self, level: float = 0.95) -> list[tuple[float, float]]:
        """All values that are not excluded, as intervals; an open end is an end of `limits`.

        Args:
            level: Confidence level, at most that of the profile.

        Raises:
            InputError: A level that is not between 0 and 1, or above that of the profile.
        """
        level = checks.number(level, "level", above=0, below=1, example="0.95")
        if level > self.level:
            raise InputError(
                f"An interval of level {level:g} was asked for, but the profile reaches {self.level:g}; make "
                f"it with level={level:g}."
            )
        most = math.sqrt(scipy.stats.chi2.ppf(level, 1))
        excess = np.abs(self.root) - most
        inside = excess <= 0
        edges = [self.limits[0]] if inside[0] else []
        for k in np.flatnonzero(inside[1:] != inside[:-1]):
            low, high = self.values[k], self.values[k + 1]
            edges.append(
                scipy.optimize.brentq(lambda v: abs(float(self.root_at(np.array([v]))[0])) - most, low, high)
            )
        edges += [self.limits[1]] if inside[-1] else []
        return list(zip(edges[::2], edges[1::2], strict=True))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """From the least to the largest value that is not excluded; `regions` has the gaps between.

        Args:
            level: Confidence level, at most that of the profile.

        Raises:
            InputError: A level that is not between 0 and 1, or above that of the profile.
        """
        found = self.regions(level)
        return found[0][0], found[-1][1]

    @property
    def shape(self) -> str:
        """`closed`, `open below`, `open above`, `open` (to both sides) or `two minima`, at 95 %."""
        found, most = self.regions(), scipy.stats.chi2.ppf(0.95, 1)
        if len(found) > 1:
            return "two minima"
        low, high = self.drop[0] <= most, self.drop[-1] <= most
        return {(0, 0): "closed", (1, 0): "open below", (0, 1): "open above", (1, 1): "open"}[low, high]

    @property
    def wald_is_poor(self) -> bool:
        """Whether the parabola misleads, the profile being at another level at an end of Wald's interval."""
        if not math.isfinite(self.std) or self.shape != "closed":
            return True
        at = self.root_at(np.array(self.wald))
        return not bool(np.all(np.abs(np.abs(at) / HALF_WIDTH_95 - 1) <= POOR))

    @property
    def sentence(self) -> str:
        """What is known of the quantity, in words."""
        (low, high), (factor, unit) = self.interval(), as_read(1.0, self.unit)
        # As many digits as the interval is worth.
        width = min((b - a for a, b in self.regions() if math.isfinite(b - a)), default=math.inf)
        worth = math.log10(max(abs(self.value) / width, 1.0)) if width > 0 else 3.0
        shown = lambda v: digits(factor * v, 3 + math.floor(worth))  # noqa: E731
        says = {
            "closed": f"lies between {shown(low)} and {shown(high)}",
            "open above": f"is at least {shown(low)}; the recordings set no upper end",
            "open below": f"is at most {shown(high)}; the recordings set no lower end",
            "open": "is not determined by these recordings",
            "two minima": "lies in one of several ranges: "
            + " or ".join(f"{shown(a)} to {shown(b)}" for a, b in self.regions()),
        }[self.shape]
        return f"{self.name} = {shown(self.value)} {unit}".rstrip() + f" {says} (95 %)"

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; an end that is infinite or unknown is None."""
        finite = lambda pair: [v if math.isfinite(v) else None for v in pair]  # noqa: E731
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "interval95": finite(self.interval()),
            "regions95": [finite(r) for r in self.regions()],
            "wald95": finite(self.wald),
            "shape": self.shape,
            "wald_is_poor": self.wald_is_poor,
            "factor": self.factor,
            "values": self.values.tolist(),
            "drop": self.drop.tolist(),
        }

    def plot(self) -> "Figure":
        """The drop over the quantity beside the parabola of the Wald interval, with both 95 % intervals."""
        return profile_figure([self])

    def _repr_html_(self) -> str:
        """Both intervals side by side, and what the profile says in words."""
        rows = []
        for what, (low, high) in (("profile", self.interval()), ("Wald", self.wald)):
            (a, unit), (b, _) = readable(low, self.unit), readable(high, self.unit)
            rows.append((what, unit, plain_number(a), plain_number(b)))
        warning = "The Wald interval is poor here: use that of the profile." if self.wald_is_poor else ""
        return card(
            f"Profile of {self.name}: {self.shape}",
            paragraph(self.sentence + "."),
            table(("95 % interval", "unit", "from", "to"), rows, words=2),
            paragraph(warning) if warning else "",
        )

    def __str__(self) -> str:
        (low, high), (factor, unit) = self.wald, as_read(1.0, self.unit)
        worth = math.log10(max(abs(self.value) / self.std, 1.0)) if self.std > 0 else 0.0
        ends = (digits(factor * v, 3 + math.floor(worth)) for v in (low, high))
        return f"{self.sentence}; Wald: {' to '.join(ends)} {unit_text(unit)}".rstrip()


@styled
def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """One panel for each profile, at most three beside each other."""
    columns = min(len(profiles), 3)
    rows = -(-len(profiles) // columns)
    figure = blank(10.0 if columns > 1 else 5.5, 2.7 * rows + 0.4)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    limit = scipy.stats.chi2.ppf(0.95, 1)
    for ax, p in zip(grid, profiles, strict=False):
        scale, unit = readable(1.0, p.unit)
        fine = np.linspace(p.values[0], p.values[-1], 300)
        for low, high in p.regions():
            ax.axvspan(
                scale * max(low, p.values[0]), scale * min(high, p.values[-1]), color=HIGHLIGHT, zorder=0
            )
        ax.plot(scale * fine, p.root_at(fine) ** 2, color=FINAL, lw=1.5, label="profile")
        ax.plot(scale * p.values, p.drop, "o", color=FINAL, ms=3)
        if np.isfinite(p.std):
            parabola = np.square((fine - p.value) / p.std)
            ax.plot(scale * fine, parabola, color=BASELINE, lw=1.0, ls=(0, (4, 2)), label="parabola (Wald)")
        ax.axhline(limit, color=MUTED, lw=0.8, label="95 %")
        ax.set_ylim(0, max(1.6 * limit, min(1.1 * float(p.drop.max()), 3 * limit)))
        ax.set_title(p.shape)
        ax.set_xlabel(f"{p.name} [{unit}]" if unit else p.name)
        ax.locator_params(axis="x", nbins=5)
    for ax in grid[::columns]:
        ax.set_ylabel("2 x loss of log-likelihood / factor")
    for ax in grid[len(profiles) :]:
        ax.set_visible(False)
    legend_above(figure, grid[: len(profiles)])
    return figure


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
    """

    process_noise: dict[str, float] | None = None
    local: tuple[str, ...] = ()
    first: str = "fitted"
    window_seconds: float | None = None
    max_steps: int = 60


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
    weakest: dict[str, float] = dataclasses.field(default_factory=dict)
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
