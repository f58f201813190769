"""Profile likelihood: the cost of a fit along one quantity, with everything else fitted again at each value.

    cost(c) = min of the fit's own cost over all parameters and first states with g(parameters) = c

The quantity is held by an additional row of the least-squares problem, `(g - c) / w`, with a width `w` far
below its standard deviation. At the minimum of this sum, the profile is known exactly at the value `g`
reached there, whatever the width: no other parameters with the same `g` have a lower cost. Every point goes
through the compiled program of the fit, with the parameters of its neighbour as a start.
"""

import contextlib
import dataclasses
import itertools
from collections import deque
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import Windows
from rotflex_jax.fit.greybox import problem_of, report
from rotflex_jax.fit.greybox_problem import FitAttempt, FitPoint, FitStage, GreyBoxProblem
from rotflex_jax.fit.inference import UNDETERMINED_CURVATURE
from rotflex_jax.fit.problem import LikelihoodEquations
from rotflex_jax.fit.profile_result import LEAST_LEVEL, Profile, Quantity
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.parameters import Transform
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, listed
from rotflex_jax.runtime.xla import double_precision, one_thread

# Width of the row that holds the quantity, as a share of its standard deviation.
WIDTH = 0.02
# Number of points between the least cost and the level on each side, and largest number of points there.
POINTS_TO_LEVEL, MOST_POINTS = 4, 16
# First step if the curvature gives none, largest step, and largest distance from the least cost, as changes
# of the logarithm of a positive quantity.
FIRST_STEP, LARGEST, FARTHEST = 0.1, 1.5, 6.0
# A level is passed if the root of the likelihood ratio exceeds the root at the level by this factor.
BEYOND_LEVEL = 1.05
# Points are added until the level lies between two points whose roots differ by no more than this share of
# it; largest number of added points.
NEAR_LEVEL, MOST_BETWEEN = 0.6, 8
# A value that moves by less than this share of the step has reached the end of its range.
STUCK = 0.5
# A parameter counts as at its lower bound if it is nearer to it than this share of its typical size.
NEAR = 1e-3
# Number of the last equations that are kept: enough for two sides and a refused step.
REMEMBERED = 6
# Step of a difference quotient in the coordinates of a fit.
STEP = 1e-5
# The sign of a function is examined at this many random parameters, with this standard deviation from the fit
# in unconstrained coordinates.
DRAWS, AWAY = 100, 2.0


