"""Structural and practical identifiability of the parameters of a machine.

Structural: which combinations of parameters no recording determines, whatever its length and noise. They are
computed in exact arithmetic for a linear machine (`structural_identifiability.py`), for any other machine by
the rank of the sensitivities of free runs at random parameters and inputs. Practical: which combinations one
recording determines badly, by the eigenvectors of its information about the logarithms of the parameters.

All sensors that a machine might have are outputs of one compiled run. So the benefit of a further sensor
follows from further rows.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.data import excitation
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import prepare
from rotflex_jax.fit.problem import RunLayout, free_run_slopes
from rotflex_jax.fit.result import Fit
from rotflex_jax.fit.structural_identifiability import (
    Direction,
    direction,
    impulse_slopes,
    is_linear,
    kind_of,
    least_held,
    null_space,
    random_values,
    reduced,
)
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.mechanism import ROTOR
from rotflex_jax.mechanism.quantity import Quantity
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import SHORTEST_TO_FIT, single
from rotflex_jax.text.markup import bullets, card, paragraph
from rotflex_jax.text.numbers import json_numbers

# Singular values of normalised sensitivities below this count as zero, apart from rounding.
ZERO = 1e-7
# Number of samples and sampling period [s] of a random run, if no recording gives them.
RANDOM_SAMPLES, RANDOM_PERIOD = 1000, 0.004
# Sizes of random inputs, times 1 V, 0.3 rad or the root mean square of the recording; random parameters lie
# within exp(+-FACTOR) times their values.
INPUT_SIZES, FACTOR = (1.0, 3.0, 10.0), 0.5
# A direction is badly known if its standard deviation exceeds this share of the values.
BADLY_KNOWN = 0.1
# A parameter near zero counts as having this share of its typical size.
SHARE_OF_TYPICAL = 0.1
# A held parameter, a sensor or an input is worth naming if it improves the worst direction by this factor.
HELPS = 3.0


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """Identifiability of the parameters of a machine: structural, and by one recording.

    Attributes:
        free: Free parameters.
        rank: Number of combinations of them that a perfect recording would determine.
        unknown: The combinations that it would not determine.
        trust: The smallest sets of parameters that leave nothing unknown if they are held.
        sensors: Further sensor -> number of combinations that would still be unknown with it; only sensors
            that help.
        exact: Whether the structural part was computed in exact arithmetic.
        badly_known: Combinations that this recording determines with a standard deviation of more than 10 %;
            None without a recording.
        trust_here: Parameter -> largest standard deviation of a combination if it is held; the best first.
        sensors_here: Further sensor -> largest standard deviation of a combination with this sensor.
        inputs_here: Another input -> largest standard deviation of a combination with this input.
        std: Parameter -> standard deviation as a share of its value, by this recording.
    """

    free: tuple[str, ...]
    rank: int
    unknown: tuple[Direction, ...]
    trust: tuple[tuple[str, ...], ...]
    sensors: dict[str, int]
    exact: bool
    badly_known: tuple[Direction, ...] | None = None
    trust_here: dict[str, float] = dataclasses.field(default_factory=dict)
    sensors_here: dict[str, float] = dataclasses.field(default_factory=dict)
    inputs_here: dict[str, float] = dataclasses.field(default_factory=dict)
    std: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def structural(self) -> bool:
        """Whether a perfect recording would determine every free parameter."""
        return not self.unknown

    @property
    def practical(self) -> bool | None:
        """Whether this recording determines all combinations within 10 %; None without a recording."""
        return None if self.badly_known is None else not self.badly_known

    @property
    def sentences(self) -> tuple[str, ...]:
        """All results in words."""
        how = (
            "in exact arithmetic" if self.exact else "by the rank of sensitivities at random parameter values"
        )
        said = []
        if self.structural:
            said.append(f"A perfect recording would determine all {len(self.free)} free parameters ({how}).")
        else:
            said.append(
                f"Of {len(self.free)} free parameters a perfect recording would determine {self.rank} "
                f"combinations ({how})."
            )
            said += [f"{d.sentence}." for d in self.unknown]
            said += [f"To know the rest, trust {_either(self.trust)}."] if self.trust else []
            freeing = [s for s, left in self.sensors.items() if left == 0]
            if freeing:
                said.append(f"Or measure {' or '.join(freeing)}.")
            elif not self.sensors:
                said.append("No further position or speed sensor would help.")
        if self.badly_known is None:
            return tuple(said)
        if not self.badly_known:
            worst = max(self.std, key=lambda n: self.std[n], default="")
            half = 100 * HALF_WIDTH_95
            tail = f"; worst is {worst}, ± {half * self.std[worst]:.2g} %" if worst else ""
            return (
                *said,
                f"This recording determines every combination with a standard deviation of at most "
                f"{100 * BADLY_KNOWN:.0f} % (95 %: ± {half * BADLY_KNOWN:.0f} %){tail}.",
            )
        said += [f"{d.sentence}." for d in self.badly_known if np.isfinite(d.std)]
        if self.structural:
            for words, found in (
                ("trust {}", self.trust_here),
                ("measure {}", self.sensors_here),
                ("record {}", self.inputs_here),
            ):
                if found:
                    best = min(found, key=lambda n: found[n])
                    said.append(
                        f"What would help: {words.format(best)}; the worst combination would be known to "
                        f"± {100 * HALF_WIDTH_95 * found[best]:.2g} %."
                    )
        return tuple(said)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "free": list(self.free),
            "rank": self.rank,
            "exact": self.exact,
            "unknown": [d.to_dict() for d in self.unknown],
            "trust": [list(names) for names in self.trust],
            "sensors": self.sensors,
            "badly_known": None if self.badly_known is None else [d.to_dict() for d in self.badly_known],
            "trust_here": self.trust_here,
            "sensors_here": self.sensors_here,
            "inputs_here": self.inputs_here,
            "std": json_numbers(self.std),
            "sentences": list(self.sentences),
        }

    def _repr_html_(self) -> str:
        """A card with structural identifiability first, then identifiability by the recording."""
        first, *others = self.sentences
        return card("What can be known", paragraph(first), bullets(others))

    def __str__(self) -> str:
        return "\n".join(self.sentences)


def _either(sets: Sequence[Sequence[str]]) -> str:
    """Sets of names as alternatives in words, at most six of them."""
    shown = [" with ".join(names) for names in sets[:6]]
    return (" or " if len(sets[0]) == 1 else ", or ").join(shown) + (" or others" if len(sets) > 6 else "")


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Sensors that a machine has, and sensors that it might have.

    Attributes:
        here: Rows over positions and speeds of the machine's own channels.
        further: Name in words -> row over positions and speeds of a sensor that the machine lacks.
    """

    here: list[tuple[float, ...]]
    further: dict[str, tuple[float, ...]]

    @classmethod
    def of(cls, m: Mechanism) -> "Sensors":
        """The sensors of a machine; further ones measure all positions and speeds of ports that it lacks."""
        ports = m.port_vectors
        pairs = [(port, Quantity(what)) for _, (port, what) in m.outputs]
        here = [q.row(tuple(ports[port])) for port, q in pairs]
        wanted = {
            f"the {q.value} of {port}": q.row(tuple(v))
            for port, v in ports.items()
            if port != ROTOR
            for q in Quantity
            if q.of_motion
        }
        return cls(here, {name: row for name, row in wanted.items() if row not in here})

    def all_outputs(self, m: Mechanism) -> Mechanism:
        """The machine with all sensors as outputs, its own first."""
        added = {}
        for name in self.further:
            quantity, _, port = name.removeprefix("the ").partition(" of ")
            added[f"further {name}"] = (port, quantity)
        return dataclasses.replace(m, outputs=dict(m.outputs) | added)


