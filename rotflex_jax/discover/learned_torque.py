"""A torque learned as a map of position and speed, where no effect of the catalogue explains what is left."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Real

from rotflex_jax import checks
from rotflex_jax.discover.evaluation import evaluate
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.result import Stage
from rotflex_jax.discover.selection import HELD_OUT_NATS, HELD_OUT_Z, WINDOWS_WORSE, paired_gain
from rotflex_jax.discover.spline_map import Formula, Term, fit_map, position_differences, read_formula
from rotflex_jax.discover.stepwise import fit_baseline
from rotflex_jax.discover.supermodel import build, scales
from rotflex_jax.discover.validation import ValidationSet, validate
from rotflex_jax.effects import LearnedTorque, Viscous
from rotflex_jax.effects.base import name_prefix
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import prepare, process_noise_ports
from rotflex_jax.fit.plausibility import motion
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.linear import output_units
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, check_apart, listed
from rotflex_jax.runtime.persistent_jit import clear_compilation_caches

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Number of cells of the map along each axis, and least number of samples in a cell that counts as visited.
MAP_CELLS, MIN_CELL_SAMPLES = 30, 3
# Number of splines along position and along speed.
SPLINES = (8, 15)
# Share of the usual speed below which the splines are equally wide; at higher speeds they are wider.
EVEN_SPEED_SHARE = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class LearnedTorqueResult:
    """A learned torque with its gain, its map and its formula.

    Attributes:
        at: Port of the torque.
        kept: Whether the torque was kept: whether it explains the validation data better.
        effect: The learned map; zero if it was not kept.
        before: The model without the torque, refitted and evaluated.
        after: The model with the torque; `before` if it was not kept.
        held_out_gain_nats: Gain in log-likelihood of the validation data [nat].
        formula: The formula nearest to the map; empty if the map was not kept.
        physics: Terms that the model's own offset, damper or spring gives at the port; the map has none of
            them.
        covariance: Covariance of the weights of the map [(N m)^2].
        position: Position of the port along the training recordings [rad].
        speed: Speed of the port along the training recordings [rad/s].
        noise_floor: Channel -> standard deviation of the sensor noise.
    """

    at: str
    kept: bool
    effect: LearnedTorque
    before: Stage
    after: Stage
    held_out_gain_nats: float
    formula: Formula
    physics: tuple[str, ...]
    covariance: Float[np.ndarray, "W W"]
    position: Float[np.ndarray, " N"]
    speed: Float[np.ndarray, " N"]
    noise_floor: dict[str, float]

    @property
    def model(self) -> Model:
        """The model with the learned torque, or without it if it was not kept."""
        return self.after.model

    @property
    def reading(self) -> str:
        """The formula with its unit, in position `q` and speed `w`."""
        return f"{self.formula} {self.model.mechanism.units.effort}"

    def torque(
        self, position: float | Real[np.ndarray, "..."], speed: float | Real[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """Learned torque and its standard deviation [N m] at positions [rad] and speeds [rad/s] of the port.

        It contains nothing that the physics of the model can imitate: if the port has a damper, it has no
        part proportional to the speed.
        """
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        Phi = self.effect.design(q.ravel(), w.ravel())
        std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", Phi, self.covariance, Phi), 0.0))
        return (Phi @ np.array(self.effect.weights)).reshape(q.shape), std.reshape(q.shape)

    def read_torque(
        self, position: float | Real[np.ndarray, "..."], speed: float | Real[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """Torque of the formula [N m], without what the model's own terms can imitate, as in the map."""
        own = columns(self.physics, self.position, self.speed)
        held = np.linalg.lstsq(own, self.formula(self.position, self.speed), rcond=None)[0]
        q, w = np.broadcast_arrays(np.asarray(position, float), np.asarray(speed, float))
        return self.formula(q, w) - (columns(self.physics, q.ravel(), w.ravel()) @ held).reshape(q.shape)

    def visited(self, edges: Sequence[Float[np.ndarray, " _"]]) -> Bool[np.ndarray, "Q S"]:
        """Which cells of a grid over position and speed the recordings have visited."""
        return np.histogram2d(self.position, self.speed, [*edges])[0] >= MIN_CELL_SAMPLES

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; the map on a grid, None in cells that the recordings have not visited."""
        edges = tuple(np.linspace(*ends, MAP_CELLS + 1) for ends in (self.effect.position, self.effect.speed))
        q, w = ((e[1:] + e[:-1]) / 2 for e in edges)
        seen, (torque, std) = self.visited(edges), self.torque(q[:, None], w[None, :])
        unit = self.model.mechanism.units.unit
        grid = lambda values: [  # noqa: E731
            [float(v) if s else None for v, s in zip(*row, strict=True)]
            for row in zip(values, seen, strict=True)
        ]
        return {
            "port": self.at,
            "kept": self.kept,
            "held_out_gain_nats": self.held_out_gain_nats,
            "before": self.before.errors(),
            "after": self.after.errors(),
            "noise_floor": self.noise_floor,
            "formula": self.reading,
            "terms": [
                {
                    "term": t.name,
                    "coefficient": t.coefficient,
                    "std": t.std,
                    "unit": unit(t.unit),
                    "share": t.share,
                }
                for t in self.formula.terms
            ],
            "map": {"position": q.tolist(), "speed": w.tolist(), "torque": grid(torque), "std": grid(std)},
        }

    def plot(self) -> "Figure":
        """Figure of the map (grey where recordings have not been), its profiles with bands, the formula."""
        from rotflex_jax.discover.learned_torque_figure import learned_figure  # takes long to import

        return learned_figure(self)

    def __str__(self) -> str:
        if not self.kept:
            return f"No map of position and speed at the {self.at} makes the validation data likelier."
        before, after = self.before.held_out_rmse_windows, self.after.held_out_rmse_windows
        units = output_units(self.model.mechanism)
        errors = ", ".join(f"{c} {before[c]:.3g} -> {after[c]:.3g} {unit}" for c, unit in units.items())
        share = f"{100 * self.formula.share:.0f} % of what the map explains"
        return f"Learned torque at the {self.at}: held-out error {errors}; reads {self.reading} ({share})"


def columns(
    terms: Sequence[str], position: Float[np.ndarray, " N"], speed: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N T"]:
    """Values of terms of a formula at samples, one column per term."""
    return np.stack([Term(t, 0.0)(position, speed) for t in terms], axis=1)


def learn_torque(
    model: Mechanism | Model,
    train: Recording | Sequence[Recording],
    validation: Recording | Sequence[Recording],
    at: str = "hub",
    *,
    window_seconds: float = 2.0,
    progress: Callable[[str], None] | None = None,
) -> LearnedTorqueResult:
    """Learn a torque as a smooth map of position and speed of a port, and approximate it by a formula.

    The map is fitted through the simulator together with the parameters of the model, which it cannot
    imitate. Its smoothness is estimated from the recordings. The map is kept only if the validation
    recordings become likelier, so that a model that lacks nothing stays unchanged. Use it where a search ends
    `unexplained`.

    Do not use it for a torque that depends on time, on the past or on the voltage: the map then explains
    little.

    Args:
        model: The model so far, with the effects that were found.
        train: Training recordings, to which model and map are fitted.
        validation: Validation recordings, which decide whether the map is kept.
        at: Port of the torque.
        window_seconds: Length of the windows of the short validation runs [s].
        progress: Called with a line of text at each stage.

    Returns:
        The model with the map, its errors, the map with standard deviations, and its formula.

    Raises:
        InputError: If the port does not exist, if the outputs do not determine its motion, or if the model
            already has a learned torque there.
    """
    clear_compilation_caches()
    model, say = Model.of(model).without_gates(), checks.progress(progress)
    trained = listed(train, "train", SHORTEST_TO_FIT)
    held_back = listed(validation, "validation", SHORTEST_TO_FIT)
    checks.positive(window_seconds, "window_seconds")
    reason = "a map is kept only where data that no fit has seen become likelier; give other recordings, or "
    reason += "the two parts of recording.split(0.7)"
    check_apart(trained, held_back, "to fit and to validate", reason)
    position, speed = _motion(model, trained, at)
    dataset = prepare(model, trained, noise_of=held_back)
    torque = dataset.torque_scale
    effect = _zero_map(at, position, speed, torque)
    whole = model.mechanism + effect
    names = [f"{at}.learned_torque.{n}" for n in effect.values]
    s = build(whole.trust(*names), (), scales(model, trained, torque))
    ports = tuple(process_noise_ports(whole, 1.0))
    problem = LikelihoodProblem.of(s, model.solver, dataset, ports)
    other = LikelihoodProblem.of(s, model.solver, prepare(model, held_back, like=dataset), ports)
    unseen = ValidationSet(other, window_seconds)
    say("learned torque: fitting the model as it is")
    current = validate(unseen, fit_baseline(problem))
    say("learned torque: fitting the map")
    weights = [s.mechanism.parameter_names.index(n) for n in names]
    physics = _own_terms(model.mechanism, at)
    excluded = effect.design(position, speed).T @ columns(physics, position, speed)
    size = torque / effect.scale
    fitted = fit_map(problem, current.hypothesis, effect, weights, excluded, size)
    candidate = validate(unseen, fitted.hypothesis)
    if effect.count[0] > 1 and not fitted.flat:
        # If validation data lie beyond the positions of training, a map of speed alone may be the better one.
        excluded = np.hstack([excluded, position_differences(effect).T])
        flat = fit_map(problem, current.hypothesis, effect, weights, excluded, size)
        of_speed = validate(unseen, flat.hypothesis)
        if of_speed.log_likelihood > candidate.log_likelihood:
            fitted, candidate = flat, of_speed
    gain, z = paired_gain(candidate.blocks, current.blocks)
    runs_as_well = np.all(candidate.window_rmse < (1 + WINDOWS_WORSE) * current.window_rmse)
    # The same limits as for an effect of the catalogue.
    kept = bool(gain > HELD_OUT_NATS and z > HELD_OUT_Z and runs_as_well)
    say(f"learned torque: {gain:.0f} nat on validation data, {'kept' if kept else 'not kept'}")
    before = _without_map(evaluate(problem, unseen, model.solver, current, s.calibrations), at)
    after = evaluate(problem, unseen, model.solver, candidate, s.calibrations) if kept else before
    effect = effect.replace(weights=tuple((effect.scale * candidate.hypothesis.z[weights] * kept).tolist()))
    return LearnedTorqueResult(
        at=at,
        kept=kept,
        effect=effect,
        before=before,
        after=after,
        held_out_gain_nats=gain,
        formula=read_formula(fitted, effect, position, speed) if kept else Formula(()),
        physics=physics,
        covariance=effect.scale**2 * fitted.covariance,
        position=position,
        speed=speed,
        noise_floor=dict(zip(whole.channels, dataset.noise.tolist(), strict=True)),
    )


def _motion(model: Model, recordings: Sequence[Recording], at: str) -> tuple[np.ndarray, np.ndarray]:
    """Measured position and speed of a port along the recordings."""
    m = model.mechanism
    if at not in m.port_vectors:
        raise InputError(
            f"Port {at!r} was asked for, but the mechanism has {', '.join(m.port_vectors)}; name one."
        )
    if any((e.name, e.at) == (LearnedTorque.name, at) for e in m.effects):
        raise InputError(
            f"A torque at {at!r} was to be learned, but the model already has one there; take it out with "
            "`without`."
        )
    found = [motion(m, model.measured(r).astype(float), r.Ts) for r in recordings]
    if not all(at in f for f in found):
        raise InputError(
            f"A torque at {at!r} was to be learned, but the measured positions do not determine its motion; "
            "choose a port whose position follows from the outputs."
        )
    return tuple(np.concatenate([f[at][k] for f in found]) for k in (0, 1))  # type: ignore


def _zero_map(at: str, position: np.ndarray, speed: np.ndarray, torque: float) -> LearnedTorque:
    """A map of zero torque over the range of positions and speeds of a port."""
    usual = max(float(np.sqrt(np.mean(speed**2))), 1e-9)
    ranges = []
    for x in (position, speed):
        low, high = np.quantile(x, (0.005, 0.995))
        ranges.append((float(low), float(high) if high > low else float(low) + 1e-6))
    return LearnedTorque(
        at=at,
        position=ranges[0],
        speed=ranges[1],
        bend=EVEN_SPEED_SHARE * usual,
        count=SPLINES,
        scale=0.1 * torque,
    )


def _own_terms(m: Mechanism, at: str) -> tuple[str, ...]:
    """Terms that an offset of the recording, dampers and springs give at a port."""
    stamps = {e.name: e.stamp() for e in m.linear_effects(at)}
    damped = Viscous.name in stamps or any(float(s.damping) for s in stamps.values())
    sprung = any(float(s.stiffness) for s in stamps.values())
    return ("1", *("w",) * damped, *("q",) * sprung)


def _without_map(stage: Stage, at: str) -> Stage:
    """The stage of the model without the map, whose weights are all zero in this stage."""
    head, m = name_prefix(at, LearnedTorque.name), stage.model.mechanism
    return dataclasses.replace(
        stage,
        model=dataclasses.replace(stage.model, mechanism=m.without(LearnedTorque.name, at)),
        estimates=tuple(e for e in stage.estimates if not e.name.startswith(head)),
    )