@dataclasses.dataclass(frozen=True)
class Along:
    """A quantity of a fit, and the coordinate of its profile: the logarithm of a quantity that is positive.

    Attributes:
        name: Name for people.
        unit: Unit; empty for a function.
        function: Function of the values of the parameters by full name.
        limits: Least and largest value that the quantity may have.
        positive: Whether the coordinate is the logarithm of the distance to the lower limit.
        least: Distance that is added to it, so that the limit itself is not infinitely far away.
    """

    name: str
    unit: str
    function: Callable[[Mapping[str, float]], float]
    limits: tuple[float, float]
    positive: bool
    least: float = 0.0

    @classmethod
    def of(cls, of: Quantity, fitted: Fit) -> "Along":
        """The quantity that is a parameter, by its name, or a function.

        Raises:
            InputError: If the name is no free parameter, if the function gives no finite number, or if it
                does not depend on a free parameter.
        """
        m = fitted.model.mechanism
        if isinstance(of, str):
            if of not in fitted.free_names:
                raise InputError(
                    f"Parameter {of!r} was to be profiled, but the free parameters of the fit are "
                    f"{', '.join(fitted.free_names)}; name one of these."
                )
            spec = m.parameter_specifications[m.parameter_names.index(of)]
            # If both ends are finite, logarithms would refine the steps near one of them only.
            positive = np.isfinite(spec.lower) and not np.isfinite(spec.upper)
            return cls(
                of,
                spec.unit,
                lambda values: values[of],
                (spec.lower, spec.upper),
                positive,
                NEAR * spec.typical,
            )
        if not callable(of):
            raise InputError(
                f"Argument `of` must be the full name of a parameter or a function of the values by name, "
                f"but is {checks.shown(of)}; give for instance {fitted.free_names[0]!r}."
            )
        values = m.named_values
        try:
            value = checks.real(of(values))
        except (KeyError, TypeError, ValueError, ArithmeticError) as error:
            raise InputError(
                f"The function of the parameters failed with {type(error).__name__}: {error}; it receives "
                "the values by full name and must give a number."
            ) from error
        if not np.isfinite(value):
            raise InputError(
                f"The function of the parameters gives {value} at the fit, but must give a finite number; "
                "correct it."
            )
        name = getattr(of, "__name__", "quantity")
        name = "quantity" if name == "<lambda>" else name
        drawn = _about(of, m, fitted.free_names)
        if len(drawn) > 1 and len(set(drawn)) == 1:
            raise InputError(
                f"The function of the parameters gives {value:.6g} whatever the fitted parameters are, but a "
                f"profile needs a quantity that depends on one of them; use {fitted.free_names[0]!r} or "
                "another of `free_names` in it."
            )
        positive = value > 0 and not any(v <= 0 for v in drawn)
        return cls(name, "", of, (0.0 if positive else -np.inf, np.inf), positive)

    def walked(self, value: float) -> float:
        """The coordinate of a value."""
        if not self.positive:
            return value
        return float(np.log(max(value - self.limits[0] + self.least, 1e-300)))

    def slope(self, value: float) -> float:
        """Derivative of the value by the coordinate."""
        return value - self.limits[0] + self.least if self.positive else 1.0


@dataclasses.dataclass(frozen=True)
class HeldProblem(GreyBoxProblem):
    """A fit in which a quantity is held near a number by an additional row of the least-squares problem.

    Attributes:
        along: The quantity and the coordinate of its profile.
        target: Coordinate at which the quantity is held.
        width: Standard deviation of the row.
        made: The last points with their gains and equations without the row, since a point of a profile
            begins where another one ended.
    """

    along: Along
    target: float
    width: float
    made: "deque[tuple[FitPoint, np.ndarray, LikelihoodEquations]]"

    def at(self, point: FitPoint) -> tuple[float, Float[np.ndarray, " P"]]:
        """Value of the quantity, and the values of all parameters (means over recordings)."""
        common, names = self.common(self.physical(point)[0]), self.model.mechanism.parameter_names
        return float(self.along.function(dict(zip(names, common.tolist(), strict=True)))), common

    def slopes(self, point: FitPoint, windows: Windows) -> Float[np.ndarray, " M"]:
        """Derivative of the coordinate of the profile by the coordinates of the fit."""
        coordinates = self.coordinates(point, windows)
        move = np.zeros(coordinates.size)
        found = np.zeros(coordinates.size)
        own = [coordinates.local_columns(r) for r in range(len(point.local_z))]
        for column in np.concatenate([np.arange(coordinates.shared), *own]).astype(int):
            ends = []
            for sign in (1, -1):
                move[column] = sign * STEP
                ends.append(self.along.walked(self.at(coordinates.moved(point, move))[0]))
            move[column] = 0.0
            found[column] = (ends[0] - ends[1]) / (2 * STEP)
        return found

    def penalty(self, point: FitPoint) -> float:
        """The cost of the additional row."""
        return ((self.along.walked(self.at(point)[0]) - self.target) / self.width) ** 2 / 2

    def equations(
        self, point: FitPoint, stage: FitStage, K: Float[np.ndarray, "R n C"]
    ) -> LikelihoodEquations:
        """The equations of the fit, with the row of the quantity."""
        found = next((e for at, gain, e in self.made if at is point and np.array_equal(gain, K)), None)
        if found is None:
            found = super().equations(point, stage, K)
            self.made.append((point, K, found))
        miss = (self.along.walked(self.at(point)[0]) - self.target) / self.width
        row = self.slopes(point, stage.windows) / self.width
        return dataclasses.replace(
            found,
            cost=found.cost + miss**2 / 2,
            gradient=found.gradient + miss * row,
            H=found.H + np.outer(row, row),
        )