def identifiable(mechanism: Mechanism | Model | Fit, recording: Recording | None = None) -> Identifiability:
    """Structural and practical identifiability of the free parameters of a machine.

        structural: rank of d(outputs) / d ln(parameters)
        practical: H = J'J / noise^2,  std = eig(H)^(-1/2)

    The structural part gives the combinations of parameters that no recording of these sensors determines,
    for instance the common factor of all torques if only voltage and angles are measured. It is computed in
    exact arithmetic if all effects are linear, otherwise at three random sets of parameters with random
    inputs of different sizes. The practical part gives the combinations that this recording determines with a
    standard deviation of more than 10 %, at the parameters of the mechanism (fit it first), with first states
    unknown, and with the noise of the sensors. For a fit, residuals replace the noise, and its covariance
    allows for their correlation. Both parts name parameters to trust and sensors that would help, the
    practical part also inputs.

    Args:
        mechanism: A mechanism, a model or a fit; trusted parameters are known.
        recording: Recording for the practical part; None for the structural part alone.

    Raises:
        InputError: If no parameter is free, or if the recording lacks channels of the model.

    Source: M. S. Grewal and K. Glover, IEEE Trans. Autom. Control 21, 1976 (linear); J. A. Jacquez and P.
    Greif, Math. Biosci. 77, 1985 (rank of sensitivities); R. N. Gutenkunst et al., PLoS Comput. Biol. 3, 2007
    (sloppy directions).
    """
    fitted = mechanism if isinstance(mechanism, Fit) else None
    model = fitted.model if fitted else Model.of(mechanism).without_gates()  # type: ignore[arg-type]
    if recording is not None:
        recording = single(recording, "recording", shortest=SHORTEST_TO_FIT)
        model = model.at(recording)
    m = model.mechanism
    if not m.free_names:
        raise InputError("All parameters are trusted, so that there is none to know; release one.")
    sensors = Sensors.of(m)
    if is_linear(m):
        found = _structural_exact(m, sensors)
    else:
        found = _structural_at_random(model, sensors, recording)
    return found if recording is None else _with_recording(found, model, sensors, recording, fitted)


