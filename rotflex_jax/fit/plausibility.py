"""What is physically plausible: ranges of parameters, signs of channels, sizes the recordings speak for."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.base import HALF_A_PERIOD, Effect, Linear
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, linearise
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, Transform, specifications
from rotflex_jax.recording import Recording
from rotflex_jax.recording.smoothing import smoothed


def motion(
    mechanism: Mechanism, y: Float[np.ndarray, "N C"], Ts: float, smooth: float = 0.03
) -> dict[str, tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]]:
    """Port -> (position, speed) by smoothing measured outputs over `smooth` seconds.

    Ports that the measured positions do not determine are left out.
    """
    layout = Layout.of(mechanism.structure)
    rows = np.array(layout.output_rows)
    is_position = np.array([q.is_position for q in mechanism.quantities])
    if not is_position.any():
        return {}
    width = max(2 * round(smooth / Ts / 2) + 1, 5)
    width = min(width, len(y) - 1 + len(y) % 2)
    C = rows[is_position, : layout.n]
    position, speed = (
        np.stack([smoothed(column, width, 3, order, Ts) for column in y[:, is_position].T], axis=1)
        for order in (0, 1)
    )
    back, out = np.linalg.pinv(C), {}
    for port, vector in mechanism.port_vectors.items():
        p = np.array(vector) @ back
        if np.allclose(p @ C, vector):
            out[port] = (position @ p, speed @ p)
    return out


_DAMPING = "N m s/rad"


def physical_ranges(m: Mechanism) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Least and largest unconstrained value of each parameter.

    They are the physical ranges that effects declare. A damping coefficient may fall below its own range as
    far as others damp the same port: then it corrects them, as with a back-EMF constant that is trusted and
    too large, and what stays is the damping of a machine. A start outside widens the range.

    Args:
        m: With the values at the start.
    """
    low, high = [], []
    for effect in m.effects:
        others = sum(e.stamp().static().damping for e in m.linear_effects(effect.at) if e is not effect)
        for spec in specifications(effect).values():
            corrects = isinstance(effect, Linear) and spec.unit == _DAMPING
            low.append(spec.physical[0] - (max(others, 0.0) if corrects else 0.0))
            high.append(spec.physical[1])
    values, transform = m.values, Transform.of(m.parameter_specifications)
    low, high = np.minimum(low, values), np.maximum(high, values)
    # An end beyond a declared bound is never reached. A coordinate runs with its parameter but where that
    # has only an upper bound, and no effect declares such a one.
    ends = (low > transform.lower, low, -np.inf), (high < transform.upper, high, np.inf)
    lowest, highest = (
        np.where(inside, transform.unconstrain(np.where(inside, end, values)), none)
        for inside, end, none in ends
    )
    return lowest, highest


# Moves over each of these shares of the recording, of at most so many samples, are compared.
MOVE_SHARES, MAX_SIGN_SAMPLES = (0.001, 0.003, 0.01, 0.03), 20_000
# Samples of a block of the linear run.
LINEAR_RUN_BLOCK = 64
# A channel that moves against the model at all shares, correlated at least this much.
OPPOSED_CORRELATION = -0.6


def check_signs(model: Model, recordings: Sequence[Recording]) -> None:
    """Refuses recordings whose channels move against the model.

    The linear part of the model, with the parameters that it has, runs under the recorded input. Rough
    values will do, as only the direction of each move counts. A resonance that the model puts on the other
    side of all excited frequencies reverses a channel as well: then a nearer start helps. Recordings with
    signals are not looked at: what a signal moves may outweigh the input, whether the model has it or not.

    Args:
        model: Before any fit.
        recordings: To be fitted.

    Raises:
        InputError: Channels that move in the opposite direction.
    """
    against: set[str] = set()
    worst = 0.0
    for recording in (r for r in recordings if not r.signals):
        linear = linearise(model.at(recording).mechanism)
        r = recording.slice(0, min(recording.N, MAX_SIGN_SAMPLES))
        y, would = model.measured(r).astype(float), _response(linear.discretise(r.Ts), linear.C, r.u)
        if not np.all(np.isfinite(would)):
            continue
        for channel, a, b in zip(model.mechanism.channels, y.T, would.T, strict=True):
            found = [_correlation(a, b, max(round(share * r.N), 1)) for share in MOVE_SHARES]
            if max(found) < OPPOSED_CORRELATION:
                against.add(channel)
                worst = min(worst, *found)
    if not against:
        return
    every = against == set(model.mechanism.channels)
    names = " and ".join(c for c in model.mechanism.channels if c in against)
    what = "the input" if every else f"the column of {names}"
    verb = "moves" if len(against) == 1 else "move"
    raise InputError(
        f"{names} {verb} against what the model would do under this input (correlation {worst:.2f}), as with "
        f"a sign turned round; negate {what} if that is so, or give the model a start nearer to the machine."
    )