@dataclasses.dataclass(frozen=True)
class PointOfProfile:
    """A point of a profile: value, cost without the additional row, point of the fit, and all parameters."""

    value: float
    cost: float
    point: FitPoint
    values: Float[np.ndarray, " P"]


@dataclasses.dataclass(frozen=True)
class Walk:
    """The computation of the points of a profile, outwards from the least cost.

    Attributes:
        problem: Problem of the fit.
        along: The quantity.
        end: The fit with the least cost.
        middle: The point of the profile there.
        std: Wald's standard deviation of the coordinate of the profile; nan if there is none.
        factor: Number of nats of the cost that count as one; see `profile`.
        made: Last equations, as in `HeldProblem`.
    """

    problem: GreyBoxProblem
    along: Along
    end: FitAttempt
    middle: PointOfProfile
    std: float
    factor: float
    made: "deque[tuple[FitPoint, np.ndarray, LikelihoodEquations]]"

    def root(self, point: PointOfProfile) -> float:
        """Root of the likelihood ratio of a point, without sign."""
        return float(np.sqrt(max(2 * (point.cost - self.middle.cost) / self.factor, 0.0)))

    def held(self, target: float, start: FitPoint) -> PointOfProfile:
        """The point of the profile near a target coordinate."""
        width = WIDTH * (self.std if np.isfinite(self.std) else FIRST_STEP)
        given = {f.name: getattr(self.problem, f.name) for f in dataclasses.fields(GreyBoxProblem)}
        problem = HeldProblem(**given, along=self.along, target=target, width=width, made=self.made)
        found = problem.attempt(start, [self.end.stage])
        value, values = problem.at(found.point)
        return PointOfProfile(value, found.cost - problem.penalty(found.point), found.point, values)

    def side(self, sign: int, goal: float) -> list[PointOfProfile]:
        """Points on one side, outwards until the root exceeds the goal or the quantity moves no further."""
        begin = self.along.walked(self.middle.value)
        step = goal / POINTS_TO_LEVEL * self.std if np.isfinite(self.std) else FIRST_STEP
        most = LARGEST if self.along.positive else np.inf
        step, found, here = min(step, most), [], self.middle
        low, high = (self.along.walked(v) if np.isfinite(v) else v for v in self.along.limits)
        while len(found) < MOST_POINTS:
            at, root = self.along.walked(here.value), self.root(here)
            target = at + sign * step
            if not self.along.positive:
                # The coordinate approaches a limit but does not reach it.
                target = float(np.clip(target, (at + 3 * low) / 4, (at + 3 * high) / 4))
            further = self.held(target, here.point)
            moved = sign * (self.along.walked(further.value) - at)
            if not np.isfinite(further.cost) or moved <= STUCK * abs(target - at):
                break
            found.append(further)
            if self.root(further) > BEYOND_LEVEL * goal:
                return self.nearer(found, here, goal)
            here, gained = further, self.root(further) - root
            if self.along.positive and abs(self.along.walked(here.value) - begin) > FARTHEST:
                break
            wanted = moved * goal / POINTS_TO_LEVEL / gained if gained > 0 else np.inf
            step = float(min(np.clip(wanted, moved / 3, 2.5 * moved), most))
        return found

    def nearer(
        self, found: list[PointOfProfile], inside: PointOfProfile, goal: float
    ) -> list[PointOfProfile]:
        """Points of a side with more points added, until the level lies between two that are close together.

        Args:
            found: Points of the side, of which the last is beyond the level.
            inside: The point before the last one, or the middle.
            goal: Root of the likelihood ratio at the level.
        """
        outside, added = found[-1], list[PointOfProfile]()
        for _ in range(MOST_BETWEEN):
            a, b = self.root(inside), self.root(outside)
            if b - a <= NEAR_LEVEL * goal:
                break
            share = float(np.clip((goal - a) / (b - a), 0.1, 0.9))
            low, high = (self.along.walked(p.value) for p in (inside, outside))
            between = self.held(low + share * (high - low), inside.point)
            if not min(low, high) < self.along.walked(between.value) < max(low, high):
                break
            added.append(between)
            inside, outside = (between, outside) if self.root(between) < goal else (inside, between)
        return [*found[:-1], *added, found[-1]]