def _structural_exact(m: Mechanism, sensors: Sensors) -> Identifiability:
    free = m.free_names
    rows = [*sensors.here, *sensors.further.values()]
    draws = [random_values(m, free, seed) for seed in (1, 2)]
    slopes = impulse_slopes(m, draws[0], free, rows)

    def lost(given: list[Any], which: Sequence[int]) -> list[Any]:
        return null_space([row for k, row in enumerate(given) if k % len(rows) in which], len(free))

    own = list(range(len(sensors.here)))
    null = lost(slopes, own)
    other = lost(impulse_slopes(m, draws[1], free, rows), own) if null else []
    vectors = np.array(null, float).reshape(-1, len(free))
    values = [np.array([float(d[n]) for n in free]) for d in draws]
    unknown = [
        direction(free, v, kind_of(v, w, *values))
        for v, w in zip(vectors, np.array(other, float).reshape(-1, len(free)), strict=True)
    ]
    helping = {name: len(lost(slopes, [*own, len(own) + k])) for k, name in enumerate(sensors.further)}
    return _structural(free, vectors, unknown, helping, True)


def _structural(
    free: tuple[str, ...],
    vectors: np.ndarray,
    unknown: Sequence[Direction],
    helping: dict[str, int],
    exact: bool,
) -> Identifiability:
    return Identifiability(
        free=free,
        rank=len(free) - len(vectors),
        unknown=tuple(unknown),
        trust=least_held(free, vectors),
        sensors={name: left for name, left in helping.items() if left < len(vectors)},
        exact=exact,
    )


def _structural_at_random(model: Model, sensors: Sensors, recording: Recording | None) -> Identifiability:
    m, rng = model.mechanism, np.random.default_rng(0)
    free = list(m.free_names)
    index = [m.parameter_names.index(n) for n in free]
    Ts = recording.Ts if recording is not None else RANDOM_PERIOD
    N = recording.N if recording is not None else RANDOM_SAMPLES
    unit = 0.3 if m.units.input == "rad" else 1.0
    if recording is not None:
        sizes = np.atleast_1d(np.sqrt(np.mean(np.square(model.inputs(recording)), axis=0)))
    else:
        sizes = np.r_[unit, np.ones(len(m.signals))]
    draws = []
    for k, times in enumerate(INPUT_SIZES):
        values = m.values.copy()
        away = np.exp(rng.uniform(-FACTOR, FACTOR, len(free)))
        values[index] = _nonzero(m)[index] * away
        columns = [excitation.noise(N, Ts, seed=k + len(INPUT_SIZES) * c) for c in range(len(sizes))]
        u = times * (sizes[0] * columns[0] if len(sizes) == 1 else sizes * np.column_stack(columns))
        draws.append((values, Runs(model, sensors, values, u, Ts, least_share=0.0).scaled()))
    C = len(sensors.here)

    def lost(rows: Sequence[int]) -> tuple[np.ndarray, int]:
        """Directions that the best draw leaves unknown, and the index of this draw."""
        null = [_null_vectors(J[:, rows]) for _, J in draws]
        best = min(range(len(null)), key=lambda k: len(null[k]))
        return null[best], best

    vectors, best = lost(range(C))
    vectors = reduced(vectors)
    kinds = ["mixed"] * len(vectors)
    alike = [k for k, (_, J) in enumerate(draws) if len(_null_vectors(J[:, range(C)])) == len(vectors)]
    if len(alike) > 1:
        other = next(k for k in alike if k != best)
        again = reduced(_null_vectors(draws[other][1][:, range(C)]))
        kinds = [
            kind_of(v, w, draws[best][0][index], draws[other][0][index])
            for v, w in zip(vectors, again, strict=True)
        ]
    unknown = [direction(free, v, kind) for v, kind in zip(vectors, kinds, strict=True)]
    helping = {
        name: len(lost([*range(C), C + k])[0]) if len(vectors) else 0
        for k, name in enumerate(sensors.further)
    }
    return _structural(tuple(free), vectors, unknown, helping, False)


