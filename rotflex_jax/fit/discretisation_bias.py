"""Discretisation bias: how far the integration step shifts the estimates of a fit, and a remark on it.

Dry friction that sticks and slips within a sample is integrated coarsely by one step per sample. One run with
shorter steps from the optimum gives the shift of the estimates, to first order. If an estimate shifts far, a
second run gives the change of the cost:

    shift = (J'J)^-1 J'(e - e_fine)

with the scaled errors `e` of the fit, their slopes `J` and the errors `e_fine` of shorter steps with the same
parameters and first states. The shift is caused by the steps alone: the gradient that remains at the end of a
fit does not contribute.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.fit.greybox_problem import LEAST_SCALE, FitAttempt, GreyBoxProblem
from rotflex_jax.fit.inference import RecordingSlopes, flattened, scaled_inverse
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.fit.problem import negative_log_likelihood
from rotflex_jax.mechanism import Exponential
from rotflex_jax.mechanism.finer_step import SUBSTEP_FACTOR, with_finer_steps
from rotflex_jax.text.numbers import plain_number

COARSE_STEP = "step of integration"
"""Kind of a remark on integration steps that are too long for an estimate."""

# A shift counts from this many standard deviations on: a 95 % interval that is shifted by one standard
# deviation contains the true value in 83 of 100 cases.
LARGE_SHIFT = 1.0


@dataclasses.dataclass(frozen=True)
class FinerSteps:
    """Effect of shorter integration steps on a fit.

    Attributes:
        solver: Integration rule with the shorter steps.
        shift: Shift of each coordinate, in standard deviations of the fit; nan for a coordinate without one.
        fall: Decrease of the negative log-likelihood with the shorter steps [nat].
    """

    solver: Exponential
    shift: Float[np.ndarray, " M"]
    fall: float


def finer_steps(
    problem: GreyBoxProblem,
    end: FitAttempt,
    e: Float[np.ndarray, "R N C"],
    scale: Float[np.ndarray, " C"],
    parts: Sequence[RecordingSlopes],
    H: Float[np.ndarray, "F F"],
    covariance: Float[np.ndarray, "M M"],
) -> FinerSteps | None:
    """Effect of shorter integration steps on a fit; None if there are none, or if no estimate shifts far.

    Args:
        problem: The problem of the fit.
        end: The optimum.
        e: Errors at the optimum.
        scale: Scale of each channel.
        parts: Scaled errors and slopes of the windows, for the coordinates that move.
        H: Their curvature.
        covariance: Covariance of all coordinates; nan for coordinates that are held.
    """
    solver = with_finer_steps(problem.layout.solver, problem.model.mechanism.effects)
    if solver is None or not np.isfinite(H).all():
        return None
    layout = dataclasses.replace(problem.layout, solver=solver)
    problem = dataclasses.replace(problem, layout=layout)
    fine = problem.errors_alone(end.point, end.stage, end.K)
    if not np.isfinite(fine).all():
        return None
    coordinates, seen = problem.coordinates(end.point, end.stage.windows), problem.dataset.data.seen
    # Coordinates that are held at an end of their range have no slopes in `parts`.
    moves = ~problem.held_by_ends(end.point, end.stage.windows)
    none = np.zeros((*e.shape, 0))  # no slopes of the differences: `parts` only divides them into windows
    gradient = np.zeros(len(H))
    for part, change in zip(parts, coordinates.parts((fine - e) / scale, none, seen), strict=True):
        gradient[part.columns] += flattened(part.J).T @ change.e.ravel()
    inverse, size = scaled_inverse(H)
    step = np.zeros(len(moves))
    step[moves] = -(inverse @ (gradient / size)) / size
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = step / np.sqrt(np.diag(covariance))
    if not np.any(np.abs(shift) > LARGE_SHIFT):
        return None
    there = problem.with_shown_states(coordinates.moved(end.point, step), end.stage)
    moved = problem.errors_alone(there, end.stage, end.K)
    cost = min(_cost(problem, fine), _cost(problem, moved))
    return FinerSteps(solver, shift, _cost(problem, e) - cost)


def coarse_step(
    found: FinerSteps | None, parameters: Sequence[tuple[str, Sequence[int]]]
) -> tuple[Remark, ...]:
    """A remark that integration steps are too long for the estimates; none if these shift little.

    There is no remark either if the recordings are less likely with shorter steps: such data were simulated
    with the steps of the fit, and are fitted best with these.

    Args:
        found: Effect of shorter steps.
        parameters: Free parameters by full name, each with the indices of its coordinates.
    """
    if found is None or not found.fall >= 0 or not parameters:
        return ()
    sizes = [(float(np.nanmax(np.abs(found.shift[[*rows]]), initial=0.0)), name) for name, rows in parameters]
    largest, name = max(sizes)
    if not largest > LARGE_SHIFT:
        return ()
    given = ", ".join(
        f'{f.name}="{value}"' if isinstance(value, str) else f"{f.name}={value}"
        for f in dataclasses.fields(found.solver)
        if (value := getattr(found.solver, f.name)) != f.default
    )
    number = found.solver.substeps
    sentence = (
        f"{name} would move by {plain_number(largest, 2)} of its standard deviations, the most of all "
        f"parameters, and the cost would fall by {found.fall:.0f} nats, if each sample were integrated in "
        f"{number} steps instead of {number // SUBSTEP_FACTOR}: the steps are too long for these confidence "
        f"intervals; give rf.Model(joint, rf.Exponential({given})) in the place of the joint, on the command "
        f"line --substeps {number}"
    )
    return (Remark(name, COARSE_STEP, sentence),)


def _cost(problem: GreyBoxProblem, e: Float[np.ndarray, "R N C"]) -> float:
    """Negative log-likelihood of errors, without constants [nat]; infinite if a run diverges."""
    samples = int(np.count_nonzero(problem.dataset.data.seen))
    cost, _ = negative_log_likelihood(e, samples, LEAST_SCALE * problem.dataset.noise)
    return cost if np.isfinite(cost) else np.inf
