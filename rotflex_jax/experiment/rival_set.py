"""Several rival models in one structure: fitted to all recordings so far, with their probabilities.

All effects of all models are built into one mechanism, and gates select the effects of each model, so that
one compiled program serves every rival. A recording gives an evidence for each model: the likelihood averaged
over the parameters, first states and offsets that the model may have (Laplace's method).
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from rotflex_jax.experiment.rival_fit import (
    MAX_STEPS,
    RULES,
    SHAPE_FACTORS,
    limits_of_unknowns,
    with_calibrations,
)
from rotflex_jax.mechanism import Mechanism, Solver, free_run, kalman_gains, linearise, predictor_run
from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, minimise
from rotflex_jax.parameters import Transform
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

# Prior standard deviations of the unknowns of each run: of calibrations in units of their typical size, of
# positions and speeds in their own units. They are wide, and the same for every rival.
CALIBRATION_SPREAD, STATE_SPREAD = 5.0, 10.0
# Rows in one call of a batched program. More rows are run in turn, fewer are filled up, so that no further
# program is compiled.
BATCH = 16
# Recordings are filled up to lengths that grow by this factor from the first length.
LENGTH_FACTOR = 4


@persistent_jit(static=2)
def _run_with_slopes(structure, solver, values, gates, x0, K, u, y, Ts, place, dvalues, dx0):  # noqa: ANN001, ANN202
    """Predicted outputs (N, C) and the state at a sample (n,), each with derivatives along the last axis."""
    seen = jnp.ones_like(u)

    def run(values: Array, x0: Array) -> tuple[Array, Array]:
        X, y_hat = predictor_run(structure, solver, values, gates, x0, u, y, seen, K, Ts)
        return y_hat, X[place]

    def along(v: Array, x: Array) -> Any:
        return jax.jvp(run, (values, x0), (v, x))

    return jax.vmap(along, out_axes=((None, None), (-1, -1)))(dvalues, dx0)


@persistent_jit(static=2)
def _outputs(structure, solver, values, gates, x0, u, Ts):  # noqa: ANN001, ANN202 - as `free_run`, in batches
    one = lambda v, g, x, u: free_run(structure, solver, v, g, x, u, Ts)[1]  # noqa: E731
    return jax.vmap(one)(values, gates, x0, u)


@persistent_jit(static=2)
def _outputs_with_slopes(structure, solver, values, gates, x0, u, dvalues, dx0, Ts):  # noqa: ANN001, ANN202
    """Outputs (N, C) of one run, and their derivatives along the last axis."""

    def along(v: Array, x: Array) -> Any:
        run = lambda v, x: free_run(structure, solver, v, gates, x, u, Ts)[1]  # noqa: E731
        return jax.jvp(run, (values, x0), (v, x))

    return jax.vmap(along, out_axes=(None, -1))(dvalues, dx0)


@persistent_jit(static=2)
def _input_slopes(structure, solver, values, gates, x0, u, weight, Ts):  # noqa: ANN001, ANN202
    """Gradient of a weighted sum of the outputs of one run with respect to its voltage (N,)."""
    run = lambda u: free_run(structure, solver, values, gates, x0, u, Ts)[1]  # noqa: E731
    return jax.grad(lambda u: jnp.sum(weight * run(u)))(u)


class Start(NamedTuple):
    """Runs that begin in given states: parameter values, gates and first state of each, as rows."""

    values: Float[np.ndarray, "B P"]
    gates: Float[np.ndarray, "B E"]
    x0: Float[np.ndarray, "B n"]


class RunData(NamedTuple):
    """Voltage that the rig played without a pause, and recorded outputs."""

    u: Float[np.ndarray, " N"]
    y: Float[np.ndarray, "N C"]


@dataclasses.dataclass(frozen=True)
class RivalPosterior:
    """Posterior of the unknowns of one rival after some recordings.

    The unknowns are the free parameters of the machine (unconstrained), then for each run its calibrations
    and its first positions and speeds.

    Attributes:
        unknowns: Most probable values.
        cost: Half the squared whitened residuals [nat].
        prior_cost: Half the squared distance from the prior mean, weighted by the prior precision [nat].
        gradient: Gradient of the sum of both costs along the unknowns.
        information: `J'J` of the whitened residuals.
        precision: Precision of the prior.
        residuals: Whitened residuals of each run.
        state: State in the last run at the requested sample.
        state_slope: Derivative of this state by the machine parameters and the unknowns of the last run.
    """

    unknowns: Float[np.ndarray, " D"]
    cost: float
    prior_cost: float
    gradient: Float[np.ndarray, " D"]
    information: Float[np.ndarray, "D D"]
    precision: Float[np.ndarray, "D D"]
    residuals: tuple[Float[np.ndarray, "_ C"], ...]
    state: Float[np.ndarray, " n"]
    state_slope: Float[np.ndarray, "n A"]

    def log_evidence(self, scale: float) -> float:
        """Logarithm of the averaged likelihood, without constants that are common to all rivals [nat].

        Args:
            scale: Variance of the whitened residuals.

        Source: D. J. C. MacKay, Bayesian interpolation, Neural Computation 4, 1992.
        """
        if not math.isfinite(self.cost):
            return -math.inf
        after = np.linalg.slogdet(self.information / scale + self.precision)[1]
        return (
            -self.cost / scale - self.prior_cost - 0.5 * float(after - np.linalg.slogdet(self.precision)[1])
        )

    def covariance(self, scale: float, pick: Int[np.ndarray, " A"]) -> Float[np.ndarray, "A A"]:
        """Marginal covariance of some unknowns.

        Args:
            scale: Variance of the whitened residuals.
            pick: Indices of the unknowns.
        """
        whole = np.linalg.inv(self.information / scale + self.precision)[np.ix_(pick, pick)]
        return (whole + whole.T) / 2


@dataclasses.dataclass(frozen=True)
class RivalSet:
    """Rival models of one machine, in one structure.

    Attributes:
        labels: Names of the H models.
        models: The models as they were given, without effects that their gates switch off.
        structure: The mechanism with the effects of all models.
        solver: Integration rule.
        gates: Which of the E effects each model has.
        values: Parameter values of each model.
        free: For each model, indices of the free parameters that belong to the machine.
        own: Indices of the calibrations, which each run has separately.
        prior_mean: Prior mean of the unconstrained free parameters of each model.
        prior_covariance: Covariance of these parameters.
        noise: Standard deviation of the sensor noise of each channel.
        process_noise: Port -> intensity of the process noise [(N m)^2 s].
        Ts: Sampling period [s].
    """

    labels: tuple[str, ...]
    models: tuple[Model, ...]
    structure: Mechanism
    solver: Solver
    gates: Float[np.ndarray, "H E"]
    values: Float[np.ndarray, "H P"]
    free: tuple[Int[np.ndarray, " _"], ...]
    own: Int[np.ndarray, " o"]
    prior_mean: tuple[Float[np.ndarray, " _"], ...]
    prior_covariance: tuple[Float[np.ndarray, "_ _"], ...]
    noise: Float[np.ndarray, " C"]
    process_noise: dict[str, float]
    Ts: float

    # -- sizes -------------------------------------------------------------------------------------

    @property
    def count(self) -> int:
        """Number of rivals."""
        return len(self.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the outputs."""
        return tuple(output_units(self.structure).values())

    @property
    def layout(self) -> Layout:
        """Order of the states."""
        return Layout.of(self.structure.structure)

    @property
    def run_unknowns(self) -> int:
        """Number of unknowns that each run has separately: calibrations, positions, speeds."""
        return len(self.own) + 2 * self.layout.n

    @functools.cached_property
    def rest(self) -> Float[np.ndarray, " n"]:
        """State at rest."""
        return rest_state(self.structure.structure, np.float64)

    @functools.cached_property
    def transform(self) -> Transform:
        """Transform between unconstrained and physical values of all parameters."""
        return Transform.of(self.structure.parameter_specifications)

    # -- whitening ---------------------------------------------------------------------------------

    @functools.cached_property
    def _filters(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        """Gain (n, C), inverse Cholesky factor (C, C), and linear part with gain, for each rival.

        The last entry is None for a free run.
        """
        found = []
        for model in self.models:
            m = with_calibrations(model.mechanism)
            K = kalman_gains(m, [self.process_noise], self.noise, self.Ts)[0]
            own, q = Layout.of(m.structure), 2 * self.layout.n
            rows = own.linear if own.linear == self.layout.linear else q
            gain = np.zeros((self.layout.size, len(self.noise)))
            gain[:rows] = K[:rows]
            ss = linearise(m)
            CK = ss.C @ K[: own.linear]
            S = np.linalg.solve(np.eye(len(CK)) - CK, np.diag(np.square(self.noise)))
            L = np.linalg.inv(np.linalg.cholesky((S + S.T) / 2))
            found.append((gain, L, (ss, K[: own.linear]) if np.any(K) else None))
        return found

    def _impulse_response(self, h: int, M: int) -> np.ndarray | None:
        """Response (M, C, C) of the innovations to a difference of the outputs; None if it is an identity."""
        linear = self._filters[h][2]
        if linear is None:
            return None
        ss, K = linear
        A = ss.discretise(self.Ts)[0]
        response, carried = [np.eye(len(ss.C))], A @ K
        for _ in range(M - 1):
            response.append(-ss.C @ carried)
            carried = A @ (carried - K @ (ss.C @ carried))
        return np.array(response)

    def whitened(
        self, h: int, difference: Float[np.ndarray, "*B M C"], adjoint: bool = False
    ) -> Float[np.ndarray, "*B M C"]:
        """Whitened innovations of rival `h` for a difference of the outputs, to first order.

        Args:
            h: Number of the rival.
            difference: Measured outputs less the outputs of the rival.
            adjoint: Whether to apply the transposed operation, for gradients.
        """
        L, response = self._filters[h][1], self._impulse_response(h, difference.shape[-2])
        if response is None:
            return difference @ (L if adjoint else L.T)
        x, M = difference @ L if adjoint else difference, difference.shape[-2]
        if adjoint:
            x, response = x[..., ::-1, :], np.swapaxes(response, 1, 2)
        out = np.zeros_like(x)
        for i in range(x.shape[-1]):
            for j in range(x.shape[-1]):
                kernel = response[:, i, j].reshape((1,) * (x.ndim - 2) + (M,))
                out[..., i] += scipy.signal.fftconvolve(x[..., j], kernel, axes=-1)[..., :M]
        return out[..., ::-1, :] if adjoint else out @ L.T

    # -- fits --------------------------------------------------------------------------------------

    def values_and_slopes(
        self, h: int, machine: Float[np.ndarray, "*B m"], own: Float[np.ndarray, "*B o"]
    ) -> tuple[Float[np.ndarray, "*B P"], Float[np.ndarray, "*B P"]]:
        """Physical values, and the derivative of each with respect to its unconstrained coordinate."""
        shape = machine.shape[:-1]
        z = np.broadcast_to(self.transform.unconstrain(self.values[h]), (*shape, self.values.shape[1])).copy()
        z[..., self.free[h]], z[..., self.own] = machine, own
        physical, slope = self.transform.physical(z)
        values = np.broadcast_to(self.values[h], z.shape).copy()
        for pick in (self.free[h], self.own):
            values[..., pick] = physical[..., pick]
        return values, slope

    def directions(
        self, h: int, slope: Float[np.ndarray, " P"]
    ) -> tuple[Float[np.ndarray, "D P"], Float[np.ndarray, "D n"]]:
        """Directions of the unknowns of one run in values and first state, filled up to a common number.

        Args:
            h: Number of the rival.
            slope: Derivative of each value with respect to its unconstrained coordinate.
        """
        widest = max(map(len, self.free)) + self.run_unknowns
        m, o, q = len(self.free[h]), len(self.own), 2 * self.layout.n
        dvalues = np.zeros((widest, len(slope)))
        dx0 = np.zeros((widest, self.layout.size))
        dvalues[np.arange(m), self.free[h]] = slope[self.free[h]]
        dvalues[m + np.arange(o), self.own] = slope[self.own]
        dx0[m + o + np.arange(q), np.arange(q)] = 1.0
        return dvalues, dx0

    def _run(self, h: int, x: np.ndarray, run: RunData, place: int, length: int) -> tuple[np.ndarray, ...]:
        """Whitened residuals (N, C) of one run, their derivatives (N, C, A), a state and its derivatives."""
        m, o = len(self.free[h]), len(self.own)
        values, slope = self.values_and_slopes(h, x[:m], x[m : m + o])
        dvalues, dx0 = self.directions(h, slope)
        start = self.rest.copy()
        start[: 2 * self.layout.n] = x[m + o :]
        N, (K, L, _) = len(run.u), self._filters[h]
        u = np.concatenate([run.u, np.zeros(length - N)])
        y = np.concatenate([run.y, np.repeat(run.y[-1:], length - N, axis=0)])
        with double_precision():
            given = (values, self.gates[h], start, K, u, y, self.Ts, np.int64(place), dvalues, dx0)
            (y_hat, state), (dy, dstate) = _run_with_slopes(
                self.structure.structure, self.solver, *map(jnp.asarray, given)
            )
        A = m + self.run_unknowns
        w = (run.y - np.asarray(y_hat)[:N]) @ L.T
        J = -np.einsum("kc,ncd->nkd", L, np.asarray(dy)[:N, :, :A])
        return w, J, np.asarray(state), np.asarray(dstate)[:, :A]

    def prior_precision(self, h: int, runs: int) -> Float[np.ndarray, "D D"]:
        """Precision of the prior of rival `h`: of its machine, then of the unknowns of each of some runs."""
        m, o, q = len(self.free[h]), len(self.own), 2 * self.layout.n
        own = np.concatenate([np.full(o, CALIBRATION_SPREAD**-2.0), np.full(q, STATE_SPREAD**-2.0)])
        out = np.diag(np.concatenate([np.zeros(m), np.tile(own, runs)]))
        out[:m, :m] = np.linalg.inv(self.prior_covariance[h])
        return out

    def posterior(
        self, h: int, unknowns: Float[np.ndarray, " D"], runs: Sequence[RunData], place: int, first: int
    ) -> RivalPosterior:
        """Costs, gradient and information of rival `h` at given unknowns.

        Args:
            h: Number of the rival.
            unknowns: Unknowns of the machine and of all runs.
            runs: Recorded runs.
            place: Sample of the last run whose state is wanted.
            first: Shortest length for which a program is compiled.
        """
        m, r = len(self.free[h]), self.run_unknowns
        D, machine = m + r * len(runs), np.arange(m)
        information, gradient, cost, residuals = np.zeros((D, D)), np.zeros(D), 0.0, []
        state, slope = self.rest, np.zeros((self.layout.size, m + r))
        for k, run in enumerate(runs):
            pick = np.concatenate([machine, m + r * k + np.arange(r)])
            here = place if k == len(runs) - 1 else 0
            w, J, state, slope = self._run(h, unknowns[pick], run, here, filled_length(len(run.u), first))
            J = J.reshape(w.size, -1)
            information[np.ix_(pick, pick)] += J.T @ J
            gradient[pick] += J.T @ w.ravel()
            cost += 0.5 * float(np.sum(w**2))
            residuals.append(w)
        precision = self.prior_precision(h, len(runs))
        difference = unknowns - np.concatenate([self.prior_mean[h], np.zeros(D - m)])
        known = np.isfinite(cost) and np.all(np.isfinite(information))
        if not known:
            cost = math.inf
        return RivalPosterior(
            unknowns,
            cost,
            0.5 * float(difference @ precision @ difference),
            gradient + precision @ difference,
            information if known else np.zeros((D, D)),
            precision,
            tuple(residuals),
            state,
            slope,
        )

    def fitted(
        self,
        h: int,
        starts: Sequence[Float[np.ndarray, " D"]],
        runs: Sequence[RunData],
        place: int,
        first: int,
    ) -> RivalPosterior:
        """Rival `h` at its most probable unknowns for all runs, from several starts.

        Arguments as in `posterior`.
        """
        bounded = self.transform.bounded[list(self.free[h])]

        def equations(x: np.ndarray) -> NormalEquations:
            p = self.posterior(h, x, runs, place, first)
            return NormalEquations(np.array([p.cost + p.prior_cost]), p.gradient, p.information + p.precision)

        best = min(
            (
                minimise(equations, x, RULES, limit=limits_of_unknowns(bounded, x), max_steps=MAX_STEPS)
                for x in starts
            ),
            key=lambda found: float(found.cost) if np.isfinite(found.cost) else math.inf,
        )
        return self.posterior(h, best.x, runs, place, first)

    def first_unknowns(self, run: RunData) -> Float[np.ndarray, " r"]:
        """Start values of the unknowns of a run: no calibrations, positions of its first sample, at rest."""
        n, rows = self.layout.n, np.array(self.layout.output_rows)
        q = np.linalg.lstsq(rows[:, :n], run.y[0], rcond=None)[0]
        return np.concatenate([np.zeros(len(self.own)), q, np.zeros(n)])

    def other_shapes(self, h: int, unknowns: Float[np.ndarray, " D"]) -> list[Float[np.ndarray, " D"]]:
        """The unknowns with other shapes of the effects that not every rival has, one parameter at a time."""
        names, found = self.structure.parameter_names, []
        shared = np.all(self.gates > 0, axis=0)
        for e, effect in enumerate(self.structure.effects):
            if shared[e] or self.gates[h, e] == 0:
                continue
            for name in effect.values:
                i = names.index(effect.full_name(name))
                where = np.flatnonzero(self.free[h] == i)
                value = self.values[h, i]
                if name in effect.amplitudes or not len(where) or value == 0:
                    continue
                spec = self.structure.parameter_specifications[i]
                for factor in SHAPE_FACTORS:
                    if spec.lower < factor * value < spec.upper:
                        changed, physical = unknowns.copy(), self.values[h].copy()
                        physical[i] = factor * value
                        changed[where[0]] = self.transform.unconstrain(physical)[i]
                        found.append(changed)
        return found

    # -- batches of runs ---------------------------------------------------------------------------

    def _batched(self, program: Any, rows: Sequence[np.ndarray]) -> Any:
        """A batched program over any number of rows, `BATCH` at a time."""
        B, parts = len(rows[0]), []
        with double_precision():
            Ts = jnp.asarray(float(self.Ts))
            for k in range(0, B, BATCH):
                chunk = [row[k : k + BATCH] for row in rows]
                fill = BATCH - len(chunk[0])
                full = [np.concatenate([c, np.repeat(c[:1], fill, axis=0)]) for c in chunk]
                out = program(self.structure.structure, self.solver, *map(jnp.asarray, full), Ts)
                parts.append(jax.tree.map(lambda a: np.asarray(a)[: BATCH - fill], out))  # noqa: B023
        return jax.tree.map(lambda *a: np.concatenate(a), *parts)

    def _each(self, program: Any, rows: Sequence[np.ndarray]) -> Any:
        """Applies a program for one run to several runs, one after another.

        For a machine with one coordinate, nested batches of derivatives crash when compiled by JAX 0.10.
        """
        with double_precision():
            Ts, found = jnp.asarray(float(self.Ts)), []
            for row in zip(*rows, strict=True):
                out = program(self.structure.structure, self.solver, *map(jnp.asarray, row), Ts)
                found.append(jax.tree.map(np.asarray, out))
        return jax.tree.map(lambda *a: np.stack(a), *found)

    def outputs(self, start: Start, u: Float[np.ndarray, "B M"]) -> Float[np.ndarray, "B M C"]:
        """Outputs of free runs from given states."""
        return self._batched(_outputs, (*start, u))

    def outputs_with_slopes(
        self,
        start: Start,
        u: Float[np.ndarray, "B M"],
        dvalues: Float[np.ndarray, "B D P"],
        dx0: Float[np.ndarray, "B D n"],
    ) -> tuple[Float[np.ndarray, "B M C"], Float[np.ndarray, "B M C D"]]:
        """Outputs of free runs, and their derivatives along directions of values and first states."""
        return self._each(_outputs_with_slopes, (*start, u, dvalues, dx0))

    def input_slopes(
        self, start: Start, u: Float[np.ndarray, "B M"], weight: Float[np.ndarray, "B M C"]
    ) -> Float[np.ndarray, "B M"]:
        """Gradient of the weighted sum of the outputs with respect to each sample of the voltage [1/V]."""
        return self._each(_input_slopes, (*start, u, weight))


def filled_length(N: int, first: int) -> int:
    """The length to which a recording of N samples is filled up.

    >>> [filled_length(N, 500) for N in (500, 501, 2001)]
    [500, 2000, 8000]
    """
    length = first
    while length < N:
        length *= LENGTH_FACTOR
    return length