def _null_vectors(J: Float[np.ndarray, "N C K"]) -> Float[np.ndarray, "n K"]:
    """Directions (rows) that sensitivities map to zero, apart from rounding."""
    flat = J.reshape(-1, J.shape[-1])
    if not np.isfinite(flat).all():
        return np.eye(J.shape[-1])
    size = np.linalg.norm(flat, axis=0)
    seen = size > ZERO * max(float(size.max()), 1e-300)
    scaled = np.where(seen, flat / np.where(seen, size, 1.0), 0.0)
    _, s, V = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    null = V[s < ZERO * max(float(s[0]), 1e-300)]
    # Scaled back to shares of the values.
    return null / np.where(seen, size / size.max(), 1.0)


def _nonzero(m: Mechanism) -> np.ndarray:
    """Parameter values, with a share of the typical size in the place of values near zero."""
    typical = np.array([s.typical for s in m.parameter_specifications])
    small = np.abs(m.values) < SHARE_OF_TYPICAL * typical
    return np.where(small, SHARE_OF_TYPICAL * typical * np.where(m.values < 0, -1, 1), m.values)


@dataclasses.dataclass(frozen=True)
class Runs:
    """A free run with all sensors, and its slopes.

    Attributes:
        model: Machine and solver.
        sensors: Sensors of the machine and further ones.
        values: Values of all parameters.
        u: Input.
        Ts: Sampling period [s].
        start: First positions and speeds; at rest if None.
        least_share: Least size to which changes of a parameter are related, as a share of its typical size.
    """

    model: Model
    sensors: Sensors
    values: np.ndarray
    u: np.ndarray
    Ts: float
    start: np.ndarray | None = None
    least_share: float = SHARE_OF_TYPICAL

    def slopes(self) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C D"]]:
        """Outputs, and slopes by relative changes of free parameters, then by first positions and speeds."""
        m = self.sensors.all_outputs(self.model.mechanism)
        names, states = m.parameter_names, 2 * len(m.coordinates)
        free = np.array([names.index(n) for n in m.free_names])
        typical = np.array([s.typical for s in m.parameter_specifications])
        shares = np.maximum(np.abs(self.values), self.least_share * typical)
        layout = RunLayout(m.structure, self.model.solver, states)
        start = np.zeros(states) if self.start is None else self.start
        return free_run_slopes(layout, self.values, shares, free, start, self.u, self.Ts)

    def scaled(self) -> Float[np.ndarray, "N C K"]:
        """Slopes by relative changes of the parameters, each channel divided by the size of its signal."""
        y, J = self.slopes()
        size = np.maximum(np.std(y, axis=0), 1e-12)
        return J[..., : len(self.model.mechanism.free_names)] / size[:, None]


def _information(
    J: Float[np.ndarray, "N C D"], noise: Float[np.ndarray, " C"], K: int
) -> Float[np.ndarray, "K K"]:
    """Information about relative changes of the parameters, with first states unknown."""
    flat = (J / noise[:, None]).reshape(-1, J.shape[-1])
    H = flat.T @ flat
    if J.shape[-1] == K:
        return H
    return H[:K, :K] - H[:K, K:] @ np.linalg.pinv(H[K:, K:], hermitian=True) @ H[K:, :K]