@one_thread
def profile(
    fitted: Fit, recordings: Recording | Sequence[Recording], of: Quantity, level: float = 0.95
) -> Profile:
    """Profile likelihood of a parameter, or of any function of the parameters.

        2 (cost(c) - least cost) / factor <= quantile of chi2 with 1 degree of freedom at `level`

    `cost(c)` is the cost of the fit with the quantity held at `c` and everything else fitted again: the other
    parameters, local parameters of each recording, and first states. The interval of all `c` that satisfy the
    inequality need not be symmetric. It may be open if the recordings set no end, and it may have a gap.
    `factor` is the variance that allows for errors correlated in time, divided by the variance from the
    curvature alone. So the interval equals Wald's interval if the cost is a parabola. Points are placed
    outwards from the least cost, closer together where the profile is steep, with the fit's own compiled
    program. If the fit has used measured first states, these follow the parameters here. Wald's interval
    neglects this, and the two differ.

    Args:
        fitted: A fit by `rotflex_jax.fit`; its options are used again.
        recordings: The recordings that were fitted.
        of: Full name of a free parameter, or a function that receives the values of all parameters by full
            name and gives a number: `lambda p: p["hub.coulomb.level"] / p["joint.spring.stiffness"]`.
        level: Confidence level up to which points are placed; at least 0.95, which `shape` needs.

    Returns:
        Profile with `interval(level)`, `shape`, `wald` and a figure.

    Raises:
        InputError: If there is no such parameter, if the function gives no number or depends on no fitted
            parameter, or if the recordings are not those that were fitted.

    Source: S. A. Murphy and A. W. van der Vaart, J. Am. Stat. Assoc. 95, 2000; A. Raue et al., Bioinformatics
    25, 2009; the factor: R. E. Chandler and S. Bate, Biometrika 94, 2007.
    """
    if not isinstance(fitted, Fit):
        raise InputError(
            f"A fit is needed, but {checks.shown(fitted)} was given; give what rotflex_jax.fit gives."
        )
    level = max(checks.number(level, "level", above=0, below=1, example="0.95"), LEAST_LEVEL)
    given = list(listed(recordings, shortest=SHORTEST_TO_FIT))
    along = Along.of(of, fitted)
    with double_precision():
        walk = _at_least(fitted, given, along)
        goal = float(np.sqrt(scipy.stats.chi2.ppf(level, 1)))
        below, above = walk.side(-1, goal), walk.side(1, goal)
    points = sorted([*below, walk.middle, *above], key=lambda p: p.value)
    least = min(points, key=lambda p: p.cost)
    spread = _distinct([p.value for p in points])
    points = [p for p, keep in zip(points, spread, strict=True) if keep or p is least]
    return Profile(
        name=along.name,
        unit=along.unit,
        value=least.value,
        values=np.array([p.value for p in points]),
        drop=np.array([2 * (p.cost - least.cost) / walk.factor for p in points]),
        factor=walk.factor,
        std=walk.std * along.slope(walk.middle.value),
        limits=along.limits,
        nuisances=np.array([p.values for p in points]),
        parameter_names=fitted.model.mechanism.parameter_names,
        gained=walk.middle.cost - least.cost,
        level=level,
    )


