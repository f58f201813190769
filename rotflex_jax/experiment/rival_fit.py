"""Two models that a recording cannot distinguish, and how well one can reproduce a run of the other.

The rival B is fitted to a run of A by Gauss-Newton steps. Each step is an exact linear least-squares problem
in all unknowns of a new recording: the shape parameters of B, every free parameter of the machine, first
state, offset, bias.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from rotflex_jax.checks import shown
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import Effect
from rotflex_jax.errors import InputError
from rotflex_jax.fit.linear import factor
from rotflex_jax.mechanism import Mechanism, Solver, free_run, kalman_gains, predictor_run
from rotflex_jax.mechanism.assembly import Layout, rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, Status, minimise, step_limits
from rotflex_jax.parameters import Transform
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision

# Fitted to every recording separately, so that it never counts as evidence.
VOLTAGE_OFFSET = ("voltage_offset", "input")


@dataclasses.dataclass(frozen=True)
class RivalModel:
    """One of two competing models, and which of its parameters are unknown for a new recording.

    A fit to a new recording has D unknowns: unconstrained values of the free parameters, then the first
    state.

    Attributes:
        label: `effect@port`.
        mechanism: Fitted model with the effect and the calibrations of a recording.
        solver: Integration rule.
        free: Indices in `mechanism.values` of the parameters that are fitted to a new recording.
        calibrations: Full names of the parameters that each recording has separately.
        K: Gain of the predictor; zero for a free run.
        L: Inverse Cholesky factor of the covariance of the innovations.
    """

    label: str
    mechanism: Mechanism
    solver: Solver
    free: tuple[int, ...]
    calibrations: tuple[str, ...]
    K: Float[np.ndarray, "n C"]
    L: Float[np.ndarray, "C C"]

    @property
    def transform(self) -> Transform:
        """Transform between unconstrained and physical values."""
        return Transform.of(self.mechanism.parameter_specifications)

    @property
    def start(self) -> Float[np.ndarray, " D"]:
        """Start of a fit to a new recording: the values of the model, and a state at rest."""
        z = self.transform.unconstrain(self.mechanism.values)
        return np.concatenate([z[list(self.free)], np.zeros(2 * len(self.mechanism.coordinates))])

    def with_unknowns(self, unknowns: Float[np.ndarray, " D"]) -> "RivalModel":
        """The model with fitted parameters; the first state is left out."""
        z, free = self.transform.unconstrain(self.mechanism.values), list(self.free)
        z[free] = unknowns[: len(free)]
        values = self.mechanism.values
        values[free] = self.transform.physical(z)[0][free]
        return dataclasses.replace(self, mechanism=self.mechanism.with_values(values))

    def effect(self) -> Effect:
        """The effect that distinguishes this model from its rival."""
        name, _, port = self.label.partition("@")
        return self.mechanism.effect(name, port)


def effect_location(effect: Any) -> tuple[str, str]:
    """Name and port of an effect given as `name@port`, as a pair, or as the effect itself."""
    if isinstance(effect, Effect):
        return effect.name, effect.at
    pair = effect.split("@") if isinstance(effect, str) else effect
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(p, str) for p in pair)):
        raise InputError(
            f"An effect was given as {shown(effect)}, but needs a name and a port; write for instance "
            '"delay@input", or give an effect with its parameters.'
        )
    name, port = pair
    if name not in CATALOG:
        raise InputError(
            f"The effect {name!r} is not in the catalogue, which has {', '.join(CATALOG)}; use one of these."
        )
    return name, port


def rival_model(
    model: Model,
    effect: Any,
    other: tuple[str, str],
    process_noise: Mapping[str, float],
    noise: Float[np.ndarray, " C"],
    Ts: float,
) -> RivalModel:
    """The fitted model with one effect, and without its rival.

    Args:
        model: Fitted model; may have one of the two effects.
        effect: The effect: an instance with its parameters, `name@port` or a pair. Without an instance, the
            parameters come from the model if it has the effect, otherwise from the catalogue.
        other: Effect and port of the rival, which is removed.
        process_noise: Port -> intensity of the process noise [(N m)^2 s].
        noise: Standard deviation of the sensor noise of each channel.
        Ts: Sampling period [s].
    """
    name, port = effect_location(effect)
    m = model.mechanism
    present = {(e.name, e.at) for e in m.effects}
    if other in present:
        m = m.without(*other)
    if isinstance(effect, Effect):
        m = (m.without(name, port) if (name, port) in present else m) + effect
    elif (name, port) not in present:
        m = m + CATALOG[name](at=port)
    before = set(m.parameter_names)
    m = with_calibrations(m)
    calibrations = tuple(n for n in m.parameter_names if n not in before)
    free = [i for i, n in enumerate(m.parameter_names) if n not in m.trusted]
    K = kalman_gains(m, [process_noise], noise, Ts)[0]
    layout = Layout.of(m.structure)
    C = np.zeros((len(m.channels), layout.size))
    C[:, : 2 * layout.n] = layout.output_rows
    # K = P C' S^-1 with S = C P C' + R, hence C K = 1 - R S^-1.
    S = np.linalg.solve(np.eye(len(C)) - C @ K, np.diag(np.square(noise)))
    L = np.linalg.inv(np.linalg.cholesky((S + S.T) / 2))
    return RivalModel(f"{name}@{port}", m, model.solver, tuple(free), calibrations, K, L)


def with_calibrations(m: Mechanism) -> Mechanism:
    """The mechanism with a voltage offset and sensor biases, which each recording has separately.

    The first channel needs no bias, because its first position is fitted.
    """
    locations = [VOLTAGE_OFFSET, *(("sensor_bias", c) for c in m.channels[1:])]
    for name, port in locations:
        if (name, port) not in {(e.name, e.at) for e in m.effects}:
            m = m + CATALOG[name](at=port)
    return m


# A fit has converged when the predicted gain of a further step is less than this share of the remaining cost,
# or less than this [nat].
GAIN_SHARE_TOLERANCE, GAIN_TOLERANCE = 2e-3, 0.01
MAX_STEPS = 25
# Directions weaker than this share of the strongest do not count in the exact projection.
RANK_TOLERANCE = 1e-7
# A short recording hardly determines some of the unknowns, and most steps are nearly exact: therefore little
# damping, which is raised fast when a step fails.
RULES = Rules(
    enough=GAIN_TOLERANCE / 2, enough_share=GAIN_SHARE_TOLERANCE / 2, damping=1e-6, increase=30.0, least=1e-9
)
# Further starts of a fit: factors of every parameter of the rival's effect that is not an amplitude, because
# least squares from one start finds only the local minimum of that shape.
SHAPE_FACTORS = (0.6, 1.6)


@dataclasses.dataclass(frozen=True)
class RivalFit:
    """A rival model fitted to a run of the true one.

    Attributes:
        unknowns: Unconstrained values of the free parameters, then the first state.
        nats: Half the squared whitened residuals that remain after an exact projection [nat].
        residuals: Whitened innovations of the rival on the run of the true model.
        predicted_gain: Gain of a further step to first order [nat]; small at convergence.
    """

    unknowns: Float[np.ndarray, " D"]
    nats: float
    residuals: Float[np.ndarray, "N C"]
    predicted_gain: float

    @property
    def converged(self) -> bool:
        """Whether a further step would gain almost nothing; False for a fit whose runs diverge."""
        return bool(np.isfinite(self.nats)) and self.predicted_gain <= max(
            GAIN_SHARE_TOLERANCE * self.nats, GAIN_TOLERANCE
        )


def free_run_from_rest(model: RivalModel, u: Float[np.ndarray, " N"], Ts: float) -> Float[np.ndarray, "N C"]:
    """Outputs of a model from rest, without noise."""
    structure = model.mechanism.structure
    with double_precision():
        arrays = tuple(map(jnp.asarray, (model.mechanism.values, u, float(Ts))))
        return np.asarray(_free_run_from_rest(structure, model.solver, *arrays))


@persistent_jit(static=2)
def _free_run_from_rest(
    structure: Mechanism, solver: Solver, values: jax.Array, u: jax.Array, Ts: jax.Array
) -> jax.Array:
    gates = jnp.ones(len(structure.effects), u.dtype)
    return free_run(structure, solver, values, gates, _rest_state(structure, u), u, Ts)[1]


def _rest_state(structure: Mechanism, like: jax.Array) -> jax.Array:
    return jnp.asarray(rest_state(structure, np.float64), like.dtype)


@dataclasses.dataclass(frozen=True)
class _StaticRival:
    """The part of a rival model that is static in a compiled program."""

    structure: Mechanism
    solver: Solver
    free: tuple[int, ...]

    def whitened(
        self, unknowns: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
    ) -> jax.Array:
        """Whitened innovations (N, C) on a run `y` under the voltage `u`."""
        values, K, L = fixed
        P = len(self.free)
        specs = self.structure.parameter_specifications
        fitted = Transform.of([specs[i] for i in self.free]).constrain(unknowns[:P])
        values = values.at[np.array(self.free)].set(fitted)
        gates = jnp.ones(len(self.structure.effects), u.dtype)
        x0 = _rest_state(self.structure, u).at[: len(unknowns) - P].set(unknowns[P:])
        seen = jnp.ones_like(u)
        y_hat = predictor_run(self.structure, self.solver, values, gates, x0, u, y, seen, K, Ts)[1]
        return (y - y_hat) @ L.T


@persistent_jit(static=1)
def _whitened_residuals(
    rival: _StaticRival, unknowns: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
) -> Any:
    return rival.whitened(unknowns, fixed, u, y, Ts)


@persistent_jit(static=1)
def _residuals_and_jacobian(
    rival: _StaticRival, unknowns: jax.Array, fixed: Any, u: jax.Array, y: jax.Array, Ts: jax.Array
) -> Any:
    def run(x: jax.Array) -> jax.Array:
        return rival.whitened(x, fixed, u, y, Ts)

    directions = jnp.eye(len(unknowns))
    return jax.vmap(lambda d: jax.jvp(run, (unknowns,), (d,)), out_axes=(None, -1))(directions)


@persistent_jit(static=3)
def _input_gradient(
    structure: Mechanism, solver: Solver, rival: _StaticRival, arrays: Any, u: jax.Array, Ts: jax.Array
) -> Any:
    values, unknowns, fixed, evidence_weight, output_weight = arrays

    def objective(u: jax.Array) -> jax.Array:
        y = _free_run_from_rest(structure, solver, values, u, Ts)
        nats = 0.5 * jnp.sum(rival.whitened(unknowns, fixed, u, y, Ts) ** 2)
        return evidence_weight * nats + jnp.sum(output_weight * y)

    return jax.grad(objective)(u)


def _static_and_arrays(model: RivalModel) -> tuple[_StaticRival, Any]:
    arrays = tuple(map(jnp.asarray, (model.mechanism.values, model.K, model.L)))
    return _StaticRival(model.mechanism.structure, model.solver, model.free), arrays


def limits_of_unknowns(
    bounded: Bool[np.ndarray, " P"], x: Float[np.ndarray, " D"]
) -> Float[np.ndarray, " D"]:
    """Largest step of the unknowns of a rival from a start: `step_limits` of parameters, which come first.

    Args:
        bounded: Whether each of the P parameters has a bound.
        x: The start.
    """
    parameters = step_limits(bounded, x[: len(bounded)])
    return np.concatenate([parameters, np.full(len(x) - len(bounded), np.inf)])


@np.errstate(over="ignore", invalid="ignore")  # of a run that diverges, whose step is refused
def fit_rival(
    rival: RivalModel,
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, "N C"],
    Ts: float,
    start: Float[np.ndarray, " D"] | None = None,
) -> RivalFit:
    """The rival fitted to a run of the true model, or to a recording.

        nats = min over unknowns of  1/2 sum_k |L (y_k - y_hat_k)|^2

    Args:
        rival: The model to fit.
        u: Voltage [V].
        y: Outputs to reproduce.
        Ts: Sampling period [s].
        start: Unknowns at the start; `rival.start` if None.
    """
    with double_precision():
        static, fixed = _static_and_arrays(rival)
        data = tuple(map(jnp.asarray, (u, y, float(Ts))))

        def linearised(unknowns: np.ndarray) -> _Linearisation:
            w, J = _residuals_and_jacobian(static, jnp.asarray(unknowns), fixed, *data)
            return _Linearisation(np.asarray(w), np.asarray(J))

        first = rival.start if start is None else start
        limit = limits_of_unknowns(rival.transform.bounded[list(rival.free)], first)
        found = minimise(linearised, first, RULES, limit=limit, max_steps=MAX_STEPS - 1)
    if found.status == Status.DIVERGED:
        return RivalFit(found.x, np.inf, np.full_like(y, np.inf), np.inf)
    nats = found.equations.projected_cost()
    return RivalFit(found.x, nats, found.equations.residuals, found.cost - nats)


@dataclasses.dataclass(frozen=True)
class _Linearisation:
    """Whitened residuals (N, C) and their Jacobian (N, C, D) at some unknowns, with normal equations."""

    residuals: np.ndarray
    jacobian: np.ndarray

    @functools.cached_property
    def _normal(self) -> NormalEquations:
        return NormalEquations.of(self.jacobian.reshape(self.residuals.size, -1), self.residuals.ravel())

    @property
    def cost(self) -> float:
        return float(self._normal.cost)

    def step(self, damping: float, limit: np.ndarray) -> Any:
        return self._normal.step(damping, limit)

    def predicted_decrease(self, step: np.ndarray) -> Any:
        return self._normal.predicted_decrease(step)

    def projected_cost(self) -> float:
        """Half the squared residuals after an undamped step, to first order; from a triangular factor."""
        A, r = self.jacobian.reshape(self.residuals.size, -1), self.residuals.ravel()
        size = np.linalg.norm(A, axis=0)
        size = np.where(size > 0, size, 1.0)
        R = factor(np.column_stack([A / size, r]))
        step = -np.linalg.lstsq(R[:-1, :-1], R[:-1, -1], rcond=RANK_TOLERANCE)[0] / size
        left = r + A @ step
        return 0.5 * float(left @ left)


def best_rival_fit(
    rival: RivalModel,
    u: Float[np.ndarray, " N"],
    y: Float[np.ndarray, "N C"],
    Ts: float,
    starts: Sequence[Float[np.ndarray, " D"]],
) -> RivalFit:
    """The fit with the smallest residuals, out of fits from several starts; arguments as in `fit_rival`."""
    return min((fit_rival(rival, u, y, Ts, start) for start in starts), key=lambda fit: fit.nats)


def input_gradient(
    true: RivalModel,
    rival: RivalModel,
    unknowns: Float[np.ndarray, " D"],
    u: Float[np.ndarray, " N"],
    Ts: float,
    evidence_weight: float = 1.0,
    output_weight: float | Float[np.ndarray, "N C"] = 0.0,
) -> Float[np.ndarray, " N"]:
    """Gradient of `evidence_weight * nats + sum output_weight * y` with respect to the voltage [1/V].

    At the minimum over the unknowns of the rival, the gradient along the unknowns is zero. Therefore the
    gradient of the minimum equals the gradient with the unknowns held.

    Args:
        true: Model whose run is fitted.
        rival: Model that is fitted to this run.
        unknowns: Best unknowns of the rival for this voltage.
        u: Voltage [V].
        Ts: Sampling period [s].
        evidence_weight: Factor of the evidence.
        output_weight: Factors of the run of the true model.
    """
    with double_precision():
        static, fixed = _static_and_arrays(rival)
        m = true.mechanism
        weight = np.broadcast_to(np.asarray(output_weight, float), (len(u), len(m.channels)))
        held = (m.values, unknowns, fixed, float(evidence_weight), weight)
        args = jax.tree.map(jnp.asarray, (held, u, float(Ts)))
        return np.asarray(_input_gradient(m.structure, true.solver, static, *args))