def _directions(H: Float[np.ndarray, "K K"]) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations along the eigenvectors of an information, largest first; these vectors as rows."""
    eigenvalues, vectors = np.linalg.eigh((H + H.T) / 2)
    return 1 / np.sqrt(np.maximum(eigenvalues, 1e-300)), vectors.T


def _with_recording(
    found: Identifiability, model: Model, sensors: Sensors, recording: Recording, fitted: Fit | None
) -> Identifiability:
    m, free = model.mechanism, found.free
    K, C = len(free), len(sensors.here)
    start = model.states_at(recording, np.array([0]))[0][: 2 * len(m.coordinates)]
    u, Ts = model.inputs(recording), float(recording.Ts)
    y, J = Runs(model, sensors, m.values, u, Ts, start).slopes()
    if not np.isfinite(J).all():
        raise InputError(
            "The model diverges over this recording, so that nothing can be said of it; fit it first."
        )
    prepared = prepare(model, [recording])
    noise = prepared.noise
    if fitted is not None:
        noise = np.maximum(noise, [fitted.noise[c] for c in m.channels])
    # A further sensor is assumed as good, relative to its signal, as the best sensor of the machine.
    spread = np.maximum(np.std(y, axis=0), 1e-12)
    relative = float(np.min(noise / spread[:C]))
    every = np.concatenate([noise, relative * spread[C:]])
    H = _information(J[:, :C], noise, K)
    if fitted is not None and np.isfinite(fitted.covariance).all() and fitted.free_names == free:
        # The covariance of the fit allows for the correlation of errors in time.
        typical = np.array([s.typical for s in m.parameter_specifications])
        shares = np.maximum(np.abs(m.values), SHARE_OF_TYPICAL * typical)
        shares = shares[[m.parameter_names.index(n) for n in free]]
        H = np.linalg.pinv(fitted.covariance / np.outer(shares, shares), rcond=1e-14, hermitian=True)
    std, vectors = _directions(H)
    bad = [
        direction(free, v, "mixed", min(s, 1e9)) for s, v in zip(std, vectors, strict=True) if s > BADLY_KNOWN
    ]
    worst = float(std[0])
    each = np.sqrt(np.maximum(np.diag(np.linalg.pinv(H, rcond=1e-14, hermitian=True)), 0.0))
    trust, further, inputs = {}, {}, {}
    if bad and found.structural:
        base = _information(J[:, :C], noise, K)
        counts = worst / _directions(base)[0][0]  # factor by which correlated errors widen the intervals
        for k, name in enumerate(free):
            rest = np.delete(np.arange(K), k)
            if len(rest):
                trust[name] = float(_directions(H[np.ix_(rest, rest)])[0][0])
        for k, name in enumerate(sensors.further):
            rows = [*range(C), C + k]
            further[name] = float(counts * _directions(_information(J[:, rows], every[rows], K))[0][0])
        for name, other in _other_inputs(u, Ts).items():
            J_other = Runs(model, sensors, m.values, other, Ts, start).slopes()[1]
            if np.isfinite(J_other).all():
                inputs[name] = float(counts * _directions(_information(J_other[:, :C], noise, K))[0][0])
    helpful = lambda options: {  # noqa: E731
        n: s for n, s in sorted(options.items(), key=lambda pair: pair[1]) if s < worst / HELPS
    }
    return dataclasses.replace(
        found,
        badly_known=tuple(bad),
        trust_here=helpful(trust),
        sensors_here=helpful(further),
        inputs_here=helpful(inputs),
        std=dict(zip(free, each.tolist(), strict=True)),
    )


def _other_inputs(u: Float[np.ndarray, "N *c"], Ts: float) -> dict[str, Float[np.ndarray, "N *c"]]:
    """Name in words -> another input of the same length that may show more; further signals stay the same."""
    whole, u = u, u if u.ndim == 1 else u[:, 0]
    N, most = len(u), max(float(np.abs(u).max()), 1e-12)
    rms = max(float(np.sqrt(np.mean(u**2))), 1e-12)
    noise = excitation.noise(N, Ts, seed=0)
    t = np.arange(N) * Ts
    slow = np.sin(2 * np.pi * 3 * t / max(t[-1], Ts)) * most
    others = {
        "an input three times as large": 3 * u,
        "noise of the same rms": noise * rms / max(float(np.sqrt(np.mean(noise**2))), 1e-12),
        "three slow swings of the same peak": slow,
    }
    if whole.ndim == 1:
        return others
    return {said: np.column_stack([v, whole[:, 1:]]) for said, v in others.items()}
