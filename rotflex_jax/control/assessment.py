"""Assessment of one controller on every model that the data leave possible, with the worst case."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from rotflex_jax.checks import instance, number, seed as checked_seed, shown, whole
from rotflex_jax.control.closed_loop import NOT_LOOKED_FOR, ClosedLoop, run_loop
from rotflex_jax.control.design import Controller
from rotflex_jax.errors import InputError
from rotflex_jax.fit import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import plain_number, readable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_DRAWS = 200
"""Most draws for one model; if all lie outside of the bounds, the distribution counts as outside."""


@dataclasses.dataclass(frozen=True, repr=False)
class ControlAssessment:
    """Runs of one controller on several models.

    Attributes:
        controller: Controller of all runs.
        runs: Name of a model -> its run in closed loop.
    """

    controller: Controller
    runs: dict[str, ClosedLoop]

    @property
    def worst(self) -> str:
        """Name of the model with the largest tracking error; a run that diverges counts as the largest."""
        return max(self.runs, key=lambda name: self.runs[name].rms)

    @property
    def broken(self) -> dict[str, str]:
        """Name of a model that diverges or has a limit cycle -> description of what happens."""
        found = {}
        for name, run in self.runs.items():
            if not run.bounded:
                found[name] = "diverges"
            elif run.limit_cycle is not None:
                size, unit = readable(run.limit_cycle.amplitude, run.unit)
                found[name] = f"limit cycle of {size:.3g} {unit} at {run.limit_cycle.frequency:.3g} Hz"
        return found

    @property
    def sentence(self) -> str:
        """The worst case, and the models that diverge or have a limit cycle, in words."""
        (rms, unit), worst = readable(self.runs[self.worst].rms, self.runs[self.worst].unit), self.worst
        error = "no bound" if not np.isfinite(rms) else f"{rms:.3g} {unit} rms"
        said = f"Worst case of {len(self.runs)} models: {error} with {worst}"
        if not self.broken:
            looked = all(run.rests for run in self.runs.values())
            return f"{said}; {'no limit cycle with any of them' if looked else NOT_LOOKED_FOR}."
        return f"{said}; " + "; ".join(f"{name}: {what}" for name, what in self.broken.items()) + "."

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "worst": self.worst,
            "broken": self.broken,
            "runs": {name: run.to_dict() for name, run in self.runs.items()},
        }

    def plot(self) -> "Figure":
        """Figure of all runs on common axes, with the names of the models."""
        from rotflex_jax.control.figure import loop_figure  # loads matplotlib, so only on request

        return loop_figure(tuple(self.runs.values()), tuple(self.runs))

    def _rows(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        _, unit = readable(1.0, next(iter(self.runs.values())).unit)
        rows = [
            (
                name,
                self.broken.get(name, "held"),
                plain_number(readable(run.rms, run.unit)[0]),
                plain_number(readable(run.largest, run.unit)[0]),
                plain_number(100 * run.saturated),
            )
            for name, run in self.runs.items()
        ]
        return ("model", "", f"error rms [{unit}]", f"largest [{unit}]", "at the limit [%]"), rows

    def _repr_html_(self) -> str:
        headings, rows = self._rows()
        return card("Control of every model", paragraph(self.sentence), table(headings, rows, words=2))

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        headings, rows = self._rows()
        widths = [max(len(row[k]) for row in (headings, *rows)) for k in range(len(headings))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in (headings, *rows)]
        return "\n".join([self.sentence, *(line.rstrip() for line in lines)])


def assess(
    controller: Controller,
    models: Fit | Mapping[str, Any] | Sequence[Any],
    reference: Float[ArrayLike, " N"] | Sequence[float],
    *,
    hold: float = 6.0,
    noise: float = 0.0,
    count: int = 20,
    seed: int = 0,
) -> ControlAssessment:
    """Simulates a controller on every model that is still possible: tracking error, limit cycles, worst case.

    At its end, the reference stands still at its last value, so that a limit cycle becomes visible.

    Args:
        controller: From `controller`.
        models: Models by name or as a list, such as equivalent models of a search; or a `Fit`, from whose
            parameter distribution models are drawn.
        reference: Reference of the port's position, one value for each sample.
        hold: Time for which the last value is held [s].
        noise: Standard deviation of the noise of the sensors [rad].
        count: Number of models that are drawn from a fit.
        seed: Seed of draws and noise.

    Returns:
        ControlAssessment.

    Raises:
        InputError: There are no models, or one of them is not a model.
    """
    hold = number(hold, "hold", least=0.0, unit="s", example="6.0")
    noise = number(noise, "noise", least=0.0, unit="rad", example="0.001")
    named: Mapping[str, Any]
    if isinstance(models, Fit):
        named = credible_models(models, count, seed)
    elif isinstance(models, Mapping):
        named = models
    elif isinstance(models, Sequence) and not isinstance(models, str):
        named = {f"model {k + 1}": model for k, model in enumerate(models)}
    else:
        named = {}
    if not named:
        raise InputError(
            f"Argument `models` must be models by name, a list of them, or a fit, but is {shown(models)}; "
            "give for instance {'found': model}."
        )
    named = {name: getattr(model, "model", model) for name, model in named.items()}
    for name, model in named.items():
        if not isinstance(model, Model | Mechanism):
            raise InputError(
                f"The model {name!r} is {shown(model)}, but a controller is assessed on models; give a "
                "Model, a mechanism or a fit."
            )
    instance(controller, Controller, "controller", "make one with rotflex_jax.controller")
    motion = controller.plan(reference)
    longer = np.append(motion.reference, np.full(round(hold / controller.Ts), motion.reference[-1]))
    motion = controller.plan(longer)
    runs = {name: run_loop(controller, m, motion, noise, seed) for name, m in named.items()}
    return ControlAssessment(controller, runs)


def credible_models(fit: Fit, count: int = 20, seed: int = 0) -> dict[str, Model]:
    """The fitted model, and models drawn from the distribution of its parameters.

    Args:
        fit: Parameters are drawn from a normal distribution with its estimates and covariance. A draw outside
            of the bounds of a parameter is repeated.
        count: Number of models that are drawn.
        seed: Seed of the draws.

    Returns:
        Models by name.

    Raises:
        InputError: `fit` is no fit, or its intervals lie almost wholly outside of the bounds.
    """
    if not isinstance(fit, Fit):
        raise InputError(f"Argument `fit` must be the result of a fit, but is {shown(fit)}; call rf.fit.")
    count, rng = whole(count, "count", 1), np.random.default_rng(checked_seed(seed))
    mechanism = fit.model.mechanism
    bounds = dict(zip(mechanism.parameter_names, mechanism.parameter_specifications, strict=True))
    known = [k for k, name in enumerate(fit.free_names) if name in bounds]
    names = [fit.free_names[k] for k in known]
    mean = np.array([fit[name].value for name in names])
    low = np.array([bounds[name].lower for name in names], float)
    high = np.array([bounds[name].upper for name in names], float)
    covariance = fit.covariance[np.ix_(known, known)]
    # An estimate without an interval, such as one at a bound, is not varied.
    certain = ~np.isfinite(np.diag(covariance))
    covariance = np.where(certain[:, None] | certain[None, :], 0.0, covariance)
    found = {"fitted": fit.model}
    for k in range(count):
        for _ in range(MOST_DRAWS):
            values = rng.multivariate_normal(mean, covariance, method="eigh")
            if np.all((values >= low) & (values <= high)):
                break
        else:
            raise InputError(
                "The intervals of the estimates lie almost wholly outside of what the parameters may be; fit "
                "more data first."
            )
        drawn = mechanism.with_values(dict(zip(names, values.tolist(), strict=True)))
        found[f"draw {k + 1}"] = dataclasses.replace(fit.model, mechanism=drawn)
    return found
