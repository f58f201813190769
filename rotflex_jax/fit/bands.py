"""Bands around a free run: where a measurement would lie, and what widens them.

    y - y_hat ~ N(0, sum of parts),   part_p = S V S',  S = J_p + J_x dx0/dp

Each part is the variance caused by one source of uncertainty, to first order: the parameters (by the
covariance of the fit), the first state (by the noise of the samples from which it is estimated), local
parameters of each recording, process noise, the sensor, and what the model lacks (by the errors of free runs
over known recordings).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from rotflex_jax import checks
from rotflex_jax.effects.base import Memory
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import sensor_noise
from rotflex_jax.fit.problem import RunLayout, free_run_slopes
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Mechanism, linearise
from rotflex_jax.mechanism.assembly import Layout, effects_of
from rotflex_jax.mechanism.linear import inverse_mass, output_units, process_covariance
from rotflex_jax.models.model import Model
from rotflex_jax.optimise.damped_least_squares import NormalEquations, Rules, minimise
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, listed_if_given, single
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import plain_number, readable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = (
    "parameters",
    "first state",
    "own of each recording",
    "process torque",
    "sensor",
    "what the model lacks",
    "between models",
)
"""Sources of uncertainty that widen a band, in the order of tables."""
# A recording starts at rest if its first speeds are below this share of the root mean square speeds.
AT_REST = 0.02
# Rules of the fit of a first state, whose cost is in nats, and its largest number of steps.
FIRST_STATE_RULES, FIRST_STATE_STEPS = Rules(enough=0.05, largest=1e4), 16
# Standard deviation, in ranges of the measured motion, from which on propagation to first order is
# meaningless.
MOST_RANGES = 100
# Phase per sample from which on a step no longer resolves the oscillation of bristles [rad]; speed [rad/s]
# and state at which their stiffness at rest is computed.
MOST_BRISTLE_PHASE, SLOW_SPEED, SMALL_STATE = 0.5, 1e-6, 1e-6
# Number of bisections of the interval that contains a quantile of a mixture.
HALVINGS = 60


@dataclasses.dataclass(frozen=True, eq=False)
class Bands:
    """Bands in which the outputs of a recording would lie, sample by sample.

    Attributes:
        recording: Recording whose input was run.
        channels: Channels of the model.
        units: Units of the channels.
        level: Probability of each sample to lie inside.
        middle: Free run, with first states (memories included) from the first samples; for several models,
            the weighted mean of their free runs.
        lower: Lower end of the band.
        upper: Upper end of the band.
        parts: Source of uncertainty -> standard deviation that it causes alone.
    """

    recording: Recording
    channels: tuple[str, ...]
    units: tuple[str, ...]
    level: float
    middle: Float[np.ndarray, "N C"]
    lower: Float[np.ndarray, "N C"]
    upper: Float[np.ndarray, "N C"]
    parts: dict[str, Float[np.ndarray, "N C"]]

    def coverage(self, recording: Recording | None = None) -> dict[str, float]:
        """Share of the measured samples inside the band, by channel, without the first `n_init` samples.

        Args:
            recording: Measurement under the same input; the recording of the band if None.

        Raises:
            InputError: If the recording has another length, or lacks a channel.
        """
        recording = single(self.recording if recording is None else recording, "recording")
        missing = [c for c in self.channels if c not in recording.channels]
        if missing or len(self.middle) != recording.N:
            what = f"lacks the channel {missing[0]!r}" if missing else f"has {recording.N} samples"
            raise InputError(
                f"The bands are of {len(self.middle)} samples of {', '.join(self.channels)}, but the "
                f"recording {what}; give a measurement under the same input."
            )
        y = np.stack([recording.channel(c) for c in self.channels], axis=1).astype(float)
        inside = ((self.lower <= y) & (y <= self.upper))[recording.n_init :]
        return dict(zip(self.channels, inside.mean(axis=0).tolist(), strict=True))

    @property
    def shares(self) -> dict[str, dict[str, float]]:
        """Channel -> source of uncertainty -> share of the mean variance."""
        mean = {name: np.mean(np.square(part), axis=0) for name, part in self.parts.items()}
        total = np.sum(list(mean.values()), axis=0)
        return {
            channel: {
                name: float(value[c] / total[c]) if total[c] > 0 else 0.0 for name, value in mean.items()
            }
            for c, channel in enumerate(self.channels)
        }

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        half = (self.upper - self.lower) / 2
        return {
            "level": self.level,
            "channels": list(self.channels),
            "mean_half_width": dict(zip(self.channels, half.mean(axis=0).tolist(), strict=True)),
            "coverage": self.coverage(),
            "shares": self.shares,
        }

    def plot(self) -> "Figure":
        """Figure of the band around the free run with the measured outputs, and of its parts over time."""
        from rotflex_jax.fit.bands_figure import bands_figure  # takes long to import

        return bands_figure(self)

    def _repr_html_(self) -> str:
        """A card with mean width, coverage and largest source of uncertainty of each channel."""
        rows, covered, shares = [], self.coverage(), self.shares
        for c, (channel, unit) in enumerate(zip(self.channels, self.units, strict=True)):
            half, read = readable(float(np.mean(self.upper[:, c] - self.lower[:, c]) / 2), unit)
            most = max(shares[channel], key=lambda name: shares[channel][name])
            share = f"{most} ({100 * shares[channel][most]:.0f} %)"
            rows.append((channel, read, share, plain_number(half), f"{100 * covered[channel]:.1f} %"))
        return card(
            f"Bands of {100 * self.level:g} % around a free run",
            table(
                ("channel", "unit", "widened most by", "mean half width", "measured inside"), rows, words=3
            ),
            paragraph("Each sample by itself: neighbouring samples leave the band together."),
        )

    def __str__(self) -> str:
        shares = self.shares
        lines = [f"Bands of {100 * self.level:g} %"]
        for channel, inside in self.coverage().items():
            large = sorted(shares[channel].items(), key=lambda pair: -pair[1])[:3]
            by = ", ".join(f"{name} {100 * share:.0f} %" for name, share in large if share >= 0.005)
            lines.append(f"  {channel}: {100 * inside:.1f} % of the samples inside; widened by {by}")
        return "\n".join(lines)


def prediction_bands(
    fitted: Fit | Sequence[tuple[Fit, float]],
    recording: Recording,
    level: float = 0.9,
    *,
    known: Recording | Sequence[Recording] = (),
) -> Bands:
    """Bands in which the samples of a recording lie with some probability, around a free run over it.

        y_k - y_hat_k ~ N(0, v_k),   v_k = sum of the parts,   band: y_hat_k -+ quantile(level) sqrt(v_k)

    The run starts from the first `n_init` samples, like every free run. If the recording does not start at
    rest, memories that no sensor shows, such as the state of a friction, are estimated from these samples
    too. The variance of a sample is the sum of these parts:

    - parameters, by the covariance of the fit; the first state follows them;
    - the first state, by the noise of the samples from which it is estimated;
    - local parameters of each recording, by their scatter;
    - process noise, by the linear part of the machine;
    - the noise of the sensors;
    - what the model lacks, a constant for each channel. With `known` recordings, it is so large that bands
      over them contain the share `level` of their samples. Without any, it is the variance of the fit's
      residuals beyond the sensor noise; or zero for a fit to predictions, whose residuals are no errors of
      free runs.

    For several models with weights, the band is that of their mixture.

    All parts are propagated to first order. Do not use it for a run in which a small change of a parameter
    decides between two motions.

    Args:
        fitted: A fit; or pairs of a fit and its weight, one for each set of effects that may be true.
        recording: Recording whose input, first samples and sensor noise are used; other samples are used by
            `coverage` only.
        level: Probability, between 0 and 1.
        known: Recordings of the same machine by which the error of the model is measured, preferably
            recordings that were not fitted.

    Raises:
        InputError: If there is no fit, if weights are not positive, if models have different channels, or if
            a run or its slopes diverge (`MOST_RANGES`).

    Source: L. Ljung, System Identification, 2nd ed., 1999, section 9.4 (propagation of a covariance); V.
    Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, 2005 (width by known errors).
    """
    recording = single(recording, "recording", shortest=SHORTEST_TO_FIT)
    level, others = checked_level(level), listed_if_given(known, "known", SHORTEST_TO_FIT)
    sources = []
    for fit, weight in _weighted(fitted):
        values = fit.model.mechanism.named_values
        run = FitForRun(fit, {name: scatter(each, values[name]) for name, each in fit.local.items()})
        sources.append(BandSource(run, weight, [(run, r) for r in others]))
    return mixed_bands(sources, recording, level)


class FitForRun(NamedTuple):
    """A fit as it is used for the recordings of one run.

    Attributes:
        fit: The fit, whose model has the values for this run.
        own: Local parameter -> variance about its value for this run, in addition to the covariance of the
            fit.
    """

    fit: Fit
    own: Mapping[str, float]


class BandSource(NamedTuple):
    """One of the models from which a band is computed.

    Attributes:
        run: The fit for the run of the recording.
        weight: Probability, up to a common factor.
        known: Recordings by which the error of the model is measured, each with the fit for its run.
    """

    run: FitForRun
    weight: float
    known: Sequence[tuple[FitForRun, Recording]] = ()


def scatter(of_runs: Sequence[Estimate], value: float) -> float:
    """Variance of a parameter in another run about a value, from the estimates of some runs."""
    values = np.array([e.value for e in of_runs])
    variance = float(np.var(values, ddof=1)) if len(values) > 1 else 0.0
    return variance + (float(np.mean(values)) - value) ** 2


def checked_level(level: Any) -> float:
    """The argument `level`, checked to be between 0 and 1."""
    return checks.number(level, "level", above=0, below=1, example="0.9")


def mixed_bands(sources: Sequence[BandSource], recording: Recording, level: float) -> Bands:
    """Bands over a recording of the mixture of several models; see `prediction_bands`."""
    quantile = float(scipy.stats.norm.ppf((1 + level) / 2))
    runs, variances, weights = [], [], []
    for source in sources:
        y_hat, parts = _run(source.run, recording)
        lacks = _lacking(source, quantile, level, parts["sensor"][0])
        parts["what the model lacks"] = np.broadcast_to(lacks, y_hat.shape)
        runs.append(y_hat)
        variances.append(parts)
        weights.append(source.weight)
    w = np.array(weights) / np.sum(weights)
    middle = np.einsum("m,mnc->nc", w, np.array(runs))
    combined = {
        name: np.einsum("m,mnc->nc", w, np.array([v.get(name, np.zeros_like(middle)) for v in variances]))
        for name in PARTS[:-1]
    }
    combined["between models"] = np.einsum("m,mnc->nc", w, np.square(np.array(runs) - middle))
    totals = np.array([np.sum(list(v.values()), axis=0) for v in variances])
    lower, upper = _mixture(np.array(runs), np.sqrt(totals), w, (1 - level) / 2, quantile)
    m = sources[0].run.fit.model.mechanism
    return Bands(
        recording=recording,
        channels=m.channels,
        units=tuple(output_units(m).values()),
        level=level,
        middle=middle,
        lower=lower,
        upper=upper,
        parts={name: np.sqrt(v) for name, v in combined.items() if np.any(v > 0)},
    )


def _weighted(fitted: Any) -> list[tuple[Fit, float]]:
    """Fits with their weights.

    Raises:
        InputError: If the argument is neither a fit nor such pairs, or if models have different channels.
    """
    pairs = [(fitted, 1.0)] if isinstance(fitted, Fit) else fitted
    right = isinstance(pairs, Sequence) and all(
        isinstance(pair, Sequence) and len(pair) == 2 and isinstance(pair[0], Fit) for pair in pairs
    )
    if not right or not pairs:
        raise InputError(
            f"A fit, or pairs of a fit and its weight, is needed, but {checks.shown(fitted)} was given; give "
            "what rotflex_jax.fit gives."
        )
    found = [(fit, checks.positive(weight, "weight", "", "0.5")) for fit, weight in pairs]
    channels = {fit.model.mechanism.channels for fit, _ in found}
    if len(channels) > 1:
        raise InputError(
            "The models have different outputs, "
            + " and ".join(", ".join(c) for c in sorted(channels))
            + ", but bands are of the same outputs; give models of one machine."
        )
    return found


def _run(
    fit_for_run: FitForRun, recording: Recording
) -> tuple[Float[np.ndarray, "N C"], dict[str, np.ndarray]]:
    """A free run, and the variances of its samples by parameters, first state, process noise and sensor."""
    fitted, model = fit_for_run.fit, fit_for_run.fit.model
    m = model.at(recording).mechanism
    names = m.parameter_names
    free = np.array([names.index(n) for n in fitted.free_names], int)
    y = model.measured(recording).astype(float)
    noise = sensor_noise([recording], model)
    moving, F = 2 * len(m.coordinates), len(free)
    start = model.states_at(recording, np.array([0]))[0]
    unseen = _unseen(model, recording, start, moving)

    def run(state: Float[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
        """Outputs; slopes by parameters, by positions and speeds, and by coordinates of unseen states."""
        y_hat, J = _slopes(model, m, recording, state, free)
        with np.errstate(over="ignore", invalid="ignore"):  # of a run that diverges, which is refused below
            return y_hat, np.concatenate([J[..., : F + moving], J[..., F + moving :] @ unseen], axis=-1)

    if unseen.size:
        start = _first_state(run, start, unseen, y, noise, recording.n_init, F)
    y_hat, J = run(start)
    if not (np.isfinite(y_hat).all() and np.isfinite(J).all()):
        of = f"{recording.source or 'a recording'} ({recording.N * recording.Ts:.3g} s)"
        raise InputError(
            f"The model diverges over {of}; bands need finite runs over the recording and over those by "
            "which the error of the model is measured (`known`; of a search without it, its own). Choose "
            "other recordings, or fit again."
        )
    known = np.array([n in recording.constants for n in fitted.free_names], bool)
    J[..., :F][..., known] = 0.0
    # The first state is the least-squares estimate from the first samples, given the parameters.
    by, first = J[: recording.n_init, :, :F], J[: recording.n_init, :, F:]
    if unseen.size:
        weight, prior = 1 / noise**2, np.diag([0.0] * moving + [1.0] * unseen.shape[1])
    else:
        weight, prior = np.ones_like(noise), 0.0  # unweighted channels, as at the start of a free run
    H = np.einsum("ncs,c,nct->st", first, weight, first) + prior
    inverse = np.linalg.pinv(H, rcond=1e-12, hermitian=True)
    follows = -inverse @ np.einsum("ncs,c,ncp->sp", first, weight, by)
    squares = np.einsum("ncs,c,nct->st", first, (weight * noise) ** 2, first) + prior
    whole = J[..., :F] + J[..., F:] @ follows
    parts = {
        "parameters": _propagated(whole, _finite(fitted.covariance)),
        "first state": _propagated(J[..., F:], inverse @ squares @ inverse),
        "sensor": np.broadcast_to(noise**2, y.shape),
    }
    own = np.zeros_like(y)
    for name, variance in fit_for_run.own.items():
        own = own + variance * np.square(whole[..., fitted.free_names.index(name)])
    if own.any():
        parts["own of each recording"] = own
    # The motion of the run: the recording may be a planned one, of which only the first samples are real.
    _refuse_growing(model, recording, parts, np.maximum(np.ptp(y_hat, axis=0), noise))
    if fitted.options.process_noise is not None:
        parts["process torque"] = _process_variance(m, fitted.options.process_noise, recording)
    return y_hat, parts


def _refuse_growing(
    model: Model, recording: Recording, parts: Mapping[str, np.ndarray], ranges: Float[np.ndarray, " C"]
) -> None:
    """Refuse a run whose slopes grow without limit, such as that of an unstable machine held by friction.

    Raises:
        InputError: If the standard deviation of a channel is far beyond its motion.
    """
    widths = np.sqrt(np.mean(np.sum(list(parts.values()), axis=0), axis=0))
    for channel, width, motion in zip(model.mechanism.channels, widths, ranges, strict=True):
        if width > MOST_RANGES * motion:
            cause, cure = "as with negative damping", "Fit a model that is stable"
            if fast := _fast_bristles(model.mechanism, recording.Ts):
                cause = f"as where {fast} swings within a sample, or with negative damping"
                cure = "Fit Coulomb or Stribeck friction in its place, or a model that is stable"
            raise InputError(
                f"The band of {channel} would be {width / motion:.1g} times as wide as its motion in "
                f"{recording.source or 'a recording'}: the slopes of this model grow along the run, {cause}, "
                f"and to first order nothing is known. {cure}, or give a shorter recording."
            )


def _fast_bristles(m: Mechanism, Ts: float) -> str:
    """The friction with memory that oscillates too fast for the sampling period, in words; else empty.

    At rest it acts as a spring with stiffness `k = -(d tau/dz) (d (dz/dt)/d speed)`, which oscillates with
    `w = sqrt(k / J)` against the inertia `J` of the port.
    """
    inverse = inverse_mass(m)
    for _, e in effects_of(m, Memory):
        if e.driven_by != "voltage" or not e.law_of:
            continue
        rate = float(e.flow(0.0, 0.0, SLOW_SPEED, 0.0)) / SLOW_SPEED
        bent, straight = (float(e.force(z, 0.0, 0.0, 0.0)) for z in (SMALL_STATE, 0.0))
        torque = (bent - straight) / SMALL_STATE
        p = np.array(m.port_vectors[e.at])
        w = np.sqrt(max(-rate * torque * float(p @ inverse @ p), 0.0))
        if w * Ts > MOST_BRISTLE_PHASE:
            return f"the {e.title} at the {e.at}"
    return ""


def _unseen(
    model: Model, recording: Recording, start: Float[np.ndarray, " n"], moving: int
) -> Float[np.ndarray, "h k"]:
    """Prior spread of the first states that no sensor shows, such as the state of a friction with memory.

    If a recording starts at rest, or continues another one, it is assumed to start in the states of the
    model. Otherwise the spread of these states is the mean square of their deviations in a run over the
    recording.

    Returns:
        A root of their covariance, without columns if there is no spread.
    """
    X = model.simulate_states(recording)
    if recording.continues is not None or not np.isfinite(X).all():
        return np.zeros((len(start) - moving, 0))
    n = moving // 2
    speed = np.sqrt(np.mean(np.square(X[:, n:moving]), axis=0))
    if np.all(np.abs(start[n:moving]) < AT_REST * speed):
        return np.zeros((len(start) - moving, 0))
    error = X[:, moving:] - start[moving:]
    size, axes = np.linalg.eigh(error.T @ error / len(X))
    kept = size > 1e-12 * max(size.max(initial=0.0), 1e-300)
    return axes[:, kept] * np.sqrt(size[kept])


def _first_state(
    run: Callable[[Float[np.ndarray, " n"]], tuple[np.ndarray, np.ndarray]],
    start: Float[np.ndarray, " n"],
    unseen: Float[np.ndarray, "h k"],
    y: Float[np.ndarray, "N C"],
    noise: Float[np.ndarray, " C"],
    n_init: int,
    parameters: int,
) -> Float[np.ndarray, " n"]:
    """The first state, memories included, fitted to the first samples.

        minimise  sum_k |(y_k - y_hat_k(x0)) / noise|^2 + |c|^2,   x0 = start + (moving, unseen c)

    The memory of a friction determines how far the machine moves before it slides, so the first samples
    contain information on it. A run that starts with a wrong memory has a constant error ever after.

    Args:
        run: Gives outputs and slopes for a first state.
        start: Where the fit begins.
        unseen: Root of the prior covariance of the states that no sensor shows.
        y: Measured outputs.
        noise: Standard deviation of the sensor noise.
        n_init: Number of samples that are used.
        parameters: Number of columns of the slopes that belong to parameters; they come first.
    """
    moving, memories = len(start) - len(unseen), unseen.shape[1]

    def state(x: np.ndarray) -> np.ndarray:
        return start + np.concatenate([x[:moving], unseen @ x[moving:]])

    @np.errstate(over="ignore", invalid="ignore")  # of a run that diverges, whose step is refused
    def equations(x: np.ndarray) -> NormalEquations:
        y_hat, J = run(state(x))
        e = ((y_hat - y) / noise)[:n_init].ravel()
        S = (J[:n_init, :, parameters:] / noise[:, None]).reshape(len(e), -1)
        prior = np.eye(memories, moving + memories, moving)
        return NormalEquations.of(np.vstack([S, prior]), np.concatenate([e, x[moving:]]))

    axes = np.eye(moving + memories)[moving:]
    starts = (np.zeros(moving + memories), *axes, *-axes)  # for example, play may rest on either side
    ends = [minimise(equations, x, FIRST_STATE_RULES, max_steps=FIRST_STATE_STEPS) for x in starts]
    return state(min(ends, key=lambda end: end.cost if np.isfinite(end.cost) else np.inf).x)


def _finite(covariance: np.ndarray) -> np.ndarray:
    """A covariance with zeros for parameters that have none, since they are held at an end of their range."""
    return np.where(np.isfinite(covariance), covariance, 0.0)


def _propagated(S: Float[np.ndarray, "N C P"], V: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "N C"]:
    """Diagonal of `S V S'`."""
    return np.maximum(np.einsum("ncp,pq,ncq->nc", S, V, S), 0.0)


def _slopes(
    model: Model, m: Mechanism, recording: Recording, start: np.ndarray, free: np.ndarray
) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C D"]]:
    """Outputs of a free run, and slopes by the parameters [per unit], then by the first state."""
    layout = RunLayout(m.structure, model.solver, Layout.of(m.structure).size)
    u, Ts = model.inputs(recording), float(recording.Ts)
    y, J = free_run_slopes(layout, m.values, np.ones(len(m.values)), free, start, u, Ts)
    return np.array(y), np.array(J)


def _process_variance(
    m: Mechanism, intensities: dict[str, float], recording: Recording
) -> Float[np.ndarray, "N C"]:
    """Variance of the outputs by process noise after the first samples, in the linear part of the machine."""
    ss = linearise(m)
    Ts = float(recording.Ts)
    Ad, _ = ss.discretise(Ts)
    n, inverse = len(m.coordinates), inverse_mass(m)
    ports = m.port_vectors
    Q = sum(
        (q * process_covariance(ss.A, inverse @ np.array(ports[p]), n, Ts) for p, q in intensities.items()),
        np.zeros_like(ss.A),
    )
    P, found = np.zeros_like(ss.A), np.zeros((recording.N, len(ss.C)))
    for k in range(recording.n_init, recording.N):
        P = Ad @ P @ Ad.T + Q
        found[k] = np.einsum("cs,st,ct->c", ss.C, P, ss.C)
    return found


def _lacking(
    source: BandSource, quantile: float, level: float, sensor: Float[np.ndarray, " C"]
) -> Float[np.ndarray, " C"]:
    """Variance of each channel that is caused by what the model lacks."""
    fitted = source.run.fit
    residual = np.array([fitted.noise[c] for c in fitted.model.mechanism.channels])
    if not source.known:
        if fitted.options.process_noise is not None:
            return np.zeros(len(residual))  # residuals of predictions are no errors of free runs
        return np.maximum(residual**2 - sensor, 0.0)
    errors, others = [], []
    for run, recording in source.known:
        y_hat, parts = _run(run, recording)
        seen = slice(recording.n_init, None)
        errors.append((run.fit.model.measured(recording).astype(float) - y_hat)[seen])
        others.append(np.sum(list(parts.values()), axis=0)[seen])
    e, v = np.concatenate(errors), np.concatenate(others)
    # For each sample, the additional variance with which it would lie on the edge of its band.
    needed = np.square(e / quantile) - v
    return np.maximum(np.quantile(needed, level, axis=0), 0.0)


def _mixture(
    runs: Float[np.ndarray, "M N C"],
    std: Float[np.ndarray, "M N C"],
    weights: Float[np.ndarray, " M"],
    tail: float,
    quantile: float,
) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C"]]:
    """Quantiles of a mixture of normal distributions, by bisection."""
    if len(runs) == 1:
        return runs[0] - quantile * std[0], runs[0] + quantile * std[0]
    ends = []
    for probability in (tail, 1 - tail):
        far = float(scipy.stats.norm.isf(tail / 2)) + 2.0
        low, high = (runs - far * std).min(axis=0), (runs + far * std).max(axis=0)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            below = np.einsum("m,mnc->nc", weights, scipy.stats.norm.cdf((middle - runs) / std)) < probability
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        ends.append((low + high) / 2)
    return ends[0], ends[1]