def _response(discrete: tuple[np.ndarray, np.ndarray], C: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs (N, C) of a linear system from rest, a block of samples at a time."""
    A, B = discrete
    with np.errstate(all="ignore"):
        powers = np.array([*itertools.accumulate([A] * LINEAR_RUN_BLOCK, np.matmul, initial=np.eye(len(A)))])
        left, pushed = (
            C @ powers[:-1],
            powers[:-1] @ B,
        )  # what a state and an input do later (L, C, n), (L, n)
        lag = np.subtract.outer(np.arange(LINEAR_RUN_BLOCK), np.arange(LINEAR_RUN_BLOCK)) - 1
        kernel = np.where(lag[..., None] >= 0, (pushed @ C.T)[lag], 0.0)  # (L, L, C)
        blocks = np.pad(u, (0, -len(u) % LINEAR_RUN_BLOCK)).reshape(-1, LINEAR_RUN_BLOCK)
        adds = blocks @ pushed[::-1]
        states = np.array(
            [*itertools.accumulate(adds[:-1], lambda x, new: powers[-1] @ x + new, initial=0 * B)]
        )
        y = np.tensordot(blocks, kernel, (1, 1)) + np.tensordot(states, left, (1, 2))
    return y.reshape(-1, len(C))[: len(u)]


def _correlation(a: np.ndarray, b: np.ndarray, step: int) -> float:
    """Correlation of moves over a number of samples; zero where nothing moves."""
    moves = [x[step:] - x[:-step] for x in (a, b)]
    if min(np.ptp(m) for m in moves) == 0:
        return 0.0
    return float(np.corrcoef(moves[0], moves[1])[0, 1])


# A size is beyond the recordings where it is more than this many times the largest signal in them.
BEYOND = 3.0
BEYOND_RECORDINGS = "beyond the recordings"
"""Kind of a remark on such a size."""


class Reach(NamedTuple):
    """How far the signals of some recordings go.

    Attributes:
        input: Largest |u| [unit of the input].
        position: Port -> largest distance from the middle of its travel; channel -> largest |reading|.
        speed: Port -> largest speed.
        seconds: The longest recording [s].
    """

    input: float
    position: dict[str, float]
    speed: dict[str, float]
    seconds: float

    @classmethod
    def of(cls, model: Model, recordings: Sequence[Recording]) -> "Reach":
        """That of recordings, at the ports that their channels determine."""
        position: dict[str, float] = {}
        speed: dict[str, float] = {}
        for r in recordings:
            y = model.measured(r).astype(float)
            largest = dict(zip(model.mechanism.channels, np.abs(y).max(axis=0).tolist(), strict=True))
            for port, (q, dq) in motion(model.mechanism, y, r.Ts).items():
                largest[port] = float(np.ptp(q)) / 2
                speed[port] = max(speed.get(port, 0.0), float(np.abs(dq).max()))
            for name, size in largest.items():
                position[name] = max(position.get(name, 0.0), size)
        voltage = max(float(np.abs(r.u).max()) for r in recordings)
        return cls(voltage, position, speed, max(r.N * r.Ts for r in recordings))

    def limit(self, effect: Effect, unit: str) -> tuple[float, str] | None:
        """The most that the recordings reach of what a parameter is a size of, and what that is."""
        if unit == "V" and effect.at == "input":
            return self.input, "the input"
        if unit == "s" and effect.acts_on in ("input", "channel"):
            return self.seconds / BEYOND, "a third of the recording"
        if unit == "rad" and effect.at in self.position:
            return self.position[effect.at], f"the motion of {effect.at}"
        if unit == "rad/s" and effect.at in self.speed:
            return self.speed[effect.at], f"the speed of {effect.at}"
        return None


class Remark(NamedTuple):
    """What a reader must know of one parameter.

    Attributes:
        parameter: Full name.
        kind: `BEYOND_RECORDINGS`, "at a bound", or `discretisation_bias.COARSE_STEP`.
        sentence: In words, with numbers.
    """

    parameter: str
    kind: str
    sentence: str

    def to_dict(self) -> dict[str, str]:
        """Plain JSON types."""
        return self._asdict()


def beyond_recordings(m: Mechanism, reach: Reach, effects: Iterable[Effect] | None = None) -> list[Remark]:
    """Free parameters of sizes that the recordings do not reach.

    They are sizes of a signal and more than three times as large as it ever was: the recordings cannot tell
    one size from another, and an effect with such a threshold is inactive. Or they count the repetitions of
    a law of which the motion covers less than half a period: it is a spring or a constant torque there.

    Args:
        m: With the values in question.
        reach: Of the recordings that they were fitted to.
        effects: Those that are looked at; all of them if None.
    """
    found = []
    for effect in m.effects if effects is None else effects:
        for name, spec in specifications(effect).items():
            full, value = effect.full_name(name), float(getattr(effect, name))
            if full in m.trusted:
                continue
            unit, limit = m.units.of(effect, spec.unit), reach.limit(effect, spec.unit)
            if limit is not None and abs(value) > BEYOND * limit[0]:
                why = (
                    f"is far beyond what these recordings reach ({limit[1]}: {limit[0]:.3g} {unit}), so that "
                    "they do not determine it"
                )
            elif name == effect.repeats and value * reach.position.get(effect.at, np.inf) < HALF_A_PERIOD:
                travel = math.degrees(2 * reach.position[effect.at])
                why = (
                    f"per turn is less than half a period within the motion of {effect.at} ({travel:.3g} "
                    "degrees), where the law is a spring or a constant torque"
                )
            else:
                continue
            sentence = f"{full} = {value:.3g} {unit}".rstrip() + f" {why}"
            found.append(Remark(full, BEYOND_RECORDINGS, sentence))
    return found


def at_bounds(estimates: Iterable[Estimate]) -> list[Remark]:
    """Free parameters at an end of their range."""
    return [
        Remark(e.name, "at a bound", f"{e.name} = {e.value:.3g} {e.unit}".rstrip() + f" is {_bound(e.note)}")
        for e in estimates
        if e.free and _bound(e.note)
    ]


def _bound(note: str) -> str:
    return next((part for part in note.split("; ") if part in AT_BOUND.values()), "")


AT_BOUND: Mapping[str, str] = {"lower": "at its lower bound", "upper": "at its upper bound"}