def _about(of: Callable[[Mapping[str, float]], float], m: Mechanism, free: Sequence[str]) -> list[float]:
    """Values of a function at random parameters, which show whether it is positive or constant."""
    rng, transform = np.random.default_rng(0), Transform.of(m.parameter_specifications)
    z, moves = transform.unconstrain(m.values), np.isin(m.parameter_names, free)
    found = []
    for _ in range(DRAWS):
        values = transform.physical(np.where(moves, z + AWAY * rng.standard_normal(len(z)), z))[0]
        # Where the function fails, the parameters are outside of its domain.
        with contextlib.suppress(TypeError, ValueError, ArithmeticError), np.errstate(all="ignore"):
            found.append(float(of(dict(zip(m.parameter_names, values.tolist(), strict=True)))))
    return found


def _distinct(values: list[float]) -> list[bool]:
    """For ascending values, whether each differs from the value before."""
    size = max(abs(values[0]), abs(values[-1]))
    return [True, *(b - a > 1e-12 * size for a, b in itertools.pairwise(values))]


def _at_least(fitted: Fit, recordings: Sequence[Recording], along: Along) -> Walk:
    """The start of a profile: the least cost near a fit, and the variance of the quantity there."""
    problem, point, stage = problem_of(fitted, recordings)
    end = problem.attempt(point, [stage])
    here = problem.equations(end.point, stage, end.K)
    given = {f.name: getattr(problem, f.name) for f in dataclasses.fields(GreyBoxProblem)}
    made = deque([(end.point, end.K, here)], REMEMBERED)
    held = HeldProblem(**given, along=along, target=0.0, width=1.0, made=made)
    value, values = held.at(end.point)
    row = held.slopes(end.point, stage.windows)
    again = report(problem, end, *problem.errors(end.point, stage, end.K))
    # Variance of the profile's coordinate by the curvature alone, for coordinates not held at an end.
    moves = ~problem.held_by_ends(end.point, stage.windows)
    plain = _variance(here.H[np.ix_(moves, moves)], row[moves])
    # Gradient of the profile's coordinate by the parameters, in the order of their covariance.
    m = again.model.mechanism
    base = m.named_values
    transform = Transform.of(m.parameter_specifications)
    z = transform.unconstrain(m.values)
    gradient = np.zeros(len(again.free_names))
    for k, name in enumerate(again.free_names):
        i, ends = m.parameter_names.index(name), []
        for sign in (1, -1):
            moved = z.copy()
            moved[i] += sign * STEP
            ends.append(base | {name: float(transform.physical(moved)[0][i])})
        high, low = (along.walked(along.function(values)) for values in ends)
        gap = ends[0][name] - ends[1][name]
        gradient[k] = (high - low) / gap if gap else 0.0
    used = gradient != 0
    variance = float(gradient[used] @ again.covariance[np.ix_(used, used)] @ gradient[used])
    factor = here.nats_that_count
    if np.isfinite(variance) and variance > 0 and plain > 0:
        factor = max(variance / plain, 1.0)
    std = float(np.sqrt(plain * factor)) if plain > 0 else np.nan
    middle = PointOfProfile(value, end.cost, end.point, values)
    return Walk(problem, along, end, middle, std, factor, made)


def _variance(H: Float[np.ndarray, "M M"], row: Float[np.ndarray, " M"]) -> float:
    """`row' H^-1 row`; nan if the quantity depends on directions that the curvature does not determine."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(H / np.outer(size, size))
    along = vectors.T @ (row / size)
    known = eigenvalues > UNDETERMINED_CURVATURE
    if not row.any() or np.abs(along[~known]).max(initial=0.0) > 1e-3 * np.linalg.norm(along):
        return np.nan
    return float(np.sum(np.square(along[known]) / eigenvalues[known]))
